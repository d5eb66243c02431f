"""Kernels of the default estimator: batched seven-point solver, Sampson distances and truncated score.

In the projective basis of four of the seven matches F has a zero diagonal and entries that sum to zero, and
three equations leave a pencil by minors without pivoting: the loop vectorises and is four times faster than
:func:`thesisrecon.epipolar.ransac.seven_point`. It may miss a double root, which random sampling tolerates.
Points are rows (x1, y1, x2, y2) in a frame that scales both images equally, F is a row-major vector of 9.
"""

import numpy as np

from thesisrecon._numba import copy_to, empty, full, kernel
from thesisrecon.arrays import F64, I64

LANES = 32
# Rows of a solved batch: 0 and 9 the transforms to the bases (9 each), 18 the orientation of the first three
# matches, 21 and 30 the last three points of either image (9 each), 39 and 45 the two members (6 each) of
# the pencil basis, 51 the three coefficients of the monic cubic.
TO_BASIS_1, TO_BASIS_2, FIRST, SECOND, ROWS = 0, 9, 39, 45, 54
STRIDE = 16  # points scored between two tests
LOG_REJECTION_RATIO = np.log(1e3)  # the sequential test rejects at most one correct F in a thousand
LARGEST = 1 << 40

Three = tuple[float, float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]


@kernel(inline="always")
def _basis_transform(
    xa: float, ya: float, xb: float, yb: float, xc: float, yc: float, xd: float, yd: float
) -> Nine:
    """Rows of T (3, 3) from pixels to the basis of four points; not finite if three are collinear."""
    a0, a1, a2 = yb - yc, xc - xb, xb * yc - yb * xc
    b0, b1, b2 = yc - ya, xa - xc, xc * ya - yc * xa
    c0, c1, c2 = ya - yb, xb - xa, xa * yb - ya * xb
    a = 1.0 / (a0 * xd + a1 * yd + a2)
    b = 1.0 / (b0 * xd + b1 * yd + b2)
    c = 1.0 / (c0 * xd + c1 * yd + c2)
    return a * a0, a * a1, a * a2, b * b0, b * b1, b * b2, c * c0, c * c1, c * c2


@kernel(inline="always")
def _apply_transform(T: Nine, x: float, y: float) -> Three:
    """T (x, y, 1)'."""
    return T[0] * x + T[1] * y + T[2], T[3] * x + T[4] * y + T[5], T[6] * x + T[7] * y + T[8]


@kernel(inline="always")
def _basis_equation(u: Three, v: Three) -> tuple[float, float, float, float, float]:
    """Coefficients of F13, F21, F23, F31, F32 in v' F u = 0, with F12 minus their sum."""
    first = v[0] * u[1]
    F13, F21, F23 = v[0] * u[2] - first, v[1] * u[0] - first, v[1] * u[2] - first
    return F13, F21, F23, v[2] * u[0] - first, v[2] * u[1] - first


@kernel(inline="always")
def _determinant(a: Three, b: Three, c: Three) -> float:
    """Determinant of the matrix with columns a, b, c."""
    value: float = a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2])
    return value + a[2] * (b[0] * c[1] - b[1] * c[0])


