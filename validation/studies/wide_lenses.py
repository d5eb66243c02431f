"""Wide lenses without a prior: rendered images of 60 to 180 degrees, beside COLMAP with this kind of lens.

Without a focal length COLMAP registers no image of a fisheye lens. It starts from its own guess, 1.2 times
the long side, or has the true calibration.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thesisrecon import Camera, reconstruct
from thesisrecon.arrays import F64
from thesisrecon.camera import camera_of_row
from thesisrecon.errors import StageFailure
from thesisrecon.lens import image_of_directions, lens_row
from thesisrecon.records import Reconstruction
from validation.metrics.cameras import TrueCameras, area_under_recall, centre_errors, pose_pair_errors
from validation.references.colmap import map_and_read, match_with_pycolmap
from validation.runs.study import Part, report_progress
from validation.runs.tables import text_table
from validation.scenes.courtyard import SUN, WALL_HEIGHT, build_yard
from validation.scenes.many_views import TEXEL, WIDTH, _crate, _front, build_near, walk, walk_street
from validation.scenes.materials import cut_stone, grid, planks, rubble
from validation.scenes.pose import Pose, look_at, true_cameras
from validation.scenes.raycast import Surface, World, build_world
from validation.scenes.sensor import write_images

SIZE, K1 = (640, 480), -0.02
AUC_DEG = 0.5


class WideSet(NamedTuple):
    """Rendered images, their true poses, and the true camera."""

    images: Path
    poses: Sequence[Pose]
    camera: Camera


def render_set(out: Path, scene: str, degrees: float, views: int, threads: int) -> WideSet:
    """Render the images of a scene by a fisheye lens, if the folder does not hold them."""
    K, row = lens_camera(SIZE, degrees, "fisheye", np.array([K1]))
    straight = walk(views, SIZE) if scene == "yard" else walk_street(views, SIZE)
    poses = [replace(pose, K=K, lens=row) for pose in straight]
    if scene == "room":
        poses = walk_inside(views, K, row)
    images = out / f"{scene}-{degrees:g}"
    if len(list(images.glob("*.png"))) != views:
        houses = [int(pose.C[0] // WIDTH) if scene == "street" else 0 for pose in poses]
        for house in sorted(set(houses)):
            near = {k: pose for k, pose in enumerate(poses) if houses[k] == house}
            build = {"room": build_room, "street": build_near}.get(scene)
            write_images(images, build_yard(3) if build is None else build(house), near, SIZE, [5], threads)
    return WideSet(images, poses, camera_of_row((K, np.eye(3), np.zeros(3)), SIZE, row))


def run_colmap(given: WideSet, out: Path, threads: int, *, calibrated: bool) -> Reconstruction | None:
    """COLMAP's model of a set from its guess of the focal length, or with the true calibration."""
    K, guess = given.camera.K, 1.2 * max(SIZE)
    start = [guess, guess, SIZE[0] / 2.0, SIZE[1] / 2.0, 0.0, 0.0, 0.0, 0.0]
    true = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, K1, 0.0, 0.0, 0.0]
    camera = ("OPENCV_FISHEYE", true if calibrated else start)
    match_with_pycolmap(given.images, out, threads=threads, camera=camera)
    return map_and_read(given.images, out, threads=threads, refine_principal_point=True, fixed=calibrated)


def score(model: Reconstruction | None, truth: TrueCameras) -> str:
    """Registered cameras; RMS error of their centres over the extent; AUC of relative poses."""
    auc = area_under_recall(pose_pair_errors(model, truth), AUC_DEG)
    if model is None or (off := centre_errors(model, truth)) is None:
        return f"{0 if model is None else model.registered.sum()}; –; {auc:.3f}"
    extent = np.sqrt(np.sum((truth[2] - truth[2].mean(axis=0)) ** 2, axis=1).mean())
    return f"{model.registered.sum()}; {np.sqrt(np.mean(off**2)) / extent:.3%}; {auc:.3f}"


def wide_lenses_study(
    out: Path, scenes: Sequence[str] = ("yard", "street", "room"),
    degrees: Sequence[float] = (60.0, 90.0, 120.0, 150.0, 180.0), views: int = 16, threads: int = 2,
) -> Iterator[Part]:  # fmt: skip
    """Reconstruct rendered images of wide lenses without a prior, and with COLMAP."""
    lines = list[list[object]]()
    for scene, wide in product(scenes, degrees):
        given = render_set(out / "images", scene, wide, views, threads)
        name = given.images.name
        lines.append([f"{scene}, {wide:g}°", *_ours(given, out / "ours" / name, threads)])
        for kind, calibrated in (("guess", False), ("true", True)):
            model = run_colmap(given, out / kind / name, threads, calibrated=calibrated)
            lines[-1].append(score(model, true_cameras(given.poses)))
        report_progress(" | ".join(map(str, lines[-1])))
    head = ["scene, angle", "trusted", "angle of view (true)", "focal length", "cameras; centres; AUC"]
    yield text_table([*head, "COLMAP from its guess", "COLMAP, true calibration"], lines)


