"""Robust resection of a projective camera (6.4), and tests whether it is determined and right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import B8, F64
from thesisrecon.geometry.homogeneous import whitening_transform
from thesisrecon.geometry.resection import resect_linear
from thesisrecon.geometry.two_view import fundamental_from_cameras, sampson_residuals
from thesisrecon.records import TwoView

_SAMPLE = 6
_BATCH, _MAX_BATCHES = 64, 12


def resect_ransac(X: F64, xy: F64, *, threshold_px: float, rng: Generator) -> tuple[F64 | None, B8]:
    """Resect a camera by RANSAC over six-point samples with a truncated-quadratic score (6.4; HZ 7.1).

    Samples are drawn in batches until one without outliers was drawn with probability 0.999. Points X (M, 4)
    are signed so that depths have one sign; those of the other sign are outliers. Returns the camera of the
    inliers with positive depths, None below six of them, and the inliers (M,).
    """
    none = np.zeros(len(X), dtype=bool)
    if len(X) < _SAMPLE:
        return None, none
    # The points of one view may fill a corner of the frame: whitening keeps all digits.
    M = whitening_transform(X)
    Y = X @ M.T
    Y /= np.maximum(np.linalg.norm(Y, axis=1, keepdims=True), 1e-300)
    best_cost, best, drawn = np.inf, None, 0
    scored = rng.choice(len(Y), 1000, replace=False) if len(Y) > 1000 else np.arange(len(Y))
    for _ in range(_MAX_BATCHES):
        samples = rng.random((_BATCH, len(Y))).argpartition(_SAMPLE - 1, axis=1)[:, :_SAMPLE]
        P = resect_linear(Y[samples], xy[samples])
        P = np.concatenate([P, -P])
        squared = _squared_residuals(P, Y[scored], xy[scored]) / threshold_px**2
        cost = np.minimum(squared, 1.0).sum(axis=1)
        drawn += _BATCH
        if cost.min() < best_cost:
            best_cost, best = float(cost.min()), P[cost.argmin()]
        share = 1.0 - best_cost / len(scored)
        if drawn * np.log1p(-min(share**_SAMPLE, 1 - 1e-9)) < np.log(1e-3):
            break
    if best is None:
        return None, none
    found, inlier = _refit(best, Y, xy, threshold_px)
    return (None if found is None else found @ M), inlier


def _refit(P: F64, X: F64, xy: F64, threshold_px: float) -> tuple[F64 | None, B8]:
    """Estimate the camera again from its inliers, twice."""
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
    """Return squared reprojection residuals (B, M), inf on or behind the principal plane."""
    xh = np.einsum("bij,mj->bmi", P, X)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        squared = np.sum((xh[..., :2] / xh[..., 2:] - xy) ** 2, axis=-1)
    return np.where((xh[..., 2] > 0) & np.isfinite(squared), squared, np.inf)


def projection_std_px(P: F64, covariance: F64, X: F64) -> F64:
    """Return the standard deviations (N,) px of projections under the covariance (12, 12) of a camera.

    The root of half the trace of J C J'; inf near the principal plane.
    """
    xh = X @ P.T
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = xh[:, :2] / xh[:, 2:]
        A = X / xh[:, 2:]
    blocks = covariance.reshape(3, 4, 3, 4)
    quadratic = np.einsum("na,rasb,nb->nrs", A, blocks, A)
    var_u = quadratic[:, 0, 0] - 2 * uv[:, 0] * quadratic[:, 0, 2] + uv[:, 0] ** 2 * quadratic[:, 2, 2]
    var_v = quadratic[:, 1, 1] - 2 * uv[:, 1] * quadratic[:, 1, 2] + uv[:, 1] ** 2 * quadratic[:, 2, 2]
    spread = np.sqrt(np.maximum((var_u + var_v) / 2.0, 0.0))
    return np.where(np.isfinite(spread), spread, np.inf)


def find_inconsistent_view(
    P: F64, registered: B8, pairs: Sequence[TwoView], *, threshold_px: float, min_ratio: float
) -> tuple[int, float] | None:
    """Return the view that agrees least with the verified matches of its pairs, and its inlier ratio.

    An inlier is within ``threshold_px`` (Sampson) of the F of the two cameras. None if all views reach
    ``min_ratio``. One view at a time: a wrong camera also lowers the ratios of its partners.
    """
    total, agreed = np.zeros(len(P)), np.zeros(len(P))
    for pair in pairs:
        if not (pair.accepted and registered[pair.i] and registered[pair.j]):
            continue
        try:
            F = fundamental_from_cameras(P[pair.i], P[pair.j])
        except ValueError:  # one camera centre
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.abs(sampson_residuals(F, pair.xy1, pair.xy2))
        total[[pair.i, pair.j]] += pair.inliers
        agreed[[pair.i, pair.j]] += float(np.mean(distance < threshold_px)) * pair.inliers
    share_of_view = np.where(total > 0, agreed / np.maximum(total, 1.0), 1.0)
    worst = int(np.argmin(share_of_view))
    return (worst, float(share_of_view[worst])) if share_of_view[worst] < min_ratio else None
