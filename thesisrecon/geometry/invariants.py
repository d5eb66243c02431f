"""Section 3.4: what each stratum keeps.

Projective: the cross-ratio (and incidence, tangency, the sign of the Gaussian curvature, in ``conics``).
Affine: parallelism, ratios of volumes and of lengths along a line, centroids. Metric: angles and ratios of
all lengths. Euclidean: lengths. Points are homogeneous (..., 4); their scales never matter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.homogeneous import dehomogenize

F64 = NDArray[np.float64]


def cross_ratio(X: F64, *, tolerance: float = 1e-6) -> float:
    """(l1 - l3)(l2 - l4) / ((l1 - l4)(l2 - l3)) of four points X_i ~ X + l_i X' of a line (3.4.2).

    X (4, d), d = 2, 3 or 4, with any scales; a point may be the base point X' itself, whose l is infinite,
    since the differences are taken as determinants. inf where X1 = X4 or X2 = X3. Raises ``ValueError`` for
    points that are not on one line to ``tolerance`` (the third singular value of the unit vectors) or of
    which three are one point, where the ratio does not exist.
    """
    if X.ndim != 2 or X.shape[0] != 4 or not np.isfinite(X).all():
        raise ValueError(f"cross_ratio needs four finite points (4, d); got {X.shape}")
    unit = X / np.maximum(np.linalg.norm(X, axis=1, keepdims=True), 1e-300)
    _, s, Vt = np.linalg.svd(unit)
    if len(s) > 2 and s[2] > tolerance:
        raise ValueError(f"cross_ratio needs points of one line; they miss it by {s[2]:.2g}")
    a, b = Vt[:2] @ unit.T
    difference = np.outer(a, b) - np.outer(b, a)
    above = difference[0, 2] * difference[1, 3]
    below = difference[0, 3] * difference[1, 2]
    if max(abs(above), abs(below)) < 1e-24:
        raise ValueError("cross_ratio does not exist where three of the four points are one")
    return float(above / below) if below != 0.0 else np.inf


def parallelism_sine(plane1: F64, plane2: F64) -> F64:
    """Sine of the angle between the normals of two planes (..., 4): 0 for parallel planes.

    Zero is kept by affine transforms, other values by metric ones only.
    """
    a, b = plane1[..., :3], plane2[..., :3]
    size = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return np.asarray(np.linalg.norm(np.cross(a, b), axis=-1) / np.maximum(size, 1e-300))


def volume(X: F64) -> float:
    """Signed volume of the tetrahedron of four finite points (4, 4), in cubic units of space."""
    corners = dehomogenize(X)
    return float(np.linalg.det(corners[1:] - corners[0])) / 6.0


def volume_ratio(X: F64, Y: F64) -> float:
    """Ratio of the signed volumes of two tetrahedra (4, 4): affine. inf where Y is flat."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.float64(volume(X)) / np.float64(volume(Y)))


def centroid(X: F64) -> F64:
    """Centroid (4,) of finite points (N, 4), with W = 1; affine transforms move it with the points."""
    return np.append(dehomogenize(X).mean(axis=0), 1.0)


def segment_ratio(X: F64, Y: F64, Z: F64) -> float:
    """l with Z = X + l (Y - X) for three finite points (4,) of a line: affine.

    The cross-ratio of the three and the line's point at infinity. A Z off the line is taken at its foot.
    """
    x, y, z = (dehomogenize(point) for point in (X, Y, Z))
    return float((z - x) @ (y - x) / ((y - x) @ (y - x)))


def length(X: F64, Y: F64) -> F64:
    """Distance of finite points (..., 4), in units of space: Euclidean."""
    return np.asarray(np.linalg.norm(dehomogenize(X) - dehomogenize(Y), axis=-1))


def length_ratio(X: F64, Y: F64, Z: F64) -> F64:
    """|XY| / |XZ| of finite points (..., 4) in any directions: metric."""
    return np.asarray(length(X, Y) / length(X, Z))


def angle(apex: F64, X: F64, Y: F64) -> F64:
    """Angle (rad) at ``apex`` between the directions to X and Y, finite points (..., 4): metric."""
    a, b = (dehomogenize(point) - dehomogenize(apex) for point in (X, Y))
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.arctan2(sine, np.sum(a * b, axis=-1)))
