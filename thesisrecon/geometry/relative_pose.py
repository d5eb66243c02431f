"""Relative poses of calibrated cameras: five points, essential matrices and homographies taken apart."""

from itertools import product

import numpy as np

from thesisrecon._numba import empty, kernel
from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.geometry.polynomial_triangulation import horner, roots_in_unit_interval

# Products of the unknowns (x, y, z, 1): those of three as in Nister's table, then those without x^2, xy, y^2.
_CUBIC = ("000", "111", "001", "011", "002", "003", "112", "113", "012", "013", "022", "023", "033", "122",
          "123", "133", "222", "223", "233", "333")  # fmt: skip
_ALL_CUBIC = np.array(
    [["".join(sorted(each)) == name for name in _CUBIC] for each in product("0123", repeat=3)], np.float64
)


def essential_five_points(x1: F64, x2: F64) -> F64:
    """Essential matrices (B', 3, 3) of samples of five matches, rays (B, 5, 3) each, of unit norm.

    E = x E0 + y E1 + z E2 + E3 in the null space of the five equations; det E = 0 and 2 E E' E = tr(E E') E
    are ten cubic equations. Eliminated, they leave three equations in x, y and 1 whose coefficients are
    polynomials in z, and whose determinant has degree ten (Nister, PAMI 26(6), 2004). Up to ten of each
    sample.
    """
    rows = np.einsum("ski,skj->sijk", x2, x1).reshape(-1, 9, 5)
    N = np.ascontiguousarray(np.linalg.qr(rows, mode="complete")[0][:, :, 5:].swapaxes(1, 2))
    models = np.empty((10 * len(x1), 3, 3))
    return models[: _solve_each(N, _essential_constraints(N.reshape(-1, 4, 3, 3)), models.reshape(-1, 9))]


def _essential_constraints(E: F64) -> F64:
    """2 E E' E - tr(E E') E and det E (S, 10, 20) over ``_CUBIC`` of E0 to E3 (S, 4, 3, 3)."""
    squares = E[:, :, None] @ E[:, None].swapaxes(3, 4)
    squares = 2.0 * squares - np.trace(squares, axis1=3, axis2=4)[..., None, None] * np.eye(3)
    cubes = np.einsum("suvik,swkj->sijuvw", squares, E, optimize=True).reshape(-1, 9, 64)
    minors = np.cross(E[:, :, None, 1], E[:, None, :, 2])
    determinant = np.einsum("suvi,swi->suvw", minors, E[:, :, 0]).reshape(-1, 1, 64)
    return np.asarray(np.concatenate([cubes, determinant], axis=1) @ _ALL_CUBIC)


@kernel
def _solve_each(N: F64, A: F64, models: F64) -> int:
    """Fill models (M, 9) from null spaces (S, 4, 9) and constraints (S, 10, 20); their number."""
    B, c, back, roots, n = empty((3, 3, 5)), empty(11), empty(11), empty(11), 0
    for s in range(len(N)):
        if not _reduce(A[s]):
            continue
        _determinant_in_z(A[s], B, c)
        for k in range(11):
            back[k] = c[10 - k]
        for far in range(2):
            for k in range(roots_in_unit_interval(back if far else c, roots)):
                z = roots[k]
                if far and z == 0.0:
                    continue
                n += _essential_of_root(B, 1.0 / z if far else z, N[s], models[n])
    return n


@kernel
def _reduce(A: F64) -> bool:
    """Bring A (10, 20) to the form [I, *] by Gauss-Jordan elimination; False if it is singular."""
    for k in range(10):
        pivot = k
        for i in range(k + 1, 10):
            if abs(A[i, k]) > abs(A[pivot, k]):
                pivot = i
        if not abs(A[pivot, k]) > 1e-14:
            return False
        for j in range(k, 20):
            A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
        scale = 1.0 / A[k, k]
        for j in range(k, 20):
            A[k, j] *= scale
        for i in range(10):
            if i != k:
                factor = A[i, k]
                for j in range(k, 20):
                    A[i, j] -= factor * A[k, j]
    return True


@kernel
def _determinant_in_z(A: F64, B: F64, c: F64) -> None:
    """Fill the polynomials B (3, 3, 5) in z of x, y and 1, and c (11,) of their determinant."""
    # The rows x^2 z - z x^2, y^2 z - z y^2 and xyz - z xy of the reduced A have no other products of x and y.
    B[:] = 0.0
    c[:] = 0.0
    for i in range(3):
        high, low, first = A[4 + 2 * i], A[5 + 2 * i], 10
        for part in range(3):
            count = 4 if part == 2 else 3
            for k in range(count):
                B[i, part, count - 1 - k] += high[first + k]
                B[i, part, count - k] -= low[first + k]
            first += count
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for a in range(4):
            for b in range(4):
                minor = B[j, 0, a] * B[k, 1, b] - B[k, 0, a] * B[j, 1, b]
                for d in range(5):
                    c[a + b + d] += minor * B[i, 2, d]