@kernel(fastmath={"contract"}, forceinline=True)
def solve_seven_point_batch(X: F64, Y: F64) -> None:
    """Write the pencils and cubics of LANES samples to ``Y`` (ROWS, LANES), not finite if degenerate."""
    # `X` (28, LANES) holds x1, y1, x2, y2 of seven matches. With t p + q a member of a pencil, det(t p + q) =
    # t^3 + ... has products of entries as coefficients, since F12 F23 F31 + F13 F21 F32 is the determinant of
    # a matrix with zero diagonal.
    for k in range(LANES):
        S = _basis_transform(X[0, k], X[1, k], X[4, k], X[5, k], X[8, k], X[9, k], X[12, k], X[13, k])
        T = _basis_transform(X[2, k], X[3, k], X[6, k], X[7, k], X[10, k], X[11, k], X[14, k], X[15, k])
        # T x_i is a positive or negative multiple of the basis vector e_i: the products over both images.
        side0 = (S[0] * X[0, k] + S[1] * X[1, k] + S[2]) * (T[0] * X[2, k] + T[1] * X[3, k] + T[2])
        side1 = (S[3] * X[4, k] + S[4] * X[5, k] + S[5]) * (T[3] * X[6, k] + T[4] * X[7, k] + T[5])
        side2 = (S[6] * X[8, k] + S[7] * X[9, k] + S[8]) * (T[6] * X[10, k] + T[7] * X[11, k] + T[8])
        u, v = _apply_transform(S, X[16, k], X[17, k]), _apply_transform(T, X[18, k], X[19, k])
        r, s = _apply_transform(S, X[20, k], X[21, k]), _apply_transform(T, X[22, k], X[23, k])
        w, z = _apply_transform(S, X[24, k], X[25, k]), _apply_transform(T, X[26, k], X[27, k])
        A, B, C = _basis_equation(u, v), _basis_equation(r, s), _basis_equation(w, z)
        c0, c1, c2 = (A[0], B[0], C[0]), (A[1], B[1], C[1]), (A[2], B[2], C[2])
        c3, c4 = (A[3], B[3], C[3]), (A[4], B[4], C[4])
        lead = _determinant(c0, c1, c2)
        p1, p2, p3, p4 = -_determinant(c3, c1, c2), -_determinant(c0, c3, c2), -_determinant(c0, c1, c3), lead
        q1, q2, q3, q5 = -_determinant(c4, c1, c2), -_determinant(c0, c4, c2), -_determinant(c0, c1, c4), lead
        p0, q0 = -(p1 + p2 + p3 + p4), -(q1 + q2 + q3 + q5)
        # det(t p + q), with p5 = q4 = 0.
        m3 = p0 * p3 * p4
        m2 = q0 * p3 * p4 + p0 * q3 * p4 + p1 * p2 * q5
        m1 = q0 * q3 * p4 + q1 * p2 * q5 + p1 * q2 * q5
        m0 = q1 * q2 * q5
        inverse = 1.0 / m3
        for m in range(9):
            Y[TO_BASIS_1 + m, k] = S[m]
            Y[TO_BASIS_2 + m, k] = T[m]
        Y[18, k], Y[19, k], Y[20, k] = side0, side1, side2
        Y[21, k], Y[22, k], Y[23, k], Y[24, k], Y[25, k], Y[26, k] = u[0], u[1], u[2], r[0], r[1], r[2]
        Y[27, k], Y[28, k], Y[29, k], Y[30, k], Y[31, k], Y[32, k] = w[0], w[1], w[2], v[0], v[1], v[2]
        Y[33, k], Y[34, k], Y[35, k], Y[36, k], Y[37, k], Y[38, k] = s[0], s[1], s[2], z[0], z[1], z[2]
        Y[39, k], Y[40, k], Y[41, k], Y[42, k], Y[43, k], Y[44, k] = p0, p1, p2, p3, p4, 0.0
        Y[45, k], Y[46, k], Y[47, k], Y[48, k], Y[49, k], Y[50, k] = q0, q1, q2, q3, 0.0, q5
        Y[51, k], Y[52, k], Y[53, k] = m2 * inverse, m1 * inverse, m0 * inverse


@kernel(fastmath={"contract"}, forceinline=True)
def _newton_cubic_roots(a: float, b: float, c: float, roots: F64) -> int:
    """Real roots of x^3 + a x^2 + b x + c: one by Newton from beyond the turning point, and a quadratic."""
    centre = -a / 3.0
    Q = (a * a - 3.0 * b) / 9.0
    value = ((centre + a) * centre + b) * centre + c
    if not abs(value) < np.inf:
        return 0
    reach = 2.0 * np.sqrt(Q) if Q > 0.0 else np.cbrt(abs(value))
    x = centre - reach if value > 0.0 else centre + reach
    for _ in range(40):
        slope = (3.0 * x + 2.0 * a) * x + b
        change = (((x + a) * x + b) * x + c) / slope if slope != 0.0 else 0.0
        x -= change
        if not abs(change) > 1e-13 * (1.0 + abs(x)):
            break
    roots[0] = x
    p = a + x
    q = b + p * x
    gap = p * p - 4.0 * q
    if not gap > 0.0:
        return 1
    large = -0.5 * (p + np.sqrt(gap)) if p > 0.0 else -0.5 * (p - np.sqrt(gap))
    roots[1] = large
    roots[2] = q / large if large != 0.0 else 0.0
    return 3


