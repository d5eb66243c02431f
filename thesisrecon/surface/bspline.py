"""Robust B-spline surfaces fitted to depth maps (thesis, section 2.6: parametric surfaces)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy

from thesisrecon._numba import empty, kernel
from thesisrecon.arrays import B8, F64, I32, I64
from thesisrecon.optimize.noise import MAD_FACTOR
from thesisrecon.records import DepthMap
from thesisrecon.surface._mesh import GRAZING_DEG, components, max_depth_slope, same_surface

_POLYNOMIALS = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6.0
"""Row i: coefficients of 1, u, u^2, u^3 of the i-th non-zero B-spline, u in [0, 1]."""
WINDOW = 5  #: cells of the window of the discrepancy principle along each side


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


@kernel
def _sum_squares(
    piece: I64, value: F64, weight: F64, basis: F64, cell: int, matrix: F64, right_side: F64
) -> None:
    """Accumulate the upper triangles (N, 16, 16) and right sides (N, 16) of the normal equations."""
    height, width = piece.shape
    b = empty(16)
    for y in range(height):
        for x in range(width):
            k = piece[y, x]
            w = weight[y, x]
            if k < 0 or w <= 0.0:
                continue
            for i in range(4):
                for j in range(4):
                    b[4 * i + j] = basis[y % cell, i] * basis[x % cell, j]
            for m in range(16):
                wb = w * b[m]
                right_side[k, m] += wb * value[y, x]
                for n in range(m, 16):
                    matrix[k, m, n] += wb * b[n]


@kernel
def _evaluate_pixels(piece: I64, coefficient: I64, c: F64, basis: F64, cell: int, value: F64) -> None:
    """Evaluate the spline at all pixels, NaN for pixels without a piece."""
    height, width = piece.shape
    for y in range(height):
        for x in range(width):
            k = piece[y, x]
            total = np.nan
            if k >= 0:
                total = 0.0
                for i in range(4):
                    for j in range(4):
                        total += basis[y % cell, i] * basis[x % cell, j] * c[coefficient[k, 4 * i + j]]
            value[y, x] = total


class Domain(NamedTuple):
    """Pixels with a surface and with used depths; ``joined`` to the pixel below and to the right."""

    covered: B8
    reliable: B8
    joined: tuple[B8, B8]


class SplinePieces(NamedTuple):
    """The connected parts of a depth map in the cells between knots, numbered cell by cell."""

    piece: I64  #: (H, W) of each pixel, -1 for none
    coefficient: I64  #: (N, 16) numbers of the coefficients of each piece
    total: int  #: number of coefficients
    cell: I64  #: (N,) of each piece, row by row
    shape: tuple[int, int]  #: rows and columns of cells


def _domain_of(depth_map: DepthMap, *, least: int, reach: float) -> Domain:
    """Connect the depths of a map to surfaces of at least ``least`` pixels, extended by ``reach`` pixels."""
    depth, std = depth_map.depth.astype(np.float64), depth_map.std.astype(np.float64)
    slope = max_depth_slope(depth_map.P, GRAZING_DEG)
    known = np.isfinite(depth) & (depth > 0.0) & (std > 0.0) & np.isfinite(std)
    depth = np.where(known, depth, np.nan)
    joined = [
        _alike(depth, std, np.full(depth.shape, slope), axis) & ~_steps(1.0 / depth, std / depth**2, axis)
        for axis in (0, 1)
    ]
    reliable = known & (_sizes(joined, known) >= least)
    if not reliable.any():
        return Domain(reliable, reliable, (joined[0], joined[1]))
    away, (y, x) = scipy.ndimage.distance_transform_edt(~reliable, return_indices=True)
    covered = known & (away <= reach)
    for axis in (0, 1):
        # Unreliable pixels take the depth of the nearest reliable one.
        extended = _alike(depth[y, x], std[y, x], slope * (1.0 + 2.0 * away), axis)
        joined[axis] = np.where(_both(reliable, axis), joined[axis], extended) & _both(covered, axis)
    # They must be connected to reliable pixels.
    covered &= _sizes(joined, reliable) >= least
    return Domain(covered, reliable & covered, (joined[0] & _both(covered, 0), joined[1] & _both(covered, 1)))


def _pairs(values: Any, axis: int) -> tuple[Any, Any]:
    """Values (H, W) of neighbours along an axis."""
    return (values[:-1], values[1:]) if axis == 0 else (values[:, :-1], values[:, 1:])


def _both(mask: B8, axis: int) -> B8:
    first, second = _pairs(mask, axis)
    return np.asarray(first & second)


def _alike(depth: F64, std: F64, slope: F64, axis: int) -> B8:
    """Whether neighbouring depths along an axis are close enough for one surface."""
    with np.errstate(invalid="ignore"):
        return same_surface(*_pairs(depth, axis), *_pairs(std, axis), np.maximum(*_pairs(slope, axis)))


def _steps(rho: F64, deviation: F64, axis: int) -> B8:
    """Whether the inverse depth has a step, of five standard deviations, unlike those before and after."""
    rho, deviation = np.moveaxis(rho, axis, 0), np.moveaxis(deviation, axis, 0)
    step = np.diff(rho, axis=0)
    padded = np.pad(step, ((1, 1), (0, 0)), constant_values=np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.fmin(np.abs(step - padded[:-2]), np.abs(step - padded[2:]))
        off /= np.sqrt(3.0) * np.hypot(deviation[:-1], deviation[1:])
        finite = off[np.isfinite(off)]
        usual = max(1.0, MAD_FACTOR * float(np.median(finite))) if len(finite) else 1.0
        return np.asarray(np.moveaxis(off > 5.0 * usual, 0, axis))


def _sizes(joined: Sequence[B8], counted: B8) -> I64:
    """(H, W) number of ``counted`` pixels in the connected region of each pixel."""
    number = np.arange(counted.size).reshape(counted.shape)
    label = _components(number, joined, counted.size)
    return np.asarray(np.bincount(label, counted.ravel())[label].reshape(counted.shape), dtype=np.int64)


def _pieces_of(domain: Domain, cell: int) -> SplinePieces:
    """Divide a domain into pieces, its connected parts in each cell, and number their coefficients.

    A node has one coefficient for every connected part of the surface within its sixteen cells, so that both
    sides of a cut are separate and the surface is smooth around the end of a cut.
    """
    height, width = domain.covered.shape
    shape = (-(-height // cell), -(-width // cell))
    piece, cells = _label_pieces(domain, cell, shape[1])
    sides = [[part[joined] for part in _pairs(piece, axis)] for axis, joined in enumerate(domain.joined)]
    linked = np.unique(np.concatenate(sides, axis=1), axis=1)
    return SplinePieces(piece, *_number_coefficients(cells, shape[1], linked), cells, shape)


def _number_coefficients(cells: I64, columns: int, linked: I64) -> tuple[I64, int]:
    """Numbers (N, 16) of the coefficients of pieces in ``cells`` (N,), ``linked`` (2, M), and their count."""
    i, j = np.divmod(np.arange(16), 4)
    row, column = np.divmod(cells, columns)
    node = ((row[:, None] + i) * (columns + 3) + column[:, None] + j).ravel()
    # A graph of the pieces at each node, sorted by nodes: its components are the coefficients.
    place = np.empty(len(node), dtype=np.int64)
    place[np.argsort(node, kind="stable")] = np.arange(len(node))
    a, b = linked
    i, j = i + (row[a] - row[b])[:, None], j + (column[a] - column[b])[:, None]
    shared = (i >= 0) & (i < 4) & (j >= 0) & (j < 4)
    start, stop = (16 * a[:, None] + np.arange(16))[shared], (16 * b[:, None] + 4 * i + j)[shared]
    label = components(place[start], place[stop], len(node))
    return label[place].reshape(-1, 16), int(label.max(initial=-1)) + 1


def _label_pieces(domain: Domain, cell: int, columns: int) -> tuple[I64, I64]:
    """Pieces (H, W), -1 for none, numbered cell by cell and by their first pixel; the cell (N,) of each."""
    y, x = np.indices(domain.covered.shape) // cell
    place = y * columns + x
    pixels = np.flatnonzero(domain.covered)
    pixels = pixels[np.argsort(place.ravel()[pixels], kind="stable")]
    number = np.full(place.shape, -1, dtype=np.int64)
    number.ravel()[pixels] = np.arange(len(pixels))
    inside = [
        joined & (np.diff(place, axis=axis) == 0) & _both(domain.covered, axis)
        for axis, joined in enumerate(domain.joined)
    ]
    label = _components(number, inside, len(pixels))
    piece = number.copy()
    piece.ravel()[pixels] = label
    return piece, place.ravel()[pixels[np.unique(label, return_index=True)[1]]]


def _components(number: I64, joined: Sequence[B8], count: int) -> I64:
    """Connected components (count,) of numbered pixels; ``joined`` with the next along either axis."""
    start, stop = (
        np.concatenate([_pairs(number, axis)[end][joined[axis]] for axis in (0, 1)]) for end in (0, 1)
    )
    return components(start, stop, count)


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
        # Weight of the gradient energy relative to the bending energy; it determines undetermined slopes.
        gradient_weight = 1e-7
        own, count = pieces.coefficient, pieces.total
        code = (own[:, None, :] * count + own[:, :, None]).reshape(-1)
        places, place = np.unique(code, return_inverse=True)
        starts = np.searchsorted(places, np.arange(count + 1) * count).astype(np.int32)
        bending, gradient = _energies()
        along = _basis((np.arange(cell) + 0.5) / cell)
        rows, place = (places % count).astype(np.int32), place.astype(np.int32).reshape(-1, 256)
        return cls(pieces, cell, along, bending + gradient_weight * gradient, rows, starts, place)

    def sums(self, value: F64, weight: F64) -> tuple[F64, F64]:
        """Contributions of the depths (H, W) and weights to each piece: (N, 16, 16) and (N, 16)."""
        n = len(self.pieces.coefficient)
        matrix, right = np.zeros((n, 16, 16)), np.zeros((n, 16))
        _sum_squares(self.pieces.piece, value, weight, self.pixel_basis, self.cell, matrix, right)
        upper = np.triu_indices(16, 1)
        matrix[:, upper[1], upper[0]] = matrix[:, upper[0], upper[1]]
        return matrix, right

    def solve(self, matrix: F64, right: F64, stiffness: F64) -> F64:
        """Coefficients for the stiffness (N,) of each piece."""
        entries = matrix + stiffness[:, None, None] * self.energy
        data = np.bincount(self.place.ravel(), entries.ravel(), len(self.rows))
        count = self.pieces.total
        A = scipy.sparse.csc_array((data, self.rows, self.starts), shape=(count, count))
        b = np.bincount(self.pieces.coefficient.ravel(), right.ravel(), count)
        factor = scipy.sparse.linalg.splu(
            A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        return np.asarray(factor.solve(b))

    def values(self, c: F64) -> F64:
        """(H, W) values of the spline at the pixels."""
        value = np.empty(self.pieces.piece.shape)
        _evaluate_pixels(self.pieces.piece, self.pieces.coefficient, c, self.pixel_basis, self.cell, value)
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
    """

    knot_px: int = 4
    """Distance of the knots. Connected regions smaller than a cell are outliers: within ``knot_px`` of a
    surface they take its depth, elsewhere they become empty."""

    def __post_init__(self) -> None:
        if self.knot_px < 2:
            raise ValueError(f"knot_px must be >= 2; got {self.knot_px}")

    def smooth(self, depth_map: DepthMap) -> DepthMap:
        """Return the depths of the fitted surface."""
        cell = self.knot_px
        domain = _domain_of(depth_map, least=cell * cell, reach=float(cell))
        inverse_depth = np.full(depth_map.depth.shape, np.nan)
        if domain.reliable.any():
            pieces = _pieces_of(domain, cell)
            reliable = domain.reliable
            depth = np.where(reliable, depth_map.depth, 1.0).astype(np.float64)
            std = np.where(reliable, depth_map.std, 1.0).astype(np.float64)
            value = np.where(reliable, 1.0 / depth, 0.0)
            equations = _NormalEquations.of(pieces, cell)
            c = self._coefficients(equations, value, std / depth**2, reliable)
            inverse_depth = equations.values(c)
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
        # Rounds of reweighting; those with convex weights, and with the softest spline, which detect
        # outliers.
        rounds, huber_rounds, initial_rounds = 13, 2, 5
        # Initial stiffness, relative to the weight of a pixel with the median standard deviation.
        min_stiffness = 1e-3
        # First factor of a change of stiffness, and the exponent from one factor to the next.
        first_step, step_decay = 1e3, 0.65
        unit = float(np.median(std[reliable]))
        value, std = value / unit, std / unit
        cells = equations.pieces.cell
        weight, stiffness = np.where(reliable, 1.0, 0.0), np.full(len(cells), min_stiffness)
        noise = np.zeros(0)
        # The n residuals of a window have n - p degrees of freedom with standard deviation sqrt(2 p) of the
        # fitted part: larger mean squares are incompatible with the softest spline.
        n, p = (self.knot_px * WINDOW) ** 2, WINDOW**2
        allowed = float(n / (n - p) * (1.0 + np.sqrt(2.0 * p) / n))
        for k in range(rounds):
            c = equations.solve(*equations.sums(value, weight / std**2), stiffness)
            residual = np.where(reliable, equations.values(c) - value, 0.0) / std
            weight = np.where(reliable, _weights(residual, reliable, redescending=k >= huber_rounds), 0.0)
            found = self._mean_square(equations.pieces.shape, residual, weight)
            if k < initial_rounds:
                noise = allowed * found
            else:
                step = first_step ** (step_decay ** (k - initial_rounds))
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
    # Thresholds of the weights in standard deviations; both have 95 % efficiency (Huber 1981).
    huber, tukey = 1.345, 4.685
    min_root_weight = 1e-3  # Root of the least weight, which keeps pieces of outliers determined
    scale = max(1.0, MAD_FACTOR * float(np.median(np.abs(residual[reliable]))))
    r = np.abs(residual) / scale
    if redescending:
        return np.asarray(np.maximum(1.0 - (r / tukey) ** 2, min_root_weight) ** 2)
    return np.asarray(huber / np.maximum(r, huber))
