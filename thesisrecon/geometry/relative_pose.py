"""Relative poses of calibrated cameras: five points, essential matrices and homographies taken apart."""

from itertools import product

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import cross_matrix

# Products of the unknowns (x, y, z, 1), those of degree three first.
_CUBIC = ("000", "001", "002", "011", "012", "022", "111", "112", "122", "222",
          "003", "013", "023", "113", "123", "223", "033", "133", "233", "333")  # fmt: skip
_ALL_CUBIC = np.array(
    [["".join(sorted(each)) == name for name in _CUBIC] for each in product("0123", repeat=3)], np.float64
)


def essential_five_points(x1: F64, x2: F64) -> F64:
    """Essential matrices (B', 3, 3) of samples of five matches, rays (B, 5, 3) each, of unit norm.

    E = x E0 + y E1 + z E2 + E3 in the null space of the five equations; det E = 0 and 2 E E' E = tr(E E') E
    are ten cubic equations. They express the products of degree three by the other ten, whose values at a
    solution are an eigenvector of the matrix that multiplies by x (Stewenius, Engels and Nister, 2006). Up to
    ten of each sample.
    """
    rows = np.einsum("ski,skj->sijk", x2, x1).reshape(-1, 9, 5)
    N = np.ascontiguousarray(np.linalg.qr(rows, mode="complete")[0][:, :, 5:].swapaxes(1, 2))
    basis = N.reshape(-1, 4, 3, 3)
    squares = basis[:, :, None] @ basis[:, None].swapaxes(3, 4)
    squares = 2.0 * squares - np.trace(squares, axis1=3, axis2=4)[..., None, None] * np.eye(3)
    cubes = np.einsum("suvik,swkj->sijuvw", squares, basis, optimize=True).reshape(-1, 9, 64)
    minors = np.cross(basis[:, :, None, 1], basis[:, None, :, 2])
    determinant = np.einsum("suvi,swi->suvw", minors, basis[:, :, 0]).reshape(-1, 1, 64)
    A = np.concatenate([cubes, determinant], axis=1) @ _ALL_CUBIC
    regular = np.isfinite(A).all(axis=(1, 2)) & (np.linalg.det(A[:, :, :10]) != 0.0)
    A, N = A[regular], N[regular]
    by_x = np.zeros((len(A), 10, 10))
    by_x[:, :6] = -np.linalg.solve(A[:, :, :10], A[:, :, 10:])[:, :6]
    by_x[:, [6, 7, 8, 9], [0, 1, 2, 6]] = 1.0
    values, vectors = np.linalg.eig(by_x)
    sample, which = np.nonzero(values.imag == 0.0)
    E = np.einsum("sk,skm->sm", vectors[sample, 6:, which].real, N[sample])
    return np.asarray((E / np.linalg.norm(E, axis=1, keepdims=True)).reshape(-1, 3, 3))


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
