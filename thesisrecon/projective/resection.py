"""Section 6.4, robust: the camera that most points of the model agree with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.resection import resect_linear
from thesisrecon.optimize.conditioning import whitening_transform
from thesisrecon.types import B8

F64 = NDArray[np.float64]

_SAMPLE = 6


def resect_robust(
    X: F64, xy: F64, *, threshold_px: float, rng: np.random.Generator, batch: int = 64, max_batches: int = 12
) -> tuple[F64 | None, B8]:
    """RANSAC over six-point samples with a truncated-quadratic score; X (M, 4), xy (M, 2) px.

    The signs of X must be such that their depths have one sign; points of the other one count as outliers.
    Samples are drawn and solved a batch at a time; it stops when a sample free of outliers has been drawn
    with probability 0.999 at the best inlier share so far. Returns the camera of the best sample
    re-estimated from its inliers, depths positive (None where there are fewer than six), and the inliers
    (M,).
    """
    none = np.zeros(len(X), dtype=bool)
    if len(X) < _SAMPLE:
        return None, none
    # The points of one view may crowd in a corner of the model's frame: whitened anew, no digits are lost.
    M = whitening_transform(X)
    Y = X @ M.T
    Y /= np.maximum(np.linalg.norm(Y, axis=1, keepdims=True), 1e-300)
    best_cost, best, drawn = np.inf, None, 0
    scored = rng.choice(len(Y), 1000, replace=False) if len(Y) > 1000 else np.arange(len(Y))
    for _ in range(max_batches):
        samples = rng.random((batch, len(Y))).argpartition(_SAMPLE - 1, axis=1)[:, :_SAMPLE]
        P = resect_linear(Y[samples], xy[samples])
        P = np.concatenate([P, -P])
        squared = _squared_residuals(P, Y[scored], xy[scored]) / threshold_px**2
        cost = np.minimum(squared, 1.0).sum(axis=1)
        drawn += batch
        if cost.min() < best_cost:
            best_cost, best = float(cost.min()), P[cost.argmin()]
        share = 1.0 - best_cost / len(scored)
        if drawn * np.log1p(-min(share**_SAMPLE, 1 - 1e-9)) < np.log(1e-3):
            break
    if best is None:
        return None, none
    found, inlier = _polish(best, Y, xy, threshold_px)
    return (None if found is None else found @ M), inlier


def _polish(P: F64, X: F64, xy: F64, threshold_px: float) -> tuple[F64 | None, B8]:
    inlier = _squared_residuals(P[None], X, xy)[0] < threshold_px**2
    for _ in range(2):
        if inlier.sum() < _SAMPLE:
            return None, inlier
        candidate = resect_linear(X[inlier], xy[inlier])
        candidate *= np.sign(np.median(X[inlier] @ candidate[2])) or 1.0
        support = _squared_residuals(candidate[None], X, xy)[0] < threshold_px**2
        if support.sum() < inlier.sum():
            break
        P, inlier = candidate, support
    return P, inlier


def _squared_residuals(P: F64, X: F64, xy: F64) -> F64:
    """(B, M) squared reprojection residuals, infinite for a point on or behind the principal plane."""
    xh = np.einsum("bij,mj->bmi", P, X)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        squared = np.sum((xh[..., :2] / xh[..., 2:] - xy) ** 2, axis=-1)
    return np.where((xh[..., 2] > 0) & np.isfinite(squared), squared, np.inf)
