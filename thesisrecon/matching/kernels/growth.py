"""Growth: local affine maps from known matches, and the search around the places they predict."""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.matching.kernels.windows import (
    SAMPLES,
    SIDE,
    dot,
    level_of,
    map_determinant,
    normalize_window,
    sample_window,
)
from thesisrecon.types import B8, F32, F64, I64

# Two corners of an image closer than this, in pixels of their scale, may be one scene point.
APART = 3.0
# Rounds of least squares of a local map: the first with all neighbours alike, the others re-weighted.
ROUNDS = 3
# How much the prior holds a local map, as a share of what its neighbours' weights say along one direction.
PRIOR_SHARE = 0.05


@njit(cache=True, nogil=True)
def fit_local_affines(xy: F64, neighbours: I64, xy1: F64, xy2: F64, prior: F64) -> tuple[F64, F64, F64]:
    """Affine map of image 1 to image 2 around each of ``xy`` (N, 2) from its ``neighbours`` (N, K) among
    matches.

    Weighted least squares, weights 1 / (d^2 + d_mean^2), rounds of Cauchy re-weighting against neighbours on
    another surface, held to ``prior`` (M, 2, 2), the mean of the neighbours' own maps, where they are in
    line. Returns the map (N, 2, 2), the place in image 2 (N, 2) and its uncertainty (N,) px.
    """
    count, k = neighbours.shape
    affine = np.empty((count, 2, 2))
    place = np.empty((count, 2))
    spread = np.empty(count)
    offset = np.empty((k, 2))
    rest = np.empty((k, 2))
    distance2 = np.empty(k)
    residual2 = np.empty(k)
    for n in range(count):
        mean2 = 0.0
        a0 = np.zeros((2, 2))
        for m in range(k):
            i = neighbours[n, m]
            dx, dy = xy1[i, 0] - xy[n, 0], xy1[i, 1] - xy[n, 1]
            offset[m, 0], offset[m, 1] = dx, dy
            distance2[m] = dx * dx + dy * dy
            residual2[m] = 0.0
            mean2 += distance2[m] / k
            a0 += prior[i] / k
        mean2 = mean2 + 1e-9
        for m in range(k):
            i, dx, dy = neighbours[n, m], offset[m, 0], offset[m, 1]
            rest[m, 0] = xy2[i, 0] - (a0[0, 0] * dx + a0[0, 1] * dy)
            rest[m, 1] = xy2[i, 1] - (a0[1, 0] * dx + a0[1, 1] * dy)
        scale2 = np.inf
        a, z = a0, np.zeros((3, 2))
        for _ in range(ROUNDS):
            z = _solve_correction(offset, rest, (distance2, mean2), (residual2, scale2))
            a = a0 + z[:2].T
            for m in range(k):
                i, dx, dy = neighbours[n, m], offset[m, 0], offset[m, 1]
                ex = xy2[i, 0] - (a[0, 0] * dx + a[0, 1] * dy + z[2, 0])
                ey = xy2[i, 1] - (a[1, 0] * dx + a[1, 1] * dy + z[2, 1])
                residual2[m] = ex * ex + ey * ey
            scale2 = np.median(residual2)
        affine[n] = a
        place[n] = z[2]
        spread[n] = np.sqrt(scale2)
    return affine, place, spread


@njit(cache=True, nogil=True)
def _solve_correction(offset: F64, rest: F64, near: tuple[F64, float], misfit: tuple[F64, float]) -> F64:
    """(3, 2) correction of the prior map, transposed, over the translation, by weighted least squares."""
    distance2, mean2 = near
    residual2, scale2 = misfit
    s = np.zeros((3, 3))
    r = np.zeros((3, 2))
    total = 0.0
    for m in range(len(offset)):
        w = 1.0 / (distance2[m] + mean2)
        w /= 1.0 + residual2[m] / (scale2 + 1e-9)
        total += w
        dx, dy = offset[m, 0], offset[m, 1]
        s[0, 0] += w * dx * dx
        s[0, 1] += w * dx * dy
        s[1, 1] += w * dy * dy
        s[0, 2] += w * dx
        s[1, 2] += w * dy
        s[2, 2] += w
        for side in range(2):
            e = rest[m, side]
            r[0, side] += w * dx * e
            r[1, side] += w * dy * e
            r[2, side] += w * e
    ridge = PRIOR_SHARE * total * mean2
    s[0, 0] += ridge
    s[1, 1] += ridge
    s[1, 0], s[2, 0], s[2, 1] = s[0, 1], s[0, 2], s[1, 2]
    correction = np.empty((3, 2))
    correction[:] = np.linalg.solve(s, r)
    return correction