@kernel(fastmath={"contract"}, forceinline=True)
def _oriented_in_basis(g: F64, Y: F64, lane: int) -> bool:
    """Return whether the seven matches of a lane can be in front of both cameras of the member ``g`` (6,)."""
    # Oriented epipolar constraint (Chum, Werner and Matas, ICPR 2004): e2 x x2 and F x1 are parallel for an
    # exact match and must agree in direction for all matches or for none.
    g01, g02, g10, g12, g20, g21 = g
    # e2 is at right angles to the columns (0, g10, g20), (g01, 0, g21) and (g02, g12, 0).
    e0, e1, e2 = g10 * g21, g20 * g01, -g10 * g01
    first = Y[18, lane] * (e2 * g10 - e1 * g20)
    if first * Y[19, lane] * (e0 * g21 - e2 * g01) < 0.0:
        return False
    if first * Y[20, lane] * (e1 * g02 - e0 * g12) < 0.0:
        return False
    fourth = (e1 - e2) * (g01 + g02) + (e2 - e0) * (g10 + g12) + (e0 - e1) * (g20 + g21)
    if first * fourth < 0.0:
        return False
    for m in range(3):
        u0, u1, u2 = Y[21 + 3 * m, lane], Y[22 + 3 * m, lane], Y[23 + 3 * m, lane]
        v0, v1, v2 = Y[30 + 3 * m, lane], Y[31 + 3 * m, lane], Y[32 + 3 * m, lane]
        dot = (e1 * v2 - e2 * v1) * (g01 * u1 + g02 * u2)
        dot += (e2 * v0 - e0 * v2) * (g10 * u0 + g12 * u2) + (e0 * v1 - e1 * v0) * (g20 * u0 + g21 * u1)
        if first * dot < 0.0:
            return False
    return True


@kernel(fastmath={"contract"}, forceinline=True)
def _leave_basis(g: F64, Y: F64, lane: int, f: F64) -> bool:
    """Write F = T2' G T1 as a unit vector to ``f``, G from the entries ``g`` (6,); False if not finite."""
    norm = 0.0
    for j in range(3):
        s0, s1, s2 = Y[j, lane], Y[3 + j, lane], Y[6 + j, lane]
        r0, r1, r2 = g[0] * s1 + g[1] * s2, g[2] * s0 + g[3] * s2, g[4] * s0 + g[5] * s1
        for i in range(3):
            f[3 * i + j] = Y[9 + i, lane] * r0 + Y[12 + i, lane] * r1 + Y[15 + i, lane] * r2
            norm += f[3 * i + j] * f[3 * i + j]
    if not 0.0 < norm < np.inf:
        return False
    norm = 1.0 / np.sqrt(norm)
    for m in range(9):
        f[m] *= norm
    return True


@kernel(forceinline=True)
def seven_point_batch_solutions(Y: F64, lane: int, work: F64, F: F64) -> int:
    """Write the F (3, 9) of a solved sample that satisfy the oriented constraint; returns their number."""
    roots, g, found = work[:3], work[3:], 0
    for k in range(_newton_cubic_roots(Y[51, lane], Y[52, lane], Y[53, lane], roots)):
        for m in range(6):
            g[m] = roots[k] * Y[FIRST + m, lane] + Y[SECOND + m, lane]
        if _oriented_in_basis(g, Y, lane) and _leave_basis(g, Y, lane, F[found]):
            found += 1
    return found


@kernel(inline="always")
def _squared_sampson(f: F64 | tuple[float, ...], x1: float, y1: float, x2: float, y2: float) -> float:
    """Squared Sampson distance, the summand of (5.4)."""
    a0 = f[0] * x1 + f[1] * y1 + f[2]
    a1 = f[3] * x1 + f[4] * y1 + f[5]
    b0 = f[0] * x2 + f[3] * y2 + f[6]
    b1 = f[1] * x2 + f[4] * y2 + f[7]
    e = a0 * x2 + a1 * y2 + f[6] * x1 + f[7] * y1 + f[8]
    squared: float = e * e / (a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1 + 1e-300)
    return squared


@kernel
def sampson_distances(f: F64, points: F64) -> F64:
    """Sampson distances (N,) >= 0 of all points."""
    r = empty(len(points))
    for k in range(len(points)):
        r[k] = np.sqrt(_squared_sampson(f, points[k, 0], points[k, 1], points[k, 2], points[k, 3]))
    return r


@kernel(fastmath={"reassoc", "contract"})
def squared_distances(F: F64, columns: F64) -> F64:
    """Squared Sampson distances (B, N) of matches (4, N) from models F (B, 9)."""
    out = empty((len(F), columns.shape[1]))
    for s in range(len(F)):
        f = F[s, 0], F[s, 1], F[s, 2], F[s, 3], F[s, 4], F[s, 5], F[s, 6], F[s, 7], F[s, 8]
        for k in range(columns.shape[1]):
            out[s, k] = _squared_sampson(f, columns[0, k], columns[1, k], columns[2, k], columns[3, k])
    return out


