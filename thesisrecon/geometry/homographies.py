"""Sections 3.6.1 and 3.6.4: homographies between views, and what they have to do with F and the cameras."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import cross_matrix, require_finite, unit_of
from thesisrecon.geometry.two_view import epipoles, unit_norm


def image_from_plane(P: F64, plane: F64) -> F64:
    """H_Pi = M - m pi' (3.29): takes the point (x, -pi'x) of the plane (pi, 1) to its image; (3, 3).

    P (3, 4); ``plane`` (4,) with any fourth entry but 0. Singular where the plane holds the camera's centre.
    Raises ``ValueError`` for a plane through the origin, which x cannot coordinate:
    :func:`plane_homography` takes such a plane, too.
    """
    if not abs(plane[3]) > 1e-14 * np.linalg.norm(plane):
        raise ValueError("image_from_plane needs a plane that does not hold the origin")
    return np.asarray(P[:, :3] - np.outer(P[:, 3], plane[:3] / plane[3]))


def plane_homography(P1: F64, P2: F64, plane: F64) -> F64:
    """H (3, 3), unit norm, that takes the image in P1 of every point of a plane (4,) to its image in P2.

    H = P2 ((Pi'C) I - C Pi') P1^+ with the centre C of P1: the ray of a pixel meets the plane, and the point
    is seen again. It equals H_Pi2 H_Pi1^-1 (3.30), without its exception of planes through the origin.
    Singular where the plane holds the second centre; raises ``ValueError`` where it holds the first one, and
    for cameras and planes that are zero or not finite.
    """
    P1, P2, plane = (unit_of(array, "plane_homography") for array in (P1, P2, plane))
    centre = unit_of(camera_centre(P1), "plane_homography, for the centre of its first camera,")
    if not abs(plane @ centre) > 1e-14:
        raise ValueError("plane_homography needs a plane that does not hold the first camera's centre")
    meet = (plane @ centre) * np.eye(4) - np.outer(centre, plane)
    return unit_norm(np.asarray(P2 @ meet @ np.linalg.pinv(P1)))


def infinite_homography(P1: F64, P2: F64) -> F64:
    """H = M2 M1^-1 (3.31), unit norm, for the plane (0, 0, 0, 1); (3, 4), (3, 4) -> (3, 3).

    K2 R2 R1' K1^-1 in a metric frame (3.28, where the thesis' R are transposed), whatever the centres are;
    in an affine one it still is the homography of the plane at infinity, in a projective one that of a plane
    like others. Raises ``ValueError`` for a first camera at infinity and for entries that are not finite.
    """
    require_finite("infinite_homography", P1, P2)
    if not np.linalg.cond(P1[:, :3]) < 1e14:
        raise ValueError("infinite_homography needs a finite first camera")
    H = np.linalg.solve(P1[:, :3].T, P2[:, :3].T).T
    return unit_norm(np.asarray(H, dtype=np.float64))


def fundamental_from_homography(H: F64, e2: F64) -> F64:
    """F = [e2]x H, unit norm, of the homography (3, 3) of any plane and the epipole e2 (3,) in view 2 (3.37).

    The line of x is that of its epipole and its place H x. Raises ``ValueError`` for a zero epipole.
    """
    if not np.linalg.norm(e2) > 0.0:
        raise ValueError("fundamental_from_homography needs an epipole; equal centres have none")
    return unit_norm(cross_matrix(e2 / np.linalg.norm(e2)) @ H)


def homographies_of_fundamental(F: F64, *, plane: F64 | None = None) -> F64:
    """H = -[e2]x F / |e2|^2 + e2 v' of all planes, v (3,) = ``plane`` free (3.39, 3.41); (3, 3).

    (3.41) is the member v = 0, without its sign and scale: the plane through the second centre whose image
    there is the line e2, hence singular. Here [e2]x H = F exactly, with the sign, for unit e2 and F of unit
    norm.
    """
    F = unit_norm(F)
    _, e2 = epipoles(F)
    H = -cross_matrix(e2) @ F
    return H if plane is None else H + np.outer(e2, plane)


def homography_through_line(F: F64, line2: F64) -> F64:
    """H = [l]x F (proof of (3.41)): x goes to where its epipolar line meets a line (3,) of view 2; (3, 3).

    The homography of the plane that view 2 sees as that line. Of rank 2; rank 1 where the line holds e2.
    """
    return np.asarray(cross_matrix(line2) @ F)


def compatibility_residual(H: F64, F: F64) -> float:
    """|H'F + F'H| / (|H| |F|): 0 where H is the homography of some plane for the pair (HZ 13.3).

    x' = H x lies on F x for every x exactly where H'F is antisymmetric.
    """
    S = H.T @ F
    return float(np.linalg.norm(S + S.T) / (np.linalg.norm(H) * np.linalg.norm(F)))


def second_camera(H: F64, e2: F64, *, plane: F64 | None = None) -> F64:
    """P2 = [H + e2 pi', e2] (3.40) beside P1 = [I 0]; H (3, 3), e2 (3,), pi (3,) = ``plane`` -> (3, 4).

    H is the homography of the plane (pi, 1) of the frame, that of W = 0 where ``plane`` is None (3.37). H and
    e2 must have their true ratio of scales, up to one common factor of e2 that the frame absorbs.
    """
    M = H if plane is None else H + np.outer(e2, plane)
    return np.hstack([M, e2[:, None]])


def plane_of_homography(H: F64, P2: F64) -> tuple[F64, float]:
    """Plane (4,), unit norm, of the homography H (3, 3) between P1 = [I 0] and P2 (3, 4), and its residual.

    Least squares of s H = M - m pi' over s and pi (3.38); the residual |s H - M + m pi'| / |M| is 0 for
    a true homography. Raises ``ValueError`` where the cameras share their centre (m = 0).
    """
    M, m = P2[:, :3], P2[:, 3]
    squared = float(m @ m)
    if not squared > 1e-28 * float(np.sum(M**2)):
        raise ValueError("plane_of_homography needs cameras with different centres")
    # Orthogonally to m the unknown plane has no effect, so s is found there alone.
    away = np.eye(3) - np.outer(m, m) / squared
    h, g = away @ H, away @ M
    size = float(np.sum(h**2))
    s = float(np.sum(h * g)) / size if size > 0.0 else 0.0
    pi = (M - s * H).T @ m / squared
    plane = np.append(pi, 1.0)
    residual = float(np.linalg.norm(s * H - M + np.outer(m, pi)) / np.linalg.norm(M))
    return plane / np.linalg.norm(plane), residual
