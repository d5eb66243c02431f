"""Homography between two images: robust estimate with inliers, noise and covariance (HZ, algorithm 4.6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import B8, F64
from thesisrecon.epipolar._frame import PairFrame
from thesisrecon.epipolar._noise import noise_width
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.conditioning import unit_norm
from thesisrecon.geometry.homography import (
    homography_linear,
    homography_residuals,
    homography_sampson_residuals,
)
from thesisrecon.optimize.least_squares import minimize_residuals
from thesisrecon.optimize.noise import VARIANCE_OF_INLIERS, next_inlier_limit

_SAMPLE, _PARAMETERS = 4, 8
_BATCH, _MAX_BATCHES, _SCORED = 128, 16, 1000
# Rounds to find the inliers.
_ROUNDS = 8
# Residuals in units of the frame below which they are rounding errors.
_EXACT = 1e-9
# Ratio of singular values of the equations below which they are dependent.
_DEPENDENT = 1e-9


@dataclass(frozen=True)
class HomographyFit:
    """A homography with its inliers and noise.

    Parameters
    ----------
    H, covariance : ndarray (3, 3), ndarray (9, 9)
        x2 ~ H x1, unit norm, and the covariance of its entries (row-major), rank 8.
    inliers, sigma_px : ndarray (N,) of bool, float
        Inliers, and the standard deviation of one image coordinate; for 4 matches it and the covariance are
        NaN.
    """

    H: F64
    inliers: B8
    sigma_px: float
    covariance: F64


def fit_homography(xy1: F64, xy2: F64, threshold_px: float | None, rng: Generator) -> HomographyFit:
    """Fit a homography; arguments as for :func:`thesisrecon.estimate_homography`."""
    if len(xy1) < _SAMPLE or min(np.ptp(xy1, axis=0).max(), np.ptp(xy2, axis=0).max()) == 0.0:
        raise _undetermined(f"{counted(len(xy1), 'match')}, at least 4 different ones are needed")
    frame = PairFrame.of(xy1, xy2)
    points, inliers = frame.points(xy1, xy2), np.ones(len(xy1), dtype=bool)
    if threshold_px is None:
        H, inverse = _refine(homography_linear(points[:, :2], points[:, 2:]), points)
    else:
        gate = threshold_px * frame.scale
        H = _search(points, gate, rng)
        for k in range(_ROUNDS):
            before = inliers
            r = homography_sampson_residuals(H, points[:, :2], points[:, 2:])
            distance = np.linalg.norm(r, axis=1)
            if k == 0:
                limit = max(noise_width(np.abs(r[:, 0]), gate, parameters=_PARAMETERS), gate)
            else:
                limit = next_inlier_limit(distance, inliers, limit, unknowns=_PARAMETERS)
            inliers = distance <= max(limit, _EXACT)
            if inliers.sum() < _SAMPLE:
                raise _undetermined(f"{inliers.sum()} of {len(points)} are within {threshold_px:g} px")
            if k > 0 and np.array_equal(inliers, before):
                break
            H, inverse = _refine(H, points[inliers])
    r = homography_sampson_residuals(H, points[inliers, :2], points[inliers, 2:])
    left = (r.size - _PARAMETERS) * (1.0 if threshold_px is None else VARIANCE_OF_INLIERS)
    sigma = float(np.sqrt(np.sum(r**2) / left)) if left else float("nan")
    h = frame.homography_to_pixels @ H.ravel()
    norm = np.linalg.norm(h)
    J = (np.eye(9) - np.outer(h, h) / norm**2) @ frame.homography_to_pixels / norm
    covariance = sigma**2 * J @ inverse @ J.T
    return HomographyFit(unit_norm(h.reshape(3, 3)), inliers, sigma / frame.scale, covariance)


def _undetermined(evidence: str) -> StageFailure:
    return StageFailure(
        "the matches do not determine a homography",
        evidence,
        "use four or more matches of one plane, or of a rotating camera, no three of them on one line",
    )


def _through_four(samples: F64) -> F64:
    """Homographies (B, 3, 3) of samples of four matches (B, 4, 4) in the frame."""
    one = np.ones((*samples.shape[:2], 1))
    x1, u, v = np.concatenate([samples[..., :2], one], axis=2), samples[..., 2:3], samples[..., 3:]
    zero = np.zeros_like(x1)
    rows = [np.concatenate([x1, zero, -u * x1], axis=2), np.concatenate([zero, x1, -v * x1], axis=2)]
    return np.asarray(np.linalg.svd(np.concatenate(rows, axis=1))[2][:, -1].reshape(-1, 3, 3))


def _search(points: F64, gate: float, rng: Generator) -> F64:
    """The homography of the samples with the least truncated squared distances in image 2."""
    n = len(points)
    scored = points[rng.choice(n, _SCORED, replace=False)] if n > _SCORED else points
    best, least, drawn = np.eye(3), np.inf, 0
    for _ in range(_MAX_BATCHES):
        samples = rng.random((_BATCH, n)).argpartition(_SAMPLE - 1, axis=1)[:, :_SAMPLE]
        H = _through_four(points[samples])
        squared = np.stack([homography_residuals(h, scored[:, :2], scored[:, 2:]) for h in H]) ** 2
        cost = np.minimum(squared / (2.0 * gate**2), 1.0).sum(axis=1)
        drawn += _BATCH
        if cost.min() < least:
            least, best = float(cost.min()), H[cost.argmin()]
        share = 1.0 - least / len(scored)
        if drawn * np.log1p(-min(share**_SAMPLE, 1.0 - 1e-9)) < np.log(1e-4):
            break
    return best


def _refine(H: F64, points: F64) -> tuple[F64, F64]:
    """H of least Sampson distances of matches (n, 4), and the inverse (9, 9) of its information."""
    start = H.ravel() / np.linalg.norm(H)
    tangent = np.linalg.svd(start[None])[2][1:]

    def residuals(x: F64) -> F64:
        moved = (start + x @ tangent).reshape(3, 3)
        return homography_sampson_residuals(moved, points[:, :2], points[:, 2:]).ravel()

    # Steps that send points to infinity are rejected.
    with np.errstate(all="ignore"):
        found = minimize_residuals(residuals, np.zeros(_PARAMETERS))
        steps = 1e-6 * np.eye(_PARAMETERS)
        J = np.stack([residuals(found.x + e) - residuals(found.x - e) for e in steps], axis=1) / 2e-6
    end = start + found.x @ tangent
    s, Vt = np.linalg.svd(np.nan_to_num(J), full_matrices=False)[1:]
    if not s[-1] > _DEPENDENT * s[0]:
        raise _undetermined(f"the equations of {counted(len(points), 'match')} have rank below 8")
    half = tangent.T @ (Vt.T / s)
    return end.reshape(3, 3), half @ half.T
