"""Robust B-spline surfaces fitted to depth maps (thesis, section 2.6: parametric surfaces)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I32
from thesisrecon.optimize.noise import MAD_FACTOR
from thesisrecon.records import DepthMap
from thesisrecon.surface._bspline_pieces import (
    SplinePieces,
    domain_of,
    evaluate_pixels,
    pieces_of,
    sum_squares,
)

_POLYNOMIALS = (
    np.array([[1.0, -3.0, 3.0, -1.0], [4.0, 0.0, -6.0, 3.0], [1.0, 3.0, 3.0, -3.0], [0.0, 0.0, 0.0, 1.0]])
    / 6.0
)
"""Row i: coefficients of 1, u, u^2, u^3 of the i-th non-zero B-spline, u in [0, 1]."""
GRADIENT_WEIGHT = 1e-7
"""Weight of the gradient energy relative to the bending energy; it determines undetermined slopes."""
HUBER, TUKEY = 1.345, 4.685
"""Thresholds of the weights in standard deviations; both have 95 % efficiency (Huber 1981)."""
ROUNDS, HUBER_ROUNDS, INITIAL_ROUNDS = 13, 2, 5
"""Rounds of reweighting; those with convex weights, and with the softest spline, which detect outliers."""
WINDOW = 5
"""Cells of the window of the discrepancy principle along each side."""
MIN_ROOT_WEIGHT = 1e-3
"""Root of the least weight, which keeps pieces of outliers determined."""
MIN_STIFFNESS = 1e-3
"""Initial stiffness, relative to the weight of a pixel with the median standard deviation."""
FIRST_STEP, STEP_DECAY = 1e3, 0.65
"""First factor of a change of stiffness, and the exponent from one factor to the next."""


def _basis(u: F64, derivative: int = 0) -> F64:
    """The four uniform cubic B-splines (N, 4) that are non-zero between two knots, at u (N,) in [0, 1]."""
    row = _POLYNOMIALS
    for _ in range(derivative):
        row = row[:, 1:] * np.arange(1.0, row.shape[1])
    return np.asarray(np.power(u[:, None], np.arange(row.shape[1])) @ row.T)


def _energies() -> tuple[F64, F64]:
    """Integrals (16, 16) of f_xx^2 + 2 f_xy^2 + f_yy^2 and of the squared gradient over a unit cell."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    values = [_basis(0.5 * (nodes + 1.0), d) for d in (0, 1, 2)]
    M0, M1, M2 = (np.einsum("n,ni,nj->ij", 0.5 * weights, v, v) for v in values)
    bending = np.kron(M2, M0) + 2.0 * np.kron(M1, M1) + np.kron(M0, M2)
    return bending, np.kron(M1, M0) + np.kron(M0, M1)


