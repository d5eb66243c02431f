"""Sections 3.3 and 3.4: how each entity is transformed, and the four strata with their groups of transforms.

A transform G (4, 4) acts on points as X -> G X; a singular one is none and a ``ValueError`` where its inverse
is needed. The matrices of 3.4.2 to 3.4.5 in the thesis' text have
their zeros in the fourth column: they act on rows, X' -> X' G, and are the transposes of the ones here, which
follow its table in 3.3.

Section 3.4: what each stratum keeps.

Projective: the cross-ratio (and incidence, tangency, the sign of the Gaussian curvature, in ``conics``).
Affine: parallelism, ratios of volumes and of lengths along a line, centroids. Metric: angles and ratios of
all lengths. Euclidean: lengths. Points are homogeneous (..., 4); their scales never matter.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import dehomogenize, inverse_of, require_finite

Group = Literal["projective", "affine", "metric", "euclidean"]

DEGREES_OF_FREEDOM: dict[Group, int] = {"projective": 15, "affine": 12, "metric": 7, "euclidean": 6}
"""From the largest set of transforms, with the fewest invariants, to the smallest."""

PLANE_AT_INFINITY = np.array([0.0, 0.0, 0.0, 1.0])
"""Its canonical position in the affine and all later strata (3.4.3)."""


def transform_points(G: F64, X: F64) -> F64:
    """X -> G X; (4, 4), (..., 4), and image points (..., 3) under a homography (3, 3)."""
    return np.asarray(X @ G.T)


def transform_cameras(G: F64, P: F64) -> F64:
    """P -> P G^-1; (4, 4), (..., 3, 4). The images P X stay what they are."""
    return np.asarray(P @ inverse_of(G, "transform_cameras"))


def transform_planes(G: F64, plane: F64) -> F64:
    """Pi' -> Pi' G^-1; (4, 4), (..., 4), and image lines (..., 3) under a homography (3, 3)."""
    return np.asarray(plane @ inverse_of(G, "transform_planes"))


def transform_conics(G: F64, C: F64) -> F64:
    """C -> G^-T C G^-1 and Q -> G^-T Q G^-1: conics (3, 3), (..., 3, 3) and quadrics (4, 4), (..., 4, 4)."""
    inverse = inverse_of(G, "transform_conics")
    return np.asarray(inverse.T @ C @ inverse)


def transform_dual_conics(G: F64, C: F64) -> F64:
    """C* -> G C* G' and Q* -> G Q* G': dual conics (3, 3), (..., 3, 3) and dual quadrics (4, 4), (..., 4, 4).

    Also the rule of a Pluecker matrix L of points; that of planes L* follows :func:`transform_conics`.
    """
    return np.asarray(G @ C @ G.T)


def affine_transform(A: F64, t: F64) -> F64:
    """The (4, 4) transform X -> A X + t of 12 degrees of freedom; A (3, 3) invertible, t (3,).

    With A = s R it is metric (7), with A = R Euclidean (6). Raises ``ValueError`` for a singular A.
    """
    require_finite("affine_transform", A, t)
    if not np.linalg.cond(A) < 1e14:
        raise ValueError("affine_transform needs an invertible matrix")
    G = np.eye(4)
    G[:3, :3], G[:3, 3] = A, t
    return G


def random_transform(group: Group, rng: np.random.Generator) -> F64:
    """A well-conditioned (4, 4) member of a group that belongs to no smaller one."""
    if group == "projective":
        return np.eye(4) + _shift_of_norm(rng, (4, 4), 0.5)
    t, scale = rng.normal(size=3), float(np.exp(rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 1.0)))
    if group == "affine":
        return affine_transform(scale * (np.eye(3) + _shift_of_norm(rng, (3, 3), 0.5)), t)
    R = scipy.spatial.transform.Rotation.random(random_state=rng).as_matrix()
    return affine_transform(scale * R if group == "metric" else R, t)


def _shift_of_norm(rng: np.random.Generator, shape: tuple[int, int], norm: float) -> F64:
    """Noise whose norm below 1 keeps the identity plus it invertible."""
    noise = rng.normal(size=shape)
    return np.asarray(norm * noise / np.linalg.norm(noise))


def group_of(G: F64, *, tolerance: float = 1e-9) -> Group:
    """The smallest group that a transform (4, 4) of any scale belongs to.

    Affine: the last row is a multiple of (0, 0, 0, 1), so the plane at infinity is fixed; metric: A'A is also
    a multiple of I and det A > 0 after W is set to 1, so the absolute conic is fixed (a reflection is only
    affine here); Euclidean: the multiple is 1. ``tolerance`` is relative. Raises ``ValueError`` for a matrix
    that is not finite, (4, 4) and invertible.
    """
    if G.shape != (4, 4) or not np.isfinite(G).all() or not np.linalg.cond(G) < 1e14:
        raise ValueError(f"group_of needs a finite invertible (4, 4) matrix; got shape {G.shape}")
    if np.linalg.norm(G[3, :3]) > tolerance * np.linalg.norm(G):
        return "projective"
    A = G[:3, :3] / G[3, 3]
    gram = A.T @ A
    squared_scale = float(np.trace(gram)) / 3.0
    if np.linalg.norm(gram - squared_scale * np.eye(3)) > tolerance * squared_scale or np.linalg.det(A) < 0.0:
        return "affine"
    return "euclidean" if abs(squared_scale - 1.0) <= tolerance else "metric"


def affine_from_projective(plane: F64) -> F64:
    """G_PA (4, 4), which takes the plane at infinity (4,) of a projective frame to (0, 0, 0, 1) (3.4.3).

    The identity with the last row (Pi1/Pi4, Pi2/Pi4, Pi3/Pi4, 1). That row does not exist for a plane through
    the origin; where Pi4 is below 1e-6 of the plane's norm the smallest rotation that takes the plane there
    stands in its place. Raises ``ValueError`` for a zero plane.
    """
    norm = float(np.linalg.norm(plane))
    if plane.shape != (4,) or not np.isfinite(norm) or norm == 0.0:
        raise ValueError("affine_from_projective needs a finite plane (4,) that is not zero")
    unit = plane / norm if plane[3] >= 0.0 else -plane / norm
    G = np.eye(4)
    if unit[3] > 1e-6:
        G[3] = unit / unit[3]
        return G
    last = PLANE_AT_INFINITY
    middle = unit + last
    return np.asarray(G - np.outer(middle, middle) / (1.0 + unit[3]) + 2.0 * np.outer(last, unit))


def metric_from_affine(absolute_conic: F64) -> F64:
    """G_AM (4, 4), which takes the absolute conic (3, 3) of an affine frame to the identity (3.4.4).

    With Omega = A'A (Cholesky) the points of the plane at infinity move by A. Determined up to a similarity.
    Raises ``ValueError`` for a conic that is not definite.
    """
    sign = 1.0 if np.trace(absolute_conic) > 0.0 else -1.0
    try:
        lower = np.linalg.cholesky(sign * (absolute_conic + absolute_conic.T) / 2.0)
    except np.linalg.LinAlgError as error:
        raise ValueError("metric_from_affine needs a definite absolute conic") from error
    return affine_transform(lower.T / np.cbrt(np.linalg.det(lower)), np.zeros(3))


def metric_from_projective(dual_quadric: F64) -> F64:
    """G_PM (4, 4), which takes the absolute dual quadric (4, 4) to diag(1, 1, 1, 0), det G_PM > 0.

    Q* = V diag(s1, s2, s3, s4) V' with |s4| least, which is taken for 0; G_PM^-1 = V diag(root s1, root s2,
    root s3, 1). Raises ``ValueError`` where the other three do not have one sign.
    """
    s, V = np.linalg.eigh((dual_quadric + dual_quadric.T) / 2.0)
    order = np.argsort(-np.abs(s))
    s, V = s[order] * np.sign(s[order[0]]), V[:, order]
    if not (s[:3] > 1e-14 * s[0]).all():
        raise ValueError("metric_from_projective needs a semi-definite dual quadric of rank 3")
    size = np.append(np.sqrt(s[:3]), np.sqrt(s[0]))
    size[3] *= np.sign(np.linalg.det(V))
    return np.asarray(np.linalg.inv(V * size))


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
