"""Section 5.3: criteria of F (gold standard, Sampson, ...), minimised over rank 2; covariance of F (HZ 5.2).

The criteria are the Sampson distance (5.4), which the thesis calls the gradient criterion, the distances to
the epipolar lines (5.6) and the reprojection error (HZ, algorithm 11.3). F = U diag(cos phi, sin phi, 0) V'
is the orthonormal representation of Bartoli and Sturm (IJCV 2004). Points are rows (x1, y1, x2, y2) in a
common frame, F is a row-major vector of 9.
"""

from typing import Literal

import numpy as np

from thesisrecon._numba import copy_to, empty, kernel
from thesisrecon.arrays import F64
from thesisrecon.epipolar._matches import PairFrame, check_matches, check_start
from thesisrecon.errors import unknown_word
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.small_matrices import orthogonalize_columns, solve_damped
from thesisrecon.records import FundamentalFit

SAMPSON, EPIPOLAR_DISTANCE, REPROJECTION = 0, 1, 2
# Steps to the nearest exact match; each reduces the error by about (noise / distance to the epipole)^2.
CORRECTIONS = 8
BLOCK = 128
UNBOUNDED = 1e150  # stands for an infinite width of the loss; its square is still finite
# Smallest curvature relative to the largest: the F of a plane stays uncertain but finite.
FLATTEST_REL = 1e-14


@kernel(fastmath={"reassoc", "contract"}, forceinline=True)
def _weighted_derivatives(f: F64, points: F64, criterion: int, gate: float, delta: float, D: F64) -> float:
    """Derivatives of at most BLOCK residuals by F, columns of ``D`` (11, BLOCK); returns the cost."""
    # Row 9 is the signed residual, row 10 the weight rho'(r) / r, 0 beyond the gate. No branches and
    # contiguous rows, so that the loop vectorises.
    X = empty((4, BLOCK))
    for k in range(len(points)):
        for c in range(4):
            X[c, k] = points[k, c]
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = f
    outside = delta * (gate - 0.5 * delta)
    cost = 0.0
    for k in range(len(points)):
        x1, y1, x2, y2 = X[0, k], X[1, k], X[2, k], X[3, k]
        a0 = f0 * x1 + f1 * y1 + f2
        a1 = f3 * x1 + f4 * y1 + f5
        b0 = f0 * x2 + f3 * y2 + f6
        b1 = f1 * x2 + f4 * y2 + f7
        e = a0 * x2 + a1 * y2 + f6 * x1 + f7 * y1 + f8
        g1 = a0 * a0 + a1 * a1 + 1e-60
        g2 = b0 * b0 + b1 * b1 + 1e-60
        if criterion == SAMPSON:
            s = 1.0 / np.sqrt(g1 + g2)
            p = q = -e * s * s * s
        else:
            s = np.sqrt(1.0 / g1 + 1.0 / g2)
            p = -e / (s * g1 * g1)
            q = -e / (s * g2 * g2)
        r = abs(e * s)
        inside = r < gate
        bend = delta / max(r, delta)
        w = bend if inside else 0.0
        cost += bend * r * (r - 0.5 * bend * r) if inside else outside
        # dr = s de + p (a0 da0 + a1 da1) + q (b0 db0 + b1 db1)
        u0, u1, v0, v1 = p * a0, p * a1, q * b0, q * b1
        s2, t2 = s * x2 + u0, s * y2 + u1
        D[0, k] = s2 * x1 + v0 * x2
        D[1, k] = s2 * y1 + v1 * x2
        D[2, k] = s2
        D[3, k] = t2 * x1 + v0 * y2
        D[4, k] = t2 * y1 + v1 * y2
        D[5, k] = t2
        D[6, k] = s * x1 + v0
        D[7, k] = s * y1 + v1
        D[8, k] = s
        D[9, k] = e * s
        D[10, k] = w
    return cost


