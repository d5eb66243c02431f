"""RANSAC (Fischler and Bolles 1981) with local optimisation; robust resection of cameras (section 6.4)."""

from collections.abc import Callable, Iterable
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
import scipy
from numpy.random import Generator

from thesisrecon._numba import empty, kernel
from thesisrecon.arrays import B8, F64, I64, Record
from thesisrecon.camera import compose_camera, decompose_camera
from thesisrecon.errors import Notice, StageFailure, counted
from thesisrecon.geometry.camera_matrix import depth, project
from thesisrecon.geometry.homogeneous import homogenize, whitened_frame
from thesisrecon.geometry.triangulation import pose_from_three_points, resect_linear, resect_six
from thesisrecon.optimize.bundle.partial import PoseRefinement, refine_camera, refine_pose
from thesisrecon.optimize.bundle.projection import pinhole_rows
from thesisrecon.optimize.least_squares import VARIANCE_OF_INLIERS, next_inlier_limit, student_factor

# Data on which all models are tried first, and data on which the remaining ones are scored.
FIRST, SCORED = 48, 2000
# Probability that a good model is rejected by its first data, and the quantile of the normal distribution.
LOST, LOST_SIGMAS = 0.05, 1.645
AT_ONCE = 2**17  # residuals of models computed at once
WITHOUT = 100_000  # samples without any model after which there is none
CHANCE = -4.0
"""Logarithm to base 10 of the largest expected number of models of wrong data with as many inliers."""
AS_GOOD, _SAME = 9.0, 0.02
"""Largest difference of two poses' squared residuals, in variances, that noise explains (three standard
deviations), and of the rotations of one pose."""
_FEW = 6  # this many points or fewer may have other poses although they are not flat
REACHES = 1.0, 3.0
"""Thresholds at which chance is tested: right data whose noise is the threshold lie within three."""


WATCH: ContextVar[Callable[[int, float, float, F64, bool], None] | None] = ContextVar("watch", default=None)
"""Called by every robust search, if set, with its samples so far, the cost and the share of inliers of its
best model, this model in the frame of the search, and whether the search ends there."""


def watched(samples: int, cost: float, share: float, model: F64 | None, *, ends: bool = False) -> None:
    """Report a better model to :data:`WATCH`."""
    if (watch := WATCH.get()) is not None and model is not None:
        watch(samples, float(cost), float(share), model.copy(), ends)


class Budget(NamedTuple):
    """Probability that one of the samples has no outlier, and the largest number of samples."""

    confidence: float = 0.9999
    max_samples: int = 100_000


class Found(NamedTuple):
    """The best model, the number of samples, and its inliers among the scored data (rows)."""

    model: F64
    samples: int
    inliers: I64


def draw_samples(rng: Generator, count: int, n: int, size: int) -> I64:
    """Samples (count, size) of distinct numbers below n."""
    if n < 8 * size:
        return rng.random((count, n)).argpartition(size - 1, axis=1)[:, :size]
    drawn = rng.integers(0, n, (count, size))
    while len(again := np.flatnonzero(np.any([a == b for a, b in combinations(drawn.T, 2)], axis=0))):
        drawn[again] = rng.integers(0, n, (len(again), size))
    return drawn


