"""Compiled loops of the test of an F: the dominant plane, and other epipolar geometries of that plane.

Points are rows (x1, y1, x2, y2) in one frame in which both images are scaled alike, F and H flat row-major
vectors of 9. Distances are Sampson's, so that noise has the standard deviation of one coordinate.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.arrays import B8, F64, I64

NEIGHBOURS = 5
SINGULAR_REL, FARTHEST = 1e-28, 1e280
"""det J J' over the square of its trace below which an H is singular at a match, and its distance squared."""


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def squared_plane_distance(h: F64, x1: float, y1: float, x2: float, y2: float) -> float:
    """Squared distance of a match to the nearest exact match of x2 ~ H x1, to first order.

    c' (J J')^-1 c of the two equations c and their derivatives J by the four coordinates (Chum, Pajdla and
    Sturm, 2005).
    """
    w = h[6] * x1 + h[7] * y1 + h[8]
    c0 = h[0] * x1 + h[1] * y1 + h[2] - w * x2
    c1 = h[3] * x1 + h[4] * y1 + h[5] - w * y2
    j00, j01 = h[0] - x2 * h[6], h[1] - x2 * h[7]
    j10, j11 = h[3] - y2 * h[6], h[4] - y2 * h[7]
    # Sums of squares (Lagrange's identity): the difference of products would round to less than nothing.
    above = (c0 * j10 - c1 * j00) ** 2 + (c0 * j11 - c1 * j01) ** 2 + w * w * (c0 * c0 + c1 * c1)
    entries = j00 * j00 + j01 * j01 + j10 * j10 + j11 * j11 + w * w
    below = (j00 * j11 - j01 * j10) ** 2 + w * w * entries
    # An H that takes all of the image to one place has no exact match nearby.
    squared: float = above / below if below > SINGULAR_REL * entries * entries else FARTHEST
    return squared


@njit(cache=True, nogil=True, error_model="numpy")
def plane_distances(h: F64, points: F64) -> F64:
    """Squared distances (N,) of all points from a homography."""
    squared = np.empty(len(points))
    for k in range(len(points)):
        squared[k] = squared_plane_distance(h, points[k, 0], points[k, 1], points[k, 2], points[k, 3])
    return squared


@njit(cache=True, nogil=True, error_model="numpy")
def plane_of_triple(f: F64, e2: F64, points: F64, triple: I64, h: F64) -> bool:
    """H of the plane through three matches that agree with F: A - e2 v', A = [e2]x F (HZ, result 13.6).

    Each match has v . x1 = b with b = (x2 x A x1) . (x2 x e2) / |x2 x e2|^2. False for points near one line.
    """
    A = np.empty(9)
    for j in range(3):
        A[j] = e2[1] * f[6 + j] - e2[2] * f[3 + j]
        A[3 + j] = e2[2] * f[j] - e2[0] * f[6 + j]
        A[6 + j] = e2[0] * f[3 + j] - e2[1] * f[j]
    M, b = np.empty((3, 2)), np.empty(3)
    for k in range(3):
        x1, y1, x2, y2 = points[triple[k]]
        M[k, 0], M[k, 1] = x1, y1
        p0 = A[0] * x1 + A[1] * y1 + A[2]
        p1 = A[3] * x1 + A[4] * y1 + A[5]
        p2 = A[6] * x1 + A[7] * y1 + A[8]
        a0, a1, a2 = y2 * e2[2] - e2[1], e2[0] - x2 * e2[2], x2 * e2[1] - y2 * e2[0]
        q0, q1, q2 = y2 * p2 - p1, p0 - x2 * p2, x2 * p1 - y2 * p0
        b[k] = (q0 * a0 + q1 * a1 + q2 * a2) / (a0 * a0 + a1 * a1 + a2 * a2 + 1e-300)
    ux, uy, wx, wy = M[1, 0] - M[0, 0], M[1, 1] - M[0, 1], M[2, 0] - M[0, 0], M[2, 1] - M[0, 1]
    area = ux * wy - uy * wx
    if abs(area) < 1e-3:
        return False
    v0 = ((b[1] - b[0]) * wy - (b[2] - b[0]) * uy) / area
    v1 = ((b[2] - b[0]) * ux - (b[1] - b[0]) * wx) / area
    v2 = b[0] - v0 * M[0, 0] - v1 * M[0, 1]
    for i in range(3):
        h[3 * i] = A[3 * i] - e2[i] * v0
        h[3 * i + 1] = A[3 * i + 1] - e2[i] * v1
        h[3 * i + 2] = A[3 * i + 2] - e2[i] * v2
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def plane_normal_equations(h: F64, points: F64, gate: float, G: F64) -> float:
    """``G`` (9, 9) of the equations of x2 ~ H x1, each match weighted by (J J')^-1 and, within the gate, by
    (1 - d^2 / gate^2)^2 (Tukey); returns the sum of min(d^2 / gate^2, 1)."""
    G[:] = 0.0
    total, wide = 0.0, gate * gate
    row = np.zeros((2, 9))
    for k in range(len(points)):
        x1, y1, x2, y2 = points[k, 0], points[k, 1], points[k, 2], points[k, 3]
        share = squared_plane_distance(h, x1, y1, x2, y2) / wide
        if not share < 1.0:
            total += 1.0
            continue
        total += share
        w = h[6] * x1 + h[7] * y1 + h[8]
        j00, j01 = h[0] - x2 * h[6], h[1] - x2 * h[7]
        j10, j11 = h[3] - y2 * h[6], h[4] - y2 * h[7]
        a = j00 * j00 + j01 * j01 + w * w
        b = j00 * j10 + j01 * j11
        # a d - b^2, without its rounding.
        determinant = (j00 * j11 - j01 * j10) ** 2 + w * w * (a + j10 * j10 + j11 * j11)
        # The rows of L^-1 [equations], L the Cholesky factor of J J', times the root of the weight.
        s = (1.0 - share) / np.sqrt(a)
        t = (1.0 - share) * np.sqrt(a / determinant)
        for j in range(3):
            x = x1 if j == 0 else (y1 if j == 1 else 1.0)
            row[0, j], row[0, 6 + j] = s * x, -s * x2 * x
            row[1, j], row[1, 3 + j] = -t * b / a * x, t * x
            row[1, 6 + j] = -t * (y2 - b / a * x2) * x
        for i in range(9):
            for j in range(i, 9):
                G[i, j] += row[0, i] * row[0, j] + row[1, i] * row[1, j]
    for i in range(9):
        for j in range(i):
            G[i, j] = G[j, i]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def refine_plane(h: F64, points: F64, gate: float, iterations: int) -> F64:
    """Fit ``h`` (in place, unit norm) to the points within the gate, reweighted; the last ``G`` (9, 9)."""
    G = np.empty((9, 9))
    for _ in range(iterations):
        h /= np.sqrt(np.sum(h * h)) + 1e-300
        plane_normal_equations(h, points, gate, G)
        vectors = np.linalg.eigh(G)[1]
        new = vectors[:, 0].copy()
        if np.sum(new * h) < 0.0:
            new = -new
        moved = np.sum((new - h) ** 2)
        h[:] = new
        if moved < 1e-18:
            break
    return G


