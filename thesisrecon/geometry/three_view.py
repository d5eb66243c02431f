"""Section 3.6.3: the trifocal tensor, all that three views of points and lines have in common.

T (3, 3, 3) is indexed T[i, j, k] = T_i^jk: i a coordinate of a point of view 1, j and k of lines of views 2
and 3 (Hartley 1997; Hartley and Zisserman, chapter 15). For a point x of view 1 and lines l2, l3 of the
others through its matches, sum x^i l2_j l3_k T_i^jk = 0: every relation of points and lines is this one, with
the right points and lines put in.

Section 3.6.3: the trifocal tensor from points and lines by linear equations.

Every match is brought into one form, a point x of view 1 and lines l2, l3 of the others with
sum x^i l2_j l3_k T_i^jk = 0 (HZ table 15.1): a triplet of points gives four such equations, the two
axis-parallel lines through x2 with those through x3; a triplet of lines two, for the two ends of its segment
in view 1.
The 27 entries of the solution are not those of any cameras; algorithm 15.2 of Hartley and Zisserman, here
:meth:`TensorEquations.solve_with_epipoles`, restores the constraints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import (
    cross_matrix,
    dehomogenize,
    homogenize,
    inverse_of,
    normalizing_transform,
    require_finite,
    unit_of,
)
from thesisrecon.geometry.lines_and_planes import unit_normals
from thesisrecon.geometry.optimal_triangulation import correct_matches
from thesisrecon.geometry.two_view import unit_norm


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


LARGEST_PX = 1e15
"""Beyond, squares of squares overflow, and a double has no fraction of a pixel left."""

NEEDED_EQUATIONS = 26
"""Seven points, thirteen lines, or a mixture (HZ 16.1)."""


@dataclass(frozen=True)
class TensorEquations:
    """A t = 0 for the entries t of the tensor, in conditioned coordinates of each image.

    ``A`` (27, 27) is the triangular factor of all equations, with the same |A t|; ``noise`` (27, 27) that of
    their derivatives by the pixels: |noise t|^2 is the mean of |A t|^2 for the true t and noise of 1 px;
    ``transforms`` (3, 3, 3) take pixels to the conditioned coordinates.
    """

    A: F64
    noise: F64
    transforms: F64

    def solve(self) -> F64:
        """T (3, 3, 3), unit norm, conditioned, with least |A t|; raises ``ValueError`` where it is not one.

        Coplanar points, and lines that all meet one line, leave a family of tensors.
        """
        _, s, Vt = np.linalg.svd(self.A)
        if not s[25] > 1e-10 * s[0]:
            raise ValueError(
                "the matches leave the trifocal tensor free; they need to be in general position"
            )
        return np.asarray(Vt[26].reshape(3, 3, 3))

    def explained_px(self) -> F64:
        """The noise that would explain each of 27 solutions of the equations, px, the best one first; (27,).

        Roots of the eigenvalues of A'A relative to those of unit noise (renormalisation: Kanatani 1996).
        Where the matches leave a family of tensors, as those of a plane, a rotation or parallel lines, as
        many as the family has dimensions are their noise or less, at any noise.
        """
        values, vectors = np.linalg.eigh(self.noise.T @ self.noise)
        whitening = vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1]))
        return np.asarray(np.linalg.svd(self.A @ whitening, compute_uv=False)[::-1])

    def solve_with_epipoles(self, e2: F64, e3: F64) -> F64:
        """T (3, 3, 3), unit norm, of cameras with given epipoles (3,) and least |A t| (HZ 16.3).

        T_i^jk = a_i^j e3^k - e2^j b_i^k is linear in the other entries of the cameras: t = E (a, b). E (27,
        18) has rank 15, and t is sought in its range.
        """
        eye = np.eye(3)
        left = np.einsum("ri,sj,k->ijkrs", eye, eye, e3).reshape(27, 9)
        right = np.einsum("ri,j,sk->ijkrs", eye, e2, eye).reshape(27, 9)
        basis = np.linalg.svd(np.hstack([left, -right]))[0][:, :15]
        best = np.linalg.svd(self.A @ basis)[2][14]
        return np.asarray((basis @ best).reshape(3, 3, 3))

    def in_pixels(self, T: F64) -> F64:
        """A conditioned tensor in pixels, unit norm."""
        H1, H2, H3 = np.linalg.inv(self.transforms)
        return transform_tensor(T, H1, H2, H3)


def tensor_equations(points: F64, segments: F64) -> TensorEquations:
    """Equations of N points (3, N, 2) px and M line segments (3, M, 2, 2) px, by their ends, in three views.

    The ends of a line's segments need not match each other. Raises ``ValueError`` for fewer than 26
    equations, 4 N + 2 M, and as :func:`check_triplets`.
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
    # The share of the other end in a point of the line, as a function of the point.
    share = np.column_stack([along, -np.sum(along * ends[:, 0, :2], axis=1)])
    return np.stack([np.eye(3)[2] - share, share], axis=1)


def check_triplets(points: F64, segments: F64) -> tuple[F64, F64]:
    """Matches of three views as float64 arrays, points (3, N, 2) and segments (3, M, 2, 2) by their ends.

    Raises ``ValueError`` for other shapes, values that are not finite or beyond 1e15, and segments of no
    length.
    """
    if np.iscomplexobj(points) or np.iscomplexobj(segments):
        raise ValueError("points and segments must be real numbers; got complex ones")
    points, segments = np.asarray(points, dtype=np.float64), np.asarray(segments, dtype=np.float64)
    right = points.ndim == 3 and points.shape[::2] == (3, 2)
    if not right or segments.ndim != 4 or (segments.shape[0], *segments.shape[2:]) != (3, 2, 2):
        raise ValueError(
            f"needed points (3, N, 2) and segments (3, M, 2, 2); got {points.shape} and {segments.shape}"
        )
    if not (np.isfinite(points).all() and np.isfinite(segments).all()):
        raise ValueError("points and segments must be finite; some are NaN or infinite")
    if max(np.abs(points).max(initial=0.0), np.abs(segments).max(initial=0.0)) > LARGEST_PX:
        raise ValueError(
            f"points and segments must be pixels of a photograph; some are beyond {LARGEST_PX:g}"
        )
    if segments.size and not (np.linalg.norm(segments[:, :, 0] - segments[:, :, 1], axis=2) > 0.0).all():
        raise ValueError("a segment needs two different ends; one has no length")
    return points, segments


def _axis_parallel_lines(x: F64) -> F64:
    """Lines x = u and y = v (N, 2, 3) through points (N, 3) whose last coordinate is 1."""
    lines = np.zeros((len(x), 2, 3))
    lines[:, 0, 0] = lines[:, 1, 1] = 1.0
    lines[:, :, 2] = -x[:, :2]
    return lines


def estimate_tensor_linear(points: F64, segments: F64) -> F64:
    """T (3, 3, 3), unit norm, in pixels, with the least algebraic error over all tensors (HZ algorithm 16.1).

    points (3, N, 2) px, segments (3, M, 2, 2) px, either may be empty; 4 N + 2 M >= 26. Exact on exact data;
    with noise a start for the refinement, not a tensor of cameras. Raises as :func:`tensor_equations` and
    :meth:`TensorEquations.solve`.
    """
    equations = tensor_equations(points, segments)
    return unit_tensor(equations.in_pixels(equations.solve()))
