"""The package as a user gets it: built, installed into an empty environment, and used from an empty folder.

``build`` makes wheel and sdist in OUT/dist and checks them; the later steps use them. ``install`` puts the
wheel into an empty environment; ``imports``, ``typed``, ``quiet`` and ``demo`` use it from empty folders.
``lowest`` and ``newest`` run the quick suite with the lowest and newest versions of the dependencies. Each
environment is made once and keeps the output of pytest.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from thesisrecon.io._images import DEMO_IMAGES, demo_images
from thesisrecon.io._outputs import clear_folder
from validation.studies.package.built import build, check_built, find_built
from validation.studies.package.environments import (
    captured,
    dependencies,
    install,
    lowest_versions,
    make_environment,
    run_suite,
    suite_environment,
)
from validation.studies.package.installed import check_imports, trespasses, watch
from validation.studies.runner import Part, Rows, pick

FOCAL_WITHIN = 0.01
"""Relative bound of the focal error of the demo."""


class Checks:
    """All steps; each returns its faults."""

    def __init__(self, out: Path, python: str, pytest: list[str]) -> None:
        self.out, self.python, self.pytest = out, python, pytest
        self.interpreter = out / "environment" / "bin" / "python"

    def build(self) -> list[str]:
        """Build wheel and sdist and check what they hold."""
        return check_built(build(self.out))

    def install(self) -> list[str]:
        """Install the wheel into an empty environment."""
        clear_folder(self.out / "environment")
        make_environment(self.out / "environment", self.python)
        install(self.interpreter, str(find_built(self.out).wheel))
        return []

    def imports(self) -> list[str]:
        """Measure the import times of the installed package."""
        return check_imports(self.interpreter)

    def typed(self) -> list[str]:
        """Run mypy --strict over a client of the installed package."""
        checker = make_environment(self.out / "mypy")
        install(checker, "mypy")
        with tempfile.TemporaryDirectory() as empty:
            client = shutil.copy(Path(__file__).with_name("client.py"), empty)
            command = [checker, "-m", "mypy", "--strict", "--python-executable", self.interpreter, client]
            run = captured(command, empty)
        print(run.stdout.strip())
        return [] if run.returncode == 0 else [f"mypy: {run.stdout.strip()}"]

    def quiet(self) -> list[str]:
        """Check that a run writes only into its folder and the kernel cache, and makes no network call."""
        with tempfile.TemporaryDirectory() as place:
            images, result = Path(place) / "images", Path(place) / "result"
            images.mkdir()
            for path in demo_images()[:4]:
                shutil.copy(path, images)
            command = ["reconstruct", str(images), "-o", str(result), "--max-size", "480"]
            cache = self.out / "kernels"
            run = watch(str(self.interpreter), command, Path(place) / "watched", NUMBA_CACHE_DIR=str(cache))
            written = len(run.written)
            faults = trespasses(run, result, cache)
        print(f"{written} paths were written, {len(run.network)} calls of the network")
        return faults

    def demo(self) -> list[str]:
        """Run the installed demo from an empty folder and compare it with the truth in the wheel."""
        with tempfile.TemporaryDirectory() as empty:
            command = [self.interpreter.with_name("thesisrecon"), "demo"]
            run = captured(command, empty, HOME=empty, NUMBA_CACHE_DIR=str(self.out / "kernels"))
            if run.returncode != 0:
                return [f"the demo ended with code {run.returncode}: {run.stderr.strip()}"]
            return self._demo_faults(Path(empty) / "out" / "demo")

    def _demo_faults(self, out: Path) -> list[str]:
        summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        package = next((self.out / "environment").glob("lib/python*/site-packages/thesisrecon"))
        truth = json.loads((package / "courtyard" / "cameras.json").read_text(encoding="utf-8"))
        true = {camera["name"]: camera for camera in truth["cameras"]}
        print(json.dumps({k: summary[k] for k in ("registered", "points", "reprojection_rms_px", "seconds")}))
        faults = [
            f"{n} is missing" for n in ("model.glb", "report.html", "points.ply") if not (out / n).is_file()
        ]
        if summary["registered"] != DEMO_IMAGES:
            faults.append(f"{summary['registered']} of {DEMO_IMAGES} images have a camera")
        found = json.loads((out / "cameras.json").read_text(encoding="utf-8"))["cameras"]
        off = max(abs(c["K"][0][0] / true[c["name"]]["K"][0][0] - 1.0) for c in found)
        print(f"{len(found)} cameras, focal lengths within {100 * off:.2f} % of the truth")
        return faults + ([f"a focal length is off by {100 * off:.2f} %"] if off > FOCAL_WITHIN else [])

    def lowest(self) -> list[str]:
        """Run the quick suite with the lowest allowed versions of the dependencies."""
        return self._suite("lowest", lowest_versions(dependencies()))

    def newest(self) -> list[str]:
        """Run the quick suite with the newest versions of the dependencies."""
        return self._suite("newest", [])

    def _suite(self, name: str, constraints: list[str]) -> list[str]:
        place = suite_environment(self.out, name, self.python, constraints)
        return run_suite(place, self.pytest)


STEPS: dict[str, Callable[[Checks], list[str]]] = {
    "build": Checks.build,
    "install": Checks.install,
    "imports": Checks.imports,
    "typed": Checks.typed,
    "quiet": Checks.quiet,
    "demo": Checks.demo,
    "lowest": Checks.lowest,
    "newest": Checks.newest,
}


def package_study(
    out: Path, steps: Sequence[str] = ("build",), python: str = sys.executable, pytest: Sequence[str] = ()
) -> Iterator[Part]:
    """Build the package, install it into empty environments and use it from empty folders."""
    checks, rows = Checks(out, python, list(pytest)), Rows("package", "ours")
    for step in pick(steps, STEPS):
        found = STEPS[step](checks)
        yield f"{step}: {'; '.join(found) or 'no fault'}"
        rows.add(f"faults of {step}", len(found), at_most=0.0)
    yield rows
