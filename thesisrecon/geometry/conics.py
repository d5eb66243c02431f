"""Section 3.4.6: conics and dual conics of a plane, quadrics and dual quadrics of space.

One algebra serves both: C stands for a conic (3, 3) with the points x'C x = 0 (3.1) or a quadric (4, 4) with
X'Q X = 0 (3.8), ``dual`` for l'C* l = 0 (3.3) or Pi'Q* Pi = 0 (3.9). All are symmetric and of any scale; how
they are transformed stands in :mod:`~thesisrecon.geometry.strata`.

Section 3.4.6: the absolute conic, the absolute dual quadric, their images, and what they measure.

The absolute conic Omega is x'x = 0 on the plane at infinity (3.2); its tangent planes are the absolute dual
quadric. The image of Omega depends on K alone, not on the place of the camera (3.11-3.13): it is the
calibration object that is always in sight, and it measures angles.
"""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import inverse_of, require_finite, unit_of


def form(C: F64, x: F64, y: F64) -> F64:
    """S(x, y) = x'C y (3.5) of points (..., d) and a conic or quadric (..., d, d); (...)."""
    return np.asarray(np.einsum("...i,...ij,...j->...", x, C, y))


def incidence_residual(C: F64, x: F64) -> F64:
    """|x'C x| / (|C| |x|^2), in [0, 1]: 0 on the conic or quadric (3.1, 3.8), or for duals (3.3, 3.9)."""
    size = np.linalg.norm(C, axis=(-2, -1)) * np.sum(x**2, axis=-1)
    return np.asarray(np.abs(form(C, x, x)) / np.maximum(size, 1e-300))


def dual(C: F64) -> F64:
    """C* ~ C^-1 (3.4), Q* ~ Q^-1 (3.10): tangents of a conic (3, 3), tangent planes of a quadric (4, 4).

    The adjugate, from the singular values, so that a conic of rank 2 (two lines) has a dual as well: the
    point they share, twice. Zero for lower rank. The dual of the dual is the conic where that has full rank.
    Raises ``ValueError`` for entries that are not finite.
    """
    require_finite("dual", C)
    U, s, Vt = np.linalg.svd(C)
    others = np.array([np.prod(np.delete(s, k)) for k in range(len(s))])
    sign = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    return np.asarray(sign * (Vt.T * others) @ U.T)


def tangent(C: F64, x: F64) -> F64:
    """Tangent line C x (3.7), or tangent plane Q X, at points (..., d) of the conic or quadric (d, d).

    For points elsewhere it is their polar: the line or plane of the points where tangents through them touch.
    """
    return np.asarray(x @ C)


def tangency_discriminant(C: F64, x: F64, y: F64) -> F64:
    """S(x, y)^2 - S(x) S(y) (3.6): 0 where the line of x and y touches, positive where it cuts.

    x, y (..., d), C (d, d). (3.6) lost its square in the text.
    """
    return np.asarray(form(C, x, y) ** 2 - form(C, x, x) * form(C, y, y))


def meet_line(C: F64, x: F64, y: F64) -> F64:
    """The real points (0, 1 or 2; d) where the line of points x, y (d,) meets a conic or quadric (3.5).

    Roots (a, b) of a^2 S(x) + 2 a b S(x, y) + b^2 S(y) = 0 for the points a x + b y: in homogeneous form, so
    that x and y themselves are found. A discriminant of 0 to rounding is one point. Empty as well where the
    line lies on the quadric altogether. Raises ``ValueError`` for a point or conic that is zero or not
    finite.
    """
    x, y, C = (unit_of(array, "meet_line") for array in (x, y, C))
    sxx, sxy, syy = float(form(C, x, x)), float(form(C, x, y)), float(form(C, y, y))
    size = max(abs(sxx), abs(sxy), abs(syy))
    # Each of the three forms is known to some 1e-15, being of unit vectors.
    discriminant, rounding = sxy**2 - sxx * syy, 1e-14 * size
    if size <= 1e-15 or discriminant < -rounding:
        return np.zeros((0, len(x)))
    touches = discriminant <= rounding
    q = -(sxy + np.copysign(0.0 if touches else np.sqrt(discriminant), sxy))
    if abs(q) <= 1e-7 * size:
        return (x if abs(sxx) < abs(syy) else y)[None]
    first, second = q * x + sxx * y, syy * x + q * y
    return first[None] if touches else np.stack([first, second])


def tangents_from(C: F64, x: F64) -> F64:
    """The real tangent lines (0, 1 or 2; 3) of a conic (3, 3) of full rank through an image point (3,).

    They touch where the polar of x meets the conic; a point of the conic has one tangent. Raises as
    :func:`meet_line`.
    """
    require_finite("tangents_from", C, x)
    basis = np.linalg.svd(tangent(C, x)[None])[2][1:]
    return tangent(C, meet_line(C, basis[0], basis[1]))


def conic_through(x: F64) -> F64:
    """Conic (3, 3), unit norm, with the least sum of squared x'C x over N >= 5 points (N, 3).

    Exact for five points. Raises ``ValueError`` for fewer points or points that leave more than one conic
    (four on a line, or equal ones).
    """
    if x.ndim != 2 or x.shape[1] != 3 or len(x) < 5 or not np.isfinite(x).all():
        raise ValueError(f"conic_through needs finite points (N >= 5, 3); got {x.shape}")
    unit = x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-300)
    a, b = np.triu_indices(3)
    rows = unit[:, a] * unit[:, b] * np.where(a == b, 1.0, np.sqrt(2.0))
    _, s, Vt = np.linalg.svd(rows)
    if not s[4] > 1e-12 * s[0]:
        raise ValueError("conic_through needs points that determine one conic")
    C = np.zeros((3, 3))
    C[a, b] = Vt[5] * np.where(a == b, 1.0, np.sqrt(0.5))
    C[b, a] = C[a, b]
    return C


