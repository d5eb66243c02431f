"""Section 3.6.3: the trifocal tensor, all that three views of points and lines have in common.

T (3, 3, 3) is indexed T[i, j, k] = T_i^jk: i a coordinate of a point of view 1, j and k of lines of views 2
and 3 (Hartley 1997; Hartley and Zisserman, chapter 15). For a point x of view 1 and lines l2, l3 of the
others through its matches, sum x^i l2_j l3_k T_i^jk = 0: every relation of points and lines is this one, with
the right points and lines put in.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.homogeneous import (
    cross_matrix,
    dehomogenize,
    homogenize,
    inverse_of,
    require_finite,
    unit_of,
)
from thesisrecon.geometry.multiview import unit_norm
from thesisrecon.geometry.optimal_triangulation import correct_matches

F64 = NDArray[np.float64]


def unit_tensor(T: F64) -> F64:
    """T with norm 1 (zeros stay zeros); (3, 3, 3)."""
    norm = float(np.linalg.norm(T))
    return T / norm if norm > 0.0 else T


def tensor_from_cameras(P1: F64, P2: F64, P3: F64) -> F64:
    """T_i^jk = (-1)^i det [P1 without row i; row j of P2; row k of P3], unit norm (HZ 17.12), i from 0.

    For P1 = [I 0], P2 = [A a], P3 = [B b] it is A_ji b_k - a_j B_ki. Cameras (3, 4) of any frame and scales.
    Zero where all three centres coincide. Raises ``ValueError`` for cameras that are zero or not finite.
    """
    P1, P2, P3 = (unit_of(P, "tensor_from_cameras") for P in (P1, P2, P3))
    T = np.empty((3, 3, 3))
    for i in range(3):
        rows = np.empty((3, 3, 4, 4))
        rows[:, :, :2] = np.delete(P1, i, axis=0)
        rows[:, :, 2], rows[:, :, 3] = P2[:, None], P3[None]
        T[i] = (-1.0) ** i * np.linalg.det(rows)
    return unit_tensor(T)


def incidences(T: F64, x1: F64, l2: F64, l3: F64) -> F64:
    """sum x^i l2_j l3_k T_i^jk of points (..., 3) of view 1 and lines (..., 3) of views 2 and 3; (...)."""
    return np.asarray(np.einsum("...i,...j,...k,ijk->...", x1, l2, l3, T))


def point_residuals(T: F64, x1: F64, x2: F64, x3: F64) -> F64:
    """[x2]x (sum x^i T_i) [x3]x (..., 3, 3): 0 for the images (..., 3) of one point (HZ 15.7).

    Nine equations of which four are independent.
    """
    middle = np.einsum("...i,ijk->...jk", x1, T)
    return np.asarray(cross_matrix(x2) @ middle @ cross_matrix(x3))


def line_residuals(T: F64, l1: F64, l2: F64, l3: F64) -> F64:
    """l1 x (l2'T_i l3) (..., 3): 0 for the images (..., 3) of one line of space; two are independent."""
    return np.cross(l1, transfer_lines_to_first(T, l2, l3))


def transfer_lines_to_first(T: F64, l2: F64, l3: F64) -> F64:
    """Lines l_i = l2_j l3_k T_i^jk of view 1 (..., 3); zero for lines of one epipolar plane of views 2, 3."""
    return np.asarray(np.einsum("...j,...k,ijk->...i", l2, l3, T))


def transfer_lines(T: F64, l1: F64, l2: F64) -> F64:
    """Lines of view 3 (..., 3), unit vectors, of the lines l1, l2 (..., 3) in views 1 and 2 (figure 3.15).

    The planes of both lines meet in the line that view 3 sees: l3 is the null vector of [l1]x (l2_j T_i^jk),
    for which l1 and the line transferred back are parallel vectors. Not determined where both lines belong to
    one epipolar plane of views 1 and 2. Raises ``ValueError`` for entries that are not finite.
    """
    require_finite("transfer_lines", T, l1, l2)
    M = np.einsum("...j,ijk->...ik", l2, T)
    scaled = l1 / np.maximum(np.linalg.norm(l1, axis=-1, keepdims=True), 1e-300)
    return np.asarray(np.linalg.svd(cross_matrix(scaled) @ M)[2][..., 2, :])


def point_transfer_homography(T: F64, l2: F64) -> F64:
    """H (..., 3, 3) = l2_j T_i^jk from view 1 to view 3 through the plane that view 2 sees as l2 (..., 3)."""
    return np.asarray(np.einsum("...j,ijk->...ki", l2, T))


def transfer_points(T: F64, xy1: F64, xy2: F64) -> F64:
    """Pixels (N, 2) in view 3 of matches (N, 2), (N, 2) of views 1 and 2 (figure 3.14).

    The matches are first moved to the nearest pair that satisfies the epipolar constraint (6.3.3); then the
    line through x2 across its epipolar line transfers x1 (HZ 15.3), so the result does not hang on the choice
    of that line. Unlike the meet of two epipolar lines it also serves points of the plane of the three
    centres; only points of the line through the centres of views 1 and 2 have no transfer (inf or NaN).
    """
    F21, _ = fundamentals_from_tensor(T)
    xy1, xy2 = correct_matches(F21, xy1, xy2)
    x1, x2 = homogenize(xy1), homogenize(xy2)
    epipolar = x1 @ F21.T
    across = np.cross(x2, np.column_stack([epipolar[:, :2], np.zeros(len(x2))]))
    return dehomogenize(np.einsum("nki,ni->nk", point_transfer_homography(T, across), x1))


def transfer_by_epipolar_lines(F31: F64, F32: F64, xy1: F64, xy2: F64) -> F64:
    """Pixels (N, 2) in view 3 where the epipolar lines of x1 and x2 meet (section 3.6.3); for comparison.

    F31, F32 (3, 3) take points of views 1 and 2 to lines of view 3. inf or NaN where the lines coincide,
    which they do for every point of the plane of the three centres.
    """
    return dehomogenize(np.cross(homogenize(xy1) @ F31.T, homogenize(xy2) @ F32.T))


def tensor_epipoles(T: F64) -> tuple[F64, F64]:
    """Unit epipoles e2, e3 (3,) of the first camera in views 2 and 3 (HZ algorithm 15.1).

    e2 is orthogonal to the three left null vectors u_i of the T_i (u_i'T_i = 0), e3 to the right ones.
    Least squares where T has noise. Raises ``ValueError`` for entries that are not finite.
    """
    require_finite("tensor_epipoles", T)
    U, _, Vt = np.linalg.svd(T)
    return np.linalg.svd(U[:, :, 2])[2][2], np.linalg.svd(Vt[:, 2])[2][2]


def fundamentals_from_tensor(T: F64) -> tuple[F64, F64]:
    """F21 = [e2]x [T_1, T_2, T_3] e3 and F31 = [e3]x [T_1', T_2', T_3'] e2, unit norm (HZ 15.1).

    x2'F21 x1 = 0, x3'F31 x1 = 0. The third, of views 2 and 3, follows from the cameras.
    """
    e2, e3 = tensor_epipoles(T)
    F21 = cross_matrix(e2) @ np.einsum("ijk,k->ji", T, e3)
    F31 = cross_matrix(e3) @ np.einsum("ijk,j->ki", T, e2)
    return unit_norm(F21), unit_norm(F31)


def cameras_from_tensor(T: F64) -> tuple[F64, F64, F64]:
    """P1 = [I 0], P2 = [[T_1, T_2, T_3] e3, e2], P3 = [(e3 e3' - I) [T_1', T_2', T_3'] e2, e3] (HZ 15.1).

    Three cameras (3, 4) of one projective frame whose tensor is T (3, 3, 3), where T is that of cameras at
    all; the epipoles have unit norm, which the formula of P3 needs.
    """
    e2, e3 = tensor_epipoles(T)
    A = np.einsum("ijk,k->ji", T, e3)
    B = (np.outer(e3, e3) - np.eye(3)) @ np.einsum("ijk,j->ki", T, e2)
    return np.eye(3, 4), np.column_stack([A, e2]), np.column_stack([B, e3])


def transform_tensor(T: F64, H1: F64, H2: F64, H3: F64) -> F64:
    """T in image coordinates x' = H x of the three views (3, 3): H1^-1 on points, H2 and H3 on T's others.

    Tensor rule T'_i^jk = (H1^-1)^r_i H2^j_s H3^k_t T_r^st; unit norm. ``ValueError`` for a singular H1.
    """
    return unit_tensor(np.einsum("ri,js,kt,rst->ijk", inverse_of(H1, "transform_tensor"), H2, H3, T))


def reordered_tensor(T: F64, order: tuple[int, int, int]) -> F64:
    """The tensor (3, 3, 3) of the same views in another order, 0-based, e.g. (2, 0, 1) puts view 3 first.

    Swapping views 2 and 3 only swaps indices; a new first view goes through the cameras. Raises
    ``ValueError`` for an order that is not one of 0, 1, 2.
    """
    if sorted(order) != [0, 1, 2]:
        raise ValueError(f"reordered_tensor needs an order of 0, 1, 2; got {order}")
    if order[0] == 0:
        return T if order[1] == 1 else np.swapaxes(T, 1, 2)
    P = cameras_from_tensor(T)
    return tensor_from_cameras(P[order[0]], P[order[1]], P[order[2]])
