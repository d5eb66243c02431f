"""Robust B-spline surfaces fitted to depth maps (thesis, section 2.6: parametric surfaces)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I32, I64
from thesisrecon.errors import require_range
from thesisrecon.optimize.least_squares import MAD_FACTOR
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


class Domain(NamedTuple):
    """Pixels with a surface and with used depths; ``joined`` to the pixel below and to the right."""

    covered: B8
    reliable: B8
    joined: tuple[B8, B8]


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
    start, stop = _edges(np.arange(counted.size).reshape(counted.shape), joined)
    label = components(start, stop, counted.size)
    return np.asarray(np.bincount(label, counted.ravel())[label].reshape(counted.shape), dtype=np.int64)


def _edges(number: I64, joined: Sequence[B8]) -> I64:
    """Numbers (2, M) of the neighbouring pixels that are ``joined`` along either axis."""
    ends = [np.stack(_pairs(number, axis))[:, joined[axis]] for axis in (0, 1)]
    return np.concatenate(ends, axis=1)


def _number_coefficients(cells: I64, columns: int, linked: I64) -> I64:
    """Numbers (N, 16) of the coefficients of pieces in ``cells`` (N,), ``linked`` (2, M)."""
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
    return components(place[start], place[stop], len(node))[place].reshape(-1, 16)


class _Spline(NamedTuple):
    """A bicubic spline; its pieces are the connected parts of a domain in each cell between knots."""

    pixel: I64  #: (N,) numbers of the pixels, cell by cell
    place: I64  #: (N,) of each pixel in its cell, row by row
    piece: I64  #: (N,) of each pixel
    cell: I64  #: (M,) of each piece, row by row
    shape: tuple[int, int]  #: rows and columns of cells
    coefficient: I64  #: (M, 16) numbers of the coefficients of each piece
    basis: F64  #: (S, 16) at the places of a cell
    energy: F64  #: (16, 16) of a piece
    pattern: tuple[I32, I32, I32]  #: rows, starts of the columns, and (M, 256) places of the normal matrix

    @classmethod
    def over(cls, domain: Domain, knot_px: int) -> "_Spline":
        """Divide a domain into pieces and number their coefficients."""
        # A node has one coefficient for every connected part of the surface within its sixteen cells, so that
        # both sides of a cut are separate and the surface is smooth around the end of a cut.
        # Weight of the gradient energy relative to the bending energy; it determines undetermined slopes.
        gradient_weight = 1e-7
        y, x = np.indices(domain.covered.shape)
        rows, columns = (-(-side // knot_px) for side in domain.covered.shape)
        cell = y // knot_px * columns + x // knot_px
        pixel = np.flatnonzero(domain.covered)
        pixel = pixel[np.argsort(cell.ravel()[pixel], kind="stable")]
        number = np.full(cell.shape, -1, dtype=np.int64)
        number.ravel()[pixel] = np.arange(len(pixel))
        inside = [joined & (np.diff(cell, axis=axis) == 0) for axis, joined in enumerate(domain.joined)]
        start, stop = _edges(number, inside)
        piece = components(start, stop, len(pixel))
        cells = cell.ravel()[pixel[np.unique(piece, return_index=True)[1]]]
        own = _number_coefficients(cells, columns, np.unique(piece[_edges(number, domain.joined)], axis=1))
        count = int(own.max()) + 1
        places, entry = np.unique(own[:, None, :] * count + own[:, :, None], return_inverse=True)
        starts = np.searchsorted(places, np.arange(count + 1) * count)
        row, first, entry = (part.astype(np.int32) for part in (places % count, starts, entry.ravel()))
        along, (bending, gradient) = _basis((np.arange(knot_px) + 0.5) / knot_px), _energies()
        place = (y % knot_px * knot_px + x % knot_px).ravel()[pixel]
        energy, basis = np.asarray(bending + gradient_weight * gradient), np.asarray(np.kron(along, along))
        return cls(pixel, place, piece, cells, (rows, columns), own, basis, energy, (row, first, entry))

    def fit(self, value: F64, weight: F64, stiffness: F64) -> F64:
        """Coefficients for the values (N,) and weights of the pixels and the stiffness (M,) of the pieces."""
        weights, weighted = np.zeros((2, len(self.cell), len(self.basis)))
        weights[self.piece, self.place], weighted[self.piece, self.place] = weight, weight * value
        products = (self.basis[:, :, None] * self.basis[:, None]).reshape(-1, 256)
        entries = weights @ products + stiffness[:, None] * self.energy.ravel()
        rows, starts, entry = self.pattern
        data, count = np.bincount(entry, entries.ravel()), len(starts) - 1
        A = scipy.sparse.csc_array((data, rows, starts), shape=(count, count))
        factor = scipy.sparse.linalg.splu(
            A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        right = np.bincount(self.coefficient.ravel(), (weighted @ self.basis).ravel())
        return np.asarray(factor.solve(right))

    def values(self, c: F64) -> F64:
        """(N,) values of the spline at the pixels."""
        return np.asarray((c[self.coefficient] @ self.basis.T)[self.piece, self.place])


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
        require_range(self, knot_px="[2, inf)")

    def smooth(self, depth_map: DepthMap) -> DepthMap:
        """Return the depths of the fitted surface."""
        domain = _domain_of(depth_map, least=self.knot_px**2, reach=float(self.knot_px))
        inverse_depth = np.full(depth_map.depth.shape, np.nan)
        if domain.reliable.any():
            spline = _Spline.over(domain, self.knot_px)
            depth = depth_map.depth.ravel()[spline.pixel].astype(np.float64)
            std = depth_map.std.ravel()[spline.pixel].astype(np.float64)
            reliable = domain.reliable.ravel()[spline.pixel]
            c = self._coefficients(spline, 1.0 / depth, std / depth**2, reliable)
            inverse_depth.ravel()[spline.pixel] = spline.values(c)
        with np.errstate(divide="ignore", invalid="ignore"):
            fitted = np.where(inverse_depth > 0.0, 1.0 / inverse_depth, np.nan).astype(np.float32)
        known = np.isfinite(fitted)
        return replace(
            depth_map,
            depth=fitted,
            std=np.where(known, depth_map.std, np.float32(np.nan)),
            views=np.where(known, depth_map.views, np.uint8(0)),
        )

    def _coefficients(self, spline: _Spline, value: F64, std: F64, reliable: B8) -> F64:
        """Coefficients fitted to inverse depths (N,); those not reliable are not used."""
        # Rounds of reweighting; those with convex weights, and with the softest spline, which detect
        # outliers.
        rounds, huber_rounds, initial_rounds = 13, 2, 5
        # Initial stiffness, relative to the weight of a pixel with the median standard deviation.
        min_stiffness = 1e-3
        # First factor of a change of stiffness, and the exponent from one factor to the next.
        first_step, step_decay = 1e3, 0.65
        unit = float(np.median(std[reliable]))
        value, std = value / unit, std / unit
        weight, stiffness = reliable.astype(np.float64), np.full(len(spline.cell), min_stiffness)
        noise, cell, shape = np.zeros(0), spline.cell[spline.piece], spline.shape
        # The n residuals of a window have n - p degrees of freedom with standard deviation sqrt(2 p) of the
        # fitted part: larger mean squares are incompatible with the softest spline.
        n, p = (self.knot_px * WINDOW) ** 2, WINDOW**2
        allowed = float(n / (n - p) * (1.0 + np.sqrt(2.0 * p) / n))
        for k in range(rounds):
            c = spline.fit(value, weight / std**2, stiffness)
            residual = (spline.values(c) - value) / std
            weight = np.where(reliable, _weights(residual, reliable, redescending=k >= huber_rounds), 0.0)
            # Weighted means of squared residuals in the window around each cell.
            above, below = (
                scipy.ndimage.uniform_filter(
                    np.bincount(cell, part, shape[0] * shape[1]).reshape(shape), WINDOW, mode="constant"
                )
                for part in (weight * residual**2, weight)
            )
            found = (above / np.maximum(below, 1e-12)).ravel()
            if k < initial_rounds:
                noise = allowed * found
            else:
                step = first_step ** (step_decay ** (k - initial_rounds))
                stiffness *= np.where(found <= noise, step, 1.0 / step)[spline.cell]
        return c * unit


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
