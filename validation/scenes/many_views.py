"""Arbitrarily many rendered images of the courtyard and of a street.

They are rendered, not cropped: images with a common centre would have no parallax and another cost. The first
n of a longer set are the set of n. Of the street only the houses near a camera are built, so that memory does
not grow with its length.
"""

from __future__ import annotations

import io
import re
from dataclasses import replace
from functools import lru_cache
from math import cos, pi, sin, tan
from pathlib import Path

import numpy as np

from thesisrecon.arrays import F32, F64
from thesisrecon.io._files import write_atomically, write_json
from validation.scenes.courtyard import SUN, WALL_HEIGHT, build_courtyard, build_yard
from validation.scenes.materials import (
    Material,
    add_window,
    bricks,
    cut_stone,
    grid,
    over,
    planks,
    plaster,
    rubble,
    smooth,
)
from validation.scenes.pose import Pose, look_at
from validation.scenes.procedural import fractal
from validation.scenes.raycast import Surface, World, build_world, trace
from validation.scenes.real import Scene, cache_folder, read_scene, write_png
from validation.scenes.sensor import take_image, write_images

FOCAL_REL = 0.9  # Focal length as a share of the long side


def walk_calibration(size: tuple[int, int]) -> F64:
    """K (3, 3) for images of ``size`` (width, height), the principal point off their middle."""
    focal = FOCAL_REL * max(size)
    return np.array([[focal, 0.0, 0.51 * size[0]], [0.0, focal, 0.48 * size[1]], [0.0, 0.0, 1.0]])


def walk(count: int, size: tuple[int, int], *, seed: int = 0) -> list[Pose]:
    """``count`` true cameras about the yard, of one calibration, for images of ``size`` (width, height)."""
    K = walk_calibration(size)
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
YARDS = cache_folder("yards")
YARD_IMAGES, YARD_SIZE = 10, (960, 720)


def yard_number(name: str) -> int | None:
    """N of "yard-N"; None if ``name`` is not of a yard."""
    found = _YARD.fullmatch(name)
    return None if found is None else int(found[1])


def load_yard(number: int) -> Scene:
    """Images and true cameras of a yard (:func:`build_yard`), rendered on first use (a minute)."""
    folder, cameras = YARDS / f"yard-{number}-{YARD_IMAGES}", list[dict[str, object]]()
    if (folder / "cameras.json").is_file():
        return read_scene(folder, f"yard-{number}")
    poses = walk(YARD_IMAGES, YARD_SIZE, seed=1000 + number)
    zoom = float(np.random.default_rng([72, number]).uniform(0.85, 1.25))
    for k, pose in enumerate(poses):
        K = pose.K * np.array([[zoom], [zoom], [1.0]])
        K[:2, 2] = pose.K[:2, 2]
        poses[k] = replace(pose, K=K)
        place = {"K": K, "R": pose.R, "t": -pose.R @ pose.C, "distortion": [0.0, 0.0, 0.0]}
        cameras.append({"name": f"{k:04d}.png", "width": YARD_SIZE[0], "height": YARD_SIZE[1], **place})
    write_images(folder / "images", build_yard(number), dict(enumerate(poses)), YARD_SIZE, [2003, number])
    write_json(folder / "cameras.json", {"cameras": cameras})
    return read_scene(folder, f"yard-{number}")


STEREO_SIZE, STEREO_BASELINE_M = (480, 360), 0.3


def stereo_yard_folder(seed: int) -> Path:
    """The folder of a rectified pair of a yard, rendered on first use: ``left.png``, ``right.png`` and
    ``disparity.npy`` (2, H, W), the true disparities of both images, NaN for the sky.
    """
    folder = YARDS / f"stereo-{seed}"
    if (folder / "disparity.npy").is_file():
        return folder
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
    return folder


TEXEL, WIDTH, DISTANCE = 0.01, 8.0, 5.5
"""Side of a texel, width of a house and distance of the camera from the walls, in metres."""
STEP = 0.5  # Metres between consecutive cameras: a wall point stays in view for some twelve of them
NEAR = 2  # Houses to each side of the nearest one that a camera may see


def _front(house: int) -> Material:
    """The wall of a house: bricks, stone or peeling plaster, and windows where chance puts them."""
    rng = np.random.default_rng([81, house])
    shape, seed = grid((WIDTH, WALL_HEIGHT), TEXEL), 1000 * (house + 1)
    kind = int(rng.integers(4))
    if kind == 0:
        wall = bricks(shape, TEXEL, seed)
    elif kind == 1:
        wall = cut_stone(shape, TEXEL, seed, (float(rng.uniform(0.4, 0.8)), float(rng.uniform(0.2, 0.35))))
    elif kind == 2:
        wall = rubble(shape, TEXEL, seed, cell_m=float(rng.uniform(0.2, 0.35)), relief_m=0.05)
    else:
        peel = smooth(fractal(shape, TEXEL, seed + 40, wavelengths_m=(1.9, 0.05), ratio=0.62), -0.02, 0.02)
        wall = over(bricks(shape, TEXEL, seed), plaster(shape, TEXEL, seed + 20), peel)
    across = np.sort(rng.uniform(0.7, WIDTH - 0.7, 3))
    for k, x in enumerate(across[np.diff(across, prepend=-9.0) > 1.4]):
        for low in (1.0, 3.0):
            low = low + float(rng.uniform(-0.15, 0.15))
            half = float(rng.uniform(0.3, 0.45))
            add_window(wall, (x - half, low, x + half, low + 1.2), seed + 60 + 7 * k + int(low))
    return wall


