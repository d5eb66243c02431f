"""Section 6.3.3: the polynomial method, optimal triangulation from two views (Hartley and Sturm 1997).

The pair of points nearest to the measured one that satisfies the epipolar constraint is the best of at most
six stationary points of a one-parameter cost over the epipolar planes, the roots of a polynomial of degree 6.

All epipolar planes are q0 A + q1 B; their lines in the two images are L1 q and L2 q, L (3, 2). The distance
of x = (x, y, 1) from a line is the root of n^2 / (q'Bq) with n = (x'L) q linear in q and B = L[:2]'L[:2] of
the pair alone, so that a point enters by four numbers. The line through the point and its B-orthogonal
companion replace the rotated images of the paper, so that epipoles may be at infinity.
"""

import numpy as np

from thesisrecon.arrays import F64, checked, require_finite, require_shapes
from thesisrecon.geometry.homogeneous import checked_unit, cross_matrix
from thesisrecon.geometry.triangulation import polynomial_roots, sort_by_point, triangulate_linear
from thesisrecon.geometry.two_view import fundamental_from_cameras

_RANK = 1e-13  # singular values below this fraction of the largest are zero


def _dot(a: F64, b: F64) -> F64:
    # A sum of two products without fused operations: the line through a point has exactly n = 0.
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1])


def _form(M: F64, p: F64, q: F64) -> F64:
    """p'Bq of the last axes with B = M'M."""
    return _dot(np.einsum("...ab,...b->...a", M, p), np.einsum("...ab,...b->...a", M, q))


def _best_of_pencil(l: F64, M: F64) -> F64:
    """Members q (N, 2) of least sum of n^2 / |M q|^2 over the images; n = l . q, l (2, N, 2), M (2, 2, 2).

    q = q0 + h x p is counted from the line q0 through the point of one image, p B-orthogonal to it. The cost
    G x^2 / (1 + kappa x^2) + (n0 + n1 x)^2 / (E0 + 2 E1 x + E2 x^2) is stationary at roots of a polynomial.
    """
    rows, through = np.arange(l.shape[1]), np.stack([l[..., 1], -l[..., 0]], axis=-1)
    Q, D = _form(M[:, None], through, through), np.linalg.det(M) ** 2
    # Q / D is the squared distance of a point from its epipole: the farther one gives the narrower sector.
    own = np.where((Q[0] * D[1] > Q[1] * D[0]) | (not D.any()), 0, 1)
    most = np.min(_dot(l[1], through[0]) ** 2 / _form(M[::-1, None], through, through), axis=0)
    q, other, E, Q, D = through[own, rows], l[1 - own, rows], M[1 - own], Q[own, rows], D[own]
    p = np.einsum("nab,nac,nc->nb", M[own], M[own], q)[:, ::-1] * [1.0, -1.0]
    # The lines within the root of the bound `most` of the point, or those within 45 degrees.
    h = np.sqrt(np.where(Q - most * D > 0.5 * Q, most / (Q - most * D), 1.0 / D))
    n0, n1, G, kappa = _dot(other, q), h * _dot(other, p), Q * h * h, D * h * h
    E0, E1, E2 = _form(E, q, q), h * _form(E, q, p), h * h * _form(E, p, p)
    m0, m1 = n1 * E0 - n0 * E1, n1 * E1 - n0 * E2
    s0, s1, s2 = n0 * m0, n0 * m1 + n1 * m0, n1 * m1
    derivative = [
        kappa * kappa * s2,
        kappa * kappa * s1 + G * E2 * E2,
        2.0 * kappa * s2 + kappa * kappa * s0 + 4.0 * G * E1 * E2,
        2.0 * kappa * s1 + G * (4.0 * E1 * E1 + 2.0 * E0 * E2),
        s2 + 2.0 * kappa * s0 + 4.0 * G * E0 * E1,
        s1 + G * E0 * E0,
        s0,
    ]
    x = polynomial_roots(np.stack(derivative, axis=1)).real
    w = 1.0 / (1.0 + np.abs(x))
    found = w[..., None] * q[:, None] + (w * h[:, None] * x)[..., None] * p[:, None]
    # Exact matches, and points on epipoles, through which every line goes.
    always = np.concatenate([through, np.broadcast_to([1.0, 0.0], (1, len(rows), 2))]).swapaxes(0, 1)
    tried = np.concatenate([always, found], axis=1)
    cost = np.sum(_dot(l[:, :, None], tried) ** 2 / _form(M[:, None, None], tried, tried), axis=0)
    return np.asarray(tried[rows, np.nan_to_num(cost, nan=np.inf).argmin(axis=1)])


