"""Triangulation by any method of section 6.3, among them the least reprojection error."""

from __future__ import annotations

from typing import Literal

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.polynomial_triangulation import triangulate_polynomial
from thesisrecon.geometry.triangulation import (
    PASSES,
    SortedPixels,
    sort_by_point,
    triangulate_linear,
    triangulate_midpoint,
)
from thesisrecon.optimize.bundle.partial import minimize_reprojection

Method = Literal["polynomial", "linear", "midpoint", "iterated", "optimal"]


def triangulate_points(P: F64, xy: F64, *, method: Method | None = None) -> F64:
    """Triangulate points by a method of section 6.3; see :func:`thesisrecon.triangulate`."""
    method = method or ("polynomial" if len(P) == 2 else "optimal")
    if method == "polynomial":
        return triangulate_polynomial(P, xy)
    listed = sort_by_point(xy)
    if method == "midpoint":
        return triangulate_midpoint(P, listed)
    if method == "optimal":
        return _optimal(P, listed)
    return triangulate_linear(P, listed, PASSES if method == "iterated" else 0)


def _optimal(P: F64, listed: SortedPixels) -> F64:
    """Local minimum of the reprojection error by Levenberg-Marquardt from the linear result."""
    start, view, pixels = listed
    point = np.repeat(np.arange(len(start) - 1), np.diff(start))
    X = minimize_reprojection(P, triangulate_linear(P, listed, 0), view, point, pixels)
    sizes = np.linalg.norm(X, axis=1, keepdims=True)
    return np.asarray(X / np.where(sizes > 0.0, sizes, 1.0))
