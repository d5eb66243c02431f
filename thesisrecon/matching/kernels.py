"""Compiled loops of the matching; every one has a NumPy twin in the tests.

A pyramid travels as ``pixels``, all its levels one after the other, and ``levels`` (L, 3): offset, height and
width of each; level k spans ``base * 2^k`` pixels of the photograph per pixel.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.types import F32, F64, I64

# Sums may be reordered; assuming that no NaN exists would undo the bounds checks.
FAST = {"contract", "reassoc", "nsz", "arcp"}
SIDE = 15
SAMPLES = SIDE * SIDE
# Two corners of an image closer than this, in pixels of their scale, may be one scene point.
APART = 3.0


@njit(cache=True, nogil=True)
def scan_correlations(correlation: F32, xy2: F32, apart2: F32) -> tuple[I64, F32, F32]:
    """Best column of each row, its value, and the best value of a rival that lies elsewhere.

    ``correlation`` (B, N); ``xy2`` (N, 2) px; ``apart2`` (N,) squared distance within which a rival of column
    n counts as the same place. Returns index (B,), value (B,), rival (B,); -1 where there is no rival.
    """
    rows, columns = correlation.shape
    index = np.zeros(rows, np.int64)
    value = np.full(rows, -1.0, np.float32)
    rival = np.full(rows, -1.0, np.float32)
    for b in range(rows):
        row = correlation[b]
        best, top = 0, np.float32(-2.0)
        for n in range(columns):
            if row[n] > top:
                best, top = n, row[n]
        second = np.float32(-1.0)
        x, y, limit = xy2[best, 0], xy2[best, 1], apart2[best]
        for n in range(columns):
            if row[n] > second:
                dx, dy = xy2[n, 0] - x, xy2[n, 1] - y
                if dx * dx + dy * dy > limit:
                    second = row[n]
        index[b], value[b], rival[b] = best, top, second
    return index, value, rival


@njit(cache=True, nogil=True)
def update_column_best(correlation: F32, first_row: int, value: F32, index: I64) -> None:
    """Keep in ``value`` and ``index`` (N,) the best row of each column seen so far."""
    for b in range(correlation.shape[0]):
        row = correlation[b]
        for n in range(len(value)):
            if row[n] > value[n]:
                value[n] = row[n]
                index[n] = first_row + b


@njit(cache=True, nogil=True)
def fit_local_affines(xy: F64, neighbours: I64, xy1: F64, xy2: F64, prior: F64) -> tuple[F64, F64, F64]:
    """Affine map of image 1 to image 2 around each of ``xy`` (N, 2) from its ``neighbours`` (N, K) among
    matches.

    Weighted least squares, weights 1 / (d^2 + d_mean^2), one round of Cauchy re-weighting against neighbours
    on another surface, held to ``prior`` (M, 2, 2), the mean of the neighbours' own maps, where they are in
    line. Returns the map (N, 2, 2), the place in image 2 (N, 2) and its uncertainty (N,) px.
    """
    count, k = neighbours.shape
    affine = np.empty((count, 2, 2))
    place = np.empty((count, 2))
    spread = np.empty(count)
    residual2 = np.empty(k)
    distance2 = np.empty(k)
    for n in range(count):
        mean2 = 0.0
        a0 = np.zeros((2, 2))
        for m in range(k):
            i = neighbours[n, m]
            dx, dy = xy1[i, 0] - xy[n, 0], xy1[i, 1] - xy[n, 1]
            distance2[m] = dx * dx + dy * dy
            residual2[m] = 0.0
            mean2 += distance2[m] / k
            a0 += prior[i] / k
        mean2 = mean2 + 1e-9
        scale2 = 0.0
        a = a0.copy()
        tx = ty = 0.0
        for turn in range(3):
            s = np.zeros((3, 3))
            r = np.zeros((3, 2))
            total = 0.0
            for m in range(k):
                i = neighbours[n, m]
                w = 1.0 / (distance2[m] + mean2)
                if turn > 0:
                    w /= 1.0 + residual2[m] / (scale2 + 1e-9)
                total += w
                dx, dy = xy1[i, 0] - xy[n, 0], xy1[i, 1] - xy[n, 1]
                ex = xy2[i, 0] - (a0[0, 0] * dx + a0[0, 1] * dy)
                ey = xy2[i, 1] - (a0[1, 0] * dx + a0[1, 1] * dy)
                s[0, 0] += w * dx * dx
                s[0, 1] += w * dx * dy
                s[1, 1] += w * dy * dy
                s[0, 2] += w * dx
                s[1, 2] += w * dy
                s[2, 2] += w
                r[0, 0] += w * dx * ex
                r[1, 0] += w * dy * ex
                r[2, 0] += w * ex
                r[0, 1] += w * dx * ey
                r[1, 1] += w * dy * ey
                r[2, 1] += w * ey
            ridge = 0.05 * total * mean2
            s[0, 0] += ridge
            s[1, 1] += ridge
            s[1, 0], s[2, 0], s[2, 1] = s[0, 1], s[0, 2], s[1, 2]
            z = np.linalg.solve(s, r)
            a[0, 0], a[0, 1] = a0[0, 0] + z[0, 0], a0[0, 1] + z[1, 0]
            a[1, 0], a[1, 1] = a0[1, 0] + z[0, 1], a0[1, 1] + z[1, 1]
            tx, ty = z[2, 0], z[2, 1]
            for m in range(k):
                i = neighbours[n, m]
                dx, dy = xy1[i, 0] - xy[n, 0], xy1[i, 1] - xy[n, 1]
                ex = xy2[i, 0] - (a[0, 0] * dx + a[0, 1] * dy + tx)
                ey = xy2[i, 1] - (a[1, 0] * dx + a[1, 1] * dy + ty)
                residual2[m] = ex * ex + ey * ey
            scale2 = np.median(residual2)
        affine[n] = a
        place[n, 0], place[n, 1] = tx, ty
        spread[n] = np.sqrt(scale2)
    return affine, place, spread


@njit(cache=True, nogil=True)
def level_of(scale: float, base: float, count: int) -> int:
    """The pyramid level whose pixels are nearest to ``scale``, on a logarithmic measure."""
    k = int(np.floor(np.log2(scale / base) + 0.5))
    return min(max(k, 0), count - 1)


@njit(cache=True, nogil=True, fastmath=FAST)
def sample_window(pixels: F32, level: I64, to_level: float, xy: F64, step: F64, side: int, out: F32) -> bool:
    """Bilinear samples of a ``side`` x ``side`` window around ``xy`` px into ``out`` (side^2,), False where
    it leaves.

    Sample (column a, row b), counted from the centre, is at ``xy + step @ (a, b)``; ``level`` is (offset,
    height, width) and ``to_level`` its pixels per pixel of the photograph.
    """
    offset, height, width = level[0], level[1], level[2]
    x0 = (xy[0] + 0.5) * to_level - 0.5
    y0 = (xy[1] + 0.5) * to_level - 0.5
    a, b = step[0, 0] * to_level, step[0, 1] * to_level
    c, d = step[1, 0] * to_level, step[1, 1] * to_level
    half = side // 2
    reach_x, reach_y = half * (abs(a) + abs(b)), half * (abs(c) + abs(d))
    if not (x0 - reach_x >= 0.0 and x0 + reach_x < width - 1.001):
        return False
    if not (y0 - reach_y >= 0.0 and y0 + reach_y < height - 1.001):
        return False
    n = 0
    for row in range(-half, half + 1):
        u_row, v_row = x0 + b * row, y0 + d * row
        for column in range(-half, half + 1):
            u, v = u_row + a * column, v_row + c * column
            iu, iv = int(u), int(v)
            p, q = np.float32(u - iu), np.float32(v - iv)
            at = offset + iv * width + iu
            top = pixels[at] + p * (pixels[at + 1] - pixels[at])
            low = pixels[at + width] + p * (pixels[at + width + 1] - pixels[at + width])
            out[n] = top + q * (low - top)
            n += 1
    return True


@njit(cache=True, nogil=True, fastmath=FAST)
def normalize_window(window: F32) -> float:
    """Subtract the mean and divide by the norm, in place; returns the norm before (0: no structure, left
    zero)."""
    total = np.float32(0.0)
    for n in range(len(window)):
        total += window[n]
    mean = total / np.float32(len(window))
    square = np.float32(0.0)
    for n in range(len(window)):
        window[n] -= mean
        square += window[n] * window[n]
    norm = np.sqrt(square)
    # Less contrast than half a grey level per pixel is noise.
    if norm < 0.5 * np.sqrt(float(len(window))):
        window[:] = np.float32(0.0)
        return 0.0
    factor = np.float32(1.0) / norm
    for n in range(len(window)):
        window[n] *= factor
    return float(norm)


@njit(cache=True, nogil=True)
def corner_patches(pixels: F32, levels: I64, base: float, xy: F64, scale: F32) -> F32:
    """(N, 225) normalised upright 15 x 15 windows of the corners at their scale; zero where they leave."""
    out = np.zeros((len(xy), SAMPLES), np.float32)
    step = np.zeros((2, 2))
    for n in range(len(xy)):
        k = level_of(scale[n], base, len(levels))
        step[0, 0] = step[1, 1] = scale[n]
        if sample_window(pixels, levels[k], 1.0 / (base * 2.0**k), xy[n], step, SIDE, out[n]):
            normalize_window(out[n])
        else:
            out[n] = np.float32(0.0)
    return out


@njit(cache=True, nogil=True, fastmath=FAST)
def dot(a: F32, b: F32) -> float:
    """Inner product of two float32 vectors."""
    total = np.float32(0.0)
    for n in range(len(a)):
        total += a[n] * b[n]
    return float(total)


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
    pixels, levels, base = view1
    xy1, scale1 = corners1
    affine, place, radius = predicted
    xy2, scale2, patches2 = corners2
    cell, shape, start, order = grid2
    F, band, least = gate
    count = len(xy1)
    index = np.full(count, -1, np.int64)
    score = np.zeros(count, np.float32)
    rival = np.full(count, -1.0, np.float32)
    tried, seen = np.empty(len(xy2), np.int64), np.empty(len(xy2), np.float32)
    window = np.empty((2, SAMPLES), np.float32)
    ready = np.zeros(2, np.int64)
    sizes = np.zeros(2)
    base2 = np.min(scale2)
    sizes[0], sizes[1] = base2, 2.0 * base2
    for n in range(count):
        a = affine[n]
        determinant = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
        if not (determinant > 0.04 and determinant < 25.0):
            continue
        m = np.sqrt(determinant)
        inverse = np.empty((2, 2))
        inverse[0, 0], inverse[0, 1] = a[1, 1] / determinant, -a[0, 1] / determinant
        inverse[1, 0], inverse[1, 1] = -a[1, 0] / determinant, a[0, 0] / determinant
        l0 = F[0, 0] * xy1[n, 0] + F[0, 1] * xy1[n, 1] + F[0, 2]
        l1 = F[1, 0] * xy1[n, 0] + F[1, 1] * xy1[n, 1] + F[1, 2]
        l2 = F[2, 0] * xy1[n, 0] + F[2, 1] * xy1[n, 1] + F[2, 2]
        length = np.sqrt(l0 * l0 + l1 * l1) + 1e-300
        if abs(l0 * place[n, 0] + l1 * place[n, 1] + l2) > (radius[n] + band) * length:
            continue
        ready[:] = 0
        best, top, tries = -1, least, 0
        first_x = max(int((place[n, 0] - radius[n]) / cell), 0)
        last_x = min(int((place[n, 0] + radius[n]) / cell), shape[1] - 1)
        first_y = max(int((place[n, 1] - radius[n]) / cell), 0)
        last_y = min(int((place[n, 1] + radius[n]) / cell), shape[0] - 1)
        if last_x < first_x:
            continue
        for cy in range(first_y, last_y + 1):
            row = cy * shape[1]
            for at in range(start[row + first_x], start[row + last_x + 1]):
                c = order[at]
                dx, dy = xy2[c, 0] - place[n, 0], xy2[c, 1] - place[n, 1]
                if dx * dx + dy * dy > radius[n] * radius[n]:
                    continue
                if abs(l0 * xy2[c, 0] + l1 * xy2[c, 1] + l2) > band * length:
                    continue
                t = 0 if scale2[c] < 1.5 * base2 else 1
                if ready[t] == 0:
                    ready[t] = -1
                    ratio = scale1[n] * m / sizes[t]
                    if ratio > 0.6 and ratio < 1.7:
                        size = sizes[t] / m
                        k = level_of(size, base, len(levels))
                        inside = sample_window(
                            pixels,
                            levels[k],
                            1.0 / (base * 2.0**k),
                            xy1[n],
                            inverse * sizes[t],
                            SIDE,
                            window[t],
                        )
                        if inside and normalize_window(window[t]) > 0.0:
                            ready[t] = 1
                if ready[t] < 0:
                    continue
                value = dot(window[t], patches2[c])
                tried[tries], seen[tries] = c, value
                tries += 1
                if value > top:
                    best, top = c, value
        if best < 0:
            continue
        index[n], score[n] = best, top
        for t in range(tries):
            c = tried[t]
            dx, dy = xy2[c, 0] - xy2[best, 0], xy2[c, 1] - xy2[best, 1]
            if dx * dx + dy * dy > (APART * scale2[best]) ** 2:
                rival[n] = max(rival[n], seen[t])
    return index, score, rival


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

    S. Baker, I. Matthews, Lucas-Kanade 20 years on: a unifying framework, IJCV 56, 2004, section 3.2.
    """
    pixels1, levels1, base1 = view1
    pixels2, levels2, base2 = view2
    xy1, scale1, xy2_start, affine_start = matches
    iterations, affine_std, largest_shift, largest_std = limits
    count = len(xy1)
    xy2, affine = xy2_start.copy(), affine_start.copy()
    score = np.zeros(count, np.float32)
    unknowns = 6 if affine_std > 0.0 else 2
    wide = SIDE + 2
    border = np.empty(wide * wide, np.float32)
    template = np.empty(SAMPLES, np.float32)
    window = np.empty(SAMPLES, np.float32)
    gradient = np.empty((6, SAMPLES), np.float32)
    step = np.empty((2, 2))
    half = SIDE // 2
    for n in range(count):
        a = affine[n]
        determinant = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
        if not (determinant > 0.04 and determinant < 25.0):
            continue
        m = np.sqrt(determinant)
        # The finest size that both images can show: below its own pixels image 2 has nothing to compare.
        size = max(float(scale1[n]), base2 / m)
        k1, k2 = level_of(size, base1, len(levels1)), level_of(size * m, base2, len(levels2))
        to1, to2 = 1.0 / (base1 * 2.0**k1), 1.0 / (base2 * 2.0**k2)
        step[0, 0] = step[1, 1] = size
        step[0, 1] = step[1, 0] = 0.0
        if not sample_window(pixels1, levels1[k1], to1, xy1[n], step, wide, border):
            continue
        at = 0
        for row in range(1, wide - 1):
            for column in range(1, wide - 1):
                c = row * wide + column
                template[at] = border[c]
                gradient[0, at] = np.float32(0.5) * (border[c + 1] - border[c - 1])
                gradient[1, at] = np.float32(0.5) * (border[c + wide] - border[c - wide])
                at += 1
        norm = normalize_window(template)
        if norm == 0.0:
            continue
        at = 0
        for row in range(-half, half + 1):
            for column in range(-half, half + 1):
                # Offsets are in units of half the window, so that all six unknowns are of one size.
                gradient[2, at] = gradient[0, at] * column / half
                gradient[3, at] = gradient[0, at] * row / half
                gradient[4, at] = gradient[1, at] * column / half
                gradient[5, at] = gradient[1, at] * row / half
                at += 1
        for g in range(unknowns):
            _clear(gradient[g], template, norm)
        hessian = np.zeros((unknowns, unknowns))
        for g in range(unknowns):
            for h in range(g, unknowns):
                hessian[g, h] = hessian[h, g] = dot(gradient[g], gradient[h])
        if hessian[0, 0] * hessian[1, 1] - hessian[0, 1] ** 2 <= 1e-4 * hessian[0, 0] * hessian[1, 1]:
            continue
        x, y = xy2[n, 0], xy2[n, 1]
        right = np.zeros(unknowns)
        moved = np.zeros(unknowns)
        value = 0.0
        lost = False
        for turn in range(iterations + 1):
            if not sample_window(pixels2, levels2[k2], to2, xy2[n], a * size, SIDE, window):
                lost = True
                break
            if normalize_window(window) == 0.0:
                lost = True
                break
            value = dot(window, template)
            if value < 0.3:
                lost = True
                break
            if turn == iterations:
                break
            damped = hessian.copy()
            # Residual variance of a normalised sample against the prior of the affine coefficients.
            ridge = (
                max(1.0 - value * value, 1e-4) / SAMPLES / max(half * half * affine_std * affine_std, 1e-12)
            )
            for g in range(unknowns):
                right[g] = dot(gradient[g], window) / value
                if g >= 2:
                    damped[g, g] += ridge
                    right[g] -= ridge * moved[g]
            delta = np.linalg.solve(damped, right)
            dx, dy = size * delta[0], size * delta[1]
            if unknowns == 6:
                for g in range(2, 6):
                    moved[g] += delta[g]
                d = np.empty((2, 2))
                d[0, 0], d[0, 1] = 1.0 + delta[2] / half, delta[3] / half
                d[1, 0], d[1, 1] = delta[4] / half, 1.0 + delta[5] / half
                updated = a @ np.linalg.inv(d)
                xy2[n, 0] -= updated[0, 0] * dx + updated[0, 1] * dy
                xy2[n, 1] -= updated[1, 0] * dx + updated[1, 1] * dy
                a[:] = updated
            else:
                xy2[n, 0] -= a[0, 0] * dx + a[0, 1] * dy
                xy2[n, 1] -= a[1, 0] * dx + a[1, 1] * dy
            if (xy2[n, 0] - x) ** 2 + (xy2[n, 1] - y) ** 2 > (largest_shift * size * m) ** 2:
                lost = True
                break
            if turn < iterations - 1 and delta[0] ** 2 + delta[1] ** 2 < 1e-6:
                # One more look at the correlation would cost a window and change nothing.
                break
        if not lost:
            # Variance of the place: that of a sample times the trace of the inverse normal matrix.
            trace = (hessian[0, 0] + hessian[1, 1]) / (hessian[0, 0] * hessian[1, 1] - hessian[0, 1] ** 2)
            lost = (1.0 - value * value) / SAMPLES * trace > largest_std * largest_std
        if lost:
            xy2[n, 0], xy2[n, 1] = x, y
            affine[n] = affine_start[n]
        else:
            score[n] = value
    return xy2, affine, score