@njit(cache=True, nogil=True)
def grow_corners(
    view1: tuple[F32, I64, float],
    corners1: tuple[F64, F32],
    predicted: tuple[F64, F64, F64],
    corners2: tuple[F64, F32, F32],
    grid2: tuple[float, I64, I64, I64],
    gate: tuple[F64, float, float],
) -> tuple[I64, F32, F32]:
    """The corner of image 2 that looks most like each corner of image 1, near its predicted place and
    epipolar line.

    ``view1`` = pixels, levels, base; ``corners1`` = xy (N, 2), scale (N,); ``predicted`` = affine (N, 2, 2),
    place (N, 2), radius (N,) px; ``corners2`` = xy, scale, patches (C, 225); ``grid2`` = cell size, shape
    (2,), start, order of the corners of image 2 in cells; ``gate`` = F, half width of the epipolar band px,
    least correlation. Returns the corner of image 2 (-1: none), the correlation, and that of the best rival
    that lies elsewhere (-1: none).
    """
    xy1, scale1 = corners1
    affine, place, radius = predicted
    xy2, scale2, patches2 = corners2
    F, band, least = gate
    count = len(xy1)
    index = np.full(count, -1, np.int64)
    score = np.zeros(count, np.float32)
    rival = np.full(count, -1.0, np.float32)
    near, seen = np.empty(len(xy2), np.int64), np.empty(len(xy2), np.float32)
    window = np.empty((2, SAMPLES), np.float32)
    ready = np.zeros(2, np.bool_)
    sizes = np.array([1.0, 2.0]) * float(np.min(scale2))
    for n in range(count):
        determinant = map_determinant(affine[n])
        if determinant == 0.0:
            continue
        found = _corners_in_band(xy1[n], (place[n], radius[n]), (F, band), xy2, grid2, near)
        if found == 0:
            continue
        _warp_windows(view1, (xy1[n], scale1[n]), (affine[n], determinant), sizes, (window, ready))
        best, top = -1, least
        for t in range(found):
            c = near[t]
            size = 0 if scale2[c] < 1.5 * sizes[0] else 1
            seen[t] = np.float32(-1.0)
            if ready[size]:
                seen[t] = dot(window[size], patches2[c])
                if seen[t] > top:
                    best, top = c, float(seen[t])
        if best >= 0:
            index[n], score[n] = best, top
            rival[n] = _best_elsewhere(xy2, best, APART * scale2[best], near[:found], seen)
    return index, score, rival


@njit(cache=True, nogil=True)
def _corners_in_band(
    xy1: F64,
    search: tuple[F64, float],
    epipolar: tuple[F64, float],
    xy2: F64,
    grid2: tuple[float, I64, I64, I64],
    near: I64,
) -> int:
    """How many corners of image 2 lie within the radius of the place and within the band of the epipolar
    line; their numbers go to ``near``."""
    place, radius = search
    F, band = epipolar
    cell, shape, start, order = grid2
    l0 = F[0, 0] * xy1[0] + F[0, 1] * xy1[1] + F[0, 2]
    l1 = F[1, 0] * xy1[0] + F[1, 1] * xy1[1] + F[1, 2]
    l2 = F[2, 0] * xy1[0] + F[2, 1] * xy1[1] + F[2, 2]
    length = np.sqrt(l0 * l0 + l1 * l1) + 1e-300
    if abs(l0 * place[0] + l1 * place[1] + l2) > (radius + band) * length:
        return 0
    first_x = max(int((place[0] - radius) / cell), 0)
    last_x = min(int((place[0] + radius) / cell), shape[1] - 1)
    first_y = max(int((place[1] - radius) / cell), 0)
    last_y = min(int((place[1] + radius) / cell), shape[0] - 1)
    if last_x < first_x:
        return 0
    found = 0
    for cy in range(first_y, last_y + 1):
        row = cy * shape[1]
        for at in range(start[row + first_x], start[row + last_x + 1]):
            c = order[at]
            dx, dy = xy2[c, 0] - place[0], xy2[c, 1] - place[1]
            if dx * dx + dy * dy > radius * radius:
                continue
            if abs(l0 * xy2[c, 0] + l1 * xy2[c, 1] + l2) > band * length:
                continue
            near[found] = c
            found += 1
    return found


@njit(cache=True, nogil=True, forceinline=True)
def _warp_windows(
    view1: tuple[F32, I64, float],
    corner: tuple[F64, float],
    local: tuple[F64, float],
    sizes: F64,
    out: tuple[F32, B8],
) -> None:
    """The window of a corner of image 1 as image 2 shows it, for each of the ``sizes`` of corners there; not
    ready where the corner would have another size, or the window leaves the image or is blank."""
    pixels, levels, base = view1
    xy, scale = corner
    a, determinant = local
    window, ready = out
    m = np.sqrt(determinant)
    inverse = np.empty((2, 2))
    inverse[0, 0], inverse[0, 1] = a[1, 1] / determinant, -a[0, 1] / determinant
    inverse[1, 0], inverse[1, 1] = -a[1, 0] / determinant, a[0, 0] / determinant
    for t in range(len(sizes)):
        ready[t] = False
        ratio = scale * m / sizes[t]
        if ratio > 0.6 and ratio < 1.7:
            k = level_of(sizes[t] / m, base, len(levels))
            step = inverse * sizes[t]
            if sample_window(pixels, levels[k], 1.0 / (base * 2.0**k), xy, step, SIDE, window[t]):
                ready[t] = normalize_window(window[t]) > 0.0


@njit(cache=True, nogil=True)
def _best_elsewhere(xy2: F64, best: int, apart: float, near: I64, seen: F32) -> float:
    """Largest of the correlations ``seen`` of corners ``near`` that lie ``apart`` from the best; -1: none."""
    rival = np.float32(-1.0)
    for t in range(len(near)):
        dx, dy = xy2[near[t], 0] - xy2[best, 0], xy2[near[t], 1] - xy2[best, 1]
        if dx * dx + dy * dy > apart**2:
            rival = max(rival, seen[t])
    return float(rival)
