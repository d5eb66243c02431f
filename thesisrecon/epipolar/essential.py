"""The essential matrix of matches with outliers: five points, RANSAC, least Sampson distance."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.epipolar._matches import PairFrame, chance_of_agreement, multiplicity_weights
from thesisrecon.epipolar._sampling import squared_distances
from thesisrecon.epipolar.refinement import SAMPSON, UNBOUNDED, normal_equations, refine
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry import relative_pose
from thesisrecon.geometry.homogeneous import (
    cross_matrix,
    dehomogenize,
    directions_across,
    homogenize,
    unit_norm,
)
from thesisrecon.geometry.two_view import homography_linear
from thesisrecon.optimize.least_squares import INLIER_SIGMAS, trimmed_noise_scale
from thesisrecon.optimize.ransac import CHANCE, Budget, log10_false_alarms, search_models

_SAMPLE, _UNKNOWN = 5, 5
_ROUNDS = 6
# Minimal samples amplify the noise: inliers of a refit are first those of wider gates, in thresholds.
_GATES = (3.0, 2.0, 1.0)
# A refit of a model up to this much worse than the best one may be better.
_NEAR = 1.1
_REFITTED = 1000  # matches of a refit
# Leverage that is high, in units of the mean, and expected share of wrong matches at which it is left out.
_HIGH, _DOUBT = 3.0, 0.05
# Residuals in units of the frame below which they are rounding errors.
_EXACT = 1e-9

# Another pose is as good up to three standard deviations, sqrt(4 n) each, of the difference of sums of
# squares, which are other parts of the same noise, if nearly all points are in front. Essential matrices of
# unit norm this close are the same.
_AS_GOOD, _IN_FRONT, _SAME = 6.0, 0.95, 0.02


@dataclass(frozen=True)
class EssentialFit:
    """An essential matrix with the relative pose, its inliers and noise."""

    E: F64  #: (3, 3) [t]x R of unit norm
    R: F64  #: (3, 3) a point X in the frame of the first camera is R X + t in that of the second
    t: F64  #: (3,) of length 1
    inliers: B8
    """(N,) matches within the noise that were used, without those that are apart from the others where chance
    explains them."""
    in_front: B8  #: (N,) matches that meet in front of both cameras
    sigma_px: float  #: standard deviation of one image coordinate
    covariance: F64
    """(6, 6) of rotation vector w (rad) and translation d of x -> exp(w) x + d in the second camera, as if
    all inliers were right; it has no part along t."""
    competing_poses: F64
    """(C, 3, 4) [R t] of the other pose that explains the inliers to within their noise, as points of one
    plane have one (Longuet-Higgins, Proc. R. Soc. B 227, 1986); C = 0 if the pose is determined."""


@dataclass(frozen=True)
class _Pair:
    """Matches (N, 4) in a common frame, their calibration there, and rays (N, 3)."""

    points: F64
    inverse1: F64
    inverse2: F64
    x1: F64
    x2: F64

    @classmethod
    def of(cls, frame: PairFrame, xy1: F64, xy2: F64, K1: F64, K2: F64) -> "_Pair":
        inverse1, inverse2 = np.linalg.inv(np.stack(frame.transforms) @ np.stack([K1, K2]))
        points = frame.points(xy1, xy2)
        x1, x2 = homogenize(points[:, :2]) @ inverse1.T, homogenize(points[:, 2:]) @ inverse2.T
        return cls(points, inverse1, inverse2, x1, x2)

    def fundamental(self, E: F64) -> F64:
        """F of E (..., 3, 3) in the frame."""
        return np.asarray(self.inverse2.T @ E @ self.inverse1)

    def squared(self, E: F64, rows: I64 | slice = slice(None)) -> F64:
        """Squared Sampson distances (B, M) of some matches."""
        return squared_distances(self.fundamental(E).reshape(-1, 9), self.points[rows].T.copy())

    @property
    def of_essential(self) -> F64:
        """Matrix (9, 9) from vec(E) to vec(F) in the frame, row by row."""
        return np.asarray(np.kron(self.inverse2.T, self.inverse1.T))

    def pose(self, E: F64, rows: I64) -> tuple[F64, F64]:
        """R and t of E that place most matches in front of both cameras."""
        return relative_pose.pose_in_front(E, self.x1[rows], self.x2[rows])[:2]

    def tangent(self, R: F64, t: F64) -> F64:
        """Derivatives (5, 9) of F by w and by d of x -> exp(w) x + D'd, D the directions across t."""
        # exp(w) turns E as a whole; d changes t alone.
        of_turn = cross_matrix(np.eye(3)) @ relative_pose.essential_from_pose(R, t)
        by_pose = np.concatenate([of_turn, cross_matrix(directions_across(t)) @ R])
        return np.asarray(by_pose.reshape(5, 9) @ self.of_essential.T)


