"""Wide baselines: which front ends find the right matches, and up to which difference of the views.

Images and warped views of them (roll, scale, obliqueness, exposure), and a yard from two known poses. A pair
is found if it is accepted and the median distance of the true correspondences to the epipolar lines of its F
is below ``RIGHT_REL`` of the long side; accepted with another F it is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64, U8
from thesisrecon.config import PipelineConfig, preset
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.two_view import symmetric_residuals
from thesisrecon.pipeline.matching import match_images
from thesisrecon.records import Image
from validation.references.libraries import cv2
from validation.references.sift import sift_front_end
from validation.runs.study import Part, report_progress
from validation.runs.tables import Metric, Rows, text_table
from validation.scenes.courtyard import build_courtyard
from validation.scenes.many_views import YARDS, walk_calibration
from validation.scenes.pose import Pose, look_at
from validation.scenes.raycast import World, trace
from validation.scenes.real import data_root, read_rgb, write_png
from validation.scenes.sensor import take_image

PHOTOGRAPHS = (
    "strecha/fountain-P11/images/0005.jpg",
    "strecha/Herz-Jesus-P8/images/0004.jpg",
    "merton1/images/001.jpg",
    "wild/monstree/images/IMG_1036.jpg",
    "wild/lund29/images/16.jpg",
)
LONG_SIDE, SAMPLES_PER_PX = 1000, 3
GRID = 40
SIZE = (960, 720)


class WideStep(NamedTuple):
    """What differs between the images: roll and obliqueness (deg), scale and exposure (factors)."""

    roll: float = 0.0
    scale: float = 1.0
    tilt: float = 0.0
    exposure: float = 1.0

    def __str__(self) -> str:
        parts = [f"roll {self.roll:g} deg"] if self.roll else []
        parts += [f"scale {self.scale:g}"] if self.scale != 1.0 else []
        parts += [f"tilt {self.tilt:g} deg"] if self.tilt else []
        parts += [f"exposure {self.exposure:g}"] if self.exposure != 1.0 else []
        return ", ".join(parts) or "none"


STEPS = (
    *(WideStep(roll=roll) for roll in (0.0, 20.0, 45.0, 90.0, 180.0)),
    *(WideStep(scale=scale) for scale in (1.5, 2.0, 3.0)),
    *(WideStep(tilt=tilt) for tilt in (30.0, 45.0, 60.0, 70.0)),
    WideStep(exposure=0.3),
    WideStep(roll=45.0, tilt=45.0),
    WideStep(roll=90.0, tilt=60.0),
    WideStep(scale=2.0, tilt=45.0),
    WideStep(roll=45.0, scale=2.0, tilt=45.0, exposure=0.5),
    WideStep(roll=45.0, scale=2.0, tilt=60.0),
    WideStep(scale=3.0, tilt=60.0),
)
WidePair = tuple[tuple[Image, Image], F64]
"""Two images, and true correspondences (M, 4) px spread over what both show."""


def warped_pairs(step: WideStep) -> Iterator[WidePair]:
    """Yield each real image and its view by a camera that differs by ``step``; none without the data."""
    root = data_root()
    for path in (root / name for name in PHOTOGRAPHS) if root is not None else ():
        if path.is_file():
            yield warp_photograph(path, step)


def warp_photograph(path: Path, step: WideStep) -> WidePair:
    """Return an image reduced by the scale of ``step``, and its second view of the same size."""
    rgb = read_rgb(path)
    whole = np.array(rgb.shape[1::-1], dtype=np.float64)
    long_side = min(LONG_SIDE, whole.max() / step.scale)
    size = np.round(whole * long_side / whole.max()).astype(np.int64)
    first = _to_canvas(whole, size, WideStep())
    second = _to_canvas(whole, size, step)
    images = tuple(_warp(rgb, H, size) for H in (first, second))
    lit = np.clip(255.0 * step.exposure * (images[1] / 255.0) ** 1.1, 0.0, 255.0)
    pair = _image(images[0]), _image(lit.astype(np.uint8))
    x, y = np.meshgrid(*(np.linspace(0.0, n - 1.0, GRID) for n in whole))
    points = homogenize(np.column_stack([x.ravel(), y.ravel()]))
    xy1, xy2 = dehomogenize(points @ first.T), dehomogenize(points @ second.T)
    inside = ((xy2 >= 0.0) & (xy2 <= size - 1.0)).all(axis=1)
    return pair, np.hstack([xy1, xy2])[inside]


def _to_canvas(whole: F64, size: np.ndarray, step: WideStep) -> F64:
    """Return the homography (3, 3) from image pixels to those of a camera 1.2 long sides in front of it."""
    distance = 1.2
    to_plane = np.diag([1.0 / whole.max(), 1.0 / whole.max(), 1.0])
    to_plane[:2, 2] = -0.5 * (whole - 1.0) / whole.max()
    R = Rotation.from_euler("ZY", [step.roll, step.tilt], degrees=True).as_matrix()
    view = np.column_stack([R[:, 0], R[:, 1], [0.0, 0.0, distance]])
    focal = step.scale * distance * size.max()
    K = np.array([[focal, 0.0, 0.5 * (size[0] - 1.0)], [0.0, focal, 0.5 * (size[1] - 1.0)], [0.0, 0.0, 1.0]])
    return np.asarray(K @ view @ to_plane)


def _warp(rgb: U8, H: F64, size: np.ndarray) -> U8:
    n = SAMPLES_PER_PX
    finer = np.array([[n, 0.0, 0.5 * (n - 1.0)], [0.0, n, 0.5 * (n - 1.0)], [0.0, 0.0, 1.0]])
    fine = cv2.warpPerspective(rgb, finer @ H, (int(n * size[0]), int(n * size[1])), flags=cv2.INTER_CUBIC)
    return np.asarray(cv2.resize(fine, (int(size[0]), int(size[1])), interpolation=cv2.INTER_AREA))


def rendered_pair(step: WideStep) -> WidePair:
    """The courtyard from its front, and from where a camera differs by ``step``; kept in a folder."""
    world = build_courtyard()
    poses = [_yard_pose(WideStep()), _yard_pose(step)]
    names = ("front", str(step))
    images = [_image(_rendered(world, pose, name)) for name, pose in zip(names, poses, strict=True)]
    return (images[0], images[1]), _true_matches(world, poses)


def _image(rgb: U8) -> Image:
    return Image("", rgb, rgb.shape[1::-1])


def _yard_pose(step: WideStep) -> Pose:
    """A camera that looks at the middle of the yard, moved on a circle, nearer and turned."""
    K = walk_calibration(SIZE)
    target, angle = np.array([-0.3, -0.6, 1.7]), np.radians(step.tilt)
    distance = 7.0 / step.scale
    C = target + distance * np.array([np.sin(angle), -np.cos(angle), 0.05])
    # The tangent of half of 180 degrees is infinite; a camera is turned after it is aimed.
    R = Rotation.from_euler("z", step.roll, degrees=True).as_matrix() @ look_at(C, target, 0.0)
    return Pose(K, R, C, step.exposure)


def _rendered(world: World, pose: Pose, name: str) -> U8:
    file = YARDS / "wide" / f"{name}.png"
    if not file.is_file():
        rng = np.random.default_rng([2005, len(name)])
        file.parent.mkdir(parents=True, exist_ok=True)
        write_png(file, take_image(world, pose, SIZE, rng))
    return read_rgb(file)


def _true_matches(world: World, poses: list[Pose]) -> F64:
    """Pixels of image 1 on a grid and where image 2 shows the same points."""
    depths = [trace(world, pose, SIZE, shade=False)[1] for pose in poses]
    x, y = (a.ravel() for a in np.meshgrid(*(np.arange(8, n, n // GRID) for n in SIZE)))
    depth = depths[0][y, x]
    rays = homogenize(np.column_stack([x, y]).astype(np.float64)) @ np.linalg.inv(poses[0].K).T
    X = (rays * depth[:, None]) @ poses[0].R + poses[0].C
    seen = (X - poses[1].C) @ poses[1].R.T @ poses[1].K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        xy2 = seen[:, :2] / seen[:, 2:]
    here = np.flatnonzero((depth > 0.0) & (seen[:, 2] > 0.0))
    here = here[((xy2[here] >= 0.0) & (xy2[here] <= np.array(SIZE) - 1.0)).all(axis=1)]
    there = depths[1][tuple(np.rint(xy2[here]).astype(np.int64).T[::-1])]
    # Relative difference of depths within which a pixel shows the point.
    here = here[np.abs(there - seen[here, 2]) <= 0.02 * seen[here, 2]]
    return np.column_stack([x[here], y[here], xy2[here]]).astype(np.float64)


OURS, ORDINARY, SIFT = "ours", "without simulated views", "SIFT"
RIGHT_REL = 0.003


class _WithoutTilts(MultiScaleCorners):
    oblique_tilts = ()


def front_ends() -> dict[str, PipelineConfig]:
    """Our front end and one of OpenCV with the same estimator of F and verification."""
    ours = preset("default")
    ordinary = replace(ours, features=_WithoutTilts())
    return {OURS: ours, ORDINARY: ordinary, SIFT: sift_front_end(ours)}


def relate(config: PipelineConfig, pair: WidePair) -> tuple[int, bool]:
    """Return the verified matches of a pair that is found, 0 for another one, and whether it is wrong."""
    images, truth = pair
    view = match_images(config, images, 0)
    if not view.accepted:
        return 0, False
    d = symmetric_residuals(view.F, truth[:, :2], truth[:, 2:]) / np.sqrt(2.0)
    right = float(np.median(d)) / max(images[0].size) < RIGHT_REL
    return view.inliers * right, not right


def check_step(step: WideStep, by: dict[str, list[tuple[int, bool]]]) -> list[Metric]:
    """Pairs found and wrong."""
    rows, pairs = Rows(str(step), OURS), max(map(len, by.values()))
    found = {name: float(sum(verified > 0 for verified, _ in some)) for name, some in by.items()}
    rows.add(f"pairs found, of {pairs}", found)
    wrong = {name: float(sum(is_wrong for _, is_wrong in some)) for name, some in by.items()}
    rows.add("wrong", wrong, at_most=0.0)
    return rows


def wide_baseline_study() -> Iterator[Part]:
    """Find pairs of images whose view directions, distances or rolls differ much."""
    configs, lines, rows = front_ends(), list[list[object]](), list[Part]()
    for step in STEPS:
        pairs = [*warped_pairs(step), rendered_pair(step)]
        by = {name: [relate(config, pair) for pair in pairs] for name, config in configs.items()}
        lines.append([step, *map(_cell, by.values())])
        report_progress(" | ".join(map(str, lines[-1])))
        rows.append(check_step(step, by))
    yield text_table(["step; found of all (wrong), median verified", *configs], lines)
    yield from rows


def _cell(results: Sequence[tuple[int, bool]]) -> str:
    verified, wrong = zip(*results, strict=True)
    return f"{np.count_nonzero(verified)} of {len(results)} ({sum(wrong)}), {np.median(verified):.0f}"