@njit(cache=True, nogil=True, fastmath=FAST)
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


@njit(cache=True, nogil=True)
def unite(edges: I64, view_of: I64, n_views: int) -> I64:
    """(N,) the root of each corner after uniting along ``edges`` (E, 2) in their order.

    An edge between two sets that share a view is refused. ``view_of`` (N,) is the view of each corner.
    """
    count = len(view_of)
    parent = np.arange(count)
    # Sets are lists linked through ``following``, so that their views can be compared.
    following = np.full(count, -1, np.int64)
    last = np.arange(count)
    seen = np.zeros(n_views, np.bool_)
    for e in range(len(edges)):
        a, b = edges[e, 0], edges[e, 1]
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        while parent[b] != b:
            parent[b] = parent[parent[b]]
            b = parent[b]
        if a == b:
            continue
        if b < a:
            a, b = b, a
        n = a
        while n >= 0:
            seen[view_of[n]] = True
            n = following[n]
        clash = False
        n = b
        while n >= 0 and not clash:
            clash = seen[view_of[n]]
            n = following[n]
        n = a
        while n >= 0:
            seen[view_of[n]] = False
            n = following[n]
        if clash:
            continue
        parent[b] = a
        following[last[a]] = b
        last[a] = last[b]
    for n in range(count):
        a = n
        while parent[a] != a:
            a = parent[a]
        parent[n] = a
    return parent


