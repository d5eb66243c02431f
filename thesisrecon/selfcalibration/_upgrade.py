"""The upgrade to a metric frame from plane at infinity and K (HZ 19.2): candidates, selection and check.

The identifiability is that of the upgraded cameras, or of projective ones where self-calibration failed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import ParamSpec

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import Notice, StageFailure, counted
from thesisrecon.geometry.homogeneous import pixel_from_unit
from thesisrecon.geometry.relative_pose import pose_in_front
from thesisrecon.geometry.strata import upgrade_cameras, upgrade_points
from thesisrecon.geometry.two_view import fundamental_from_cameras
from thesisrecon.optimize.bundle import identifiability
from thesisrecon.optimize.bundle.identifiability import CalibrationProblem
from thesisrecon.optimize.bundle.projection import MetricCameras, Observations, calibrations
from thesisrecon.optimize.least_squares import noise_from_distances
from thesisrecon.records import (
    IdentifiabilityReport,
    IntrinsicsPrior,
    Reconstruction,
    SelfCalibration,
    Tracks,
    Upgrade,
)
from thesisrecon.selfcalibration._frame import ReferenceFrame, build_frame, cannot_be_calibrated
from thesisrecon.selfcalibration._refinement import focal_std

_MAX_OBSERVATIONS = 12000
_VIRTUAL_POINTS = 300
_MAX_ITERATIONS = 12


def check_identifiability(
    reconstruction: Reconstruction, upgrade: Upgrade, prior: IntrinsicsPrior
) -> IdentifiabilityReport:
    """Check whether a self-calibration is determined by the images and the prior (chapter 7)."""
    # Bundle adjustment of some observations gives the covariance of the focal lengths under the prior; a
    # second one, with free aspect ratio and principal point, shows the effect of the prior of these.
    if reconstruction.inlier.any():
        problem = _bundle_problem(reconstruction, upgrade, prior)
    else:
        problem = _virtual_problem(reconstruction, upgrade, prior)
    if problem is None:
        return identifiability_without_calibration(reconstruction, prior)
    excess = identifiability.excess_equations(prior, reconstruction.registered)
    return identifiability.identifiability_report(problem, excess, iterations=_MAX_ITERATIONS)


def _virtual_problem(
    reconstruction: Reconstruction, upgrade: Upgrade, prior: IntrinsicsPrior
) -> CalibrationProblem | None:
    """The problem of cameras without points, with virtual ones; None if their optical axes do not meet."""
    # The world may be mirrored: the optical axes then meet behind the cameras.
    for side in (1.0, -1.0):
        metric = np.diag([1.0, 1.0, 1.0, side]) @ upgrade.metric_from_projective
        one = replace(upgrade, metric_from_projective=metric)
        problem = _bundle_problem(_with_virtual_points(reconstruction, one), one, prior)
        if problem is not None:
            return problem
    return None


def identifiability_without_calibration(
    reconstruction: Reconstruction, prior: IntrinsicsPrior
) -> IdentifiabilityReport:
    """Report the nearest critical motion of the projective cameras alone, after self-calibration failed."""
    frame = build_frame(reconstruction, prior, pixel_from_unit(reconstruction.sizes))
    evidence = identifiability.projective_infinity_shifts(frame.A, frame.a)
    motion, distance = identifiability.nearest_critical_motion(evidence)
    motion = motion if distance < 1.0 else ""
    evidence["critical_motion_distance"] = distance
    evidence["excess_equations"] = float(identifiability.excess_equations(prior, reconstruction.registered))
    given = float(prior.std[reconstruction.registered, 0].max())
    sentences = identifiability.identifiability_sentences(
        motion, evidence, identifiable=False, focal_std=given
    )
    return IdentifiabilityReport(False, motion, distance < 1.0, evidence, sentences)


def calibration_of_two_views(
    reconstruction: Reconstruction, prior: IntrinsicsPrior
) -> SelfCalibration | None:
    """The upgrade of two views of known focal length by their essential matrix (HZ 9.6); None: others."""
    views = np.flatnonzero(reconstruction.registered)
    if len(views) != 2 or not prior.focal_known[views].all():
        return None
    K = np.zeros((len(prior.mean), 3, 3))
    K[views] = calibrations(prior.mean[views])
    P = np.linalg.solve(K[views], reconstruction.P[views])
    x1, x2 = (reconstruction.X[reconstruction.valid] @ camera.T for camera in P)
    R, t, _ = pose_in_front(fundamental_from_cameras(*P), *(x / x[:, 2:] for x in (x1, x2)))
    # [I 0] H = P1 and [R t] H = s P2, linear in H and s.
    system = np.zeros((24, 17))
    system[:12, :12] = np.eye(12)
    system[12:, :16] = np.kron(np.column_stack([R, t]), np.eye(4))
    system[12:, 16] = -P[1].ravel()
    H = np.linalg.lstsq(system, np.concatenate([P[0].ravel(), np.zeros(12)]), rcond=None)[0][:16].reshape(
        4, 4
    )
    only = Upgrade(H, K, 0.0, "known focal length of two views")
    return SelfCalibration(H, K, np.full_like(K, np.nan), True, (), (only,))


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
    H, views = upgrade.metric_from_projective, np.flatnonzero(reconstruction.registered)
    R, T, _ = upgrade_cameras(reconstruction.P[views], upgrade.K[views], H)
    X, usable, spread = upgrade_points(reconstruction.X, reconstruction.valid, H)
    # A very distant point has no information on the focal length and dominates the conditioning.
    usable &= np.linalg.norm(X - np.median(X[usable], axis=0), axis=1) < 100.0 * spread
    T, X = T / spread, X / spread
    # Inliers of finite points in front of their cameras, at least two per point and ten per view.
    t = reconstruction.tracks
    there = reconstruction.registered[t.view_index] & usable[t.point_index]
    index = np.flatnonzero(reconstruction.inlier & there)
    place = np.searchsorted(views, t.view_index[index])
    index = index[np.einsum("kj,kj->k", R[place, 2], X[t.point_index[index]]) + T[place, 2] > 1e-6]
    index = index[np.bincount(t.view_index[index], minlength=t.n_views)[t.view_index[index]] >= 10]
    index = index[np.bincount(t.point_index[index], minlength=t.n_points)[t.point_index[index]] >= 2]
    total = len(index)
    if total > _MAX_OBSERVATIONS:
        # Every k-th track by length rather than the longest ones, which may lie in one corner of the scene.
        numbers, lengths = np.unique(t.point_index[index], return_counts=True)
        order = numbers[np.argsort(-lengths, kind="stable")]
        count = min(int(len(order) * _MAX_OBSERVATIONS / total) + 1, len(order))
        index = index[np.isin(t.point_index[index], order[np.arange(count) * len(order) // count])]
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


Arguments = ParamSpec("Arguments")

_SAME_LOG_FOCAL = 0.03  # candidates whose log focal lengths differ by less than this are the same
_MAX_LOG_STD = 1e3
FOCAL_LIMITS = (0.02, 200.0)  # focal lengths in long sides: fields of view from 178 to 0.3 degrees


def group_log_focals(frame: ReferenceFrame, K: F64) -> F64:
    """Return the median log focal length (G,) of each camera group for unit-free K (R, 3, 3)."""
    return frame.group_medians(0.5 * np.log(K[:, 0, 0] * K[:, 1, 1]))


@dataclass(frozen=True)
class Candidate:
    """One self-calibration: plane (3,), unit-free K (R, 3, 3) with standard deviations if known, and cost."""

    plane: F64
    K: F64
    cost: float
    method: str
    K_std: F64 | None = None


def as_stage_failure(calibrate: Callable[Arguments, SelfCalibration]) -> Callable[Arguments, SelfCalibration]:
    """Wrap a ``calibrate`` method so that a failed decomposition raises ``StageFailure``."""

    @wraps(calibrate)
    def inner(*args: Arguments.args, **kwargs: Arguments.kwargs) -> SelfCalibration:
        with np.errstate(all="ignore"):
            try:
                return calibrate(*args, **kwargs)
            except np.linalg.LinAlgError as error:
                raise cannot_be_calibrated(f"a matrix decomposition failed: {error}") from error

    return inner


def square_pixel_calibrations(log_f: F64) -> F64:
    """Return K = diag(f, f, 1) (..., 3, 3) of log focal lengths (...)."""
    return np.exp(log_f)[..., None, None] * np.diag([1.0, 1.0, 0.0]) + np.diag([0.0, 0.0, 1.0])


def group_focals_from_planes(frame: ReferenceFrame, p: F64, f_reference: F64) -> F64:
    """Log focals (B, G) by w*_i = H_i K_r K_r' H_i' of planes (B, 3), medians of the cameras of a group."""
    f = np.clip(f_reference, *FOCAL_LIMITS)
    H = frame.homographies(p)
    H[..., :2] *= f[:, None, None, None]
    ww = np.sum(H**2, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_f = 0.5 * np.log((ww[..., 0] + ww[..., 1]) / (2.0 * ww[..., 2]))
    low, high = np.log(FOCAL_LIMITS)
    log_f = np.clip(np.nan_to_num(log_f, nan=0.0, posinf=high, neginf=low), low, high)
    groups = frame.group_medians(log_f)
    groups[:, frame.group[frame.reference]] = np.log(f)
    return groups


def gherardi_fusiello_planes(frame: ReferenceFrame, other: int, f_reference: F64, f_other: F64) -> F64:
    """Planes at infinity (2 B, 3) of the focals (B,) of two views (Gherardi and Fusiello, ECCV 2010)."""
    # For both signs of the other camera. Bougnoux's formula (ICCV 1998) gives two focals from F alone, but
    # has no solution if the optical axes meet, which is usual: focals are scanned instead.
    K1 = np.stack([f_reference, f_reference, np.ones_like(f_reference)], axis=1)
    K2 = np.stack([f_other, f_other, np.ones_like(f_other)], axis=1)
    t = frame.a[other] / K2
    # Rotations with R t = (|t|, 0, 0).
    first = t / np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-300)
    second = np.cross(first, np.eye(3)[np.abs(first).argmin(axis=1)])
    second /= np.maximum(np.linalg.norm(second, axis=1, keepdims=True), 1e-300)
    rotation = np.stack([first, second, np.cross(first, second)], axis=1)
    W = rotation @ ((frame.A[other][None] / K2[:, :, None]) * K1[:, None, :])
    planes = []
    for sign in (1.0, -1.0):
        w1, w2, w3 = sign * W[:, 0], sign * W[:, 1], sign * W[:, 2]
        length = np.maximum(np.linalg.norm(w3, axis=1, keepdims=True), 1e-300)
        baseline = sign * np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-300)
        planes.append(-(np.cross(w2, w3) / length - w1) / baseline / K1)
    return np.concatenate(planes)


def candidates_from_parameters(frame: ReferenceFrame, theta: F64, cost: F64, method: str) -> list[Candidate]:
    """Return one candidate with square pixels for each row (plane, log focal lengths) (B, 3 + G)."""
    K = square_pixel_calibrations(theta[:, 3:][:, frame.group])
    return [Candidate(t[:3], k, float(c), method) for t, k, c in zip(theta, K, cost, strict=True)]


def _same_focals(frame: ReferenceFrame, one: Candidate, other: Candidate) -> bool:
    difference = group_log_focals(frame, one.K) - group_log_focals(frame, other.K)
    return bool(np.abs(difference).max() < _SAME_LOG_FOCAL)


def distinct_candidates(
    frame: ReferenceFrame, candidates: Sequence[Candidate], max_candidates: int
) -> list[Candidate]:
    """Return the best candidates of finite cost whose focal lengths or planes differ, best first."""

    def same(one: Candidate, other: Candidate) -> bool:
        apart = np.linalg.norm(one.plane - other.plane) > _SAME_LOG_FOCAL * np.linalg.norm(one.plane)
        return not apart and _same_focals(frame, one, other)

    chosen: list[Candidate] = []
    for candidate in sorted(candidates, key=lambda a: a.cost):
        if len(chosen) == max_candidates or not np.isfinite(candidate.cost):
            break
        if not any(same(candidate, other) for other in chosen):
            chosen.append(candidate)
    return chosen


def select_candidate(
    frame: ReferenceFrame, reconstruction: Reconstruction, candidates: Sequence[Candidate], *,
    max_candidates: int = 1, min_in_front_ratio: float = 0.5,
) -> SelfCalibration:  # fmt: skip
    """Select the best candidates of different focals with enough points in front; check them."""
    chosen: list[tuple[Candidate, Upgrade]] = []
    for tried in sorted(candidates, key=lambda a: a.cost):
        if len(chosen) == max_candidates or not np.isfinite(tried.cost):
            break
        if not any(_same_focals(frame, tried, other) for other, _ in chosen):
            upgrade = _hartley_zisserman_upgrade(frame, reconstruction, tried, min_in_front_ratio)
            chosen += [(tried, upgrade)] if upgrade is not None else []
    if not chosen:
        raise _no_candidate_failure(frame, reconstruction, len(candidates))
    candidate, best = chosen[0]
    theta = np.concatenate([candidate.plane, group_log_focals(frame, candidate.K)])
    std_log_f = focal_std(frame, theta)
    report = check_identifiability(reconstruction, best, frame.prior)
    K_std = _calibration_std(frame, best.K, candidate, np.minimum(std_log_f[frame.group], _MAX_LOG_STD))
    reasons = _biased_focal(frame, best, report) if report.identifiable else report.sentences
    return SelfCalibration(
        best.metric_from_projective, best.K, K_std, report.identifiable, reasons,
        tuple(upgrade for _, upgrade in chosen), report,
    )  # fmt: skip


def _biased_focal(frame: ReferenceFrame, best: Upgrade, report: IdentifiabilityReport) -> tuple[str, ...]:
    """A sentence if bundle adjustment moves the focal length by over 3 % and three standard deviations."""
    longest = frame.pixel_from_unit[frame.views, 0, 0]
    focal = float(np.median(best.K[frame.views, 0, 0] / longest))
    refined = report.evidence.get("focal_long_sides", focal)
    if abs(focal / refined - 1.0) <= max(0.03, 3.0 * report.evidence.get("focal_std_rel_median", 0.0)):
        return ()
    pixels = refined * float(np.median(longest))
    return (
        f"the focal length of this method is {focal / refined - 1.0:+.0%} from that of bundle adjustment, "
        f"{pixels:.0f} px: the views determine it, but K is only a start; use a method that refines it, such "
        "as nonlinear-quadric",
    )


def _no_candidate_failure(frame: ReferenceFrame, reconstruction: Reconstruction, tried: int) -> StageFailure:
    """Return the failure of a method that has no acceptable candidate."""
    candidates, views = counted(tried, "candidate calibration"), counted(len(frame.views), "view")
    evidence = f"none of {candidates} of {views} places the points in front of the cameras"
    given = frame.views[frame.prior.focal_known[frame.views]]
    if len(given):
        # All candidates are near the given focal length, so the advice to give one does not help here.
        focal = frame.prior.mean[given, 0]
        values = f"{focal.min():.0f}" if np.ptp(focal) < 0.5 else f"{focal.min():.0f} to {focal.max():.0f}"
        return StageFailure.of("no-calibration-near-focal", values, frame.prior.std[given, 0].max(), evidence)
    sentences = identifiability_without_calibration(reconstruction, frame.prior).sentences
    advice = "; ".join(sentences) or "take images from more directions and rotate the camera between them"
    return StageFailure(Notice("self-calibration"), evidence, advice)


def _calibration_std(frame: ReferenceFrame, K: F64, candidate: Candidate, focal_std: F64) -> F64:
    """Standard deviations (V, 3, 3) of K: the candidate's, else of focal lengths and prior, else NaN."""
    K_std, rows = np.zeros_like(K), frame.views
    if candidate.K_std is not None:
        # The last row of K is known, so rows only change their unit.
        unit = np.diagonal(frame.pixel_from_unit[rows], axis1=1, axis2=2)
        K_std[rows] = unit[:, :, None] * candidate.K_std
        return K_std
    prior = np.where(np.isfinite(frame.prior.std), frame.prior.std, np.nan)[rows]
    K_std[rows, 0, 0] = K[rows, 0, 0] * focal_std
    K_std[rows, 1, 1] = K[rows, 1, 1] * np.hypot(focal_std, prior[:, 1] / frame.prior.mean[rows, 1])
    K_std[rows, 0, 1], K_std[rows, 0, 2], K_std[rows, 1, 2] = prior[:, 2:5].T
    square = square_pixel_calibrations(np.log(candidate.K[:, 0, 0]))
    if not np.allclose(candidate.K, square, atol=1e-12):
        K_std[rows[:, None], (0, 0, 0, 1, 1), (0, 1, 2, 1, 2)] = np.nan
    return K_std


