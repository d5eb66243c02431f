"""Rectification of real pairs beside OpenCV: ``python -m validation.studies.rectification [-o OUT]``.

Every accepted pair of fountain-P11 and Herz-Jesus-P8 (reconstructed once, kept in OUT) by every method, and
the pairs of kusvod2, some with epipoles in view, by the choice among them. The exit code is 1 where a target
is missed. With ``--pictures`` some pairs are drawn into OUT with lines over them.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import thesisrecon
from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.camera_matrix import project, undistort
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.triangulation import triangulate_linear
from thesisrecon.records import Reconstruction, TwoView
from thesisrecon.stereo.epipolar_pair import EpipolarPair, pair_of_cameras, pair_of_fundamental
from thesisrecon.stereo.planar import (
    CommonOrientationRectifier,
    HartleyRectifier,
    LoopZhangRectifier,
    MinimumDistortionRectifier,
    PlanarRectification,
)
from thesisrecon.stereo.polar import PolarRectifier
from thesisrecon.stereo.rectification import (
    AnyRectification,
    RectificationQuality,
    jacobians,
    measure_quality,
    rectify,
)
from validation.metrics.record import Metric, markdown_table
from validation.references.rectification import opencv_calibrated, opencv_uncalibrated
from validation.scenes.real import data_root, load_real_scene

SCENES = ("fountain-P11", "Herz-Jesus-P8")
BEST_F, BEST = "best from F", "best from cameras"
OPENCV_F, OPENCV = "OpenCV uncalibrated", "OpenCV stereoRectify"
DY_PX, ORTHOGONALITY_DEG, ASPECT, KEPT = 0.3, 5.0, 0.1, 0.8
GRID = 48
Size = tuple[int, int]


@dataclass(frozen=True)
class RealPair:
    """A pair as F sees it, and as metric cameras do, lens distortion removed."""

    name: str
    loose: EpipolarPair
    metric: EpipolarPair


@dataclass(frozen=True)
class Measured:
    """What one method does to one pair; ``kept`` is the share of what both see, the lesser of both sides."""

    quality: RectificationQuality
    dy_px: float
    kept: float
    seconds: float
    polar: bool


def undistorted(model: Reconstruction, view: int, xy: F64) -> F64:
    """Pixels (N, 2) as a camera without lens distortion sees them."""
    assert model.K is not None
    if model.distortion is None:
        return xy
    inverse = np.linalg.inv(model.K[view])
    places = undistort(dehomogenize(homogenize(xy) @ inverse.T), model.distortion[view])
    return np.asarray(dehomogenize(homogenize(places) @ model.K[view].T))


def pairs_of(pairs: Sequence[TwoView], model: Reconstruction, sizes: F64) -> list[RealPair]:
    """Every accepted pair of registered views."""
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
    loose = pair.loose
    # F as cameras and matches of this pair have it: of the same pixels.
    L1, L2 = loose.pencil.lines
    T = [np.diag([1.0 / u, 1.0 / u, 1.0]) for u in loose.pencil.units]
    for t, u, c in zip(T, loose.pencil.units, loose.pencil.centres, strict=True):
        t[:2, 2] = -c / u
    F = T[1].T @ L2 @ np.array([[0.0, 1.0], [-1.0, 0.0]]) @ L1.T @ T[0]
    return opencv_uncalibrated(F / np.linalg.norm(F), *loose.matches, loose.sizes[0])


def _opencv_cameras(pair: RealPair) -> PlanarRectification:
    assert pair.metric.cameras is not None
    return opencv_calibrated(pair.metric.cameras[0], pair.metric.cameras[1], pair.metric.sizes[0])


METHODS: Mapping[str, tuple[bool, Callable[[RealPair], AnyRectification | None]]] = {
    "Hartley": (False, lambda p: HartleyRectifier().rectify(p.loose)),
    "Loop-Zhang": (False, lambda p: LoopZhangRectifier().rectify(p.loose)),
    "least distortion": (False, lambda p: MinimumDistortionRectifier().rectify(p.loose)),
    "polar": (False, lambda p: PolarRectifier().rectify(p.loose)),
    "metric": (True, lambda p: CommonOrientationRectifier().rectify(p.metric)),
    BEST_F: (False, lambda p: rectify(p.loose)),
    BEST: (True, lambda p: rectify(p.metric)),
    OPENCV_F: (False, _opencv_f),
    OPENCV: (True, _opencv_cameras),
}
"""Name -> whether it works on undistorted pixels, and the method; None or ``StageFailure``: refused."""


def seen_by_other(pair: EpipolarPair, side: int) -> F64:
    """Pixels (M, 2) of a photograph's grid that the other one shows at some depth of the matches.

    Depths are the 1 to 99 % quantiles of those of the matches, an eighth more at either end.
    """
    assert pair.cameras is not None
    P = pair.cameras if side == 0 else pair.cameras[::-1]
    X = dehomogenize(triangulate_linear(pair.cameras, np.stack(pair.matches)))
    z = np.quantile(X @ P[0, 2, :3] + P[0, 2, 3], [0.01, 0.99])
    width, height = pair.sizes[side]
    x, y = ((np.arange(GRID) + 0.5) / GRID * length - 0.5 for length in (width, height))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    shown = np.zeros(len(grid), dtype=bool)
    for depth in 1.0 / np.linspace(1.125 / z[0], 0.875 / z[1], 16):
        at = np.linalg.solve(P[0, :, :3], (depth * homogenize(grid) - P[0, :, 3]).T).T
        other = project(P[1], at)
        limit = np.array(pair.sizes[1 - side]) - 1.0
        front = at @ P[1, 2, :3] + P[1, 2, 3] > 0.0
        shown |= front & np.all((other >= 0.0) & (other <= limit), axis=1)
    return grid[shown]


def measure(pair: RealPair, name: str) -> Measured | None:
    """One method on one pair; None where it refuses."""
    with_cameras, method = METHODS[name]
    seen = pair.metric if with_cameras else pair.loose
    begun = time.perf_counter()
    try:
        found = method(pair)
    except StageFailure:
        return None
    seconds = time.perf_counter() - begun
    if found is None:
        return None
    kept = []
    for side in (0, 1):
        # Lens distortion moves these pixels by less than the distance of the grid.
        pixels = seen_by_other(pair.metric, side)
        inside = np.all(np.isfinite(found.rectified_from_original(side, pixels)), axis=1)
        kept.append(float(np.mean(inside)) if len(pixels) else 1.0)
    quality = measure_quality(found, seen)
    polar = not isinstance(found, PlanarRectification)
    return Measured(quality, _dy_of_photograph(found, seen), min(kept), seconds, polar)


def _dy_of_photograph(rectified: AnyRectification, pair: EpipolarPair) -> float:
    """RMS of y1 - y2 of the matches, each over the pixels of the frame per pixel of its photographs."""
    rows = [rectified.rectified_from_original(s, xy)[:, 1] for s, xy in enumerate(pair.matches)]
    steps = [np.linalg.norm(jacobians(rectified, s, xy)[:, 1], axis=1) for s, xy in enumerate(pair.matches)]
    off = (rows[0] - rows[1]) / (0.5 * (steps[0] + steps[1]))
    off = off[np.isfinite(off)]
    return float(np.sqrt(np.mean(off**2))) if len(off) else float("nan")


def _off(values: tuple[float, float], ideal: float) -> float:
    return float(np.max(np.abs(np.array(values) - ideal)))


QUANTITIES: tuple[tuple[str, str, Callable[[Measured], float], float | None, bool], ...] = (
    ("RMS |dy| of inliers", "px of the frame", lambda m: m.quality.rms_dy_px, None, True),
    ("RMS |dy| of inliers", "px of the photograph", lambda m: m.dy_px, DY_PX, True),
    (
        "angle of midlines off 90",
        "deg",
        lambda m: _off(m.quality.orthogonality_deg, 90.0),
        ORTHOGONALITY_DEG,
        True,
    ),
    ("aspect off 1", "", lambda m: _off(m.quality.aspect, 1.0), ASPECT, True),
    ("kept of what both see", "", lambda m: m.kept, KEPT, False),
    ("stretch", "", lambda m: m.quality.stretch, None, True),
    ("slant of disparities", "", lambda m: m.quality.disparity_slope, None, True),
    ("distortion", "", lambda m: m.quality.distortion, None, True),
    ("least scale", "", lambda m: m.quality.least_scale, None, False),
    ("pixels over the photograph's", "", lambda m: m.quality.size_ratio, None, True),
    ("range of disparities", "px", lambda m: float(np.ptp(m.quality.disparities)), None, True),
    ("time", "ms", lambda m: 1e3 * m.seconds, None, True),
)
"""Name, unit, number, target, and whether it is good to be small."""


def check_scene(name: str, pairs: Sequence[RealPair]) -> list[Metric]:
    """Medians and worst over the pairs by every method; targets are those of the best from F."""
    found = {method: [measure(pair, method) for pair in pairs] for method in METHODS}
    done = {method: [m for m in each if m is not None] for method, each in found.items()}
    rows = [
        Metric(
            name,
            f"done, of {counted(len(pairs), 'pair')}",
            "",
            {k: float(len(v)) for k, v in done.items()},
            BEST_F,
        ),
        Metric(
            name,
            "polar chosen",
            "",
            {k: float(sum(m.polar for m in done[k])) for k in (BEST_F, BEST)},
            BEST_F,
        ),
    ]
    for label, unit, number, target, small in QUANTITIES:
        for how, merge in (("median", np.median), ("worst", np.max if small else np.min)):
            values = {k: _merged(merge, [number(m) for m in v]) for k, v in done.items()}
            held = target if how == "worst" else None
            rows.append(Metric(name, f"{label}, {how}", unit, values, BEST_F, held, at_most=small))
    within = [number for _, _, number, target, _ in QUANTITIES if target is not None]
    limits = [(target, small) for _, _, _, target, small in QUANTITIES if target is not None]
    shares = {
        k: float(
            np.mean([[_reached(f(m), *limit) for f, limit in zip(within, limits, strict=True)] for m in v])
        )
        for k, v in done.items()
        if v
    }
    rows.append(Metric(name, "targets reached, share of all", "", shares, BEST_F))
    return rows


def _reached(value: float, target: float | None, small: bool) -> bool:
    # A midline through the epipole has no angle: a polar frame is not judged by it.
    return target is None or not np.isfinite(value) or (value <= target if small else value >= target)


def _merged(merge: Callable[[F64], float], values: list[float]) -> float | None:
    finite = np.array([v for v in values if np.isfinite(v)])
    return float(merge(finite)) if len(finite) else None


def check_hand_made(names: Sequence[str]) -> list[Metric]:
    """The pairs of kusvod2, matched here: what is chosen from F alone."""
    root = data_root()
    rows: list[Metric] = []
    for name in names:
        folder = root / "kusvod2" / name if root else None
        if folder is None or not folder.is_dir():
            continue
        sizes = [_size(folder / f"{side}.jpg") for side in "AB"]
        found = thesisrecon.match_pair(str(folder / "A.jpg"), str(folder / "B.jpg"))
        try:
            pair = pair_of_fundamental(found.F, found.xy1, found.xy2, sizes[0], sizes[1])
            chosen = rectify(pair)
        except StageFailure as reason:
            rows.append(Metric("kusvod2", name, "px", {"RMS |dy|": None}, "RMS |dy|", note=str(reason)))
            continue
        q = measure_quality(chosen, pair)
        values = {
            "matches": float(len(found.xy1)),
            "RMS |dy|": q.rms_dy_px,
            "distortion": q.distortion,
            "kept of A": q.coverage[0],
            "kept of B": q.coverage[1],
            "pixels over the photograph's": q.size_ratio,
        }
        kind = "planar" if isinstance(chosen, PlanarRectification) else "polar"
        rows.append(Metric("kusvod2", name, "", values, "RMS |dy|", note=kind))
    return rows


def _size(path: Path) -> Size:
    with Image.open(path) as photograph:
        return photograph.size


def draw_pair(rectified: AnyRectification, images: Sequence[np.ndarray], to: Path) -> None:
    """Both sides beside each other under red lines."""
    sides = [rectified.warp(image.astype(np.float32), side) for side, image in enumerate(images)]
    shown = np.hstack([np.where(np.isnan(s), 40.0, np.clip(s, 0.0, 255.0)).astype(np.uint8) for s in sides])
    picture = Image.fromarray(shown)
    pen = ImageDraw.Draw(picture)
    for y in np.linspace(0, picture.height - 1, 24).astype(int):
        pen.line([(0, y), (picture.width, y)], fill=(255, 0, 0))
    picture.save(to)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; 1 where a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, help="where reconstructions are kept")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=SCENES)
    parser.add_argument("--hand-made", nargs="*", default=["booksh", "corr", "kampa", "rotunda", "valbonne"])
    parser.add_argument(
        "--pictures", action="store_true", help="draw the best of neighbouring pairs into OUT"
    )
    options = parser.parse_args(arguments)
    tables = [check_hand_made(options.hand_made)]
    with tempfile.TemporaryDirectory() as folder:
        out = options.out or Path(folder)
        for name in options.scenes:
            scene = load_real_scene(name)
            if scene is None:
                continue
            run = thesisrecon.reconstruct(list(scene.image_paths), out / name, until="metric")
            assert run.metric is not None
            sizes = np.array([image.size for image in run.images], dtype=np.float64)
            pairs = pairs_of(run.pairs, run.metric.reconstruction, sizes)
            tables.append(check_scene(name, pairs))
            if options.pictures:
                for pair in pairs:
                    i, j = map(int, pair.name.split("-"))
                    if j - i in (1, 3):
                        images = [run.images[k].rgb for k in (i, j)]
                        draw_pair(rectify(pair.loose), images, out / f"{name}-{pair.name}.png")
    for table in tables:
        if table:
            print(f"## {table[0].scene}", markdown_table(table), sep="\n\n", end="\n\n", flush=True)
    return int(any(row.verdict == "missed" for table in tables for row in table))


if __name__ == "__main__":
    raise SystemExit(main())
