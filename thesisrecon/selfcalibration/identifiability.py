"""Identifiability of the calibration from the images, checked before anything depends on it.

Two questions are answered: which critical motion is nearest
(:mod:`~thesisrecon.selfcalibration.critical_motions`), and is the calibration determined under the prior of
the intrinsics? The second follows from the covariance of the focal lengths with free poses and points,
because the prior may resolve a critical motion: a turntable leaves the scale along its axis and the aspect
ratio undetermined; square pixels resolve both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.numerics.metric_bundle import BundleOptions, MetricBundleResult, refine_metric_bundle
from thesisrecon.numerics.metric_cameras import MetricCameras
from thesisrecon.numerics.noise import noise_from_distances
from thesisrecon.numerics.observations import Observations
from thesisrecon.records import IdentifiabilityReport, Reconstruction, Upgrade
from thesisrecon.selfcalibration.critical_motions import (
    MAX_FOCAL_STD,
    MAX_NOISE_RATIO,
    MIN_INFINITY_SHIFT,
    MIN_ROTATION_SIGNIFICANCE,
    UpgradedCameras,
    measure_motion,
    motion_sentences,
    nearest_critical_motion,
    projective_infinity_shifts,
)
from thesisrecon.selfcalibration.frame import build_frame

# Localisation of corners; a few of them may agree better by chance.
_NOISE_FLOOR_PX = 0.05
# The same in long sides, for ratios of noise.
_NOISE_FLOOR_REL = 3e-5
_MAX_OBSERVATIONS = 12000
_MAX_ITERATIONS = 12
_NEEDED_EQUATIONS = 8
_FREE_STD = 1e3
_FREE = np.array([True, True, False, True, True, False])


def check_identifiability(
    reconstruction: Reconstruction, upgrade: Upgrade, prior: IntrinsicsPrior
) -> IdentifiabilityReport:
    """Check whether a self-calibration is determined by the images and the prior.

    A metric bundle adjustment of a subset of the observations gives cameras and the covariance of their focal
    lengths under the prior; a second covariance, with free aspect ratio and principal point, shows what
    depends on these.

    Parameters
    ----------
    reconstruction : Reconstruction
        Projective reconstruction.
    upgrade : Upgrade
        Metric upgrade to check.
    prior : IntrinsicsPrior
        Prior of the intrinsics of every view.

    Returns
    -------
    IdentifiabilityReport
        ``evidence`` holds the measures of :data:`~thesisrecon.selfcalibration.critical_motions.TOLERANCES`,
        ``focal_long_sides`` (median), ``focal_std_rel`` (worst view), ``focal_std_rel_median``,
        ``focal_std_rel_free`` (median, free aspect ratio and principal point), ``principal_point_std_free``
        (long sides), ``rotation_significance``, ``excess_equations`` and ``noise_px``.
    """
    problem = _bundle_problem(reconstruction, upgrade, prior)
    excess = excess_equations(prior, reconstruction.registered)
    if problem is None:
        return identifiability_without_calibration(reconstruction, prior)
    fit = problem.adjust(iterations=_MAX_ITERATIONS)
    free = problem.with_free_intrinsics(fit).adjust(iterations=0)
    return _report(problem, fit, free, excess)


def identifiability_without_calibration(
    reconstruction: Reconstruction, prior: IntrinsicsPrior
) -> IdentifiabilityReport:
    """Report the identifiability from projective cameras alone, after self-calibration failed.

    Parameters
    ----------
    reconstruction : Reconstruction
        Projective reconstruction.
    prior : IntrinsicsPrior
        Prior of the intrinsics of every view.

    Returns
    -------
    IdentifiabilityReport
        Not identifiable; with the nearest critical motion if there is one.
    """
    frame = build_frame(reconstruction, prior.group)
    evidence = projective_infinity_shifts(frame.A, frame.a)
    motion, distance = nearest_critical_motion(evidence)
    motion = motion if distance < 1.0 else ""
    evidence |= {
        "critical_motion_distance": distance,
        "excess_equations": float(excess_equations(prior, reconstruction.registered)),
    }
    focal_std = prior.std[reconstruction.registered, 0]
    given = float(focal_std.max()) if len(focal_std) else float("inf")
    sentences = motion_sentences(motion, evidence, identifiable=False, focal_std=given)
    return IdentifiabilityReport(False, motion, distance < 1.0, evidence, sentences)


def excess_equations(prior: IntrinsicsPrior, registered: B8) -> int:
    """Count the equations beyond the 8 that self-calibration needs: m n_known + (m - 1) n_constant - 8.

    Written for any pattern of sharing: five intrinsics of each of m views minus the number of unknown values
    (a standard deviation makes a value known).

    Parameters
    ----------
    prior : IntrinsicsPrior
        Prior of the intrinsics of V views.
    registered : ndarray (V,) of bool
        Registered views.

    Returns
    -------
    int
        Excess; negative if there are too few views.

    References
    ----------
    M. Pollefeys, R. Koch, L. Van Gool, IJCV 32(1), 1999.
    """
    unknown = 0
    for column in range(5):
        open_ = registered & ~np.isfinite(prior.std[:, column])
        unknown += len(np.unique(prior.shared[open_, column]))
    return 5 * int(registered.sum()) - unknown - _NEEDED_EQUATIONS


@dataclass(frozen=True)
class _Problem:
    """Bundle adjustment of the registered ``views``, each with its own row of intrinsics.

    ``share`` is the fraction of observations used, ``longest`` (V,) the long side in pixels,
    ``projective_px`` the noise that the projective cameras leave in the same observations.
    """

    cameras: MetricCameras
    X: F64
    observations: Observations
    prior: IntrinsicsPrior
    sigma_px: float
    share: float
    longest: F64
    views: I64
    projective_px: float

    def adjust(self, *, iterations: int) -> MetricBundleResult:
        """Adjust focal length, aspect ratio and principal point under the prior, with their covariance."""
        return refine_metric_bundle(
            self.cameras, self.X, self.observations, free=_FREE, prior=self.prior,
            options=BundleOptions(
                sigma_px=self.sigma_px, loss_px=2.0 * self.sigma_px, max_iterations=iterations,
                covariance=True, noise_floor_px=_NOISE_FLOOR_PX,
            ),
        )  # fmt: skip

    def with_free_intrinsics(self, fit: MetricBundleResult) -> _Problem:
        """Return the problem at the solution ``fit`` with a free aspect and principal point per focal.

        Large finite standard deviations keep the system regular.
        """
        std = np.full_like(self.prior.std, _FREE_STD)
        std[:, 3:5] *= self.longest.max()
        shared = np.array(fit.cameras.shared)
        shared[:, 1:5] = shared[:, :1]
        # Shared values take those of the first view.
        first = np.unique(shared[:, 0], return_index=True)[1][np.unique(shared[:, 0], return_inverse=True)[1]]
        intrinsics = np.column_stack([fit.cameras.intrinsics[:, 0], fit.cameras.intrinsics[first, 1:]])
        return replace(
            self,
            cameras=replace(fit.cameras, shared=shared, intrinsics=intrinsics),
            X=fit.X,
            prior=IntrinsicsPrior.unshared(intrinsics, std),
            sigma_px=max(fit.sigma_px, 1e-6),
        )


def _bundle_problem(
    reconstruction: Reconstruction, upgrade: Upgrade, prior: IntrinsicsPrior
) -> _Problem | None:
    """Return upgraded cameras and points with a subset of their observations; None with too few of them."""
    views = np.flatnonzero(reconstruction.registered)
    cameras, X, usable = _metric_frame(reconstruction, upgrade, views)
    index = _usable_observations(reconstruction, cameras, X, usable)
    t, total = reconstruction.tracks, len(index)
    index = index[_subsample(t.point_index[index], np.bincount(t.point_index[index], minlength=t.n_points))]
    seen = np.isin(views, t.view_index[index])
    if len(index) < 4 * len(views) + 20 or seen.sum() < 3:
        return None
    views = views[seen]
    points, point = np.unique(t.point_index[index], return_inverse=True)
    mean, std = prior.mean[views].copy(), prior.std[views].copy()
    mean[:, 0] = np.where(np.isfinite(mean[:, 0]), mean[:, 0], upgrade.K[views, 0, 0])
    intrinsics = np.column_stack([upgrade.K[views, 0, 0], mean[:, 1:5], np.zeros(len(views))])
    own = np.arange(len(views), dtype=np.int64)
    return _Problem(
        MetricCameras(cameras.R[seen], cameras.t[seen], intrinsics, own, prior.shared[views]), X[points],
        Observations(np.searchsorted(views, t.view_index[index]), point.astype(np.int64), t.xy[index]),
        IntrinsicsPrior.unshared(mean, std), max(reconstruction.sigma_px, 1e-3), len(index) / max(total, 1),
        reconstruction.sizes[views].max(axis=1).astype(np.float64), views,
        _projective_noise(reconstruction, index),
    )  # fmt: skip


def _projective_noise(reconstruction: Reconstruction, index: I64) -> float:
    """Return the noise (px) of one coordinate about the projective cameras and points.

    Corrected for the 3 N + 11 V - 15 fitted parameters; the noise estimate of the projective stage has a
    floor.
    """
    t = reconstruction.tracks
    view, point = t.view_index[index], t.point_index[index]
    x = np.einsum("kij,kj->ki", reconstruction.P[view], reconstruction.X[point])
    noise = noise_from_distances(np.linalg.norm(x[:, :2] / x[:, 2:] - t.xy[index], axis=1))
    left = 2 * len(index) - 3 * len(np.unique(point)) - 11 * len(np.unique(view)) + 15
    return noise * float(np.sqrt(2.0 * len(index) / max(left, 1)))


def _usable_observations(reconstruction: Reconstruction, cameras: MetricCameras, X: F64, usable: B8) -> I64:
    """Return inliers of finite points in front of their cameras, at least two per point and ten per view."""
    t, views = reconstruction.tracks, np.flatnonzero(reconstruction.registered)
    index = np.flatnonzero(
        reconstruction.inlier & reconstruction.registered[t.view_index] & usable[t.point_index]
    )
    place = np.searchsorted(views, t.view_index[index])
    depth = np.einsum("kj,kj->k", cameras.R[place, 2], X[t.point_index[index]]) + cameras.t[place, 2]
    index = index[depth > 1e-6]
    index = index[np.bincount(t.view_index[index], minlength=t.n_views)[t.view_index[index]] >= 10]
    seen = np.bincount(t.point_index[index], minlength=t.n_points)
    return np.asarray(index[seen[t.point_index[index]] >= 2], dtype=np.int64)


def _subsample(point: I64, seen: I64) -> I64:
    """Return about ``_MAX_OBSERVATIONS`` places, of points spread evenly over track length."""
    if len(point) <= _MAX_OBSERVATIONS:
        return np.arange(len(point))
    numbers = np.unique(point)
    step = len(point) / _MAX_OBSERVATIONS
    order = numbers[np.argsort(-seen[numbers], kind="stable")]
    # Every k-th track rather than the longest ones, which may lie in one corner of the scene.
    wanted = order[np.unique(np.arange(0, len(order), step).astype(np.int64))]
    chosen = np.zeros(int(point.max()) + 1, dtype=bool)
    chosen[wanted] = True
    return np.flatnonzero(chosen[point])


def _metric_frame(
    reconstruction: Reconstruction, upgrade: Upgrade, views: I64
) -> tuple[MetricCameras, F64, B8]:
    """Return upgraded poses of the registered views, points (N, 3), and which points are finite."""
    P = reconstruction.P[views] @ np.linalg.inv(upgrade.metric_from_projective)
    Q = np.linalg.inv(upgrade.K[views]) @ P
    Q *= np.where(np.linalg.det(Q[:, :, :3]) < 0, -1.0, 1.0)[:, None, None]
    U, S, Vt = np.linalg.svd(Q[:, :, :3])
    Xm = reconstruction.X @ upgrade.metric_from_projective.T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        X = Xm[:, :3] / Xm[:, 3:]
    usable = reconstruction.valid & np.isfinite(X).all(axis=1)
    X = np.where(usable[:, None], X, 0.0)
    spread = float(np.median(np.linalg.norm(X[usable] - np.median(X[usable], axis=0), axis=1)))
    # A point far behind the others is uninformative and distorts every scale.
    usable &= np.linalg.norm(X - np.median(X[usable], axis=0), axis=1) < 100.0 * spread
    t = Q[:, :, 3] / S.mean(axis=1)[:, None]
    empty = MetricCameras(U @ Vt, t / spread, np.zeros((0, 6)), np.zeros(0, dtype=np.int64))
    return empty, X / spread, usable


def _report(
    problem: _Problem, fit: MetricBundleResult, free: MetricBundleResult, excess: int
) -> IdentifiabilityReport:
    cameras, views = fit.cameras, problem.views
    focal = cameras.intrinsics[cameras.group, 0]
    metric = UpgradedCameras(
        focal / problem.longest, cameras.R, -np.einsum("vba,vb->va", cameras.R, cameras.t), fit.X
    )
    evidence = measure_motion(metric)
    motion, distance = nearest_critical_motion(evidence)
    evidence["critical_motion_distance"] = distance
    std = _focal_std(fit, problem)
    own = _focal_std(free, problem)
    centre = np.sqrt(
        np.diagonal(free.intrinsics_covariance, axis1=1, axis2=2)[cameras.group, 3:5].max(axis=1)
    )
    evidence |= {
        "focal_long_sides": float(np.median(metric.focal)),
        "focal_std_rel": float(std.max()),
        "focal_std_rel_median": float(np.median(std)),
        "focal_std_rel_free": float(np.median(own)),
        "principal_point_std_free": float(np.median(centre / problem.longest) * np.sqrt(problem.share)),
        "rotation_significance": rotation_significance(cameras.R, fit.pose_covariance)
        / float(np.sqrt(problem.share)),
        "excess_equations": float(excess),
        "noise_px": fit.sigma_px,
        "noise_ratio_to_projective": fit.sigma_px
        / max(problem.projective_px, _NOISE_FLOOR_REL * float(np.median(problem.longest))),
    }
    undetermined = views[std >= MAX_FOCAL_STD]
    # A prior that fixes the focal length does so for any motion.
    rotated = (
        evidence["rotation_significance"] >= MIN_ROTATION_SIGNIFICANCE
        and evidence["infinity_shift_beyond_roll"] >= MIN_INFINITY_SHIFT
    )
    known_focal = bool((problem.prior.std[:, 0] < MAX_FOCAL_STD).all())
    identifiable = (
        len(views) - len(undetermined) >= max(3, (len(views) + 1) // 2)
        and excess >= 0
        and (rotated or known_focal)
        and evidence["noise_ratio_to_projective"] < MAX_NOISE_RATIO
    )
    given = float(problem.prior.std[:, 0].max())
    sentences = motion_sentences(motion, evidence, identifiable=identifiable, focal_std=given)
    return IdentifiabilityReport(
        identifiable, motion, distance < 1.0, evidence, sentences, tuple(int(v) for v in undetermined)
    )


def _focal_std(fit: MetricBundleResult, problem: _Problem) -> F64:
    """Return the relative standard deviations (V,) that all observations would give."""
    group = fit.cameras.group
    variance = np.maximum(fit.intrinsics_covariance[group, 0, 0], 0.0)
    std = np.sqrt(variance) / fit.cameras.intrinsics[group, 0] * np.sqrt(problem.share)
    return np.asarray(np.where(np.isfinite(std), std, np.inf), dtype=np.float64)


def rotation_significance(R: F64, covariance: F64 | None) -> float:
    """Compute the rms rotation of the optical axes in units of its standard deviation.

    Without such rotations (pure translation, or roll only) the focal length is undetermined.

    Parameters
    ----------
    R : ndarray (V, 3, 3)
        Rotations, world to camera.
    covariance : ndarray (V, 6, 6) or None
        Covariances of the poses.

    Returns
    -------
    float
        Significance, 0 without a covariance.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> R = Rotation.from_rotvec([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]]).as_matrix()
    >>> round(rotation_significance(R, np.tile(1e-4 * np.eye(6), (2, 1, 1))), 3)
    7.059
    """
    if covariance is None:
        return 0.0
    mean = R[:, 2].mean(axis=0)
    tilt = (R @ (mean / max(float(np.linalg.norm(mean)), 1e-12)))[:, :2]
    variance = float(np.mean(np.diagonal(covariance, axis1=1, axis2=2)[:, :2]))
    return float(np.sqrt(np.mean(tilt**2) / max(variance, 1e-300))) if np.isfinite(variance) else 0.0
