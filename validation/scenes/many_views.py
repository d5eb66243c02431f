"""Arbitrarily many rendered images of the courtyard.

They are rendered, not cropped: images with a common centre would have no parallax and another cost. The first
n of a longer set are the set of n, spread over the same arc.
"""

from __future__ import annotations

import io
import re
import tempfile
from dataclasses import replace
from math import cos, pi, sin, tan
from pathlib import Path

import numpy as np

from thesisrecon.arrays import F32
from thesisrecon.io._files import write_atomically, write_json
from validation.scenes.courtyard import build_courtyard, build_yard
from validation.scenes.pose import Pose, look_at
from validation.scenes.raycast import trace
from validation.scenes.real import Scene, read_scene, write_png
from validation.scenes.sensor import take_image, write_images

FOCAL_REL = 0.9
"""Focal length as a share of the long side."""


def walk(count: int, size: tuple[int, int], *, seed: int = 0) -> list[Pose]:
    """``count`` true cameras about the yard, of one calibration, for images of ``size`` (width, height)."""
    width, height = size
    focal = FOCAL_REL * max(size)
    K = np.array([[focal, 0.0, 0.51 * width], [0.0, focal, 0.48 * height], [0.0, 0.0, 1.0]])
    poses = []
    for k in range(count):
        rng = np.random.Generator(np.random.PCG64([seed, k]))
        angle = (2.0 * _van_der_corput(k + 1) - 1.0) * 55.0 * pi / 180.0
        distance, eye = rng.uniform(5.6, 6.8), rng.uniform(1.1, 2.4)
        C = np.array([distance * sin(angle), -1.4 - distance * cos(angle), eye])
        target = rng.uniform([-0.5, -1.4, 1.5], [0.5, -0.8, 1.9])
        roll = tan(0.5 * rng.uniform(-6.0, 6.0) * pi / 180.0)
        poses.append(Pose(K, look_at(C, target, roll), C, float(rng.uniform(0.88, 1.12))))
    return poses


def _van_der_corput(k: int) -> float:
    """The k-th number of the sequence with base 2: the binary digits of k behind the point, reversed."""
    value, share = 0.0, 0.5
    while k:
        value += share * (k & 1)
        k, share = k >> 1, 0.5 * share
    return value


def write_views(folder: Path, count: int, *, size: tuple[int, int] = (480, 360), threads: int = 2) -> None:
    """Images ``0000.png`` and so on of :func:`walk` in ``folder``; those that are there stay."""
    poses = enumerate(walk(count, size))
    missing = {k: pose for k, pose in poses if not (folder / f"{k:04d}.png").is_file()}
    if missing:
        write_images(folder, build_courtyard(), missing, size, [2001], threads)


_YARD = re.compile(r"yard-(\d{1,4})")
YARDS = Path(tempfile.gettempdir()) / "thesisrecon-yards"
YARD_IMAGES, YARD_SIZE = 10, (960, 720)


def yard_number(name: str) -> int | None:
    """N of "yard-N"; None if ``name`` is not of a yard."""
    found = _YARD.fullmatch(name)
    return None if found is None else int(found[1])


def load_yard(number: int) -> Scene:
    """Images and true cameras of a yard, rendered on first use (a minute)."""
    folder = YARDS / f"yard-{number}-{YARD_IMAGES}"
    if not (folder / "cameras.json").is_file():
        write_yard(folder, number)
    return read_scene(folder, f"yard-{number}")


def write_yard(folder: Path, seed: int) -> None:
    """Images and ``cameras.json`` of another yard (:func:`build_yard`) and other cameras for each seed."""
    poses = walk(YARD_IMAGES, YARD_SIZE, seed=1000 + seed)
    zoom = float(np.random.default_rng([72, seed]).uniform(0.85, 1.25))
    cameras = []
    for k, pose in enumerate(poses):
        K = pose.K * np.array([[zoom], [zoom], [1.0]])
        K[:2, 2] = pose.K[:2, 2]
        poses[k] = replace(pose, K=K)
        place = {"K": K, "R": pose.R, "t": -pose.R @ pose.C, "distortion": [0.0, 0.0, 0.0]}
        cameras.append({"name": f"{k:04d}.png", "width": YARD_SIZE[0], "height": YARD_SIZE[1], **place})
    write_images(folder / "images", build_yard(seed), dict(enumerate(poses)), YARD_SIZE, [2003, seed])
    write_json(folder / "cameras.json", {"cameras": cameras})


STEREO_SIZE, STEREO_BASELINE_M = (480, 360), 0.3


def stereo_yard_folder(seed: int) -> Path:
    """The folder of a rectified pair of a yard and its true disparities, rendered on first use."""
    folder = YARDS / f"stereo-{seed}"
    if not (folder / "disparity.npy").is_file():
        write_stereo_yard(folder, seed)
    return folder


def write_stereo_yard(folder: Path, seed: int) -> None:
    """``left.png``, ``right.png`` and ``disparity.npy`` (2, H, W) of both images, NaN for the sky."""
    world, pose = build_yard(seed), replace(walk(1, STEREO_SIZE, seed=1000 + seed)[0], exposure=1.0)
    poses = (pose, replace(pose, C=pose.C + STEREO_BASELINE_M * pose.R[0]))
    disparities = list[F32]()
    for k, (name, seen) in enumerate(zip(("left", "right"), poses, strict=True)):
        rng = np.random.default_rng([2004, seed, k])
        write_png(folder / f"{name}.png", take_image(world, seen, STEREO_SIZE, rng))
        depth = trace(world, seen, STEREO_SIZE, shade=False)[1]
        shift = seen.K[0, 0] * STEREO_BASELINE_M / np.where(depth > 0.0, depth, np.nan)
        disparities.append(shift.astype(np.float32))
    whole = io.BytesIO()
    np.save(whole, np.stack(disparities))
    write_atomically(folder / "disparity.npy", whole.getvalue())