@kernel
def _essential_of_root(B: F64, z: float, N: F64, out: F64) -> int:
    """Write E (9,) of a root z, of unit norm, if x and y follow from B (3, 3, 5); 1, or 0 if not."""
    M = empty((3, 3))
    for i in range(3):
        for part in range(3):
            M[i, part] = horner(B[i, part], z)[0]
    x, y, w = 0.0, 0.0, 0.0
    for i in range(3):
        a, b = M[i], M[(i + 1) % 3]
        third = a[0] * b[1] - a[1] * b[0]
        if abs(third) > abs(w):
            x, y, w = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], third
    if w == 0.0:
        return 0
    x, y, total = x / w, y / w, 0.0
    for m in range(9):
        out[m] = x * N[0, m] + y * N[1, m] + z * N[2, m] + N[3, m]
        total += out[m] ** 2
    for m in range(9):
        out[m] /= np.sqrt(total)
    return 1


def poses_from_essential(E: F64) -> tuple[F64, F64]:
    """Rotations (..., 4, 3, 3) and unit translations (..., 4, 3) with E ~ [t]x R (HZ 9.6.2)."""
    U, _, Vt = np.linalg.svd(E)
    U = U * np.linalg.det(U)[..., None, None]
    Vt = Vt * np.linalg.det(Vt)[..., None, None]
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    first, second, t = U @ W @ Vt, U @ W.T @ Vt, U[..., 2]
    return np.stack([first, first, second, second], axis=-3), np.stack([t, -t, t, -t], axis=-2)


def depths_of_matches(R: F64, t: F64, x1: F64, x2: F64) -> F64:
    """Depths (..., N, 2) in both cameras where the rays (N, 3) meet best, |d1 R x1 + t - d2 x2| least."""
    a = x1 @ np.swapaxes(R, -1, -2)
    aa, bb, ab = np.sum(a * a, axis=-1), np.sum(x2 * x2, axis=-1), np.sum(a * x2, axis=-1)
    at, bt = np.einsum("...na,...a->...n", a, t), np.einsum("na,...a->...n", x2, t)
    determinant = aa * bb - ab**2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.stack([ab * bt - bb * at, aa * bt - ab * at], axis=-1) / determinant[..., None])


def pose_in_front(E: F64, x1: F64, x2: F64) -> tuple[F64, F64, F64]:
    """R, t and depths (N, 2) of E that place most matches in front of both cameras (HZ 9.6.3)."""
    R, t = poses_from_essential(E)
    depths = depths_of_matches(R, t, x1, x2)
    best = int((depths > 0.0).all(axis=2).sum(axis=1).argmax())
    return R[best], t[best], depths[best]


def essential_from_pose(R: F64, t: F64) -> F64:
    """E = [t]x R."""
    return np.asarray(cross_matrix(t) @ R)


def poses_from_homography(H: F64) -> tuple[F64, F64, F64]:
    """R (S, 3, 3), t (S, 3) and unit normals n (S, 3) with H ~ R + t n', S = 4, or 1 with t = n = 0.

    H (3, 3) maps rays of the first camera to those of the second. From H'H = V diag(s1, 1, s3)^2 V' the two
    planes of directions whose length H keeps (Faugeras and Lustman, 1988; Ma et al., An Invitation to 3-D
    Vision, 5.3.3; Malis and Vargas, INRIA RR-6303, give the same solutions in closed form).
    """
    H = H / np.linalg.svd(H, compute_uv=False)[1]
    # det H = d2 / d1, the ratio of the distances of the plane.
    H = H * (np.sign(np.linalg.det(H)) or 1.0)
    _, s, Vt = np.linalg.svd(H)
    first, third = max(s[0] ** 2 - 1.0, 0.0), max(1.0 - s[2] ** 2, 0.0)
    if first + third < 1e-12:
        U, _, Vt = np.linalg.svd(H)
        return (U @ Vt)[None], np.zeros((1, 3)), np.zeros((1, 3))
    Rs, ts, normals = [], [], []
    v = Vt * np.linalg.det(Vt)
    for sign in (1.0, -1.0):
        u = (np.sqrt(third) * v[0] + sign * np.sqrt(first) * v[2]) / np.sqrt(first + third)
        n = np.cross(v[1], u)
        a, b = H @ v[1], H @ u
        R = np.stack([a, b, np.cross(a, b)], axis=1) @ np.stack([v[1], u, n])
        for side in (n, -n):
            Rs.append(R)
            ts.append((H - R) @ side)
            normals.append(side)
    return np.array(Rs), np.array(ts), np.array(normals)
