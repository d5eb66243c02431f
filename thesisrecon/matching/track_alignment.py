"""Least-squares matching: sub-pixel alignment of windows by position and local affine map.

Inverse compositional (S. Baker and I. Matthews, IJCV 56, 2004, section 3.2), at the corner's, then the finest
scale.
"""

from dataclasses import replace

import numpy as np
import scipy

from thesisrecon._numba import FAST, copy_to, empty, kernel, zeros
from thesisrecon.arrays import F32, F64, I64
from thesisrecon.geometry.small_matrices import solve_damped
from thesisrecon.matching._prepared import (
    SAMPLES,
    SIDE,
    PreparedImage,
    affine_determinant,
    dot,
    normalize_window,
    pyramid_level,
    sample_window,
    select_found,
    window_raster,
)
from thesisrecon.records import Matches

WIDE = SIDE + 2
HALF = SIDE // 2
# Prior standard deviation of an affine coefficient, and minimum correlation of an aligned match.
AFFINE_STD, MIN_CORRELATION = 0.02, 0.8
MAX_STD = 0.12
"""Maximum standard deviation of the position in pixels of the scale. Removes smooth shading, which correlates
with anything and passes a correlation threshold."""


@kernel
def _align_windows(
    view1: tuple[F32, I64, float], view2: tuple[F32, I64, float], matches: tuple[F64, F32, F64, F64],
    limits: tuple[int, float, float, float],
) -> tuple[F64, F64, F32]:  # fmt: skip
    """Align the window around each ``xy1`` with image 2, invariant to gain and bias."""
    # `view*`: pixels, levels, base; `matches`: xy1 (M, 2), scale1 (M,), xy2 (M, 2), affine (M, 2, 2);
    # `limits`: iterations, prior standard deviation of an affine coefficient (0: translation only), maximum
    # shift and error in pixels of the corner's scale. Returns `xy2` (M, 2), affine (M, 2, 2) and the
    # correlation (M,), 0 for failures.
    pixels1, levels1, base1 = view1
    pixels2, levels2, base2 = view2
    xy1, scale1, start, affine_start = matches
    iterations, affine_std, max_shift, largest_std = limits
    xy2, affine = start.copy(), affine_start.copy()
    score = zeros(len(xy1), np.float32)
    wide, raster = (empty(WIDE * WIDE, np.float32), window_raster(WIDE)), window_raster(SIDE)
    template, window = empty(SAMPLES, np.float32), empty(SAMPLES, np.float32)
    gradient = empty((6 if affine_std > 0.0 else 2, SAMPLES), np.float32)
    normal = zeros((len(gradient), len(gradient)))
    for n in range(len(xy1)):
        determinant = affine_determinant(affine[n])
        if determinant == 0.0:
            continue
        m = np.sqrt(determinant)
        # Finest size that both images resolve.
        size = max(float(scale1[n]), base2 / m)
        k1, k2 = pyramid_level(size, base1, len(levels1)), pyramid_level(size * m, base2, len(levels2))
        to1, to2 = 1.0 / (base1 * 2.0**k1), 1.0 / (base2 * 2.0**k2)
        if not _read_template(pixels1, levels1[k1], to1, (xy1[n], size), wide, raster, (template, gradient)):
            continue
        # Inner products of the derivatives.
        for g in range(len(gradient)):
            for h in range(g, len(gradient)):
                normal[g, h] = normal[h, g] = dot(gradient[g], gradient[h])
        d = normal[0, 0] * normal[1, 1] - normal[0, 1] ** 2
        # Structure in one direction gives no position.
        if d <= 1e-4 * normal[0, 0] * normal[1, 1]:
            continue
        value = _iterate(
            (pixels2, levels2[k2], to2), (template, gradient, normal, window, raster), (xy2[n], affine[n]),
            (iterations, affine_std, max_shift * size * m, size),
        )  # fmt: skip
        # Variance of the position: that of a sample times the trace of the inverse normal matrix.
        variance = (1.0 - value * value) / SAMPLES * ((normal[0, 0] + normal[1, 1]) / d)
        if value == 0.0 or variance > largest_std * largest_std:
            copy_to(xy2[n], start[n])
            for row in range(2):
                copy_to(affine[n, row], affine_start[n, row])
        else:
            score[n] = value
    return xy2, affine, score