def _hartley_zisserman_upgrade(
    frame: ReferenceFrame, reconstruction: Reconstruction, candidate: Candidate, min_in_front_ratio: float
) -> Upgrade | None:
    """The upgrade (HZ 19.2), mirrored if most points are behind; None if singular or too few in front."""
    H, K_reference = np.eye(4), candidate.K[frame.reference]
    H[:3, :3], H[3, :3] = K_reference, -candidate.plane @ K_reference  # HZ 19.2
    if not (np.isfinite(candidate.K).all() and np.isfinite(H).all() and abs(np.linalg.det(H)) > 1e-300):
        return None
    G = np.linalg.inv(H) @ frame.reference_from_projective
    keep, share = reconstruction.inlier, 1.0  # cameras alone do not determine the handedness
    if keep.any():
        view, point = reconstruction.tracks.view_index[keep], reconstruction.tracks.point_index[keep]
        P, X = reconstruction.P @ np.linalg.inv(G), reconstruction.X @ G.T
        P *= np.where(np.linalg.det(P[:, :, :3]) < 0, -1.0, 1.0)[:, None, None]
        share = float((np.einsum("kj,kj->k", P[view, 2], X[point]) * X[point, 3] > 0).mean())
    if share < 0.5:
        G, share = np.diag([-1.0, -1.0, -1.0, 1.0]) @ G, 1.0 - share
    if share < min_in_front_ratio:
        return None
    K = np.zeros((len(reconstruction.P), 3, 3))
    K[frame.views] = frame.pixel_from_unit[frame.views] @ candidate.K
    return Upgrade(G, K, candidate.cost, candidate.method)