@njit(cache=True, nogil=True)
def chain_maps(edges: I64, xy1: F64, xy2: F64, affine: F64, xy: F64, middle: I64) -> tuple[F64, F64]:
    """Breadth-first from the middle observation of every track: x2 = xy2 + A (x1 - xy1) along each edge.

    ``edges`` (E, 2) observations; ``middle`` (T,). Returns the place (K, 2) of the middle's point in every
    observation's view and the map (K, 2, 2) to it; an observation out of reach keeps its own corner.
    """
    count = len(xy)
    place, maps = xy.copy(), np.zeros((count, 2, 2))
    maps[:, 0, 0] = 1.0
    maps[:, 1, 1] = 1.0
    start = np.zeros(count + 1, np.int64)
    for e in range(len(edges)):
        start[edges[e, 0] + 1] += 1
        start[edges[e, 1] + 1] += 1
    start = np.cumsum(start)
    fill = start[:-1].copy()
    incident = np.empty(2 * len(edges), np.int64)
    for e in range(len(edges)):
        for side in range(2):
            incident[fill[edges[e, side]]] = e
            fill[edges[e, side]] += 1
    reached = np.zeros(count, np.bool_)
    queue = np.empty(count, np.int64)
    head, tail = 0, 0
    for t in range(len(middle)):
        queue[tail] = middle[t]
        reached[middle[t]] = True
        tail += 1
    inverse = np.empty((2, 2))
    while head < tail:
        k = queue[head]
        head += 1
        for at in range(start[k], start[k + 1]):
            e = incident[at]
            forward = edges[e, 0] == k
            other = edges[e, 1] if forward else edges[e, 0]
            if reached[other]:
                continue
            a = affine[e]
            if forward:
                place[other] = xy2[e] + a @ (place[k] - xy1[e])
                maps[other] = a @ maps[k]
            else:
                determinant = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
                if abs(determinant) < 1e-6:
                    continue
                inverse[0, 0], inverse[0, 1] = a[1, 1] / determinant, -a[0, 1] / determinant
                inverse[1, 0], inverse[1, 1] = -a[1, 0] / determinant, a[0, 0] / determinant
                place[other] = xy1[e] + inverse @ (place[k] - xy2[e])
                maps[other] = inverse @ maps[k]
            reached[other] = True
            queue[tail] = other
            tail += 1
    return place, maps