# Inlined, as the next kernels: they are called for every window.
@kernel(forceinline=True)
def _read_template(
    pixels: F32, level: I64, to_level: float, place: tuple[F64, float], wide: tuple[F32, F32], inner: F32,
    out: tuple[F32, F32],
) -> bool:  # fmt: skip
    """Sample the normalised window of image 1 and its derivatives; False if it leaves the image or is blank.

    ``place``: xy, sample spacing px; ``wide``: buffer and raster of a wider window, ``inner`` its own.
    Unknowns: shift x, y in samples and, with six rows of ``gradient``, the change of the map in half windows.
    """
    xy, size = place
    template, gradient = out
    border, raster = wide
    step = zeros((2, 2))
    step[0, 0] = step[1, 1] = size
    if not sample_window(pixels, level, to_level, xy, step, raster, border):
        return False
    at = 0
    for row in range(1, WIDE - 1):
        for column in range(1, WIDE - 1):
            c = row * WIDE + column
            template[at] = border[c]
            gradient[0, at] = np.float32(0.5) * (border[c + 1] - border[c - 1])
            gradient[1, at] = np.float32(0.5) * (border[c + WIDE] - border[c - WIDE])
            at += 1
    norm = normalize_window(template)
    if norm == 0.0:
        return False
    if len(gradient) == 6:
        half = np.float32(1.0 / HALF)
        for n in range(SAMPLES):
            column, row = half * inner[0, n], half * inner[1, n]
            gradient[2, n], gradient[3, n] = gradient[0, n] * column, gradient[0, n] * row
            gradient[4, n], gradient[5, n] = gradient[1, n] * column, gradient[1, n] * row
    for g in range(len(gradient)):
        _project_out_gain_and_bias(gradient[g], template, norm)
    return True


@kernel(fastmath=FAST, forceinline=True)
def _project_out_gain_and_bias(gradient: F32, template: F32, norm: float) -> None:
    """Scale a gradient like the template and remove its components along a constant and the template."""
    total = np.float32(0.0)
    for n in range(len(gradient)):
        total += gradient[n]
    mean = total / np.float32(len(gradient))
    factor = np.float32(1.0 / norm)
    along = np.float32(0.0)
    for n in range(len(gradient)):
        gradient[n] = (gradient[n] - mean) * factor
        along += gradient[n] * template[n]
    for n in range(len(gradient)):
        gradient[n] -= along * template[n]


