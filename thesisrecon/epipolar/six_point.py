"""Kernels of the robust trifocal tensor: six-point solver, reprojection distances and search.

Tracks are rows (x1, y1, x2, y2, x3, y3) in a common frame of the three images, so that distances are pixels
times its scale. Cameras are P (3, 3, 4).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.arrays import F64, I64
from thesisrecon.epipolar.linear import singular_members
from thesisrecon.numerics.ransac import draw_sample

SAMPLE = 6
OFF_DIAGONAL = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
DEPENDENT = 1e-9
STEPS = 2
# Inverse squares of the widths of the score, in thresholds: 1, 2 and 4.
WIDTHS = (1.0, 0.25, 0.0625)


@njit(cache=True, nogil=True)
def _cross(a: F64, b: F64, out: F64) -> float:
    """Compute out = a x b and return its squared length."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    squared: float = out[0] * out[0] + out[1] * out[1] + out[2] * out[2]
    return squared


@njit(cache=True, nogil=True)
def _null_vector(M: F64, out: F64) -> bool:
    """Unit null vector (3,) of a matrix (3, 3) of rank 2: the longest cross product of two rows."""
    best, trial = 0.0, np.empty(3)
    for k in range(3):
        squared = _cross(M[k], M[(k + 1) % 3], trial)
        if squared > best:
            best = squared
            out[:] = trial
    if not (0.0 < best < np.inf):
        return False
    out /= np.sqrt(best)
    return True


@njit(cache=True, nogil=True)
def _basis_matrix(track: F64, sample: I64, view: int, B: F64) -> bool:
    """B (3, 3) that takes e_1, e_2, e_3, (1, 1, 1) to the first four points of a sample; False if none."""
    M, adjugate = np.ones((3, 3)), np.empty((3, 3))
    for k in range(3):
        M[k, 0], M[k, 1] = track[sample[k], 2 * view], track[sample[k], 2 * view + 1]
    for k in range(3):
        _cross(M[(k + 1) % 3], M[(k + 2) % 3], adjugate[k])
    det = M[0, 0] * adjugate[0, 0] + M[0, 1] * adjugate[0, 1] + M[0, 2] * adjugate[0, 2]
    if not abs(det) > DEPENDENT:
        return False
    for k in range(3):
        x, y = track[sample[3], 2 * view], track[sample[3], 2 * view + 1]
        scale = (adjugate[k, 0] * x + adjugate[k, 1] * y + adjugate[k, 2]) / det
        if not abs(scale) > DEPENDENT:
            return False
        for r in range(3):
            B[r, k] = scale * M[k, r]
    return True


@njit(cache=True, nogil=True)
def _in_basis(B: F64, x: float, y: float, out: F64) -> None:
    """Compute B^-1 (x, y, 1) as a unit vector."""
    columns = B.T
    area = np.empty(3)
    for k in range(3):
        _cross(columns[(k + 1) % 3], columns[(k + 2) % 3], area)
        out[k] = area[0] * x + area[1] * y + area[2]
    out /= np.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)


@njit(cache=True, nogil=True)
def _reduced_pencil(five: F64, six: F64, pencil: F64) -> bool:
    """Orthonormal basis (2, 9) of the G with zero diagonal, sum 0 and x6' G x5 = 0.

    ``five`` and ``six`` (3, 3) are the unit vectors of the fifth and sixth point in the basis of the others,
    one row per view. False if the equations are dependent.
    """
    Q = np.zeros((6, 6))
    Q[0] = 1.0
    for v in range(3):
        for c in range(6):
            Q[v + 1, c] = six[v, OFF_DIAGONAL[c][0]] * five[v, OFF_DIAGONAL[c][1]]
    for k in range(6):
        if k >= 4:
            # Complete the basis with the coordinate vector farthest from the span.
            inside = np.zeros(6)
            for m in range(k):
                inside += Q[m] ** 2
            Q[k] = 0.0
            Q[k, np.argmin(inside)] = 1.0
        before = np.sqrt(Q[k] @ Q[k])
        for _ in range(2):
            for m in range(k):
                Q[k] -= (Q[m] @ Q[k]) * Q[m]
        after = np.sqrt(Q[k] @ Q[k])
        if not after > DEPENDENT * before:
            return False
        Q[k] /= after
    pencil[:] = 0.0
    for c in range(6):
        place = 3 * OFF_DIAGONAL[c][0] + OFF_DIAGONAL[c][1]
        pencil[0, place], pencil[1, place] = Q[4, c], Q[5, c]
    return True


