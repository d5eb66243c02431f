"""Sections 3.6.1 and 3.6.4: homographies between views and their relation to F and the cameras."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry._checks import checked_unit
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import require_finite
from thesisrecon.geometry.two_view import unit_norm


def plane_homography(P1: F64, P2: F64, plane: F64) -> F64:
    """Return the homography x2 ~ H x1 of unit norm between two images induced by a plane.

    H = P2 ((Pi'C) I - C Pi') P1^+ with the centre C of P1: the ray of a pixel meets the plane and the point
    is projected. For P1 = [I 0], P2 = [M m] and the plane (pi, 1) it is H_Pi = M - m pi' (3.29), which maps
    the point (x, -pi'x) to its image; [M m] = [H_Pi + e2 pi', e2] with the epipole e2 = m (3.36-3.40). In
    general it equals H_Pi2 H_Pi1^-1 (3.30), also for planes through the origin.

    Parameters
    ----------
    P1, P2, plane : ndarray (3, 4), (3, 4) and (4,)
        Cameras and plane that does not contain the first centre.

    Returns
    -------
    ndarray (3, 3)
        Singular if the plane contains the second centre.
    """
    P1, P2, plane = (checked_unit(array, "plane_homography") for array in (P1, P2, plane))
    centre = checked_unit(camera_centre(P1), "plane_homography, for the centre of its first camera,")
    if not abs(plane @ centre) > 1e-14:
        raise ValueError("plane_homography needs a plane that does not contain the first camera's centre")
    meet = (plane @ centre) * np.eye(4) - np.outer(centre, plane)
    return unit_norm(np.asarray(P2 @ meet @ np.linalg.pinv(P1)))


def infinite_homography(P1: F64, P2: F64) -> F64:
    """Return H = M2 M1^-1 (3.31), the homography of the plane (0, 0, 0, 1), of unit norm.

    K2 R2 R1' K1^-1 in a metric frame (3.28, where the thesis' R are transposed), for any centres.

    Parameters
    ----------
    P1, P2 : ndarray (3, 4)
        Cameras, the first not at infinity.

    Returns
    -------
    ndarray (3, 3)
    """
    require_finite("infinite_homography", P1, P2)
    if not np.linalg.cond(P1[:, :3]) < 1e14:
        raise ValueError("infinite_homography needs a finite first camera")
    H = np.linalg.solve(P1[:, :3].T, P2[:, :3].T).T
    return unit_norm(np.asarray(H, dtype=np.float64))
