"""Architecture rules beside the layers in pyproject.toml: dependencies, exports, kernels."""

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
OPTIONAL = {"thesisrecon": {"matplotlib"}, "runtime": {"dask", "distributed"}, "testing": {"pytest"}}
"""Optional dependencies by folder, imported only on request."""


def test_the_package_imports_only_its_core_and_mathematics_touches_no_file():
    allowed = {*sys.stdlib_module_names, "thesisrecon", *CORE}
    for path in MODULES:
        nodes = [*ast.walk(tree_of(path))]
        names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
        names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
        optional = OPTIONAL.get(path.parent.name, set())
        assert {name.split(".")[0] for name in names} <= allowed | optional, path
    # A name is imported from the module that defines it; only ``thesisrecon`` itself exports names.
    code = {path: tree_of(path).body[1:] for name in CHAPTERS for path in PACKAGE.glob(f"{name}/__init__.py")}
    assert [path for path, body in code.items() if body] == []
    # Global randomness is refused by ruff, logging by ``lint-imports``.
    files = {"open", "load", "savez", "mkdir", "unlink", "read_text", "read_bytes"}
    files |= {"write_text", "write_bytes"}
    for path in (path for name in CHAPTERS for path in (PACKAGE / name).rglob("*.py")):
        assert not {name.split(".")[-1] for name in calls(tree_of(path))} & files, path


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
    given = {place: node.args for place, node, _ in kernels()}
    assert [place for place, a in given.items() if len([*a.posonlyargs, *a.args, *a.kwonlyargs]) > 8] == []


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
            "from thesisrecon.cli.commands import run_command as run; run(['--version']); run(['--help'])",
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