@kernel(fastmath={"reassoc", "contract"}, forceinline=True)
def _reprojection_derivatives(f: F64, points: F64, gate: float, delta: float, D: F64) -> float:
    """As :func:`_weighted_derivatives` for the distances r to the nearest exact match."""
    # The nearest match p comes from the iteration of Kanatani, Sugaya and Niitsuma (BMVC 2008). Since r is
    # minimal there, dr = d(p2' F p1) / |gradient at p| without the motion of p.
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = f
    outside = delta * (gate - 0.5 * delta)
    cost = 0.0
    for k in range(len(points)):
        x1, y1, x2, y2 = points[k, 0], points[k, 1], points[k, 2], points[k, 3]
        p1, q1, p2, q2 = x1, y1, x2, y2
        r, size = 0.0, 1.0
        for _ in range(CORRECTIONS):
            a0 = f0 * p1 + f1 * q1 + f2
            a1 = f3 * p1 + f4 * q1 + f5
            b0 = f0 * p2 + f3 * q2 + f6
            b1 = f1 * p2 + f4 * q2 + f7
            e = a0 * p2 + a1 * q2 + f6 * p1 + f7 * q1 + f8
            e += b0 * (x1 - p1) + b1 * (y1 - q1) + a0 * (x2 - p2) + a1 * (y2 - q2)
            size = 1.0 / np.sqrt(a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1 + 1e-60)
            r = e * size
            step = r * size
            p1, q1, p2, q2 = x1 - step * b0, y1 - step * b1, x2 - step * a0, y2 - step * a1
        inside = abs(r) < gate
        bend = delta / max(abs(r), delta)
        cost += bend * abs(r) * (abs(r) - 0.5 * bend * abs(r)) if inside else outside
        s2, t2 = size * p2, size * q2
        D[0, k], D[1, k], D[2, k] = s2 * p1, s2 * q1, s2
        D[3, k], D[4, k], D[5, k] = t2 * p1, t2 * q1, t2
        D[6, k], D[7, k], D[8, k] = size * p1, size * q1, size
        D[9, k] = r
        D[10, k] = bend if inside else 0.0
    return cost


@kernel(fastmath={"reassoc", "contract"}, forceinline=True)
def normal_equations(f: F64, points: F64, criterion: int, gate: float, delta: float, G: F64, h: F64) -> float:
    """Matrix ``G`` (9, 9), gradient ``h`` (9,), cost of 1/2 sum rho(r): Huber, constant beyond ``gate``."""
    G[:] = 0.0
    h[:] = 0.0
    cost = 0.0
    D, wd = empty((11, BLOCK)), empty(BLOCK)
    for start in range(0, len(points), BLOCK):
        m = min(BLOCK, len(points) - start)
        block = points[start : start + m]
        if criterion == REPROJECTION:
            cost += _reprojection_derivatives(f, block, gate, delta, D)
        else:
            cost += _weighted_derivatives(f, block, criterion, gate, delta, D)
        for i in range(9):
            for k in range(m):
                wd[k] = D[10, k] * D[i, k]
            for j in range(i, 9):
                total = 0.0
                for k in range(m):
                    total += wd[k] * D[j, k]
                G[i, j] += total
            total = 0.0
            for k in range(m):
                total += wd[k] * D[9, k]
            h[i] += total
    for i in range(9):
        for j in range(i):
            G[i, j] = G[j, i]
    return cost


@kernel
def fundamental_from_orthonormal(U: F64, V: F64, phi: float, f: F64) -> None:
    """Write F = U diag(cos phi, sin phi, 0) V' to ``f``."""
    c, s = np.cos(phi), np.sin(phi)
    for i in range(3):
        for j in range(3):
            f[3 * i + j] = c * U[i, 0] * V[j, 0] + s * U[i, 1] * V[j, 1]


@kernel
def orthonormal_tangent(U: F64, V: F64, phi: float, B: F64) -> None:
    """Write the derivatives of F by rotations of U (3), of V (3) and by phi to ``B`` (9, 7)."""
    c, s = np.cos(phi), np.sin(phi)
    for i in range(3):
        for j in range(3):
            m = 3 * i + j
            B[m, 0] = s * U[i, 2] * V[j, 1]
            B[m, 1] = -c * U[i, 2] * V[j, 0]
            B[m, 2] = c * U[i, 1] * V[j, 0] - s * U[i, 0] * V[j, 1]
            B[m, 3] = s * U[i, 1] * V[j, 2]
            B[m, 4] = -c * U[i, 0] * V[j, 2]
            B[m, 5] = c * U[i, 0] * V[j, 1] - s * U[i, 1] * V[j, 0]
            B[m, 6] = c * U[i, 1] * V[j, 1] - s * U[i, 0] * V[j, 0]


@kernel
def _rotate_columns(U: F64, a: F64, out: F64) -> None:
    """Compute out = U exp([a]x) by Rodrigues' formula."""
    angle = np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    if angle < 1e-12:
        p, q = 1.0, 0.5
    else:
        p, q = np.sin(angle) / angle, (1.0 - np.cos(angle)) / (angle * angle)
    for i in range(3):
        u0, u1, u2 = U[i]
        # row vector times [a]x is u x a read as a row: u [a]x = (u1 a2 - u2 a1, ...)
        c0, c1, c2 = u1 * a[2] - u2 * a[1], u2 * a[0] - u0 * a[2], u0 * a[1] - u1 * a[0]
        d0, d1, d2 = c1 * a[2] - c2 * a[1], c2 * a[0] - c0 * a[2], c0 * a[1] - c1 * a[0]
        out[i, 0] = u0 + p * c0 + q * d0
        out[i, 1] = u1 + p * c1 + q * d1
        out[i, 2] = u2 + p * c2 + q * d2


