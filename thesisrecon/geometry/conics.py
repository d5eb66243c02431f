"""Section 3.4.6: conics, quadrics, their duals, and the absolute conic.

One algebra serves both dimensions: C is a conic (3, 3) of the points x'C x = 0 (3.1) or a quadric (4, 4) with
X'Q X = 0 (3.8); its dual has l'C* l = 0 (3.3) or Pi'Q* Pi = 0 (3.9). All are symmetric and of any scale. How
they transform: :mod:`~thesisrecon.geometry.strata`.

The absolute conic Omega is x'x = 0 on the plane at infinity (3.2); its tangent planes form the absolute dual
quadric. The image of Omega depends on K alone, not on the pose (3.11-3.13): it calibrates and measures
angles.
"""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import checked_inverse, checked_unit, require_finite

ABSOLUTE_CONIC = np.eye(3)
"""Omega on the plane at infinity of a metric frame (3.2)."""
ABSOLUTE_DUAL_QUADRIC = np.diag([1.0, 1.0, 1.0, 0.0])
"""Its tangent planes in a metric frame (section 3.4.6, figure 3.7)."""


def bilinear_form(C: F64, x: F64, y: F64) -> F64:
    """Return S(x, y) = x'C y (3.5).

    Parameters
    ----------
    C : ndarray (..., d, d), conics or quadrics
    x, y : ndarray (..., d), homogeneous points

    Returns
    -------
    ndarray (...), values of the form
    """
    return np.asarray(np.einsum("...i,...ij,...j->...", x, C, y))


def incidence_residual(C: F64, x: F64) -> F64:
    """Return |x'C x| / (|C| |x|^2), 0 on the conic or quadric (3.1, 3.8).

    Parameters
    ----------
    C : ndarray (..., d, d), conics or quadrics, or their duals (3.3, 3.9)
    x : ndarray (..., d), points, or lines or planes for duals

    Returns
    -------
    ndarray (...), residuals in [0, 1]

    Examples
    --------
    >>> circle = np.diag([1.0, 1.0, -1.0])
    >>> float(incidence_residual(circle, np.array([1.0, 0.0, 1.0])))
    0.0
    """
    size = np.linalg.norm(C, axis=(-2, -1)) * np.sum(x**2, axis=-1)
    return np.asarray(np.abs(bilinear_form(C, x, x)) / np.maximum(size, 1e-300))


def dual(C: F64) -> F64:
    """Return the dual C* ~ C^-1 (3.4) or Q* ~ Q^-1 (3.10): tangent lines or tangent planes.

    It is the adjugate, by singular values, so that a conic of rank 2 (two lines) has a dual too: their common
    point, twice. Lower ranks give zero. The dual of the dual is the conic if that has full rank.

    Parameters
    ----------
    C : ndarray (3, 3) or (4, 4), conic or quadric

    Returns
    -------
    ndarray, dual conic or quadric, of the shape of ``C``

    Raises
    ------
    ValueError
        An entry is not finite.

    Examples
    --------
    >>> C = dual(np.diag([1.0, 1.0, -4.0]))
    >>> np.allclose(C / C[2, 2], np.diag([-4.0, -4.0, 1.0]))
    True
    """
    require_finite("dual", C)
    U, s, Vt = np.linalg.svd(C)
    others = np.array([np.prod(np.delete(s, k)) for k in range(len(s))])
    sign = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    return np.asarray(sign * (Vt.T * others) @ U.T)


def tangent(C: F64, x: F64) -> F64:
    """Return the tangent line C x (3.7) or tangent plane Q X.

    For points off the conic or quadric it is their polar: the line or plane through the points of tangency.

    Parameters
    ----------
    C : ndarray (d, d), conic or quadric
    x : ndarray (..., d), homogeneous points

    Returns
    -------
    ndarray (..., d), lines or planes

    Examples
    --------
    >>> tangent(np.diag([1.0, 1.0, -1.0]), np.array([0.0, 1.0, 1.0])).tolist()
    [0.0, 1.0, -1.0]
    """
    return np.asarray(x @ C)


def tangency_discriminant(C: F64, x: F64, y: F64) -> F64:
    """Return S(x, y)^2 - S(x) S(y) (3.6), 0 if the line of x and y is tangent, positive if it intersects.

    Parameters
    ----------
    C : ndarray (d, d), conic or quadric
    x, y : ndarray (..., d), two homogeneous points of the line

    Returns
    -------
    ndarray (...), discriminants

    Notes
    -----
    The square is missing in (3.6) of the thesis' text.
    """
    return np.asarray(bilinear_form(C, x, y) ** 2 - bilinear_form(C, x, x) * bilinear_form(C, y, y))


