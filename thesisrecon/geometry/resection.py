"""Section 6.4: camera resection, linear (DLT) and, for a calibrated camera, from three points (P3P)."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64, I64, require_finite
from thesisrecon.geometry.conditioning import normalizing_transform


def resect_linear(X: F64, xy: F64) -> F64:
    """Unit cameras of least algebraic residual (DLT) of points X (..., M, 4) and xy (..., M, 2), M >= 6.

    Best with whitened unit vectors X. Coplanar points do not determine the camera; one of the solutions
    results.
    """
    if X.shape[-2] < 6:
        raise ValueError(f"resect_linear needs at least 6 points; got {X.shape[-2]}")
    require_finite("resect_linear", X, xy)
    flat = xy.reshape(-1, 2)
    T = normalizing_transform(flat)
    conditioned = xy * T[0, 0] + T[:2, 2]
    # Rows u p3'X - p1'X and v p3'X - p2'X.
    zero = np.zeros_like(X)
    first = np.concatenate([-X, zero, conditioned[..., :1] * X], axis=-1)
    second = np.concatenate([zero, -X, conditioned[..., 1:] * X], axis=-1)
    A = np.concatenate([first, second], axis=-2)
    p = np.linalg.eigh(A.swapaxes(-1, -2) @ A)[1][..., 0]
    P = np.linalg.inv(T) @ p.reshape(*p.shape[:-1], 3, 4)
    return np.asarray(P / np.linalg.norm(P, axis=(-2, -1), keepdims=True))


def pose_from_three_points(X: F64, rays: F64) -> tuple[F64, F64, I64]:
    """All poses R, t that see three points X (B, 3, 3) along unit rays (B, 3, 3), and their samples (P3P).

    With side lengths a = |X2 - X3|, b = |X1 - X3|, c = |X1 - X2| and the angles between the rays, the ratio v
    = s3 / s1 of the distances is a root of Grunert's quartic: up to four poses a sample (Haralick et al.,
    IJCV 13(3), 1994).
    """
    a2, b2, c2 = (np.sum((X[:, i] - X[:, j]) ** 2, axis=1) for i, j in ((1, 2), (0, 2), (0, 1)))
    ca, cb, cc = (np.sum(rays[:, i] * rays[:, j], axis=1) for i, j in ((1, 2), (0, 2), (0, 1)))
    with np.errstate(divide="ignore", invalid="ignore"):
        q = (a2 - c2) / b2
        c_b, a_b = c2 / b2, a2 / b2
        # Quartic in v = s3/s1: A4 v^4 + ... + A0 (Haralick et al., eq. for Grunert's method).
        A4 = (q - 1) ** 2 - 4 * c_b * ca**2
        A3 = 4 * (q * (1 - q) * cb - (1 - (a2 + c2) / b2) * ca * cc + 2 * c_b * ca**2 * cb)
        A2 = 2 * (
            q**2 - 1 + 2 * q**2 * cb**2 + 2 * (1 - c_b) * ca**2 - 4 * (a2 + c2) / b2 * ca * cb * cc
            + 2 * (1 - a_b) * cc**2
        )  # fmt: skip
        A1 = 4 * (-q * (1 + q) * cb + 2 * a_b * cc**2 * cb - (1 - (a2 + c2) / b2) * ca * cc)
        A0 = (1 + q) ** 2 - 4 * a_b * cc**2
    v, sample = _real_quartic_roots(np.stack([A4, A3, A2, A1, A0], axis=1))
    X, rays, q, b2, ca, cb, cc = (array[sample] for array in (X, rays, q, b2, ca, cb, cc))
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((q - 1) * v**2 - 2 * q * cb * v + 1 + q) / (2 * (cc - v * ca))
        s1 = np.sqrt(b2 / (1 + v**2 - 2 * v * cb))
    Y = np.stack([s1, u * s1, v * s1], axis=1)[:, :, None] * rays
    good = np.isfinite(Y).all(axis=(1, 2)) & (u > 0)
    X, Y, sample = X[good], Y[good], sample[good]
    R = _triad(Y) @ _triad(X).swapaxes(1, 2)
    t = Y.mean(axis=1) - np.einsum("bij,bj->bi", R, X.mean(axis=1))
    # The triads of points on one line, as of equal rays, are no bases.
    proper = np.linalg.det(R) > 0.5
    return R[proper], t[proper], sample[proper]


def _real_quartic_roots(c: F64) -> tuple[F64, I64]:
    """Positive real roots of quartics c (B, 5), highest power first, with the row they come from."""
    good = np.isfinite(c).all(axis=1) & (np.abs(c[:, 0]) > 1e-12 * np.abs(c).max(axis=1, initial=1e-300))
    companion = np.zeros((len(c), 4, 4))
    companion[:, [1, 2, 3], [0, 1, 2]] = 1.0
    companion[good, 0] = -c[good, 1:] / c[good, :1]
    roots = np.linalg.eigvals(companion)
    real = good[:, None] & (np.abs(roots.imag) < 1e-4 * (1.0 + np.abs(roots.real))) & (roots.real > 0)
    sample, which = np.nonzero(real)
    return np.asarray(roots.real[sample, which], dtype=np.float64), sample.astype(np.int64)


def _triad(X: F64) -> F64:
    """Orthonormal columns (B, 3, 3) that follow a triangle."""
    first = X[:, 1] - X[:, 0]
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-300)
    third = np.cross(first, X[:, 2] - X[:, 0])
    third /= np.maximum(np.linalg.norm(third, axis=1, keepdims=True), 1e-300)
    return np.stack([first, np.cross(third, first), third], axis=2)