@kernel
def orthonormal_from_fundamental(f: F64, U: F64, V: F64) -> float:
    """Write U and V of the nearest matrix of rank 2 and return phi."""
    A, W, lengths = empty((3, 3)), empty((3, 3)), empty(3)
    for i in range(9):
        A[i // 3, i % 3] = f[i]
    orthogonalize_columns(A, W)
    for k in range(3):
        lengths[k] = np.sqrt(A[0, k] * A[0, k] + A[1, k] * A[1, k] + A[2, k] * A[2, k])
    last = 0 if lengths[0] <= min(lengths[1], lengths[2]) else 1 if lengths[1] <= lengths[2] else 2
    first, second = (last + 1) % 3, (last + 2) % 3
    if lengths[first] < lengths[second]:
        first, second = second, first
    for i in range(3):
        V[i, 0], V[i, 1], V[i, 2] = W[i, first], W[i, second], W[i, last]
        U[i, 0], U[i, 1] = A[i, first] / (lengths[first] + 1e-300), A[i, second] / (lengths[second] + 1e-300)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        U[i, 2] = U[j, 0] * U[k, 1] - U[k, 0] * U[j, 1]
    return float(np.arctan2(lengths[second], lengths[first]))


@kernel
def _multiply(A: F64, B: F64, out: F64) -> None:
    """Write A B, A (9, 9), to ``out``."""
    for i in range(out.shape[0]):
        for j in range(B.shape[1]):
            total = 0.0
            for k in range(9):
                total += A[i, k] * B[k, j]
            out[i, j] = total


@kernel
def _project(B: F64, G: F64, h: F64, H: F64, g: F64) -> None:
    """Write H = B' G B (7, 7) and g = B' h (7,)."""
    GB = empty((9, 7))
    _multiply(G, B, GB)
    for a in range(7):
        g[a] = 0.0
        for i in range(9):
            g[a] += B[i, a] * h[i]
        for b in range(a, 7):
            total = 0.0
            for i in range(9):
                total += B[i, a] * GB[i, b]
            H[a, b] = H[b, a] = total


@kernel(forceinline=True)
def refine(
    f: F64, points: F64, criterion: int, gate: float, delta: float, iterations: int, frame: F64 | None
) -> tuple[float, int]:
    """Minimise a criterion in place by Levenberg-Marquardt; returns the cost and number of solves."""
    # With a `frame` (9, 9), f is an essential matrix and stays one; the fundamental matrix is `frame` f.
    U, V, Un, Vn = empty((3, 3)), empty((3, 3)), empty((3, 3)), empty((3, 3))
    G, h, Gn, hn = empty((9, 9)), empty(9), empty((9, 9)), empty(9)
    B, step, trial, F, of_E = empty((9, 7)), empty(7), empty(9), empty(9), empty((9, 7))
    H, g = empty((7, 7)), empty(7)
    phi = phi_n = orthonormal_from_fundamental(f, Un, Vn)
    if frame is not None:
        phi = phi_n = 0.25 * np.pi
    exact = 1e-26 * len(points)
    cost, damping, steps = np.inf, 1e-2, 0
    # The start is the first trial: one call of the normal equations takes half as long to compile.
    while True:
        fundamental_from_orthonormal(Un, Vn, phi_n, trial)
        model = trial
        if frame is not None:
            _multiply(frame, trial.reshape((9, 1)), F.reshape((9, 1)))
            model = F
        new_cost = normal_equations(model, points, criterion, gate, delta, Gn, hn)
        if steps == 0 or new_cost < cost:
            gain = cost - new_cost
            U, Un, V, Vn, phi = Un, U, Vn, V, phi_n
            G, Gn, h, hn, cost = Gn, G, hn, h, new_cost
            copy_to(f, trial)
            # Relative to the cost of one match: the standard deviation of f falls with the number of matches.
            if gain <= 1e-3 * cost / max(len(points), 1000):
                break
            damping = max(1e-9, 0.1 * damping)
            orthonormal_tangent(U, V, phi, B)
            if frame is not None:
                _multiply(frame, B, of_E)
                B, of_E = of_E, B
                # E has equal singular values, and no effect of a turn of U and V about their last columns.
                for i in range(9):
                    B[i, 5] = B[i, 6] = 0.0
            _project(B, G, h, H, g)
        else:
            damping *= 10.0
        solved = False
        while not solved and steps < iterations and cost > exact and damping <= 1e8:
            steps += 1
            solved = solve_damped(H, g, damping, step)
            damping *= 1.0 if solved else 10.0
        if not solved:
            break
        _rotate_columns(U, step[0:3], Un)
        _rotate_columns(V, step[3:6], Vn)
        phi_n = phi + step[6]
    return cost, steps


def fundamental_covariance(frame: PairFrame, f: F64, points: F64, sigma: float) -> F64:
    """Covariance (9, 9) of vec(F), px, unit norm: sigma^2 B (J'J)^-1 B' to first order (HZ 5.2)."""
    # J: derivatives of the Sampson distances by seven parameters, B: of vec(F); f, sigma in the frame.
    U, V, B = np.empty((3, 3)), np.empty((3, 3)), np.empty((9, 7))
    G, h = np.empty((9, 9)), np.empty(9)
    phi = orthonormal_from_fundamental(f, U, V)
    orthonormal_tangent(U, V, phi, B)
    normal_equations(f, points, SAMPSON, np.inf, UNBOUNDED, G, h)
    values, vectors = np.linalg.eigh(B.T @ G @ B)
    half = B @ (vectors / np.sqrt(np.maximum(values, FLATTEST_REL * max(values[-1], 1e-300))))
    to_pixels = frame.to_pixels
    pixels = to_pixels @ f
    norm = float(np.linalg.norm(pixels))
    moved = to_pixels @ half / norm
    moved -= np.outer(pixels, pixels @ moved) / norm**2
    covariance: F64 = sigma**2 * moved @ moved.T
    return covariance


RING, MOST = 20.0, 0.95  # End of the ring of wrong matches in inlier limits; largest leverage


def wrong_match_covariance(fit: FundamentalFit, xy1: F64, xy2: F64) -> F64:
    """Covariance (9, 9) of vec(F) that accepted wrong matches add to that of the noise.

    A wrong match within the inlier limit has a depth of its own: it turns F towards itself, the more the
    larger its leverage h, the share of its own residual that it removes. The rejected matches in a ring
    around the limit give the expected number m of accepted wrong ones. They take any leverage: of the k
    matches with at least that of a match, a share of m / (m + k - 1/2) is wrong. The residual of a wrong
    match to an F without it is uniform up to limit / (1 - h).
    """
    x1, x2 = homogenize(xy1), homogenize(xy2)
    gradient = np.sqrt(sum(np.sum(line[:, :2] ** 2, axis=1) for line in (x1 @ fit.F.T, x2 @ fit.F)))
    J = (x2[:, :, None] * x1[:, None, :]).reshape(-1, 9) / np.maximum(gradient, 1e-300)[:, None]
    residual, right = np.abs(J @ fit.F.ravel()), fit.inliers
    limit = float(residual[right].max(initial=0.0))
    accepted = np.count_nonzero(residual[~right] < RING * limit) / (RING - 1.0)
    moved = J[right] @ fit.covariance
    leverage = np.sum(moved * J[right], axis=1)
    # Leverages add up to the number of parameters.
    variance = float(leverage.sum()) / 7.0
    if not (accepted > 0.0 and variance > 0.0):
        return np.zeros((9, 9))
    leverage = np.minimum(leverage / variance, MOST)
    larger = np.searchsorted(np.sort(-leverage), -leverage, "right")
    wrong = accepted / (accepted + larger - 0.5)
    weight = wrong * (limit / (1.0 - leverage)) ** 2 / 3.0
    return np.asarray((moved.T * weight) @ moved / variance**2)


Criterion = Literal["sampson", "epipolar-distance", "reprojection"]
_CRITERIA = {"sampson": SAMPSON, "epipolar-distance": EPIPOLAR_DISTANCE, "reprojection": REPROJECTION}
MAX_ITERATIONS = 50


def refine_fundamental(F: F64, xy1: F64, xy2: F64, criterion: Criterion = "sampson") -> F64:
    """Minimise a criterion of section 5.3 over matrices of rank 2 by Levenberg-Marquardt, from a start F.

    The reprojection error gives the maximum likelihood for Gaussian noise (HZ, algorithm 11.3); the Sampson
    distance is optimal to first order in the noise. The thesis writes a row of F as a combination of the
    others, which reaches the same minimum more slowly.
    """
    if criterion not in _CRITERIA:
        raise ValueError(unknown_word("criterion", criterion, _CRITERIA))
    xy1, xy2 = check_matches(xy1, xy2, needed=7)
    frame = PairFrame.of(xy1, xy2)
    f, points = check_start(F, frame), frame.points(xy1, xy2)
    refine(f, points, _CRITERIA[criterion], np.inf, UNBOUNDED, MAX_ITERATIONS, None)
    return frame.matrix_in_pixels(f)
