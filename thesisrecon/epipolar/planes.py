"""module"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.random import Generator

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.geometry.homogeneous import cross_matrix, homogenize
from thesisrecon.geometry.two_view import epipoles, estimate_homography, homography_residuals, unit_norm

SINGULAR_REL, FARTHEST = 1e-28, 1e280
"""det J J' over the square of its trace below which an H is singular at a match, and its distance squared."""


TRIPLES, SUBSET = 100, 200
"""Planes tried, and matches that each is judged on: a plane of a third of them is found with 98 %."""


OFF_PLANE = 16.0
"""Squared distance in sigma^2 beyond which a match stands off the plane: noise does so once in 3000."""


GATE = 5.0


SUBSET_STEPS, ALL_STEPS, MOST = 3, 4, 600


SAMPLES = 200
"""Homographies tried, and matches they are judged on: a plane of a quarter of them is found with 96 %."""


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _squared_plane_distance(h: F64, x1: float, y1: float, x2: float, y2: float) -> float:
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
def _plane_distances(h: F64, points: F64) -> F64:
    """Squared distances (N,) of all points from a homography."""
    squared = np.empty(len(points))
    for k in range(len(points)):
        squared[k] = _squared_plane_distance(h, points[k, 0], points[k, 1], points[k, 2], points[k, 3])
    return squared


