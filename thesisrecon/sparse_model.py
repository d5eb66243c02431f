"""A metric model as any program writes it: poses, perhaps intrinsics and sizes, points and observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

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
