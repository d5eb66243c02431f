"""The readers of COLMAP's binary files beside made-up ones: ``python -m validation.studies.fuzz_colmap``.

Inputs are the three files of a model in one; the reader may make a model of them that is consistent, or
refuse them with :class:`StageFailure`. Whatever else it does (another error, a warning of NumPy's, more than
``--memory`` MB, more than ten seconds for one input) is a finding. With atheris (``pip install atheris``) new
inputs are led by what the reader's code did with the ones before, and those that went new ways are kept in
``--corpus``; without it, good files are changed at random. The exit code is 1 where something was found.
"""

from __future__ import annotations

import argparse
import importlib.util
import re
import resource
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thesisrecon.errors import StageFailure
from thesisrecon.io.colmap import reconstruction_from_colmap
from thesisrecon.io.colmap_binary import ENCODERS, read_cameras, read_images, read_points
from thesisrecon.io.colmap_model import (
    MODEL_NUMBERS,
    NO_POINT,
    PARAMETER_COUNTS,
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    inconsistency,
)

LENGTHS = struct.Struct("<HH")
"""Before the files of an input: bytes of the cameras and of the images; the rest are points."""
LARGEST_INPUT = 4096
GUIDED = """
import sys, warnings
import atheris
with atheris.instrument_imports(include=["thesisrecon.io", "thesisrecon.geometry.camera_matrix"]):
    from validation.studies.fuzz_colmap import read_input
warnings.simplefilter("error")
atheris.Setup(sys.argv, read_input)
atheris.Fuzz()
"""
"""A program of its own: libFuzzer ends its process."""


@dataclass(frozen=True)
class Findings:
    """How many inputs were read, how many were kept as new (with their branches, 0 = nobody counted), and
    what was found (empty: nothing)."""

    how: str
    inputs: int
    kept: int
    branches: int
    found: str


def small_model(views: int, points: int, *, kind: str = "SIMPLE_RADIAL", name: str = "{}.jpg") -> ColmapModel:
    """Every view sees every point, and one more place that is no point."""
    ids = np.arange(points, dtype=np.int64) + 1
    params = (600.0, *(50.0 if k < 3 else 0.0 for k in range(1, PARAMETER_COUNTS[kind])))
    xy = np.column_stack([np.arange(points + 1.0), np.arange(points + 1.0) + 0.25])
    owners = np.append(ids, NO_POINT)
    images = tuple(
        ColmapImage(k + 1, np.array([1.0, 0, 0, 0]), np.array([k, 0, 4.0]), 1, name.format(k), xy, owners)
        for k in range(views)
    )
    cloud = ColmapPoints(
        ids=ids,
        xyz=np.column_stack([np.sin(ids), np.cos(ids), 0.1 * ids]),
        rgb=np.full((points, 3), 128, dtype=np.uint8),
        error=np.full(points, 0.5),
        track_start=np.arange(points + 1, dtype=np.int64) * views,
        track_image=np.tile(np.arange(views, dtype=np.int64) + 1, points),
        track_xy=np.repeat(np.arange(points, dtype=np.int64), views),
    )
    return ColmapModel((ColmapCamera(1, kind, 100, 100, params),), images, cloud)


def input_of(model: ColmapModel) -> bytes:
    """The three files in one."""
    cameras, images, points = (ENCODERS[name](model) for name in ("cameras", "images", "points3D"))
    return LENGTHS.pack(len(cameras), len(images)) + cameras + images + points


def corpus() -> list[bytes]:
    """Good inputs of our own writer: every camera model, no views, no points, names of many letters."""
    models = [small_model(1, 1, kind=kind) for kind in MODEL_NUMBERS]
    models += [small_model(0, 0), small_model(2, 0), small_model(2, 3), small_model(4, 8)]
    models += [small_model(1, 2, name="größe 写真 \udcff{}.jpg"), small_model(1, 1, name="x" * 300)]
    return [input_of(model) for model in models]


def read_input(data: bytes) -> None:
    """Read the files of an input, be they a model or refused; raises a finding."""
    first, second = LENGTHS.unpack_from(data.ljust(LENGTHS.size, b"\0"))
    rest = data[LENGTHS.size :]
    try:
        model = ColmapModel(
            read_cameras(rest[:first], Path("cameras.bin")),
            read_images(rest[first : first + second], Path("images.bin")),
            read_points(rest[first + second :], Path("points3D.bin")),
        )
        if not inconsistency(model):
            reconstruction_from_colmap(model)
    except StageFailure:
        return


