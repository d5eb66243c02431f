"""Places between two photographs: along the rows of the rectified frame, and out of it again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.types import F64

SHRINK = 0.8
"""Steps by which the quadrilateral is made smaller until it is in front of both cameras."""
LEAST_DEPTH = 0.2
"""Third coordinates of its corners are at least so many times that of the middle."""


@dataclass(frozen=True)
class FrameBetween:
    """The frames of views between two photographs of ``size`` (width, height), after Seitz and Dyer.

    ``H`` (2, 3, 3) take the photographs to the rectified frame. There a point of the view at s is (1 - s)
    x_left + s x_right: exactly its image in a camera on the baseline, all three being parallel. Out of the
    rectified frame leads a homography that takes a quadrilateral to the corners of the picture; the
    quadrilateral is that of the first photograph for s = 0, that of the second for s = 1, and runs in
    straight lines in between, so that both ends are the photographs.
    """

    H: F64
    size: tuple[int, int]

    def original_from_rectified(self, s: float) -> F64:
        """(3, 3) from the rectified frame at s to the pixels of the view, det > 0 where H's are."""
        corners = self._corners()
        ends = [_mapped(H, corners) for H in self.H]
        return _homography((1.0 - s) * ends[0] + s * ends[1], corners)

    def points(self, xy1: F64, xy2: F64, s: float) -> F64:
        """Where the view at s sees points whose pixels (N, 2), (N, 2) in the photographs are known."""
        left, right = _mapped(self.H[0], xy1), _mapped(self.H[1], xy2)
        return _mapped(self.original_from_rectified(s), (1.0 - s) * left + s * right)

    def _corners(self) -> F64:
        """The four points of the quadrilateral (4, 2) px: the corners, drawn to the middle where they
        must."""
        width, height = self.size
        middle = 0.5 * np.array([width - 1.0, height - 1.0])
        reach = np.maximum(middle, 0.5) * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        third = self.H[:, 2]
        least = LEAST_DEPTH * (third @ np.append(middle, 1.0))
        if not (least > 0.0).all():
            raise ValueError("the middle of the photograph is beyond the line sent to infinity")
        while not (homogenize(middle + reach) @ third.T >= least).all():
            reach *= SHRINK
        corners: F64 = middle + reach
        return corners


def _mapped(H: F64, xy: F64) -> F64:
    xh = homogenize(np.asarray(xy, dtype=np.float64)) @ H.T
    return np.asarray(xh[:, :2] / xh[:, 2:])


def _homography(source: F64, target: F64) -> F64:
    """(3, 3) that takes four points to four others, H[2] positive at the first of them."""
    rows = []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows.append([x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y, -u])
        rows.append([0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y, -v])
    # Columns of one size: coordinates are of thousands.
    system = np.array(rows)
    scale = np.linalg.norm(system, axis=0)
    H = (np.linalg.svd(system / scale)[2][-1] / scale).reshape(3, 3)
    return np.asarray(H * np.sign(H[2] @ np.append(source[0], 1.0)))