@njit(cache=True, nogil=True, error_model="numpy")
def _induced_homography(f: F64, e2: F64, points: F64, triple: I64, h: F64) -> bool:
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
def _plane_normal_equations(h: F64, points: F64, gate: float, G: F64) -> float:
    """``G`` (9, 9) of the equations of x2 ~ H x1, each match weighted by (J J')^-1 and, within the gate, by
    (1 - d^2 / gate^2)^2 (Tukey); returns the sum of min(d^2 / gate^2, 1)."""
    G[:] = 0.0
    total, wide = 0.0, gate * gate
    row = np.zeros((2, 9))
    for k in range(len(points)):
        x1, y1, x2, y2 = points[k, 0], points[k, 1], points[k, 2], points[k, 3]
        share = _squared_plane_distance(h, x1, y1, x2, y2) / wide
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
        _plane_normal_equations(h, points, gate, G)
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
def _search_dominant_plane(f: F64, e2: F64, points: F64, triples: I64, gate: float, h: F64) -> float:
    """The homography (``h``) of a plane of F with the least truncated distances; their mean (1 for none).

    The plane of each triple is judged on all ``points`` (the matches that F fits, or some of them).
    """
    best, trial = float(len(points)), np.empty(9)
    h[:] = 0.0
    wide = 1.0 / (gate * gate)
    for t in range(len(triples)):
        if not _induced_homography(f, e2, points, triples[t], trial):
            continue
        total = 0.0
        for k in range(len(points)):
            share = wide * _squared_plane_distance(
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
def _count_transferred(H: F64, xy1: F64, xy2: F64, tolerance: float) -> I64:
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


@dataclass(frozen=True)
class DominantPlane:
    """``h`` (9,) unit norm in the frame of the points, ``squared`` (N,) distances of all, in sigma^2."""

    h: F64
    squared: F64

    @property
    def off(self) -> B8:
        """(N,) which points stand off the plane."""
        return np.asarray(self.squared > OFF_PLANE)


def find_dominant_plane(
    f: F64, points: F64, inliers: B8, *, sigma: float, rng: Generator
) -> DominantPlane | None:
    """The plane of F with most of its inliers, least squares over those within 5 sigma; None without one.

    ``f`` (9,), ``points`` (N, 4) and ``sigma`` in one frame.
    """
    mine = points[inliers]
    if len(mine) < 4:
        return None
    e2 = np.linalg.svd(f.reshape(3, 3))[0][:, 2].copy()
    mine = mine[rng.permutation(len(mine))[:MOST]]
    some = mine[:SUBSET]
    triples = rng.integers(0, len(some), (TRIPLES, 3))
    h = np.empty(9)
    _search_dominant_plane(f, e2, some, triples, GATE * sigma, h)
    if not h.any():
        return None
    # A plane through three noisy matches is off elsewhere: the gate starts wide.
    refine_plane(h, some, 2.0 * GATE * sigma, SUBSET_STEPS)
    refine_plane(h, mine, GATE * sigma, ALL_STEPS)
    squared = np.asarray(_plane_distances(h, points)) / sigma**2
    return DominantPlane(h, squared) if (squared < GATE**2).any() else None


def plane_covariance(h: F64, points: F64, sigma: float) -> F64:
    """Covariance (9, 9) of h, unit norm, from the points (N, 4) of the plane."""
    G = np.empty((9, 9))
    _plane_normal_equations(h, points, 1e6 * sigma, G)
    values, vectors = np.linalg.eigh(G)
    # The least eigenvalue is the scale of H, which no distance sees.
    half = vectors[:, 1:] / np.sqrt(np.maximum(values[1:], 1e-14 * values[-1]))
    return np.asarray(sigma**2 * half @ half.T)


def plane_homographies(F: F64, xy1: F64, xy2: F64, triples: I64) -> F64:
    """Homographies of the planes through three matches each, given F; triples (S, 3) -> (S', 3, 3).

    H = A - e2 (M^-1 b)', A = [e2]x F (HZ, result 13.6). Triples on a line are left out.
    """
    _, e2 = epipoles(F)
    A = cross_matrix(e2) @ unit_norm(F)
    x1, x2 = homogenize(xy1), homogenize(xy2)
    away = np.cross(x2, e2)
    b = np.sum(np.cross(x2, x1 @ A.T) * away, axis=1) / np.maximum(np.sum(away**2, axis=1), 1e-300)
    M = x1[triples]
    area, size = np.abs(np.linalg.det(M)), np.ptp(xy1, axis=0).max()
    usable = area > 1e-4 * size**2
    v = np.linalg.solve(M[usable], b[triples[usable]][..., None])[..., 0]
    return A - e2[:, None] * v[:, None, :]


def homography_inlier_ratio(F: F64, xy1: F64, xy2: F64, *, tolerance_px: float, rng: Generator) -> float:
    """Share of matches (N, 2) px that one homography takes to within ``tolerance_px`` in image 2.

    The matches agree with F, so three of them give a homography; the best of the sampled ones is fitted again
    to all its matches until they stay the same. 1 for fewer than 5 matches, which always have one.
    """
    n = len(xy1)
    if n < 5:
        return 1.0
    chosen = rng.permutation(n)[:SUBSET]
    triples = np.argsort(rng.random((SAMPLES, min(len(chosen), 50))), axis=1)[:, :3]
    offsets = rng.integers(0, len(chosen), (SAMPLES, 1))
    triples = chosen[(triples + offsets) % len(chosen)]
    planes = plane_homographies(F, xy1, xy2, triples)
    if not len(planes):
        return _refit_share(np.eye(3), xy1, xy2, tolerance_px)
    counts = _count_transferred(planes, xy1[chosen], xy2[chosen], tolerance_px)
    best = planes[int(np.argmax(counts))]
    return _refit_share(best, xy1, xy2, tolerance_px)


def _refit_share(H: F64, xy1: F64, xy2: F64, tolerance_px: float) -> float:
    inside = homography_residuals(H, xy1, xy2) < tolerance_px
    for _ in range(5):
        points1, points2 = xy1[inside], xy2[inside]
        if len(points1) < 5 or not (np.ptp(points1, axis=0).any() and np.ptp(points2, axis=0).any()):
            break
        again = homography_residuals(estimate_homography(points1, points2), xy1, xy2) < tolerance_px
        if again.sum() <= inside.sum():
            break
        inside = again
    return float(inside.mean())
