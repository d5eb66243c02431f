"""Sections 3.3 and 3.4: how entities transform, the strata with their invariants, and conics.

A transform G (4, 4) maps points X -> G X, as in the thesis' table 3.3; the matrices of 3.4.2 to 3.4.5 in its
text act on rows, X' -> X' G, and are the transposes of those here.

Invariants: projective - cross-ratio, incidence, tangency, sign of the Gaussian curvature; affine -
parallelism, ratios of volumes and of lengths along a line; metric - angles, ratios of lengths (two metric
models differ by a similarity, 3.4.4); Euclidean - lengths.

C is a conic (3, 3) of the points x'C x = 0 (3.1) or a quadric (4, 4) with X'Q X = 0 (3.8); its dual has
l'C* l = 0 (3.3) or Pi'Q* Pi = 0 (3.9). The tangent line at x is C x, the tangent plane at X is Q X (3.7). All
are symmetric and of any scale. The absolute conic Omega is x'x = 0 on the plane at infinity (3.2). A camera
[M m] maps the point (x, 0) of that plane to M x (3.11), so that the image of Omega depends on K alone
(3.11-3.13).
"""

import math
from typing import Literal, get_args

import numpy as np

from thesisrecon.arrays import B8, F64, require_finite, require_shapes
from thesisrecon.errors import unknown_word
from thesisrecon.geometry.homogeneous import checked_inverse, checked_unit
from thesisrecon.records import Similarity

Entity = Literal["points", "planes", "cameras", "conics", "dual conics"]

PLANE_AT_INFINITY = np.array([0.0, 0.0, 0.0, 1.0])
"""Canonical position in the affine and all later strata (3.4.3)."""


def transform(G: F64, entity: F64, kind: Entity) -> F64:
    """Transform points, planes, cameras, conics or quadrics, or their duals (table 3.3).

    X -> G X, Pi' -> Pi' G^-1, P -> P G^-1 (which keeps the images P X), C -> G^-T C G^-1, C* -> G C* G'. G is
    a transform of space (4, 4), or a homography (3, 3) of points, lines and conics.
    """
    if kind not in get_args(Entity):
        raise ValueError(unknown_word("kind of entity", kind, get_args(Entity)))
    if kind == "points":
        return np.asarray(entity @ G.T)
    if kind == "dual conics":
        return np.asarray(G @ entity @ G.T)
    inverse = checked_inverse(G, "transform")
    return np.asarray(inverse.T @ entity @ inverse if kind == "conics" else entity @ inverse)


