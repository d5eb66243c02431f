"""Architecture rules, read from the source: imports, files and randomness, folders, exports and kernels.

Each test collects all offenders and names them in its message.
"""

import ast
import runpy
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "thesisrecon"
MODULES = sorted(PACKAGE.rglob("*.py"))
PAGE = runpy.run_path(str(ROOT / "scripts" / "make_architecture"))
tree_of = PAGE["tree_of"]
STAGES = {
    "features", "matching", "epipolar", "projective", "selfcalibration", "metric", "stereo", "surface",
    "views",
}  # fmt: skip
FOUNDATIONS = {
    "_code_digest",
    "_threads",
    "_numba",
    "arrays",
    "camera",
    "errors",
    "intrinsics",
    "records",
    "geometry",
    "imaging",
    "optimize",
}
COMPOSERS = {
    "__init__", "config", "api", "pipeline",
}  # fmt: skip
"""Only these may import several stages: they pass to a stage what it needs of another one."""
CORE = {"numpy", "scipy", "numba", "PIL", "trimesh", "jinja2", "plotly", "rich", "typer"}
OPTIONAL = {"runtime": {"dask", "distributed"}}
"""Optional dependencies, imported only on request."""
FILE_CALLS = {
    "open", "read_text", "read_bytes", "write_text", "write_bytes", "savez", "load", "mkdir", "unlink",
}  # fmt: skip
GLOBAL_RANDOMNESS = {
    "seed", "rand", "randn", "random", "randint", "choice", "shuffle", "permutation", "normal",
}  # fmt: skip
MAX_KERNEL_ARGUMENTS = 8


@cache
def imported_modules(path):
    """Return the full names of all imported modules; ``from a import b`` gives both a and a.b."""
    names = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names |= {"." * node.level + (node.module or "")}
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(names)


def parts_used(path):
    """Return the folders and top-level modules of the package that a file imports."""
    return {n.split(".")[1] for n in imported_modules(path) if n.startswith("thesisrecon.")}


