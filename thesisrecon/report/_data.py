"""Input of the HTML report of one run, and its reprojection residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from thesisrecon.arrays import F32, F64, I64, U8
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import distort, project
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.records import (
    HeldOut,
    Image,
    IntrinsicInterval,
    MetricResult,
    PairChoice,
    Reconstruction,
    StageReport,
    TexturedMesh,
    TwoView,
)


@dataclass(frozen=True)
class ReportData:
    """Content of ``report.html``, for a run that succeeded, stopped early or failed."""

    title: str
    images: tuple[Image, ...]
    reports: tuple[StageReport, ...]
    config_text: str
    summary: Mapping[str, object]
    version: str
    unread: Mapping[str, str] = field(default_factory=dict)  # file name -> reason
    pairs: Sequence[TwoView] = ()
    pair_choice: PairChoice | None = None
    reconstruction: Reconstruction | None = None  # projective; ``metric`` takes precedence
    metric: MetricResult | None = None
    colors: U8 | None = None  # (N, 3) of the metric points, valid or not
    affine: Reconstruction | None = None  # with the same points
    model: TexturedMesh | None = None  # 150,000 faces with 2048 x 2048 texels add about 6 MB
    depth_maps: Mapping[int, F32] = field(default_factory=dict)  # a long side of 400 px is enough
    held_out: HeldOut | None = None
    until: str | None = None  # last stage that was requested, None = all
    failure: StageFailure | None = None

    @property
    def original_intrinsics(self) -> tuple[Mapping[str, IntrinsicInterval], ...]:
        """Intrinsics of every view in original pixels; empty mappings if there are none."""
        if self.metric is None:
            return tuple({} for _ in self.images)
        views = zip(self.metric.intrinsics, self.images, strict=True)
        return tuple(
            {name: in_original_pixels(name, interval, image.scale) for name, interval in view.items()}
            for view, image in views
        )

    @property
    def best_reconstruction(self) -> Reconstruction | None:
        """The metric reconstruction, else the projective one, else None."""
        return self.metric.reconstruction if self.metric is not None else self.reconstruction


def in_original_pixels(name: str, interval: IntrinsicInterval, scale: float) -> IntrinsicInterval:
    """Convert an intrinsic whose name ends in ``_px`` to original pixels, undoing (x + 0.5) scale - 0.5."""
    if not name.endswith("_px"):
        return interval
    shift = 0.5 / scale - 0.5 if name.startswith("principal") else 0.0
    return replace(interval, value=interval.value / scale + shift, std=interval.std / scale)


@dataclass(frozen=True)
class ResidualSummary:
    """Number, median, RMS and 95 % quantile of reprojection distances."""

    count: int
    median_px: float
    rms_px: float
    q95_px: float


def used_observations(reconstruction: Reconstruction) -> I64:
    """Numbers (U,) of the inliers of registered views and valid points."""
    r, tracks = reconstruction, reconstruction.tracks
    used = r.inlier & r.registered[tracks.view_index] & r.valid[tracks.point_index]
    return np.flatnonzero(used).astype(np.int64)


def reprojection_distances(reconstruction: Reconstruction) -> list[F64]:
    """Residual lengths |observed - reprojected| (px) per view, empty if it is not registered.

    Points on the principal plane of a view are left out.
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
    residual = reconstruction.tracks.xy[observations] - _predicted_pixels(reconstruction, i, X)
    distance = np.linalg.norm(residual, axis=1)
    return np.asarray(distance[np.isfinite(distance)], dtype=np.float64)


def _predicted_pixels(reconstruction: Reconstruction, i: int, X: F64) -> F64:
    """Project X (N, 4) into view i, with radial distortion if known; (N, 2)."""
    P = reconstruction.P[i]
    if reconstruction.K is None or reconstruction.distortion is None:
        return project(P, X)
    K = reconstruction.K[i]
    normalized = dehomogenize(X @ np.linalg.solve(K, P).T)
    pixels: F64 = distort(normalized, reconstruction.distortion[i]) @ K[:2, :2].T + K[:2, 2]
    return pixels


def summarize_distances(distances: F64) -> ResidualSummary | None:
    """Summarize distances (N,) in pixels; None without any."""
    if len(distances) == 0:
        return None
    median, q95 = np.quantile(distances, [0.5, 0.95])
    return ResidualSummary(len(distances), float(median), float(np.sqrt(np.mean(distances**2))), float(q95))
