"""Section 3.6.3: the trifocal tensor of three views, and its linear equations.

T (3, 3, 3) is indexed T[i, j, k] = T_i^jk: i is a coordinate of a point of view 1, j and k of lines of views
2 and 3 (Hartley 1997; Hartley and Zisserman, chapter 15). A point x of view 1 and lines l2, l3 through its
matches satisfy sum x^i l2_j l3_k T_i^jk = 0; every relation of points and lines follows from this one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry._checks import checked_unit
from thesisrecon.geometry.homogeneous import (
    cross_matrix,
    dehomogenize,
    homogenize,
    normalizing_transform,
    require_finite,
    require_shapes,
    unit_normals,
)
from thesisrecon.geometry.optimal_triangulation import correct_matches
from thesisrecon.geometry.two_view import unit_norm

NEEDED_EQUATIONS = 26
"""Seven points, thirteen lines, or a mixture (HZ 16.1)."""
_MAX_PX = 1e15
"""Largest coordinate: beyond, fourth powers overflow and a double resolves no fraction of a pixel."""


def unit_tensor(T: F64) -> F64:
    """Scale a tensor to unit norm; zeros stay zeros.

    Parameters
    ----------
    T : ndarray (3, 3, 3)
        Tensor.

    Returns
    -------
    ndarray (3, 3, 3)
    """
    norm = float(np.linalg.norm(T))
    return T / norm if norm > 0.0 else T


def tensor_from_cameras(P1: F64, P2: F64, P3: F64) -> F64:
    """Return T_i^jk = (-1)^i det [P1 without row i; row j of P2; row k of P3] (HZ 17.12), i from 0.

    For P1 = [I 0], P2 = [A a], P3 = [B b] it is A_ji b_k - a_j B_ki.

    Parameters
    ----------
    P1, P2, P3 : ndarray (3, 4)
        Cameras of any frame and scale.

    Returns
    -------
    ndarray (3, 3, 3)
        T of unit norm; zero if all three centres coincide.
    """
    P1, P2, P3 = (checked_unit(P, "tensor_from_cameras") for P in (P1, P2, P3))
    T = np.empty((3, 3, 3))
    for i in range(3):
        rows = np.empty((3, 3, 4, 4))
        rows[:, :, :2] = np.delete(P1, i, axis=0)
        rows[:, :, 2], rows[:, :, 3] = P2[:, None], P3[None]
        T[i] = (-1.0) ** i * np.linalg.det(rows)
    return unit_tensor(T)


def point_residuals(T: F64, x1: F64, x2: F64, x3: F64) -> F64:
    """Return [x2]x (sum x^i T_i) [x3]x (HZ 15.7), nine equations of which four are independent.

    Parameters
    ----------
    T : ndarray (3, 3, 3)
        Tensor.
    x1, x2, x3 : ndarray (..., 3)
        Homogeneous points of the three views.

    Returns
    -------
    ndarray (..., 3, 3)
        0 for the images of one point.
    """
    middle = np.einsum("...i,ijk->...jk", x1, T)
    return np.asarray(cross_matrix(x2) @ middle @ cross_matrix(x3))


def line_residuals(T: F64, l1: F64, l2: F64, l3: F64) -> F64:
    """Return l1 x (l2_j l3_k T_i^jk), three equations of which two are independent.

    Parameters
    ----------
    T : ndarray (3, 3, 3)
        Tensor.
    l1, l2, l3 : ndarray (..., 3)
        Lines of the three views.

    Returns
    -------
    ndarray (..., 3)
        0 for the images of one line of space.
    """
    return np.cross(l1, np.einsum("...j,...k,ijk->...i", l2, l3, T))


def transfer_lines(T: F64, l1: F64, l2: F64) -> F64:
    """Transfer lines of views 1 and 2 to view 3 (figure 3.15).

    The planes of both lines meet in the line that view 3 sees: l3 is the null vector of [l1]x (l2_j T_i^jk).
    It is undetermined if both lines belong to one epipolar plane of views 1 and 2.

    Parameters
    ----------
    T : ndarray (3, 3, 3)
        Tensor.
    l1, l2 : ndarray (..., 3)
        Lines of views 1 and 2.

    Returns
    -------
    ndarray (..., 3)
        Unit lines of view 3.
    """
    require_finite("transfer_lines", T, l1, l2)
    M = np.einsum("...j,ijk->...ik", l2, T)
    scaled = l1 / np.maximum(np.linalg.norm(l1, axis=-1, keepdims=True), 1e-300)
    return np.asarray(np.linalg.svd(cross_matrix(scaled) @ M)[2][..., 2, :])


def transfer_points(T: F64, xy1: F64, xy2: F64) -> F64:
    """Transfer matches of views 1 and 2 to view 3 (figure 3.14).

    The matches are moved to the nearest pair that satisfies the epipolar constraint (6.3.3); then the line l2
    through x2 perpendicular to its epipolar line transfers x1 by the homography l2_j T_i^jk (HZ 15.3). Unlike
    the intersection of two epipolar lines this is valid for points of the plane of the three centres.

    Parameters
    ----------
    T : ndarray (3, 3, 3)
        Tensor.
    xy1, xy2 : ndarray (N, 2)
        Matches of views 1 and 2, px.

    Returns
    -------
    ndarray (N, 2)
        Pixels of view 3; inf or NaN for points of the line through the centres of views 1 and 2.
    """
    F21, _ = fundamentals_from_tensor(T)
    xy1, xy2 = correct_matches(F21, xy1, xy2)
    x1, x2 = homogenize(xy1), homogenize(xy2)
    epipolar = x1 @ F21.T
    across = np.cross(x2, np.column_stack([epipolar[:, :2], np.zeros(len(x2))]))
    return dehomogenize(np.einsum("nki,ni->nk", np.einsum("nj,ijk->nki", across, T), x1))


def transfer_by_epipolar_lines(F31: F64, F32: F64, xy1: F64, xy2: F64) -> F64:
    """Transfer matches of views 1 and 2 to the intersection of their epipolar lines in view 3 (3.6.3).

    Parameters
    ----------
    F31, F32 : ndarray (3, 3)
        Fundamental matrices from views 1 and 2 to view 3.
    xy1, xy2 : ndarray (N, 2)
        Matches of views 1 and 2, px.

    Returns
    -------
    ndarray (N, 2)
        Pixels of view 3; inf or NaN if the lines coincide, as for points of the plane of the three centres.
    """
    return dehomogenize(np.cross(homogenize(xy1) @ F31.T, homogenize(xy2) @ F32.T))


def tensor_epipoles(T: F64) -> tuple[F64, F64]:
    """Return the unit epipoles of the first camera in views 2 and 3 (HZ algorithm 15.1).

    e2 is orthogonal to the left null vectors u_i of the T_i (u_i'T_i = 0), e3 to the right ones; least
    squares for a noisy T.

    Parameters
    ----------
    T : ndarray (3, 3, 3)
        Tensor.

    Returns
    -------
    e2, e3 : ndarray (3,)
    """
    require_finite("tensor_epipoles", T)
    U, _, Vt = np.linalg.svd(T)
    return np.linalg.svd(U[:, :, 2])[2][2], np.linalg.svd(Vt[:, 2])[2][2]


def fundamentals_from_tensor(T: F64) -> tuple[F64, F64]:
    """Return F21 = [e2]x [T_1, T_2, T_3] e3 and F31 = [e3]x [T_1', T_2', T_3'] e2 of unit norm (HZ 15.1).

    Parameters
    ----------
    T : ndarray (3, 3, 3)
        Tensor.

    Returns
    -------
    F21, F31 : ndarray (3, 3)
        x2'F21 x1 = 0 and x3'F31 x1 = 0.
    """
    e2, e3 = tensor_epipoles(T)
    F21 = cross_matrix(e2) @ np.einsum("ijk,k->ji", T, e3)
    F31 = cross_matrix(e3) @ np.einsum("ijk,j->ki", T, e2)
    return unit_norm(F21), unit_norm(F31)


def cameras_from_tensor(T: F64) -> tuple[F64, F64, F64]:
    """Return [I 0], [[T_1, T_2, T_3] e3, e2] and [(e3 e3' - I) [T_1', T_2', T_3'] e2, e3] (HZ 15.1).

    Parameters
    ----------
    T : ndarray (3, 3, 3)
        Tensor of cameras.

    Returns
    -------
    P1, P2, P3 : ndarray (3, 4)
        Cameras of one projective frame with tensor T.
    """
    e2, e3 = tensor_epipoles(T)
    A = np.einsum("ijk,k->ji", T, e3)
    B = (np.outer(e3, e3) - np.eye(3)) @ np.einsum("ijk,j->ki", T, e2)
    return np.eye(3, 4), np.column_stack([A, e2]), np.column_stack([B, e3])


@dataclass(frozen=True)
class TensorEquations:
    """Linear equations A t = 0 of the tensor entries t, in conditioned image coordinates.

    Parameters
    ----------
    A : ndarray (27, 27)
        Triangular factor of all equations, with the same |A t|.
    noise : ndarray (27, 27)
        Triangular factor of their derivatives by the pixels: |noise t|^2 is the mean of |A t|^2 for the true
        t and noise of 1 px.
    transforms : ndarray (3, 3, 3)
        Transforms from pixels to conditioned coordinates.
    """

    A: F64
    noise: F64
    transforms: F64

    def solve(self) -> F64:
        """Return the tensor of least |A t| over all tensors (HZ algorithm 16.1), not one of cameras.

        Returns
        -------
        ndarray (3, 3, 3)
            T of unit norm, in conditioned coordinates.
        """
        _, s, Vt = np.linalg.svd(self.A)
        if not s[25] > 1e-10 * s[0]:
            raise ValueError("the matches leave the tensor free; they need to be in general position")
        return np.asarray(Vt[26].reshape(3, 3, 3))

    def noise_levels_px(self) -> F64:
        """Return the noise that would explain each of 27 solutions of the equations, px, the best first.

        Roots of the eigenvalues of A'A relative to those of unit noise. If the matches leave a family of
        tensors (a plane, a rotation, parallel lines), as many values as the family has dimensions are at or
        below the noise.

        Returns
        -------
        ndarray (27,)

        References
        ----------
        Kanatani, "Statistical Optimization for Geometric Computation" (renormalisation), 1996.
        """
        values, vectors = np.linalg.eigh(self.noise.T @ self.noise)
        whitening = vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1]))
        return np.asarray(np.linalg.svd(self.A @ whitening, compute_uv=False)[::-1])

    def solve_with_epipoles(self, e2: F64, e3: F64) -> F64:
        """Return the tensor of cameras with given epipoles and least |A t| (HZ 16.3).

        T_i^jk = a_i^j e3^k - e2^j b_i^k is linear in the other entries of the cameras: t = E (a, b). E (27,
        18) has rank 15, and t is sought in its range.

        Parameters
        ----------
        e2, e3 : ndarray (3,)
            Epipoles in views 2 and 3.

        Returns
        -------
        ndarray (3, 3, 3)
            T of unit norm, in conditioned coordinates.
        """
        eye = np.eye(3)
        left = np.einsum("ri,sj,k->ijkrs", eye, eye, e3).reshape(27, 9)
        right = np.einsum("ri,j,sk->ijkrs", eye, e2, eye).reshape(27, 9)
        basis = np.linalg.svd(np.hstack([left, -right]))[0][:, :15]
        best = np.linalg.svd(self.A @ basis)[2][14]
        return np.asarray((basis @ best).reshape(3, 3, 3))

    def in_pixels(self, T: F64) -> F64:
        """Transform a conditioned tensor to pixels x' = H x: T'_i^jk = (H1^-1)^r_i H2^j_s H3^k_t T_r^st.

        Parameters
        ----------
        T : ndarray (3, 3, 3)
            Tensor in conditioned coordinates.

        Returns
        -------
        ndarray (3, 3, 3)
            Of unit norm.
        """
        _, H2, H3 = np.linalg.inv(self.transforms)
        return unit_tensor(np.einsum("ri,js,kt,rst->ijk", self.transforms[0], H2, H3, T))


def tensor_equations(points: F64, segments: F64) -> TensorEquations:
    """Set up the linear equations of point and line matches in three views (HZ table 15.1).

    A triplet of points gives four equations, the two axis-parallel lines through x2 with those through x3; a
    triplet of lines gives two, for the two ends of its segment in view 1.

    Parameters
    ----------
    points : ndarray (3, N, 2)
        Point matches, px.
    segments : ndarray (3, M, 2, 2)
        Ends of line matches, px; the ends of different views need not correspond. 4 N + 2 M >= 26.

    Returns
    -------
    TensorEquations
    """
    points, segments = check_triplets(points, segments)
    count = 4 * points.shape[1] + 2 * segments.shape[1]
    if count < NEEDED_EQUATIONS:
        raise ValueError(
            f"a trifocal tensor needs {NEEDED_EQUATIONS} equations, 4 a point and 2 a line; got {count}"
        )
    ends = segments.reshape(3, -1, 2)
    transforms = np.stack([normalizing_transform(xy) for xy in np.concatenate([points, ends], axis=1)])
    x = homogenize(points) @ transforms.swapaxes(1, 2)
    y = homogenize(segments) @ transforms.swapaxes(1, 2)[:, None]
    lines = unit_normals(np.cross(y[:, :, 0], y[:, :, 1]))
    axes2, axes3 = (_axis_parallel_lines(x[v]) for v in (1, 2))
    scales = transforms[:, 0, 0]
    moves = np.eye(3)[:2], -np.eye(3)[2:], -np.eye(3)[2:]
    of_points = [
        _products(x[0][:, None], axes2, axes3),
        _products(moves[0] * scales[0], axes2, axes3),
        _products(x[0][:, None], moves[1] * scales[1], axes3, times=2),
        _products(x[0][:, None], axes2, moves[2] * scales[2], times=2),
    ]
    of_lines = [
        _products(y[0], lines[1][:, None], lines[2][:, None]),
        _products(moves[0] * scales[0], lines[1][:, None], lines[2][:, None], times=2),
        _products(y[0], _line_moves(y[1]) * scales[1], lines[2][:, None]),
        _products(y[0], lines[1][:, None], _line_moves(y[2]) * scales[2]),
    ]
    return TensorEquations(
        _triangular([of_points[0], of_lines[0]]), _triangular(of_points[1:] + of_lines[1:]), transforms
    )


def _products(x: F64, l2: F64, l3: F64, *, times: int = 1) -> F64:
    """Rows x^i l2_j l3_k of every choice of one of (n or 1, a, 3), (n or 1, b, 3), (n or 1, c, 3)."""
    n = max(len(l2), len(l3)) if l2.ndim == 3 and l3.ndim == 3 else len(l2 if l2.ndim == 3 else l3)
    x, l2, l3 = (np.broadcast_to(a, (n, *a.shape[-2:])) for a in (x, l2, l3))
    rows = np.einsum("nai,nbj,nck->nabcijk", x, l2, l3).reshape(-1, 27)
    return np.asarray(np.sqrt(times) * rows)


def _triangular(rows: list[F64]) -> F64:
    """The triangular factor (27, 27) of the stacked rows."""
    return np.asarray(np.linalg.qr(np.concatenate([*rows, np.zeros((27, 27))]), mode="r"))


def _line_moves(ends: F64) -> F64:
    """Derivatives (M, 2, 3) of the unit-normal lines through ends (M, 2, 3) by a move of each across them."""
    along = (ends[:, 1] - ends[:, 0])[:, :2]
    along = along / np.sum(along**2, axis=1, keepdims=True)
    # Weight of the other end in a point of the line, as a function of the point.
    share = np.column_stack([along, -np.sum(along * ends[:, 0, :2], axis=1)])
    return np.stack([np.eye(3)[2] - share, share], axis=1)


def check_triplets(points: F64, segments: F64) -> tuple[F64, F64]:
    """Check shapes, values and lengths of matches of three views and return them as float64 arrays.

    Parameters
    ----------
    points : ndarray (3, N, 2)
        Point matches, px.
    segments : ndarray (3, M, 2, 2)
        Ends of line matches, px.

    Returns
    -------
    points, segments : ndarray
    """
    if np.iscomplexobj(points) or np.iscomplexobj(segments):
        raise ValueError("points and segments must be real numbers; got complex ones")
    points, segments = np.asarray(points, dtype=np.float64), np.asarray(segments, dtype=np.float64)
    require_shapes("a trifocal tensor", points=(points, (3, "N", 2)), segments=(segments, (3, "M", 2, 2)))
    require_finite("a trifocal tensor", points, segments)
    if max(np.abs(points).max(initial=0.0), np.abs(segments).max(initial=0.0)) > _MAX_PX:
        raise ValueError(f"points and segments must be pixels of an image; some are beyond {_MAX_PX:g}")
    if segments.size and not (np.linalg.norm(segments[:, :, 0] - segments[:, :, 1], axis=2) > 0.0).all():
        raise ValueError("a segment needs two different ends; one has no length")
    return points, segments


def _axis_parallel_lines(x: F64) -> F64:
    """Lines x = u and y = v (N, 2, 3) through points (N, 3) whose last coordinate is 1."""
    lines = np.zeros((len(x), 2, 3))
    lines[:, 0, 0] = lines[:, 1, 1] = 1.0
    lines[:, :, 2] = -x[:, :2]
    return lines