@njit(cache=True, nogil=True, error_model="numpy")
def dominant_plane(f: F64, e2: F64, points: F64, triples: I64, gate: float, h: F64) -> float:
    """The homography (``h``) of a plane of F with the least truncated distances; their mean (1 for none).

    The plane of each triple is judged on all ``points`` (the matches that F fits, or some of them).
    """
    best, trial = float(len(points)), np.empty(9)
    h[:] = 0.0
    wide = 1.0 / (gate * gate)
    for t in range(len(triples)):
        if not plane_of_triple(f, e2, points, triples[t], trial):
            continue
        total = 0.0
        for k in range(len(points)):
            share = wide * squared_plane_distance(
                trial, points[k, 0], points[k, 1], points[k, 2], points[k, 3]
            )
            total += share if share < 1.0 else 1.0
            if total >= best:
                break
        if total < best:
            best = total
            h[:] = trial
    return best / max(len(points), 1)


@njit(cache=True, nogil=True, error_model="numpy")
def parallax_lines(h: F64, points: F64) -> F64:
    """(N, 3) lines x2 x H x1, in image 2 through a match and the place where the plane would have it."""
    lines = np.empty((len(points), 3))
    for k in range(len(points)):
        x1, y1, x2, y2 = points[k, 0], points[k, 1], points[k, 2], points[k, 3]
        p0 = h[0] * x1 + h[1] * y1 + h[2]
        p1 = h[3] * x1 + h[4] * y1 + h[5]
        p2 = h[6] * x1 + h[7] * y1 + h[8]
        lines[k, 0], lines[k, 1], lines[k, 2] = y2 * p2 - p1, p0 - x2 * p2, x2 * p1 - y2 * p0
    return lines