@dataclass(frozen=True)
class _NormalEquations:
    """Normal equations of a spline in ``pieces`` with ``cell`` px between knots, and their pattern."""

    pieces: SplinePieces
    cell: int
    pixel_basis: F64
    energy: F64
    rows: I32
    starts: I32
    place: I32

    @classmethod
    def of(cls, pieces: SplinePieces, cell: int) -> _NormalEquations:
        """The sparsity pattern."""
        own, count = pieces.coefficient, pieces.count
        code = (own[:, None, :] * count + own[:, :, None]).reshape(-1)
        places, place = np.unique(code, return_inverse=True)
        starts = np.searchsorted(places, np.arange(count + 1) * count).astype(np.int32)
        bending, gradient = _energies()
        along = _basis((np.arange(cell) + 0.5) / cell)
        rows, place = (places % count).astype(np.int32), place.astype(np.int32).reshape(-1, 256)
        return cls(pieces, cell, along, bending + GRADIENT_WEIGHT * gradient, rows, starts, place)

    def sums(self, value: F64, weight: F64) -> tuple[F64, F64]:
        """Contributions of the depths (H, W) and weights to each piece: (N, 16, 16) and (N, 16)."""
        n = len(self.pieces.coefficient)
        matrix, right = np.zeros((n, 16, 16)), np.zeros((n, 16))
        sum_squares(self.pieces.piece, value, weight, self.pixel_basis, self.cell, matrix, right)
        upper = np.triu_indices(16, 1)
        matrix[:, upper[1], upper[0]] = matrix[:, upper[0], upper[1]]
        return matrix, right

    def solve(self, matrix: F64, right: F64, stiffness: F64) -> F64:
        """Coefficients for the stiffness (N,) of each piece."""
        entries = matrix + stiffness[:, None, None] * self.energy
        data = np.bincount(self.place.ravel(), entries.ravel(), len(self.rows))
        count = self.pieces.count
        A = scipy.sparse.csc_array((data, self.rows, self.starts), shape=(count, count))
        b = np.bincount(self.pieces.coefficient.ravel(), right.ravel(), count)
        factor = scipy.sparse.linalg.splu(
            A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        return np.asarray(factor.solve(b))

    def values(self, c: F64) -> F64:
        """(H, W) values of the spline at the pixels."""
        value = np.empty(self.pieces.piece.shape)
        evaluate_pixels(self.pieces.piece, self.pieces.coefficient, c, self.pixel_basis, self.cell, value)
        return value


@dataclass(frozen=True)
class BSplineSurface:
    """Cubic B-splines in inverse depth, in which planes in space are exact.

    Minimises sum w(r) r^2 + sum s_k E_k with the residuals r in standard deviations, Tukey's weights w in
    iteratively reweighted least squares, and the bending energy E_k of cell k. The stiffness s_k is chosen by
    the discrepancy principle (Morozov 1966) for each cell: as large as possible while the residuals of the
    5 x 5 cells around it do not exceed the noise level, which the softest spline provides
    (the errors of adjacent depths are correlated). At surface breaks both sides have separate coefficients;
    pixels without depth stay empty.

    Parameters
    ----------
    knot_px : int
        Distance of the knots. Connected regions smaller than a cell are outliers: within ``knot_px`` of a
        surface they take its depth, elsewhere they become empty.
    """

    knot_px: int = 4

    def __post_init__(self) -> None:
        if self.knot_px < 2:
            raise ValueError(f"knot_px must be >= 2; got {self.knot_px}")

    def smooth(self, depth_map: DepthMap) -> DepthMap:
        """Return the depths of the fitted surface.

        Parameters
        ----------
        depth_map : DepthMap
            Depths of one view.

        Returns
        -------
        DepthMap
            The same view with its standard deviations unchanged, because a fit cannot detect errors that
            neighbours share.
        """
        cell = self.knot_px
        domain = domain_of(depth_map, least=cell * cell, reach=float(cell))
        pieces = pieces_of(domain, cell)
        inverse_depth = np.full(depth_map.depth.shape, np.nan)
        if pieces.count:
            reliable = domain.reliable
            depth = np.where(reliable, depth_map.depth, 1.0).astype(np.float64)
            std = np.where(reliable, depth_map.std, 1.0).astype(np.float64)
            value = np.where(reliable, 1.0 / depth, 0.0)
            equations = _NormalEquations.of(pieces, cell)
            c = self._coefficients(equations, value, std / depth**2, reliable)
            inverse_depth = _sample(pieces, cell, c)
        with np.errstate(divide="ignore", invalid="ignore"):
            fitted = np.where(inverse_depth > 0.0, 1.0 / inverse_depth, np.nan).astype(np.float32)
        known = np.isfinite(fitted)
        return replace(
            depth_map,
            depth=fitted,
            std=np.where(known, depth_map.std, np.float32(np.nan)),
            views=np.where(known, depth_map.views, np.uint8(0)),
        )

    def _coefficients(self, equations: _NormalEquations, value: F64, std: F64, reliable: B8) -> F64:
        unit = float(np.median(std[reliable]))
        value, std = value / unit, std / unit
        cells = equations.pieces.cell
        weight, stiffness = np.where(reliable, 1.0, 0.0), np.full(len(cells), MIN_STIFFNESS)
        noise = np.zeros(0)
        # The n residuals of a window have n - p degrees of freedom with standard deviation sqrt(2 p) of the
        # fitted part: larger mean squares are incompatible with the softest spline.
        n, p = (self.knot_px * WINDOW) ** 2, WINDOW**2
        allowed = float(n / (n - p) * (1.0 + np.sqrt(2.0 * p) / n))
        for k in range(ROUNDS):
            c = equations.solve(*equations.sums(value, weight / std**2), stiffness)
            residual = np.where(reliable, equations.values(c) - value, 0.0) / std
            weight = np.where(reliable, _weights(residual, reliable, redescending=k >= HUBER_ROUNDS), 0.0)
            found = self._mean_square(equations.pieces.shape, residual, weight)
            if k < INITIAL_ROUNDS:
                noise = allowed * found
            else:
                step = FIRST_STEP ** (STEP_DECAY ** (k - INITIAL_ROUNDS))
                stiffness *= np.where(found <= noise, step, 1.0 / step)[cells]
        return c * unit

    def _mean_square(self, cells: tuple[int, int], residual: F64, weight: F64) -> F64:
        """(rows x columns of cells,) weighted means of squared residuals in the window around each cell."""
        y, x = np.indices(residual.shape) // self.knot_px
        number, count = (y * cells[1] + x).ravel(), cells[0] * cells[1]
        totals = (
            np.bincount(number, part.ravel(), count).reshape(cells) for part in (weight * residual**2, weight)
        )
        above, below = (scipy.ndimage.uniform_filter(total, WINDOW, mode="constant") for total in totals)
        return np.asarray(above / np.maximum(below, 1e-12)).ravel()


def _weights(residual: F64, reliable: B8, *, redescending: bool) -> F64:
    """Huber's or Tukey's weights; the scale is enlarged if the residuals exceed their standard deviations."""
    scale = max(1.0, MAD_FACTOR * float(np.median(np.abs(residual[reliable]))))
    r = np.abs(residual) / scale
    if redescending:
        return np.asarray(np.maximum(1.0 - (r / TUKEY) ** 2, MIN_ROOT_WEIGHT) ** 2)
    return np.asarray(HUBER / np.maximum(r, HUBER))


def _sample(pieces: SplinePieces, cell: int, c: F64) -> F64:
    """(H, W) values of the spline at the pixels, NaN where there is no surface."""
    value = np.full(pieces.piece.shape, np.nan)
    y, x = np.nonzero(pieces.piece >= 0)
    nodes = c[pieces.coefficient[pieces.piece[y, x]]].reshape(-1, 4, 4)
    u, v = (x + 0.5) / cell - x // cell, (y + 0.5) / cell - y // cell
    value[y, x] = np.einsum("nij,ni,nj->n", nodes, _basis(v), _basis(u))
    return value
