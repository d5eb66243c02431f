"""The rules of direction: who may import whom, read from the source itself."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "thesisrecon"
STAGES = {
    "features",
    "matching",
    "epipolar",
    "projective",
    "selfcalibration",
    "metric",
    "stereo",
    "surface",
    "views",
}
COMMON = {"arrays", "camera", "errors", "records", "geometry", "numerics"}
COMPOSERS = {"__init__", "config", "api", "pipeline", "view_interpolation", "view_synthesis"}
"""What may import several stages: each stage is given by these what it needs of another."""
REFERENCES = {"cv2", "pycolmap", "open3d", "poselib", "validation"}
CORE = {"numpy", "scipy", "numba", "PIL", "trimesh", "jinja2", "plotly", "rich", "typer"}
OPTIONAL = {"runtime": {"dask", "distributed"}}
"""What a module may import besides, when it is asked for."""
FILE_CALLS = {
    "open",
    "read_text",
    "read_bytes",
    "write_text",
    "write_bytes",
    "savez",
    "load",
    "mkdir",
    "unlink",
}
GLOBAL_RANDOMNESS = {
    "seed",
    "rand",
    "randn",
    "random",
    "randint",
    "choice",
    "shuffle",
    "permutation",
    "normal",
}
MODULES = sorted(PACKAGE.rglob("*.py"))


def imported_modules(path: Path) -> set[str]:
    """All modules a file imports, by full name; ``from a import b`` gives both a and a.b."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            assert node.module is not None
            names.add(node.module)
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return names


def part_of(name: str) -> str | None:
    """The part of the package a full module name lies in, None for other packages and the package itself."""
    parts = name.split(".")
    return parts[1] if parts[0] == "thesisrecon" and len(parts) > 1 else None


def home(path: Path) -> str:
    """The folder or module of the package a file lies in."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def ids(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", MODULES, ids=ids)
def test_the_package_imports_only_its_core_dependencies(path: Path) -> None:
    roots = {name.split(".")[0] for name in imported_modules(path)}
    assert not roots & REFERENCES
    foreign = roots - set(sys.stdlib_module_names) - {"thesisrecon"} - CORE
    assert not foreign - OPTIONAL.get(home(path), set())


@pytest.mark.parametrize("path", [p for p in MODULES if home(p) in STAGES], ids=ids)
def test_a_stage_imports_no_other_stage(path: Path) -> None:
    used = {part for name in imported_modules(path) if (part := part_of(name)) is not None}
    assert used <= COMMON | {home(path)}


@pytest.mark.parametrize("path", [p for p in MODULES if home(p) in COMMON], ids=ids)
def test_the_foundations_import_only_foundations(path: Path) -> None:
    used = {part for name in imported_modules(path) if (part := part_of(name)) is not None}
    assert used <= COMMON
    assert not {"logging", "random"} & imported_modules(path)


@pytest.mark.parametrize("path", [p for p in MODULES if home(p) in {"io", "report"}], ids=ids)
def test_io_and_report_import_no_stage(path: Path) -> None:
    used = {part for name in imported_modules(path) if (part := part_of(name)) is not None}
    assert not used & (STAGES | COMPOSERS | {"cli"})


@pytest.mark.parametrize("path", MODULES, ids=ids)
def test_only_the_composer_knows_several_stages(path: Path) -> None:
    used = {part for name in imported_modules(path) if (part := part_of(name)) is not None} & STAGES
    assert len(used) <= 1 or home(path) in COMPOSERS


@pytest.mark.parametrize("path", [p for p in MODULES if home(p) in COMMON | STAGES], ids=ids)
def test_mathematics_touches_no_file_and_no_global_randomness(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        assert called.split(".")[-1] not in FILE_CALLS, f"{called} touches a file"
        if ".random." in called:
            assert called.split(".")[-1] not in GLOBAL_RANDOMNESS, f"{called} is global randomness"


HEAVY = {"numpy", "scipy", "numba", "PIL", "trimesh", "plotly", "jinja2", "rich", "typer"}
LATE = {
    "trimesh",
    "plotly",
    "jinja2",
    "rich",
    "scipy.stats",
    "scipy.optimize",
    "scipy.spatial",
    "scipy.linalg",
}


def loaded_by(code: str, names: set[str]) -> str:
    """Which of the modules a new interpreter has loaded after ``code``."""
    program = f"import sys\n{code}\nprint(sorted({names!r} & set(sys.modules)))"
    run = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return run.stdout.splitlines()[-1]


def test_importing_the_package_loads_nothing_heavy() -> None:
    assert loaded_by("import thesisrecon; thesisrecon.__version__", HEAVY) == "[]"


def test_the_version_and_the_help_load_only_what_parses_the_command() -> None:
    code = "from thesisrecon.cli.main import run_command; run_command(['--version']); run_command(['--help'])"
    assert loaded_by(code, HEAVY - {"typer", "rich"}) == "[]"


def test_a_front_door_loads_what_only_a_run_needs_when_a_run_needs_it() -> None:
    assert loaded_by("import thesisrecon; thesisrecon.reconstruct; thesisrecon.match_pair", LATE) == "[]"