@kernel(forceinline=True)
def _iterate(
    level2: tuple[F32, I64, float], template: tuple[F32, F32, F64, F32, F32], found: tuple[F64, F64],
    limits: tuple[int, float, float, float],
) -> float:  # fmt: skip
    """Move ``found`` = xy2, affine in place by Gauss-Newton; return the correlation, 0 if lost."""
    # `template`: window, derivatives, normal matrix, buffer and raster; `limits`: iterations, prior standard
    # deviation, maximum shift px, sample spacing of image 1 px.
    pixels, level, to_level = level2
    fixed, gradient, normal, window, raster = template
    xy, a = found
    iterations, affine_std, reach, size = limits
    x, y = xy[0], xy[1]
    unknowns, value = len(gradient), 0.0
    # The change of the map so far, and the step of all unknowns.
    moved, right, delta = zeros(unknowns), empty(unknowns), zeros(unknowns)
    for turn in range(iterations + 1):
        if not sample_window(pixels, level, to_level, xy, a * size, raster, window):
            return 0.0
        if normalize_window(window) == 0.0:
            return 0.0
        value = dot(window, fixed)
        # The windows show different surfaces, and the iteration does not converge.
        if value < 0.3:
            return 0.0
        if turn == iterations:
            break
        damped = normal.copy()
        # Residual variance of a normalised sample against the prior of the affine coefficients.
        ridge = max(1.0 - value * value, 1e-4) / SAMPLES / max(HALF * HALF * affine_std * affine_std, 1e-12)
        for g in range(unknowns):
            right[g] = dot(gradient[g], window) / value
            if g >= 2:
                damped[g, g] += ridge
                right[g] -= ridge * moved[g]
        solved = solve_damped(damped, right, 0.0, delta)
        for g in range(unknowns):
            delta[g] = -delta[g] if solved else 0.0
            moved[g] += delta[g]
        # The map x2(x) = xy + a x is composed with the inverse of the step of the template.
        if unknowns == 6:
            p, q, r, s = 1.0 + delta[2] / HALF, delta[3] / HALF, delta[4] / HALF, 1.0 + delta[5] / HALF
            determinant = p * s - q * r
            for i in range(2):
                u, v = a[i, 0], a[i, 1]
                a[i, 0], a[i, 1] = (u * s - v * r) / determinant, (v * p - u * q) / determinant
        dx, dy = size * delta[0], size * delta[1]
        xy[0] -= a[0, 0] * dx + a[0, 1] * dy
        xy[1] -= a[1, 0] * dx + a[1, 1] * dy
        if (xy[0] - x) ** 2 + (xy[1] - y) ** 2 > reach**2:
            return 0.0
        if turn < iterations - 1 and delta[0] ** 2 + delta[1] ** 2 < 1e-4:
            # Another correlation would cost a window and not change the result.
            break
    return value


def align_corners(
    view1: PreparedImage, view2: PreparedImage, matches: tuple[F64, F32, F64, F64], *, affine_std: float,
    max_shift: float = 3.0,
) -> tuple[F64, F64, F32]:  # fmt: skip
    """Align corners of image 1 with image 2 to sub-pixel positions, see `_align_windows`.

    Corners of a coarser scale are aligned there (wide convergence) and then at the finest scale (smaller
    noise), which is used if it fits better and stays near. ``max_shift`` is in pixels of the scale.
    """
    xy1, scale1, _, _ = matches
    base = view1.pyramid[2]
    limits = (12, affine_std, max_shift, MAX_STD)
    xy2, affine, score = _align_windows(view1.pyramid, view2.pyramid, matches, limits)
    coarse = np.flatnonzero((scale1 > 1.5 * base) & (score > 0.0))
    if not len(coarse):
        return xy2, affine, score
    finest = np.full(len(coarse), base, np.float32)
    places = (xy1[coarse], finest, xy2[coarse], affine[coarse])
    limits = (12, affine_std, 1.0, MAX_STD)
    fine_xy2, _, fine_score = _align_windows(view1.pyramid, view2.pyramid, places, limits)
    fits = fine_score >= 0.85
    xy2[coarse[fits]] = fine_xy2[fits]
    return xy2, affine, score


def align_matches(
    view1: PreparedImage, view2: PreparedImage, matches: Matches, *, affine_std: float = AFFINE_STD
) -> Matches:
    """Align matches of corners to sub-pixel positions and drop those that fail or repeat a better one."""
    start = (matches.xy1, view1.features.scale[matches.index1], matches.xy2, matches.affine)
    xy2, affine, score = align_corners(view1, view2, start, affine_std=affine_std)
    moved = replace(matches, xy2=xy2, affine=affine, score=score)
    good = select_found(moved, np.flatnonzero(score >= MIN_CORRELATION))
    return select_found(good, strongest_distinct(good))


def strongest_distinct(matches: Matches, apart_px: float = 1.0) -> I64:
    """Rows, sorted, of the matches that do not repeat a stronger one."""
    rows = np.argsort(-matches.score, kind="stable")
    keep = np.ones(len(rows), np.bool_)
    if len(rows) >= 2:
        places = np.hstack([matches.xy1, matches.xy2])[rows]
        for a, b in sorted(scipy.spatial.cKDTree(places).query_pairs(apart_px)):
            if keep[a]:
                keep[b] = False
    kept: I64 = np.sort(rows[keep])
    return kept
