"""Errors of depth maps against true depths and sparse points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from thesisrecon.arrays import B8, F32, F64, U8
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.records import DepthMap, DisparityMap, Reconstruction, Similarity
from validation.scenes.real import Scene, load_fixture_depth
from validation.scenes.stereo import StereoPair

SAME = 0.01  # Maximum relative depth error of a correct depth, and between views of the same point


class Judged(NamedTuple):
    """Relative ``error`` (N,) of known depths, above 0 if too deep, and its size in ``deviations``; shares
    ``known`` and ``right``.
    """

    error: F64
    deviations: F64
    known: float
    right: float


Scores = dict[str, float]
"""Numbers of all maps of a scene by their names in the report, shares in per cent."""


def together(judged: Sequence[Judged]) -> Scores:
    """Combine the scores of the maps of a scene; ``ValueError`` without maps."""
    if not judged:
        raise ValueError("there is no depth map to judge")
    signed, right = np.concatenate([one.error for one in judged]), [one.right for one in judged]
    error = np.abs(signed)
    # Median absolute value of a standard normal variable.
    off = [float(np.median(one.deviations)) / 0.6745 for one in judged if len(one.deviations)]
    return {
        "depth error, median": 100.0 * float(np.median(error)) if len(error) else float("nan"),
        "depth error, bias": 100.0 * abs(float(np.median(signed))) if len(signed) else float("nan"),
        "within 1 %": 100.0 * float(np.mean(right)),
        "within 1 %, worst view": 100.0 * min(right),
        "known": 100.0 * float(np.mean([one.known for one in judged])),
        "within 1 % of the known": 100.0 * float(np.mean(error < SAME)) if len(error) else 0.0,
        "error in deviations": float(np.median(off)) if off else float("nan"),
    }


TrueDepth = tuple[F64, int, B8]
"""True depth of a view (h, w), its stride in pixels, and where another view sees the place."""


def true_depth(scene: Scene, view: int) -> TrueDepth:
    """Return the truth of a view of the courtyard."""
    K, R, C = scene.cameras
    depth, stride = load_fixture_depth(view)
    rows, columns = depth.shape
    x, y = np.meshgrid(stride * np.arange(float(columns)), stride * np.arange(float(rows)))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(K[view]).T
    X = (rays * depth[..., None]) @ R[view] + C[view]
    seen = np.zeros(depth.shape, dtype=bool)
    for j in range(len(K)):
        if j != view:
            z, other = depths_in_view(scene, j, X)
            with np.errstate(divide="ignore", invalid="ignore"):
                seen |= np.abs(other / z - 1.0) < SAME
    return depth, stride, seen


def depths_in_view(scene: Scene, view: int, X: F64) -> tuple[F64, F64]:
    """Depths (...) of points X (..., 3) in a view of the courtyard, and its true ones there, NaN outside."""
    (K, R, C), (depth, stride) = scene.cameras, load_fixture_depth(view)
    q = (X - C[view]) @ (K[view] @ R[view]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        at = q[..., :2] / q[..., 2:] / stride
        inside = (q[..., 2] > 0.0) & ((at >= 0.0) & (at <= np.array(depth.shape[::-1]) - 1)).all(axis=-1)
    x, y = np.moveaxis(np.rint(np.where(inside[..., None], at, 0.0)).astype(np.int64), -1, 0)
    return q[..., 2], np.where(inside, depth[y, x], np.nan)


def true_from_maps(maps: Mapping[int, DepthMap], scene: Scene) -> Similarity:
    """Return the similarity that aligns the cameras of depth maps with the true ones."""
    _, _, C = scene.cameras
    views = sorted(maps)
    centres = [-np.linalg.solve(maps[i].P[:, :3], maps[i].P[:, 3]) for i in views]
    return estimate_similarity(np.array(centres), C[views])


def at_true_places(found: DepthMap, shape: tuple[int, int], stride: int, width_px: int) -> tuple[F64, F64]:
    """Depths and deviations of a map at the samples of a true one of this ``shape`` and ``stride``."""
    shrink = found.depth.shape[1] / width_px
    rows, columns = (
        np.clip(np.rint((stride * np.arange(n) + 0.5) * shrink - 0.5), 0, m - 1).astype(np.int64)
        for n, m in zip(shape, found.depth.shape, strict=True)
    )
    place = np.ix_(rows, columns)
    return found.depth[place].astype(np.float64), found.std[place].astype(np.float64)


def judge_against_truth(found: DepthMap, truth: TrueDepth, scale: float) -> Judged:
    """Evaluate one map, ``scale`` true lengths over its own, at pixels visible in two views."""
    depth, stride, seen = truth
    own, std = at_true_places(found, depth.shape, stride, stride * depth.shape[1])
    ours, std = scale * own, scale * std
    known = seen & np.isfinite(ours)
    error = (ours / depth - 1.0)[known]
    return _judged(error, (np.abs(ours - depth) / std)[known], int(seen.sum()))


def judge_against_points(found: DepthMap, model: Reconstruction) -> Judged:
    """Evaluate one map at the valid points with inlier observations in its view."""
    tracks = model.tracks
    mine = (tracks.view_index == found.view) & model.inlier & model.valid[tracks.point_index]
    Xh = model.X[np.unique(tracks.point_index[mine])]
    q = (Xh / Xh[:, 3:]) @ found.P.T
    at = np.rint(q[:, :2] / q[:, 2:]).astype(np.int64)
    inside = np.all((at >= 0) & (at < found.depth.shape[::-1]), axis=1)
    (x, y), z = at[inside].T, q[inside, 2]
    ours = found.depth[y, x].astype(np.float64)
    known = np.isfinite(ours)
    error = (ours / z - 1.0)[known]
    return _judged(error, (np.abs(ours - z) / found.std[y, x])[known], len(z))


def _judged(error: F64, deviations: F64, total: int) -> Judged:
    total = max(total, 1)
    return Judged(error, deviations, len(error) / total, float(np.sum(np.abs(error) < SAME)) / total)


def depth_range(depths: Sequence[F32 | F64]) -> tuple[float, float]:
    """1 and 99 % quantiles of the inverse depths, for :func:`depth_colours`; (0, 1) where none is known."""
    known = np.concatenate([1.0 / d[np.isfinite(d)].astype(np.float64) for d in depths])
    if not len(known):
        return 0.0, 1.0
    low, high = np.quantile(known, [0.01, 0.99])
    return float(low), float(max(high, low + 1e-12))


def depth_colours(depth: F32 | F64, limits: tuple[float, float]) -> U8:
    """(H, W, 3): inverse depth between two ``limits``, near red, far blue, unknown black."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return coloured((1.0 / depth.astype(np.float64) - limits[0]) / (limits[1] - limits[0]))


def coloured(share: F64) -> U8:
    """(..., 3): 0 blue to 1 red, beyond as at the end, unknown black."""
    ends = [[48, 18, 59], [70, 107, 227], [40, 187, 236], [50, 242, 152], [238, 207, 58], [208, 48, 5]]
    stops, known = np.linspace(0.0, 1.0, len(ends)), np.isfinite(share)
    rgb = [np.interp(np.clip(share, 0.0, 1.0), stops, channel) for channel in zip(*ends, strict=True)]
    return np.where(known[..., None], np.stack(rgb, axis=-1), 0.0).astype(np.uint8)


def bad_pixels(disparity: F32, pair: StereoPair, limit_px: float) -> float:
    """Return the percentage of judged pixels off by more than ``limit_px``, holes filled along the row."""
    filled = DisparityMap(disparity, np.zeros_like(disparity), 0.0).filled()
    error = np.abs(filled - pair.truth)[pair.judged]
    return float(100.0 * np.mean(~(error <= limit_px)))
