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
    """One view in the report.

    Parameters
    ----------
    name : str
        File name.
    size, original_size : tuple of int
        (width, height) at working size and of the file.
    rgb : ndarray (H, W, 3) uint8, optional
        Of any size with this aspect ratio; a long side of 800 px is enough.
    reason : str
        Why the view was refused before the reconstruction, else empty.
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
    """Content of ``report.html``, for a run that succeeded, stopped early or failed.

    Parameters
    ----------
    title : str
        Name of the run, usually of its image folder.
    images : tuple of ReportImage
        The V views.
    reports : tuple of StageReport
        One per stage, in order.
    config_text : str
        The configuration as TOML.
    summary : mapping
        Content of ``summary.json``.
    version : str
        Version of thesisrecon.
    unread : tuple of (name, reason)
        Files that are not views.
    pairs : sequence of TwoView
        Matched pairs, accepted or not.
    pair_choice : PairChoice, optional
        How the pairs were selected.
    reconstruction : Reconstruction, optional
        Projective reconstruction; ``metric`` takes precedence.
    metric : MetricResult, optional
        Result of the metric stage.
    colors : ndarray (N, 3) uint8, optional
        Colours of the metric points, valid or not.
    affine : Reconstruction, optional
        Affine stratum with the same points.
    model : TexturedMesh, optional
        Surface in the coordinates of ``metric``; 150,000 faces with 2048 x 2048 texels add about 6 MB.
    depth_maps : mapping
        View -> depth (H, W) float32, NaN = unknown; a long side of 400 px is enough.
    held_out : HeldOut, optional
        Comparison of the model with an image that did not texture it.
    until : str, optional
        Last stage that was requested, None = all.
    failure : StageFailure, optional
        Why the run failed.

    Raises
    ------
    ValueError
        If the numbers of views or points differ.
    """

    title: str
    images: tuple[ReportImage, ...]
    reports: tuple[StageReport, ...]
    config_text: str
    summary: Mapping[str, object]
    version: str
    unread: tuple[tuple[str, str], ...] = ()
    pairs: Sequence[TwoView] = field(default=())
    pair_choice: PairChoice | None = None
    reconstruction: Reconstruction | None = None
    metric: MetricResult | None = None
    colors: U8 | None = None
    affine: Reconstruction | None = None
    model: TexturedMesh | None = None
    depth_maps: Mapping[int, F32] = field(default_factory=dict)
    held_out: HeldOut | None = None
    until: str | None = None
    failure: StageFailure | None = None

    def __post_init__(self) -> None:
        views = len(self.images)
        best = self.best_reconstruction
        if best is not None and len(best.registered) != views:
            raise ValueError(
                f"one camera per image is needed; got {len(best.registered)} cameras, {views} images"
            )
        if self.metric is not None and len(self.metric.intrinsics) != views:
            raise ValueError(
                f"intrinsics of each image are needed; got {len(self.metric.intrinsics)} for {views} images"
            )
        if any(not (0 <= pair.i < views and 0 <= pair.j < views) for pair in self.pairs):
            raise ValueError(f"pairs must refer to views below {views}, the number of images")
        if self.affine is not None and self.metric is not None:
            points, own = len(self.metric.reconstruction.X), len(self.affine.X)
            if own != points:
                raise ValueError(f"affine must have the {points} points of the metric stratum; got {own}")
        if self.colors is not None and self.metric is not None:
            points = len(self.metric.reconstruction.X)
            if self.colors.shape != (points, 3):
                raise ValueError(f"colors must be ({points}, 3), one per point; got {self.colors.shape}")

        if self.model is not None and not (self.metric and self.metric.reconstruction.registered.any()):
            raise ValueError("a model needs its metric reconstruction")
        if any(not 0 <= view < views for view in self.depth_maps):
            raise ValueError(f"depth_maps must refer to views below {views}, the number of images")

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
    """Convert an intrinsic from working to original pixels, undoing (x + 0.5) scale - 0.5.

    Parameters
    ----------
    name : str
        Its key; only names that end in ``_px`` are converted.
    interval : IntrinsicInterval
        Value and standard deviation at working size.
    scale : float
        Working over original size.

    Returns
    -------
    IntrinsicInterval
        In original pixels.
    """
    if not name.endswith("_px"):
        return interval
    shift = 0.5 / scale - 0.5 if name.startswith("principal") else 0.0
    return replace(interval, value=interval.value / scale + shift, std=interval.std / scale)


@dataclass(frozen=True)
class ResidualSummary:
    """Statistics of reprojection distances.

    Parameters
    ----------
    count : int
        Number of observations.
    median_px, rms_px, q95_px : float
        Median, RMS and 95 % quantile (px).
    """

    count: int
    median_px: float
    rms_px: float
    q95_px: float


def used_observations(reconstruction: Reconstruction) -> I64:
    """Return the observations that a reconstruction explains.

    Parameters
    ----------
    reconstruction : Reconstruction
        Of any stratum.

    Returns
    -------
    ndarray (U,)
        Numbers of the inliers of registered views and valid points.
    """
    tracks = reconstruction.tracks
    used = (
        reconstruction.inlier
        & reconstruction.registered[tracks.view_index]
        & reconstruction.valid[tracks.point_index]
    )
    return np.flatnonzero(used).astype(np.int64)


def reprojection_distances(reconstruction: Reconstruction) -> list[F64]:
    """Compute the residual lengths |observed - reprojected| of every view.

    Parameters
    ----------
    reconstruction : Reconstruction
        Of any stratum.

    Returns
    -------
    list of ndarray
        Distances (px) per view, empty if it is not registered; points on its principal plane are left out.
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
    """Summarize distances.

    Parameters
    ----------
    distances : ndarray (N,)
        Pixels.

    Returns
    -------
    ResidualSummary or None
        None without distances.
    """
    if len(distances) == 0:
        return None
    median, q95 = np.quantile(distances, [0.5, 0.95])
    return ResidualSummary(len(distances), float(median), float(np.sqrt(np.mean(distances**2))), float(q95))
