"""Figure 3.11: epipolar lines drawn into two images."""

from __future__ import annotations

import colorsys

import numpy as np

from thesisrecon.arrays import F64, U8
from thesisrecon.geometry._conditioning import require_finite, require_shapes
from thesisrecon.geometry.two_view import epipolar_lines


def draw_lines(image1: U8, image2: U8, F: F64, xy1: F64, xy2: F64, *, max_lines: int) -> tuple[U8, U8]:
    """Draw the epipolar lines and points of evenly spaced matches into copies of two images."""
    F, xy1, xy2 = (np.asarray(array, dtype=np.float64) for array in (F, xy1, xy2))
    require_shapes("draw_epipolar_lines", F=(F, (3, 3)), xy1=(xy1, ("N", 2)), xy2=(xy2, ("N", 2)))
    require_finite("draw_epipolar_lines", F, xy1, xy2)
    some = np.unique(np.linspace(0, len(xy1) - 1, min(max(max_lines, 0), len(xy1))).astype(np.int64))
    xy1, xy2 = xy1[some], xy2[some]
    return _drawn(image1, epipolar_lines(F.T, xy2), xy1), _drawn(image2, epipolar_lines(F, xy1), xy2)


def _drawn(image: U8, lines: F64, xy: F64) -> U8:
    """An image with unit-normal lines (N, 3) and points (N, 2); number k always has the same colour."""
    # Imported on use: the estimators of this chapter need no images.
    import PIL.Image
    import PIL.ImageDraw

    canvas = PIL.Image.fromarray(image)
    draw = PIL.ImageDraw.Draw(canvas)
    reach, thick = float(np.hypot(*canvas.size)), max(1, round(max(canvas.size) / 400))
    middle = (np.array(canvas.size) - 1.0) / 2.0
    for k, (line, point) in enumerate(zip(lines, xy, strict=True)):
        # The golden ratio spreads hues evenly for any number of matches.
        red, green, blue = (round(255.0 * c) for c in colorsys.hsv_to_rgb(0.618034 * k % 1.0, 1.0, 1.0))
        foot = middle - (line[:2] @ middle + line[2]) * line[:2]
        along = reach * np.array([-line[1], line[0]])
        if np.abs(foot - middle).max() < reach:
            # Pillow cuts off fractions.
            draw.line([*np.rint(foot - along), *np.rint(foot + along)], fill=(red, green, blue), width=thick)
        radius = 4.0 * thick
        draw.ellipse(
            [*np.rint(point - radius), *np.rint(point + radius)], outline=(red, green, blue), width=thick
        )
    return np.asarray(canvas)
