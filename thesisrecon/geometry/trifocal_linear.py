"""Section 3.6.3: the trifocal tensor from points and lines by linear equations.

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
from numpy.typing import NDArray

from thesisrecon.geometry.homogeneous import homogenize, normalizing_transform
from thesisrecon.geometry.lines_and_planes import unit_normals
from thesisrecon.geometry.trifocal import transform_tensor, unit_tensor

F64 = NDArray[np.float64]

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