@njit(cache=True, nogil=True, error_model="numpy")
def geometry_of_plane(h: F64, e2: F64, f: F64) -> None:
    """f = [e2]x H, unit norm."""
    for j in range(3):
        f[j] = e2[1] * h[6 + j] - e2[2] * h[3 + j]
        f[3 + j] = e2[2] * h[j] - e2[0] * h[6 + j]
        f[6 + j] = e2[0] * h[3 + j] - e2[1] * h[j]
    f /= np.sqrt(np.sum(f * f)) + 1e-300


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def agreements(f: F64, columns: F64, gate: float, agree: F64) -> None:
    """``agree`` (N,): 1 for the columns of (4, N) with a Sampson distance below the gate, else 0."""
    wide = gate * gate
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
    for k in range(columns.shape[1]):
        x1, y1, x2, y2 = columns[0, k], columns[1, k], columns[2, k], columns[3, k]
        a0 = f0 * x1 + f1 * y1 + f2
        a1 = f3 * x1 + f4 * y1 + f5
        b0 = f0 * x2 + f3 * y2 + f6
        b1 = f1 * x2 + f4 * y2 + f7
        e = a0 * x2 + a1 * y2 + f6 * x1 + f7 * y1 + f8
        agree[k] = 1.0 if e * e < wide * (a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1) else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def geometries_of_plane(h: F64, points: F64, weights: F64, pairs: I64, gate: float) -> tuple[F64, F64, F64]:
    """[e2]x H with the epipole of every pair of matches off the plane, and the weight within the gate of it.

    ``points`` (N, 4) are matches off the plane, ``weights`` (M, N) several weights of each, ``pairs`` (S, 2)
    indices into them; -> F (S, 9), which agree (S, N) as 0 and 1, and the sums of the weights (S, M).
    """
    columns = np.ascontiguousarray(points.T)
    lines = parallax_lines(h, points)
    F, agree, e2 = np.empty((len(pairs), 9)), np.empty((len(pairs), len(points))), np.empty(3)
    for s in range(len(pairs)):
        a, b = lines[pairs[s, 0]], lines[pairs[s, 1]]
        e2[0], e2[1], e2[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        geometry_of_plane(h, e2, F[s])
        agreements(F[s], columns, gate, agree[s])
    return F, agree, agree @ weights.T


@njit(cache=True, nogil=True)
def unlike(order: I64, agree: F64, weights: F64, alike: float, chosen: I64, count: int, most: int) -> int:
    """Add the first of ``order`` to ``chosen`` that share at most ``alike`` of their weight with one chosen
    before, until ``most`` are; ``count`` are there already. Returns how many there are then."""
    for s in order:
        own = 0.0
        for k in range(len(weights)):
            own += weights[k] * agree[s, k]
        fresh = True
        for c in range(count):
            common = 0.0
            for k in range(len(weights)):
                common += weights[k] * agree[s, k] * agree[chosen[c], k]
            if common > alike * own:
                fresh = False
                break
        if fresh:
            chosen[count] = s
            count += 1
            if count >= most:
                break
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def contradicted_shares(h: F64, points: F64, on_plane: B8, chosen: I64, near: float) -> F64:
    """Of the nearest neighbours of each chosen point, the share that lie on the plane and contradict it.

    A neighbour contradicts where the parallax differs by more than the two are apart in image 1: no opaque
    surface looks so, two points of it would change places. Points nearer than ``near`` are the same feature
    and do not count.
    """
    parallax = np.empty((len(points), 2))
    for k in range(len(points)):
        x1, y1 = points[k, 0], points[k, 1]
        w = h[6] * x1 + h[7] * y1 + h[8]
        parallax[k, 0] = points[k, 2] - (h[0] * x1 + h[1] * y1 + h[2]) / w
        parallax[k, 1] = points[k, 3] - (h[3] * x1 + h[4] * y1 + h[5]) / w
    shares, nearest, which = np.zeros(len(chosen)), np.empty(NEIGHBOURS), np.empty(NEIGHBOURS, np.int64)
    for c in range(len(chosen)):
        k, found = chosen[c], 0
        for m in range(len(points)):
            squared = (points[m, 0] - points[k, 0]) ** 2 + (points[m, 1] - points[k, 1]) ** 2
            if squared < near * near or (found == NEIGHBOURS and squared >= nearest[found - 1]):
                continue
            place = min(found, NEIGHBOURS - 1)
            while place > 0 and nearest[place - 1] > squared:
                nearest[place], which[place] = nearest[place - 1], which[place - 1]
                place -= 1
            nearest[place], which[place] = squared, m
            found = min(found + 1, NEIGHBOURS)
        for n in range(found):
            m = which[n]
            apart = (parallax[m, 0] - parallax[k, 0]) ** 2 + (parallax[m, 1] - parallax[k, 1]) ** 2
            shares[c] += 1.0 if on_plane[m] and apart > nearest[n] else 0.0
        shares[c] /= max(found, 1)
    return shares


@njit(cache=True, nogil=True, error_model="numpy")
def count_transferred(H: F64, xy1: F64, xy2: F64, tolerance: float) -> I64:
    """How many of the points (N, 2) each of the homographies (S, 3, 3) takes to within ``tolerance``."""
    counts = np.zeros(len(H), np.int64)
    for s in range(len(H)):
        h = H[s]
        for k in range(len(xy1)):
            x, y = xy1[k, 0], xy1[k, 1]
            w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
            u = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w - xy2[k, 0]
            v = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w - xy2[k, 1]
            counts[s] += 1 if u * u + v * v < tolerance * tolerance else 0
    return counts