def intersect_line(C: F64, x: F64, y: F64) -> F64:
    """Intersect a conic or quadric with the line of two points (3.5).

    Solves a^2 S(x) + 2 a b S(x, y) + b^2 S(y) = 0 for the points a x + b y, in homogeneous form, so that x
    and y themselves can be solutions.

    Parameters
    ----------
    C : ndarray (d, d), conic or quadric
    x, y : ndarray (d,), homogeneous points

    Returns
    -------
    ndarray (0, d), (1, d) or (2, d)
        Real points; one for a tangent (discriminant 0 to rounding), none for a line that lies on the quadric.

    Raises
    ------
    ValueError
        A point or the conic is zero or not finite.

    Examples
    --------
    >>> circle = np.diag([1.0, 1.0, -1.0])
    >>> X = intersect_line(circle, np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
    >>> np.sort(X[:, 0] / X[:, 2]).round(9).tolist()
    [-1.0, 1.0]
    """
    x, y, C = (checked_unit(array, "intersect_line") for array in (x, y, C))
    sxx, sxy, syy = (
        float(bilinear_form(C, x, x)),
        float(bilinear_form(C, x, y)),
        float(bilinear_form(C, y, y)),
    )
    size = max(abs(sxx), abs(sxy), abs(syy))
    # The forms of unit vectors have rounding errors of about 1e-15.
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
    """Return the real tangents of a conic through an image point.

    They touch where the polar of x meets the conic.

    Parameters
    ----------
    C : ndarray (3, 3), conic of full rank
    x : ndarray (3,), homogeneous image point

    Returns
    -------
    ndarray (0, 3), (1, 3) or (2, 3), lines; one for a point of the conic

    Raises
    ------
    ValueError
        The point or the conic is zero or not finite.
    """
    require_finite("tangents_from", C, x)
    basis = np.linalg.svd(tangent(C, x)[None])[2][1:]
    return tangent(C, intersect_line(C, basis[0], basis[1]))


def conic_through(x: F64) -> F64:
    """Fit the conic with the least sum of squared x'C x to points.

    Parameters
    ----------
    x : ndarray (N, 3), N >= 5 homogeneous points; exact for 5

    Returns
    -------
    ndarray (3, 3), conic of unit norm

    Raises
    ------
    ValueError
        There are fewer points, or they leave more than one conic (four on a line, or equal points).

    Examples
    --------
    >>> x = np.array([[1.0, 0, 1], [-1.0, 0, 1], [0, 1.0, 1], [0, -1.0, 1], [0.6, 0.8, 1]])
    >>> C = conic_through(x)
    >>> np.allclose(C / C[0, 0], np.diag([1.0, 1.0, -1.0]))
    True
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
    """Return the sign of the Gaussian curvature of a quadric's real points, a projective invariant.

    K = -det Q / |grad|^4 up to a positive factor, and det(G^-T Q G^-1) has the sign of det Q.

    Parameters
    ----------
    Q : ndarray (4, 4), quadric

    Returns
    -------
    int
        1 for ellipsoids, elliptic paraboloids and hyperboloids of two sheets, -1 for saddles, 0 for cones,
        cylinders and planes.

    Raises
    ------
    ValueError
        The quadric is zero or not finite.
    """
    scaled = checked_unit(Q, "curvature_sign")
    det = float(np.linalg.det(scaled))
    return 0 if abs(det) < 1e-14 else -int(np.sign(det))


def project_dual_quadric(P: F64, dual_quadric: F64) -> F64:
    """Project a dual quadric to the dual conic of its outline: C* = P Q* P' (HZ 8.5).

    A line is tangent to the outline if its plane P'l is tangent to the quadric. (3.14) is the case of the
    absolute dual quadric.

    Parameters
    ----------
    P : ndarray (..., 3, 4), cameras
    dual_quadric : ndarray (4, 4), dual quadric

    Returns
    -------
    ndarray (..., 3, 3), dual conics

    Examples
    --------
    >>> P = np.diag([800.0, 800.0, 1.0]) @ np.eye(3, 4)
    >>> np.diag(project_dual_quadric(P, ABSOLUTE_DUAL_QUADRIC)).tolist()
    [640000.0, 640000.0, 1.0]
    """
    return np.asarray(P @ dual_quadric @ np.swapaxes(P, -1, -2))


def image_of_absolute_conic(K: F64) -> F64:
    """Return omega = K^-T K^-1 (3.13).

    Parameters
    ----------
    K : ndarray (..., 3, 3), calibration matrices

    Returns
    -------
    ndarray (..., 3, 3), images of the absolute conic

    Raises
    ------
    ValueError
        A matrix is singular or not finite.

    Examples
    --------
    >>> image_of_absolute_conic(np.diag([2.0, 2.0, 1.0])).tolist()
    [[0.25, 0.0, 0.0], [0.0, 0.25, 0.0], [0.0, 0.0, 1.0]]
    """
    inverse = checked_inverse(K, "image_of_absolute_conic")
    return np.asarray(np.swapaxes(inverse, -1, -2) @ inverse)


def dual_image_of_absolute_conic(K: F64) -> F64:
    """Return omega* = K K' (3.14), the inverse of omega (3.15).

    Parameters
    ----------
    K : ndarray (..., 3, 3), calibration matrices

    Returns
    -------
    ndarray (..., 3, 3), dual images of the absolute conic
    """
    return np.asarray(K @ np.swapaxes(K, -1, -2))


def calibration_from_dual_image(dual_image: F64) -> F64:
    """Recover K from omega* ~ K K' by the Cholesky factor taken from the last row up.

    Parameters
    ----------
    dual_image : ndarray (3, 3), omega* of any scale and sign

    Returns
    -------
    ndarray (3, 3), K, upper triangular, positive focal lengths, K33 = 1

    Raises
    ------
    ValueError
        omega* is not definite: no real camera has this image.

    Examples
    --------
    >>> calibration_from_dual_image(-np.diag([9.0, 4.0, 1.0])).round(9).tolist()
    [[3.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 1.0]]
    """
    symmetric = (dual_image + dual_image.T) / 2.0
    if symmetric[2, 2] == 0.0 or not np.isfinite(symmetric).all():
        raise ValueError("calibration_from_dual_image needs a finite definite conic")
    try:
        lower = np.linalg.cholesky((symmetric / symmetric[2, 2])[::-1, ::-1])
    except np.linalg.LinAlgError as error:
        raise ValueError(
            "calibration_from_dual_image needs a definite conic; no real camera has this image"
        ) from error
    K = lower[::-1, ::-1]
    return np.asarray(K / K[2, 2])


def calibration_from_image(image: F64) -> F64:
    """Recover K from omega ~ K^-T K^-1.

    Parameters
    ----------
    image : ndarray (3, 3), omega of any scale and sign

    Returns
    -------
    ndarray (3, 3), K, upper triangular, positive focal lengths, K33 = 1

    Raises
    ------
    ValueError
        omega is singular or not definite.
    """
    if not np.isfinite(image).all() or not np.linalg.cond(image) < 1e15:
        raise ValueError("calibration_from_image needs a finite invertible conic")
    return calibration_from_dual_image(np.asarray(np.linalg.inv(image), dtype=np.float64))


def image_of_infinity(P: F64) -> F64:
    """Return M of P = [M m], which maps points (x, 0) of the plane at infinity to the image (3.11).

    Parameters
    ----------
    P : ndarray (..., 3, 4), cameras

    Returns
    -------
    ndarray (..., 3, 3), M, equal to K R in a metric frame; the centre has no effect
    """
    return P[..., :3]


def dual_quadric_of_plane(K: F64, plane: F64) -> F64:
    """Return Q* of a projective frame whose first camera is [I 0].

    Q* = [[K K', -K K'p], [-p'K K', p'K K'p]] (Triggs 1997; HZ 19.2).

    Parameters
    ----------
    K : ndarray (3, 3), calibration of the first camera
    plane : ndarray (3,), p of the plane at infinity (p, 1)

    Returns
    -------
    ndarray (4, 4), absolute dual quadric
    """
    lift = np.vstack([np.eye(3), -plane])
    return np.asarray(lift @ dual_image_of_absolute_conic(K) @ lift.T)


def plane_at_infinity(dual_quadric: F64) -> F64:
    """Return the plane at infinity: the null vector of the absolute dual quadric.

    Parameters
    ----------
    dual_quadric : ndarray (4, 4), absolute dual quadric of any frame

    Returns
    -------
    ndarray (4,), unit plane

    Raises
    ------
    ValueError
        An entry is not finite.

    Examples
    --------
    >>> np.abs(plane_at_infinity(ABSOLUTE_DUAL_QUADRIC)).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    require_finite("plane_at_infinity", dual_quadric)
    s, V = np.linalg.eigh((dual_quadric + dual_quadric.T) / 2.0)
    return np.asarray(V[:, np.abs(s).argmin()])


