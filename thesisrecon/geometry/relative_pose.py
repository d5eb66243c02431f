"""Relative poses of calibrated cameras: five points, essential matrices and homographies taken apart."""

from __future__ import annotations

from itertools import combinations_with_replacement, product

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import cross_matrix, unit_norm

# Monomials of degree 3 in (x, y, z, 1): first those of degree 3 in x, y, z alone.
_MONOMIALS: list[tuple[int, ...]] = sorted(
    combinations_with_replacement(range(4), 3), key=lambda m: (m.count(3), m)
)
_OF_PRODUCT = np.array([_MONOMIALS.index(tuple(sorted(m))) for m in product(range(4), repeat=3)])
_COLLECT = np.eye(20)[_OF_PRODUCT]
# Where x times each of the lower monomials stands.
_TIMES_X = np.array([_MONOMIALS.index((*sorted((0, *m[:2])),)) for m in _MONOMIALS[10:]])


def essential_five_points(x1: F64, x2: F64) -> F64:
    """Essential matrices (B', 3, 3) of samples of five matches, rays (B, 5, 3) each, of unit norm.

    E = x E0 + y E1 + z E2 + E3 in the null space of the five equations; det E = 0 and 2 E E' E = tr(E E') E
    are ten cubic equations (Nister, PAMI 26(6), 2004), whose solutions are the eigenvectors of the
    multiplication by x (Stewenius, Engels and Nister, ISPRS 60, 2006). Up to ten of each sample.
    """
    rows = (x2[:, :, :, None] * x1[:, :, None, :]).reshape(len(x1), 5, 9)
    E = np.linalg.svd(rows)[2][:, 5:].reshape(-1, 4, 3, 3)
    square = np.einsum("biac,bjdc->bijad", E, E)
    trace = np.einsum("bijaa->bij", square)
    cubic = 2.0 * np.einsum("bijac,bkcd->badijk", square, E) - np.einsum("bij,bkad->badijk", trace, E)
    minors = np.cross(E[:, :, None, 1], E[:, None, :, 2])
    determinant = np.einsum("bia,bjka->bijk", E[:, :, 0], minors)
    A = np.concatenate([determinant[:, None], cubic.reshape(-1, 9, 4, 4, 4)], axis=1)
    A = A.reshape(-1, 10, 64) @ _COLLECT
    good = np.linalg.cond(A[:, :, :10]) < 1e14
    A, E = A[good], E[good]
    # Each monomial in terms of the ten lower ones.
    unit = np.broadcast_to(np.eye(10), (len(A), 10, 10))
    lower = np.concatenate([-np.linalg.solve(A[:, :, :10], A[:, :, 10:]), unit], axis=1)
    values, vectors = np.linalg.eig(lower[:, _TIMES_X])
    sample, root = np.nonzero(np.abs(values.imag) < 1e-9 * (1.0 + np.abs(values)))
    v = vectors[sample, :, root].real
    # The last four lower monomials are x, y, z and 1.
    return unit_norm(np.einsum("sk,skab->sab", v[:, 6:], E[sample]))


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