def _ours(given: WideSet, out: Path, threads: int) -> list[str]:
    """Whether our result is trusted, the angle of view, the error of the focal length, and the scores."""
    truth = true_cameras(given.poses)
    try:
        result = reconstruct(given.images, out, until="metric", threads=threads, overwrite=True)
    except StageFailure as failure:
        return [f"no result: {failure}", "", "", score(None, truth)]
    assert result.metric is not None
    one, true = next(iter(result.cameras.values())), given.camera
    std = (one.std or {}).get("angle_of_view_deg", np.nan)
    angle = f"{one.angles_of_view[0]:.2f} ± {std:.2f} ({true.angles_of_view[0]:.2f})"
    focal = f"{abs(one.K[0, 0] / true.K[0, 0] - 1.0):.3%}"
    trusted, scores = "yes" if result.metric.trusted else "no", score(result.metric.reconstruction, truth)
    return [trusted, angle, focal, scores]


PRINCIPAL = (0.507, 0.494)  # principal point, as shares of the sides


def lens_camera(size: tuple[int, int], degrees: float, lens: str, coefficients: F64) -> tuple[F64, F64]:
    """K (3, 3) and the row of a lens whose images are ``degrees`` wide along the long side."""
    row = lens_row(lens, coefficients)
    half = np.radians(degrees / 2.0)
    ray = np.array([[np.sin(half), 0.0, np.cos(half)]])
    focal = max(size) / 2.0 / float(image_of_directions(ray, row)[0, 0])
    width, height = size
    return np.array([[focal, 0, PRINCIPAL[0] * width], [0, focal, PRINCIPAL[1] * height], [0, 0, 1.0]]), row


def build_room(seed: int) -> World:
    """A room of 8 x 8 m with four different walls and crates along them, seen from inside."""
    x, y, z = np.eye(3)
    half, high, plain = WIDTH / 2.0, WALL_HEIGHT, grid((WIDTH, WIDTH), TEXEL)
    materials = [_front(100 + 10 * seed + k) for k in range(4)]
    materials.append(rubble(plain, TEXEL, 2000 + seed, cell_m=0.16, relief_m=0.015))
    materials.append(planks(plain, TEXEL, 2100 + seed, 0.2))
    walls = [
        Surface(np.array([-half, half, 0.0]), x, z, (WIDTH, high), 0),
        Surface(np.array([-half, -half, 0.0]), y, z, (WIDTH, high), 1),
        Surface(np.array([half, half, 0.0]), -y, z, (WIDTH, high), 2),
        Surface(np.array([half, -half, 0.0]), -x, z, (WIDTH, high), 3),
        Surface(np.array([-half, -half, 0.0]), x, y, (WIDTH, WIDTH), 4),
        Surface(np.array([-half, half, high]), x, -y, (WIDTH, WIDTH), 5),
    ]
    objects = list[list[Surface]]()
    for k in range(9):
        rng, side = np.random.default_rng([83, seed, k]), grid((2.0, 2.0), TEXEL)
        kind = planks(side, TEXEL, 2200 + 9 * seed + k, 0.12 + 0.01 * k)
        stone = cut_stone(side, TEXEL, 2300 + 9 * seed + k, (0.3 + 0.02 * k, 0.25))
        materials.append(kind if k % 2 else stone)
        angle = 2.0 * np.pi * (k + rng.uniform(-0.2, 0.2)) / 9.0
        place = np.array([3.1 * np.cos(angle), 3.1 * np.sin(angle), 0.0])
        size = rng.uniform([0.4, 0.4, 0.4], [0.8, 0.8, 1.5])
        objects.append(_crate(place, size, float(rng.uniform(-0.7, 0.7)), len(materials) - 1))
    return build_world(objects + [[wall] for wall in walls], materials, SUN)


def walk_inside(count: int, K: F64, lens: F64, *, seed: int = 0) -> list[Pose]:
    """Cameras on a circle in the middle of the room, looking outwards and about."""
    poses = []
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        angle = 2.0 * np.pi * k / count
        C = np.array([1.5 * np.cos(angle), 1.5 * np.sin(angle), 1.6 + 0.5 * np.sin(3.0 * angle)])
        turn = angle + rng.uniform(-0.25, 0.25)
        ahead = np.array([np.cos(turn), np.sin(turn), rng.uniform(-0.25, 0.15)])
        poses.append(Pose(K, look_at(C, C + ahead, rng.uniform(-0.08, 0.08)), C, 1.0, lens))
    return poses