@lru_cache(maxsize=2 * (2 * NEAR + 1))
def _house(house: int) -> tuple[list[Material], float]:
    """Materials of a house (wall, ground before it, crates, stones) and how far it stands back, in metres."""
    seed, side = 1000 * (house + 1), grid((2.0, 2.0), TEXEL)
    ground = rubble(grid((WIDTH, 8.0), TEXEL), TEXEL, seed + 500, cell_m=0.14, relief_m=0.015)
    wood = planks(side, TEXEL, seed + 600, 0.155)
    stone = cut_stone(side, TEXEL, seed + 700, (0.45, 0.3))
    return [_front(house), ground, wood, stone], float(np.random.default_rng([82, house]).uniform(0.0, 1.2))


def build_near(house: int) -> World:
    """Build a house and its neighbours as one world; x runs along the street, y into the walls."""
    x, y, z = np.eye(3)
    materials, walls, objects = list[Material](), list[list[Surface]](), list[list[Surface]]()
    for h in range(house - NEAR, house + NEAR + 1):
        rng, first = np.random.default_rng([83, h]), len(materials)
        own, back = _house(h)
        materials += own
        at = WIDTH * h * x
        walls.append([Surface(at + back * y, x, z, (WIDTH, WALL_HEIGHT), first)])
        walls.append([Surface(at - 7.0 * y, x, y, (WIDTH, 8.0), first + 1)])
        for _ in range(int(rng.integers(2, 5))):
            u, away = float(rng.uniform(0.5, WIDTH - 0.5)), float(rng.uniform(0.6, 1.8))
            size = rng.uniform([0.4, 0.4, 0.4], [0.8, 0.8, 1.5])
            angle, material = float(rng.uniform(-0.4, 0.4)), first + 2 + int(rng.integers(2))
            objects.append(_crate(at + u * x - away * y, size, angle, material))
    return build_world(objects + walls, materials, SUN)


def _crate(place: np.ndarray, size: np.ndarray, angle: float, material: int) -> list[Surface]:
    z, (w, d, h) = np.eye(3)[2], size.tolist()
    u, v = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
    faces = [
        (place - 0.5 * w * u - 0.5 * d * v, u, z, (w, h)),
        (place + 0.5 * w * u + 0.5 * d * v, -u, z, (w, h)),
        (place + 0.5 * w * u - 0.5 * d * v, v, z, (d, h)),
        (place - 0.5 * w * u + 0.5 * d * v, -v, z, (d, h)),
        (place - 0.5 * w * u - 0.5 * d * v + h * z, u, v, (w, d)),
    ]
    return [
        Surface(o, a, b, s, material, flat=True, offset=(0.2 * k, 0.1 * k))
        for k, (o, a, b, s) in enumerate(faces)
    ]


def walk_street(count: int, size: tuple[int, int]) -> list[Pose]:
    """``count`` true cameras of one calibration along the street; the first n of any walk are the same."""
    K = walk_calibration(size)
    poses = []
    for k in range(count):
        rng, along = np.random.default_rng([84, k]), (NEAR + 1) * WIDTH + STEP * k
        C = np.array([along, -DISTANCE, 1.6]) + rng.normal(0.0, [0.05, 0.2, 0.15])
        heading = 0.35 * np.sin(along / 3.5) + rng.normal(0.0, 0.08)
        ahead = np.array([np.sin(heading), np.cos(heading), rng.normal(0.06, 0.05)])
        roll = float(np.tan(0.5 * np.radians(rng.uniform(-4.0, 4.0))))
        poses.append(Pose(K, look_at(C, C + ahead, roll), C, float(rng.uniform(0.88, 1.12))))
    return poses


def write_street(folder: Path, count: int, *, size: tuple[int, int] = (480, 360), threads: int = 2) -> None:
    """Images ``0000.png`` and so on of :func:`walk_street`; those that are there stay."""
    poses = walk_street(count, size)
    missing = {k: pose for k, pose in enumerate(poses) if not (folder / f"{k:04d}.png").is_file()}
    houses = {k: int(pose.C[0] // WIDTH) for k, pose in missing.items()}
    for house in sorted(set(houses.values())):
        here = {k: pose for k, pose in missing.items() if houses[k] == house}
        write_images(folder, build_near(house), here, size, [2006], threads)