@kernel(fastmath={"reassoc", "contract"}, forceinline=True)
def _block_score(f: F64, columns: F64, start: int, end: int, gate: float) -> tuple[float, float]:
    """Sum of min(r^2 / gate^2, 1) over columns ``start`` to ``end`` of (4, N), and the inliers."""
    total, inside, per_gate = 0.0, 0.0, 1.0 / (gate * gate)
    F = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
    for k in range(start, end):
        r2 = per_gate * _squared_sampson(F, columns[0, k], columns[1, k], columns[2, k], columns[3, k])
        total += r2 if r2 < 1.0 else 1.0
        inside += 1.0 if r2 < 1.0 else 0.0
    return total, inside


@kernel(forceinline=True)
def truncated_score(
    f: F64, columns: F64, gate: float, give_up: float, evidence: tuple[float, float]
) -> tuple[float, int, int]:
    """Mean of min(r^2 / gate^2, 1) on ``columns`` (4, N) in random order, the inliers and points evaluated.

    Stops with score 1 if the sum exceeds ``give_up`` times the number of points, if the running mean is three
    standard errors above it, or by Wald's sequential test (Matas and Chum, ICCV 2005) of ``evidence``, the
    log likelihood ratios "wrong" to "right" of a point inside and outside the gate.
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


@kernel
def _log_likelihood_ratios(right: float, wrong: float) -> tuple[float, float]:
    """Log likelihood ratios wrong : right inside and outside the gate; zeros (never stop) if close."""
    right = min(right, 0.99)
    if not right > 1.5 * wrong:
        return 0.0, 0.0
    return np.log(wrong / right), np.log((1.0 - wrong) / (1.0 - right))


@kernel
def draw_sample(uniforms: F64, n: int, out: I64) -> None:
    """Turn uniform numbers (s,) into distinct sorted indices below n; every subset is equally likely."""
    for k in range(len(out)):
        index = min(int(uniforms[k] * (n - k)), n - k - 1)
        place = 0
        while place < k and out[place] <= index:
            index += 1
            place += 1
        for m in range(k, place, -1):
            out[m] = out[m - 1]
        out[place] = index


@kernel
def required_samples(inlier_ratio: float, sample_size: int, confidence: float, largest: int) -> int:
    """N = log(1 - confidence) / log(1 - ratio^size) (Fischler and Bolles 1981), at most ``largest``."""
    good = inlier_ratio**sample_size
    if good <= 1e-12:
        return largest
    if good >= 1.0:
        return 1
    needed = np.log(1.0 - confidence) / np.log1p(-good)
    return int(min(float(largest), np.ceil(needed)))


@kernel
def _draw_batch(points: F64, uniforms: F64, X: F64) -> None:
    """Write the samples of the rows of ``uniforms`` (B <= LANES, 7) as columns of ``X`` (28, LANES)."""
    sample = empty(7, np.int64)
    for lane in range(len(uniforms)):
        draw_sample(uniforms[lane], len(points), sample)
        for m in range(7):
            for c in range(4):
                X[4 * m + c, lane] = points[sample[m], c]


@kernel
def search_fundamental(
    points: F64, columns: F64, uniforms: F64, gate: float, stop: tuple[int, int, float], state: F64, F: F64
) -> int:
    """Score a seven-point sample of ``points`` per row of ``uniforms`` (B, 7) on ``columns`` (4, N)."""
    # Returns the number of samples, with the batch that finds a better `F` or when enough are drawn. `stop`:
    # samples drawn before, minimum number, probability of a sample without outliers. `state` (4,): best
    # score, its inlier ratio, points seen and points inside the gate of rejected models.
    done, least, confidence = stop
    X, Y = full((28, LANES), 1.0), empty((ROWS, LANES))
    solutions, work = empty((3, 9)), empty(9)
    before = state[0]
    for start in range(0, len(uniforms), LANES):
        enough = done >= least and done >= required_samples(state[1], 7, confidence, LARGEST)
        if state[0] < before or enough:
            break
        batch = uniforms[start : start + LANES]
        done += len(batch)
        _draw_batch(points, batch, X)
        solve_seven_point_batch(X, Y)
        evidence = _log_likelihood_ratios(state[1], state[3] / state[2])
        for lane in range(len(batch)):
            for k in range(seven_point_batch_solutions(Y, lane, work, solutions)):
                score, inliers, seen = truncated_score(solutions[k], columns, gate, state[0], evidence)
                if score < state[0]:
                    state[0], state[1] = score, inliers / columns.shape[1]
                    copy_to(F, solutions[k])
                else:
                    state[2] += seen
                    state[3] += inliers
    return done