def curvature_sign(Q: F64) -> int:
    """Sign of the Gaussian curvature on a quadric (4, 4) of real points: -sign(det Q), projective.

    1 for ellipsoids, elliptic paraboloids and hyperboloids of two sheets, -1 for saddles, 0 for cones,
    cylinders and planes. K = -det Q / |grad|^4 up to a positive factor, and det(G^-T Q G^-1)
    has the sign of det Q.
    """
    scaled = unit_of(Q, "curvature_sign")
    det = float(np.linalg.det(scaled))
    return 0 if abs(det) < 1e-14 else -int(np.sign(det))


def project_dual_quadric(P: F64, dual_quadric: F64) -> F64:
    """C* = P Q* P' (..., 3, 3): the dual conic of a quadric's outline in cameras (..., 3, 4) (HZ 8.5).

    A line is a tangent of the outline where the plane P'l is tangent to the quadric. For the absolute dual
    quadric it is (3.14).
    """
    return np.asarray(P @ dual_quadric @ np.swapaxes(P, -1, -2))


ABSOLUTE_CONIC = np.eye(3)
"""Omega on the plane at infinity of a metric frame (3.2)."""

ABSOLUTE_DUAL_QUADRIC = np.diag([1.0, 1.0, 1.0, 0.0])
"""Its tangent planes in a metric frame (section 3.4.6, figure 3.7)."""


def image_of_absolute_conic(K: F64) -> F64:
    """omega = K^-T K^-1 (3.13) of calibration matrices (..., 3, 3); ``ValueError`` for singular ones."""
    inverse = inverse_of(K, "image_of_absolute_conic")
    return np.asarray(np.swapaxes(inverse, -1, -2) @ inverse)


def dual_image_of_absolute_conic(K: F64) -> F64:
    """omega* = K K' (3.14), the inverse of omega (3.15); (..., 3, 3)."""
    return np.asarray(K @ np.swapaxes(K, -1, -2))


def calibration_from_dual_image(dual_image: F64) -> F64:
    """K (3, 3), upper triangular with positive focals and K33 = 1, of omega* ~ K K' of any scale and sign.

    The Cholesky factor taken from the last row up. Raises ``ValueError`` where omega* is not definite: no
    real camera has such an image.
    """
    symmetric = (dual_image + dual_image.T) / 2.0
    if symmetric[2, 2] == 0.0 or not np.isfinite(symmetric).all():
        raise ValueError("calibration_from_dual_image needs a finite definite conic")
    try:
        lower = np.linalg.cholesky((symmetric / symmetric[2, 2])[::-1, ::-1])
    except np.linalg.LinAlgError as error:
        raise ValueError("calibration_from_dual_image needs a definite conic; no camera has this") from error
    K = lower[::-1, ::-1]
    return np.asarray(K / K[2, 2])


def calibration_from_image(image: F64) -> F64:
    """K (3, 3) of omega ~ K^-T K^-1 of any scale and sign; refuses as :func:`calibration_from_dual_image`."""
    if not np.isfinite(image).all() or not np.linalg.cond(image) < 1e15:
        raise ValueError("calibration_from_image needs a finite invertible conic")
    return calibration_from_dual_image(np.asarray(np.linalg.inv(image), dtype=np.float64))


def image_of_infinity(P: F64) -> F64:
    """M (..., 3, 3) of cameras (..., 3, 4): takes points (x, 0) of the plane at infinity to the image (3.11).

    K R in a metric frame; the centre has no part in it.
    """
    return P[..., :3]


def dual_quadric_of_plane(K: F64, plane: F64) -> F64:
    """Absolute dual quadric (4, 4) in a projective frame whose first camera is [I 0].

    [[K K', -K K'p], [-p'K K', p'K K'p]] for the plane at infinity (p, 1), p (3,), and the calibration K
    (3, 3) of the first camera (Triggs 1997; HZ 19.2).
    """
    lift = np.vstack([np.eye(3), -plane])
    return np.asarray(lift @ dual_image_of_absolute_conic(K) @ lift.T)


def plane_at_infinity(dual_quadric: F64) -> F64:
    """Unit null vector (4,) of the absolute dual quadric (4, 4): the plane at infinity of its frame.

    Raises ``ValueError`` for entries that are not finite.
    """
    require_finite("plane_at_infinity", dual_quadric)
    s, V = np.linalg.eigh((dual_quadric + dual_quadric.T) / 2.0)
    return np.asarray(V[:, np.abs(s).argmin()])


def angle_between_pixels(image: F64, x: F64, y: F64) -> F64:
    """Angle (rad) between the rays of image points x, y (..., 3) in a camera with omega ``image`` (3, 3).

    cos = x'omega y / root(x'omega x . y'omega y) (HZ 8.6); between vanishing points it is that of directions.
    ``image`` positive definite.
    """
    cosine = form(image, x, y) / np.sqrt(form(image, x, x) * form(image, y, y))
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def angle_between_planes(dual_quadric: F64, plane1: F64, plane2: F64) -> F64:
    """Angle (rad) between the normals of planes (..., 4) by the absolute dual quadric (4, 4) of any frame.

    cos = Pi'Q* Psi / root(Pi'Q* Pi . Psi'Q* Psi) (HZ 3.7), which no projective transform changes.
    """
    Q = dual_quadric * np.sign(np.trace(dual_quadric))
    product = form(Q, plane1, plane1) * form(Q, plane2, plane2)
    return np.asarray(np.arccos(np.clip(form(Q, plane1, plane2) / np.sqrt(product), -1.0, 1.0)))
