"""Section 3.4.6: conics, quadrics, their duals, and the absolute conic.

C is a conic (3, 3) of the points x'C x = 0 (3.1) or a quadric (4, 4) with X'Q X = 0 (3.8); its dual has
l'C* l = 0 (3.3) or Pi'Q* Pi = 0 (3.9). The tangent line at x is C x, the tangent plane at X is Q X (3.7). All
are symmetric and of any scale; how they transform: :func:`thesisrecon.geometry.strata.transform`.

The absolute conic Omega is x'x = 0 on the plane at infinity (3.2). A camera [M m] maps the point (x, 0) of
that plane to M x (3.11), so that the image of Omega depends on K alone (3.11-3.13).
"""

from __future__ import annotations

import math

import numpy as np

from thesisrecon.arrays import F64, require_finite
from thesisrecon.geometry.conditioning import checked_inverse, checked_unit

ABSOLUTE_CONIC = np.eye(3)
"""Omega on the plane at infinity of a metric frame (3.2)."""
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


def _length_scale(C: F64) -> float:
    """Unit of length, at least 1, in which the blocks of a conic or quadric [A b; b' c] are of similar size.

    It conditions conics and quadrics far from the origin.
    """
    a, b, c = (float(np.linalg.norm(part)) for part in (C[:-1, :-1], C[:-1, -1], C[-1, -1]))
    return max(1.0, b / a, math.sqrt(c / a)) if a > 1e-15 * max(b, c) else 1.0


def intersect_line(C: F64, x: F64, y: F64) -> F64:
    """Real intersections (0 to 2, d) of a conic or quadric with the line of two points (3.5).

    Solves a^2 S(x) + 2 a b S(x, y) + b^2 S(y) = 0 for the points a x + b y. The discriminant S(x, y)^2 - S(x)
    S(y) is 0 for tangents (3.6, where the thesis' text lost the square). None for a line of the quadric.
    """
    require_finite("intersect_line", C)
    units = np.append(np.full(len(C) - 1, _length_scale(C)), 1.0)
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


def curvature_sign(Q: F64) -> int:
    """The sign of the Gaussian curvature of a quadric's real points, a projective invariant (3.4.2).

    K = -det Q / |grad|^4 up to a positive factor, and det(G^-T Q G^-1) has the sign of det Q: 1 for
    ellipsoids, elliptic paraboloids and hyperboloids of two sheets, -1 for saddles, 0 for cones, cylinders
    and planes.
    """
    require_finite("curvature_sign", Q)
    units = np.append(np.full(3, _length_scale(Q)), 1.0)
    det = float(np.linalg.det(checked_unit(units[:, None] * Q * units, "curvature_sign")))
    return 0 if abs(det) < 1e-14 else -int(np.sign(det))


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
    K = lower[::-1, ::-1]
    return np.asarray(K / K[2, 2])