def changed(rng: np.random.Generator, whole: bytes) -> bytes:
    """An input with up to eight of its bytes, numbers or stretches changed."""
    data = bytearray(whole)
    for _ in range(int(rng.integers(1, 9))):
        at, size = int(rng.integers(0, len(data) + 1)), int(rng.integers(1, 17))
        number = struct.pack("<d", float(rng.choice(ODD)))
        what = (rng.bytes(size), rng.bytes(1), b"\xff" * 8, b"\0" * 8, number)[int(rng.integers(0, 5))]
        end = (at, at + len(what), at + size)[int(rng.integers(0, 3))]
        data[at:end] = what
    return bytes(data[:LARGEST_INPUT])


ODD = (np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, 0.0, -1.0)


def fuzz_at_random(seconds: float, seed: int) -> Findings:
    """Good inputs changed at random, for so many seconds or until one is a finding."""
    good, rng, count = corpus(), np.random.default_rng(seed), 0
    end = time.monotonic() + seconds
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        while time.monotonic() < end:
            data = changed(rng, good[int(rng.integers(0, len(good)))])
            count += 1
            try:
                read_input(data)
            except Exception:
                return Findings("at random", count, 0, 0, f"{traceback.format_exc()}\n{data!r}")
    return Findings("at random", count, 0, 0, "")


def fuzz_guided(seconds: int, seed: int, folder: Path, memory_mb: int) -> Findings:
    """Inputs led by the branches that those before them took, by atheris; those of ``folder`` go first."""
    folder.mkdir(parents=True, exist_ok=True)
    for n, data in enumerate(corpus()):
        (folder / f"good-{n:02d}").write_bytes(data)
    wishes = [f"-max_total_time={seconds}", f"-max_len={LARGEST_INPUT}", f"-seed={seed + 1}", "-timeout=10"]
    wishes += [f"-rss_limit_mb={memory_mb}", f"-artifact_prefix={folder}.found-", "-print_final_stats=1"]
    program = [sys.executable, "-c", GUIDED, str(folder), *wishes]
    done = subprocess.run(program, capture_output=True, text=True, errors="replace", check=False)
    told = done.stderr
    branches = [int(n) for n in re.findall(r"cov: (\d+)", told)]
    inputs = [int(n) for n in re.findall(r"^#(\d+)", told, flags=re.MULTILINE)]
    kept = sum(1 for path in folder.iterdir() if not path.name.startswith("good-"))
    found = "" if done.returncode == 0 else f"{done.stdout[-4000:]}\n{told[-4000:]}"
    return Findings("guided by atheris", max(inputs, default=0), kept, max(branches, default=0), found)


def main(arguments: list[str] | None = None) -> int:
    """1 where an input was a finding."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--memory", type=int, default=1024, help="MB that the reader's process may take")
    parser.add_argument(
        "--corpus", type=Path, help="a folder whose inputs are gone on with (made where absent)"
    )
    parser.add_argument("--plain", action="store_true", help="without atheris, though it is there")
    told = parser.parse_args(arguments)
    if told.plain or importlib.util.find_spec("atheris") is None:
        findings = fuzz_at_random(told.seconds, told.seed)
    else:
        with tempfile.TemporaryDirectory() as place:
            folder = told.corpus or Path(place) / "corpus"
            findings = fuzz_guided(told.seconds, told.seed, folder, told.memory)
    own = resource.RUSAGE_SELF if findings.branches == 0 else resource.RUSAGE_CHILDREN
    peak_mb = resource.getrusage(own).ru_maxrss / 2**10
    print(
        f"{findings.how}: {findings.inputs} inputs in {told.seconds} s, {findings.branches} branches, "
        f"{len(corpus())} good inputs and {findings.kept} kept, peak {peak_mb:.0f} MB, "
        f"{'nothing' if not findings.found else 'something'} found"
    )
    print(findings.found, end="")
    return int(bool(findings.found))


if __name__ == "__main__":
    raise SystemExit(main())