def angle_between_pixels(image: F64, x: F64, y: F64) -> F64:
    """Return the angle between the rays of pixels, cos = x'omega y / root(x'omega x . y'omega y) (HZ 8.6).

    Parameters
    ----------
    image : ndarray (3, 3), positive definite image of the absolute conic omega
    x, y : ndarray (..., 3), homogeneous image points; vanishing points give the angle between directions

    Returns
    -------
    ndarray (...), angles, rad

    Examples
    --------
    >>> omega = image_of_absolute_conic(np.diag([500.0, 500.0, 1.0]))
    >>> x, y = np.array([0.0, 0.0, 1.0]), np.array([500.0, 0.0, 1.0])
    >>> round(float(np.degrees(angle_between_pixels(omega, x, y))), 9)
    45.0
    """
    cosine = bilinear_form(image, x, y) / np.sqrt(bilinear_form(image, x, x) * bilinear_form(image, y, y))
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def angle_between_planes(dual_quadric: F64, plane1: F64, plane2: F64) -> F64:
    """Return the angle between the normals of planes in any frame.

    cos = Pi'Q* Psi / root(Pi'Q* Pi . Psi'Q* Psi) (HZ 3.7), a projective invariant.

    Parameters
    ----------
    dual_quadric : ndarray (4, 4), absolute dual quadric of the frame
    plane1, plane2 : ndarray (..., 4), planes

    Returns
    -------
    ndarray (...), angles, rad
    """
    Q = dual_quadric * np.sign(np.trace(dual_quadric))
    product = bilinear_form(Q, plane1, plane1) * bilinear_form(Q, plane2, plane2)
    return np.asarray(np.arccos(np.clip(bilinear_form(Q, plane1, plane2) / np.sqrt(product), -1.0, 1.0)))
