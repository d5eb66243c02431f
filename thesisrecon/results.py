"""Results in pixels of the original images: of a run, models of any program, comparisons of models."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy

from thesisrecon import records
from thesisrecon.arrays import F64, I64, U8, Record, cut_text, number, rows_of_views
from thesisrecon.camera import POSE_STDS, Camera, camera_of_row

SUMMARY = "summary.json"


class SeenPoints(NamedTuple):
    """Observations of one image: positions (M, 2) in original pixels, and rows (M,) of ``result.points``."""

    xy: F64
    point: I64


def in_original_pixels(
    name: str, interval: records.IntrinsicInterval, scale: float
) -> records.IntrinsicInterval:
    """Convert an intrinsic, if its name ends in ``_px``, from working to original pixels."""
    if not name.endswith("_px"):
        return interval
    shift = 0.5 / scale - 0.5 if name.startswith("principal") else 0.0
    return replace(interval, value=interval.value / scale + shift, std=interval.std / scale)


def pose_deviations(metric: records.MetricResult, i: int) -> dict[str, float]:
    """Return the standard deviations of a pose as in :attr:`thesisrecon.Camera.std`, none if unknown."""
    if metric.pose_std is None or not np.isfinite(metric.pose_std[i]).all():
        return {}
    rotation, centre = np.degrees(metric.pose_std[i, :3]).tolist(), metric.pose_std[i, 3:].tolist()
    return dict(zip(POSE_STDS, [*rotation, *centre], strict=True))


def _number_of(image: str | int, images: tuple[records.Image, ...]) -> int:
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

    def __init__(
        self, images: tuple[records.Image, ...], metric: records.MetricResult, *, as_stored: bool
    ) -> None:
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
        pose = one.original_from_working @ r.K[i], Rt[:, :3], Rt[:, 3]
        return camera_of_row(pose, one.original_size, r.distortion[i], std=std, as_stored=self._as_stored)

    def __iter__(self) -> Iterator[str]:
        registered = self._metric.reconstruction.registered
        return (image.name for image, there in zip(self._images, registered, strict=True) if there)

    def __len__(self) -> int:
        return int(self._metric.reconstruction.registered.sum())

    def __repr__(self) -> str:
        return cut_text(f"Cameras({list(self)})")


@dataclass(frozen=True, eq=False)
class RunResult(Record):
    """All results of one run; None or empty beyond the last stage.

    ``cameras``, ``points``, ``observations``, ``summary`` and all files are in pixels of the original images;
    the records of the stages are in pixels at working size.
    """

    out: Path | None  #: output folder, None if the run had none
    images: tuple[records.Image, ...]  #: the V views at working size
    unread: Mapping[str, str]  #: file name -> reason of unreadable images
    features: tuple[records.Features, ...]
    pairs: tuple[records.TwoView, ...]  #: all matched pairs, accepted or not
    groups: I64  #: (V,) camera number of each view
    settings: Mapping[str, Mapping[str, Any]]  #: stage -> field -> value
    pair_choice: records.PairChoice | None = None
    tracks: records.Tracks | None = None
    projective: records.Reconstruction | None = None
    calibration: records.SelfCalibration | None = None
    metric: records.MetricResult | None = None
    #: undistorted images and, below, their depth maps; of many, some are made or read when they are used
    views: Sequence[records.PinholeView] = ()
    depth_maps: Sequence[records.DepthMap] = ()
    mesh: records.TexturedMesh | None = None
    held_out: records.HeldOut | None = None
    reports: tuple[records.StageReport, ...] = ()  #: one per stage
    warnings: tuple[str, ...] = ()  #: of all stages
    summary: Mapping[str, Any] = field(default_factory=dict)  #: content of ``summary.json``
    failure: str = ""  #: the failure that ended the run
    #: results in ``group-2`` and so on: models of other images, each in its own world
    further_models: tuple[RunResult, ...] = ()

    def __repr__(self) -> str:
        # That of a dataclass prints the pixels and features of all images.
        best = self.best_reconstruction
        counts = {"images": len(self.images), "registered": 0 if best is None else int(best.registered.sum())}
        counts["points"] = 0 if best is None else int(best.valid.sum())
        text = ", ".join(f"{name}={count}" for name, count in counts.items())
        return f"RunResult(out={str(self.out) if self.out else None!r}, {text}, failure={self.failure!r})"

    @property
    def best_reconstruction(self) -> records.Reconstruction | None:
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

    def _metric_result(self, what: str) -> records.MetricResult:
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
    def reconstruction(self) -> records.Reconstruction:
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

    def add(self, images: Any, **options: Any) -> RunResult:
        """Register more images into the model; see :func:`thesisrecon.add_images`.

        Parameters
        ----------
        images, **options
            As of :func:`thesisrecon.add_images`.

        Returns
        -------
        RunResult
            Of all images.
        """
        # The call is above the records.
        import thesisrecon

        return thesisrecon.add_images(self, images, **options)

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


@dataclass(frozen=True, eq=False)
class SparseView(Record):
    """One image of a model, in pixels of the original image; (0, 0) is the centre of its top-left pixel."""

    name: str
    R: F64  #: (3, 3) rotation from world to camera
    t: F64  #: (3,) translation -R centre
    K: F64 | None = None  #: (3, 3); None for a trajectory without intrinsics
    size: tuple[int, int] | None = None  #: width, height
    distortion: F64 | None = (
        None  #: row of the lens: (3,) k1, k2, k3, zeros for a pinhole, or (12,); None if unknown
    )
    camera: int = 0  #: number of the camera; views with equal numbers have the same intrinsics
    std: Mapping[str, float] | None = None  #: as in :attr:`thesisrecon.Camera.std`; None if not stated

    @property
    def centre(self) -> F64:
        """Camera centre (3,)."""
        return np.asarray(-self.R.T @ self.t)

    @property
    def intrinsics(self) -> tuple[F64, tuple[int, int], F64]:
        """K, size and distortion of a view in which they are known."""
        assert self.K is not None
        assert self.size is not None
        assert self.distortion is not None
        return self.K, self.size, self.distortion


@dataclass(frozen=True, eq=False)
class SparseModel(Record):
    """Cameras of images, points and the observations of the points, in pixels of the original images."""

    views: Sequence[SparseView]  #: V images with a pose
    X: F64 = field(default_factory=lambda: np.zeros((0, 3)))
    colors: U8 | None = None  #: (N, 3) of the points
    view_index: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    point_index: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    xy: F64 = field(default_factory=lambda: np.zeros((0, 2)))
    as_stored: bool = False  #: pixels are those of the files as stored, as in COLMAP, without EXIF rotation

    @property
    def names(self) -> list[str]:
        """Names of the V images."""
        return [view.name for view in self.views]

    @property
    def point_colors(self) -> U8:
        """Colours (N, 3) of the points; mid-grey if they are not known."""
        return np.full((len(self.X), 3), 128, np.uint8) if self.colors is None else self.colors

    def transformed(self, similarity: records.Similarity) -> SparseModel:
        """Return the model in another world: y = scale R x + t of its points and camera centres."""
        views = []
        for view in self.views:
            R = view.R @ similarity.R.T
            t = similarity.scale * view.t - R @ similarity.t
            # Deviations of centres along other axes need covariances.
            std = {k: v for k, v in (view.std or {}).items() if not k.startswith("centre")} or None
            views.append(replace(view, R=R, t=t, std=std))
        return replace(self, views=views, X=similarity.apply(self.X))


THRESHOLDS = (0.001, 0.003, 0.01, 0.03, 0.1)  # Distances of points, relative to the size of the scene


@dataclass(frozen=True, eq=False)
class PointDistances(Record):
    """Distances between the points of two models, from each point to the nearest one of the other model."""

    a_to_b: float  #: medians, in units of b
    b_to_a: float
    #: 0.1, 0.3, 1, 3 and 10 % of the median distance of the points of b from their median
    thresholds: F64
    a_within: F64  #: fraction of the points of a, and of b, that are nearer to the other model than these
    b_within: F64


@dataclass(frozen=True, eq=False)
class RelativeErrors(Record):
    """Errors of the motions between cameras of a trajectory."""

    pairs: I64  #: (M, 2) first and last camera of each motion, as numbers in ``names``
    translation: F64  #: (M,) in units of b
    rotation_deg: F64  #: (M,)


def _poses(views: Sequence[SparseView]) -> F64:
    """Camera-to-world poses (V, 4, 4)."""
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    poses[:, :3, :3] = [view.R.T for view in views]
    poses[:, :3, 3] = [view.centre for view in views]
    return poses


@dataclass(frozen=True, eq=False)
class ModelComparison(Record):
    """Differences of model a from model b, which is the reference; one entry per common camera."""

    names: tuple[str, ...]  #: V common cameras by their names in a, and in b
    names_b: tuple[str, ...]
    centre_error: F64  #: (V,) distances of the centres after ``similarity``, in units of b; NaN without it
    #: (V,) angles after the rotation of the world that fits the rotations best; NaN for a single camera
    rotation_error_deg: F64
    focal_error_rel: F64  #: (V,) f / f_b - 1, f the geometric mean of fx and fy; NaN without intrinsics
    principal_point_error_px: F64  #: (V,) distances of the principal points, in pixels of b
    similarity: (
        records.Similarity | None
    )  #: least squares of the centres (Umeyama), a to b; None if undetermined
    points: PointDistances | None  #: if both models have points and there is a similarity
    only_a: tuple[str, ...]  #: cameras that the other model does not have
    only_b: tuple[str, ...]
    notes: tuple[str, ...]  #: quantities that could not be compared, and the reasons
    a: SparseModel  #: in the world of b if there is a similarity
    b: SparseModel

    @property
    def summary(self) -> dict[str, dict[str, float]]:
        """Median, mean, RMS and maximum of the absolute errors by name, without those that are unknown."""
        found = {}
        for name in ERRORS:
            errors = np.abs(getattr(self, name))
            if np.isfinite(errors).all():
                values = np.median(errors), np.mean(errors), np.sqrt(np.mean(errors**2)), np.max(errors)
                found[name] = dict(zip(("median", "mean", "rms", "max"), map(float, values), strict=True))
        return found

    def relative_errors(self, distance: float) -> RelativeErrors:
        """Return the errors of the motions over a distance, without a common frame (Kümmerle et al. 2009).

        Parameters
        ----------
        distance : float
            Length of the path of b, in units of b, between the two cameras of a motion: the cameras are
            visited in the order of b, and a motion ends, and the next begins, when its path is this long.

        Returns
        -------
        RelativeErrors
            Errors of E = (B_i^-1 B_j)^-1 (A_i^-1 A_j) with camera-to-world poses A, aligned, and B.

        Raises
        ------
        ValueError
            If the distance is not positive, the path is shorter, or the models could not be aligned.
        """
        if not 0.0 < number("relative_errors", "distance", distance) < np.inf:
            raise ValueError(f"relative_errors needs a finite distance above 0; got {distance:g}")
        if self.similarity is None:
            raise ValueError("relative_errors needs models that could be aligned; see notes")
        of_a, of_b = ({view.name: view for view in model.views} for model in (self.a, self.b))
        place = {name: i for i, name in enumerate(of_b)}
        order = np.argsort([place[name] for name in self.names_b])
        views = [of_a[self.names[k]] for k in order], [of_b[self.names_b[k]] for k in order]
        (A, B), path = (_poses(some) for some in views), 0.0
        ends, steps = [0], np.linalg.norm(np.diff(B[:, :3, 3], axis=0), axis=1)
        for j, step in enumerate(steps.tolist(), start=1):
            path += step
            if path >= distance:
                ends.append(j)
                path = 0.0
        if len(ends) < 2:
            raise ValueError(f"the path of {steps.sum():.4g} is shorter than the distance {distance:g}")
        first, last = np.array(ends[:-1]), np.array(ends[1:])
        motion, motion_b = np.linalg.solve(A[first], A[last]), np.linalg.solve(B[first], B[last])
        E = np.linalg.solve(motion_b, motion)
        angle = scipy.spatial.transform.Rotation.from_matrix(E[:, :3, :3]).magnitude()
        pairs = np.stack([order[first], order[last]], axis=1)
        return RelativeErrors(pairs, np.linalg.norm(E[:, :3, 3], axis=1), np.degrees(angle))

    def as_table(self) -> dict[str, Any]:
        """Return all numbers as a table of plain types, arrays and text, for JSON.

        Returns
        -------
        dict
        """
        columns = {"name": self.names, "name_b": self.names_b}
        columns |= {name: getattr(self, name) for name in ERRORS}
        rows = zip(*columns.values(), strict=True)
        return {
            "cameras": [dict(zip(columns, row, strict=True)) for row in rows],
            "summary": self.summary,
            "similarity": None if self.similarity is None else vars(self.similarity),
            "points": None if self.points is None else vars(self.points),
            "only_a": self.only_a,
            "only_b": self.only_b,
            "notes": self.notes,
        }


ERRORS = ("centre_error", "rotation_error_deg", "focal_error_rel", "principal_point_error_px")
"""Errors of each camera in a comparison."""
