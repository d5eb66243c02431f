"""Section 6.4: cameras from points of which some are wrong: RANSAC, refinement, noise and covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import B8, F64
from thesisrecon.camera import compose_camera, decompose_camera
from thesisrecon.errors import Notice, StageFailure, counted
from thesisrecon.geometry.camera_matrix import depth, project
from thesisrecon.geometry.conditioning import centred_frame, whitening_transform
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.triangulation import pose_from_three_points, resect_linear
from thesisrecon.optimize.bundle.partial import refine_camera, refine_pose
from thesisrecon.optimize.noise import VARIANCE_OF_INLIERS, next_inlier_limit

_SAMPLE = 6
_BATCH, _MAX_BATCHES = 64, 12
# Three-point samples of one camera.
_SAMPLES = 300
# Search threshold if all points are inliers.
_ANY_PX = 1e4
# Rounds to find the inliers.
_ROUNDS = 6
# Residuals below this are rounding errors, not noise.
_EXACT_PX = 1e-6
# Ratio of extents below which points lie in one plane.
_FLAT = 1e-6


@dataclass(frozen=True)
class Resection:
    """A camera from space points and their pixels.

    Parameters
    ----------
    P, K, R, t : ndarray (3, 4), (3, 3), (3, 3) and (3,)
        Camera P = K [R t], with K as given or estimated.
    inliers, sigma_px : ndarray (N,) of bool, float
        Inliers, and the standard deviation of one image coordinate; NaN if no residuals are left.
    covariance : ndarray (12, 12) or (6, 6)
        Covariance of the entries of P (row-major, rank 11) or, with a given K, of the pose: rotation vector w
        (rad) and translation d of x -> exp(w) x + d in the camera frame.
    """

    P: F64
    K: F64
    R: F64
    t: F64
    inliers: B8
    sigma_px: float
    covariance: F64


def resect_robust(X: F64, xy: F64, K: F64 | None, threshold_px: float | None, rng: Generator) -> Resection:
    """Resect a camera; arguments as for :func:`thesisrecon.resect`."""
    needed, unknown = (6, 11) if K is None else (4, 6)
    if len(X) < needed:
        raise StageFailure(Notice("few-resection-points"), f"{counted(len(X), 'point')}, {needed} are needed")
    extent = np.linalg.svd(X - X.mean(axis=0), compute_uv=False)
    if not extent[2 if K is None else 1] > _FLAT * extent[0]:
        place = "in one plane" if K is None else "on one line"
        raise StageFailure(
            f"the points do not determine the camera: they lie {place}",
            "",
            "add points off it" + (", or give the calibration matrix K" if K is None else ""),
        )
    if not np.ptp(xy, axis=0).any():
        raise _no_camera(f"all {len(xy)} pixels are equal")
    limit = threshold_px or _ANY_PX
    fit = _search(X, xy, K, limit, rng)
    inliers = np.ones(len(X), dtype=bool) if fit.inliers.any() and threshold_px is None else fit.inliers
    for _ in range(_ROUNDS):
        if inliers.sum() < needed:
            raise _no_camera(f"{inliers.sum()} of {len(X)} agree with one, {needed} are needed")
        fit = _refine(fit, X, xy, inliers, calibrated=K is not None)
        distance, front = np.linalg.norm(project(fit.P, X) - xy, axis=1), depth(fit.P, homogenize(X)) > 0.0
        distance[~front] = np.inf
        used = inliers
        if threshold_px is None:
            if not front.all():
                raise _no_camera(f"{np.sum(~front)} of {len(X)} are behind the one that fits them best")
            break
        limit = max(next_inlier_limit(distance, used, limit, unknowns=unknown), _EXACT_PX)
        inliers = front & (distance <= limit)
        if np.array_equal(inliers, used):
            break
    left = (2 * int(used.sum()) - unknown) * (1.0 if threshold_px is None else VARIANCE_OF_INLIERS)
    sigma = float(np.sqrt(np.sum(distance[used] ** 2) / left)) if left > 0 else float("nan")
    return replace(fit, inliers=used, sigma_px=sigma, covariance=sigma**2 * fit.covariance)


def _no_camera(evidence: str) -> StageFailure:
    advice = "check that points and pixels correspond, and that the points are in right-handed coordinates"
    return StageFailure("no camera explains the points", evidence, advice)


def _search(X: F64, xy: F64, K: F64 | None, threshold_px: float, rng: Generator) -> Resection:
    """The best camera of samples and its inliers."""
    empty, none = np.empty((0, 0)), np.zeros(len(X), dtype=bool)
    nowhere = Resection(np.eye(3, 4), np.eye(3), np.eye(3), np.zeros(3), none, 0.0, empty)
    if K is None:
        P, inliers = resect_projective(homogenize(X), xy, threshold_px=threshold_px, rng=rng)
        return nowhere if P is None else replace(nowhere, P=P, inliers=inliers)
    rays = homogenize(xy) @ np.linalg.inv(K).T
    pose = resect_calibrated(X, rays[:, :2] / rays[:, 2:], threshold=threshold_px / K[0, 0], rng=rng)
    return nowhere if pose is None else replace(nowhere, K=K, R=pose[0], t=pose[1], inliers=pose[2])


def _refine(fit: Resection, X: F64, xy: F64, inliers: B8, *, calibrated: bool) -> Resection:
    """The camera of least reprojection error of the inliers, with its covariance for noise of 1 px."""
    if calibrated:
        K = fit.K
        row = np.array([K[0, 0], K[1, 1] / K[0, 0], K[0, 1], K[0, 2], K[1, 2], 0.0])
        held = np.zeros(6, dtype=bool)
        pose = refine_pose(fit.R, fit.t, row, X[inliers], xy[inliers], free=held, loss_px=np.inf)
        P = compose_camera(K, pose.R, pose.t)
        return replace(fit, P=P, R=pose.R, t=pose.t, covariance=pose.covariance)
    P, covariance = refine_camera(fit.P, homogenize(X[inliers]), xy[inliers], loss_px=np.inf)
    K, R, t = decompose_camera(P)
    scale = float(np.sum(compose_camera(K, R, t) * P) / np.sum(P**2))
    return replace(fit, P=P * scale, K=K, R=R, t=t, covariance=covariance * scale**2)


def resect_projective(X: F64, xy: F64, *, threshold_px: float, rng: Generator) -> tuple[F64 | None, B8]:
    """Resect a camera by RANSAC over six-point samples with a truncated-quadratic score (6.4; HZ 7.1).

    Samples are drawn in batches until one without outliers was drawn with probability 0.999. Points X (M, 4)
    are signed so that depths have one sign; those of the other sign are outliers. Returns the camera of the
    inliers with positive depths, None below six of them, and the inliers (M,).
    """
    none = np.zeros(len(X), dtype=bool)
    if len(X) < _SAMPLE:
        return None, none
    # The points of one view may fill a corner of the frame: whitening keeps all digits.
    frame = centred_frame(X, whitening_transform)
    Y = frame.points(X)
    Y /= np.maximum(np.linalg.norm(Y, axis=1, keepdims=True), 1e-300)
    best_cost, best, drawn = np.inf, None, 0
    scored = rng.choice(len(Y), 1000, replace=False) if len(Y) > 1000 else np.arange(len(Y))
    # Few samples of six determine the camera if most points are on a line or plane.
    of_all = resect_linear(Y, xy)[None]
    for _ in range(_MAX_BATCHES):
        samples = rng.random((_BATCH, len(Y))).argpartition(_SAMPLE - 1, axis=1)[:, :_SAMPLE]
        P = np.append(resect_linear(Y[samples], xy[samples]), of_all, axis=0)
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
    return (None if found is None else frame.cameras_back(found)), inlier


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
    xh = (P.reshape(-1, 4) @ X.T).reshape(len(P), 3, -1)
    x, y, depths = xh[:, 0], xh[:, 1], xh[:, 2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        squared = (x / depths - xy[:, 0]) ** 2 + (y / depths - xy[:, 1]) ** 2
    return np.where((depths > 0) & np.isfinite(squared), squared, np.inf)


def resect_calibrated(
    X: F64, normalized: F64, *, threshold: float, rng: Generator
) -> tuple[F64, F64, B8] | None:
    """Estimate the pose of a calibrated camera by P3P in RANSAC with a truncated quadratic score (6.4).

    ``normalized`` (M, 2) are the image points of ``X`` (M, 3), ``threshold`` is in their unit. Returns R, t
    and inliers (M,), or None below four points or if no sample has a pose.
    """
    if len(X) < 4:
        return None
    chosen = rng.random((_SAMPLES, len(X))).argpartition(2, axis=1)[:, :3]
    rays = np.column_stack([normalized, np.ones(len(X))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    R, t, _ = pose_from_three_points(X[chosen], rays[chosen])
    if len(R) == 0:
        return None
    scored = rng.choice(len(X), 500, replace=False) if len(X) > 500 else np.arange(len(X))
    poses, Xh = np.concatenate([R, t[:, :, None]], axis=2), homogenize(X)
    squared = _squared_residuals(poses, Xh[scored], normalized[scored])
    best = int(np.minimum(squared / threshold**2, 1.0).sum(axis=1).argmin())
    inlier = _squared_residuals(poses[best : best + 1], Xh, normalized)[0] < threshold**2
    return R[best], t[best], inlier
