"""The result of a run: cameras, points and observations in pixels of the original images, and all stages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thesisrecon.arrays import F64, I64, rows_of_views
from thesisrecon.camera import Camera
from thesisrecon.records import (
    DepthMap,
    Features,
    HeldOut,
    Image,
    IntrinsicInterval,
    MetricResult,
    PairChoice,
    PinholeView,
    Reconstruction,
    SelfCalibration,
    StageReport,
    TexturedMesh,
    Tracks,
    TwoView,
)

SUMMARY = "summary.json"
POSE_NAMES = ("rotation_x_deg", "rotation_y_deg", "rotation_z_deg", "centre_x", "centre_y", "centre_z")
"""Names of the standard deviations of a pose in :attr:`thesisrecon.Camera.std`."""


class SeenPoints(NamedTuple):
    """Observations of one image: positions (M, 2) in original pixels, and rows (M,) of ``result.points``."""

    xy: F64
    point: I64


def in_original_pixels(name: str, interval: IntrinsicInterval, scale: float) -> IntrinsicInterval:
    """Convert an intrinsic from working to original pixels, undoing (x + 0.5) scale - 0.5.

    Parameters
    ----------
    name, interval, scale : str, IntrinsicInterval, float
        Name of the intrinsic, which is converted only if it ends in ``_px``; its value; and working size over
        original size.

    Returns
    -------
    IntrinsicInterval
    """
    if not name.endswith("_px"):
        return interval
    shift = 0.5 / scale - 0.5 if name.startswith("principal") else 0.0
    return replace(interval, value=interval.value / scale + shift, std=interval.std / scale)


def pose_deviations(metric: MetricResult, i: int) -> dict[str, float]:
    """Return the standard deviations of a pose as in :attr:`thesisrecon.Camera.std`.

    Parameters
    ----------
    metric, i : MetricResult, int
        Result of the metric stage, and the number of the image.

    Returns
    -------
    dict of str to float
        Empty if unknown.
    """
    if metric.pose_std is None or not np.isfinite(metric.pose_std[i]).all():
        return {}
    values = np.concatenate([np.degrees(metric.pose_std[i, :3]), metric.pose_std[i, 3:]])
    return dict(zip(POSE_NAMES, values.tolist(), strict=True))


def _number_of(image: str | int, images: tuple[Image, ...]) -> int:
    """The number of an image by its name or number, which may count from the end; ``KeyError`` if none."""
    if isinstance(image, str):
        numbers = [i for i, one in enumerate(images) if one.name == image]
        if not numbers:
            raise KeyError(f"there is no image {image!r}; the first of {len(images)} is {images[0].name!r}")
        return numbers[0]
    if not -len(images) <= int(image) < len(images):
        raise KeyError(f"there is no image {image}; {len(images)} were read")
    return int(image) % len(images)


class Cameras(Mapping[str, Camera]):
    """The registered cameras by image name, or by the number of the image among all that were read."""

    def __init__(self, images: tuple[Image, ...], metric: MetricResult, *, as_stored: bool) -> None:
        self._images, self._metric, self._as_stored = images, metric, as_stored

    def __getitem__(self, image: str | int) -> Camera:
        i = _number_of(image, self._images)
        r = self._metric.reconstruction
        if not r.registered[i]:
            raise KeyError(f"image {self._images[i].name!r} is not registered: {r.reasons[i]}")
        assert r.K is not None
        assert r.distortion is not None
        one, intrinsics = self._images[i], self._metric.intrinsics[i]
        Rt = np.linalg.solve(r.K[i], r.P[i])
        std = {name: in_original_pixels(name, value, one.scale).std for name, value in intrinsics.items()}
        std |= pose_deviations(self._metric, i)
        K = one.original_from_working @ r.K[i]
        lens = r.distortion[i]
        return Camera(K, Rt[:, :3], Rt[:, 3], one.original_size, lens, std, as_stored=self._as_stored)

    def __iter__(self) -> Iterator[str]:
        registered = self._metric.reconstruction.registered
        return (image.name for image, there in zip(self._images, registered, strict=True) if there)

    def __len__(self) -> int:
        return int(self._metric.reconstruction.registered.sum())

    def __repr__(self) -> str:
        return f"Cameras({list(self)})"


@dataclass(frozen=True)
class RunResult:
    """All results of one run; None or empty beyond the last stage.

    ``cameras``, ``points``, ``observations``, ``summary`` and all files are in pixels of the original images;
    the records of the stages are in pixels at working size.

    Parameters
    ----------
    out, settings : Path, mapping
        Output folder (None if the run had none), and the settings: stage -> field -> value.
    images, groups : tuple of Image, ndarray (V,) of int
        The V views at working size, and the camera number of each.
    unread : mapping
        File name -> reason of unreadable images.
    features, pair_choice, pairs, tracks, projective, calibration, metric, mesh, held_out
        Results of the stages; ``pairs`` are all matched ones, accepted or not.
    views, depth_maps : sequence of PinholeView, sequence of DepthMap
        Undistorted images and their depth maps; of many, some are undistorted, or read from ``out``, when
        they are used.
    reports, warnings, failure : tuple of StageReport, tuple of str, str
        One report per stage, all warnings, and the failure that ended the run, empty otherwise.
    summary : mapping
        Content of ``summary.json``.
    """

    out: Path | None
    images: tuple[Image, ...]
    unread: Mapping[str, str]
    features: tuple[Features, ...]
    pairs: tuple[TwoView, ...]
    groups: I64
    settings: Mapping[str, Mapping[str, Any]]
    pair_choice: PairChoice | None = None
    tracks: Tracks | None = None
    projective: Reconstruction | None = None
    calibration: SelfCalibration | None = None
    metric: MetricResult | None = None
    views: Sequence[PinholeView] = ()
    depth_maps: Sequence[DepthMap] = ()
    mesh: TexturedMesh | None = None
    held_out: HeldOut | None = None
    reports: tuple[StageReport, ...] = ()
    warnings: tuple[str, ...] = ()
    summary: Mapping[str, Any] = field(default_factory=dict)
    failure: str = ""

    def __repr__(self) -> str:
        # That of a dataclass prints the pixels and features of all images.
        best = self.best_reconstruction
        counts = {"images": len(self.images), "registered": 0 if best is None else int(best.registered.sum())}
        counts["points"] = 0 if best is None else int(best.valid.sum())
        text = ", ".join(f"{name}={count}" for name, count in counts.items())
        return f"RunResult(out={str(self.out) if self.out else None!r}, {text}, failure={self.failure!r})"

    @property
    def best_reconstruction(self) -> Reconstruction | None:
        """The metric reconstruction, else the projective one, else None."""
        return self.metric.reconstruction if self.metric is not None else self.projective

    @property
    def refused(self) -> dict[str, str]:
        """File name -> reason of every image without a camera: unreadable or not registered."""
        best = self.best_reconstruction
        if best is None:
            return dict(self.unread)
        views = zip(self.images, best.registered, best.reasons, strict=True)
        reasons = {image.name: reason or "no reason was recorded" for image, in_, reason in views if not in_}
        return {**self.unread, **reasons}

    def _metric_result(self, what: str) -> MetricResult:
        if self.metric is None:
            stage = "the run ended before the metric stage" if not self.failure else self.failure
            raise AttributeError(f"there are no {what}: {stage}")
        return self.metric

    @property
    def cameras(self) -> Cameras:
        """Registered cameras by image name or number, in original pixels, with standard deviations."""
        as_stored = self.summary.get("as_stored") is True
        return Cameras(self.images, self._metric_result("cameras"), as_stored=as_stored)

    @property
    def points(self) -> F64:
        """The valid points (N, 3) of the metric reconstruction."""
        r = self._metric_result("points").reconstruction
        X = r.X[r.valid]
        return np.asarray(X[:, :3] / X[:, 3:])

    @property
    def reconstruction(self) -> Reconstruction:
        """The metric reconstruction in original pixels; ``metric.reconstruction`` is in working ones."""
        r = self._metric_result("cameras").reconstruction
        assert r.K is not None
        scale = np.array([image.scale for image in self.images])
        to_original = np.array([image.original_from_working for image in self.images])
        view = r.tracks.view_index
        xy = (r.tracks.xy + 0.5) / scale[view][:, None] - 0.5
        return replace(
            r,
            P=to_original @ r.P,
            K=np.where(r.registered[:, None, None], to_original @ r.K, 0.0),
            tracks=replace(r.tracks, xy=xy),
            sizes=np.array([image.original_size for image in self.images], dtype=np.int64),
            sigma_px=r.sigma_px / float(np.median(scale)),
        )

    @cached_property
    def _seen(self) -> list[I64]:
        """Inlier observations of each image."""
        r = self._metric_result("observations").reconstruction
        used = np.flatnonzero(r.used)
        return [used[k] for k in rows_of_views(r.tracks.view_index[used], len(self.images))]

    @cached_property
    def _row(self) -> I64:
        """The row of each valid point in ``points``."""
        return np.cumsum(self._metric_result("observations").reconstruction.valid) - 1

    def observations(self, image: str | int) -> SeenPoints:
        """Return the inlier observations of one image.

        Parameters
        ----------
        image : str or int
            Name of the image, or its number in ``images``; ``KeyError`` if there is none.

        Returns
        -------
        SeenPoints
            ``xy`` (M, 2) in original pixels and ``point`` (M,), the rows of ``points``.
        """
        r = self._metric_result("observations").reconstruction
        i = _number_of(image, self.images)
        seen = self._seen[i]
        xy = (r.tracks.xy[seen] + 0.5) / self.images[i].scale - 0.5
        return SeenPoints(xy, self._row[r.tracks.point_index[seen]])
