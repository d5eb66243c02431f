"""Identifiability of the self-calibration: of its cameras, or of projective ones where it failed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.geometry.critical_motions import nearest_critical_motion, projective_infinity_shifts
from thesisrecon.geometry.strata import upgrade_cameras, upgrade_points
from thesisrecon.optimize.bundle.identifiability import (
    CalibrationProblem,
    excess_equations,
    identifiability_report,
    identifiability_sentences,
)
from thesisrecon.optimize.bundle.metric_kernels import MetricCameras
from thesisrecon.optimize.bundle.observations import Observations
from thesisrecon.optimize.noise import noise_from_distances
from thesisrecon.records import IdentifiabilityReport, IntrinsicsPrior, Reconstruction, Tracks, Upgrade
from thesisrecon.selfcalibration._frame import build_frame

_MAX_OBSERVATIONS = 12000
_VIRTUAL_POINTS = 300
_MAX_ITERATIONS = 12


def check_identifiability(
    reconstruction: Reconstruction, upgrade: Upgrade, prior: IntrinsicsPrior
) -> IdentifiabilityReport:
    """Check whether a self-calibration is determined by the images and the prior (chapter 7).

    A metric bundle adjustment of a subset of the observations gives cameras and the covariance of their focal
    lengths under the prior; a second covariance, with free aspect ratio and principal point, shows the effect
    of the prior of these.
    """
    problem = None
    if reconstruction.inlier.any():
        problem = _bundle_problem(reconstruction, upgrade, prior)
    else:
        # Without points the world may be mirrored: the optical axes then meet behind the cameras.
        for side in (1.0, -1.0):
            metric = np.diag([1.0, 1.0, 1.0, side]) @ upgrade.metric_from_projective
            one = replace(upgrade, metric_from_projective=metric)
            problem = problem or _bundle_problem(_with_virtual_points(reconstruction, one), one, prior)
    if problem is None:
        return identifiability_without_calibration(reconstruction, prior)
    excess = excess_equations(prior, reconstruction.registered)
    return identifiability_report(problem, excess, iterations=_MAX_ITERATIONS)


def identifiability_without_calibration(
    reconstruction: Reconstruction, prior: IntrinsicsPrior
) -> IdentifiabilityReport:
    """Report the nearest critical motion of the projective cameras alone, after self-calibration failed."""
    frame = build_frame(reconstruction, prior)
    evidence = projective_infinity_shifts(frame.A, frame.a)
    motion, distance = nearest_critical_motion(evidence)
    motion = motion if distance < 1.0 else ""
    evidence["critical_motion_distance"] = distance
    evidence["excess_equations"] = float(excess_equations(prior, reconstruction.registered))
    given = float(prior.std[reconstruction.registered, 0].max())
    sentences = identifiability_sentences(motion, evidence, identifiable=False, focal_std=given)
    return IdentifiabilityReport(False, motion, distance < 1.0, evidence, sentences)


def _with_virtual_points(reconstruction: Reconstruction, upgrade: Upgrade) -> Reconstruction:
    """Add exact observations of points where the optical axes meet, for cameras without points."""
    G, views = np.linalg.inv(upgrade.metric_from_projective), np.flatnonzero(reconstruction.registered)
    P = reconstruction.P[views] @ G
    P *= np.sign(np.linalg.det(P[:, :, :3]))[:, None, None]
    axes = P[:, 2, :3] / np.linalg.norm(P[:, 2, :3], axis=1, keepdims=True)
    C = -np.linalg.solve(P[:, :, :3], P[:, :, 3:])[:, :, 0]
    spread = float(np.sqrt(np.mean(np.sum((C - C.mean(axis=0)) ** 2, axis=1))))
    # The point nearest to all axes; parallel ones meet at five times the spread of the centres.
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    expected = C.mean(axis=0) + 5.0 * spread * axes.mean(axis=0)
    weighted = np.einsum("vij,vj->i", across, C) / len(C) + 1e-3 * expected
    middle = np.linalg.solve(across.mean(axis=0) + 1e-3 * np.eye(3), weighted)
    radius = 0.3 * float(np.median(np.linalg.norm(C - middle, axis=1)))
    X = middle + radius * np.random.default_rng(0).uniform(-1.0, 1.0, (_VIRTUAL_POINTS, 3))
    x = np.einsum("vij,nj->nvi", P, np.column_stack([X, np.ones(len(X))]))
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = x[..., :2] / x[..., 2:]
    seen = (x[..., 2] > 0.0) & (np.abs(xy / reconstruction.sizes[views] - 0.5) <= 0.5).all(axis=2)
    point, place = np.nonzero(seen)
    tracks = Tracks(views[place], point, xy[point, place], len(reconstruction.P), len(X))
    every = np.ones(len(X), dtype=bool)
    Xh = np.column_stack([X, np.ones(len(X))]) @ G.T
    return replace(reconstruction, X=Xh, valid=every, inlier=np.ones(len(point), dtype=bool), tracks=tracks)


def _bundle_problem(
    reconstruction: Reconstruction, upgrade: Upgrade, prior: IntrinsicsPrior
) -> CalibrationProblem | None:
    """Return upgraded cameras and points with a subset of their observations; None with too few of them."""
    views = np.flatnonzero(reconstruction.registered)
    R, T, X, usable = _metric_frame(reconstruction, upgrade, views)
    t, index = reconstruction.tracks, _usable_observations(reconstruction, R, T, X, usable)
    total = len(index)
    index = index[_subsample(t.point_index[index])]
    seen = np.isin(views, t.view_index[index])
    if len(index) < 4 * len(views) + 20 or seen.sum() < 3:
        return None
    views = views[seen]
    points, point = np.unique(t.point_index[index], return_inverse=True)
    mean, std = prior.mean[views].copy(), prior.std[views].copy()
    mean[:, 0] = np.where(np.isfinite(mean[:, 0]), mean[:, 0], upgrade.K[views, 0, 0])
    intrinsics = np.column_stack([upgrade.K[views, 0, 0], mean[:, 1:5], np.zeros(len(views))])
    own = np.arange(len(views), dtype=np.int64)
    return CalibrationProblem(
        MetricCameras(R[seen], T[seen], intrinsics, own, prior.shared[views]), X[points],
        Observations(np.searchsorted(views, t.view_index[index]), point.astype(np.int64), t.xy[index]),
        IntrinsicsPrior.unshared(mean, std), max(reconstruction.sigma_px, 1e-3), len(index) / max(total, 1),
        reconstruction.sizes[views].max(axis=1).astype(np.float64), views,
        _projective_noise(reconstruction, index),
    )  # fmt: skip


def _projective_noise(reconstruction: Reconstruction, index: I64) -> float:
    """Return the noise (px) of the projective cameras, corrected for the 3 N + 11 V - 15 parameters."""
    t = reconstruction.tracks
    view, point = t.view_index[index], t.point_index[index]
    x = np.einsum("kij,kj->ki", reconstruction.P[view], reconstruction.X[point])
    noise = noise_from_distances(np.linalg.norm(x[:, :2] / x[:, 2:] - t.xy[index], axis=1))
    left = 2 * len(index) - 3 * len(np.unique(point)) - 11 * len(np.unique(view)) + 15
    return noise * float(np.sqrt(2.0 * len(index) / max(left, 1)))


def _usable_observations(reconstruction: Reconstruction, R: F64, T: F64, X: F64, usable: B8) -> I64:
    """Return inliers of finite points in front of their cameras, at least two per point and ten per view."""
    t, views = reconstruction.tracks, np.flatnonzero(reconstruction.registered)
    index = np.flatnonzero(
        reconstruction.inlier & reconstruction.registered[t.view_index] & usable[t.point_index]
    )
    place = np.searchsorted(views, t.view_index[index])
    depth = np.einsum("kj,kj->k", R[place, 2], X[t.point_index[index]]) + T[place, 2]
    index = index[depth > 1e-6]
    index = index[np.bincount(t.view_index[index], minlength=t.n_views)[t.view_index[index]] >= 10]
    seen = np.bincount(t.point_index[index], minlength=t.n_points)
    return np.asarray(index[seen[t.point_index[index]] >= 2], dtype=np.int64)


def _subsample(point: I64) -> I64:
    """Return about ``_MAX_OBSERVATIONS`` places, of points spread evenly over track length."""
    if len(point) <= _MAX_OBSERVATIONS:
        return np.arange(len(point))
    numbers, seen = np.unique(point, return_counts=True)
    order = numbers[np.argsort(-seen, kind="stable")]
    # Every k-th track rather than the longest ones, which may lie in one corner of the scene.
    count = min(int(len(order) * _MAX_OBSERVATIONS / len(point)) + 1, len(order))
    chosen = np.arange(count) * len(order) // count
    return np.flatnonzero(np.isin(point, order[chosen]))


def _metric_frame(reconstruction: Reconstruction, upgrade: Upgrade, views: I64) -> tuple[F64, F64, F64, B8]:
    """Return R and t of the upgraded views, points (N, 3), and which points are finite."""
    H = upgrade.metric_from_projective
    R, t, _ = upgrade_cameras(reconstruction.P[views], upgrade.K[views], H)
    X, usable, spread = upgrade_points(reconstruction.X, reconstruction.valid, H)
    # A very distant point has no information on the focal length and dominates the conditioning.
    usable &= np.linalg.norm(X - np.median(X[usable], axis=0), axis=1) < 100.0 * spread
    return R, t / spread, X / spread, usable
