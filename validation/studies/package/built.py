"""The wheel and the sdist: made, and what is in them."""

from __future__ import annotations

import hashlib
import re
import subprocess
import tarfile
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from thesisrecon.io.lists import COUNT
from validation.studies.package.environments import bare, install, make_environment
from validation.scenes.real import ROOT

MOST_BYTES = 3_000_000
"""Of the wheel."""
NEEDED = (
    "thesisrecon/py.typed",
    "thesisrecon/report/template.html.j2",
    "thesisrecon/report/strip.html.j2",
    "thesisrecon/report/style.css",
    "thesisrecon/report/page.js",
    "thesisrecon/report/strip.js",
    "thesisrecon/report/viewer.js",
    "thesisrecon/courtyard/cameras.json",
)
LAID_IN = re.compile(
    r"thesisrecon/(.*\.py|py\.typed|report/[a-z.]*\.(j2|js|css)|courtyard/(cameras\.json|images/\d{4}\.jpg))"
    r"|thesisrecon-[0-9.]*\.dist-info/.*"
)
"""All that may be in a wheel."""


@dataclass(frozen=True)
class Built:
    """What a build made: the wheel out of the sdist, the sdist, and the wheel straight from the tree."""

    wheel: Path
    sdist: Path
    direct: Path


def build(out: Path) -> Built:
    """Run ``python -m build`` in an environment that holds nothing else."""
    interpreter = make_environment(out / "build-environment")
    install(interpreter, "build")
    for folder, wishes in (("dist", []), ("direct", ["--wheel"])):
        command = [str(interpreter), "-m", "build", *wishes, "--outdir", str(out / folder), str(ROOT)]
        subprocess.run(command, check=True, env=bare(), stdout=subprocess.DEVNULL)
    return find_built(out)


def find_built(out: Path) -> Built:
    """What an earlier :func:`build` made there."""
    wheel, sdist = next((out / "dist").glob("*.whl")), next((out / "dist").glob("*.tar.gz"))
    return Built(wheel, sdist, next((out / "direct").glob("*.whl")))


def wheel_faults(names: Iterable[str], size: int) -> list[str]:
    """What is wrong with a wheel of these files and so many bytes."""
    held = set(names)
    faults = [f"{name} is missing" for name in NEEDED if name not in held]
    faults += [f"{name} does not belong there" for name in sorted(held) if not LAID_IN.fullmatch(name)]
    photographs = sum(name.endswith(".jpg") for name in held)
    if photographs != COUNT:
        faults.append(f"{photographs} photographs instead of {COUNT}")
    if size > MOST_BYTES:
        faults.append(f"{size / 1e6:.2f} MB, at most {MOST_BYTES / 1e6:.2f}")
    return faults


def content(wheel: Path) -> dict[str, str]:
    """The digest of every file of a wheel by its name."""
    with zipfile.ZipFile(wheel) as archive:
        return {name: hashlib.sha256(archive.read(name)).hexdigest() for name in archive.namelist()}


def check_built(built: Built) -> list[str]:
    """Faults of what was built; none where all is well."""
    held = content(built.wheel)
    faults = wheel_faults(held, built.wheel.stat().st_size)
    direct = content(built.direct)
    faults += [
        f"{name} differs between the wheel of the sdist and that of the tree"
        for name in sorted(held.keys() | direct.keys())
        if held.get(name) != direct.get(name)
    ]
    with tarfile.open(built.sdist) as archive:
        names = archive.getnames()
    print(
        f"wheel: {len(held)} files, {built.wheel.stat().st_size / 1e6:.2f} MB; "
        f"sdist: {len(names)} files, {built.sdist.stat().st_size / 1e6:.2f} MB"
    )
    return faults + [
        f"the sdist holds {n}" for n in names if "__pycache__" in n or n.endswith((".nbi", ".nbc"))
    ]
