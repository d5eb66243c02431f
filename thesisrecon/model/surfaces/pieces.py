"""Pixels that hang together: what of a depth map is fitted by which coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from thesisrecon.model.depth_surface import one_surface, steepest_slope
from thesisrecon.model.surfaces.kernels import label_pieces, number_coefficients
from thesisrecon.robust.noise import MAD_FACTOR
from thesisrecon.types import B8, F64, I64, DepthMap

STEP = 5.0
"""Deviations by which a difference stands out that is a step."""


@dataclass(frozen=True)
class Domain:
    """What of a depth map a surface stands in front of: ``held`` (H, W), and ``speaks``, whose depths count;
    ``right`` (H, W - 1), ``down`` (H - 1, W): whether neighbours are of one surface."""

    held: B8
    speaks: B8
    right: B8
    down: B8


@dataclass(frozen=True)
class Pieces:
    """``piece`` (H, W), the number of the piece that each pixel is of, -1 for none; ``coefficient`` (N, 16),
    the coefficients of each piece; ``cell`` (N,), where it lies among the cells (``shape``); ``count`` of
    coefficients."""

    piece: I64
    coefficient: I64
    cell: I64
    shape: tuple[int, int]
    count: int


def domain_of(depth_map: DepthMap, *, grazing_deg: float, least: int, reach: float) -> Domain:
    """Depths joined to surfaces, cut where they break.

    Connected pixels fewer than ``least`` are no surface: their depths do not speak. Within ``reach`` px of
    one they get its depth, beyond there is nothing.
    """
    depth, std = depth_map.depth.astype(np.float64), depth_map.std.astype(np.float64)
    slope = steepest_slope(depth_map.P, grazing_deg)
    known = np.isfinite(depth) & (depth > 0.0) & (std > 0.0) & np.isfinite(std)
    depth = np.where(known, depth, np.nan)
    joined = [
        _alike(depth, std, np.full(depth.shape, slope), axis) & ~_steps(1.0 / depth, std / depth**2, axis)
        for axis in (0, 1)
    ]
    speaks = known & (_sizes(joined, known) >= least)
    if not speaks.any():
        return Domain(speaks, speaks, joined[1], joined[0])
    away, (y, x) = scipy.ndimage.distance_transform_edt(~speaks, return_indices=True)
    held = known & (away <= reach)
    for axis in (0, 1):
        # The depth of a pixel that does not speak is lent by the nearest that does.
        lent = _alike(depth[y, x], std[y, x], slope * (1.0 + 2.0 * away), axis)
        joined[axis] = np.where(_both(speaks, axis), joined[axis], lent) & _both(held, axis)
    # What was lent a depth must hang together with depths that speak.
    held &= _sizes(joined, speaks) >= least
    joined = [one & _both(held, axis) for axis, one in enumerate(joined)]
    return Domain(held, speaks & held, joined[1], joined[0])


def _pairs(values: Any, axis: int) -> tuple[Any, Any]:
    """Values (H, W) of neighbours along an axis."""
    return (values[:-1], values[1:]) if axis == 0 else (values[:, :-1], values[:, 1:])


def _both(mask: B8, axis: int) -> B8:
    first, second = _pairs(mask, axis)
    return np.asarray(first & second)


def _alike(depth: F64, std: F64, slope: F64, axis: int) -> B8:
    """Whether depths are near enough to the next along an axis for one surface."""
    with np.errstate(invalid="ignore"):
        return one_surface(*_pairs(depth, axis), *_pairs(std, axis), np.maximum(*_pairs(slope, axis)))


def _steps(rho: F64, deviation: F64, axis: int) -> B8:
    """Whether inverse depth jumps from a pixel to the next: by another difference than before and after.

    On a plane differences are equal. Those that stand out on both sides by ``STEP`` deviations, of noise as
    it is told or, if that is more, as most differences show it, are steps.
    """
    rho, deviation = np.moveaxis(rho, axis, 0), np.moveaxis(deviation, axis, 0)
    step = np.diff(rho, axis=0)
    padded = np.pad(step, ((1, 1), (0, 0)), constant_values=np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.fmin(np.abs(step - padded[:-2]), np.abs(step - padded[2:]))
        off /= np.sqrt(3.0) * np.hypot(deviation[:-1], deviation[1:])
        told = off[np.isfinite(off)]
        usual = max(1.0, MAD_FACTOR * float(np.median(told))) if len(told) else 1.0
        return np.asarray(np.moveaxis(off > STEP * usual, 0, axis))


def _sizes(joined: Sequence[B8], counted: B8) -> I64:
    """(H, W) number of pixels, of those that are ``counted``, that each hangs together with."""
    shape = counted.shape
    number = np.arange(counted.size).reshape(shape)
    start, stop = (
        np.concatenate([_pairs(number, axis)[end][joined[axis]] for axis in (0, 1)]) for end in (0, 1)
    )
    graph = scipy.sparse.coo_array(
        (np.ones(len(start), dtype=np.int8), (start, stop)), shape=(number.size, number.size)
    )
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    return np.asarray(np.bincount(label, counted.ravel())[label].reshape(shape), dtype=np.int64)


def pieces_of(domain: Domain, cell: int) -> Pieces:
    """The pieces of a domain in cells of ``cell`` px, and the coefficients of each.

    A node of the spline has a coefficient for every part of the surface that hangs together within the
    sixteen cells that it reaches: both sides of a cut have their own, and it is smooth round the end.
    """
    height, width = domain.held.shape
    shape = (-(-height // cell), -(-width // cell))
    piece = np.empty((height, width), dtype=np.int64)
    first = np.empty(shape[0] * shape[1] + 1, dtype=np.int64)
    count = label_pieces(domain.held, domain.right, domain.down, cell, piece, first)
    start, linked = _links(piece, domain, count)
    coefficient = np.empty((count, 16), dtype=np.int64)
    total = number_coefficients(first, shape[1], start, linked, coefficient)
    cells = np.repeat(np.arange(len(first) - 1), np.diff(first))
    return Pieces(piece, coefficient, cells, shape, total)


def _links(piece: I64, domain: Domain, count: int) -> tuple[I64, I64]:
    """Which pieces go on in which others: starts (count + 1,) and numbers."""
    pairs = [
        np.stack([piece[:, :-1][domain.right], piece[:, 1:][domain.right]]),
        np.stack([piece[:-1][domain.down], piece[1:][domain.down]]),
    ]
    pair = np.concatenate(pairs, axis=1)
    pair = np.concatenate([pair, pair[::-1]], axis=1)
    code = np.unique(pair[0] * count + pair[1])
    start = np.searchsorted(code, np.arange(count + 1) * count)
    return start.astype(np.int64), (code % max(count, 1)).astype(np.int64)
