"""Writes ``fixtures/courtyard`` and ``fixtures/cube`` from nothing; the same bytes each time."""

from __future__ import annotations

import io
import json
from concurrent.futures import ThreadPoolExecutor
from math import cos, pi, sin, tan
from pathlib import Path

import numba
import numpy as np
import PIL
from PIL import Image as PillowImage
from PIL import features

from thesisrecon.arrays import U16
from thesisrecon.io._files import write_atomically, write_text
from validation.scenes.courtyard import build_courtyard
from validation.scenes.cube import make_cube
from validation.scenes.pose import Pose, look_at
from validation.scenes.raycast import World, trace
from validation.scenes.sensor import encode_jpeg, take_image

SIZE = (1024, 768)
FOCAL, PRINCIPAL = 908.6, (528.9, 367.8)
DEPTH_STRIDE = 2
DEPTH_UNIT_M = 0.00025
GAINS = ((1.0, 1.0, 1.0), (1.02, 1.0, 0.98), (0.99, 1.0, 1.01))

# angle about the yard (deg), distance (m), eye height (m), roll (deg), what it looks at: x, y, z (m),
# exposure
STANDPOINTS = (
    (-55.0, 5.7, 1.62, 2.1, 0.55, -1.2, 1.62, 1.00),
    (-46.5, 6.3, 1.35, -3.4, 0.20, -1.0, 1.75, 1.08),
    (-38.0, 5.9, 2.05, 1.2, 0.05, -1.4, 1.50, 0.92),
    (-29.0, 6.6, 1.70, 5.8, -0.30, -0.8, 1.90, 1.00),
    (-20.5, 6.0, 1.18, -1.6, 0.10, -1.2, 1.70, 1.15),
    (-12.5, 6.8, 2.25, -4.9, -0.10, -0.9, 1.75, 0.88),
    (-4.0, 6.2, 1.55, 0.8, 0.35, -1.1, 1.85, 0.95),
    (5.0, 6.9, 1.92, 3.6, -0.15, -1.0, 1.60, 1.05),
    (13.5, 6.1, 1.28, -2.3, -0.40, -1.3, 1.80, 1.00),
    (21.5, 6.6, 2.15, 6.4, 0.10, -1.0, 1.65, 0.85),
    (30.5, 6.2, 1.66, -5.2, -0.20, -1.2, 1.70, 1.10),
    (39.0, 5.8, 1.40, 1.9, -0.50, -0.9, 1.75, 0.97),
    (47.0, 6.1, 2.30, -1.1, -0.10, -1.4, 1.50, 1.03),
    (55.0, 5.6, 1.72, 4.2, -0.65, -1.1, 1.68, 0.94),
)


def courtyard_poses() -> list[Pose]:
    """The fourteen true cameras: a hand-held walk on an arc, with varied heights, distances and rolls."""
    K = np.array([[FOCAL, 0.0, PRINCIPAL[0]], [0.0, FOCAL, PRINCIPAL[1]], [0.0, 0.0, 1.0]])
    poses = []
    for angle, distance, height, roll, x, y, z, exposure in STANDPOINTS:
        a = angle * pi / 180
        C = np.array([round(distance * sin(a), 4), round(-1.4 - distance * cos(a), 4), height])
        poses.append(
            Pose(K, look_at(C, np.array([x, y, z]), round(tan(0.5 * roll * pi / 180), 5)), C, exposure)
        )
    return poses


def render_image(world: World, pose: Pose, view: int) -> tuple[bytes, U16]:
    """JPEG bytes and quantised depth (see README of the fixtures) of one view."""
    rng = np.random.Generator(np.random.PCG64([2000, view]))
    rgb = take_image(world, pose, SIZE, rng, GAINS[view % len(GAINS)])
    depth = trace(world, pose, SIZE, shade=False)[1][::DEPTH_STRIDE, ::DEPTH_STRIDE]
    return encode_jpeg(rgb), np.asarray(np.floor(depth / DEPTH_UNIT_M + 0.5), dtype=np.uint16)


def encode_depth(depth: U16) -> bytes:
    """16-bit grey PNG."""
    buffer = io.BytesIO()
    PillowImage.fromarray(depth).save(buffer, "PNG", compress_level=9)
    return buffer.getvalue()


def versions() -> dict[str, str]:
    """Return the versions that affect the bytes."""
    jpeg = features.version("libjpeg_turbo") or features.version("jpg") or "unknown"
    return {"pillow": PIL.__version__, "libjpeg": jpeg, "numpy": np.__version__, "numba": numba.__version__}


def write_courtyard(folder: Path, *, threads: int = 2) -> None:
    """Render all views into ``folder``: images/, depth/, cameras.json."""
    world, poses = build_courtyard(), courtyard_poses()
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / "depth").mkdir(exist_ok=True)
    with ThreadPoolExecutor(threads) as pool:
        views = pool.map(lambda item: render_image(world, item[1], item[0]), enumerate(poses))
        for k, (jpeg, depth) in enumerate(views):
            write_atomically(folder / "images" / f"{k:04d}.jpg", jpeg)
            write_atomically(folder / "depth" / f"{k:04d}.png", encode_depth(depth))
    write_text(folder / "cameras.json", courtyard_cameras(versions()))


def courtyard_cameras(made_with: dict[str, str]) -> str:
    """Content of ``cameras.json``: the cameras as a run writes them, and the scale of the depth maps."""
    cameras = []
    for k, pose in enumerate(courtyard_poses()):
        camera = {"name": f"{k:04d}.jpg", "width": SIZE[0], "height": SIZE[1], "K": pose.K.tolist()}
        camera |= {"distortion": [0.0, 0.0, 0.0], "R": pose.R.tolist(), "t": (-pose.R @ pose.C).tolist()}
        cameras.append(camera | {"centre": pose.C.tolist()})
    content = {
        "scene": "courtyard",
        "convention": "x ~ K (R X + t); (0, 0) is the centre of the top-left pixel; metres",
        "depth": {"unit_m": DEPTH_UNIT_M, "stride": DEPTH_STRIDE, "none": 0},
        "made_with": made_with,
        "cameras": cameras,
    }
    return json.dumps(content, indent=1) + "\n"


def write_cube(folder: Path) -> None:
    """Write cube.npz: the fields of :class:`validation.scenes.cube.CubeSequence` by name."""
    folder.mkdir(parents=True, exist_ok=True)
    cube = make_cube()
    np.savez(folder / "cube.npz", K=cube.K, R=cube.R, C=cube.C, X=cube.X, face=cube.face, xy=cube.xy)