def fit_essential(
    xy1: F64, xy2: F64, K1: F64, K2: F64, threshold_px: float | None, budget: Budget, rng: Generator
) -> EssentialFit:
    """Fit an essential matrix; arguments as for :func:`thesisrecon.estimate_essential`."""
    n = len(xy1)
    if n < _SAMPLE + 1 or min(np.ptp(xy1, axis=0).max(), np.ptp(xy2, axis=0).max()) == 0.0:
        raise StageFailure.of(
            "undetermined-essential", f"{counted(n, 'match')}, at least 6 different ones are needed"
        )
    frame = PairFrame.of(xy1, xy2)
    pair, every = _Pair.of(frame, xy1, xy2, K1, K2), np.arange(n)
    # Without a search the noise of all matches is the threshold.
    gate = frame.scale * threshold_px if threshold_px is not None else 1e3
    E, samples, _ = _search(pair, gate, budget, rng)
    inliers = np.ones(n, dtype=bool) if threshold_px is None else pair.squared(E[None], every)[0] < gate**2
    if threshold_px is not None:
        _require_more_than_chance(xy1, xy2, inliers, threshold_px, samples)
    share = chance_of_agreement(xy1, xy2, threshold_px) if threshold_px is not None else 0.0
    for _ in range(_ROUNDS):
        if inliers.sum() <= _SAMPLE:
            raise StageFailure.of(
                "undetermined-essential",
                f"{inliers.sum()} of {n} matches agree with the best of {samples} samples",
            )
        E = _refined(pair, E, np.flatnonzero(inliers))
        distance = np.sqrt(pair.squared(E[None], every)[0])
        if threshold_px is None:
            break
        near = distance[distance < max(2.0 * gate, float(np.median(distance[inliers])))]
        noise = trimmed_noise_scale(near, float(np.median(near)) / 0.6745, parameters=_UNKNOWN)
        limit = max(INLIER_SIGMAS * noise, _EXACT)
        before, inliers = inliers, _without_apart(pair, E, distance <= limit, noise, share * limit / gate)
        if np.array_equal(inliers, before):
            break
    return _finished(pair, E, inliers, frame.scale)


def _search(pair: _Pair, gate: float, budget: Budget, rng: Generator) -> tuple[F64, int, I64]:
    """The E of least truncated squared distances, the number of samples and its inliers among scored data."""
    some = rng.permutation(len(pair.points))[:_REFITTED]

    def refit(E: F64, rows: I64) -> F64:
        if len(rows) <= _SAMPLE:
            return E
        refined = E
        for wide in _GATES:
            inside = some[pair.squared(refined[None], some)[0] < (wide * gate) ** 2]
            if len(inside) <= _SAMPLE:
                return E
            refined = _refined(pair, refined, inside, iterations=3)
        return refined

    found = search_models(
        lambda samples: relative_pose.essential_five_points(pair.x1[samples], pair.x2[samples]),
        lambda E, rows: pair.squared(E, rows) / gate**2,
        refit, rng, len(pair.points), _SAMPLE, budget, near=_NEAR,
    )  # fmt: skip
    if found is None or not len(found.inliers):
        raise StageFailure.of("undetermined-essential", "no sample of five matches has an essential matrix")
    return found


def _refined(pair: _Pair, E: F64, rows: I64, *, iterations: int = 50) -> F64:
    """E of least squared Sampson distances of some matches."""
    e = E.ravel() / np.linalg.norm(E)
    refine(e, pair.points[rows], SAMPSON, UNBOUNDED, UNBOUNDED, iterations, pair.of_essential)
    return e.reshape(3, 3)


