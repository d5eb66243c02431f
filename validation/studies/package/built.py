"""The wheel and the sdist: how they are built, and what they hold."""

from __future__ import annotations

import hashlib
import re
import subprocess
import tarfile
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from thesisrecon.io._images import DEMO_IMAGES
from validation.scenes.real import ROOT
from validation.studies.package.environments import clean_environment, install, make_environment

MAX_BYTES = 3_000_000
"""Bound of the size of the wheel."""
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
ALLOWED = re.compile(
    r"thesisrecon/(.*\.py|py\.typed|report/[a-z.]*\.(j2|js|css)|courtyard/(cameras\.json|images/\d{4}\.jpg))"
    r"|thesisrecon-[0-9.]*\.dist-info/.*"
)
"""Files that a wheel may hold."""


@dataclass(frozen=True)
class Built:
    """The wheel from the sdist, the sdist, and the wheel built from the tree."""

    wheel: Path
    sdist: Path
    direct: Path


def build(out: Path) -> Built:
    interpreter = make_environment(out / "build-environment")
    install(interpreter, "build")
    for folder, flags in (("dist", []), ("direct", ["--wheel"])):
        command = [str(interpreter), "-m", "build", *flags, "--outdir", str(out / folder), str(ROOT)]
        subprocess.run(command, check=True, env=clean_environment(), stdout=subprocess.DEVNULL)
    return find_built(out)


def find_built(out: Path) -> Built:
    """Return the files of an earlier :func:`build`."""
    wheel, sdist = next((out / "dist").glob("*.whl")), next((out / "dist").glob("*.tar.gz"))
    return Built(wheel, sdist, next((out / "direct").glob("*.whl")))


def wheel_faults(names: Iterable[str], size: int) -> list[str]:
    """Return the faults of a wheel with these files and this size."""
    held = set(names)
    faults = [f"{name} is missing" for name in NEEDED if name not in held]
    faults += [f"{name} does not belong there" for name in sorted(held) if not ALLOWED.fullmatch(name)]
    images = sum(name.endswith(".jpg") for name in held)
    if images != DEMO_IMAGES:
        faults.append(f"{images} images instead of {DEMO_IMAGES}")
    if size > MAX_BYTES:
        faults.append(f"{size / 1e6:.2f} MB, at most {MAX_BYTES / 1e6:.2f}")
    return faults


def content(wheel: Path) -> dict[str, str]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: hashlib.sha256(archive.read(name)).hexdigest() for name in archive.namelist()}


def check_built(built: Built) -> list[str]:
    """Return the faults of the built files."""
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
