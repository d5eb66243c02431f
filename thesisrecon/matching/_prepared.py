"""Windows for normalised cross-correlation (4.2.2), and pyramids of an image prepared for matching.

A pyramid is stored as ``pixels``, all levels one after the other, and ``levels`` (L, 3): offset, height and
width of each; a pixel of level k spans ``base * 2^k`` pixels of the image.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from thesisrecon._numba import FAST, empty, kernel, zeros
from thesisrecon.arrays import B8, F32, F64, I64
from thesisrecon.imaging.resampling import halve, resample
from thesisrecon.records import Features, FundamentalFit, Image, Matches, Seeds

SIDE = 15
SAMPLES = SIDE * SIDE
PYRAMID_LEVELS = 4
Found = TypeVar("Found", Features, Seeds, Matches)


@kernel
def pyramid_level(scale: float, base: float, count: int) -> int:
    """Level whose pixel size is nearest to ``scale`` px (logarithmic); ``base`` = pixel size of level 0."""
    k = int(np.floor(np.log2(scale / base) + 0.5))
    return min(max(k, 0), count - 1)


@kernel
def window_raster(side: int) -> F32:
    """Columns and rows of the samples of a window, counted from its centre, and scratch (4, side^2)."""
    raster = empty((4, side * side), np.float32)
    for n in range(side * side):
        raster[0, n], raster[1, n] = n % side - side // 2, n // side - side // 2
    return raster


@kernel(fastmath=FAST, forceinline=True)
def sample_window(
    pixels: F32, level: I64, to_level: float, xy: F64, step: F64, raster: F32, out: F32
) -> bool:
    """Sample a square window bilinearly to ``out`` (side^2,); False if it leaves the image."""
    # Column a and row b of the `raster` is at `xy + step @ (a, b)`; `to_level` = level pixels per image
    # pixel.
    offset, height, width = level[0], level[1], level[2]
    x0 = (xy[0] + 0.5) * to_level - 0.5
    y0 = (xy[1] + 0.5) * to_level - 0.5
    a, b = step[0, 0] * to_level, step[0, 1] * to_level
    c, d = step[1, 0] * to_level, step[1, 1] * to_level
    half = -raster[0, 0]
    reach_x, reach_y = half * (abs(a) + abs(b)), half * (abs(c) + abs(d))
    if not (x0 - reach_x >= 0.0 and x0 + reach_x < width - 1.001):
        return False
    if not (y0 - reach_y >= 0.0 and y0 + reach_y < height - 1.001):
        return False
    left, top = int(x0 - reach_x), int(y0 - reach_y)
    start, wide = offset + top * width + left, np.float32(width)
    x, y = np.float32(x0 - left), np.float32(y0 - top)
    ax, bx, ay, by = np.float32(a), np.float32(b), np.float32(c), np.float32(d)
    column, row, place, weight = raster[0], raster[1], raster[2], raster[3]
    for n in range(len(out)):
        u, v = x + ax * column[n] + bx * row[n], y + ay * column[n] + by * row[n]
        iu, iv = np.float32(np.int32(u)), np.float32(np.int32(v))
        place[n], weight[n], out[n] = iv * wide + iu, v - iv, u - iu
    for n in range(len(out)):
        at, p = start + int(place[n]), out[n]
        upper = pixels[at] + p * (pixels[at + 1] - pixels[at])
        lower = pixels[at + width] + p * (pixels[at + width + 1] - pixels[at + width])
        out[n] = upper + weight[n] * (lower - upper)
    return True


@kernel(fastmath=FAST, forceinline=True)
def normalize_window(window: F32) -> float:
    """Normalise to mean 0 and norm 1 in place (4.2.2) and return the norm, 0 below half a grey level."""
    total = np.float32(0.0)
    for n in range(len(window)):
        total += window[n]
    mean = total / np.float32(len(window))
    square = np.float32(0.0)
    for n in range(len(window)):
        window[n] -= mean
        square += window[n] * window[n]
    norm = np.sqrt(square)
    # Contrast below half a grey level per pixel is noise.
    if norm < 0.5 * np.sqrt(float(len(window))):
        window[:] = np.float32(0.0)
        return 0.0
    factor = np.float32(1.0) / norm
    for n in range(len(window)):
        window[n] *= factor
    return float(norm)


@kernel(fastmath=FAST, forceinline=True)
def dot(a: F32, b: F32) -> float:
    """Inner product of two float32 vectors."""
    total = np.float32(0.0)
    for n in range(len(a)):
        total += a[n] * b[n]
    return float(total)


@kernel
def _corner_patches(pixels: F32, levels: I64, base: float, xy: F64, scale: F32, side: int = SIDE) -> F32:
    """Normalised upright windows (N, side^2) of the corners at their scale; zero outside the image."""
    out = zeros((len(xy), side * side), np.float32)
    step, raster = zeros((2, 2)), window_raster(side)
    for n in range(len(xy)):
        k = pyramid_level(scale[n], base, len(levels))
        step[0, 0] = step[1, 1] = scale[n]
        if sample_window(pixels, levels[k], 1.0 / (base * 2.0**k), xy[n], step, raster, out[n]):
            normalize_window(out[n])
        else:
            out[n] = np.float32(0.0)
    return out


@kernel
def affine_determinant(a: F64) -> float:
    """Determinant of a local affine map, 0 if it is implausible (mirrored, or scaled by more than five)."""
    determinant = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    return determinant if determinant > 0.04 and determinant < 25.0 else 0.0


@dataclass(frozen=True)
class PreparedImage:
    """An image prepared for matching."""

    size: tuple[int, int]  #: (width, height)
    features: Features
    pyramid: tuple[F32, I64, float]  #: pixels, levels and base: arguments of the kernels
    cells: tuple[float, I64, I64, I64]  #: side px, shape, start and order of the corner cells
    window: int  #: side of the corner windows
    channels: tuple[F32, ...]  #: pixels of which they are cut

    @property
    def long_side(self) -> int:
        return max(self.size)

    @cached_property
    def patches(self) -> F32:
        """Normalised windows (N, D) of the corners, the channels side by side; zero outside the image."""
        (_, levels, base), found = self.pyramid, self.features
        parts = [_corner_patches(c, levels, base, found.xy, found.scale, self.window) for c in self.channels]
        return parts[0] if len(parts) == 1 else np.hstack(parts) / np.float32(np.sqrt(len(parts)))

    @property
    def nbytes(self) -> int:
        """Memory with the windows, which only some stages need, and without the features."""
        windows = len(self.channels) * len(self.features.xy) * self.window**2 * 4
        pixels = {id(pixels): pixels.nbytes for pixels in (self.pyramid[0], *self.channels)}
        return windows + sum(pixels.values())


def prepare_image(
    image: Image, features: Features, *, window: int = SIDE, colour: bool = False
) -> PreparedImage:
    """Compute the grey pyramid and the corner cells of an image, for corner windows of side ``window``."""
    # It starts at twice the image size with corners of scale below 1. `colour`: windows of the three colours.
    doubled = len(features.scale) > 0 and float(features.scale.min()) < 0.75
    base = 0.5 if doubled else 1.0
    pixels, levels = _pyramid(image.gray, doubled)
    grays = [image.rgb[:, :, c].astype(np.float32) for c in range(3)] if colour else []
    channels = tuple(_pyramid(gray, doubled)[0] for gray in grays) or (pixels,)
    cell_px = max(4.0, 0.01 * max(image.size))
    cells = (cell_px, *_cells(features.xy, image.size, cell_px))
    return PreparedImage(image.size, features, (pixels, levels, base), cells, window, channels)


def _pyramid(gray: F32, doubled: bool) -> tuple[F32, I64]:
    if doubled:
        gray = resample(gray, 2 * gray.shape[1], 2 * gray.shape[0])
    grays = [gray]
    while len(grays) < PYRAMID_LEVELS and min(grays[-1].shape) >= 16:
        grays.append(halve(grays[-1]))
    offsets = np.cumsum([0] + [g.size for g in grays[:-1]])
    levels = np.array([(at, *g.shape) for at, g in zip(offsets, grays, strict=True)], dtype=np.int64)
    return np.concatenate([g.ravel() for g in grays]), levels


def _cells(xy: F64, size: tuple[int, int], cell_px: float) -> tuple[I64, I64, I64]:
    """Sort corners into square cells, row by row: those of cell c are ``order[start[c]:start[c + 1]]``."""
    shape = np.array([int(size[1] / cell_px) + 1, int(size[0] / cell_px) + 1], dtype=np.int64)
    column, row = (np.clip((xy[:, a] / cell_px).astype(np.int64), 0, shape[1 - a] - 1) for a in (0, 1))
    cell = row * shape[1] + column
    order = np.argsort(cell, kind="stable").astype(np.int64)
    start = np.searchsorted(cell[order], np.arange(shape[0] * shape[1] + 1)).astype(np.int64)
    return shape, start, order


EstimateFundamental = Callable[[F64, F64, np.random.Generator], FundamentalFit]
MapAll = Callable[[Callable[[Any], Any], Iterable[Any]], list[Any]]
"""Apply a function to each item, possibly in several threads, and return the results in order."""


def empty_matches(pair: tuple[int, int]) -> Matches:
    index, xy = np.empty(0, np.int64), np.empty((0, 2))
    return Matches(*pair, index, index, xy, xy, np.empty(0, np.float32), np.empty((0, 2, 2)))


def one_to_one(index: I64, score: F32) -> I64:
    """Rows, sorted, of the best ``score`` of each corner of image 2, given by ``index`` (N,); -1: none."""
    rows = np.flatnonzero(index >= 0)
    rows = rows[np.lexsort((rows, -score[rows]))]
    return np.sort(rows[np.unique(index[rows], return_index=True)[1]])


def join_matches(parts: Sequence[Matches]) -> Matches:
    """The matches of one pair, those of each part after the other."""
    names = [f.name for f in fields(Matches)[2:]]
    arrays = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    return Matches(parts[0].i, parts[0].j, *arrays)


def select_found(found: Found, rows: I64 | B8) -> Found:
    """Some of the corners of features, of the seeds or of the matches."""
    columns = {field.name: getattr(found, field.name) for field in fields(found)}
    chosen: dict[str, Any] = {name: a[rows] for name, a in columns.items() if isinstance(a, np.ndarray)}
    return replace(found, **chosen)


def strongest_corners(features: Features, share: float) -> I64:
    """Rows, sorted, of the strongest corners, a share of each scale: two images keep the same ones."""
    return _first_of_each(features.scale, share)


def strongest_share(features: Features, share: float) -> Features:
    """The features with their strongest corners, and with as large a share of the seeds of each level."""
    fewer, seeds = select_found(features, strongest_corners(features, share)), features.seeds
    if seeds is None:
        return fewer
    level = np.where(seeds.angle == 0.0, seeds.scale, -seeds.scale)
    return replace(fewer, seeds=select_found(seeds, _first_of_each(level, share)))


def _first_of_each(label: F32, share: float) -> I64:
    """Rows, sorted, of the first ``share`` of the rows of each label."""
    groups = [np.flatnonzero(label == one) for one in np.unique(label)]
    first = [rows[: math.ceil(share * len(rows))] for rows in groups]
    return np.sort(np.concatenate([np.zeros(0, np.int64), *first]))
