"""A metric model as any program writes it: poses, perhaps intrinsics and sizes, points and observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from thesisrecon.arrays import F64, I64, U8
from thesisrecon.geometry.similarity import Similarity


@dataclass(frozen=True, eq=False)
class SparseView:
    """One image of a model, in pixels of the original image; (0, 0) is the centre of its top-left pixel."""

    name: str
    R: F64  #: (3, 3) rotation from world to camera
    t: F64  #: (3,) translation -R centre
    K: F64 | None = None  #: (3, 3); None for a trajectory without intrinsics
    size: tuple[int, int] | None = None  #: width, height
    distortion: F64 | None = None  #: (3,) k1, k2, k3, zeros for a pinhole; None if unknown or of another kind
    camera: int = 0  #: number of the camera; views with equal numbers have the same intrinsics

    @property
    def centre(self) -> F64:
        """Camera centre (3,)."""
        return np.asarray(-self.R.T @ self.t)


def _empty(*shape: int) -> F64:
    return np.zeros(shape)


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Cameras of images, points and the observations of the points.

    Parameters
    ----------
    views : sequence of SparseView
        V images with a pose.
    X, colors : ndarray (N, 3), ndarray (N, 3) uint8, optional
        Points and their colours.
    view_index, point_index, xy : ndarray (M,), ndarray (M,), ndarray (M, 2)
        Observations of the points, in pixels of the original images.
    as_stored : bool
        Whether these are pixels of the files as stored, as in COLMAP, and not after EXIF rotation.
    """

    views: Sequence[SparseView]
    X: F64 = field(default_factory=lambda: _empty(0, 3))
    colors: U8 | None = None
    view_index: I64 = field(default_factory=lambda: _empty(0).astype(np.int64))
    point_index: I64 = field(default_factory=lambda: _empty(0).astype(np.int64))
    xy: F64 = field(default_factory=lambda: _empty(0, 2))
    as_stored: bool = False

    @property
    def names(self) -> list[str]:
        """Names of the V images."""
        return [view.name for view in self.views]

    def transformed(self, similarity: Similarity) -> SparseModel:
        """Return the model in another world: y = scale R x + t of its points and camera centres.

        Parameters
        ----------
        similarity : Similarity
            From the world of this model to the new one.

        Returns
        -------
        SparseModel
        """
        rotations = [view.R @ similarity.R.T for view in self.views]
        shifts = [similarity.scale * view.t for view in self.views]
        views = [
            replace(view, R=R, t=t - R @ similarity.t)
            for view, R, t in zip(self.views, rotations, shifts, strict=True)
        ]
        return replace(self, views=views, X=similarity.apply(self.X))


THRESHOLDS = (0.001, 0.003, 0.01, 0.03, 0.1)
"""Distances of points, relative to the size of the scene."""


@dataclass(frozen=True, eq=False)
class PointDistances:
    """Distances between the points of two models, from each point to the nearest one of the other model.

    Parameters
    ----------
    a_to_b, b_to_a : float
        Medians, in units of b.
    thresholds : ndarray (T,)
        Distances: 0.1, 0.3, 1, 3 and 10 % of the median distance of the points of b from their median.
    a_within, b_within : ndarray (T,)
        Fraction of the points of a, and of b, that are nearer to the other model than the thresholds.
    """

    a_to_b: float
    b_to_a: float
    thresholds: F64
    a_within: F64
    b_within: F64


@dataclass(frozen=True, eq=False)
class ModelComparison:
    """Differences of model a from model b, which is the reference; one entry per common camera.

    Parameters
    ----------
    names, names_b : tuple of str
        V common cameras by their names in a, and in b.
    centre_error : ndarray (V,)
        Distances of the centres after ``similarity``, in units of b; NaN without it.
    rotation_error_deg : ndarray (V,)
        Angles after the rotation of the world that fits the rotations best; NaN for a single camera.
    focal_error_rel : ndarray (V,)
        f / f_b - 1 with f the geometric mean of fx and fy; NaN if a model has no intrinsics.
    principal_point_error_px : ndarray (V,)
        Distances of the principal points, in pixels of b.
    similarity : Similarity or None
        Least-squares similarity of the centres (Umeyama) from a to b; None if they do not determine it.
    points : PointDistances or None
        Distances of the point clouds, if both models have points and there is a similarity.
    only_a, only_b : tuple of str
        Cameras that the other model does not have.
    notes : tuple of str
        Quantities that could not be compared, and the reasons.
    a, b : SparseModel
        The models; ``a`` in the world of b if there is a similarity.
    """

    names: tuple[str, ...]
    names_b: tuple[str, ...]
    centre_error: F64
    rotation_error_deg: F64
    focal_error_rel: F64
    principal_point_error_px: F64
    similarity: Similarity | None
    points: PointDistances | None
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    notes: tuple[str, ...]
    a: SparseModel
    b: SparseModel

    @property
    def summary(self) -> dict[str, dict[str, float]]:
        """Median, mean, RMS and maximum of the absolute errors by name, without those that are unknown."""
        found = {}
        for name in ERRORS:
            errors = np.abs(getattr(self, name))
            if np.isfinite(errors).all():
                rms = float(np.sqrt(np.mean(errors**2)))
                mean, largest = float(np.mean(errors)), float(np.max(errors))
                found[name] = {"median": float(np.median(errors)), "mean": mean, "rms": rms, "max": largest}
        return found

    def as_table(self) -> dict[str, Any]:
        """Return all numbers as a table of plain types, arrays and text, for JSON.

        Returns
        -------
        dict
        """
        columns = {"name": self.names, "name_b": self.names_b} | {
            name: getattr(self, name) for name in ERRORS
        }
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
