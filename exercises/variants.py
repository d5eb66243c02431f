"""Variants of a solution with one expression of its source changed, as beginners change it."""

import ast
import itertools
import re

ONE_ARGUMENT = {"sqrt", "abs", "inv", "sign", "norm"}
OF_VALUES = [("-A", "a sign"), ("A.T", "transposed"), ("0 * A", "set to 0")]
OF_RESULTS = [("np.linalg.inv(A)", "inverted"), ("A[:1]", "only the first"), ("2 * A", "a factor of 2"),
              ("A / 2", "a factor of 2")]  # fmt: skip


def of(folder, name):
    """Yield a sentence and the function of each variant of the solution of an exercise."""
    tree = _joined(folder, name)
    function = next(n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == name)
    names = [one.arg for one in function.args.args]
    for first, second in itertools.combinations(range(len(names)), 2):
        order = list(range(len(names)))
        order[first], order[second] = second, first
        words = f"{names[first]} and {names[second]} are swapped"
        yield words, lambda *given, order=order: _compiled(tree, name)(*(given[k] for k in order))
    for first, second in _pairs_of_indices(tree):
        first.slice, second.slice = second.slice, first.slice
        made = _compiled(ast.fix_missing_locations(tree), name)
        words = f"indices are exchanged: it is `{ast.unparse(second)}` in the place of `{ast.unparse(first)}`"
        first.slice, second.slice = second.slice, first.slice
        yield words, made
    for owner, field, place, node in list(_places(tree)):
        for new, kind in _changes(node):
            _put(owner, field, place, new)
            try:
                words = _shown(owner, new)
                made = _compiled(ast.fix_missing_locations(tree), name)
            except (SyntaxError, ValueError, TypeError):
                continue
            finally:
                _put(owner, field, place, node)
            yield f"{kind}: the result is that of `{words}`", made


def _pairs_of_indices(tree):
    """Pairs of elements of one array with different indices."""
    read = [n for n in ast.walk(tree) if isinstance(n, ast.Subscript) and isinstance(n.ctx, ast.Load)]
    for first, second in itertools.combinations(read, 2):
        same = ast.dump(first.value) == ast.dump(second.value)
        if same and ast.dump(first.slice) != ast.dump(second.slice):
            yield first, second


def _joined(folder, name):
    """The source of a solution with that of the solutions that it imports."""
    tree = ast.parse((folder / f"{name}.py").read_text("utf-8"))
    body = []
    for node in tree.body:
        other = isinstance(node, ast.ImportFrom) and (node.module or "").startswith("solutions.")
        body += _joined(folder, node.module.split(".")[1]).body if other else [node]
    return ast.Module(body, [])


def _compiled(tree, name):
    names = {"__name__": "variant"}
    exec(compile(tree, name, "exec"), names)
    return names[name]


def _places(tree):
    """Owner, field, place in a list or None, and node, from the last function to the first."""
    for function in reversed([n for n in tree.body if isinstance(n, ast.FunctionDef)]):
        for owner in itertools.chain.from_iterable(map(ast.walk, function.body)):
            for field, value in ast.iter_fields(owner):
                for k, node in enumerate(value if isinstance(value, list) else [value]):
                    if isinstance(node, ast.expr | ast.stmt):
                        yield owner, field, k if isinstance(value, list) else None, node
        for k, node in enumerate(function.body):
            yield function, "body", k, node


def _put(owner, field, place, node):
    if place is None:
        setattr(owner, field, node)
    else:
        getattr(owner, field)[place] = node


def _shown(owner, new):
    """The changed expression with what is around it, in one line."""
    text = ast.unparse(new)
    around = ast.unparse(owner).split("\n")[0]
    if isinstance(new, ast.stmt) or isinstance(owner, ast.FunctionDef) or len(around) > 90:
        around = text
    return re.sub(r"\s+", " ", around)


def _expression(template, *nodes):
    """An expression with nodes in place of A and B."""
    tree = ast.parse(template, mode="eval").body
    given = dict(zip("AB", nodes, strict=False))

    class Fill(ast.NodeTransformer):
        def visit_Name(self, node):
            return given.get(node.id, node)

    if template == "A.T" and getattr(nodes[0], "attr", "") == "T":
        return nodes[0].value
    if template == "-A" and isinstance(nodes[0], ast.UnaryOp):
        return nodes[0].operand
    return Fill().visit(tree)


def _changes(node):
    """Yield changed nodes with a few words."""
    if isinstance(node, ast.BinOp):
        yield from _of_operation(node.left, node.op, node.right)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield node.operand, "a sign"
    elif isinstance(node, ast.Attribute) and node.attr == "T":
        yield node.value, "not transposed"
        yield _expression("np.linalg.inv(A)", node.value), "inverted, not transposed"
    elif isinstance(node, ast.Call):
        yield from _of_call(node)
    elif isinstance(node, ast.Subscript):
        yield from _of_index(node)
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        yield from ((ast.Constant(node.value + step), "another number") for step in (1, -1))
        yield ast.Constant(0), "another number"
    elif isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.Lt | ast.Gt):
        other = ast.Gt() if isinstance(node.ops[0], ast.Lt) else ast.Lt()
        yield ast.Compare(node.left, [other], node.comparators), "a comparison"
        yield ast.Constant(True), "a condition is missing"
    elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load) and node.id[-1:] in "12":
        yield ast.Name(node.id[:-1] + "12"[node.id[-1] == "1"], ast.Load()), "another one of two"
    elif isinstance(node, ast.Tuple | ast.List) and isinstance(node.ctx, ast.Load) and len(node.elts) > 1:
        for k, one in enumerate(node.elts):
            for template, kind in OF_VALUES:
                changed = [*node.elts[:k], _expression(template, one), *node.elts[k + 1 :]]
                yield type(node)(changed, node.ctx), kind
        yield type(node)(node.elts[::-1], node.ctx), "another order"
    elif isinstance(node, ast.Return) and node.value is not None and not isinstance(node.value, ast.Tuple):
        for template, kind in (*OF_VALUES, *OF_RESULTS):
            yield ast.Return(_expression(template, node.value)), kind
    elif isinstance(node, ast.If):
        for always in (True, False):
            yield ast.If(ast.Constant(always), node.body, node.orelse), "a condition"
    elif isinstance(node, ast.AugAssign) or (isinstance(node, ast.Assign) and _replaces(node)):
        yield ast.Pass(), f"without the line `{ast.unparse(node)}`"


