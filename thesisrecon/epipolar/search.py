"""Compiled loops of chapter 5: minimal solver, orientation, score and the search that joins them.

Points are rows (x1, y1, x2, y2) in one frame in which both images are scaled alike, so that Sampson distances
are pixels times that scale. F is a flat row-major vector of 9.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.arrays import F64, I64
from thesisrecon.epipolar.refinement import SAMPSON, refine
from thesisrecon.epipolar.seven_point import LANES, ROWS, lane_solutions, solve_batch
from thesisrecon.numerics.noise import draw_sample, required_samples

DIAGONAL = np.sqrt(0.5)
SUBSET = 300
STRIDE = 16
DOUBT = np.log(1e3)
"""The sequential test calls at most one right matrix in a thousand wrong."""
LARGEST = 1 << 40


@njit(
    cache=True,
    nogil=True,
    inline="always",
    error_model="numpy",
    fastmath={"reassoc", "contract"},
    forceinline=True,
)
def reflect(v: F64, start: int, scale: float, x: F64) -> None:
    """x <- (I - scale v v') x, v zero before ``start``."""
    dot = 0.0
    for r in range(start, 9):
        dot += v[r] * x[r]
    dot *= scale
    for r in range(start, 9):
        x[r] -= dot * v[r]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def null_pencil(points: F64, sample: I64, pencil: F64) -> bool:
    """Two orthonormal vectors (``pencil`` (2, 9)) that span the null space of the seven equations (5.1).

    Householder QR of A' (9, 7): the last two columns of Q. False where the equations are dependent.
    """
    A = np.empty((7, 9))
    for k in range(7):
        x1, y1, x2, y2 = points[sample[k]]
        A[k, 0], A[k, 1], A[k, 2] = x2 * x1, x2 * y1, x2
        A[k, 3], A[k, 4], A[k, 5] = y2 * x1, y2 * y1, y2
        A[k, 6], A[k, 7], A[k, 8] = x1, y1, 1.0
    pencil[:] = 0.0
    pencil[0, 7] = pencil[1, 8] = 1.0
    scales = np.empty(7)
    for k in range(7):
        norm = 0.0
        for r in range(k, 9):
            norm += A[k, r] * A[k, r]
        norm = np.sqrt(norm)
        if norm < 1e-9:
            return False
        A[k, k] += norm if A[k, k] >= 0.0 else -norm
        scales[k] = 1.0 / (norm * abs(A[k, k]))
        for c in range(k + 1, 7):
            reflect(A[k], k, scales[k], A[c])
    for k in range(6, -1, -1):
        reflect(A[k], k, scales[k], pencil[0])
        reflect(A[k], k, scales[k], pencil[1])
    return True


@njit(cache=True, nogil=True)
def det3(f: F64) -> float:
    """Determinant of a 3x3 matrix given as a vector of 9."""
    value: float = (
        f[0] * (f[4] * f[8] - f[5] * f[7])
        - f[1] * (f[3] * f[8] - f[5] * f[6])
        + f[2] * (f[3] * f[7] - f[4] * f[6])
    )
    return value


@njit(cache=True, nogil=True)
def mixed_det3(f: F64, g: F64) -> float:
    """trace(adj(f) g): the coefficient of a in det(f + a g)."""
    value: float = (
        (f[4] * f[8] - f[5] * f[7]) * g[0]
        + (f[5] * f[6] - f[3] * f[8]) * g[1]
        + (f[3] * f[7] - f[4] * f[6]) * g[2]
        + (f[2] * f[7] - f[1] * f[8]) * g[3]
        + (f[0] * f[8] - f[2] * f[6]) * g[4]
        + (f[1] * f[6] - f[0] * f[7]) * g[5]
        + (f[1] * f[5] - f[2] * f[4]) * g[6]
        + (f[2] * f[3] - f[0] * f[5]) * g[7]
        + (f[0] * f[4] - f[1] * f[3]) * g[8]
    )
    return value


@njit(cache=True, nogil=True)
def monic_cubic_roots(a: float, b: float, c: float, roots: F64) -> int:
    """Real roots of x^3 + a x^2 + b x + c, a double root once; polished by Newton."""
    Q = (a * a - 3.0 * b) / 9.0
    R = (2.0 * a * a * a - 9.0 * a * b + 27.0 * c) / 54.0
    gap = R * R - Q * Q * Q
    # What the rounding of a, b and c leaves of R^2 - Q^3: within it a double root is a double root.
    small = 1e-12 * (R * R + abs(Q * Q * Q))
    small += 4e-15 * (Q * Q * (a * a + abs(b)) + abs(R) * (abs(a * a * a) + abs(a * b) + abs(c)))
    count = 1
    if gap < -small:
        theta = np.arccos(min(1.0, max(-1.0, R / np.sqrt(Q * Q * Q))))
        for k in range(3):
            roots[k] = -2.0 * np.sqrt(Q) * np.cos((theta + 2.0 * np.pi * (k - 1)) / 3.0) - a / 3.0
        count = 3
    else:
        A = -np.sign(R) * np.cbrt(abs(R) + np.sqrt(max(gap, 0.0)))
        B = Q / A if A != 0.0 else 0.0
        roots[0] = A + B - a / 3.0
        if gap <= small and A != 0.0:
            roots[1] = -0.5 * (A + B) - a / 3.0
            count = 2
    for k in range(count):
        for _ in range(2):
            x = roots[k]
            slope = (3.0 * x + 2.0 * a) * x + b
            value = ((x + a) * x + b) * x + c
            if abs(slope) > 1e-8 * (1.0 + x * x):
                roots[k] = x - value / slope
    return count


@njit(cache=True, nogil=True)
def singular_members(pencil: F64, F: F64) -> int:
    """Members of the pencil with determinant 0, unit norm, into ``F`` (3, 9); how many (0 to 3).

    det is a homogeneous cubic of the pencil's coordinates. It cannot vanish in four directions unless it
    vanishes everywhere, so the direction of the largest |det| of four is made the first basis vector: the
    leading coefficient is then never small and no solution is lost at infinity, as (5.2)'s affine combination
    loses one.
    """
    best, c, s = -1.0, 1.0, 0.0
    trial = np.empty(9)
    for k in range(4):
        ck = (1.0, 0.0, DIAGONAL, DIAGONAL)[k]
        sk = (0.0, 1.0, DIAGONAL, -DIAGONAL)[k]
        for m in range(9):
            trial[m] = ck * pencil[0, m] + sk * pencil[1, m]
        size = abs(det3(trial))
        if size > best:
            best, c, s = size, ck, sk
    if best < 1e-14:
        return 0
    first = c * pencil[0] + s * pencil[1]
    second = c * pencil[1] - s * pencil[0]
    lead = det3(first)
    roots = np.empty(3)
    count = monic_cubic_roots(
        mixed_det3(first, second) / lead, mixed_det3(second, first) / lead, det3(second) / lead, roots
    )
    for k in range(count):
        norm = np.sqrt(1.0 + roots[k] * roots[k])
        for m in range(9):
            F[k, m] = (roots[k] * first[m] + second[m]) / norm
    return count


@njit(cache=True, nogil=True)
def seven_point(points: F64, sample: I64, F: F64) -> int:
    """Fundamental matrices (``F`` (3, 9)) through seven matches; how many (0 where they are degenerate)."""
    pencil = np.empty((2, 9))
    if not null_pencil(points, sample, pencil):
        return 0
    return singular_members(pencil, F)


@njit(cache=True, nogil=True)
def oriented(f: F64, points: F64, sample: I64) -> bool:
    """Whether the sample can be in front of both cameras: e2 x x2 and F x1 agree in sign for all or none.

    The oriented epipolar constraint (Chum, Werner and Matas, ICPR 2004).
    """
    e0, e1, e2, largest = 0.0, 0.0, 0.0, 0.0
    for a, b in ((0, 1), (0, 2), (1, 2)):
        x = f[3 + a] * f[6 + b] - f[6 + a] * f[3 + b]
        y = f[6 + a] * f[b] - f[a] * f[6 + b]
        z = f[a] * f[3 + b] - f[3 + a] * f[b]
        size = x * x + y * y + z * z
        if size > largest:
            largest = size
            e0, e1, e2 = x, y, z
    side = 0.0
    for k in range(len(sample)):
        x1, y1, x2, y2 = points[sample[k]]
        l0 = f[0] * x1 + f[1] * y1 + f[2]
        l1 = f[3] * x1 + f[4] * y1 + f[5]
        l2 = f[6] * x1 + f[7] * y1 + f[8]
        dot = l0 * (e1 - e2 * y2) + l1 * (e2 * x2 - e0) + l2 * (e0 * y2 - e1 * x2)
        if dot * side < 0.0:
            return False
        if dot != 0.0:
            side = dot
    return True


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def squared_sampson(f: F64, x1: float, y1: float, x2: float, y2: float) -> float:
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
    """Sampson distances (N,) >= 0 of all points, in their units."""
    r = np.empty(len(points))
    for k in range(len(points)):
        r[k] = np.sqrt(squared_sampson(f, points[k, 0], points[k, 1], points[k, 2], points[k, 3]))
    return r


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def block_score(f: F64, columns: F64, start: int, end: int, gate: float) -> tuple[float, float]:
    """Sum of min(r^2 / gate^2, 1) over columns ``start`` to ``end`` of (4, N), and how many have r < gate.

    Without branches and over contiguous rows, so that the compiler makes vector instructions of it.
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
    """Mean of min(r^2 / gate^2, 1) over all columns (4, N), how many have r < gate, and how many were seen.

    Given up (score 1) as soon as the sum passes ``give_up`` times the number of points, since it cannot win,
    as the running mean is three standard errors above it, or as Wald's sequential test says so (Matas and
    Chum, ICCV 2005): ``evidence`` are the logarithms of the ratio of the likelihoods of "wrong" and "right"
    for a point within the gate and for one beyond. The order of the points must be random.
    """
    n = columns.shape[1]
    total, inliers = 0.0, 0.0
    spread = 3.0 * np.sqrt(give_up * max(1.0 - give_up, 0.01))
    for start in range(0, n, STRIDE):
        end = min(start + STRIDE, n)
        part, inside = block_score(f, columns, start, end, gate)
        total += part
        inliers += inside
        doubt = inliers * evidence[0] + (end - inliers) * evidence[1]
        if total > min(give_up * n, give_up * end + spread * np.sqrt(end)) or doubt > DOUBT:
            return 1.0, int(inliers), end
    return total / n, int(inliers), n


@njit(cache=True, nogil=True)
def log_ratios(right: float, wrong: float) -> tuple[float, float]:
    """Logarithms of the likelihood ratios wrong : right for a point inside and outside the gate.

    ``right`` and ``wrong`` are the shares of points within the gate of a right and of a wrong matrix. Zeros
    (never give up) where the two are too near to be told apart.
    """
    right = min(right, 0.99)
    if not right > 1.5 * wrong:
        return 0.0, 0.0
    return np.log(wrong / right), np.log((1.0 - wrong) / (1.0 - right))


@njit(cache=True, nogil=True)
def draw_batch(points: F64, uniforms: F64, X: F64) -> None:
    """Samples of the rows of ``uniforms`` (B <= LANES, 7) as columns of ``X`` (28, LANES)."""
    sample = np.empty(7, np.int64)
    for lane in range(len(uniforms)):
        draw_sample(uniforms[lane], len(points), sample)
        for m in range(7):
            for c in range(4):
                X[4 * m + c, lane] = points[sample[m], c]


@njit(cache=True, nogil=True, forceinline=True)
def improve(points: F64, columns: F64, gate: float, state: F64, F: F64) -> None:
    """Refine the best matrix a little (on at most 300 points, with a gate twice as wide) and keep the better.

    A minimal sample spreads its noise over the image. ``state`` and ``F`` as in :func:`search`.
    """
    f = F.copy()
    refine(f, points[:SUBSET], SAMPSON, 2.0 * gate, gate, 4)
    score, inliers, _ = truncated_score(f, columns, gate, state[0], (0.0, 0.0))
    if score < state[0]:
        state[0], state[1] = score, inliers / len(points)
        F[:] = f


@njit(cache=True, nogil=True)
def search(points: F64, uniforms: F64, gate: float, stop: tuple[int, int, float], state: F64, F: F64) -> int:
    """Draw one sample per row of ``uniforms`` (B, 7) until enough were drawn; number of samples drawn in all.

    ``stop`` are the samples drawn before, the least number to draw and the probability of one free of
    outliers that is enough. ``state`` (4,) holds the best score, its share of inliers, and of all matrices
    given up the points seen and those of them within the gate; ``F`` (9,) is the best matrix: both are read
    and updated. A new best of a batch is improved before it sets the number of samples still needed.
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
        draw_batch(points, batch, X)
        solve_batch(X, Y)
        evidence = log_ratios(state[1], state[3] / state[2])
        before = state[0]
        for lane in range(len(batch)):
            for k in range(lane_solutions(Y, lane, work, solutions)):
                score, inliers, seen = truncated_score(solutions[k], columns, gate, state[0], evidence)
                if score < state[0]:
                    state[0], state[1] = score, inliers / len(points)
                    F[:] = solutions[k]
                else:
                    state[2] += seen
                    state[3] += inliers
        if state[0] < before:
            improve(points, columns, gate, state, F)
    return done
