"""Checks of matches and the coordinate frame that all estimators of F share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.conditioning import unit_norm

# Ratio of the spread across to the spread along the main direction below which points count as collinear.
COLLINEAR = 1e-9
# Above the first a double has no fraction of a pixel left; below the second fourth powers underflow.
MAX_PX, MIN_PX = 1e15, 1e-50


def as_matches(xy1: F64, xy2: F64) -> tuple[F64, F64]:
    """Matches as contiguous float64 arrays (N, 2); ValueError if shapes or coordinates are impossible."""
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
    """As :func:`as_matches`; StageFailure if the matches are too few, equal or collinear."""
    xy1, xy2 = as_matches(xy1, xy2)
    if len(xy1) < needed:
        raise StageFailure(
            "too few matches for the epipolar geometry",
            f"found {len(xy1)}, needed at least {needed}",
            "use images with more overlap",
        )
    for name, xy in (("first", xy1), ("second", xy2)):
        spread = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)
        length = max(float(spread[0]), 1e-3 * float(np.abs(xy).max()))
        if not spread[1] > max(COLLINEAR * length, MIN_PX):
            raise StageFailure(
                f"the matched points are collinear in the {name} image",
                f"{len(xy)} points with a spread across the line of {spread[1] / np.sqrt(len(xy)):.3g} px",
                "collinear points do not determine the epipolar geometry; use matches from the whole image",
            )
    return xy1, xy2


@dataclass(frozen=True)
class PairFrame:
    """Coordinates about the centroids; one common scale keeps Sampson distances proportional to pixels."""

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
        """Matches in the frame: rows (x1, y1, x2, y2)."""
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

    @property
    def homography_to_pixels(self) -> F64:
        """Matrix (9, 9) that converts vec(H) of a homography from the frame to pixels."""
        T1, T2 = self._transform(self.centroid1), self._transform(self.centroid2)
        return np.asarray(np.kron(np.linalg.inv(T2), T1.T))

    def matrix_in_pixels(self, f: F64) -> F64:
        """F (3, 3) in pixels, unit norm, of F (9,) in the frame."""
        T1, T2 = self._transform(self.centroid1), self._transform(self.centroid2)
        return unit_norm(T2.T @ f.reshape(3, 3) @ T1)

    def matrix_in_frame(self, F: F64) -> F64:
        """F (9,) in the frame, unit norm, of F (3, 3) in pixels."""
        T1, T2 = self._transform(self.centroid1), self._transform(self.centroid2)
        return np.ascontiguousarray(unit_norm(np.linalg.inv(T2).T @ F @ np.linalg.inv(T1)).ravel())

    def _transform(self, centroid: F64) -> F64:
        """Similarity (3, 3) from pixels to the frame."""
        s = self.scale
        return np.array([[s, 0.0, -s * centroid[0]], [0.0, s, -s * centroid[1]], [0.0, 0.0, 1.0]])


def check_start(F: F64, frame: PairFrame) -> F64:
    """The start of a refinement in the frame (9,); a ValueError unless it has rank 2 or 3."""
    F = np.asarray(F, dtype=np.float64)
    if F.shape != (3, 3) or not np.isfinite(F).all():
        raise ValueError(f"the refinement starts from a finite (3, 3) matrix of rank 2 or 3; got {F.shape}")
    f = frame.matrix_in_frame(F)
    if np.linalg.matrix_rank(f.reshape(3, 3)) < 2:
        raise ValueError("the refinement starts from a finite (3, 3) matrix of rank 2 or 3; got a lower rank")
    return f
