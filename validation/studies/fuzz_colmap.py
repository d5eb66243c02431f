"""Fuzzing of the readers of COLMAP's binary files.

An input holds the three files of a model. The reader may return a consistent model or refuse with
:class:`StageFailure`. Any other error, a NumPy warning, more than ``--memory`` MB or more than ten seconds
for one input is a finding. With atheris (``pip install atheris``) the branches that earlier inputs reached
guide new ones, which are kept in ``--corpus``; without it, valid files are changed at random.
"""

from __future__ import annotations

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
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from thesisrecon.io.colmap_model import (
    NO_POINT,
    PARAMETER_COUNTS,
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    decode_model,
    encode_model,
    inconsistency,
)

from thesisrecon.errors import StageFailure
from thesisrecon.io.colmap import reconstruction_from_colmap
from validation.studies.runner import Part, Rows

LENGTHS = struct.Struct("<HH")
"""Header of an input: bytes of the cameras and of the images; the rest are points."""
MAX_INPUT = 4096
GUIDED = """
import sys, warnings
import atheris
with atheris.instrument_imports(include=["thesisrecon.io", "thesisrecon.geometry.camera_matrix"]):
    from validation.studies.fuzz_colmap import read_input
warnings.simplefilter("error")
atheris.Setup(sys.argv, read_input)
atheris.Fuzz()
"""
"""Program of its own, because libFuzzer ends its process."""


@dataclass(frozen=True)
class Findings:
    """Result of one run.

    ``how``: random or guided; ``inputs``, ``kept``: inputs that were read, and new inputs that were kept;
    ``branches``: branches of the reader that were reached; 0 if not counted; ``found``: traceback and input
    of a finding; empty if there is none.
    """

    how: str
    inputs: int
    kept: int
    branches: int
    found: str


def small_model(views: int, points: int, *, kind: str = "SIMPLE_RADIAL", name: str = "{}.jpg") -> ColmapModel:
    """Make a model in which every view sees every point and one feature without a point."""
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
    files = encode_model(model)
    cameras, images, points = (files[name] for name in ("cameras", "images", "points3D"))
    return LENGTHS.pack(len(cameras), len(images)) + cameras + images + points


def valid_inputs() -> list[bytes]:
    """Return valid inputs: every camera model, no views, no points, long and non-ASCII names."""
    models = [small_model(1, 1, kind=kind) for kind in PARAMETER_COUNTS]
    models += [small_model(0, 0), small_model(2, 0), small_model(2, 3), small_model(4, 8)]
    models += [small_model(1, 2, name="größe 写真 \udcff{}.jpg"), small_model(1, 1, name="x" * 300)]
    return [input_of(model) for model in models]


def read_input(data: bytes) -> None:
    """Read the files of one input; any exception but ``StageFailure`` is a finding."""
    first, second = LENGTHS.unpack_from(data.ljust(LENGTHS.size, b"\0"))
    rest = data[LENGTHS.size :]
    try:
        parts = (rest[:first], rest[first : first + second], rest[first + second :])
        names = (Path("cameras.bin"), Path("images.bin"), Path("points3D.bin"))
        model = decode_model(dict(zip(names, parts, strict=True)))
        if not inconsistency(model):
            reconstruction_from_colmap(model)
    except StageFailure:
        return


def changed(rng: np.random.Generator, whole: bytes) -> bytes:
    """Change up to eight bytes, numbers or stretches of an input."""
    data = bytearray(whole)
    for _ in range(int(rng.integers(1, 9))):
        at, size = int(rng.integers(0, len(data) + 1)), int(rng.integers(1, 17))
        number = struct.pack("<d", float(rng.choice(ODD)))
        piece = (rng.bytes(size), rng.bytes(1), b"\xff" * 8, b"\0" * 8, number)[int(rng.integers(0, 5))]
        end = (at, at + len(piece), at + size)[int(rng.integers(0, 3))]
        data[at:end] = piece
    return bytes(data[:MAX_INPUT])


ODD = (np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, 0.0, -1.0)


def fuzz_at_random(seconds: float, seed: int) -> Findings:
    """Change valid inputs at random, until the time is over or there is a finding."""
    good, rng, count = valid_inputs(), np.random.default_rng(seed), 0
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
    """Let atheris choose inputs by the branches that earlier ones reached; ``folder`` keeps them."""
    folder.mkdir(parents=True, exist_ok=True)
    for n, data in enumerate(valid_inputs()):
        (folder / f"good-{n:02d}").write_bytes(data)
    flags = [f"-max_total_time={seconds}", f"-max_len={MAX_INPUT}", f"-seed={seed + 1}", "-timeout=10"]
    flags += [f"-rss_limit_mb={memory_mb}", f"-artifact_prefix={folder}.found-", "-print_final_stats=1"]
    program = [sys.executable, "-c", GUIDED, str(folder), *flags]
    done = subprocess.run(program, capture_output=True, text=True, errors="replace", check=False)
    said = done.stderr
    branches = [int(n) for n in re.findall(r"cov: (\d+)", said)]
    inputs = [int(n) for n in re.findall(r"^#(\d+)", said, flags=re.MULTILINE)]
    kept = sum(1 for path in folder.iterdir() if not path.name.startswith("good-"))
    found = "" if done.returncode == 0 else f"{done.stdout[-4000:]}\n{said[-4000:]}"
    return Findings("guided by atheris", max(inputs, default=0), kept, max(branches, default=0), found)


def fuzz_colmap_study(
    seconds: int = 600, seed: int = 0, memory: int = 1024, corpus: Path | None = None, plain: bool = False
) -> Iterator[Part]:
    """Fuzz the reader of COLMAP's binary files."""
    if plain or importlib.util.find_spec("atheris") is None:
        findings = fuzz_at_random(seconds, seed)
    else:
        with tempfile.TemporaryDirectory() as place:
            findings = fuzz_guided(seconds, seed, corpus or Path(place) / "corpus", memory)
    usage = resource.RUSAGE_SELF if findings.branches == 0 else resource.RUSAGE_CHILDREN
    peak_mb = resource.getrusage(usage).ru_maxrss / 2**10
    yield (
        f"{findings.how}: {findings.inputs} inputs in {seconds} s, {findings.branches} branches, "
        f"{len(valid_inputs())} valid inputs and {findings.kept} kept, peak {peak_mb:.0f} MB, "
        f"{'something' if findings.found else 'nothing'} found"
    )
    yield findings.found
    rows = Rows("fuzzing", "ours")
    rows.add("findings", bool(findings.found), at_most=0.0)
    yield rows