def home(path):
    """Return the folder or top-level module of the package that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def modules_of(parts):
    return (path for path in MODULES if home(path) in parts)


def report(offenders):
    return [f"{path.relative_to(ROOT)}: {sorted(found)}" for path, found in offenders.items() if found]


def test_no_import_is_relative():
    assert report({p: {n for n in imported_modules(p) if n.startswith(".")} for p in MODULES}) == []


def test_the_package_imports_only_its_core_dependencies():
    allowed = set(sys.stdlib_module_names) | {"thesisrecon"} | CORE
    foreign = {p: {n.split(".")[0] for n in imported_modules(p)} - allowed for p in MODULES}
    assert report({p: names - OPTIONAL.get(home(p), set()) for p, names in foreign.items()}) == []


def test_few_internals_of_numba_are_used():
    # Each may change with a release: pyproject.toml has the range of versions that the tests ran with.
    used = {name for path in MODULES for name in imported_modules(path) if name.startswith("numba.core.")}
    modules = {name.rpartition(".")[0] for name in used}
    assert sorted(used - modules) == [
        "numba.core.compiler.CompileResult",
        "numba.core.compiler_lock.global_compiler_lock",
        "numba.core.registry.CPUDispatcher",
        "numba.core.serialize.dumps",
    ]


def test_a_stage_imports_only_foundations_and_itself():
    assert report({p: parts_used(p) - FOUNDATIONS - {home(p)} for p in modules_of(STAGES)}) == []


def test_foundations_import_only_foundations():
    used = {p: parts_used(p) - FOUNDATIONS for p in modules_of(FOUNDATIONS)}
    # _numba.py warns where machine code cannot be kept.
    barred = {p: {"random"} if home(p) == "_numba" else {"logging", "random"} for p in used}
    used |= {p: names | (barred[p] & imported_modules(p)) for p, names in used.items()}
    assert report(used) == []


def test_io_and_report_import_no_stage_and_no_composer():
    above = STAGES | COMPOSERS | {"cli"}
    assert report({p: parts_used(p) & above for p in modules_of({"io", "report"})}) == []


def test_only_composers_import_several_stages():
    used = {p: parts_used(p) & STAGES for p in MODULES if home(p) not in COMPOSERS}
    assert report({p: stages for p, stages in used.items() if len(stages) > 1}) == []


def test_mathematics_touches_no_file_and_no_global_randomness():
    found = {}
    # _numba.py keeps machine code on disk, and errors.py reads the texts of messages.
    for path in modules_of((FOUNDATIONS | STAGES) - {"errors", "_numba"}):
        called = {ast.unparse(node.func) for node in ast.walk(tree_of(path)) if isinstance(node, ast.Call)}
        found[path] = {name for name in called if name.split(".")[-1] in FILE_CALLS}
        found[path] |= {n for n in called if ".random." in n and n.split(".")[-1] in GLOBAL_RANDOMNESS}
    assert report(found) == []


def test_no_folder_is_nested_in_a_chapter():
    # Bundle adjustment is the one large subject of a folder.
    files = [p.relative_to(PACKAGE) for p in MODULES if p.parent != PACKAGE / "optimize" / "bundle"]
    assert [str(p) for p in files if len(p.parts) > 2] == []


def test_chapters_export_nothing():
    """A name is imported from the module that defines it; only ``thesisrecon`` itself exports names."""
    chapters = [p for p in MODULES if p.name == "__init__.py" and home(p) not in ("__init__", "config")]
    code = {p: {ast.unparse(node) for node in tree_of(p).body[1:]} for p in chapters}
    assert report(code) == []


def test_the_page_on_the_architecture_is_up_to_date():
    """``scripts/make_architecture`` writes it."""
    assert PAGE["PAGE"].read_text(encoding="utf-8") == PAGE["page"]()


def test_array_types_are_defined_once():
    found = {}
    for path in modules_of({home(p) for p in MODULES} - {"arrays"}):
        for node in tree_of(path).body:
            value = getattr(node, "value", None)
            if isinstance(value, ast.Subscript) and ast.unparse(value.value).endswith("NDArray"):
                found.setdefault(path, set()).add(ast.unparse(node))
    assert report(found) == []


class Kernel(NamedTuple):
    """A compiled function: its place, the names it calls, and how it is compiled."""

    place: str
    arguments: int
    calls: frozenset[str]
    reorders: bool
    inlined: bool


def is_named_call(node):
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name)


def kernels_in(tree, place):
    """Return all functions of a module under ``@kernel`` or ``@kernel(...)``, by name."""
    found = {}
    for node in tree.body:
        if not isinstance(node, ast.FunctionDef):
            continue
        for mark in node.decorator_list:
            name = mark.func if is_named_call(mark) else mark
            if isinstance(name, ast.Name) and name.id == "kernel":
                options = {option.arg for option in mark.keywords} if isinstance(mark, ast.Call) else set()
                calls = frozenset(call.func.id for call in ast.walk(node) if is_named_call(call))
                reorders, inlined = "fastmath" in options, "forceinline" in options
                count = len(node.args.posonlyargs + node.args.args + node.args.kwonlyargs)
                found[node.name] = Kernel(f"{place}:{node.name}", count, calls, reorders, inlined)
    return found


def not_inlined(kernels):
    """Return called functions that reorder sums, or inline one that does, and are not inlined themselves."""
    every = [kernel for named in kernels.values() for kernel in named]
    reordering = {name for name, named in kernels.items() if any(k.reorders for k in named)}
    while (
        more := {n for n, named in kernels.items() if any(k.calls & reordering for k in named)} - reordering
    ):
        reordering |= more
    called = {name for kernel in every for name in kernel.calls}
    return sorted(k.place for name in reordering & called for k in kernels[name] if not k.inlined)


@cache
def all_kernels():
    kernels = {}
    for path in MODULES:
        for name, kernel in kernels_in(tree_of(path), str(path.relative_to(PACKAGE))).items():
            kernels.setdefault(name, []).append(kernel)
    return kernels


def test_kernels_take_few_arguments():
    every = [kernel for named in all_kernels().values() for kernel in named]
    assert len(every) > 100
    assert [f"{k.place}: {k.arguments}" for k in every if k.arguments > MAX_KERNEL_ARGUMENTS] == []


def test_kernels_that_reorder_sums_are_inlined_into_their_callers():
    """A function with ``fastmath`` that several kernels link may be optimised differently in each copy.

    Which copy a process calls depends on the kernel that it loads first, so a run that compiles and one that
    reads the cache would differ in the last digits. An inlined function has no such copies.
    """
    assert sum(k.reorders for named in all_kernels().values() for k in named) > 10
    assert not_inlined(all_kernels()) == []


def test_the_inlining_rule_finds_offenders():
    source = """
@kernel(fastmath=True{0})
def total(a): ...

@kernel({1})
def between(a):
    return total(a)

@kernel
def outer(a):
    return between(a)
"""

    def offenders(first, second):
        found = kernels_in(ast.parse(source.format(first, second)), "a.py")
        return not_inlined({name: [kernel] for name, kernel in found.items()})

    inlined = "forceinline=True"
    assert offenders("", inlined) == ["a.py:total"]
    assert offenders(", " + inlined, "") == ["a.py:between"]
    assert offenders(", " + inlined, inlined) == []


HEAVY = {"numpy", "scipy", "numba", "PIL", "trimesh", "plotly", "jinja2", "rich", "typer"}
LATE = {
    "trimesh", "plotly", "jinja2", "rich", "scipy.stats", "scipy.optimize", "scipy.spatial", "scipy.linalg",
}  # fmt: skip


def test_imports_load_only_what_they_need():
    """Heavy modules are loaded by the calls that use them."""
    cases = [
        ("import thesisrecon; thesisrecon.__version__", HEAVY),
        (
            "from thesisrecon.cli.main import run_command as run; run(['--version']); run(['--help'])",
            HEAVY - {"typer", "rich"},
        ),
        ("import thesisrecon; thesisrecon.reconstruct; thesisrecon.match_pair", LATE),
    ]
    for code, unwanted in cases:
        program = f"import sys\n{code}\nprint(sorted({unwanted!r} & set(sys.modules)))"
        run = subprocess.run(
            [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
        )
        assert run.stdout.splitlines()[-1] == "[]", code