@njit(cache=True, nogil=True)
def _sixth_point(G: F64, X: F64) -> bool:
    """The sixth point (4,) of a singular G (3, 3), the others being E_1, ..., E_4 and (1, 1, 1, 1).

    G = [u]x diag(X, Y, Z) with u = (X - W, Y - W, Z - W), its left null vector; the right one is u / X.
    """
    right, left, M, mix = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(3)
    if not (_null_vector(G, right) and _null_vector(G.T.copy(), left)):
        return False
    for k in range(3):
        # X = W - m u, put into X v = n u.
        M[k, 0], M[k, 1], M[k, 2] = right[k], -left[k] * right[k], -left[k]
    if not _null_vector(M, mix):
        return False
    X[0], X[1], X[2] = mix[0] - mix[1] * left[0], mix[0] - mix[1] * left[1], mix[0] - mix[1] * left[2]
    X[3] = mix[0]
    norm = np.sqrt(X @ X)
    if not norm > 0.0:
        return False
    X /= norm
    return True


@njit(cache=True, nogil=True)
def _reduced_camera(B: F64, five: F64, six: F64, X: F64, P: F64) -> bool:
    """P (3, 4) = B [a 0 0 d; 0 b 0 d; 0 0 c d], unit norm, that projects (1, 1, 1, 1) and X."""
    M, mix = np.empty((3, 3)), np.empty(3)
    for k in range(3):
        # a = s x5 - d and so on, put into a X + d W = t x6.
        M[k, 0], M[k, 1], M[k, 2] = five[k] * X[k], X[3] - X[k], -six[k]
    if not _null_vector(M, mix):
        return False
    for r in range(3):
        P[r, 3] = 0.0
        for k in range(3):
            P[r, k] = B[r, k] * (mix[0] * five[k] - mix[1])
            P[r, 3] += B[r, k] * mix[1]
    norm = np.sqrt(np.sum(P * P))
    if not (0.0 < norm < np.inf):
        return False
    P /= norm
    return True