@njit(cache=True, nogil=True)
def displacement_weight(a: F64, b: F64, closeness: float) -> float:
    """lambda of figure 4.4: direction x length x distance of two displacement vectors, in [0, 1].

    Displacements under one pixel have no direction worth the name; their lengths are taken as one pixel.
    """
    na, nb = np.hypot(a[0], a[1]), np.hypot(b[0], b[1])
    if na < 1.0 and nb < 1.0:
        return closeness
    cosine = (a[0] * b[0] + a[1] * b[1]) / max(na * nb, 1e-12)
    shorter, longer = max(min(na, nb), 1.0), max(na, nb)
    return float(max(cosine, 0.0) * (shorter / longer) * closeness)


@njit(cache=True, nogil=True)
def strength_of_match(
    correlation: F32, xy: tuple[F64, F64], near: tuple[I64, I64], radius: float, candidates: int
) -> tuple[I64, F32]:
    """Equation 4.1: for each corner of image 1 the candidate of largest SM_k = c_k sum_m max_n (c_mn
    lambda_n).

    ``correlation`` (N1, N2); ``xy`` the corners of both images; ``near`` the neighbours (N1, M) and (N2, N)
    of each corner in its own image, -1 where there are fewer. Returns the corner of image 2 (N1,), -1 where
    no candidate with positive correlation lies within ``radius`` px, and the strength (N1,).
    """
    xy1, xy2 = xy
    near1, near2 = near
    index = np.full(len(xy1), -1, np.int64)
    strength = np.zeros(len(xy1), np.float32)
    held = np.empty(candidates, np.int64)
    moved, other = np.empty(2), np.empty(2)
    for u in range(len(xy1)):
        count = 0
        for v in range(len(xy2)):
            c = correlation[u, v]
            if c <= 0.0 or (count == candidates and c <= correlation[u, held[count - 1]]):
                continue
            if (xy2[v, 0] - xy1[u, 0]) ** 2 + (xy2[v, 1] - xy1[u, 1]) ** 2 > radius * radius:
                continue
            count = min(count + 1, candidates)
            at = count - 1
            while at > 0 and correlation[u, held[at - 1]] < c:
                held[at] = held[at - 1]
                at -= 1
            held[at] = v
        for k in range(count):
            v = held[k]
            moved[0], moved[1] = xy2[v, 0] - xy1[u, 0], xy2[v, 1] - xy1[u, 1]
            total = 0.0
            for m in near1[u]:
                if m < 0:
                    continue
                closeness = 1.0 - np.hypot(xy1[m, 0] - xy1[u, 0], xy1[m, 1] - xy1[u, 1]) / radius
                best = 0.0
                for n in near2[v]:
                    if n >= 0 and correlation[m, n] > best:
                        other[0], other[1] = xy2[n, 0] - xy1[m, 0], xy2[n, 1] - xy1[m, 1]
                        best = max(best, correlation[m, n] * displacement_weight(moved, other, closeness))
                total += best
            if correlation[u, v] * total > strength[u]:
                index[u], strength[u] = v, correlation[u, v] * total
    return index, strength
