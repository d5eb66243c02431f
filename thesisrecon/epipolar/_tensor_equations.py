"""The linear equations of the trifocal tensor (section 3.6.3; HZ chapter 16)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import (
    homogenize,
    normalizing_transform,
    require_finite,
    require_shapes,
    unit_normals,
)
from thesisrecon.geometry.three_view import unit_tensor

NEEDED_EQUATIONS = 26
"""Seven points, thirteen lines, or a mixture (HZ 16.1)."""
_MAX_PX = 1e15
"""Largest coordinate: beyond, fourth powers overflow and a double resolves no fraction of a pixel."""


@dataclass(frozen=True)
class TensorEquations:
    """Linear equations A t = 0 of the tensor entries t, in conditioned image coordinates.

    ``A`` (27, 27): triangular factor of all equations; ``noise`` (27, 27): that of their derivatives by the
    pixels, |noise t|^2 is the mean of |A t|^2 for the true t and noise of 1 px; ``transforms`` (3, 3, 3):
    from pixels to conditioned coordinates.
    """

    A: F64
    noise: F64
    transforms: F64

    def solve(self) -> F64:
        """The unit tensor (3, 3, 3) of least |A t| (HZ algorithm 16.1), in general not one of cameras."""
        _, s, Vt = np.linalg.svd(self.A)
        if not s[25] > 1e-10 * s[0]:
            raise ValueError("the matches leave the tensor free; they need to be in general position")
        return np.asarray(Vt[26].reshape(3, 3, 3))

    def noise_levels_px(self) -> F64:
        """Noise (27,) that would explain each of 27 solutions of the equations, the best first.

        Roots of the eigenvalues of A'A relative to those of unit noise (Kanatani's renormalisation). If the
        matches leave a family of tensors, as many values as it has dimensions are at or below the noise.
        """
        values, vectors = np.linalg.eigh(self.noise.T @ self.noise)
        whitening = vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1]))
        return np.asarray(np.linalg.svd(self.A @ whitening, compute_uv=False)[::-1])

    def solve_with_epipoles(self, e2: F64, e3: F64) -> F64:
        """The unit tensor of cameras with these epipoles (3,) in views 2 and 3 and least |A t| (HZ 16.3).

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
        """A conditioned tensor in pixels x' = H x: T'_i^jk = (H1^-1)^r_i H2^j_s H3^k_t T_r^st, unit norm."""
        _, H2, H3 = np.linalg.inv(self.transforms)
        return unit_tensor(np.einsum("ri,js,kt,rst->ijk", self.transforms[0], H2, H3, T))


def tensor_equations(points: F64, segments: F64) -> TensorEquations:
    """Set up the equations of points (3, N, 2) and segment ends (3, M, 2, 2) of three views (HZ table 15.1).

    A triplet of points gives four equations, the two axis-parallel lines through x2 with those through x3; a
    triplet of lines gives two, for the two ends of its segment in view 1.
    """
    ends = segments.reshape(3, -1, 2)
    transforms = np.stack([normalizing_transform(xy) for xy in np.concatenate([points, ends], axis=1)])
    x = homogenize(points) @ transforms.swapaxes(1, 2)
    y = homogenize(segments) @ transforms.swapaxes(1, 2)[:, None]
    lines = unit_normals(np.cross(y[:, :, 0], y[:, :, 1]))[:, :, None]
    # The lines x = u and y = v (N, 2, 3) through the points.
    axes2, axes3 = np.eye(3)[:2] - x[1:, :, :2, None] * np.eye(3)[2]
    scales = transforms[:, 0, 0]
    moves = np.eye(3)[:2], -np.eye(3)[2:], -np.eye(3)[2:]
    exact = [_products(x[0][:, None], axes2, axes3), _products(y[0], lines[1], lines[2])]
    noise = [
        _products(moves[0] * scales[0], axes2, axes3),
        _products(x[0][:, None], moves[1] * scales[1], axes3, times=2),
        _products(x[0][:, None], axes2, moves[2] * scales[2], times=2),
        _products(moves[0] * scales[0], lines[1], lines[2], times=2),
        _products(y[0], _line_moves(y[1]) * scales[1], lines[2]),
        _products(y[0], lines[1], _line_moves(y[2]) * scales[2]),
    ]
    return TensorEquations(_triangular(exact), _triangular(noise), transforms)


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
    """Check matches of three views and return them as float64 arrays."""
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