def search_models(
    solve: Callable[[I64], F64], squared: Callable[[F64, I64], F64], refit: Callable[[F64, I64], F64],
    rng: Generator, n: int, size: int, budget: Budget, *, near: float = 1.0,
) -> Found | None:  # fmt: skip
    """The model of least truncated cost of random samples of ``size`` of n data, each best one refitted.

    ``solve`` makes models (B', ...) of samples (B, size); ``squared`` gives squared distances (B', M) of some
    data, 1 at the threshold; ``refit`` improves a model by its inliers (rows), also one whose cost is below
    ``near`` times the least. Models with too few inliers among the first data are not scored further (Matas
    and Chum, ICCV 2005). The search ends when a sample without outliers was drawn with the confidence of the
    ``budget``. None without any model.
    """
    scored = rng.permutation(n) if n <= SCORED else rng.choice(n, SCORED, replace=False)
    most = max(AT_ONCE // FIRST, 64)
    best, least, share, drawn, batch = None, np.inf, 0.0, 0, 64
    while drawn < budget.max_samples:
        batch = min(batch, budget.max_samples - drawn)
        models = solve(draw_samples(rng, batch, n, size))
        drawn += batch
        for some in np.array_split(models, len(models) * len(scored) // AT_ONCE + 1):
            # As many data as a good model needs not to be among the worst.
            tried = min(max(FIRST, int(LOST_SIGMAS**2 * (1.0 - share) / max(share, 1e-9)) + 1), len(scored))
            inside = np.count_nonzero(squared(some, scored[:tried]) < 1.0, axis=1)
            least_inside = tried * share - LOST_SIGMAS * np.sqrt(tried * share * (1.0 - share))
            if not (inside >= least_inside).any():
                continue
            some = some[inside >= least_inside]
            cost = np.minimum(squared(some, scored), 1.0).mean(axis=1)
            if (lowest := cost.min()) < near * least:
                trial = _refitted(some[cost.argmin()], squared, refit, scored)
                if min(lowest, trial[1]) < least:
                    best, least, inliers = trial
                    share = len(inliers) / len(scored)
                    watched(drawn, least, share, best)
        good = (1.0 - LOST) * min(share**size, 1.0 - 1e-9)
        missing = np.log1p(-budget.confidence) / np.log1p(-max(good, 1e-300)) - drawn
        if missing < 0.0 or (best is None and drawn >= WITHOUT):
            break
        batch = int(min(2 * batch, most, missing + 1.0))
    watched(drawn, least, share, best, ends=True)
    return None if best is None else Found(best, drawn, inliers)


def _refitted(
    model: F64, squared: Callable[[F64, I64], F64], refit: Callable[[F64, I64], F64], scored: I64
) -> tuple[F64, float, I64]:
    """A model refitted to its inliers while its cost falls (Chum et al. 2003), its cost and its inliers."""
    distances = squared(model[None], scored)[0]
    for _ in range(4):
        inliers = scored[distances < 1.0]
        trial = refit(model, inliers)
        now = squared(trial[None], scored)[0]
        if not np.minimum(now, 1.0).sum() < np.minimum(distances, 1.0).sum():
            break
        model, distances = trial, now
    return model, float(np.minimum(distances, 1.0).mean()), scored[distances < 1.0]


def log10_false_alarms(agreeing: float, tried: float, *, chance: float, free: int) -> float:
    """log10 of the expected number of models with as many inliers among wrong matches, sums of weights.

    A-contrario bound (tried - free) C(tried, free) P(Binomial >= agreeing - free): the model passes through
    ``free`` matches, the rest agree with probability ``chance`` (Moisan and Stival, IJCV 57, 2004).
    """
    rest, hits = tried - free, agreeing - free
    if hits <= 0.0 or rest <= 0.0:
        return 0.0
    tail = float(scipy.special.betainc(hits, max(rest - hits, 0.0) + 1.0, min(chance, 1.0)))
    gammaln = scipy.special.gammaln
    ways = gammaln(tried + 1.0) - gammaln(free + 1.0) - gammaln(rest + 1.0) + np.log(max(rest, 1.0))
    return float((ways + np.log(max(tail, 1e-300))) / np.log(10.0))


def inliers_by_chance(
    squared: F64,
    columns: Iterable[F64],
    limits: tuple[float, float],
    chance: Callable[[float], float],
    size: int,
) -> int | None:
    """Inliers (equal data, ``columns``, once) of a model of samples of ``size``, if chance explains them.

    ``limits``: threshold, and rounding. ``chance`` of a squared distance is the probability that a wrong
    datum is as near. Nothing was chosen if all data are inliers. Else None.
    """
    threshold, exact = limits
    for reach in REACHES:
        near = squared <= max(reach * threshold, exact) ** 2
        if near.all():
            return None
        share = chance(max(float(squared[near].max(initial=0.0)), exact**2))
        # Equal data alone have equal sums with irrational factors.
        sums = sum(weight * column[near] for weight, column in zip(_IRRATIONAL, columns, strict=False))
        k = len(np.unique(sums))
        if log10_false_alarms(k, len(near), chance=share, free=size) <= CHANCE:
            return None
    return k


_IRRATIONAL = (2.0**0.5, 3.0**0.5, 5.0**0.5, 7.0**0.5, 11.0**0.5)
_SAMPLE = 6
_ANY_PX = 1e4  # search threshold if all points are inliers
_ROUNDS = 6  # rounds to find the inliers
_EXACT_PX = 1e-6  # residuals below this are rounding errors, not noise
_FLAT = 1e-6  # ratio of extents below which points lie in one plane


@dataclass(frozen=True, eq=False)
class Resection(Record):
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
    competing_poses : ndarray (C, 3, 4)
        With a given K, [R t] of other poses that explain the inliers as well: the mirrored one of small or
        distant planes (Schweighofer and Pinz, PAMI 28(12), 2006), those of few points; else C = 0.
    """

    P: F64
    K: F64
    R: F64
    t: F64
    inliers: B8
    sigma_px: float
    covariance: F64
    competing_poses: F64 = field(default_factory=lambda: np.zeros((0, 3, 4)))


def resect_robust(
    X: F64, xy: F64, K: F64 | None, threshold_px: float | None, budget: Budget, rng: Generator
) -> Resection:
    """Resect a camera; arguments as for :func:`thesisrecon.resect`."""
    needed, unknown = (6, 11) if K is None else (4, 6)
    if len(X) < needed:
        raise StageFailure(Notice("few-resection-points"), f"{counted(len(X), 'point')}, {needed} are needed")
    extent = np.linalg.svd(X - X.mean(axis=0), compute_uv=False)
    if not extent[2 if K is None else 1] > _FLAT * extent[0]:
        place, more = (
            ("in one plane", ", or give the calibration matrix K") if K is None else ("on one line", "")
        )
        raise StageFailure.of("undetermined-camera", place, more)
    if not np.ptp(xy, axis=0).any():
        raise _no_camera(f"all {len(xy)} pixels are equal")
    limit = threshold_px or _ANY_PX
    if K is None:
        found = resect_projective(homogenize(X), xy, threshold_px=limit, budget=budget, rng=rng)
    else:
        rays = homogenize(xy) @ np.linalg.inv(K).T
        normalized = rays[:, :2] / rays[:, 2:]
        found = resect_calibrated(X, normalized, threshold=limit / K[0, 0], budget=budget, rng=rng)
    start, inliers, samples = found
    if inliers.any() and threshold_px is None:
        inliers[:] = True
    for _ in range(_ROUNDS):
        if start is None or inliers.sum() < needed:
            raise _no_camera(
                f"{inliers.sum()} of {len(X)} agree with the best of {samples} samples, {needed} are needed"
            )
        fit = _refine(start, K, X, xy, inliers)
        distance, front = np.linalg.norm(project(fit.P, X) - xy, axis=1), depth(fit.P, homogenize(X)) > 0.0
        distance[~front] = np.inf
        if threshold_px is None:
            if not front.all():
                raise _no_camera(f"{np.sum(~front)} of {len(X)} are behind the one that fits them best")
            break
        limit = max(next_inlier_limit(distance, fit.inliers, limit, unknowns=unknown), _EXACT_PX)
        start = fit.P if K is None else np.column_stack([fit.R, fit.t])
        inliers = front & (distance <= limit)
        if np.array_equal(inliers, fit.inliers):
            break
    if threshold_px is not None:
        _require_more_than_chance(X, xy, fit.P, threshold_px, samples, _SAMPLE if K is None else 3)
    left = 2 * int(fit.inliers.sum()) - unknown
    fits, k = [fit], fit.inliers
    if K is not None:
        # Rays are used of few points only.
        some = rays[np.flatnonzero(k)[:_FEW]]
        poses = other_poses(fit.R, fit.t, np.append(pinhole_rows(K), 0.0), some, X[k], xy[k])
        fits += [_of_pose(pose, K, k) for pose in poses]
    (cost, fit), *others = sorted([(_cost(one, X, xy), one) for one in fits], key=lambda one: one[0])
    variance = 1.0 if threshold_px is None else VARIANCE_OF_INLIERS
    sigma = float(np.sqrt(cost / (left * variance))) if left > 0 else float("nan")
    limit = AS_GOOD * (student_factor(left) * max(sigma, _EXACT_PX)) ** 2
    as_good = [one for worse, one in others if worse - cost <= limit]
    competing = np.array([np.column_stack([one.R, one.t]) for one in as_good]).reshape(-1, 3, 4)
    return replace(fit, sigma_px=sigma, covariance=sigma**2 * fit.covariance, competing_poses=competing)


def _cost(fit: Resection, X: F64, xy: F64) -> float:
    """Sum of squared residuals of the inliers in px, infinite if one is behind the camera."""
    return float(_squared_residuals(fit.P[None], homogenize(X[fit.inliers]), xy[fit.inliers]).sum())


def other_poses(R: F64, t: F64, row: F64, rays: F64, X: F64, xy: F64) -> list[PoseRefinement]:
    """Other poses near which flat or few points (N, 3) look as from [R t], refined.

    ``row`` are intrinsics as of ``MetricCameras``, ``rays`` (N, 3) those of the pixels.
    """
    centre, normal = X.mean(axis=0), np.linalg.eigh(np.cov(X.T))[1][:, 0]
    place = R @ centre + t
    view = place / np.linalg.norm(place)
    # Reflected along the normal, which does not move a plane, and the line of sight: pixels hardly move.
    turn = (np.eye(3) - 2.0 * np.outer(view, view)) @ R @ (np.eye(3) - 2.0 * np.outer(normal, normal))
    starts, found = np.column_stack([turn, place - turn @ centre])[None], list[PoseRefinement]()
    if len(X) <= _FEW:
        samples = np.array(list(combinations(range(len(X)), 3)))
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        starts = np.concatenate([starts, pose_from_three_points(X[samples], rays[samples])])
    for start in starts:
        pose = refine_pose(start[:, :3], start[:, 3], row, X, xy, free=np.zeros(6, bool), loss_px=np.inf)
        if all(np.linalg.norm(pose.R - one) >= _SAME for one in (R, *(other.R for other in found))):
            found.append(pose)
    return found


def _require_more_than_chance(X: F64, xy: F64, P: F64, threshold: float, samples: int, size: int) -> None:
    """Raise ``StageFailure`` if a camera of wrong points would have as many inliers."""
    area = float(np.prod(np.ptp(xy, axis=0)))
    found = inliers_by_chance(
        _squared_residuals(P[None], homogenize(X), xy)[0], (*X.T, *xy.T), (threshold, _EXACT_PX),
        lambda largest: np.pi * largest / max(area, largest), size,
    )  # fmt: skip
    if found is not None:
        raise StageFailure.of("camera-by-chance", found, len(X), samples)


def _no_camera(evidence: str) -> StageFailure:
    return StageFailure.of("no-camera", evidence)


def _of_pose(pose: PoseRefinement, K: F64, inliers: B8) -> Resection:
    return Resection(compose_camera(K, pose.R, pose.t), K, pose.R, pose.t, inliers, 1.0, pose.covariance)


def _refine(start: F64, K: F64 | None, X: F64, xy: F64, inliers: B8) -> Resection:
    """The camera of least reprojection error of the inliers near P or [R t], its covariance for 1 px."""
    if K is not None:
        row = np.append(pinhole_rows(K), 0.0)
        pose = refine_pose(
            start[:, :3], start[:, 3], row, X[inliers], xy[inliers], free=np.zeros(6, bool), loss_px=np.inf
        )
        return _of_pose(pose, K, inliers)
    P, covariance = refine_camera(start, homogenize(X[inliers]), xy[inliers], loss_px=np.inf)
    K, R, t = decompose_camera(P)
    scale = float(np.sum(compose_camera(K, R, t) * P) / np.sum(P**2))
    return Resection(P * scale, K, R, t, inliers, 1.0, covariance * scale**2)


def resect_projective(
    X: F64, xy: F64, *, threshold_px: float, budget: Budget, rng: Generator
) -> tuple[F64 | None, B8, int]:
    """Resect a camera by RANSAC over six-point samples with a truncated-quadratic score (6.4; HZ 7.1).

    Points X (M, 4) are signed so that depths have one sign. Returns the camera, None below six inliers, the
    inliers (M,) and the number of samples.
    """
    none = np.zeros(len(X), dtype=bool)
    if len(X) < _SAMPLE:
        return None, none, 0
    # The points of one view may fill a corner of the frame: whitening keeps all digits.
    frame = whitened_frame(X)
    Y = frame.points(X)
    Y /= np.maximum(np.linalg.norm(Y, axis=1, keepdims=True), 1e-300)
    # Few samples of six determine the camera if most points are on a line or plane.
    of_all = resect_linear(Y, xy)[None]

    def cameras(samples: I64) -> F64:
        P = resect_six(Y[samples], xy[samples])
        signs = np.sign(np.einsum("bmi,bi->bm", Y[samples], P[:, 2]))
        # The points of a sample are in front.
        P = (P * signs[:, :1, None])[(signs == signs[:, :1]).all(axis=1)]
        return np.concatenate([P, of_all, -of_all])

    def squared(P: F64, rows: I64 | slice) -> F64:
        return _squared_residuals(P, Y[rows], xy[rows]) / threshold_px**2

    def refit(P: F64, rows: I64) -> F64:
        if len(rows) < _SAMPLE:
            return P
        camera = resect_linear(Y[rows], xy[rows])
        return camera * (np.sign(np.median(Y[rows] @ camera[2])) or 1.0)

    found = search_models(cameras, squared, refit, rng, len(Y), _SAMPLE, budget)
    if found is None or len(found.inliers) < _SAMPLE:
        return None, none, 0 if found is None else found.samples
    P = refit(found.model, found.inliers)
    if np.sum(squared(P[None], found.inliers) < 1.0) < len(found.inliers):
        P = found.model
    return frame.cameras_back(P), squared(P[None], slice(None))[0] < 1.0, found.samples


def _squared_residuals(P: F64, X: F64, xy: F64) -> F64:
    """Return squared reprojection residuals (B, M), inf on or behind the principal plane."""
    return np.asarray(
        _residuals(np.ascontiguousarray(P), np.ascontiguousarray(X.T), np.ascontiguousarray(xy.T))
    )


@kernel(fastmath={"reassoc", "contract"})
def _residuals(P: F64, X: F64, xy: F64) -> F64:
    """:func:`_squared_residuals` of columns X (4, M) and xy (2, M)."""
    squared = empty((len(P), X.shape[1]))
    for b in range(len(P)):
        p, q, r = P[b, 0], P[b, 1], P[b, 2]
        for k in range(X.shape[1]):
            x0, x1, x2, x3 = X[0, k], X[1, k], X[2, k], X[3, k]
            w = r[0] * x0 + r[1] * x1 + r[2] * x2 + r[3] * x3
            inverse = 1.0 / w if w > 0.0 else np.inf
            dx = (p[0] * x0 + p[1] * x1 + p[2] * x2 + p[3] * x3) * inverse - xy[0, k]
            dy = (q[0] * x0 + q[1] * x1 + q[2] * x2 + q[3] * x3) * inverse - xy[1, k]
            distance = dx * dx + dy * dy
            squared[b, k] = distance if distance < np.inf else np.inf
    return squared


def resect_calibrated(
    X: F64, normalized: F64, *, threshold: float, budget: Budget, rng: Generator
) -> tuple[F64 | None, B8, int]:
    """Estimate the pose of a calibrated camera by P3P in RANSAC with a truncated quadratic score (6.4).

    Image points ``normalized`` (M, 2) and ``threshold`` have one unit. Returns [R t] or None, inliers,
    samples.
    """
    Xh, none = homogenize(X), np.zeros(len(X), dtype=bool)
    if len(X) < 4:
        return None, none, 0
    rays = homogenize(normalized)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    row = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0])

    def squared(poses: F64, rows: I64 | slice) -> F64:
        return _squared_residuals(poses, Xh[rows], normalized[rows]) / threshold**2

    def refit(pose: F64, rows: I64) -> F64:
        some = rows[:300]
        if len(some) < 4:
            return pose
        fit = refine_pose(
            pose[:, :3], pose[:, 3], row, X[some], normalized[some], free=np.zeros(6, bool), loss_px=np.inf,
            iterations=5,
        )  # fmt: skip
        return np.column_stack([fit.R, fit.t])

    def poses(samples: I64) -> F64:
        return pose_from_three_points(X[samples], rays[samples])

    found = search_models(poses, squared, refit, rng, len(X), 3, budget)
    if found is None:
        return None, none, budget.max_samples
    return found.model, squared(found.model[None], slice(None))[0] < 1.0, found.samples
