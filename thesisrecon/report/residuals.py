"""How far the observed points lie from the reprojected ones, per view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.camera import distort, project
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.types import F64, I64, Reconstruction

BINS = 28
# The common axis of the histograms ends at one of these, so that its numbers read well.
ROUND_LIMITS_PX = (0.1, 0.2, 0.3, 0.5, 0.8, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 10.0, 15.0, 20.0, 50.0, 100.0)


@dataclass(frozen=True)
class ResidualSummary:
    """Distances between observed and reprojected points: how many, median, RMS and 95 % point in px."""

    count: int
    median_px: float
    rms_px: float
    q95_px: float


def used_observations(reconstruction: Reconstruction) -> I64:
    """Numbers k of the observations explained: inliers of a registered view and a valid point."""
    tracks = reconstruction.tracks
    used = (
        reconstruction.inlier
        & reconstruction.registered[tracks.view_index]
        & reconstruction.valid[tracks.point_index]
    )
    return np.flatnonzero(used).astype(np.int64)


def reprojection_distances(reconstruction: Reconstruction) -> list[F64]:
    """Residual lengths |observed - reprojected| (px) of every view, in the reconstruction's own stratum.

    One array per view, empty where the view is not registered. A point on the focal plane of the view has no
    image and is left out.
    """
    used = used_observations(reconstruction)
    views = reconstruction.tracks.view_index[used]
    return [
        _distances_in_view(reconstruction, i, used[views == i]) for i in range(len(reconstruction.registered))
    ]


def _distances_in_view(reconstruction: Reconstruction, i: int, observations: I64) -> F64:
    if len(observations) == 0:
        return np.zeros(0)
    X = reconstruction.X[reconstruction.tracks.point_index[observations]]
    residual = reconstruction.tracks.xy[observations] - predicted_pixels(reconstruction, i, X)
    distance = np.linalg.norm(residual, axis=1)
    return np.asarray(distance[np.isfinite(distance)], dtype=np.float64)


def predicted_pixels(reconstruction: Reconstruction, i: int, X: F64) -> F64:
    """Pixels of homogeneous points X (N, 4) in view i, radial distortion included where known; (N, 2)."""
    P = reconstruction.P[i]
    if reconstruction.K is None or reconstruction.radial is None:
        return project(P, X)
    K = reconstruction.K[i]
    normalized = dehomogenize(X @ np.linalg.solve(K, P).T)
    pixels: F64 = distort(normalized, reconstruction.radial[i]) @ K[:2, :2].T + K[:2, 2]
    return pixels


def summarize_distances(distances: F64) -> ResidualSummary | None:
    """Middle, RMS and 95 % point of (N,) distances in px; None where there are none."""
    if len(distances) == 0:
        return None
    median, q95 = np.quantile(distances, [0.5, 0.95])
    return ResidualSummary(len(distances), float(median), float(np.sqrt(np.mean(distances**2))), float(q95))


def common_limit_px(distances: F64) -> float:
    """A round upper end (px) of the histograms that holds 98 % of all distances (N,)."""
    needed = float(np.quantile(distances, 0.98)) if len(distances) else 1.0
    return next((limit for limit in ROUND_LIMITS_PX if limit >= needed), float(np.ceil(needed)))


def histogram_shares(distances: F64, limit_px: float) -> NDArray[np.float64]:
    """Share of the (N,) distances in each of ``BINS`` bins of [0, limit_px]; the last holds the rest too."""
    counts, _ = np.histogram(np.minimum(distances, limit_px), bins=BINS, range=(0.0, limit_px))
    return counts / max(len(distances), 1)
