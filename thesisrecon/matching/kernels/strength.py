"""Strength of match, equation (4.1), and the weight functions of figure 4.4."""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.types import F32, F64, I64


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
