"""Uniform cubic B-splines between two knots: values, derivatives and bending energy.

The normal equations of a spline in pieces: assembled, and solved.

Section 2.6: a parametric surface fitted to a depth map, robustly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from thesisrecon.arrays import B8, F64
from thesisrecon.numerics.noise import MAD_FACTOR
from thesisrecon.records import DepthMap
from thesisrecon.surface.bspline_pieces import (
    SplinePieces,
    domain_of,
    evaluate_pixels,
    pieces_of,
    sum_squares,
)
from thesisrecon.surface.linear import SurfaceSample

_POLYNOMIALS = (
    np.array([[1.0, -3.0, 3.0, -1.0], [4.0, 0.0, -6.0, 3.0], [1.0, 3.0, 3.0, -3.0], [0.0, 0.0, 0.0, 1.0]])
    / 6.0
)
"""Row i: the coefficients of 1, u, u^2, u^3 of the i-th of the four that are not zero, u in [0, 1]."""


def basis(u: F64, derivative: int = 0) -> F64:
    """(N, 4) values of the four B-splines, or of a derivative, at u (N,) between two knots."""
    row = _POLYNOMIALS
    for _ in range(derivative):
        row = row[:, 1:] * np.arange(1.0, row.shape[1])
    return np.asarray(np.power(u[:, None], np.arange(row.shape[1])) @ row.T)


def energies() -> tuple[F64, F64]:
    """(16, 16) of the bending energy, the integral of f_xx^2 + 2 f_xy^2 + f_yy^2 over a cell of side 1, and
    of that of the squared gradient, in the coefficients of the cell's nodes (i, j) in place 4 i + j."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    values = [basis(0.5 * (nodes + 1.0), d) for d in (0, 1, 2)]
    M0, M1, M2 = (np.einsum("n,ni,nj->ij", 0.5 * weights, v, v) for v in values)
    bending = np.kron(M2, M0) + 2.0 * np.kron(M1, M1) + np.kron(M0, M2)
    return bending, np.kron(M1, M0) + np.kron(M0, M1)


TILT = 1e-7
"""Weight of squared gradients beside that of bending: what decides where depths leave a tilt open."""


@dataclass(frozen=True)
class _NormalEquations:
    """Least squares of a spline in ``pieces`` with ``cell`` px between knots.

    ``rows, starts`` are the places of the sparse matrix and ``place`` (N, 256) where the entries of each
    piece go.
    """

    pieces: SplinePieces
    cell: int
    pixel_basis: F64
    energy: F64
    rows: NDArray[np.int32]
    starts: NDArray[np.int32]
    place: NDArray[np.int32]

    @classmethod
    def of(cls, pieces: SplinePieces, cell: int) -> _NormalEquations:
        """The equations' pattern, without numbers."""
        own, count = pieces.coefficient, pieces.count
        code = (own[:, None, :] * count + own[:, :, None]).reshape(-1)
        places, place = np.unique(code, return_inverse=True)
        starts = np.searchsorted(places, np.arange(count + 1) * count).astype(np.int32)
        bending, gradient = energies()
        along = basis((np.arange(cell) + 0.5) / cell)
        rows = (places % count).astype(np.int32)
        return cls(
            pieces,
            cell,
            along,
            bending + TILT * gradient,
            rows,
            starts,
            place.astype(np.int32).reshape(-1, 256),
        )

    def sums(self, value: F64, weight: F64) -> tuple[F64, F64]:
        """What the depths (H, W) and their weights give each piece: (N, 16, 16) and (N, 16)."""
        n = len(self.pieces.coefficient)
        matrix, right = np.zeros((n, 16, 16)), np.zeros((n, 16))
        sum_squares(self.pieces.piece, value, weight, self.pixel_basis, self.cell, matrix, right)
        upper = np.triu_indices(16, 1)
        matrix[:, upper[1], upper[0]] = matrix[:, upper[0], upper[1]]
        return matrix, right

    def solve(self, matrix: F64, right: F64, stiffness: F64) -> F64:
        """Coefficients where pieces (N,) resist bending by ``stiffness``."""
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
        """(H, W) of the spline at the pixels."""
        value = np.empty(self.pieces.piece.shape)
        evaluate_pixels(self.pieces.piece, self.pieces.coefficient, c, self.pixel_basis, self.cell, value)
        return value


