"""Least-squares matching of windows: the place and the local map that make two windows most alike.

S. Baker, I. Matthews, Lucas-Kanade 20 years on: a unifying framework, IJCV 56, 2004, section 3.2.

Least-squares matching of corners: at the scale they were found on, then at the finest there is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy
from numba import njit

from thesisrecon.arrays import F32, F64, I64
from thesisrecon.matching.prepared import (
    FAST,
    SAMPLES,
    SIDE,
    PreparedView,
    dot,
    level_of,
    map_determinant,
    matches_at,
    normalize_window,
    sample_window,
)
from thesisrecon.records import Matches

# The parts below are called for every window and step: inlined they cost what one long function would.
WIDE = SIDE + 2
HALF = SIDE // 2
# Windows that agree less than this show different things; no step from there leads home.
LEAST_ALIKE = 0.3
# Structure along one direction only holds no place: least det / product of the diagonal of the normal matrix.
LEAST_CONDITION = 1e-4
# Squared step, in pixels of the scale, after which another would change nothing.
SETTLED = 1e-6


@njit(cache=True, nogil=True)
def align_windows(
    view1: tuple[F32, I64, float],
    view2: tuple[F32, I64, float],
    matches: tuple[F64, F32, F64, F64],
    limits: tuple[int, float, float, float],
) -> tuple[F64, F64, F32]:
    """Least-squares matching of the window around each ``xy1`` with image 2, gain and bias free.

    ``view*`` = pixels, levels, base; ``matches`` = xy1 (M, 2), scale1 (M,), xy2 (M, 2), affine (M, 2, 2);
    ``limits`` = iterations, prior standard deviation of an affine coefficient (0: translation only), largest
    shift and largest expected error of the place, both in pixels of the corner's scale. Inverse
    compositional: the template's gradients, cleared of its mean and of itself (bias and gain), serve every
    iteration. Returns ``xy2`` (M, 2), affine (M, 2, 2) and the final correlation (M,), 0 where it failed.
    """
    pixels1, levels1, base1 = view1
    pixels2, levels2, base2 = view2
    xy1, scale1, start, affine_start = matches
    iterations, affine_std, largest_shift, largest_std = limits
    xy2, affine = start.copy(), affine_start.copy()
    score = np.zeros(len(xy1), np.float32)
    border = np.empty(WIDE * WIDE, np.float32)
    template, window = np.empty(SAMPLES, np.float32), np.empty(SAMPLES, np.float32)
    gradient = np.empty((6 if affine_std > 0.0 else 2, SAMPLES), np.float32)
    for n in range(len(xy1)):
        determinant = map_determinant(affine[n])
        if determinant == 0.0:
            continue
        m = np.sqrt(determinant)
        # The finest size that both images can show: below its own pixels image 2 has nothing to compare.
        size = max(float(scale1[n]), base2 / m)
        k1, k2 = level_of(size, base1, len(levels1)), level_of(size * m, base2, len(levels2))
        to1, to2 = 1.0 / (base1 * 2.0**k1), 1.0 / (base2 * 2.0**k2)
        if not _read_template(pixels1, levels1[k1], to1, (xy1[n], size), border, (template, gradient)):
            continue
        normal = _normal_matrix(gradient)
        d = normal[0, 0] * normal[1, 1] - normal[0, 1] ** 2
        if d <= LEAST_CONDITION * normal[0, 0] * normal[1, 1]:
            continue
        value = _iterate(
            (pixels2, levels2[k2], to2),
            (template, gradient, normal, window),
            (xy2[n], affine[n]),
            (iterations, affine_std, largest_shift * size * m, size),
        )
        # Variance of the place: that of a sample times the trace of the inverse normal matrix.
        variance = (1.0 - value * value) / SAMPLES * ((normal[0, 0] + normal[1, 1]) / d)
        if value == 0.0 or variance > largest_std * largest_std:
            xy2[n], affine[n] = start[n], affine_start[n]
        else:
            score[n] = value
    return xy2, affine, score


@njit(cache=True, nogil=True, forceinline=True)
def _read_template(
    pixels: F32,
    level: I64,
    to_level: float,
    place: tuple[F64, float],
    border: F32,
    out: tuple[F32, F32],
) -> bool:
    """The normalised window around a place of image 1 and its derivatives with respect to the unknowns.

    ``place`` = xy, size of a sample in px. The unknowns: shift x, y in samples, and, where ``gradient`` has
    six rows, the change of the map in units of half the window, so that all six are of one size. False where
    the window leaves the image or is blank.
    """
    xy, size = place
    template, gradient = out
    step = np.zeros((2, 2))
    step[0, 0] = step[1, 1] = size
    if not sample_window(pixels, level, to_level, xy, step, WIDE, border):
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
        at = 0
        for row in range(-HALF, HALF + 1):
            for column in range(-HALF, HALF + 1):
                gradient[2, at] = gradient[0, at] * column / HALF
                gradient[3, at] = gradient[0, at] * row / HALF
                gradient[4, at] = gradient[1, at] * column / HALF
                gradient[5, at] = gradient[1, at] * row / HALF
                at += 1
    for g in range(len(gradient)):
        _clear(gradient[g], template, norm)
    return True


@njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _clear(gradient: F32, template: F32, norm: float) -> None:
    """Scale a gradient as the template was and remove its parts along a constant and along the template."""
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


@njit(cache=True, nogil=True, forceinline=True)
def _normal_matrix(gradient: F32) -> F64:
    """Inner products of the derivatives."""
    unknowns = len(gradient)
    normal = np.zeros((unknowns, unknowns))
    for g in range(unknowns):
        for h in range(g, unknowns):
            normal[g, h] = normal[h, g] = dot(gradient[g], gradient[h])
    return normal


@njit(cache=True, nogil=True, forceinline=True)
def _iterate(
    level2: tuple[F32, I64, float],
    template: tuple[F32, F32, F64, F32],
    found: tuple[F64, F64],
    limits: tuple[int, float, float, float],
) -> float:
    """Gauss-Newton steps that move ``found`` = xy2, affine in place; the correlation reached, 0 where lost.

    ``template`` = window of image 1, derivatives, normal matrix, room for the window of image 2; ``limits`` =
    iterations, prior std of an affine coefficient, largest shift px, size of a sample of image 1 px.
    """
    pixels, level, to_level = level2
    fixed, gradient, normal, window = template
    xy, a = found
    iterations, affine_std, reach, size = limits
    x, y = xy[0], xy[1]
    moved = np.zeros(len(gradient))
    value = 0.0
    for turn in range(iterations + 1):
        if not sample_window(pixels, level, to_level, xy, a * size, SIDE, window):
            return 0.0
        if normalize_window(window) == 0.0:
            return 0.0
        value = dot(window, fixed)
        if value < LEAST_ALIKE:
            return 0.0
        if turn == iterations:
            break
        delta = _solve_step(gradient, normal, window, value, (moved, affine_std))
        _compose(xy, a, delta, size)
        if (xy[0] - x) ** 2 + (xy[1] - y) ** 2 > reach**2:
            return 0.0
        if turn < iterations - 1 and delta[0] ** 2 + delta[1] ** 2 < SETTLED:
            # One more look at the correlation would cost a window and change nothing.
            break
    return value


@njit(cache=True, nogil=True, forceinline=True)
def _solve_step(gradient: F32, normal: F64, window: F32, value: float, prior: tuple[F64, float]) -> F64:
    """The step of all unknowns; ``prior`` = how far the map has moved (updated), and its standard
    deviation."""
    moved, affine_std = prior
    unknowns = len(gradient)
    damped = normal.copy()
    right = np.empty(unknowns)
    # Residual variance of a normalised sample against the prior of the affine coefficients.
    ridge = max(1.0 - value * value, 1e-4) / SAMPLES / max(HALF * HALF * affine_std * affine_std, 1e-12)
    for g in range(unknowns):
        right[g] = dot(gradient[g], window) / value
        if g >= 2:
            damped[g, g] += ridge
            right[g] -= ridge * moved[g]
    delta = np.empty(unknowns)
    delta[:] = np.linalg.solve(damped, right)
    for g in range(2, unknowns):
        moved[g] += delta[g]
    return delta


@njit(cache=True, nogil=True, forceinline=True)
def _compose(xy: F64, a: F64, delta: F64, size: float) -> None:
    """Take the step back from the map, as the template moved, in place: x2(x) = xy + a x."""
    if len(delta) == 6:
        d = np.empty((2, 2))
        d[0, 0], d[0, 1] = 1.0 + delta[2] / HALF, delta[3] / HALF
        d[1, 0], d[1, 1] = delta[4] / HALF, 1.0 + delta[5] / HALF
        a[:] = a @ np.linalg.inv(d)
    dx, dy = size * delta[0], size * delta[1]
    xy[0] -= a[0, 0] * dx + a[0, 1] * dy
    xy[1] -= a[1, 0] * dx + a[1, 1] * dy


ITERATIONS = 12
# A window of half the width sees less: it must fit better, and not wander from what the wider one found.
FINE_CORRELATION = 0.85
FINE_SHIFT = 1.0
# Smooth shading correlates with anything and holds no place: what its own gradients cannot place to this many
# pixels of its scale is dropped. It removes the false matches that a correlation threshold lets through.
LARGEST_STD = 0.12


def align_corners(
    view1: PreparedView,
    view2: PreparedView,
    matches: tuple[F64, F32, F64, F64],
    *,
    affine_std: float,
    largest_shift: float,
) -> tuple[F64, F64, F32]:
    """Sub-pixel places in image 2 of corners of image 1, with the local maps and the correlations reached.

    Criterion: the squared difference of two 15 x 15 windows, gain and bias free, over the place and the
    affine map, the map held to its start by ``affine_std``. Corners found at a coarser scale are aligned
    there first (a wide basin) and then at the finest scale of the photographs (the noise of the place shrinks
    with the pixel), where the finer answer is kept if it fits.

    Parameters
    ----------
    matches : xy1 (M, 2) px, scale1 (M,), start of xy2 (M, 2) px, start of the affine maps (M, 2, 2).
    affine_std : prior standard deviation of the affine coefficients (pure numbers); 0 leaves them fixed.
    largest_shift : from the start, in pixels of the corner's scale.

    Returns
    -------
    xy2 (M, 2), affine (M, 2, 2), correlation (M,), 0 where the alignment failed or its expected error
    exceeds ``LARGEST_STD`` px of the scale, and the start was kept.
    """
    xy1, scale1, start, maps = matches
    xy2, affine, score = align_windows(
        view1.pyramid,
        view2.pyramid,
        (xy1, scale1, start, maps),
        (ITERATIONS, affine_std, largest_shift, LARGEST_STD),
    )
    coarse = np.flatnonzero((scale1 > 1.5 * view1.base) & (score > 0.0))
    if not len(coarse):
        return xy2, affine, score
    finest = np.full(len(coarse), view1.base, np.float32)
    fine_xy2, _, fine_score = align_windows(
        view1.pyramid,
        view2.pyramid,
        (xy1[coarse], finest, xy2[coarse], affine[coarse]),
        (ITERATIONS, affine_std, FINE_SHIFT, LARGEST_STD),
    )
    fits = fine_score >= FINE_CORRELATION
    xy2[coarse[fits]] = fine_xy2[fits]
    return xy2, affine, score


def aligned_matches(
    view1: PreparedView,
    view2: PreparedView,
    matches: Matches,
    *,
    affine_std: float,
    least_correlation: float,
    largest_shift: float = 3.0,
) -> Matches:
    """The matches of corners with the places in image 2 moved to sub-pixel by :func:`align_corners`.

    Those that do not reach ``least_correlation`` are dropped, and those that the alignment led to the place
    of a better one.
    """
    xy2, affine, score = align_corners(
        view1,
        view2,
        (matches.xy1, view1.features.scale[matches.index1], matches.xy2, matches.affine),
        affine_std=affine_std,
        largest_shift=largest_shift,
    )
    moved = replace(matches, xy2=xy2, affine=affine, score=score)
    good = matches_at(moved, np.flatnonzero(score >= least_correlation))
    return matches_at(good, strongest_distinct(good))


def strongest_distinct(matches: Matches, *, apart_px: float = 1.0) -> I64:
    """Rows, in order, of the matches that repeat no stronger one within ``apart_px`` in both images."""
    rows = np.argsort(-matches.score, kind="stable")
    keep = np.ones(len(rows), np.bool_)
    if len(rows) >= 2:
        places = np.hstack([matches.xy1, matches.xy2])[rows]
        for a, b in sorted(scipy.spatial.cKDTree(places).query_pairs(apart_px)):
            if keep[a]:
                keep[b] = False
    kept: I64 = np.sort(rows[keep])
    return kept
