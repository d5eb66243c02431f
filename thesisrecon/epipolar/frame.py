"""Checks of matches and the coordinate frame that all estimators of F share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.two_view import unit_norm

# Ratio of the spread across to the spread along the main direction below which points count as collinear.
COLLINEAR = 1e-9
# Above the first a double has no fraction of a pixel left; below the second fourth powers underflow.
MAX_PX, MIN_PX = 1e15, 1e-50


def as_matches(xy1: F64, xy2: F64) -> tuple[F64, F64]:
    """Return the matches as contiguous float64 arrays.

    Parameters
    ----------
    xy1, xy2 : array_like (N, 2)
        Matched points, px.

    Returns
    -------
    tuple of ndarray (N, 2)
        The two point sets.

    Raises
    ------
    ValueError
        If the shapes differ or coordinates are complex, not finite or beyond 1e15 px.
    """
    if np.iscomplexobj(xy1) or np.iscomplexobj(xy2):
        raise ValueError("a fundamental matrix needs real pixel coordinates; got complex ones")
    xy1, xy2 = np.ascontiguousarray(xy1, dtype=np.float64), np.ascontiguousarray(xy2, dtype=np.float64)
    if xy1.shape != xy2.shape or xy1.ndim != 2 or xy1.shape[1] != 2:
        raise ValueError(f"a fundamental matrix needs two (N, 2) arrays; got {xy1.shape} and {xy2.shape}")
    if not (np.isfinite(xy1).all() and np.isfinite(xy2).all()):
        raise ValueError("a fundamental matrix needs finite pixel coordinates; some are NaN or infinite")
    if max(np.abs(xy1).max(initial=0.0), np.abs(xy2).max(initial=0.0)) > MAX_PX:
        raise ValueError(
            f"a fundamental matrix needs pixel coordinates of images; some are beyond {MAX_PX:g}"
        )
    return xy1, xy2


def check_matches(xy1: F64, xy2: F64, *, needed: int) -> tuple[F64, F64]:
    """Return the matches as float64 arrays and require that they can determine an F.

    Parameters
    ----------
    xy1, xy2 : array_like (N, 2)
        Matched points, px.
    needed : int
        Minimum number of matches.

    Returns
    -------
    tuple of ndarray (N, 2)
        The two point sets.

    Raises
    ------
    ValueError
        As :func:`as_matches`.
    StageFailure
        If there are too few matches or the points of an image are equal or collinear.
    """
    xy1, xy2 = as_matches(xy1, xy2)
    if len(xy1) < needed:
        raise StageFailure(
            "too few matches for the epipolar geometry",
            f"found {len(xy1)}, needed at least {needed}",
            "use images with more overlap",
        )
    for name, xy in (("first", xy1), ("second", xy2)):
        if _clearly_spread(xy):
            continue
        spread = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)
        length = max(float(spread[0]), 1e-3 * float(np.abs(xy).max()))
        if not spread[1] > max(COLLINEAR * length, MIN_PX):
            raise StageFailure(
                f"the matched points are collinear in the {name} image",
                f"{len(xy)} points with a spread across the line of {spread[1] / np.sqrt(len(xy)):.3g} px",
                "collinear points do not determine the epipolar geometry; use matches from the whole image",
            )
    return xy1, xy2


def _clearly_spread(xy: F64) -> bool:
    """Return whether the points are so far from collinear that rounding of squares cannot hide it."""
    centred = xy - xy.sum(axis=0) / len(xy)
    (a, b), (_, d) = centred.T @ centred
    size = a + d
    large = size > max(1e-6 * len(xy) * float(xy[0] @ xy[0]), MIN_PX**2)
    return bool(large and a * d - b * b > 1e-6 * size**2)


@dataclass(frozen=True)
class PairFrame:
    """Coordinates of both images about their centroids with one common scale.

    The common factor keeps Sampson distances proportional to pixels; one factor per image would weight the
    images differently.

    Parameters
    ----------
    centroid1, centroid2 : ndarray (2,)
        Centroid of the points of each image, px.
    scale : float
        Frame units per pixel.
    """

    centroid1: F64
    centroid2: F64
    scale: float

    @classmethod
    def of(cls, xy1: F64, xy2: F64) -> PairFrame:
        """Return the frame in which the mean squared coordinate over both images is 1.

        Parameters
        ----------
        xy1, xy2 : ndarray (N, 2)
            Matched points, px.

        Returns
        -------
        PairFrame
            The frame.
        """
        c1, c2 = xy1.sum(axis=0) / len(xy1), xy2.sum(axis=0) / len(xy2)
        d1, d2 = (xy1 - c1).ravel(), (xy2 - c2).ravel()
        return cls(c1, c2, 1.0 / float(np.sqrt((d1 @ d1 + d2 @ d2) / (4.0 * len(xy1)))))

    def points(self, xy1: F64, xy2: F64) -> F64:
        """Convert matches from pixels to the frame.

        Parameters
        ----------
        xy1, xy2 : ndarray (N, 2)
            Matched points, px.

        Returns
        -------
        ndarray (N, 4)
            Rows (x1, y1, x2, y2).
        """
        points = np.empty((len(xy1), 4))
        points[:, :2] = xy1 - self.centroid1
        points[:, 2:] = xy2 - self.centroid2
        points *= self.scale
        return points

    @property
    def to_pixels(self) -> F64:
        """Matrix (9, 9) that converts vec(F) from the frame to pixels, up to scale."""
        T1, T2 = self._transform(self.centroid1), self._transform(self.centroid2)
        return np.asarray(np.kron(T2.T, T1.T), dtype=np.float64)

    def matrix_in_pixels(self, f: F64) -> F64:
        """Convert F from the frame to pixels.

        Parameters
        ----------
        f : ndarray (9,)
            F in the frame, row-major.

        Returns
        -------
        ndarray (3, 3)
            F in pixels, unit norm.
        """
        T1, T2 = self._transform(self.centroid1), self._transform(self.centroid2)
        return unit_norm(T2.T @ f.reshape(3, 3) @ T1)

    def matrix_in_frame(self, F: F64) -> F64:
        """Convert F from pixels to the frame.

        Parameters
        ----------
        F : ndarray (3, 3)
            F in pixels.

        Returns
        -------
        ndarray (9,)
            F in the frame, row-major, unit norm.
        """
        T1, T2 = self._transform(self.centroid1), self._transform(self.centroid2)
        return np.ascontiguousarray(unit_norm(np.linalg.inv(T2).T @ F @ np.linalg.inv(T1)).ravel())

    def _transform(self, centroid: F64) -> F64:
        """Similarity (3, 3) from pixels to the frame."""
        s = self.scale
        return np.array([[s, 0.0, -s * centroid[0]], [0.0, s, -s * centroid[1]], [0.0, 0.0, 1.0]])


def check_start(F: F64, frame: PairFrame) -> F64:
    """Convert the start of a refinement to the frame and check it.

    Parameters
    ----------
    F : array_like (3, 3)
        F in pixels.
    frame : PairFrame
        Frame of the matches.

    Returns
    -------
    ndarray (9,)
        F in the frame, row-major, unit norm.

    Raises
    ------
    ValueError
        If F is not a finite (3, 3) matrix of rank 2 or 3.
    """
    F = np.asarray(F, dtype=np.float64)
    if F.shape != (3, 3) or not np.isfinite(F).all():
        raise ValueError(f"the refinement starts from a finite (3, 3) matrix of rank 2 or 3; got {F.shape}")
    f = frame.matrix_in_frame(F)
    if np.linalg.matrix_rank(f.reshape(3, 3)) < 2:
        raise ValueError("the refinement starts from a finite (3, 3) matrix of rank 2 or 3; got a lower rank")
    return f
