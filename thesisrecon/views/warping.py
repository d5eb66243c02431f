"""Forward warping: the pixels of a photograph at other places, what is nearer in front of what is farther.

Both ways of section 1 need it: interpolation (1.2) moves pixels along their rows, the trilinear tensor (1.3)
anywhere. Instead of walking through the photograph in an order that lets nearer pixels overwrite farther ones
(McMillan and Bishop 1995), the inverse depth of every pixel is compared: the same picture, whatever the order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon.arrays import F32, F64
from thesisrecon.geometry.zbuffer import in_strips
from thesisrecon.views.warping_kernels import distances_to_known, draw_surface, fill_from_behind, sample_at

STRETCH = 3.0
"""Pixels that neighbours of one surface come apart at most: what is stretched more is no surface."""

DIRECTIONS = np.array(
    [(a, b) for a in range(-2, 3) for b in range(-2, 3) if np.gcd(a, b) == 1], dtype=np.int32
)
"""Sixteen (down, right) in which holes look for what is around them."""


def forward_warp(
    image: ArrayLike,
    target_xy: F64 | F32,
    inverse_depth: F64 | F32,
    *,
    size: tuple[int, int],
    step: float = np.inf,
    threads: int = 1,
) -> tuple[F32, F32]:
    """A photograph as another view sees it whose places of all pixels are known.

    The pixels are corners of small triangles, within which places are interpolated and colours sampled by
    cubic convolution: exact to a fraction of a pixel where the photograph is linear. Neighbours are of one
    surface where they come no more than 3 px apart and their inverse depth differs by no more than ``step``; at
    cuts every pixel covers half a pixel to each side. Surfaces seen from behind are not drawn.

    Parameters
    ----------
    image : (h, w, C) levels, C >= 1.
    target_xy : (h, w, 2) px where each pixel comes to lie, NaN = nowhere.
    inverse_depth : (h, w) larger in front of smaller, in any unit: a disparity, an inverse depth; NaN = nowhere.
    size : (width, height) of the picture.
    step : greatest difference of the inverse depth of neighbours on one surface.
    threads : draw strips of rows; the picture does not depend on them.

    Returns
    -------
    (H, W, C) and the inverse depth (H, W) of what is seen, both float32, NaN where nothing lands.

    Raises
    ------
    ValueError : for shapes that do not belong together, sizes below one pixel and a negative step.
    """
    levels = np.ascontiguousarray(image, dtype=np.float32)
    if levels.ndim != 3 or levels.shape[:2] != np.shape(inverse_depth):
        raise ValueError(
            f"forward_warp takes an image (h, w, C) and its inverse_depth (h, w); got {levels.shape} and "
            f"{np.shape(inverse_depth)}"
        )
    source, front = forward_map(target_xy, inverse_depth, size=size, step=step, threads=threads)
    return sample(levels, source, threads=threads), front


def forward_map(
    target_xy: F64 | F32,
    inverse_depth: F64 | F32,
    *,
    size: tuple[int, int],
    step: float = np.inf,
    threads: int = 1,
) -> tuple[F32, F32]:
    """Which place (H, W, 2) of a photograph each pixel of another view sees, and its inverse depth (H, W).

    Arguments, NaN and errors as in :func:`forward_warp`, for several images of the same places.
    """
    target = np.ascontiguousarray(target_xy, dtype=np.float64)
    near = np.ascontiguousarray(inverse_depth, dtype=np.float32)
    if near.ndim != 2 or target.shape != (*near.shape, 2):
        raise ValueError(
            f"target_xy must be (h, w, 2) and inverse_depth (h, w); got {target.shape} and {near.shape}"
        )
    if min(size) < 1 or not step >= 0.0:
        raise ValueError(f"size must be at least 1 x 1 and step not negative; got {size} and {step}")
    source = np.full((size[1], size[0], 2), np.nan, dtype=np.float32)
    front = np.full((size[1], size[0]), np.nan, dtype=np.float32)
    limits = np.array([step, STRETCH])
    in_strips(lambda rows: draw_surface(target, near, limits, rows, source, front), size[1], threads)
    return source, front


def sample(image: ArrayLike, source_xy: F32, *, threads: int = 1) -> F32:
    """Cubic samples of ``image`` (h, w, C) at ``source_xy`` (H, W, 2) px; (H, W, C) float32, NaN where it is
    NaN or more than half a pixel outside.

    Beside the border and where one of the sixteen pixels around is NaN bilinear, NaN where one of four is.
    """
    levels = np.ascontiguousarray(image, dtype=np.float32)
    out = np.empty((*source_xy.shape[:2], levels.shape[2]), dtype=np.float32)
    in_strips(lambda rows: sample_at(levels, source_xy, rows, out), len(out), threads)
    return out


def fill_holes(rgb: F32, inverse_depth: F32, *, step: float = 0.0, reach_px: float = np.inf) -> F32:
    """The picture with its holes filled from what is behind them: what was hidden is background.

    Of the nearest known pixels in sixteen directions those count that are behind: their inverse depth is at most
    ``step``, or 0.4 of its range, above the least. Their colours are averaged, weighted by 1 / distance^2.

    Parameters
    ----------
    rgb, inverse_depth : (H, W, C) and (H, W) float32 of :func:`forward_warp`; NaN inverse depth = a hole.
    reach_px : holes look no farther; with a finite reach some may stay.

    Returns
    -------
    (H, W, C) float32; NaN only where no known pixel is in reach.

    Raises
    ------
    ValueError : for shapes that do not belong together.
    """
    if rgb.ndim != 3 or rgb.shape[:2] != inverse_depth.shape:
        raise ValueError(
            f"rgb must be (H, W, C) and inverse_depth (H, W); got {rgb.shape} and {inverse_depth.shape}"
        )
    distance = np.empty((len(DIRECTIONS), *inverse_depth.shape), dtype=np.int16)
    distances_to_known(inverse_depth, DIRECTIONS, distance)
    filled = rgb.copy()
    fill_from_behind(rgb, inverse_depth, DIRECTIONS, distance, (step, reach_px), filled)
    return filled