def _replaces(node):
    """Whether an assignment changes a variable that exists."""
    (target, *_) = node.targets
    if isinstance(target, ast.Subscript):
        return True
    read = {n.id for n in ast.walk(node.value) if isinstance(n, ast.Name)}
    written = {n.id for n in ast.walk(target) if isinstance(n, ast.Name)}
    return bool(written) and written <= read


def _of_operation(left, op, right):
    if isinstance(op, ast.Add | ast.Sub):
        yield ast.BinOp(left, ast.Sub() if isinstance(op, ast.Add) else ast.Add(), right), "a sign"
        yield left, "a term is missing"
        yield right, "a term is missing"
    if isinstance(op, ast.Mult | ast.Div):
        yield (
            ast.BinOp(left, ast.Div() if isinstance(op, ast.Mult) else ast.Mult(), right),
            "times or divided",
        )
        yield left, "a factor is missing"
        yield right, "a factor is missing"
    if isinstance(op, ast.Pow):
        yield left, "not squared"
    if isinstance(op, ast.MatMult):
        yield left, "a factor is missing"
        yield right, "a factor is missing"
        yield ast.BinOp(right, op, left), "factors in another order"
        if isinstance(left, ast.BinOp) and isinstance(left.op, ast.MatMult):
            yield left.right, "two factors are missing"
            for before, after in itertools.product(_other_forms(left.left), _other_forms(right)):
                chain = ast.BinOp(ast.BinOp(before, op, left.right), op, after)
                yield chain, "outer factors in another form"
        for template, kind in (("A.T", "transposed"), ("np.linalg.inv(A)", "inverted")):
            yield ast.BinOp(_expression(template, left), op, right), kind
            yield ast.BinOp(left, op, _expression(template, right)), kind


def _other_forms(node):
    """A factor transposed, inverted, or without what is done to it."""
    inner = node.value if getattr(node, "attr", "") == "T" else node
    if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "inv":
        inner = node.args[0]
    forms = [inner, _expression("A.T", inner), _expression("np.linalg.inv(A)", inner)]
    return [form for form in forms if ast.unparse(form) != ast.unparse(node)]


def _of_call(node):
    called = getattr(node.func, "attr", getattr(node.func, "id", ""))
    if called in ONE_ARGUMENT and node.args:
        yield node.args[0], f"without {called}"
    if called == "inv":
        yield _expression("A.T", node.args[0]), "transposed, not inverted"
    if called == "svd":
        yield ast.Call(node.func, [_expression("A.T", node.args[0])], node.keywords), "transposed"
    if called == "cross":
        yield _expression("A + B", *node.args), "a sum, not a cross product"
    if called == "rq":
        yield _expression("np.linalg.qr(A)[::-1]", *node.args), "QR, not RQ"
    if called == "transpose":
        yield node.func.value, "not transposed"
    if len(node.args) == 2:
        yield ast.Call(node.func, node.args[::-1], node.keywords), "arguments swapped"
    for k in range(len(node.keywords)):
        yield (
            ast.Call(node.func, node.args, node.keywords[:k] + node.keywords[k + 1 :]),
            "an option is missing",
        )


def _of_index(node):
    """Other indices and shifted slices, and the columns of U for the rows of V' of an SVD."""
    if isinstance(node.slice, ast.Slice):
        lower, upper = node.slice.lower, node.slice.upper
        if lower is None and isinstance(upper, ast.Constant):
            shifted = ast.Slice(ast.Constant(1), _expression("A + 1", upper))
            yield ast.Subscript(node.value, shifted, node.ctx), "shifted"
        if upper is None and isinstance(lower, ast.UnaryOp):
            shifted = ast.Slice(_expression("A - 1", lower), ast.Constant(-1))
            yield ast.Subscript(node.value, shifted, node.ctx), "shifted"
        return
    several = isinstance(node.slice, ast.Tuple)
    parts = node.slice.elts if several else [node.slice]
    for k, part in enumerate(parts):
        try:
            index = ast.literal_eval(part)
        except ValueError:
            continue
        if type(index) is not int:
            continue
        for other in dict.fromkeys((0, index - 1, index + 1, -1)):
            if k and ast.dump(parts[k - 1]) == ast.dump(part) and other != index:
                both = [*parts[: k - 1], ast.Constant(other), ast.Constant(other), *parts[k + 1 :]]
                yield ast.Subscript(node.value, ast.Tuple(both, ast.Load()), node.ctx), "other indices"
            changed = [*parts[:k], ast.Constant(other), *parts[k + 1 :]]
            place = ast.Tuple(changed, ast.Load()) if several else changed[0]
            if other != index:
                yield ast.Subscript(node.value, place, node.ctx), "another index"
        if not several:
            column = ast.Tuple([ast.Slice(), part], ast.Load())
            yield ast.Subscript(node.value, column, node.ctx), "a column, not a row"
