"""Section 6.3.3: the polynomial method, the optimal triangulation from two views.

Hartley and Sturm, "Triangulation", CVIU 68(2), 1997: the pair of points nearest to the measured one that
satisfies the epipolar constraint is the best of at most six stationary points of a one-parameter cost, the
roots of a polynomial of degree 6. Their rays meet exactly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.homogeneous import require_finite, unit_of

F64 = NDArray[np.float64]


def correct_matches(F: F64, xy1: F64, xy2: F64) -> tuple[F64, F64]:
    """Nearest pairs with x2' F x1 = 0 to measured pairs (N, 2), (N, 2): least sum of squared distances.

    F (3, 3) of rank 2. Every stationary point is tried, infinity included, so the minimum is global. Raises
    ``ValueError`` for a zero F and numbers that are not finite.
    """
    require_finite("correct_matches", xy1, xy2)
    F = unit_of(F, "correct_matches")
    E1, e1 = _to_origin_and_axis(xy1, np.linalg.svd(F)[2][2])
    E2, e2 = _to_origin_and_axis(xy2, np.linalg.svd(F)[0][:, 2])
    G = np.linalg.inv(E2).swapaxes(1, 2) @ F @ np.linalg.inv(E1)
    f, g = e1, e2
    a, b, c, d = G[:, 1, 1], G[:, 1, 2], G[:, 2, 1], G[:, 2, 2]
    size = np.maximum(np.sqrt(a**2 + b**2 + c**2 + d**2), 1e-300)
    a, b, c, d = a / size, b / size, c / size, d / size
    t = _stationary_points(a, b, c, d, f, g)
    cost = _cost(t, a, b, c, d, f, g)
    best = np.take_along_axis(t, cost.argmin(axis=1)[:, None], axis=1)[:, 0]
    at_infinity = np.isinf(best)
    s = np.where(at_infinity, 0.0, best)
    one = np.where(at_infinity, 0.0, 1.0)
    s = np.where(at_infinity, 1.0, s)
    line1 = np.stack([s * f, one, -s], axis=1)
    line2 = np.stack([-g * (c * s + d * one), a * s + b * one, c * s + d * one], axis=1)
    return _foot(E1, line1), _foot(E2, line2)


def _to_origin_and_axis(xy: F64, epipole: F64) -> tuple[F64, F64]:
    """Rigid motions (N, 3, 3) that take each point to the origin and the epipole to (1, 0, f); and f (N,)."""
    n = len(xy)
    T = np.tile(np.eye(3), (n, 1, 1))
    T[:, :2, 2] = -xy
    e = np.einsum("nij,j->ni", T, epipole)
    e /= np.maximum(np.hypot(e[:, 0], e[:, 1]), 1e-300)[:, None]
    R = np.tile(np.eye(3), (n, 1, 1))
    R[:, 0, 0] = R[:, 1, 1] = e[:, 0]
    R[:, 0, 1], R[:, 1, 0] = e[:, 1], -e[:, 1]
    return R @ T, e[:, 2]


def _stationary_points(a: F64, b: F64, c: F64, d: F64, f: F64, g: F64) -> F64:
    """Real parts of the roots of g(t) (methods 6.3.3) and infinity; (N, 7)."""
    p = np.stack([a**2 + g**2 * c**2, 2 * (a * b + g**2 * c * d), b**2 + g**2 * d**2], axis=1)
    q = np.stack([f**4, np.zeros_like(f), 2 * f**2, np.zeros_like(f), np.ones_like(f)], axis=1)
    r = (a * d - b * c)[:, None] * np.stack([a * c, a * d + b * c, b * d], axis=1)
    first = np.concatenate([_product(p, p), np.zeros((len(a), 1))], axis=1)
    coefficients = -_product(q, r)
    coefficients[:, 1:] += first
    return np.column_stack([_roots(coefficients), np.full(len(a), np.inf)])


def _product(p: F64, q: F64) -> F64:
    out = np.zeros((len(p), p.shape[1] + q.shape[1] - 1))
    for i in range(p.shape[1]):
        out[:, i : i + q.shape[1]] += p[:, i : i + 1] * q
    return out


def _roots(c: F64) -> F64:
    """Real parts of all roots of polynomials c (N, 7), highest power first.

    A vanishing leading coefficient sends roots to infinity, which the reversed polynomial shows as zeros.
    """
    n = c.shape[1] - 1
    reverse = np.abs(c[:, 0]) < np.abs(c[:, -1])
    ordered = np.where(reverse[:, None], c[:, ::-1], c)
    lead = np.where(ordered[:, :1] == 0, 1e-300, ordered[:, :1])
    companion = np.zeros((len(c), n, n))
    companion[:, np.arange(1, n), np.arange(n - 1)] = 1.0
    companion[:, 0] = np.clip(-ordered[:, 1:] / lead, -1e150, 1e150)
    roots = np.linalg.eigvals(companion)
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = np.where(reverse[:, None], 1.0 / roots, roots)
    return np.where(np.isfinite(roots.real), roots.real, 0.0)


def _cost(t: F64, a: F64, b: F64, c: F64, d: F64, f: F64, g: F64) -> F64:
    a, b, c, d, f, g = (v[:, None] for v in (a, b, c, d, f, g))
    finite = np.where(np.isinf(t), 0.0, t)
    with np.errstate(divide="ignore", invalid="ignore"):
        cost = finite**2 / (1 + f**2 * finite**2) + (c * finite + d) ** 2 / (
            (a * finite + b) ** 2 + g**2 * (c * finite + d) ** 2
        )
        limit = 1 / f**2 + c**2 / (a**2 + g**2 * c**2)
    return np.nan_to_num(np.where(np.isinf(t), limit, cost), nan=np.inf)


def _foot(E: F64, line: F64) -> F64:
    """Nearest point of each line to the origin, moved back; (N, 2)."""
    u, v, w = line.T
    foot = np.stack([-u * w, -v * w, u**2 + v**2], axis=1)
    back = np.einsum("nij,nj->ni", np.linalg.inv(E), foot)
    return np.asarray(back[:, :2] / back[:, 2:], dtype=np.float64)
