"""Connected pieces of a depth map, their spline coefficients, and compiled loops over the pixels.

A piece is a connected component of the pixels of one cell between knots. Cells are numbered row by row,
pieces cell by cell. Cell (p, q) has the nodes (p + i, q + j), i, j = 0 .. 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy

from thesisrecon._numba import empty, full, kernel
from thesisrecon.arrays import B8, F64, I64
from thesisrecon.optimize.noise import MAD_FACTOR
from thesisrecon.records import DepthMap
from thesisrecon.surface._mesh import components, max_depth_slope, same_surface
from thesisrecon.surface.linear import GRAZING_DEG

STEP = 5.0
"""Standard deviations of a significant depth step."""


@kernel
def _root_of(parent: I64, k: int) -> int:
    """Root of k in a union-find forest, with path halving."""
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@kernel
def _join(parent: I64, a: int, b: int) -> None:
    """Union of the trees of a and b under the smaller root."""
    a, b = _root_of(parent, a), _root_of(parent, b)
    if a < b:
        parent[b] = a
    elif b < a:
        parent[a] = b


@kernel
def _number_coefficients(first: I64, columns: int, start: I64, linked: I64, coefficient: I64) -> int:
    """Number the coefficients: at each node, one for each connected set of pieces in the 16 cells around it.

    ``first`` (cells + 1,) is the first piece of each cell; ``linked[start[k]:start[k + 1]]`` are the pieces
    of other cells connected to piece k. ``coefficient`` (N, 16) receives the number at node (i, j) of each
    piece's cell at 4 i + j. Returns the number of coefficients.
    """
    rows = (len(first) - 1) // columns
    parent = np.arange(len(coefficient))
    own = full(len(coefficient), -1, np.int64)
    count = 0
    for a in range(rows + 3):
        for b in range(columns + 3):
            p0, p1 = max(a - 3, 0), min(a, rows - 1)
            q0, q1 = max(b - 3, 0), min(b, columns - 1)
            for p in range(p0, p1 + 1):
                begin, end = first[p * columns + q0], first[p * columns + q1 + 1]
                for k in range(begin, end):
                    parent[k] = k
                    own[k] = -1
            for p in range(p0, p1 + 1):
                for k in range(first[p * columns + q0], first[p * columns + q1 + 1]):
                    for n in range(start[k], start[k + 1]):
                        other = linked[n]
                        if other > k and _within(first, columns, other, p0, p1, q0, q1):
                            _join(parent, k, other)
            for p in range(p0, p1 + 1):
                for q in range(q0, q1 + 1):
                    for k in range(first[p * columns + q], first[p * columns + q + 1]):
                        root = _root_of(parent, k)
                        if own[root] < 0:
                            own[root] = count
                            count += 1
                        coefficient[k, 4 * (a - p) + b - q] = own[root]
    return count


@kernel
def _within(first: I64, columns: int, k: int, p0: int, p1: int, q0: int, q1: int) -> bool:
    """Whether piece k lies in a cell of rows p0 .. p1 and columns q0 .. q1."""
    found = False
    for p in range(p0, p1 + 1):
        found = found or first[p * columns + q0] <= k < first[p * columns + q1 + 1]
    return found


@kernel
def sum_squares(
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
def evaluate_pixels(piece: I64, coefficient: I64, c: F64, basis: F64, cell: int, value: F64) -> None:
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


@dataclass(frozen=True)
class SplinePieces:
    """Piece (H, W) of each pixel, -1 for none; ``coefficient`` (N, 16) and ``cell`` (N,) of each piece."""

    piece: I64
    coefficient: I64
    cell: I64
    shape: tuple[int, int]
    count: int


def domain_of(depth_map: DepthMap, *, least: int, reach: float) -> Domain:
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
    """Whether the inverse depth has a step to the next pixel: a difference unlike those before and after."""
    rho, deviation = np.moveaxis(rho, axis, 0), np.moveaxis(deviation, axis, 0)
    step = np.diff(rho, axis=0)
    padded = np.pad(step, ((1, 1), (0, 0)), constant_values=np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.fmin(np.abs(step - padded[:-2]), np.abs(step - padded[2:]))
        off /= np.sqrt(3.0) * np.hypot(deviation[:-1], deviation[1:])
        finite = off[np.isfinite(off)]
        usual = max(1.0, MAD_FACTOR * float(np.median(finite))) if len(finite) else 1.0
        return np.asarray(np.moveaxis(off > STEP * usual, 0, axis))


def _sizes(joined: Sequence[B8], counted: B8) -> I64:
    """(H, W) number of ``counted`` pixels in the connected region of each pixel."""
    number = np.arange(counted.size).reshape(counted.shape)
    label = _components(number, joined, counted.size)
    return np.asarray(np.bincount(label, counted.ravel())[label].reshape(counted.shape), dtype=np.int64)


def pieces_of(domain: Domain, cell: int) -> SplinePieces:
    """Divide a domain into pieces and number their coefficients.

    A node has one coefficient for every connected part of the surface within its sixteen cells, so that both
    sides of a cut are separate and the surface is smooth around the end of a cut.
    """
    height, width = domain.covered.shape
    shape = (-(-height // cell), -(-width // cell))
    piece, cells = _label_pieces(domain, cell, shape[1])
    first = np.searchsorted(cells, np.arange(shape[0] * shape[1] + 1))
    start, linked = _links(piece, domain, len(cells))
    coefficient = np.empty((len(cells), 16), dtype=np.int64)
    total = _number_coefficients(first, shape[1], start, linked, coefficient)
    return SplinePieces(piece, coefficient, cells, shape, total)


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


def _links(piece: I64, domain: Domain, count: int) -> tuple[I64, I64]:
    """Connections of pieces: starts (count + 1,) and numbers."""
    pair = np.concatenate(
        [[part[joined] for part in _pairs(piece, axis)] for axis, joined in enumerate(domain.joined)], axis=1
    )
    pair = np.concatenate([pair, pair[::-1]], axis=1)
    code = np.unique(pair[0] * count + pair[1])
    start = np.searchsorted(code, np.arange(count + 1) * count)
    return start.astype(np.int64), (code % max(count, 1)).astype(np.int64)
