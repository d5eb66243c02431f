"""What the page of one run is made from: one record, filled by whoever ran the stages.

How far the observed points lie from the reprojected ones, per view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F32, F64, I64, U8
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import distort, project
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.records import (
    HeldOut,
    IntrinsicInterval,
    MetricResult,
    PairChoice,
    Reconstruction,
    StageReport,
    TexturedMesh,
    TwoView,
)


@dataclass(frozen=True)
class ReportImage:
    """One view as the page shows it.

    ``rgb`` (H, W, 3) uint8 of any size with the photograph's aspect, or None (a long side of 800 px is
    enough for the drawn pairs; the page shrinks it further); ``size`` (width, height) as the stages had it;
    ``original_size`` that of the file; ``reason`` why a view was refused before it reached the
    reconstruction, empty otherwise.
    """

    name: str
    size: tuple[int, int]
    original_size: tuple[int, int]
    rgb: U8 | None = None
    reason: str = ""

    @property
    def scale(self) -> float:
        """Working pixels per original pixel."""
        return max(self.size) / max(self.original_size)


@dataclass(frozen=True)
class ReportData:
    """Everything ``report.html`` says, for a run that ended well, ended early or failed.

    Parameters
    ----------
    title : the name of the run, usually that of the folder of photographs.
    photographs : the views; a view's number is its place here (as in every other record).
    reports : what each stage that ran did, in order.
    config_text : the whole configuration as TOML.
    summary : the contents of ``summary.json``; shown as it is.
    version : of thesisrecon.
    unread : (name, reason) of the files that are no photographs and hence no views.
    pairs : the pairs of views whose epipolar geometry was estimated, accepted or not.
    pair_choice : how these pairs were chosen, None where the caller does not say.
    reconstruction : the projective reconstruction, where the run has one; ``metric`` goes before it.
    metric : the result of the metric stage.
    colours : (N, 3) uint8 of the points of the metric reconstruction (valid or not), or None.
    affine : the affine stratum on the way to it, of the same points.
    model : the surface of ``metric``, in its coordinates, as the page carries it: best made ``coarser`` to
        150,000 faces with a texture of at most 2048 x 2048 texels (the page then grows by about 6 MB). With
        a texture, colours of its vertices, or neither; None or without faces = the page has no model.
    depth_pictures : view -> depth (H, W) float32, NaN where unknown, in units of the scene; any size (a long
        side of 400 px is enough), of as many views as have one.
    held_out : a photograph beside the model as its camera sees it, or None.
    until : the stage the user asked to end with, None where all were asked for.
    failure : why the run could not go on, None where it did.

    Raises
    ------
    ValueError
        where two of these speak of different numbers of views or points.
    """

    title: str
    photographs: tuple[ReportImage, ...]
    reports: tuple[StageReport, ...]
    config_text: str
    summary: Mapping[str, object]
    version: str
    unread: tuple[tuple[str, str], ...] = ()
    pairs: Sequence[TwoView] = field(default=())
    pair_choice: PairChoice | None = None
    reconstruction: Reconstruction | None = None
    metric: MetricResult | None = None
    colours: U8 | None = None
    affine: Reconstruction | None = None
    model: TexturedMesh | None = None
    depth_pictures: Mapping[int, F32] = field(default_factory=dict)
    held_out: HeldOut | None = None
    until: str | None = None
    failure: StageFailure | None = None

    def __post_init__(self) -> None:
        views = len(self.photographs)
        best = self.best_reconstruction
        if best is not None and len(best.registered) != views:
            raise ValueError(
                f"one camera per photograph: got {len(best.registered)} cameras, {views} photographs"
            )
        if self.metric is not None and len(self.metric.intrinsics) != views:
            raise ValueError(
                f"intrinsics per photograph: got {len(self.metric.intrinsics)} for {views} photographs"
            )
        if any(not (0 <= pair.i < views and 0 <= pair.j < views) for pair in self.pairs):
            raise ValueError(f"pairs must name views below {views}, the number of photographs")
        if self.affine is not None and self.metric is not None:
            points, own = len(self.metric.reconstruction.X), len(self.affine.X)
            if own != points:
                raise ValueError(f"affine must have the {points} points of the metric stratum; got {own}")
        if self.colours is not None and self.metric is not None:
            points = len(self.metric.reconstruction.X)
            if self.colours.shape != (points, 3):
                raise ValueError(f"colours must be ({points}, 3), one per point; got {self.colours.shape}")

        if self.model is not None and not (self.metric and self.metric.reconstruction.registered.any()):
            raise ValueError("a model needs the metric reconstruction that it was made from")
        if any(not 0 <= view < views for view in self.depth_pictures):
            raise ValueError(f"depth_pictures must name views below {views}, the number of photographs")

    @property
    def original_intrinsics(self) -> tuple[Mapping[str, IntrinsicInterval], ...]:
        """Intrinsics of every view in pixels of the original file; empty mappings where there are none."""
        if self.metric is None:
            return tuple({} for _ in self.photographs)
        views = zip(self.metric.intrinsics, self.photographs, strict=True)
        return tuple(
            {name: _in_original_pixels(name, interval, photograph.scale) for name, interval in view.items()}
            for view, photograph in views
        )

    @property
    def best_reconstruction(self) -> Reconstruction | None:
        """The metric reconstruction, else the projective one, else None."""
        return self.metric.reconstruction if self.metric is not None else self.reconstruction


def _in_original_pixels(name: str, interval: IntrinsicInterval, scale: float) -> IntrinsicInterval:
    """Undo the resizing (x + 0.5) scale - 0.5 of an intrinsic in pixels; pure numbers stay."""
    if not name.endswith("_px"):
        return interval
    shift = 0.5 / scale - 0.5 if name.startswith("principal") else 0.0
    return replace(interval, value=interval.value / scale + shift, std=interval.std / scale)


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
    if reconstruction.K is None or reconstruction.distortion is None:
        return project(P, X)
    K = reconstruction.K[i]
    normalized = dehomogenize(X @ np.linalg.solve(K, P).T)
    pixels: F64 = distort(normalized, reconstruction.distortion[i]) @ K[:2, :2].T + K[:2, 2]
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