@njit(cache=True, nogil=True)
def six_point(track: F64, sample: I64, P: F64) -> int:
    """Compute the cameras of three views from six points.

    Quan (1995) by Carlsson's duality: in the frame of five points the last two images satisfy an epipolar
    constraint that is the same in all views. With four constraints that hold for every point it is the
    seven-point problem of (5.2).

    Parameters
    ----------
    track : ndarray (N, 6)
        Tracks.
    sample : ndarray (6,) of int
        Indices of the tracks.
    P : ndarray (3, 3, 3, 4)
        Output: the three cameras of each solution.

    Returns
    -------
    int
        Number of solutions, 0 to 3.
    """
    B, five, six = np.empty((3, 3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for v in range(3):
        if not _basis_matrix(track, sample, v, B[v]):
            return 0
        _in_basis(B[v], track[sample[4], 2 * v], track[sample[4], 2 * v + 1], five[v])
        _in_basis(B[v], track[sample[5], 2 * v], track[sample[5], 2 * v + 1], six[v])
    pencil, G, X = np.empty((2, 9)), np.empty((3, 9)), np.empty(4)
    if not _reduced_pencil(five, six, pencil):
        return 0
    count = 0
    for k in range(singular_members(pencil, G)):
        if not _sixth_point(G[k].reshape(3, 3), X):
            continue
        good = True
        for v in range(3):
            good = good and _reduced_camera(B[v], five[v], six[v], X, P[count, v])
        if good and _in_front(P[count], X):
            count += 1
    return count


@njit(cache=True, nogil=True)
def _in_front(P: F64, X6: F64) -> bool:
    """Return whether the six points can be in front of all three cameras, in some frame with some signs.

    The depths of every two views must have the same sign for all points, or opposite signs for all.
    """
    agreed1, agreed2 = 0.0, 0.0
    for k in range(SAMPLE):
        w0, w1, w2 = 0.0, 0.0, 0.0
        if k < 4:
            w0, w1, w2 = P[0, 2, k], P[1, 2, k], P[2, 2, k]
        else:
            for a in range(4):
                x = 1.0 if k == 4 else X6[a]
                w0 += P[0, 2, a] * x
                w1 += P[1, 2, a] * x
                w2 += P[2, 2, a] * x
        s1, s2 = np.sign(w0 * w1), np.sign(w0 * w2)
        if k == 0:
            agreed1, agreed2 = s1, s2
        if s1 * agreed1 <= 0.0 or s2 * agreed2 <= 0.0:
            return False
    return True


@njit(cache=True, nogil=True)
def _first_ray(P1: F64, C: F64, D: F64) -> bool:
    """Centre ``C`` (4,) by minors (3.24) and ``D`` (4, 3) = P1^+, with D x on the rays; False if none."""
    gram, inverse = P1 @ P1.T, np.empty((3, 3))
    for k in range(3):
        _cross(gram[(k + 1) % 3], gram[(k + 2) % 3], inverse[k])
    det = gram[0, 0] * inverse[0, 0] + gram[0, 1] * inverse[0, 1] + gram[0, 2] * inverse[0, 2]
    if not det > 0.0:
        return False
    D[:] = P1.T @ inverse.T / det
    M = np.empty((3, 3))
    for left_out in range(4):
        for c in range(3):
            M[c] = P1[:, c if c < left_out else c + 1]
        det = _cross(M[0], M[1], inverse[0])
        det = inverse[0] @ M[2]
        C[left_out] = det if left_out % 2 == 1 else -det
    C /= np.sqrt(C @ C)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _start_on_ray(C: F64, D: F64, A: F64, e: F64, track: F64, X: F64) -> None:
    """X (4,) on the ray of the first image nearest to the lines through the other images.

    The lines are perpendicular to the epipolar lines, so points of the plane of the three centres are no
    exception.
    """
    aa, ad, dd = 0.0, 0.0, 0.0
    for v in range(2):
        x, y = track[2 * v + 2], track[2 * v + 3]
        d0 = A[v, 0, 0] * track[0] + A[v, 0, 1] * track[1] + A[v, 0, 2]
        d1 = A[v, 1, 0] * track[0] + A[v, 1, 1] * track[1] + A[v, 1, 2]
        d2 = A[v, 2, 0] * track[0] + A[v, 2, 1] * track[1] + A[v, 2, 2]
        l0, l1 = e[v, 1] * d2 - e[v, 2] * d1, e[v, 2] * d0 - e[v, 0] * d2
        size = 1.0 / np.sqrt(l0 * l0 + l1 * l1)
        l0, l1 = l0 * size, l1 * size
        off = l1 * x - l0 * y
        a, d = -l1 * e[v, 0] + l0 * e[v, 1] + off * e[v, 2], -l1 * d0 + l0 * d1 + off * d2
        aa, ad, dd = aa + a * a, ad + a * d, dd + d * d
    # The null vector of [aa ad; ad dd] is (-(dd - m), ad) or (ad, -(aa - m)) for its least eigenvalue m.
    half, gap = 0.5 * (aa + dd), 0.5 * (aa - dd)
    least = half - np.sqrt(gap * gap + ad * ad)
    alpha, beta = (dd - least, -ad) if dd > aa else (-ad, aa - least)
    for r in range(4):
        X[r] = alpha * C[r] + beta * (D[r, 0] * track[0] + D[r, 1] * track[1] + D[r, 2])


@njit(cache=True, nogil=True, error_model="numpy")
def _squared_distance(P: F64, C: F64, D: F64, A: F64, e: F64, track: F64, X: F64) -> float:
    """Sum over three views of the squared distances of a track to the reprojection of its best point X (4,).

    ``A`` (2, 3, 3) = P2 D, P3 D and ``e`` (2, 3) = P2 C, P3 C. Two Gauss-Newton steps from
    :func:`_start_on_ray`.
    """
    _start_on_ray(C, D, A, e, track, X)
    H, g = np.empty((4, 4)), np.empty(4)
    cost = np.inf
    for step in range(STEPS + 1):
        norm = 1.0 / np.sqrt(X[0] * X[0] + X[1] * X[1] + X[2] * X[2] + X[3] * X[3])
        cost = 0.0
        H[:], g[:] = 0.0, 0.0
        for r in range(4):
            X[r] *= norm
        for v in range(3):
            w = P[v, 2, 0] * X[0] + P[v, 2, 1] * X[1] + P[v, 2, 2] * X[2] + P[v, 2, 3] * X[3]
            for c in range(2):
                p = P[v, c, 0] * X[0] + P[v, c, 1] * X[1] + P[v, c, 2] * X[2] + P[v, c, 3] * X[3]
                image = p / w
                residual = image - track[2 * v + c]
                cost += residual * residual
                if step < STEPS:
                    j0, j1 = (P[v, c, 0] - image * P[v, 2, 0]) / w, (P[v, c, 1] - image * P[v, 2, 1]) / w
                    j2, j3 = (P[v, c, 2] - image * P[v, 2, 2]) / w, (P[v, c, 3] - image * P[v, 2, 3]) / w
                    for row, jr in enumerate((j0, j1, j2, j3)):
                        g[row] += jr * residual
                        H[row, 0] += jr * j0
                        H[row, 1] += jr * j1
                        H[row, 2] += jr * j2
                        H[row, 3] += jr * j3
        if step < STEPS and not _gauss_newton_step(H, g, X):
            break
    return cost if cost >= 0.0 else np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _gauss_newton_step(H: F64, g: F64, X: F64) -> bool:
    """X -= (H + t X X')^-1 g by Cholesky; H lacks the rank along X, to which the step is orthogonal."""
    trace = H[0, 0] + H[1, 1] + H[2, 2] + H[3, 3]
    for r in range(4):
        for c in range(4):
            H[r, c] += trace * X[r] * X[c]
    for k in range(4):
        for c in range(k):
            H[k, k] -= H[k, c] * H[k, c]
        if not H[k, k] > 1e-14 * trace:
            return False
        H[k, k] = np.sqrt(H[k, k])
        for r in range(k + 1, 4):
            for c in range(k):
                H[r, k] -= H[r, c] * H[k, c]
            H[r, k] /= H[k, k]
    for k in range(4):
        for c in range(k):
            g[k] -= H[k, c] * g[c]
        g[k] /= H[k, k]
    for k in range(3, -1, -1):
        for r in range(k + 1, 4):
            g[k] -= H[r, k] * g[r]
        g[k] /= H[k, k]
    for r in range(4):
        X[r] -= g[r]
    return True


@njit(cache=True, nogil=True)
def three_view_distances(P: F64, track: F64, distances: F64) -> None:
    """Compute the distance of each track to its reprojection in three views.

    Parameters
    ----------
    P : ndarray (3, 3, 4)
        Cameras.
    track : ndarray (N, 6)
        Tracks.
    distances : ndarray (N,)
        Output: root of the sum of squared distances over the views.
    """
    C, D, X = np.empty(4), np.empty((4, 3)), np.empty(4)
    if not _first_ray(P[0], C, D):
        distances[:] = np.inf
        return
    A, e = np.empty((2, 3, 3)), np.empty((2, 3))
    for v in range(2):
        A[v], e[v] = P[v + 1] @ D, P[v + 1] @ C
    for n in range(len(track)):
        distances[n] = np.sqrt(_squared_distance(P, C, D, A, e, track[n], X))


@njit(cache=True, nogil=True)
def _gain(squared: float, inverse: float) -> float:
    """Mean over three widths of 1 - d^2 / width^2 if positive; ``inverse`` is 1 / threshold^2."""
    total = 0.0
    for shrink in WIDTHS:
        total += max(0.0, 1.0 - squared * inverse * shrink)
    return total / len(WIDTHS)


@njit(cache=True, nogil=True)
def _score(P: F64, track: F64, inverse: float, bar: float) -> float:
    """Sum of the gains of all tracks, 0 as soon as it cannot exceed ``bar``."""
    C, D, X = np.empty(4), np.empty((4, 3)), np.empty(4)
    if not _first_ray(P[0], C, D):
        return 0.0
    A, e = np.empty((2, 3, 3)), np.empty((2, 3))
    for v in range(2):
        A[v], e[v] = P[v + 1] @ D, P[v + 1] @ C
    total, left = 0.0, float(len(track))
    for n in range(len(track)):
        if not total + left > bar:
            return 0.0
        total += _gain(_squared_distance(P, C, D, A, e, track[n], X), inverse)
        left -= 1.0
    return total


@njit(cache=True, nogil=True)
def draw_samples(uniforms: F64, n: int) -> I64:
    """Draw samples of distinct indices.

    Parameters
    ----------
    uniforms : ndarray (S, k)
        Uniform random numbers in [0, 1).
    n : int
        Upper bound of the indices.

    Returns
    -------
    ndarray (S, k) of int
        Sorted samples.
    """
    samples = np.empty(uniforms.shape, dtype=np.int64)
    for s in range(len(uniforms)):
        draw_sample(uniforms[s], n, samples[s])
    return samples


@njit(cache=True, nogil=True)
def search_trifocal(track: F64, samples: I64, scored: F64, threshold: float, bar: float, best: F64) -> float:
    """Find the cameras with the best score among the solutions of samples.

    Parameters
    ----------
    track : ndarray (N, 6)
        Tracks.
    samples : ndarray (S, 6) of int
        Samples of tracks.
    scored : ndarray (M, 6)
        Tracks that define the score.
    threshold : float
        Width of the score.
    bar : float
        Score to exceed.
    best : ndarray (3, 3, 4)
        Output: best cameras, unchanged if none exceeds ``bar``.

    Returns
    -------
    float
        Best score, or ``bar``.
    """
    P = np.empty((3, 3, 3, 4))
    for s in range(len(samples)):
        for k in range(six_point(track, samples[s], P)):
            value = _score(P[k], scored, 1.0 / threshold**2, bar)
            if value > bar:
                bar = value
                best[:] = P[k]
    return bar