def affine_from_projective(plane: F64) -> F64:
    """G_PA, which moves the plane at infinity of a projective frame to (0, 0, 0, 1) (3.4.3).

    The identity with the last row (Pi1/Pi4, Pi2/Pi4, Pi3/Pi4, 1). For a plane (nearly) through the origin it
    is the smallest rotation that moves the plane there.
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
    """G_AM, which moves the absolute conic of an affine frame to the identity (3.4.4).

    With Omega = A'A (Cholesky) the points of the plane at infinity move by A. Determined up to a similarity.
    """
    sign = 1.0 if np.trace(absolute_conic) > 0.0 else -1.0
    try:
        lower = np.linalg.cholesky(sign * (absolute_conic + absolute_conic.T) / 2.0)
    except np.linalg.LinAlgError as error:
        raise ValueError("metric_from_affine needs a definite absolute conic") from error
    G = np.eye(4)
    G[:3, :3] = lower.T / np.cbrt(np.linalg.det(lower))
    return G


def metric_from_projective(dual_quadric: F64) -> F64:
    """G_PM, which moves the absolute dual quadric to diag(1, 1, 1, 0), det G_PM > 0.

    Q* = V diag(s1, s2, s3, s4) V' with |s4| least, set to 0; G_PM^-1 = V diag(roots of s1, s2, s3, 1).
    """
    s, V = np.linalg.eigh((dual_quadric + dual_quadric.T) / 2.0)
    order = np.argsort(-np.abs(s))
    s, V = s[order] * np.sign(s[order[0]]), V[:, order]
    if not (s[:3] > 1e-14 * s[0]).all():
        raise ValueError("metric_from_projective needs a semi-definite dual quadric of rank 3")
    size = np.append(np.sqrt(s[:3]), np.sqrt(s[0]))
    size[3] *= np.sign(np.linalg.det(V))
    return np.asarray(np.linalg.inv(V * size))


def cross_ratio(X: F64) -> float:
    """(l1 - l3)(l2 - l4) / ((l1 - l4)(l2 - l3)) of four collinear points X_i ~ X + l_i X' (3.4.2).

    At most two of the homogeneous points may be equal; inf if X1 = X4 or X2 = X3.
    """
    if X.ndim != 2 or X.shape[0] != 4 or not np.isfinite(X).all():
        raise ValueError(f"cross_ratio needs four finite points (4, d); got {X.shape}")
    unit = X / np.maximum(np.linalg.norm(X, axis=1, keepdims=True), 1e-300)
    _, s, Vt = np.linalg.svd(unit)
    if len(s) > 2 and s[2] > 1e-6:
        raise ValueError(f"cross_ratio needs collinear points; they deviate by {s[2]:.2g}")
    a, b = Vt[:2] @ unit.T
    difference = np.outer(a, b) - np.outer(b, a)
    above = difference[0, 2] * difference[1, 3]
    below = difference[0, 3] * difference[1, 2]
    if max(abs(above), abs(below)) < 1e-24:
        raise ValueError("cross_ratio does not exist if three of the four points are equal")
    return float(above / below) if below != 0.0 else np.inf


def upgrade_cameras(P: F64, K: F64, metric_from_projective: F64) -> tuple[F64, F64, F64]:
    """Rotations (V, 3, 3) and translations (V, 3) nearest to C = K^-1 P H^-1 = s [R t], and singular values.

    The values (V, 3) are those of s R, equal for exact cameras.
    """
    Q = np.linalg.inv(K) @ (P @ np.linalg.inv(metric_from_projective))
    Q *= np.where(np.linalg.det(Q[:, :, :3]) < 0, -1.0, 1.0)[:, None, None]
    U, S, Vt = np.linalg.svd(Q[:, :, :3])
    return U @ Vt, Q[:, :, 3] / S.mean(axis=1)[:, None], S


def upgrade_points(X: F64, valid: B8, metric_from_projective: F64) -> tuple[F64, B8, float]:
    """Points (N, 3), zeros where not finite; which are finite; their median distance from their median."""
    Xm = X @ metric_from_projective.T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        X = Xm[:, :3] / Xm[:, 3:]
    finite = valid & np.isfinite(X).all(axis=1)
    X = np.where(finite[:, None], X, 0.0)
    return X, finite, float(np.median(np.linalg.norm(X[finite] - np.median(X[finite], axis=0), axis=1)))


def estimate_similarity(source: F64, target: F64) -> Similarity:
    """The similarity from ``source`` to ``target`` (N, 3) with the least sum of squared distances.

    Umeyama, PAMI 13(4), 1991. Fewer than 3 points, or points of one line, are a ``ValueError``.
    """
    require_shapes("estimate_similarity", source=(source, ("N", 3)), target=(target, ("N", 3)))
    if len(source) < 3:
        raise ValueError(f"estimate_similarity needs at least 3 points; got {len(source)}")
    require_finite("estimate_similarity", source, target)
    mean_s, mean_t = source.mean(axis=0), target.mean(axis=0)
    s, t = source - mean_s, target - mean_t
    U, D, Vt = np.linalg.svd(t.T @ s / len(s))
    if D[1] <= 1e-12 * max(D[0], 1e-300):
        raise ValueError("estimate_similarity needs points that do not all lie on one line")
    S = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ S @ Vt
    scale = float(np.trace(np.diag(D) @ S) / np.mean(np.sum(s**2, axis=1)))
    return Similarity(scale, R, mean_t - scale * R @ mean_s)


def rotation_errors_deg(R: F64, R_true: F64) -> F64:
    """Angles between rotations after the rotation of the world that fits them best.

    It is the chordal mean of the relative rotations: two views suffice, and the centres have no effect.
    """
    common = nearest_rotation(np.einsum("vji,vjk->ik", R_true, R))
    difference = np.einsum("vij,jk,vlk->vil", R_true, common, R)
    # The chord keeps its digits at small angles, where arccos of the trace loses half of them.
    chord = np.linalg.norm(difference - np.eye(3), axis=(1, 2)) / np.sqrt(8.0)
    return np.asarray(np.degrees(2.0 * np.arcsin(np.minimum(chord, 1.0))))


def nearest_rotation(A: F64) -> F64:
    """The rotation nearest to A (3, 3) in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(A)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


