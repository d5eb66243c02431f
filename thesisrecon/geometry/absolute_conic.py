"""Section 3.4.6: the absolute conic, the absolute dual quadric, their images, and what they measure.

The absolute conic Omega is x'x = 0 on the plane at infinity (3.2); its tangent planes are the absolute dual
quadric. The image of Omega depends on K alone, not on the place of the camera (3.11-3.13): it is the
calibration object that is always in sight, and it measures angles.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.conics import form
from thesisrecon.geometry.homogeneous import inverse_of, require_finite

F64 = NDArray[np.float64]

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