HUBER, TUKEY = 1.345, 4.685
"""Where the weights begin to fall and where they end, in deviations: both 95 % efficient (Huber 1981)."""
HUBER_ROUNDS, SOFT_ROUNDS = 2, 5
"""Rounds with convex weights, and rounds with the softest spline, which tell what is an outlier."""
FAINTEST = 1e-3
"""Root of the least weight, without which a piece of wrong depths alone would be nowhere."""
SOFTEST = 1e-3
"""Stiffness in weights of a pixel of the usual deviation."""
FIRST_STEP, SHORTER = 1e3, 0.65
"""Factor by which a stiffness changes first, and the power by which the next one is smaller."""


@dataclass(frozen=True)
class BSplineSurface:
    """Cubic B-splines in inverse depth over the image, in which planes of space stay planes.

    Minimised is sum w(r) r^2 + sum s_k E_k: r are the residuals in deviations of the depth map, w Tukey's
    weights in iteratively reweighted least squares, E_k is the bending energy of the spline over cell k
    between its knots. The stiffness s_k is chosen by the discrepancy principle (Morozov 1966), cell by cell:
    as large as leaves the residuals of the ``window`` x ``window`` cells about it no larger than noise. How
    large that is the softest spline tells, for the deviations of a depth map are those of its errors, most of
    which neighbours share. Where a surface breaks both sides have coefficients of their own, and nothing is
    said of pixels without depth.

    ``knot_px``: between knots. ``rounds`` of reweighting. ``grazing_deg``: what is seen more flatly breaks.
    Connected depths fewer than the pixels between four knots are taken for errors: within ``knot_px`` of a
    surface that becomes their depth, elsewhere they have none.
    """

    knot_px: int = 4
    rounds: int = 13
    window: int = 5
    grazing_deg: float = 10.0

    def __post_init__(self) -> None:
        if self.knot_px < 2 or self.rounds < 1 or self.window < 1:
            raise ValueError(
                f"knot_px >= 2, rounds >= 1 and window >= 1 are needed; got {self.knot_px}, {self.rounds} "
                f"and {self.window}"
            )
        if not 0.0 < self.grazing_deg < 90.0:
            raise ValueError(f"0 < grazing_deg < 90 is needed; got {self.grazing_deg}")

    def fit(self, depth_map: DepthMap) -> BSplineFit:
        """The surface; it stands only before pixels of the map."""
        cell = self.knot_px
        domain = domain_of(depth_map, grazing_deg=self.grazing_deg, least=cell * cell, reach=float(cell))
        pieces = pieces_of(domain, cell)
        if not pieces.count:
            return BSplineFit(depth_map, pieces, cell, np.zeros(0))
        value, deviation = _inverse(depth_map, domain.reliable)
        coefficients = self._coefficients(
            _NormalEquations.of(pieces, cell), value, deviation, domain.reliable
        )
        return BSplineFit(depth_map, pieces, cell, coefficients)

    def _coefficients(self, equations: _NormalEquations, value: F64, deviation: F64, reliable: B8) -> F64:
        unit = float(np.median(deviation[reliable]))
        value, deviation = value / unit, deviation / unit
        cells = equations.pieces.cell
        weight, stiffness = np.where(reliable, 1.0, 0.0), np.full(len(cells), SOFTEST)
        noise = np.zeros(0)
        for k in range(self.rounds):
            c = equations.solve(*equations.sums(value, weight / deviation**2), stiffness)
            residual = np.where(reliable, equations.values(c) - value, 0.0) / deviation
            weight = np.where(reliable, _weights(residual, reliable, redescending=k >= HUBER_ROUNDS), 0.0)
            found = self._mean_square(equations.pieces.shape, residual, weight)
            if k < SOFT_ROUNDS:
                noise = self._allowed() * found
            else:
                step = FIRST_STEP ** (SHORTER ** (k - SOFT_ROUNDS))
                stiffness *= np.where(found <= noise, step, 1.0 / step)[cells]
        return c * unit

    def _allowed(self) -> float:
        """Up to which factor of the mean square of the softest spline's residuals others are chance.

        The n residuals of a window have n - p degrees of freedom, and what its p coefficients take up is
        known to sqrt(2 p) of them.
        """
        n, p = (self.knot_px * self.window) ** 2, self.window**2
        return float(n / (n - p) * (1.0 + np.sqrt(2.0 * p) / n))

    def _mean_square(self, cells: tuple[int, int], residual: F64, weight: F64) -> F64:
        """(rows x columns of cells,) weighted means of squared residuals in the window about each cell."""
        y, x = np.indices(residual.shape) // self.knot_px
        number = (y * cells[1] + x).ravel()
        sums = [
            scipy.ndimage.uniform_filter(
                np.bincount(number, part.ravel(), cells[0] * cells[1]).reshape(cells),
                self.window,
                mode="constant",
            )
            for part in (weight * residual**2, weight)
        ]
        return np.asarray(sums[0] / np.maximum(sums[1], 1e-12)).ravel()


