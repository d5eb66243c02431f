"""What every estimator of F does first and last: refuse what cannot work, choose a frame, leave it again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.two_view import unit_norm

COLLINEAR = 1e-9
"""Spread across the longest direction, relative to it, below which points count as lying on one line."""

LARGEST_PX, SMALLEST_PX = 1e15, 1e-50
"""Beyond the first a double has no fraction of a pixel left; below the second, fourth powers underflow."""


def as_matches(xy1: F64, xy2: F64) -> tuple[F64, F64]:
    """The matches as contiguous float64 (N, 2) arrays.

    Raises ``ValueError`` for other shapes and for coordinates that are not real and finite or beyond 1e15 px.
    """
    if np.iscomplexobj(xy1) or np.iscomplexobj(xy2):
        raise ValueError("a fundamental matrix needs real pixel coordinates; got complex ones")
    xy1, xy2 = np.ascontiguousarray(xy1, dtype=np.float64), np.ascontiguousarray(xy2, dtype=np.float64)
    if xy1.shape != xy2.shape or xy1.ndim != 2 or xy1.shape[1] != 2:
        raise ValueError(f"a fundamental matrix needs two (N, 2) arrays; got {xy1.shape} and {xy2.shape}")
    if not (np.isfinite(xy1).all() and np.isfinite(xy2).all()):
        raise ValueError("a fundamental matrix needs finite pixel coordinates; some are NaN or infinite")
    if max(np.abs(xy1).max(initial=0.0), np.abs(xy2).max(initial=0.0)) > LARGEST_PX:
        raise ValueError(f"a fundamental matrix needs pixels of photographs; some are beyond {LARGEST_PX:g}")
    return xy1, xy2


def check_matches(xy1: F64, xy2: F64, *, needed: int) -> tuple[F64, F64]:
    """The matches as float64 (N, 2) arrays that can determine an F.

    Raises ``ValueError`` as :func:`as_matches`, ``StageFailure`` for fewer than ``needed`` matches and for
    points that are all equal or on one line in an image.
    """
    xy1, xy2 = as_matches(xy1, xy2)
    if len(xy1) < needed:
        raise StageFailure(
            "too few matches for the geometry of the pair",
            f"found {len(xy1)}, needed at least {needed}",
            "use photographs that overlap more",
        )
    for name, xy in (("first", xy1), ("second", xy2)):
        if _clearly_spread(xy):
            continue
        spread = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)
        length = max(float(spread[0]), 1e-3 * float(np.abs(xy).max()))
        if not spread[1] > max(COLLINEAR * length, SMALLEST_PX):
            raise StageFailure(
                f"the matched points lie on one line in the {name} image",
                f"{len(xy)} points, spread across the line {spread[1] / np.sqrt(len(xy)):.3g} px",
                "such points leave the geometry of the pair free",
            )
    return xy1, xy2


def _clearly_spread(xy: F64) -> bool:
    """Whether the points are far from lying on one line, so far that squares cannot hide it."""
    centred = xy - xy.sum(axis=0) / len(xy)
    (a, b), (_, d) = centred.T @ centred
    size = a + d
    large = size > max(1e-6 * len(xy) * float(xy[0] @ xy[0]), SMALLEST_PX**2)
    return bool(large and a * d - b * b > 1e-6 * size**2)


@dataclass(frozen=True)
class PairFrame:
    """Coordinates of both images about their centroids, scaled by one common factor ``scale`` (1 / px).

    The common factor keeps Sampson distances what they are in pixels, times ``scale``; a factor per image
    would weight the images against each other.
    """

    centroid1: F64
    centroid2: F64
    scale: float

    @classmethod
    def of(cls, xy1: F64, xy2: F64) -> PairFrame:
        """The frame in which the mean squared coordinate over both images is 1."""
        c1, c2 = xy1.sum(axis=0) / len(xy1), xy2.sum(axis=0) / len(xy2)
        d1, d2 = (xy1 - c1).ravel(), (xy2 - c2).ravel()
        return cls(c1, c2, 1.0 / float(np.sqrt((d1 @ d1 + d2 @ d2) / (4.0 * len(xy1)))))

    def points(self, xy1: F64, xy2: F64) -> F64:
        """Rows (x1, y1, x2, y2) in the frame; (N, 4)."""
        points = np.empty((len(xy1), 4))
        points[:, :2] = xy1 - self.centroid1
        points[:, 2:] = xy2 - self.centroid2
        points *= self.scale
        return points

    @property
    def to_pixels(self) -> F64:
        """(9, 9) matrix that takes vec(F) of the frame to vec(F) of pixels, up to scale."""
        T1, T2 = self._transform(self.centroid1), self._transform(self.centroid2)
        return np.asarray(np.kron(T2.T, T1.T), dtype=np.float64)

    def matrix_in_pixels(self, f: F64) -> F64:
        """F (3, 3) in pixels, unit norm, from a flat vector (9,) in the frame."""
        T1, T2 = self._transform(self.centroid1), self._transform(self.centroid2)
        return unit_norm(T2.T @ f.reshape(3, 3) @ T1)

    def matrix_in_frame(self, F: F64) -> F64:
        """Flat unit vector (9,) in the frame from F (3, 3) in pixels."""
        T1, T2 = self._transform(self.centroid1), self._transform(self.centroid2)
        return np.ascontiguousarray(unit_norm(np.linalg.inv(T2).T @ F @ np.linalg.inv(T1)).ravel())

    def _transform(self, centroid: F64) -> F64:
        s = self.scale
        return np.array([[s, 0.0, -s * centroid[0]], [0.0, s, -s * centroid[1]], [0.0, 0.0, 1.0]])


def check_start(F: F64, frame: PairFrame) -> F64:
    """Flat unit vector (9,) in ``frame`` of an F (3, 3) in pixels that a refinement can start from.

    Raises ``ValueError`` for another shape, entries that are not finite and rank below 2.
    """
    F = np.asarray(F, dtype=np.float64)
    if F.shape != (3, 3) or not np.isfinite(F).all():
        raise ValueError(f"the refinement starts from a finite (3, 3) matrix of rank 2 or 3; got {F.shape}")
    f = frame.matrix_in_frame(F)
    if np.linalg.matrix_rank(f.reshape(3, 3)) < 2:
        raise ValueError("the refinement starts from a finite (3, 3) matrix of rank 2 or 3; got a lower rank")
    return f
