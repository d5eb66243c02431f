"""Compiled loops of view interpolation; each has a NumPy twin in the tests."""

from __future__ import annotations

import numpy as np

from thesisrecon._numba import empty, kernel
from thesisrecon.arrays import F32, F64
from thesisrecon.imaging.filters import weighted_median

ONE_SURFACE_PX = 1.0
"""Neighbouring disparities that differ by more belong to different surfaces."""
REACH, SPARSE = 12, 3
"""Radius and step of the search for the disparity of a guessed pixel."""
WINDOW = 2 * REACH // SPARSE + 1
NEAR = 2
"""Radius of the median over guessed pixels."""


@kernel
def disparity_from_rectified(
    maps: tuple[F32, F32], H: F64, rows: tuple[int, int], places: F64, disparity: F32, sure: F32
) -> None:
    """Transfer disparity and confidence from the rectified frame to the pixels of an image.

    ``maps``: disparities without holes, confidences (0 if unknown); H takes the image to the frame.
    ``places`` (h, w, 2) receives positions in the frame, NaN beyond the line at infinity; ``disparity`` is
    bilinear on one surface, otherwise nearest; ``sure`` receives the confidence, 0 outside the frame.
    """
    field, confidence = maps
    height, width = field.shape
    for y in range(rows[0], rows[1]):
        for x in range(disparity.shape[1]):
            w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
            if not w > 0.0:
                places[y, x] = np.nan
                disparity[y, x] = np.nan
                sure[y, x] = 0.0
                continue
            px = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w
            py = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w
            places[y, x, 0], places[y, x, 1] = px, py
            inside = px > -0.5 and py > -0.5 and px < width - 0.5 and py < height - 0.5
            u, v = min(max(px, 0.0), width - 1.0), min(max(py, 0.0), height - 1.0)
            x0, y0 = min(int(u), max(width - 2, 0)), min(int(v), max(height - 2, 0))
            x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
            a, b, c, d = field[y0, x0], field[y0, x1], field[y1, x0], field[y1, x1]
            near_y, near_x = int(np.rint(v)), int(np.rint(u))
            if max(max(a, b), max(c, d)) - min(min(a, b), min(c, d)) <= ONE_SURFACE_PX:
                top, bottom = a + (u - x0) * (b - a), c + (u - x0) * (d - c)
                disparity[y, x] = top + (v - y0) * (bottom - top)
            else:
                disparity[y, x] = field[near_y, near_x]
            sure[y, x] = confidence[near_y, near_x] if inside else 0.0


@kernel
def filter_extrapolated_by_colour(
    levels: F32, disparity: F32, sure: F32, rows: tuple[int, int], limits: tuple[float, float], out: F32
) -> None:
    """Replace disparities of confidence 0 by a colour-weighted median of their surroundings.

    ``limits``: colour difference at which weights fall to 1 / e; weight of guesses relative to known values.
    """
    height, width = disparity.shape
    values, weights = empty(WINDOW * WINDOW, np.float32), empty(WINDOW * WINDOW)
    for y in range(rows[0], rows[1]):
        for x in range(width):
            out[y, x] = disparity[y, x]
            if sure[y, x] > 0.0 or np.isnan(disparity[y, x]):
                continue
            n, total = 0, 0.0
            least, most = disparity[y, x], disparity[y, x]
            for v in range(max(y - REACH, y % SPARSE), min(y + REACH + 1, height), SPARSE):
                for u in range(max(x - REACH, x % SPARSE), min(x + REACH + 1, width), SPARSE):
                    d = disparity[v, u]
                    if np.isnan(d):
                        continue
                    apart = 0.0
                    for c in range(levels.shape[2]):
                        apart += abs(levels[y, x, c] - levels[v, u, c])
                    weight = np.exp(-apart / limits[0])
                    if sure[v, u] <= 0.0:
                        weight *= limits[1]
                    values[n], weights[n] = d, weight
                    least, most = min(least, d), max(most, d)
                    total += weight
                    n += 1
            # On one surface there is nothing to choose.
            if most - least > ONE_SURFACE_PX:
                out[y, x] = weighted_median(values[:n], weights[:n], np.argsort(values[:n]), 0.5 * total)