ABSOLUTE_CONIC = np.eye(3)  # Omega on the plane at infinity of a metric frame (3.2)
ABSOLUTE_DUAL_QUADRIC = np.diag([1.0, 1.0, 1.0, 0.0])
"""Its tangent planes in a metric frame (section 3.4.6, figure 3.7)."""


def bilinear_form(C: F64, x: F64, y: F64) -> F64:
    """S(x, y) = x'C y (3.5); S(x, x) is 0 on the conic (3.1, 3.2) or quadric (3.8), and for tangents."""
    return np.asarray(np.einsum("...i,...ij,...j->...", x, C, y))


def dual(C: F64) -> F64:
    """The dual C* ~ C^-1 (3.4) or Q* ~ Q^-1 (3.10): tangent lines C x or tangent planes (3.7).

    It is the adjugate, by singular values: the dual of two lines (rank 2) is their common point, twice.
    """
    require_finite("dual", C)
    U, s, Vt = np.linalg.svd(C)
    others = np.array([np.prod(np.delete(s, k)) for k in range(len(s))])
    sign = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    return np.asarray(sign * (Vt.T * others) @ U.T)


def intersect_line(C: F64, x: F64, y: F64) -> F64:
    """Real intersections (0 to 2, d) of a conic or quadric with the line of two points (3.5).

    Solves a^2 S(x) + 2 a b S(x, y) + b^2 S(y) = 0 for the points a x + b y, if it is not 0. The
    discriminant S(x, y)^2 - S(x) S(y) is 0 for tangents (3.6, where the thesis' text lost the square).
    """
    require_finite("intersect_line", C)
    # In a unit of length, at least 1, in which the blocks of [A b; b' c] are similar.
    a, b, c = (float(np.linalg.norm(part)) for part in (C[:-1, :-1], C[:-1, -1], C[-1, -1]))
    length = max(1.0, b / a, math.sqrt(c / a)) if a > 1e-15 * max(b, c) else 1.0
    units = np.append(np.full(len(C) - 1, length), 1.0)
    x, y, C = (checked_unit(a, "intersect_line") for a in (x / units, y / units, units[:, None] * C * units))
    sxx, sxy, syy = (float(bilinear_form(C, a, b)) for a, b in ((x, x), (x, y), (y, y)))
    size = max(abs(sxx), abs(sxy), abs(syy))
    # The forms of unit vectors have rounding errors of about 1e-15.
    discriminant, rounding = sxy**2 - sxx * syy, 1e-14 * size
    if size <= 1e-15 or discriminant < -rounding:
        return np.zeros((0, len(x)))
    touches = discriminant <= rounding
    q = -(sxy + np.copysign(0.0 if touches else np.sqrt(discriminant), sxy))
    if abs(q) <= 1e-7 * size:
        return np.asarray(units * (x if abs(sxx) < abs(syy) else y)[None])
    first, second = q * x + sxx * y, syy * x + q * y
    return np.asarray(units * (first[None] if touches else np.stack([first, second])))


def image_of_absolute_conic(K: F64, *, is_dual: bool = False) -> F64:
    """omega = K^-T K^-1 (3.11 - 3.13), or its inverse omega* = K K' (3.14, 3.15)."""
    factor = K if is_dual else np.swapaxes(checked_inverse(K, "image_of_absolute_conic"), -1, -2)
    return np.asarray(factor @ np.swapaxes(factor, -1, -2))


def calibration_from_image(image: F64, *, is_dual: bool = False) -> F64:
    """K with K33 = 1 from omega ~ K^-T K^-1 (3.13) or omega* ~ K K' (3.14), by Cholesky from the last row up.

    A conic that is indefinite is a ``ValueError``.
    """
    if not np.isfinite(image).all() or not (is_dual or np.linalg.cond(image) < 1e15):
        raise ValueError("calibration_from_image needs a finite invertible conic")
    dual_image = image if is_dual else np.asarray(np.linalg.inv(image), dtype=np.float64)
    symmetric = (dual_image + dual_image.T) / 2.0
    if symmetric[2, 2] == 0.0:
        raise ValueError("calibration_from_image needs a definite conic")
    try:
        lower = np.linalg.cholesky((symmetric / symmetric[2, 2])[::-1, ::-1])
    except np.linalg.LinAlgError as error:
        raise ValueError("calibration_from_image needs a definite conic") from error
    # K[2, 2] is 1, the root of symmetric[2, 2] over itself.
    return np.ascontiguousarray(lower[::-1, ::-1])