def _without_apart(pair: _Pair, E: F64, inliers: B8, noise: float, share: float) -> B8:
    """Inliers without those behind a camera, and without those of high leverage if chance explains these."""
    # A wrong match near its epipolar line, as a `share` of them is, has any parallax. It stands apart from
    # the right ones, and pulls the fit to itself (high leverage: Hoaglin and Welsch, The American
    # Statistician 32, 1978). Where the parallax is within the noise, depths have any sign.
    R, t = pair.pose(E, np.flatnonzero(inliers))
    with np.errstate(divide="ignore", invalid="ignore"):
        parallax = np.linalg.norm(dehomogenize(pair.x1 @ R.T) - pair.x2[:, :2], axis=1) / pair.inverse2[0, 0]
    front = (relative_pose.depths_of_matches(R, t, pair.x1, pair.x2) > 0.0).all(axis=1)
    front |= parallax < 2.0 * max(INLIER_SIGMAS * noise, _EXACT)
    if (inliers & front).sum() <= _SAMPLE:
        return inliers
    wrong, inliers = share * np.count_nonzero(~inliers), inliers & front
    # Leverage: the share of each match in its own prediction by the fit of the inliers.
    F, T = pair.fundamental(relative_pose.essential_from_pose(R, t)), pair.tangent(R, t)
    a, b = homogenize(pair.points[:, :2]), homogenize(pair.points[:, 2:])
    slope = np.sqrt(np.sum((a @ F.T)[:, :2] ** 2 + (b @ F)[:, :2] ** 2, axis=1) + 1e-300)
    J = (b[:, :, None] * a[:, None, :]).reshape(-1, 9) @ T.T / slope[:, None]
    leverage = np.sum(J @ np.linalg.pinv(J[inliers].T @ J[inliers]) * J, axis=1)
    high = inliers & (leverage > _HIGH * _UNKNOWN / inliers.sum())
    return inliers & ~high if wrong > _DOUBT * high.sum() else inliers


def _finished(pair: _Pair, E: F64, inliers: B8, scale: float) -> EssentialFit:
    """The fit with noise, covariance and the matches in front of both cameras."""
    rows = np.flatnonzero(inliers)
    R, t = pair.pose(E, rows)
    G, h, T = np.empty((9, 9)), np.empty(9), pair.tangent(R, t)
    f = pair.fundamental(relative_pose.essential_from_pose(R, t)).ravel()
    cost = normal_equations(f, pair.points[rows], SAMPSON, UNBOUNDED, UNBOUNDED, G, h)
    sigma = float(np.sqrt(2.0 * cost / max(len(rows) - _UNKNOWN, 1)))
    values, vectors = np.linalg.eigh(T @ G @ T.T)
    half = np.zeros((6, 5))
    half[:3, :3], half[3:, 3:] = np.eye(3), directions_across(t).T
    half = half @ vectors * (sigma / np.sqrt(np.maximum(values, 1e-14 * values[-1])))
    front = np.asarray((relative_pose.depths_of_matches(R, t, pair.x1, pair.x2) > 0.0).all(axis=1))
    return EssentialFit(
        unit_norm(relative_pose.essential_from_pose(R, t)), R, t, inliers, front, sigma / scale,
        half @ half.T, _competing_poses(pair, (R, t), rows, max(sigma, _EXACT)),
    )  # fmt: skip


def _competing_poses(pair: _Pair, pose: tuple[F64, F64], rows: I64, sigma: float) -> F64:
    """Other poses (C, 3, 4), from the plane nearest to the points, whose distances are as small."""
    x1, x2, found = pair.x1[rows], pair.x2[rows], list[F64]()
    known = [unit_norm(relative_pose.essential_from_pose(*pose))]
    limit = pair.squared(known[0][None], rows).sum() + _AS_GOOD * np.sqrt(len(rows)) * sigma**2
    # Solutions of one plane come in pairs of the same E.
    H = homography_linear(dehomogenize(x1), dehomogenize(x2))
    R, t, _ = (each[::2] for each in relative_pose.poses_from_homography(H))
    for start in zip(R[t.any(axis=1)], t[t.any(axis=1)], strict=True):
        E = _refined(pair, relative_pose.essential_from_pose(*start), rows)
        R, t, depths = relative_pose.pose_in_front(E, x1, x2)
        same = any(min(np.linalg.norm(E - one), np.linalg.norm(E + one)) < _SAME for one in known)
        right = (depths > 0.0).all(axis=1).mean() > _IN_FRONT
        if not same and right and pair.squared(E[None], rows).sum() <= limit:
            known.append(E)
            found.append(np.column_stack([R, t]))
    return np.array(found).reshape(-1, 3, 4)


def _require_more_than_chance(xy1: F64, xy2: F64, inliers: B8, threshold_px: float, samples: int) -> None:
    """Raise ``StageFailure`` if some pose would have as many inliers among wrong matches."""
    # Weights count matches within two units, here thresholds.
    weights = multiplicity_weights(xy1 / threshold_px, xy2 / threshold_px)
    share = chance_of_agreement(xy1, xy2, threshold_px)
    agreeing, tried = float(weights[inliers].sum()), float(weights.sum())
    if log10_false_alarms(agreeing, tried, chance=share, free=_SAMPLE) > CHANCE:
        said = f"{inliers.sum()} of {len(xy1)} matches agree with the best of {samples} samples"
        raise StageFailure.of("undetermined-essential", f"{said}, which chance explains")