def _conditioning(xy: F64) -> tuple[float, F64, F64]:
    """Scale (one for both views), centre (2, 2) and the transforms (2, 3, 3) to ``scale (x - centre)``."""
    scale, centre, T = 1.0, np.zeros((2, 2)), np.zeros((2, 3, 3))
    if xy.size:
        centre = xy.mean(axis=1)
        spread = float(np.abs(xy - centre[:, None]).max())
        scale = 1.0 / spread if spread > 0.0 else 1.0
    T[:, 0, 0] = T[:, 1, 1] = scale
    T[:, :2, 2] = -scale * centre
    T[:, 2, 2] = 1.0
    return scale, centre, T


def correct_matches(F: F64, xy1: F64, xy2: F64) -> tuple[F64, F64]:
    """Move matches to the nearest pairs with x2' F x1 = 0: least sum of squared distances.

    The minimum is global. A match with a point on its epipole is exact with every partner and is not moved.
    """
    F, xy1, xy2 = checked("correct_matches", F=(F, (3, 3)), xy1=(xy1, ("N", 2)), xy2=(xy2, ("N", 2)))
    F = checked_unit(F, "correct_matches")
    xy = np.stack([xy1, xy2])
    scale, centre, T = _conditioning(xy)
    back = np.linalg.inv(T)
    U, s, Vt = np.linalg.svd(back[1].T @ F @ back[0])
    if not s[1] > _RANK * s[0]:
        raise ValueError("correct_matches needs an F of rank 2; got one of rank 1")
    lines1 = Vt[:2].T
    lines2 = (U[:, :2] * s[:2]) @ Vt[:2] @ cross_matrix(Vt[2]) @ lines1
    L = np.stack([lines1, lines2])
    # A basis of the pencil in which both images weigh the same.
    B = np.einsum("vka,vkb->vab", L[:, :2], L[:, :2])
    traces = np.maximum(np.trace(B, axis1=1, axis2=2), 1e-300)
    values, basis = np.linalg.eigh((B / traces[:, None, None]).sum(axis=0))
    L = L @ (basis / np.sqrt(np.maximum(values, _RANK * values[1])))
    moved = (xy - centre[:, None]) * scale
    lines = moved @ L[:, :2] + L[:, 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        q = _best_of_pencil(lines, L[:, :2])
    across, n = np.einsum("vca,na->vnc", L[:, :2], q), _dot(lines, q)
    moved -= (n / np.where(n == 0.0, 1.0, _dot(across, across)))[..., None] * across
    moved = moved / scale + centre[:, None]
    return moved[0], moved[1]


def triangulate_polynomial(P: F64, xy: F64) -> F64:
    """Triangulate xy (2, N, 2) optimally from two views (6.3.3): unit points (N, 4); zeros where xy is NaN.

    The sum of squared reprojection errors is the global minimum in any frame. A match whose nearest exact
    pair has one point on an epipole gives the centre of the other camera; both, some point of the baseline.
    """
    if P.shape != (2, 3, 4):
        raise ValueError(f'the polynomial method needs exactly two cameras, not {len(P)}; use "optimal"')
    require_shapes("triangulate_polynomial", xy=(xy, (2, "N", 2)))
    require_finite("triangulate_polynomial", P)
    seen = np.isfinite(xy).all(axis=(0, 2))
    T = _conditioning(xy[:, seen])[2]
    conditioned = T @ P
    size = np.linalg.norm(conditioned, axis=(1, 2), keepdims=True)
    stacked = (conditioned / np.where(size > 0.0, size, 1.0)).reshape(6, 4)
    columns = np.linalg.norm(stacked, axis=0)
    U, s, _ = np.linalg.svd(stacked / np.where(columns > 0.0, columns, 1.0), full_matrices=False)
    if not s[3] > _RANK * s[0]:
        raise ValueError("the polynomial method needs two cameras with different centres")
    # In a frame of space with Q1'Q1 + Q2'Q2 = I, the eigenvalues of Q2'Q2 of the centres are 0 and 1.
    Q = U.reshape(2, 3, 4)
    values = np.linalg.eigvalsh(Q[1].T @ Q[1])
    if not (values[1] > _RANK and 1.0 - values[2] > _RANK):
        raise ValueError("the polynomial method needs cameras of rank 3")
    moved = np.full_like(xy, np.nan)
    moved[:, seen] = correct_matches(T[1].T @ fundamental_from_cameras(*Q) @ T[0], *xy[:, seen])
    return triangulate_linear(P, sort_by_point(moved), 0)
