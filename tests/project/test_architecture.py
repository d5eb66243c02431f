"""Architecture rules beside the layers in pyproject.toml: files and randomness, exports, kernels.

Each test collects all offenders and names them in its message.
"""

import ast
import runpy
import subprocess
import sys
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "thesisrecon"
MODULES = sorted(PACKAGE.rglob("*.py"))
PAGE = runpy.run_path(str(ROOT / "scripts" / "make_architecture"))
tree_of = PAGE["tree_of"]
CHAPTERS = {
    "geometry", "imaging", "optimize", "features", "matching", "epipolar", "projective", "selfcalibration",
    "metric", "stereo", "surface", "views",
}  # fmt: skip
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
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(names)


def home(path):
    """Return the folder or top-level module of the package that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def report(offenders):
    return [f"{path.relative_to(ROOT)}: {sorted(found)}" for path, found in offenders.items() if found]


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


def test_mathematics_touches_no_file_and_no_global_randomness():
    found = {}
    for path in (path for path in MODULES if home(path) in CHAPTERS | {"arrays", "camera", "records"}):
        called = {ast.unparse(node.func) for node in ast.walk(tree_of(path)) if isinstance(node, ast.Call)}
        found[path] = {name for name in called if name.split(".")[-1] in FILE_CALLS}
        found[path] |= {n for n in called if ".random." in n and n.split(".")[-1] in GLOBAL_RANDOMNESS}
    assert report(found) == []


def test_chapters_export_nothing():
    """A name is imported from the module that defines it; only ``thesisrecon`` itself exports names."""
    chapters = [p for p in MODULES if p.name == "__init__.py" and home(p) in CHAPTERS]
    code = {p: {ast.unparse(node) for node in tree_of(p).body[1:]} for p in chapters}
    assert report(code) == []


def test_the_page_on_the_architecture_is_up_to_date():
    """``scripts/make_architecture`` writes it."""
    assert PAGE["PAGE"].read_text(encoding="utf-8") == PAGE["page"]()


@cache
def kernels():
    """All functions under ``@kernel`` or ``@kernel(...)``: place, definition and options."""
    found = []
    for path in MODULES:
        for node in tree_of(path).body:
            for mark in getattr(node, "decorator_list", ()):
                name = mark.func if isinstance(mark, ast.Call) else mark
                if isinstance(name, ast.Name) and name.id == "kernel":
                    options = {option.arg for option in getattr(mark, "keywords", ())}
                    found.append((f"{path.relative_to(PACKAGE)}:{node.name}", node, options))
    return found


def calls(node):
    return {ast.unparse(call.func) for call in ast.walk(node) if isinstance(call, ast.Call)}


def test_kernels_take_few_arguments():
    assert len(kernels()) > 100
    given = {
        place: [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        for place, node, _ in kernels()
    }
    assert [place for place, arguments in given.items() if len(arguments) > MAX_KERNEL_ARGUMENTS] == []


def test_kernels_that_reorder_sums_are_inlined_into_their_callers():
    """A function with ``fastmath`` that several kernels link may be optimised differently in each copy.

    Which copy a process calls depends on the kernel that it loads first, so a run that compiles and one that
    reads the cache would differ in the last digits. An inlined function has no such copies.
    """
    reordering = {node.name for _, node, options in kernels() if "fastmath" in options}
    assert len(reordering) > 10
    while more := {node.name for _, node, _ in kernels() if calls(node) & reordering} - reordering:
        reordering |= more
    called = {name for _, node, _ in kernels() for name in calls(node)}
    linked = [
        place for place, node, options in kernels()
        if node.name in reordering & called and "forceinline" not in options
    ]  # fmt: skip
    assert linked == []


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