def _weights(residual: F64, reliable: B8, *, redescending: bool) -> F64:
    """Weights of residuals in deviations, Huber's or Tukey's; wider where all are larger than told."""
    scale = max(1.0, MAD_FACTOR * float(np.median(np.abs(residual[reliable]))))
    r = np.abs(residual) / scale
    if redescending:
        return np.asarray(np.maximum(1.0 - (r / TUKEY) ** 2, FAINTEST) ** 2)
    return np.asarray(HUBER / np.maximum(r, HUBER))


def _inverse(depth_map: DepthMap, reliable: B8) -> tuple[F64, F64]:
    """Inverse depths and their deviations (H, W), 0 and 1 where they do not speak."""
    depth = np.where(reliable, depth_map.depth, 1.0).astype(np.float64)
    std = np.where(reliable, depth_map.std, 1.0).astype(np.float64)
    return np.where(reliable, 1.0 / depth, 0.0), std / depth**2


@dataclass(frozen=True)
class BSplineFit:
    """Coefficients of a spline in ``pieces``, ``cell`` px between knots."""

    given: DepthMap
    pieces: SplinePieces
    cell: int
    coefficients: F64

    @property
    def interpolates(self) -> bool:
        """False: it passes near them."""
        return False

    def evaluate(self, xy: F64) -> SurfaceSample:
        """The spline of the piece that the nearest pixel is of; nothing where that pixel is of none."""
        height, width = self.given.depth.shape
        pixel = np.rint(xy)
        inside = np.all((pixel >= 0) & (pixel <= np.array([width, height]) - 1), axis=1)
        pixel = np.where(inside[:, None], pixel, 0).astype(np.int64)
        piece = np.where(inside, self.pieces.piece[pixel[:, 1], pixel[:, 0]], -1)
        there = np.flatnonzero(piece >= 0)
        value, gradient = np.full(len(xy), np.nan), np.full((len(xy), 2), np.nan)
        c = self.coefficients[self.pieces.coefficient[piece[there]]].reshape(-1, 4, 4)
        u, v = ((xy[there] + 0.5) / self.cell - pixel[there] // self.cell).T
        value[there] = _tensor(c, basis(v), basis(u))
        gradient[there, 0] = _tensor(c, basis(v), basis(u, 1)) / self.cell
        gradient[there, 1] = _tensor(c, basis(v, 1), basis(u)) / self.cell
        return SurfaceSample(value, gradient)


def _tensor(c: F64, along_y: F64, along_x: F64) -> F64:
    return np.asarray(np.einsum("nij,ni,nj->n", c, along_y, along_x))
