"""Section 5.3: minimise a geometric criterion over the seven degrees of freedom of F.

F = U diag(cos phi, sin phi, 0) V' is the orthonormal representation of Bartoli and Sturm (IJCV 2004): rank 2
by construction, without the thesis' special case of an epipole at infinity. The criteria are the Sampson
distance (5.4), which the thesis calls the gradient criterion, the distances to the epipolar lines (5.6) and
the reprojection error (Hartley and Zisserman, algorithm 11.3). In the kernels points are rows (x1, y1, x2,
y2) in a common frame and F is a row-major vector of 9.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.arrays import F64
from thesisrecon.epipolar.frame import PairFrame, check_matches, check_start
from thesisrecon.numerics.small_solvers import solve_damped

SAMPSON, EPIPOLAR_DISTANCE, REPROJECTION = 0, 1, 2
# Steps to the nearest exact match; each reduces the error by about (noise / distance to the epipole)^2.
CORRECTIONS = 8
BLOCK = 128
# Stands for an infinite width of the loss; its square is still finite.
UNBOUNDED = 1e150


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def _weighted_derivatives(f: F64, points: F64, criterion: int, gate: float, delta: float, D: F64) -> float:
    """Compute the derivatives of the residuals of at most BLOCK points by F: columns of ``D`` (11, BLOCK).

    Row 9 is the signed residual, row 10 the weight rho'(r) / r, 0 beyond the gate. Returns the cost. The loop
    has no branches and reads contiguous rows so that it vectorises.
    """
    X = np.empty((4, BLOCK))
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def _reprojection_derivatives(f: F64, points: F64, gate: float, delta: float, D: F64) -> float:
    """As :func:`_weighted_derivatives` for the distances r of (x1, y1, x2, y2) to the nearest exact match.

    The nearest match p comes from the iteration of Kanatani, Sugaya and Niitsuma (BMVC 2008). Since r is
    minimal there, dr = d(p2' F p1) / |gradient at p| without the motion of p.
    """
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def normal_equations(f: F64, points: F64, criterion: int, gate: float, delta: float, G: F64, h: F64) -> float:
    """Compute the Gauss-Newton system of 1/2 sum rho(r) by the entries of F.

    rho is Huber's loss of width ``delta``, constant beyond ``gate``.

    Parameters
    ----------
    f : ndarray (9,)
        F in the frame.
    points : ndarray (N, 4)
        Matches.
    criterion : int
        SAMPSON (5.4), EPIPOLAR_DISTANCE (5.6) or REPROJECTION.
    gate : float
        Residual beyond which a match has no weight.
    delta : float
        Width of Huber's loss.
    G : ndarray (9, 9)
        Output: Gauss-Newton matrix.
    h : ndarray (9,)
        Output: gradient.

    Returns
    -------
    float
        The cost.
    """
    G[:] = 0.0
    h[:] = 0.0
    cost = 0.0
    D, wd = np.empty((11, BLOCK)), np.empty(BLOCK)
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


@njit(cache=True, nogil=True)
def residuals_and_derivatives(f: F64, points: F64, criterion: int) -> tuple[F64, F64]:
    """Compute the signed residuals of a criterion and their derivatives by the entries of F.

    Parameters
    ----------
    f : ndarray (9,)
        F in the frame.
    points : ndarray (N, 4)
        Matches.
    criterion : int
        SAMPSON, EPIPOLAR_DISTANCE or REPROJECTION.

    Returns
    -------
    r : ndarray (N,)
        Residuals.
    J : ndarray (N, 9)
        Derivatives.
    """
    r, J, D = np.empty(len(points)), np.empty((len(points), 9)), np.empty((11, BLOCK))
    for start in range(0, len(points), BLOCK):
        block = points[start : start + BLOCK]
        if criterion == REPROJECTION:
            _reprojection_derivatives(f, block, np.inf, 1e150, D)
        else:
            _weighted_derivatives(f, block, criterion, np.inf, 1e150, D)
        for k in range(len(block)):
            r[start + k] = D[9, k]
            for m in range(9):
                J[start + k, m] = D[m, k]
    return r, J


@njit(cache=True, nogil=True)
def fundamental_from_orthonormal(U: F64, V: F64, phi: float, f: F64) -> None:
    """Compute F = U diag(cos phi, sin phi, 0) V', rank 2 and unit norm.

    Parameters
    ----------
    U, V : ndarray (3, 3)
        Orthonormal matrices.
    phi : float
        Angle of the singular values.
    f : ndarray (9,)
        Output: F.
    """
    c, s = np.cos(phi), np.sin(phi)
    for i in range(3):
        for j in range(3):
            f[3 * i + j] = c * U[i, 0] * V[j, 0] + s * U[i, 1] * V[j, 1]


@njit(cache=True, nogil=True)
def orthonormal_tangent(U: F64, V: F64, phi: float, B: F64) -> None:
    """Compute the derivatives of F by rotations of U and V about their own axes and by phi.

    Parameters
    ----------
    U, V : ndarray (3, 3)
        Orthonormal matrices.
    phi : float
        Angle of the singular values.
    B : ndarray (9, 7)
        Output: columns for U (3), V (3) and phi.
    """
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def orthonormal_from_fundamental(f: F64, U: F64, V: F64) -> float:
    """Decompose the nearest matrix of rank 2 into U, V and phi.

    Parameters
    ----------
    f : ndarray (9,)
        F.
    U, V : ndarray (3, 3)
        Output: left and right singular vectors.

    Returns
    -------
    float
        phi = atan2 of the second and first singular value.
    """
    u, s, vt = np.linalg.svd(f.reshape((3, 3)))
    U[:] = u
    V[:] = vt.T
    return float(np.arctan2(s[1], s[0]))


@njit(cache=True, nogil=True, forceinline=True)
def refine(
    f: F64, points: F64, criterion: int, gate: float, delta: float, iterations: int
) -> tuple[float, int]:
    """Minimise the cost of :func:`normal_equations` by Levenberg-Marquardt.

    Parameters
    ----------
    f : ndarray (9,)
        Finite start; overwritten by the result.
    points : ndarray (N, 4)
        Matches.
    criterion : int
        SAMPSON, EPIPOLAR_DISTANCE or REPROJECTION.
    gate, delta : float
        Gate and width of Huber's loss.
    iterations : int
        Maximum number of linear solves.

    Returns
    -------
    cost : float
        Final cost, never above that of the nearest rank-2 matrix of the start.
    steps : int
        Number of solves.
    """
    U, V, Un, Vn = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    phi = orthonormal_from_fundamental(f, U, V)
    G, h, Gn, hn = np.empty((9, 9)), np.empty(9), np.empty((9, 9)), np.empty(9)
    B, step, trial = np.empty((9, 7)), np.empty(7), np.empty(9)
    fundamental_from_orthonormal(U, V, phi, f)
    cost = normal_equations(f, points, criterion, gate, delta, G, h)
    exact = 1e-26 * len(points)
    damping, steps = 1e-3, 0
    while steps < iterations and cost > exact:
        orthonormal_tangent(U, V, phi, B)
        H = B.T @ (G @ B)
        g = B.T @ h
        accepted = False
        while steps < iterations and not accepted:
            steps += 1
            if solve_damped(H, g, damping, step):
                _rotate_columns(U, step[0:3], Un)
                _rotate_columns(V, step[3:6], Vn)
                fundamental_from_orthonormal(Un, Vn, phi + step[6], trial)
                new_cost = normal_equations(trial, points, criterion, gate, delta, Gn, hn)
                accepted = new_cost < cost
            damping = max(1e-9, 0.1 * damping) if accepted else 10.0 * damping
            if damping > 1e8:
                return cost, steps
        if not accepted:
            break
        gain = cost - new_cost
        U, Un, V, Vn, phi = Un, U, Vn, V, phi + step[6]
        G, Gn, h, hn, cost = Gn, G, hn, h, new_cost
        f[:] = trial
        if gain <= 1e-6 * cost:
            break
    return cost, steps


def refine_sampson(
    F: F64, xy1: F64, xy2: F64, *, loss_px: float = UNBOUNDED, max_iterations: int = 50
) -> F64:
    """Minimise the Sampson distances (5.4) from a start, the thesis' gradient criterion.

    Optimal to first order in the noise. The thesis writes the third row as a combination of the others, so
    that the epipole (alpha, beta, -1) cannot lie at infinity; the orthonormal representation has no such
    exception.

    Parameters
    ----------
    F : array_like (3, 3)
        Start, rank 2 or 3, px.
    xy1, xy2 : array_like (N, 2)
        Matched points, N >= 7, px.
    loss_px : float
        Width of Huber's loss; least squares by default.
    max_iterations : int
        Maximum number of linear solves.

    Returns
    -------
    ndarray (3, 3)
        Refined F, rank 2, unit norm.

    Raises
    ------
    ValueError
        If F is not finite and of rank 2 or 3, or ``loss_px`` is not positive.
    StageFailure
        As :func:`~thesisrecon.epipolar.frame.check_matches`.

    References
    ----------
    A. Bartoli and P. Sturm, "Nonlinear estimation of the fundamental matrix with minimal parameters", PAMI
    26, 2004.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon.geometry.two_view import sampson_residuals
    >>> from thesisrecon.epipolar.linear import estimate_eight_point
    >>> xy1 = np.array([[0, 0], [9, 1], [2, 8], [7, 7], [4, 3], [1, 5], [8, 4], [5, 9], [6, 1]], dtype=float)
    >>> depth = np.array([1, 2, 4, 2, 1, 4, 1, 2, 4])
    >>> noise = np.array([[1, -1], [-1, 0], [0, 1], [1, 1], [-1, -1], [0, -1], [1, 0], [-1, 1], [0, 0]])
    >>> xy2 = xy1 + np.array([[4.0, 2.0]]) / depth[:, None] + 0.01 * noise
    >>> start = estimate_eight_point(xy1, xy2)
    >>> F = refine_sampson(start, xy1, xy2)
    >>> rms = [float(np.sqrt(np.mean(sampson_residuals(M, xy1, xy2) ** 2))) for M in (start, F)]
    >>> rms[1] < rms[0]
    True
    """
    return _refine(F, xy1, xy2, SAMPSON, loss_px, max_iterations)


def refine_epipolar_distance(
    F: F64, xy1: F64, xy2: F64, *, loss_px: float = UNBOUNDED, max_iterations: int = 50
) -> F64:
    """Minimise the squared distances to both epipolar lines (5.6) from a start.

    Parameters
    ----------
    F : array_like (3, 3)
        Start, rank 2 or 3, px.
    xy1, xy2 : array_like (N, 2)
        Matched points, N >= 7, px.
    loss_px : float
        Width of Huber's loss; least squares by default.
    max_iterations : int
        Maximum number of linear solves.

    Returns
    -------
    ndarray (3, 3)
        Refined F, rank 2, unit norm.

    Raises
    ------
    ValueError
        As :func:`refine_sampson`.
    StageFailure
        As :func:`~thesisrecon.epipolar.frame.check_matches`.

    Examples
    --------
    >>> import numpy as np
    >>> xy1 = np.array([[0, 0], [9, 1], [2, 8], [7, 7], [4, 3], [1, 5], [8, 4], [5, 9]], dtype=float)
    >>> xy2 = xy1 + np.array([[4.0, 2.0]]) / np.array([1, 2, 4, 2, 1, 4, 1, 2])[:, None]
    >>> start = np.array([[0.0, 0.0, 0.4], [0.0, 0.0, -0.9], [-0.4, 0.9, 0.0]])
    >>> F = refine_epipolar_distance(start, xy1, xy2)
    >>> float(np.round(np.abs(F[0, 2] / F[1, 2]), 6))
    0.5
    """
    return _refine(F, xy1, xy2, EPIPOLAR_DISTANCE, loss_px, max_iterations)


def refine_reprojection(
    F: F64, xy1: F64, xy2: F64, *, loss_px: float = UNBOUNDED, max_iterations: int = 50
) -> F64:
    """Minimise the reprojection error from a start, the gold standard method.

    The maximum likelihood of F and of all points for Gaussian noise. Each point is eliminated by its optimal
    correction, so that seven parameters remain.

    Parameters
    ----------
    F : array_like (3, 3)
        Start, rank 2 or 3, px.
    xy1, xy2 : array_like (N, 2)
        Matched points, N >= 7, px.
    loss_px : float
        Width of Huber's loss; least squares by default.
    max_iterations : int
        Maximum number of linear solves.

    Returns
    -------
    ndarray (3, 3)
        Refined F, rank 2, unit norm.

    Raises
    ------
    ValueError
        As :func:`refine_sampson`.
    StageFailure
        As :func:`~thesisrecon.epipolar.frame.check_matches`.

    References
    ----------
    Hartley and Zisserman, Multiple View Geometry, algorithm 11.3.

    Examples
    --------
    >>> import numpy as np
    >>> xy1 = np.array([[0, 0], [9, 1], [2, 8], [7, 7], [4, 3], [1, 5], [8, 4], [5, 9]], dtype=float)
    >>> xy2 = xy1 + np.array([[4.0, 2.0]]) / np.array([1, 2, 4, 2, 1, 4, 1, 2])[:, None]
    >>> start = np.array([[0.0, 0.0, 0.4], [0.0, 0.0, -0.9], [-0.4, 0.9, 0.0]])
    >>> F = refine_reprojection(start, xy1, xy2)
    >>> float(np.round(np.abs(F[0, 2] / F[1, 2]), 6))
    0.5
    """
    return _refine(F, xy1, xy2, REPROJECTION, loss_px, max_iterations)


def _refine(F: F64, xy1: F64, xy2: F64, criterion: int, loss_px: float, max_iterations: int) -> F64:
    xy1, xy2 = check_matches(xy1, xy2, needed=7)
    if not loss_px > 0.0:
        raise ValueError(f"loss_px must be positive; got {loss_px}")
    frame = PairFrame.of(xy1, xy2)
    f = check_start(F, frame)
    delta = min(loss_px * frame.scale, UNBOUNDED)
    refine(f, frame.points(xy1, xy2), criterion, np.inf, delta, max_iterations)
    return frame.matrix_in_pixels(f)
