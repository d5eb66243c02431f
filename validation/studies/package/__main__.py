"""The package as somebody gets it: ``python -m validation.studies.package STEP... -o OUT [-- PYTEST...]``.

``build`` makes wheel and sdist in OUT/dist and looks into them; the steps after it take what it made.
``install`` puts the wheel into an empty environment; ``imports``, ``typed``, ``quiet`` and ``demo`` use it
from empty folders. ``lowest`` and ``newest`` run the quick suite with the lowest and newest versions of the
dependencies that pyproject.toml allows, part by part; what follows ``--`` goes to pytest in place of it.
``--python`` is the interpreter of the new environments, each of which is made once and keeps what pytest said
of each part in ``logs/``. The exit code is 1 where something is wrong.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from thesisrecon.io.lists import COUNT, demo_photographs
from validation.studies.package.built import build, check_built, find_built
from validation.studies.package.environments import (
    bare,
    dependencies,
    install,
    lowest_versions,
    make_environment,
)
from validation.studies.package.imports import check_imports
from validation.studies.package.quiet import trespasses, watch
from validation.studies.package.suite import quick_parts, run_part, suite_environment, suite_faults

FOCAL_WITHIN = 0.01
"""Of the truth: the demo calibrates itself."""


class Checks:
    """Every step by its name; each returns what is wrong."""

    def __init__(self, out: Path, python: str, pytest: list[str]) -> None:
        self.out, self.python, self.pytest = out, python, pytest
        self.interpreter = out / "environment" / "bin" / "python"

    def build(self) -> list[str]:
        """Wheel and sdist, and what is in them."""
        return check_built(build(self.out))

    def install(self) -> list[str]:
        """The wheel into an empty environment."""
        shutil.rmtree(self.out / "environment", ignore_errors=True)
        make_environment(self.out / "environment", self.python)
        install(self.interpreter, str(find_built(self.out).wheel))
        return []

    def imports(self) -> list[str]:
        """What importing the installed package costs."""
        return check_imports(self.interpreter)

    def typed(self) -> list[str]:
        """mypy --strict over a client of the installed package."""
        checker = make_environment(self.out / "mypy")
        install(checker, "mypy")
        with tempfile.TemporaryDirectory() as empty:
            client = shutil.copy(Path(__file__).with_name("client.py"), empty)
            command = [checker, "-m", "mypy", "--strict", "--python-executable", self.interpreter, client]
            run = subprocess.run(
                [str(word) for word in command],
                cwd=empty,
                env=bare(),
                capture_output=True,
                text=True,
                check=False,
            )
        print(run.stdout.strip())
        return [] if run.returncode == 0 else [f"mypy: {run.stdout.strip()}"]

    def quiet(self) -> list[str]:
        """A run writes into its folder and the cache of the kernels alone, and speaks to nobody."""
        with tempfile.TemporaryDirectory() as place:
            photographs, result = Path(place) / "photographs", Path(place) / "result"
            photographs.mkdir()
            for path in demo_photographs()[:4]:
                shutil.copy(path, photographs)
            command = ["reconstruct", str(photographs), "-o", str(result), "--max-size", "480"]
            cache = self.out / "kernels"
            run = watch(str(self.interpreter), command, Path(place) / "watched", NUMBA_CACHE_DIR=str(cache))
            written = len(run.written)
            faults = trespasses(run, result, cache)
        print(f"{written} paths were written, {len(run.network)} calls of the network")
        return faults

    def demo(self) -> list[str]:
        """The installed demo from an empty folder, against the truth that the wheel carries."""
        with tempfile.TemporaryDirectory() as empty:
            command = [str(self.interpreter.with_name("thesisrecon")), "demo"]
            environment = bare(HOME=empty, NUMBA_CACHE_DIR=str(self.out / "kernels"))
            run = subprocess.run(
                command, cwd=empty, env=environment, capture_output=True, text=True, check=False
            )
            if run.returncode != 0:
                return [f"the demo ended with code {run.returncode}: {run.stderr.strip()}"]
            return self._demo_faults(Path(empty) / "out" / "demo")

    def _demo_faults(self, out: Path) -> list[str]:
        summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        package = next((self.out / "environment").glob("lib/python*/site-packages/thesisrecon"))
        truth = json.loads((package / "courtyard" / "cameras.json").read_text(encoding="utf-8"))
        print(json.dumps({k: summary[k] for k in ("registered", "points", "reprojection_rms_px", "seconds")}))
        faults = [
            f"{n} is missing" for n in ("model.glb", "report.html", "points.ply") if not (out / n).is_file()
        ]
        if summary["registered"] != COUNT:
            faults.append(f"{summary['registered']} of {COUNT} photographs have a camera")
        found = json.loads((out / "cameras.json").read_text(encoding="utf-8"))["cameras"]
        off = max(abs(c["K"][0][0] / truth["cameras"][c["name"]]["K"][0][0] - 1.0) for c in found)
        print(f"{len(found)} cameras, focal lengths within {100 * off:.2f} % of the truth")
        return faults + ([f"a focal length is off by {100 * off:.2f} %"] if off > FOCAL_WITHIN else [])

    def lowest(self) -> list[str]:
        """The quick suite with the lowest versions that are allowed."""
        return self._suite("lowest", lowest_versions(dependencies()))

    def newest(self) -> list[str]:
        """The quick suite with the newest versions there are."""
        return self._suite("newest", [])

    def _suite(self, name: str, constraints: list[str]) -> list[str]:
        place = suite_environment(self.out, name, self.python, constraints)
        parts = {" ".join(self.pytest): self.pytest} if self.pytest else quick_parts()
        return suite_faults([run_part(place, part, words) for part, words in parts.items()])


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


def main(arguments: list[str] | None = None) -> int:
    """Take the steps, print what is wrong."""
    given = sys.argv[1:] if arguments is None else arguments
    at = given.index("--") if "--" in given else len(given)
    parser = argparse.ArgumentParser(prog="python -m validation.studies.package", description=__doc__)
    parser.add_argument("steps", nargs="+", choices=STEPS)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--python", default=sys.executable)
    wishes = parser.parse_args(given[:at])
    out = wishes.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    checks, faults = Checks(out, wishes.python, given[at + 1 :]), []
    for step in wishes.steps:
        found = STEPS[step](checks)
        print(f"{step}: {'well' if not found else '; '.join(found)}", flush=True)
        faults += found
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
