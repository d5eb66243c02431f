"""Strength of match, equation (4.1), and the weight functions of figure 4.4."""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.types import F32, F64, I64


@njit(cache=True, nogil=True)
def displacement_weight(a: F64, b: F64, closeness: float, terms: tuple[bool, bool, bool]) -> float:
    """lambda of figure 4.4: direction x length x distance of two displacement vectors, in [0, 1].

    ``terms`` says which of the three factors take part. Displacements under one pixel have no direction worth
    the name; their lengths are taken as one pixel.
    """
    direction, length, distance = terms
    weight = closeness if distance else 1.0
    na, nb = np.hypot(a[0], a[1]), np.hypot(b[0], b[1])
    if na < 1.0 and nb < 1.0:
        return float(weight)
    cosine = (a[0] * b[0] + a[1] * b[1]) / max(na * nb, 1e-12)
    shorter, longer = max(min(na, nb), 1.0), max(na, nb)
    along = max(cosine, 0.0) if direction else 1.0
    return float(along * (shorter / longer if length else 1.0) * weight)


@njit(cache=True, nogil=True)
def relative_difference_weight(a: F64, b: F64, apart: float, tolerance: float) -> float:
    """exp(-1/2 (|a - b| / (tolerance apart + 1 px))^2), in (0, 1]: neighbours may move the more differently
    the farther ``apart`` px they are, whatever the length of their displacements."""
    strain = np.hypot(a[0] - b[0], a[1] - b[1]) / (tolerance * apart + 1.0)
    return float(np.exp(-0.5 * strain * strain))


@njit(cache=True, nogil=True)
def strength_of_match(
    correlation: F32,
    xy: tuple[F64, F64],
    near: tuple[I64, I64],
    search: tuple[float, int, float],
    weight: tuple[float, tuple[bool, bool, bool]],
) -> tuple[I64, F32]:
    """Equation 4.1: for each corner of image 1 the candidate of largest SM_k = c_k sum_m max_n (c_mn
    lambda_n).

    ``correlation`` (N1, N2); ``xy`` the corners of both images; ``near`` the neighbours (N1, M) and (N2, N)
    of each corner in its own image, -1 where there are fewer; ``search`` = radius px, number of candidates,
    correlation that a candidate must exceed; ``weight`` = tolerance of the relative difference (0: the
    product of figure 4.4) and the factors of the product. Returns the corner of image 2 (N1,), -1 where no
    candidate lies within the radius, and the strength (N1,).
    """
    xy1, xy2 = xy
    index = np.full(len(xy1), -1, np.int64)
    strength = np.zeros(len(xy1), np.float32)
    held = np.empty(search[1], np.int64)
    for u in range(len(xy1)):
        count = _best_candidates(correlation[u], xy1[u], xy2, search, held)
        for k in range(count):
            v = held[k]
            total = _neighbours_agree(correlation, xy, (near[0][u], near[1][v]), (u, v), (search[0], weight))
            if correlation[u, v] * total > strength[u]:
                index[u], strength[u] = v, correlation[u, v] * total
    return index, strength


@njit(cache=True, nogil=True)
def _best_candidates(
    correlation: F32, place: F64, xy2: F64, search: tuple[float, int, float], held: I64
) -> int:
    """How many corners of image 2 within the radius are candidates; the best, best first, go to ``held``."""
    radius, candidates, least = search
    count = 0
    for v in range(len(xy2)):
        c = correlation[v]
        if c <= least or (count == candidates and c <= correlation[held[count - 1]]):
            continue
        if (xy2[v, 0] - place[0]) ** 2 + (xy2[v, 1] - place[1]) ** 2 > radius * radius:
            continue
        count = min(count + 1, candidates)
        at = count - 1
        while at > 0 and correlation[held[at - 1]] < c:
            held[at] = held[at - 1]
            at -= 1
        held[at] = v
    return count


@njit(cache=True, nogil=True)
def _neighbours_agree(
    correlation: F32,
    xy: tuple[F64, F64],
    near: tuple[I64, I64],
    pair: tuple[int, int],
    rule: tuple[float, tuple[float, tuple[bool, bool, bool]]],
) -> float:
    """sum_m max_n (c_mn lambda_n) of one pair of corners, figure 4.3 step 1 (a) i."""
    xy1, xy2 = xy
    u, v = pair
    radius, (tolerance, terms) = rule
    moved, other = np.empty(2), np.empty(2)
    moved[0], moved[1] = xy2[v, 0] - xy1[u, 0], xy2[v, 1] - xy1[u, 1]
    total = 0.0
    for m in near[0]:
        if m < 0:
            continue
        apart = np.hypot(xy1[m, 0] - xy1[u, 0], xy1[m, 1] - xy1[u, 1])
        best = 0.0
        for n in near[1]:
            # A weight is at most 1, so that only a correlation above the best can beat it.
            if n >= 0 and correlation[m, n] > best:
                other[0], other[1] = xy2[n, 0] - xy1[m, 0], xy2[n, 1] - xy1[m, 1]
                if tolerance > 0.0:
                    agreement = relative_difference_weight(moved, other, apart, tolerance)
                else:
                    agreement = displacement_weight(moved, other, 1.0 - apart / radius, terms)
                best = max(best, correlation[m, n] * agreement)
        total += best
    return total
