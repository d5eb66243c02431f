"""Scoring of F and the seven-point search of :mod:`thesisrecon.epipolar.locally_optimised`.

Points are rows (x1, y1, x2, y2) in a common frame that scales both images alike, so Sampson distances are
pixels times that scale. F is a row-major vector of 9.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.arrays import F64
from thesisrecon.epipolar.linear import LANES, ROWS, seven_point_batch_solutions, solve_seven_point_batch
from thesisrecon.epipolar.refinement import SAMPSON, refine
from thesisrecon.numerics.ransac import draw_sample, required_samples

SUBSET = 300
STRIDE = 16
LOG_REJECTION_RATIO = np.log(1e3)
"""The sequential test calls at most one right matrix in a thousand wrong."""
LARGEST = 1 << 40


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _squared_sampson(f: F64, x1: float, y1: float, x2: float, y2: float) -> float:
    """Squared Sampson distance, the summand of (5.4)."""
    a0 = f[0] * x1 + f[1] * y1 + f[2]
    a1 = f[3] * x1 + f[4] * y1 + f[5]
    b0 = f[0] * x2 + f[3] * y2 + f[6]
    b1 = f[1] * x2 + f[4] * y2 + f[7]
    e = a0 * x2 + a1 * y2 + f[6] * x1 + f[7] * y1 + f[8]
    squared: float = e * e / (a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1 + 1e-300)
    return squared


@njit(cache=True, nogil=True, error_model="numpy")
def sampson_distances(f: F64, points: F64) -> F64:
    """Compute the Sampson distances of all points.

    Parameters
    ----------
    f : ndarray (9,)
        F in the frame.
    points : ndarray (N, 4)
        Matches.

    Returns
    -------
    ndarray (N,)
        Distances >= 0 in units of the frame.
    """
    r = np.empty(len(points))
    for k in range(len(points)):
        r[k] = np.sqrt(_squared_sampson(f, points[k, 0], points[k, 1], points[k, 2], points[k, 3]))
    return r


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def _block_score(f: F64, columns: F64, start: int, end: int, gate: float) -> tuple[float, float]:
    """Sum of min(r^2 / gate^2, 1) over columns ``start`` to ``end`` of (4, N), and the number with r < gate.

    No branches and contiguous rows, so that the loop vectorises.
    """
    total, inside, wide = 0.0, 0.0, gate * gate
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
    for k in range(start, end):
        x1, y1, x2, y2 = columns[0, k], columns[1, k], columns[2, k], columns[3, k]
        a0 = f0 * x1 + f1 * y1 + f2
        a1 = f3 * x1 + f4 * y1 + f5
        b0 = f0 * x2 + f3 * y2 + f6
        b1 = f1 * x2 + f4 * y2 + f7
        e = a0 * x2 + a1 * y2 + f6 * x1 + f7 * y1 + f8
        r2 = e * e / (wide * (a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1) + 1e-300)
        total += r2 if r2 < 1.0 else 1.0
        inside += 1.0 if r2 < 1.0 else 0.0
    return total, inside


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def truncated_score(
    f: F64, columns: F64, gate: float, give_up: float, evidence: tuple[float, float]
) -> tuple[float, int, int]:
    """Compute the truncated quadratic score of F, stopping early for a bad F.

    The evaluation stops with score 1 if the sum exceeds ``give_up`` times the number of points, if the
    running mean is three standard errors above it, or by Wald's sequential test. The points must be in random
    order.

    Parameters
    ----------
    f : ndarray (9,)
        F in the frame.
    columns : ndarray (4, N)
        Matches as columns.
    gate : float
        Distance at which the score is truncated.
    give_up : float
        Score to beat.
    evidence : tuple of float
        Log likelihood ratios "wrong" to "right" of a point inside and outside the gate.

    Returns
    -------
    score : float
        Mean of min(r^2 / gate^2, 1).
    inliers : int
        Number of points with r < gate.
    seen : int
        Number of points evaluated.

    References
    ----------
    J. Matas and O. Chum, "Randomized RANSAC with sequential probability ratio test", ICCV 2005.
    """
    n = columns.shape[1]
    total, inliers = 0.0, 0.0
    spread = 3.0 * np.sqrt(give_up * max(1.0 - give_up, 0.01))
    for start in range(0, n, STRIDE):
        end = min(start + STRIDE, n)
        part, inside = _block_score(f, columns, start, end, gate)
        total += part
        inliers += inside
        doubt = inliers * evidence[0] + (end - inliers) * evidence[1]
        if total > min(give_up * n, give_up * end + spread * np.sqrt(end)) or doubt > LOG_REJECTION_RATIO:
            return 1.0, int(inliers), end
    return total / n, int(inliers), n


@njit(cache=True, nogil=True)
def _log_likelihood_ratios(right: float, wrong: float) -> tuple[float, float]:
    """Log likelihood ratios wrong : right of a point inside and outside the gate.

    ``right`` and ``wrong`` are the fractions of points inside the gate of a right and of a wrong F. Zeros
    (never stop early) if the two are too close.
    """
    right = min(right, 0.99)
    if not right > 1.5 * wrong:
        return 0.0, 0.0
    return np.log(wrong / right), np.log((1.0 - wrong) / (1.0 - right))


@njit(cache=True, nogil=True)
def _draw_batch(points: F64, uniforms: F64, X: F64) -> None:
    """Write the samples of the rows of ``uniforms`` (B <= LANES, 7) as columns of ``X`` (28, LANES)."""
    sample = np.empty(7, np.int64)
    for lane in range(len(uniforms)):
        draw_sample(uniforms[lane], len(points), sample)
        for m in range(7):
            for c in range(4):
                X[4 * m + c, lane] = points[sample[m], c]


@njit(cache=True, nogil=True, forceinline=True)
def _refine_best(points: F64, columns: F64, gate: float, state: F64, F: F64) -> None:
    """Refine the best F on at most 300 points with twice the gate and keep the better of the two.

    A minimal sample spreads its noise over the image. ``state`` and ``F`` as in :func:`search_fundamental`.
    """
    f = F.copy()
    refine(f, points[:SUBSET], SAMPSON, 2.0 * gate, gate, 4)
    score, inliers, _ = truncated_score(f, columns, gate, state[0], (0.0, 0.0))
    if score < state[0]:
        state[0], state[1] = score, inliers / len(points)
        F[:] = f


@njit(cache=True, nogil=True)
def search_fundamental(
    points: F64, uniforms: F64, gate: float, stop: tuple[int, int, float], state: F64, F: F64
) -> int:
    """Draw and score one seven-point sample per row of ``uniforms`` until enough samples were drawn.

    Each new best F of a batch is refined before it sets the number of samples still required.

    Parameters
    ----------
    points : ndarray (N, 4)
        Matches in random order.
    uniforms : ndarray (B, 7)
        Uniform random numbers in [0, 1).
    gate : float
        Distance at which the score is truncated.
    stop : tuple
        Samples drawn before, minimum number to draw, probability of a sample without outliers.
    state : ndarray (4,)
        In and out: best score, its inlier ratio, points seen and points inside the gate of rejected models.
    F : ndarray (9,)
        In and out: best F.

    Returns
    -------
    int
        Number of samples drawn in total.
    """
    columns = np.ascontiguousarray(points.T)
    done, least, confidence = stop
    X, Y = np.ones((28, LANES)), np.empty((ROWS, LANES))
    solutions, work = np.empty((3, 9)), np.empty(9)
    for start in range(0, len(uniforms), LANES):
        if done >= least and done >= required_samples(state[1], 7, confidence, LARGEST):
            break
        batch = uniforms[start : start + LANES]
        done += len(batch)
        _draw_batch(points, batch, X)
        solve_seven_point_batch(X, Y)
        evidence = _log_likelihood_ratios(state[1], state[3] / state[2])
        before = state[0]
        for lane in range(len(batch)):
            for k in range(seven_point_batch_solutions(Y, lane, work, solutions)):
                score, inliers, seen = truncated_score(solutions[k], columns, gate, state[0], evidence)
                if score < state[0]:
                    state[0], state[1] = score, inliers / len(points)
                    F[:] = solutions[k]
                else:
                    state[2] += seen
                    state[3] += inliers
        if state[0] < before:
            _refine_best(points, columns, gate, state, F)
    return done
