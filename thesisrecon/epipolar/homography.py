"""Homographies: of all matches (HZ, algorithm 4.6), by F and a plane (HZ result 13.6), of the dominant plane.

Points are rows (x1, y1, x2, y2); F and H are row-major vectors of 9. Distances are Sampson distances of H, so
that noise has the standard deviation of one coordinate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from thesisrecon._numba import copy_to, empty, kernel, zeros
from thesisrecon.arrays import B8, F64, I64
from thesisrecon.epipolar._matches import PairFrame, noise_width
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.conditioning import unit_norm
from thesisrecon.geometry.small_matrices import orthogonalize_columns, shortest_column
from thesisrecon.geometry.two_view import (
    homography_linear,
    homography_residuals,
    homography_sampson_residuals,
)
from thesisrecon.optimize.least_squares import minimize_residuals
from thesisrecon.optimize.noise import VARIANCE_OF_INLIERS, next_inlier_limit

# H is singular at a match if det J J' is below the first times its squared trace; it then has the second
# squared distance.
SINGULAR_REL, FARTHEST = 1e-28, 1e280
# Planes tried and matches that each is scored on: a plane with a third of the matches is found with 98 %.
TRIPLES, SUBSET = 100, 200
# Squared distance in sigma^2 beyond which a match is off the plane; noise exceeds it once in 3000.
OFF_PLANE = 16.0
# Gate of the plane in sigma, reweighting steps on the subset and on all matches, maximum number of matches.
GATE = 5.0
SUBSET_STEPS, ALL_STEPS, MOST = 3, 4, 600
# Twice the area of the smallest triangle of three matches, in squared frame units.
MIN_AREA = 1e-3


@kernel(inline="always")
def _squared_plane_distance(h: F64, x1: float, y1: float, x2: float, y2: float) -> float:
    """Squared distance of a match to the nearest exact match of x2 ~ H x1: c' (J J')^-1 c, to first order.

    c are the two equations and J their derivatives by the four coordinates (Chum, Pajdla and Sturm, 2005).
    """
    w = h[6] * x1 + h[7] * y1 + h[8]
    c0 = h[0] * x1 + h[1] * y1 + h[2] - w * x2
    c1 = h[3] * x1 + h[4] * y1 + h[5] - w * y2
    j00, j01 = h[0] - x2 * h[6], h[1] - x2 * h[7]
    j10, j11 = h[3] - y2 * h[6], h[4] - y2 * h[7]
    # Sums of squares (Lagrange's identity): a difference of products could round below zero.
    above = (c0 * j10 - c1 * j00) ** 2 + (c0 * j11 - c1 * j01) ** 2 + w * w * (c0 * c0 + c1 * c1)
    entries = j00 * j00 + j01 * j01 + j10 * j10 + j11 * j11 + w * w
    below = (j00 * j11 - j01 * j10) ** 2 + w * w * entries
    # A singular H has no exact match nearby.
    squared: float = above / below if below > SINGULAR_REL * entries * entries else FARTHEST
    return squared


@kernel
def _plane_distances(h: F64, points: F64) -> F64:
    """Squared distances (N,) of all points from a homography."""
    squared = empty(len(points))
    for k in range(len(points)):
        squared[k] = _squared_plane_distance(h, points[k, 0], points[k, 1], points[k, 2], points[k, 3])
    return squared


@kernel
def induced_homography(f: F64, e2: F64, points: F64, triple: I64, smallest_area: float, h: F64) -> bool:
    """Homography of the plane of three matches, H = A - e2 v' with A = [e2]x F (HZ, result 13.6).

    Each match gives v . x1 = b with b = (x2 x A x1) . (x2 x e2) / |x2 x e2|^2. False if nearly collinear.
    """
    A = empty(9)
    for j in range(3):
        A[j] = e2[1] * f[6 + j] - e2[2] * f[3 + j]
        A[3 + j] = e2[2] * f[j] - e2[0] * f[6 + j]
        A[6 + j] = e2[0] * f[3 + j] - e2[1] * f[j]
    M, b = empty((3, 2)), empty(3)
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
    if not abs(area) > smallest_area:
        return False
    v0 = ((b[1] - b[0]) * wy - (b[2] - b[0]) * uy) / area
    v1 = ((b[2] - b[0]) * ux - (b[1] - b[0]) * wx) / area
    v2 = b[0] - v0 * M[0, 0] - v1 * M[0, 1]
    for i in range(3):
        h[3 * i] = A[3 * i] - e2[i] * v0
        h[3 * i + 1] = A[3 * i + 1] - e2[i] * v1
        h[3 * i + 2] = A[3 * i + 2] - e2[i] * v2
    return True


@kernel
def _plane_normal_equations(h: F64, points: F64, gate: float, G: F64) -> float:
    """Write ``G`` (9, 9) of the equations of x2 ~ H x1; returns the sum of min(d^2 / gate^2, 1).

    Each match has the weight (J J')^-1 and, within the gate, (1 - d^2 / gate^2)^2 (Tukey).
    """
    G[:] = 0.0
    total, wide = 0.0, gate * gate
    row = zeros((2, 9))
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


@kernel
def refine_plane(h: F64, points: F64, gate: float, iterations: int) -> F64:
    """Fit ``h`` in place to the points within a gate by reweighted least squares; returns G."""
    G, turned, vectors = empty((9, 9)), empty((9, 9)), empty((9, 9))
    for _ in range(iterations):
        length = 1e-300
        for i in range(9):
            length += h[i] * h[i]
        for i in range(9):
            h[i] /= np.sqrt(length)
        _plane_normal_equations(h, points, gate, G)
        for i in range(9):
            for j in range(9):
                turned[i, j] = G[i, j]
        orthogonalize_columns(turned, vectors)
        best, product, moved = shortest_column(turned), 0.0, 0.0
        for i in range(9):
            product += vectors[i, best] * h[i]
        for i in range(9):
            new = vectors[i, best] if product >= 0.0 else -vectors[i, best]
            moved += (new - h[i]) ** 2
            h[i] = new
        if moved < 1e-18:
            break
    return G


@kernel
def _search_dominant_plane(f: F64, e2: F64, points: F64, triples: I64, gate: float, h: F64) -> None:
    """Write the plane ``h`` of triples (S, 3) with the smallest sum of truncated squared distances."""
    best, trial = float(len(points)), empty(9)
    h[:] = 0.0
    wide = 1.0 / (gate * gate)
    for t in range(len(triples)):
        if not induced_homography(f, e2, points, triples[t], MIN_AREA, trial):
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
            copy_to(h, trial)


@kernel
def count_transferred(H: F64, xy1: F64, xy2: F64, tolerance: float) -> I64:
    """Number of points (N, 2) that each homography (S, 3, 3) maps to within ``tolerance``."""
    counts = zeros(len(H), np.int64)
    for s in range(len(H)):
        h = H[s]
        for k in range(len(xy1)):
            x, y = xy1[k, 0], xy1[k, 1]
            w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
            u = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w - xy2[k, 0]
            v = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w - xy2[k, 1]
            counts[s] += 1 if u * u + v * v < tolerance * tolerance else 0
    return counts


def find_dominant_plane(
    f: F64, points: F64, inliers: B8, *, sigma: float, rng: Generator
) -> tuple[F64, F64] | None:
    """Plane h (9,) of F with most of its inliers, and squared distances (N,) in sigma^2; None without one."""
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
    # The plane of three noisy matches is inaccurate elsewhere: the gate starts wide.
    refine_plane(h, some, 2.0 * GATE * sigma, SUBSET_STEPS)
    refine_plane(h, mine, GATE * sigma, ALL_STEPS)
    squared = np.asarray(_plane_distances(h, points)) / sigma**2
    return (h, squared) if (squared < GATE**2).any() else None


def plane_covariance(h: F64, points: F64, sigma: float) -> F64:
    """Covariance (9, 9) of a homography fitted to points on its plane."""
    G = np.empty((9, 9))
    _plane_normal_equations(h, points, 1e6 * sigma, G)
    values, vectors = np.linalg.eigh(G)
    # The smallest eigenvalue belongs to the scale of H, on which no distance depends.
    half = vectors[:, 1:] / np.sqrt(np.maximum(values[1:], 1e-14 * values[-1]))
    return np.asarray(sigma**2 * half @ half.T)


@kernel
def _parallax_lines(h: F64, points: F64) -> F64:
    """Lines (N, 3) x2 x H x1 in image 2 through a match and its position on the plane."""
    lines = empty((len(points), 3))
    for k in range(len(points)):
        x1, y1, x2, y2 = points[k, 0], points[k, 1], points[k, 2], points[k, 3]
        p0 = h[0] * x1 + h[1] * y1 + h[2]
        p1 = h[3] * x1 + h[4] * y1 + h[5]
        p2 = h[6] * x1 + h[7] * y1 + h[8]
        lines[k, 0], lines[k, 1], lines[k, 2] = y2 * p2 - p1, p0 - x2 * p2, x2 * p1 - y2 * p0
    return lines


@kernel
def _fundamental_of_plane(h: F64, e2: F64, f: F64) -> None:
    """Compute f = [e2]x H, unit norm."""
    for j in range(3):
        f[j] = e2[1] * h[6 + j] - e2[2] * h[3 + j]
        f[3 + j] = e2[2] * h[j] - e2[0] * h[6 + j]
        f[6 + j] = e2[0] * h[3 + j] - e2[1] * h[j]
    squares = 1e-300
    for i in range(9):
        squares += f[i] * f[i]
    for i in range(9):
        f[i] /= np.sqrt(squares)


@kernel(fastmath={"reassoc", "contract"}, forceinline=True)
def _inlier_mask(f: F64, columns: F64, gate: float, agree: F64) -> None:
    """Set ``agree`` (N,) to 1 for columns of (4, N) with a Sampson distance below the gate, else 0."""
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


@kernel
def _fundamentals_of_plane(h: F64, points: F64, columns: F64, pairs: I64, gate: float) -> tuple[F64, F64]:
    """F (S, 9) and inliers (S, N) of :func:`fundamentals_of_plane`; ``columns`` (4, N) are ``points`` too."""
    lines = _parallax_lines(h, points)
    F, agree, e2 = empty((len(pairs), 9)), empty((len(pairs), len(points))), empty(3)
    for s in range(len(pairs)):
        a, b = lines[pairs[s, 0]], lines[pairs[s, 1]]
        e2[0], e2[1], e2[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        _fundamental_of_plane(h, e2, F[s])
        _inlier_mask(F[s], columns, gate, agree[s])
    return F, agree


def fundamentals_of_plane(h: F64, points: F64, weights: F64, pairs: I64, gate: float) -> tuple[F64, F64, F64]:
    """[e2]x H of pairs off the plane: F (S, 9), inliers (S, N) as 0 or 1, sums (S, M) of their weights."""
    F, agree = _fundamentals_of_plane(h, points, np.ascontiguousarray(points.T), pairs, gate)
    return F, agree, agree @ weights.T


_SAMPLE, _PARAMETERS = 4, 8
_BATCH, _MAX_BATCHES, _SCORED = 128, 16, 1000
# Rounds to find the inliers.
_ROUNDS = 8
# Residuals in units of the frame below which they are rounding errors.
_EXACT = 1e-9
# Ratio of singular values of the equations below which they are dependent.
_DEPENDENT = 1e-9


@dataclass(frozen=True)
class HomographyFit:
    """A homography with its inliers and noise.

    Parameters
    ----------
    H, covariance : ndarray (3, 3), ndarray (9, 9)
        x2 ~ H x1, unit norm, and the covariance of its entries (row-major), rank 8.
    inliers, sigma_px : ndarray (N,) of bool, float
        Inliers, and the standard deviation of one image coordinate; for 4 matches it and the covariance are
        NaN.
    """

    H: F64
    inliers: B8
    sigma_px: float
    covariance: F64


def fit_homography(xy1: F64, xy2: F64, threshold_px: float | None, rng: Generator) -> HomographyFit:
    """Fit a homography; arguments as for :func:`thesisrecon.estimate_homography`."""
    if len(xy1) < _SAMPLE or min(np.ptp(xy1, axis=0).max(), np.ptp(xy2, axis=0).max()) == 0.0:
        raise _undetermined(f"{counted(len(xy1), 'match')}, at least 4 different ones are needed")
    frame = PairFrame.of(xy1, xy2)
    points, inliers = frame.points(xy1, xy2), np.ones(len(xy1), dtype=bool)
    if threshold_px is None:
        H, inverse = _refine(homography_linear(points[:, :2], points[:, 2:]), points)
    else:
        gate = threshold_px * frame.scale
        H = _search(points, gate, rng)
        for k in range(_ROUNDS):
            before = inliers
            r = homography_sampson_residuals(H, points[:, :2], points[:, 2:])
            distance = np.linalg.norm(r, axis=1)
            if k == 0:
                limit = max(noise_width(np.abs(r[:, 0]), gate, parameters=_PARAMETERS), gate)
            else:
                limit = next_inlier_limit(distance, inliers, limit, unknowns=_PARAMETERS)
            inliers = distance <= max(limit, _EXACT)
            if inliers.sum() < _SAMPLE:
                raise _undetermined(f"{inliers.sum()} of {len(points)} are within {threshold_px:g} px")
            if k > 0 and np.array_equal(inliers, before):
                break
            H, inverse = _refine(H, points[inliers])
    r = homography_sampson_residuals(H, points[inliers, :2], points[inliers, 2:])
    left = (r.size - _PARAMETERS) * (1.0 if threshold_px is None else VARIANCE_OF_INLIERS)
    sigma = float(np.sqrt(np.sum(r**2) / left)) if left else float("nan")
    h = frame.homography_to_pixels @ H.ravel()
    norm = np.linalg.norm(h)
    J = (np.eye(9) - np.outer(h, h) / norm**2) @ frame.homography_to_pixels / norm
    covariance = sigma**2 * J @ inverse @ J.T
    return HomographyFit(unit_norm(h.reshape(3, 3)), inliers, sigma / frame.scale, covariance)


def _undetermined(evidence: str) -> StageFailure:
    return StageFailure(
        "the matches do not determine a homography",
        evidence,
        "use four or more matches of one plane, or of a rotating camera, no three of them on one line",
    )


def _through_four(samples: F64) -> F64:
    """Homographies (B, 3, 3) of samples of four matches (B, 4, 4) in the frame."""
    one = np.ones((*samples.shape[:2], 1))
    x1, u, v = np.concatenate([samples[..., :2], one], axis=2), samples[..., 2:3], samples[..., 3:]
    zero = np.zeros_like(x1)
    rows = [np.concatenate([x1, zero, -u * x1], axis=2), np.concatenate([zero, x1, -v * x1], axis=2)]
    return np.asarray(np.linalg.svd(np.concatenate(rows, axis=1))[2][:, -1].reshape(-1, 3, 3))


def _search(points: F64, gate: float, rng: Generator) -> F64:
    """The homography of the samples with the least truncated squared distances in image 2."""
    n = len(points)
    scored = points[rng.choice(n, _SCORED, replace=False)] if n > _SCORED else points
    best, least, drawn = np.eye(3), np.inf, 0
    for _ in range(_MAX_BATCHES):
        samples = rng.random((_BATCH, n)).argpartition(_SAMPLE - 1, axis=1)[:, :_SAMPLE]
        H = _through_four(points[samples])
        squared = np.stack([homography_residuals(h, scored[:, :2], scored[:, 2:]) for h in H]) ** 2
        cost = np.minimum(squared / (2.0 * gate**2), 1.0).sum(axis=1)
        drawn += _BATCH
        if cost.min() < least:
            least, best = float(cost.min()), H[cost.argmin()]
        share = 1.0 - least / len(scored)
        if drawn * np.log1p(-min(share**_SAMPLE, 1.0 - 1e-9)) < np.log(1e-4):
            break
    return best


def _refine(H: F64, points: F64) -> tuple[F64, F64]:
    """H of least Sampson distances of matches (n, 4), and the inverse (9, 9) of its information."""
    start = H.ravel() / np.linalg.norm(H)
    tangent = np.linalg.svd(start[None])[2][1:]

    def residuals(x: F64) -> F64:
        moved = (start + x @ tangent).reshape(3, 3)
        return homography_sampson_residuals(moved, points[:, :2], points[:, 2:]).ravel()

    # Steps that send points to infinity are rejected.
    with np.errstate(all="ignore"):
        found = minimize_residuals(residuals, np.zeros(_PARAMETERS))
        steps = 1e-6 * np.eye(_PARAMETERS)
        J = np.stack([residuals(found.x + e) - residuals(found.x - e) for e in steps], axis=1) / 2e-6
    end = start + found.x @ tangent
    s, Vt = np.linalg.svd(np.nan_to_num(J), full_matrices=False)[1:]
    if not s[-1] > _DEPENDENT * s[0]:
        raise _undetermined(f"the equations of {counted(len(points), 'match')} have rank below 8")
    half = tangent.T @ (Vt.T / s)
    return end.reshape(3, 3), half @ half.T
