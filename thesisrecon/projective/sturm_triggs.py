"""Projective factorisation: all cameras and points of a complete table of matches at once.

Sturm and Triggs, "A factorization based algorithm for multi-image projective structure and motion", ECCV
1996: with the right projective depths w the matrix of all w (u, v, 1) has rank 4, and its factors are the
cameras and the points. Fundamental matrices give the depths; or one begins anywhere and takes them from the
factors, over and over (Triggs, CVPR 1996; Oliensis and Hartley, PAMI 29(12), 2007, on when that converges).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.homogeneous import homogenize, normalizing_transform, require_finite
from thesisrecon.geometry.multiview import epipoles

F64 = NDArray[np.float64]

_BALANCING = 10
_AT_REST = 1e-4
"""Relative gain of an iteration below which the factors rest."""


@dataclass(frozen=True)
class Factors:
    """Cameras ``P`` (V, 3, 4) for pixels and points ``X`` (N, 4) of unit norm, found with the balanced
    ``depths`` (V, N); ``residual_px`` (V, N) distances of the projections from the matches.

    ``gap`` is the fifth singular value over the fourth: 0 for exact matches and right depths.
    """

    P: F64
    X: F64
    depths: F64
    residual_px: F64
    gap: float
    iterations: int

    @property
    def rms_px(self) -> float:
        """Root of the mean squared residual."""
        return float(np.sqrt(np.mean(self.residual_px**2)))


def depths_from_fundamentals(
    xy: F64, F: Mapping[tuple[int, int], F64], tree: Sequence[tuple[int, int]]
) -> F64:
    """Projective depths (V, N) of matches xy (V, N, 2) px from fundamental matrices along a ``tree``.

    Of an edge (i, j), i reached before j: w_i F x_i = w_j (e_j x x_j) in every point, whose least-squares
    solution is w_j = w_i (e_j x x_j) . (F x_i) / |e_j x x_j|^2 (Sturm and Triggs, eq. 3). ``F[i, j]`` (3, 3)
    has x_j' F x_i = 0; its scale and sign are those of a whole view. The first view of the tree has depth 1.
    Points near an epipole get bad depths. Raises ``ValueError`` for a tree that does not reach every view,
    each once, from its first.
    """
    x = homogenize(xy)
    depths = np.full(xy.shape[:2], np.nan)
    depths[tree[0][0] if tree else 0] = 1.0
    for i, j in tree:
        if np.isnan(depths[i]).any() or not np.isnan(depths[j]).all():
            raise ValueError(f"depths_from_fundamentals needs a tree that grows from view {tree[0][0]}")
        turned = np.cross(epipoles(F[i, j])[1], x[j])
        squared = np.maximum(np.sum(turned**2, axis=1), 1e-300)
        depths[j] = depths[i] * np.sum(turned * (x[i] @ F[i, j].T), axis=1) / squared
    if np.isnan(depths).any():
        raise ValueError("depths_from_fundamentals needs a tree that reaches every view")
    return depths


def balanced(depths: F64, sizes: F64) -> F64:
    """Depths (V, N) rescaled by views and by points until every view and every point weighs the same.

    ``sizes`` (V, N) are the norms of the vectors that the depths multiply. Scales of views are those of
    cameras, scales of points those of points, so nothing is changed but the weights of the residuals.
    """
    views, points = depths.shape
    squared = (depths * sizes) ** 2
    a, b = np.ones(views), np.ones(points)
    for _ in range(_BALANCING):
        b = np.sqrt(views / np.maximum(a**2 @ squared, 1e-300))
        a = np.sqrt(points / np.maximum(squared @ b**2, 1e-300))
    return np.asarray(depths * a[:, None] * b)


def factorize(xy: F64, depths: F64 | None = None, *, iterations: int = 0) -> Factors:
    """Cameras and points of matches seen in every view, xy (V, N, 2) px, by a rank-4 factorisation.

    Parameters
    ----------
    depths : (V, N) projective depths to begin with (:func:`depths_from_fundamentals`); all equal where None,
        which is the affine camera and needs ``iterations``.
    iterations : most times that the depths are taken anew from the factors; 0 is Sturm and Triggs' own
        algorithm. It ends when the rank-4 residual of the balanced matrix, an approximation of the
        reprojection error, falls no more.

    Raises ``ValueError`` for fewer than two views or eight points, other shapes, and values that are not
    finite. All pixels of a view may not be equal.
    """
    if xy.ndim != 3 or xy.shape[2] != 2 or xy.shape[0] < 2 or xy.shape[1] < 8:
        raise ValueError(f"factorize needs xy (V >= 2, N >= 8, 2); got {xy.shape}")
    depths = np.ones(xy.shape[:2]) if depths is None else depths
    if depths.shape != xy.shape[:2]:
        raise ValueError(f"factorize needs depths {xy.shape[:2]}; got {depths.shape}")
    require_finite("factorize", xy, depths)
    T = np.stack([normalizing_transform(view) for view in xy])
    x = np.einsum("vab,vnb->vna", T, homogenize(xy))
    sizes = np.linalg.norm(x, axis=2)
    least, best, done = np.inf, depths, -1
    while done < iterations:
        done += 1
        depths = balanced(depths, sizes)
        fitted, residual = _rank_four(depths[:, :, None] * x)
        if residual < least:
            best = depths
        if not residual < least * (1.0 - _AT_REST):
            break
        least = residual
        depths = np.einsum("vna,vna->vn", fitted, x) / sizes**2
    return _factors(xy, x, T, best, done)


def _measurements(wx: F64) -> F64:
    """(V, N, 3) -> (3 V, N)."""
    return np.asarray(wx.swapaxes(1, 2).reshape(-1, wx.shape[1]))


def _rank_four(wx: F64) -> tuple[F64, float]:
    """The nearest matrix of rank 4, as (V, N, 3), and its squared distance."""
    W = _measurements(wx)
    basis = np.linalg.eigh(W @ W.T)[1][:, -4:]
    fitted = basis @ (basis.T @ W)
    residual = float(np.sum((W - fitted) ** 2))
    return fitted.reshape(len(wx), 3, -1).swapaxes(1, 2), residual


def _factors(xy: F64, x: F64, T: F64, depths: F64, iterations: int) -> Factors:
    U, s, Vt = np.linalg.svd(_measurements(depths[:, :, None] * x), full_matrices=False)
    # Equal shares of the singular values whiten the points as far as they go.
    P, X = np.linalg.solve(T, U[:, :4].reshape(-1, 3, 4)), Vt[:4].T * s[:4]
    lengths = np.linalg.norm(X, axis=1, keepdims=True)
    X = X / np.where(lengths > 0.0, lengths, 1.0)
    xh = np.einsum("vab,nb->vna", P, X)
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = np.linalg.norm(xh[..., :2] / xh[..., 2:] - xy, axis=2)
    gap = float(s[4] / s[3]) if s[3] > 0.0 else 1.0
    return Factors(P, X, depths, np.nan_to_num(residual, nan=np.inf), gap, iterations)