@kernel
def filter_extrapolated_by_median(disparity: F32, sure: F32, rows: tuple[int, int], out: F32) -> None:
    """Replace disparities of confidence 0 by the median of their neighbours."""
    height, width = disparity.shape
    values = empty((2 * NEAR + 1) ** 2, np.float32)
    for y in range(rows[0], rows[1]):
        for x in range(width):
            out[y, x] = disparity[y, x]
            if sure[y, x] > 0.0 or np.isnan(disparity[y, x]):
                continue
            n = 0
            for v in range(max(y - NEAR, 0), min(y + NEAR + 1, height)):
                for u in range(max(x - NEAR, 0), min(x + NEAR + 1, width)):
                    if not np.isnan(disparity[v, u]):
                        values[n] = disparity[v, u]
                        n += 1
            if values[:n].max() - values[:n].min() > ONE_SURFACE_PX:
                out[y, x] = np.sort(values[:n])[n // 2]


@kernel
def intermediate_positions(
    places: F64, disparity: F32, share: float, G: F64, rows: tuple[int, int], target: F64
) -> None:
    """Move pixels at ``places`` left by a share of their disparity and map them by G to the view."""
    for y in range(rows[0], rows[1]):
        for x in range(disparity.shape[1]):
            u, v = places[y, x, 0] - share * disparity[y, x], places[y, x, 1]
            w = G[2, 0] * u + G[2, 1] * v + G[2, 2]
            if w > 0.0:
                target[y, x, 0] = (G[0, 0] * u + G[0, 1] * v + G[0, 2]) / w
                target[y, x, 1] = (G[1, 0] * u + G[1, 1] * v + G[1, 2]) / w
            else:
                target[y, x] = np.nan


@kernel
def _at(values: F32, source: F32, y: int, x: int) -> float:
    """The value (h, w) of the pixel nearest to the source (H, W, 2) of a pixel."""
    v = min(max(int(np.rint(source[y, x, 1])), 0), values.shape[0] - 1)
    u = min(max(int(np.rint(source[y, x, 0])), 0), values.shape[1] - 1)
    return float(values[v, u])


@kernel
def blend(
    colors: tuple[F32, F32],
    fronts: tuple[F32, F32],
    sources: tuple[F32, F32],
    weights: tuple[F32, F32],
    limits: tuple[float, float, float],
    out: tuple[F32, F32],
) -> None:
    """Blend two warped images of colours (H, W, 3), inverse depths ``fronts`` and positions ``sources``.

    Where both inverse depths agree, the weighted mean is used. Otherwise known pixels replace guessed ones,
    the nearer of two known pixels is used, and the farther of two guessed ones. ``weights`` (h, w) belong to
    the source pixels; ``limits``: tolerance of inverse depth, weight up to which a pixel is guessed, and s.
    """
    alike, guess, s = limits
    rgb, near = out
    for y in range(near.shape[0]):
        for x in range(near.shape[1]):
            n0, n1 = fronts[0][y, x], fronts[1][y, x]
            if np.isnan(n0) and np.isnan(n1):
                rgb[y, x] = np.nan
                near[y, x] = np.nan
                continue
            w0 = 0.0 if np.isnan(n0) else _at(weights[0], sources[0], y, x)
            w1 = 0.0 if np.isnan(n1) else _at(weights[1], sources[1], y, x)
            if w0 > 0.0 and w1 > 0.0 and abs(n0 - n1) > alike:
                sure0, sure1 = w0 > guess, w1 > guess
                first = n0 > n1 if sure0 and sure1 else (n0 < n1 if sure0 == sure1 else sure0)
                w0, w1 = (w0, 0.0) if first else (0.0, w1)
            if w0 > 0.0 and w1 > 0.0:
                w0, w1 = (1.0 - s) * w0, s * w1
            t = w1 / (w0 + w1)
            for c in range(rgb.shape[2]):
                if t == 0.0:
                    rgb[y, x, c] = colors[0][y, x, c]
                elif t == 1.0:
                    rgb[y, x, c] = colors[1][y, x, c]
                else:
                    rgb[y, x, c] = (1.0 - t) * colors[0][y, x, c] + t * colors[1][y, x, c]
            near[y, x] = n0 if w0 >= w1 else n1
