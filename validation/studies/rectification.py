"""Rectification of every accepted pair of real images (reconstructed once in OUT), compared with OpenCV."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import thesisrecon
from thesisrecon.api.cameras import triangulate
from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.camera_matrix import project, undistort
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.records import Reconstruction, TwoView
from thesisrecon.stereo._epipolar_pair import EpipolarPair, pair_of_cameras, pair_of_fundamental
from thesisrecon.stereo._planar import (
    PlanarRectification,
    common_orientation,
    hartley,
    loop_zhang,
    minimum_distortion,
)
from thesisrecon.stereo._polar import polar
from thesisrecon.stereo._rectification_quality import RectificationQuality, jacobians, measure_quality
from thesisrecon.stereo._resampling import Rectification
from thesisrecon.stereo.rectification import rectify
from validation.references.opencv import opencv_calibrated, opencv_uncalibrated
from validation.runs.processes import timed
from validation.runs.study import Part
from validation.runs.tables import Metric, Rows
from validation.scenes.real import scenes_here

SCENES = ("fountain-P11", "Herz-Jesus-P8")
BEST_F, BEST = "best from F", "best from cameras"
OPENCV_F, OPENCV = "OpenCV uncalibrated", "OpenCV stereoRectify"
DY_PX, ORTHOGONALITY_DEG, ASPECT, KEPT = 0.3, 5.0, 0.1, 0.8
GRID = 48


@dataclass(frozen=True)
class RealPair:
    """One pair: from F, and from metric cameras with the lens distortion removed."""

    name: str
    loose: EpipolarPair
    metric: EpipolarPair


@dataclass(frozen=True)
class Measured:
    """One method on one pair; ``kept`` is the kept share of the common region, the lesser of both sides."""

    quality: RectificationQuality
    dy_frame_px: float
    dy_px: float
    disparities_px: float
    kept: float
    seconds: float
    polar: bool


def undistorted(model: Reconstruction, view: int, xy: F64) -> F64:
    """Return pixels (N, 2) of a camera without lens distortion."""
    assert model.K is not None
    if model.distortion is None:
        return xy
    inverse = np.linalg.inv(model.K[view])
    places = undistort(dehomogenize(homogenize(xy) @ inverse.T), model.distortion[view])
    return np.asarray(dehomogenize(homogenize(places) @ model.K[view].T))


def pairs_of(pairs: Sequence[TwoView], model: Reconstruction, sizes: F64) -> list[RealPair]:
    found = []
    for p in pairs:
        if p.accepted and model.registered[p.i] and model.registered[p.j]:
            size1, size2 = ((int(sizes[k][0]), int(sizes[k][1])) for k in (p.i, p.j))
            xy1, xy2 = undistorted(model, p.i, p.xy1), undistorted(model, p.j, p.xy2)
            found.append(
                RealPair(
                    f"{p.i}-{p.j}",
                    pair_of_fundamental(p.F, p.xy1, p.xy2, size1, size2),
                    pair_of_cameras(model.P[p.i], model.P[p.j], size1, size2, xy1=xy1, xy2=xy2),
                )
            )
    return found


def _opencv_f(pair: RealPair) -> PlanarRectification | None:
    loose, T = pair.loose, pair.loose.pencil.normalization
    F = T[1].T @ loose.pencil.fundamental @ T[0]
    return opencv_uncalibrated(F / np.linalg.norm(F), *loose.matches, loose.pencil.sizes[0])


def _opencv_cameras(pair: RealPair) -> PlanarRectification:
    assert pair.metric.cameras is not None
    return opencv_calibrated(pair.metric.cameras[0], pair.metric.cameras[1], pair.metric.pencil.sizes[0])


METHODS: Mapping[str, tuple[bool, Callable[[RealPair], Rectification | None]]] = {
    "Hartley": (False, lambda p: hartley(p.loose)),
    "Loop-Zhang": (False, lambda p: loop_zhang(p.loose)),
    "least distortion": (False, lambda p: minimum_distortion(p.loose)),
    "polar": (False, lambda p: polar(p.loose)),
    "metric": (True, lambda p: common_orientation(p.metric)),
    BEST_F: (False, lambda p: rectify(p.loose)),
    BEST: (True, lambda p: rectify(p.metric)),
    OPENCV_F: (False, _opencv_f),
    OPENCV: (True, _opencv_cameras),
}
"""Name -> whether the method needs undistorted pixels, and the method."""


def seen_by_other(pair: EpipolarPair, side: int) -> F64:
    """Return pixels (M, 2) of a grid in one image that the other sees at some depth of the matches.

    The depths are the 1 to 99 % quantiles of those of the matches, widened by an eighth.
    """
    assert pair.cameras is not None
    P = pair.cameras if side == 0 else pair.cameras[::-1]
    X = dehomogenize(triangulate(pair.cameras, np.stack(pair.matches), method="linear"))
    z = np.quantile(X @ P[0, 2, :3] + P[0, 2, 3], [0.01, 0.99])
    width, height = pair.pencil.sizes[side]
    x, y = ((np.arange(GRID) + 0.5) / GRID * length - 0.5 for length in (width, height))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    shown = np.zeros(len(grid), dtype=bool)
    for depth in 1.0 / np.linspace(1.125 / z[0], 0.875 / z[1], 16):
        at = np.linalg.solve(P[0, :, :3], (depth * homogenize(grid) - P[0, :, 3]).T).T
        other = project(P[1], at)
        limit = np.array(pair.pencil.sizes[1 - side]) - 1.0
        front = at @ P[1, 2, :3] + P[1, 2, 3] > 0.0
        shown |= front & np.all((other >= 0.0) & (other <= limit), axis=1)
    return grid[shown]


def measure(pair: RealPair, name: str) -> Measured | None:
    """Rectify one pair with one method; None if it refuses."""
    with_cameras, method = METHODS[name]
    seen = pair.metric if with_cameras else pair.loose
    try:
        found, seconds, _ = timed(lambda: method(pair))
    except StageFailure:
        return None
    if found is None:
        return None
    kept = []
    for side in (0, 1):
        # Lens distortion moves these pixels by less than the grid spacing.
        pixels = seen_by_other(pair.metric, side)
        inside = np.all(np.isfinite(found.rectified_from_original(side, pixels)), axis=1)
        kept.append(float(np.mean(inside)) if len(pixels) else 1.0)
    quality = measure_quality(found, seen)
    polar = not isinstance(found, PlanarRectification)
    dy, disparities = _dy_and_range(found, seen)
    return Measured(quality, dy, _dy_of_image(found, seen), disparities, min(kept), seconds, polar)


def _dy_and_range(rectified: Rectification, pair: EpipolarPair) -> tuple[float, float]:
    """RMS of y1 - y2 and disparity range (1 to 99 % quantile) of the matches in pixels of the frame.

    NaN if the frame shows none of them.
    """
    left, right = (rectified.rectified_from_original(s, xy) for s, xy in enumerate(pair.matches))
    d, dy = (left - right)[np.isfinite(left + right).all(axis=1)].T
    if not len(d):
        return float("nan"), float("nan")
    return float(np.sqrt(np.mean(dy**2))), float(np.ptp(np.quantile(d, [0.01, 0.99])))


def _dy_of_image(rectified: Rectification, pair: EpipolarPair) -> float:
    """Return the RMS of y1 - y2 of the matches in pixels of the images."""
    rows = [rectified.rectified_from_original(s, xy)[:, 1] for s, xy in enumerate(pair.matches)]
    steps = [np.linalg.norm(jacobians(rectified, s, xy)[:, 1], axis=1) for s, xy in enumerate(pair.matches)]
    off = (rows[0] - rows[1]) / (0.5 * (steps[0] + steps[1]))
    off = off[np.isfinite(off)]
    return float(np.sqrt(np.mean(off**2))) if len(off) else float("nan")


def _off(values: tuple[float, float], ideal: float) -> float:
    return float(np.max(np.abs(np.array(values) - ideal)))


QUANTITIES: tuple[tuple[str, str, Callable[[Measured], float], float | None, bool], ...] = (
    ("RMS |dy| of inliers", "px of the frame", lambda m: m.dy_frame_px, None, True),
    ("RMS |dy| of inliers", "px of the image", lambda m: m.dy_px, DY_PX, True),
    (
        "angle of midlines off 90",
        "deg",
        lambda m: _off(m.quality.orthogonality_deg, 90.0),
        ORTHOGONALITY_DEG,
        True,
    ),
    ("aspect off 1", "", lambda m: _off(m.quality.aspect, 1.0), ASPECT, True),
    ("kept of the common region", "", lambda m: m.kept, KEPT, False),
    ("stretch", "", lambda m: m.quality.stretch, None, True),
    ("slant of disparities", "", lambda m: m.quality.disparity_slope, None, True),
    ("distortion", "", lambda m: m.quality.distortion, None, True),
    ("least scale", "", lambda m: m.quality.min_scale, None, False),
    ("pixels over the image's", "", lambda m: m.quality.size_ratio, None, True),
    ("range of disparities", "px", lambda m: m.disparities_px, None, True),
    ("time", "ms", lambda m: 1e3 * m.seconds, None, True),
)
"""Name, unit, number, bound, and whether small values are good."""


def check_scene(name: str, pairs: Sequence[RealPair]) -> list[Metric]:
    """Return medians and worst values over the pairs; the best method from F is judged."""
    found = {method: [measure(pair, method) for pair in pairs] for method in METHODS}
    done = {method: [m for m in each if m is not None] for method, each in found.items()}
    rows = Rows(name, BEST_F)
    count, numbers = len(pairs), {k: float(len(v)) for k, v in done.items()}
    rows.add(f"done, of {counted(count, 'pair')}", numbers, at_least=float(count))
    rows.add("polar chosen", {k: float(sum(m.polar for m in done[k])) for k in (BEST_F, BEST)})
    for label, unit, number, target, small in QUANTITIES:
        for how, merge in (("median", np.median), ("worst", np.max if small else np.min)):
            values = {k: _merged(merge, [number(m) for m in v]) for k, v in done.items()}
            held = target if how == "worst" else None
            rows.append(Metric(name, f"{label}, {how}", unit, values, BEST_F, held, at_most=small))
    judged = [(number, target, small) for _, _, number, target, small in QUANTITIES if target is not None]
    shares = {
        k: float(np.mean([[_reached(m, f(m), target, small) for f, target, small in judged] for m in v]))
        for k, v in done.items()
        if v
    }
    rows.add("targets reached, share of all", shares)
    return rows


def _reached(measured: Measured, value: float, target: float, small: bool) -> bool:
    if not np.isfinite(value):
        # A midline through the epipole has no angle, so polar frames have none.
        return measured.polar
    return value <= target if small else value >= target


def _merged(merge: Callable[[F64], float], values: list[float]) -> float | None:
    finite = np.array([v for v in values if np.isfinite(v)])
    return float(merge(finite)) if len(finite) else None


def rectification_study(out: Path, scenes: Sequence[str] = SCENES) -> Iterator[Part]:
    """Compare rectification of real pairs with OpenCV."""
    for scene in scenes_here(scenes):
        run = thesisrecon.reconstruct(list(scene.image_paths), out / scene.name, until="metric")
        assert run.metric is not None
        sizes = np.array([image.size for image in run.images], dtype=np.float64)
        yield check_scene(scene.name, pairs_of(run.pairs, run.metric.reconstruction, sizes))
