"""What the matching needs of one photograph, computed once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.geometry.raster import halve, resample
from thesisrecon.matching.kernels import SIDE, corner_patches
from thesisrecon.types import F32, F64, I64, Features, Image

PYRAMID_LEVELS = 4


@dataclass(frozen=True)
class PreparedView:
    """A photograph ready to be matched.

    ``size`` (width, height) px; ``features`` as detected. The grey pyramid is ``pixels`` (all levels one
    after the other), ``levels`` (L, 3) offset, height, width, level k spanning ``base 2^k`` px per pixel.
    ``patches`` (N, 225): the normalised 15 x 15 window of each corner at its scale (zero where it leaves the
    image); other widths where the matcher asked for them.
    ``cell_px, cell_shape, cell_start, cell_order``: the corners sorted into square cells.
    """

    size: tuple[int, int]
    features: Features
    pixels: F32
    levels: I64
    base: float
    patches: F32
    cell_px: float
    cell_shape: I64
    cell_start: I64
    cell_order: I64

    @property
    def pyramid(self) -> tuple[F32, I64, float]:
        """Pixels, levels, base: as the kernels take it."""
        return self.pixels, self.levels, self.base

    @property
    def cells(self) -> tuple[float, I64, I64, I64]:
        """Cell size, shape, start, order: as the kernels take it."""
        return self.cell_px, self.cell_shape, self.cell_start, self.cell_order

    @property
    def long_side(self) -> int:
        """The longer of width and height, px."""
        return max(self.size)


def prepare_view(
    image: Image, features: Features, *, window: int = SIDE, colour: bool = False
) -> PreparedView:
    """Grey pyramid, corner windows and corner cells of one photograph.

    The pyramid starts at twice the size where the corners were found there (scale below 1). ``window``, odd,
    is the side of the correlation windows; where ``colour``, they hold the three colours one after the other,
    each normalised, so that the product of two is the mean of the colours' correlations.
    """
    if window < 3 or window % 2 == 0:
        raise ValueError(f"a correlation window has an odd side of at least 3; got {window}")
    doubled = len(features.scale) > 0 and float(features.scale.min()) < 0.75
    base = 0.5 if doubled else 1.0
    pixels, levels = _pyramid(image.gray, doubled)
    channels = [pixels]
    if colour:
        channels = [_pyramid(image.rgb[:, :, c].astype(np.float32), doubled)[0] for c in range(3)]
    parts = [corner_patches(c, levels, base, features.xy, features.scale, window) for c in channels]
    patches = np.hstack(parts) / np.float32(np.sqrt(3.0)) if colour else parts[0]
    cell_px = max(4.0, 0.01 * max(image.size))
    shape, start, order = _cells(features.xy, image.size, cell_px)
    return PreparedView(image.size, features, pixels, levels, base, patches, cell_px, shape, start, order)


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
    """Corners in square cells, row by row: those of cell c are ``order[start[c]:start[c + 1]]``."""
    shape = np.array([int(size[1] / cell_px) + 1, int(size[0] / cell_px) + 1], dtype=np.int64)
    column, row = (np.clip((xy[:, a] / cell_px).astype(np.int64), 0, shape[1 - a] - 1) for a in (0, 1))
    cell = row * shape[1] + column
    order = np.argsort(cell, kind="stable").astype(np.int64)
    start = np.searchsorted(cell[order], np.arange(shape[0] * shape[1] + 1)).astype(np.int64)
    return shape, start, order
