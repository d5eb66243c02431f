"""Identifiability of the calibration: the nearest critical motion, and whether the prior resolves it.

Critical motions (HZ 19.8, 19.9; P. Sturm, CVPR 1997, and BMVC 1999 for varying focal lengths; F. Kahl, B.
Triggs, K. Astrom, JMIV 13, 2000) are invariant under the transforms that they leave undetermined, so that the
measures here hold for any of these solutions. The covariance of the focal lengths with free poses and points
decides: a turntable leaves the scale along its axis and the aspect ratio undetermined; square pixels resolve
both.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import Notice
from thesisrecon.optimize.bundle.metric import BundleOptions, MetricBundleResult, refine_metric_bundle
from thesisrecon.optimize.bundle.projection import MetricCameras, Observations
from thesisrecon.records import IdentifiabilityReport, IntrinsicsPrior

PLANE = "planar scene"
ROTATION = "pure rotation"
TRANSLATION = "pure translation"
OPTICAL_AXIS = "rotation about the optical axis"
TURNTABLE = "turntable"
PLANAR = "planar motion"
PARALLEL_AXES = "parallel rotation axes"

# Tolerances for the unintended motion of a hand-held camera: rotations of a degree about each axis (twice
# that between two images), translations of a hundredth of the distance.
TOLERANCES: Mapping[str, float] = {
    "scene_planarity_ratio": 0.02,
    "centre_spread_over_distance": 0.03,
    "infinity_shift": 0.08,
    "infinity_shift_beyond_roll": 0.08,
    "rotation_rms_deg": 3.5,
    "optical_axis_rms_deg": 3.5,
    "rotation_axis_spread_deg": 3.0,
    "turntable_residual_over_distance": 0.05,
    "axial_translation_over_distance": 0.025,
}

MAX_CAMERAS = 1000
_MAX_SHIFT = 10.0  # long sides; also used for points that rotate behind the camera

# Sorted by how much the motion leaves undetermined. A motion is critical if all its measures are within
# tolerance.
_MEASURES_OF: Mapping[str, tuple[str, ...]] = {
    PLANE: ("scene_planarity_ratio",),
    ROTATION: ("centre_spread_over_distance",),
    TRANSLATION: ("infinity_shift",),
    OPTICAL_AXIS: ("infinity_shift_beyond_roll",),
    TURNTABLE: (
        "rotation_axis_spread_deg",
        "turntable_residual_over_distance",
        "axial_translation_over_distance",
    ),
    PLANAR: ("rotation_axis_spread_deg", "axial_translation_over_distance"),
    PARALLEL_AXES: ("rotation_axis_spread_deg",),
}

# With a long lens an unintended rotation moves the image more, so it is enough if the shift or the angle is
# within its tolerance. The angle depends on the focal length, which may be undetermined; the shift does not.
_ALTERNATIVE: Mapping[str, str] = {
    "infinity_shift": "rotation_rms_deg",
    "infinity_shift_beyond_roll": "optical_axis_rms_deg",
}

MAX_FOCAL_STD = 0.15  # A focal length with a larger relative standard deviation is undetermined
# Image noise can be mistaken for a small rotation, which makes the covariance too small: a rotation counts if
# it exceeds its standard deviation by this factor.
MIN_ROTATION_SIGNIFICANCE = 4.0
# In long sides. Unmodelled lens errors (resampling, focus breathing) move images by about 1e-4, equally in
# all parts of the scene, so that no covariance contains them. A rotation that moves the image by s determines
# f by its second-order part s (x / f)^2, about s / 10: for f to 15 %, 2 (s / 10) 0.15 must exceed 1e-4.
MIN_INFINITY_SHIFT = 0.003
_ROTATE = "rotate the camera by at least 10 degrees between images, about the vertical and a horizontal axis"
_HEIGHTS = "take some images from higher or lower positions, or with the camera rolled by 90 degrees"
_ADVICE: Mapping[str, str] = {
    PLANE: "include objects at different depths",
    ROTATION: "walk around the scene between images",
    TRANSLATION: _ROTATE,
    OPTICAL_AXIS: "point the camera in different directions",
    TURNTABLE: _HEIGHTS,
    PLANAR: _HEIGHTS,
    PARALLEL_AXES: "tilt the camera up and down too, or roll it by 90 degrees",
}


@dataclass(frozen=True)
class UpgradedCameras:
    """Metric cameras: unit-free focal lengths (V,), R (V, 3, 3), C (V, 3), and points X (N, 3)."""

    focal: F64
    R: F64
    C: F64
    X: F64

    @property
    def distance(self) -> float:
        """Median distance from the cameras to the median point."""
        centre = np.median(self.X, axis=0)
        return max(float(np.median(np.linalg.norm(centre - self.C, axis=1))), 1e-300)

    def infinite_homographies(self) -> F64:
        """Return the unit-free infinite homographies (V, 3, 3) from the view nearest to the mean rotation."""
        mean = scipy.spatial.transform.Rotation.from_matrix(self.R).mean().as_matrix()
        middle = int(scipy.spatial.transform.Rotation.from_matrix(self.R @ mean.T).magnitude().argmin())
        K = np.stack([self.focal, self.focal, np.ones_like(self.focal)], axis=1)
        return np.asarray(K[:, :, None] * (self.R @ self.R[middle].T) / K[middle])


def measure_motion(metric: UpgradedCameras) -> dict[str, float]:
    """Return the measures of ``TOLERANCES`` by name and the largest rotation, of ``MAX_CAMERAS`` cameras."""
    if len(metric.R) > MAX_CAMERAS:
        few = np.unique(np.rint(np.linspace(0, len(metric.R) - 1, MAX_CAMERAS)).astype(np.int64))
        metric = UpgradedCameras(metric.focal[few], metric.R[few], metric.C[few], metric.X)
    i, j = np.triu_indices(len(metric.R), 1)
    relative = metric.R[j].swapaxes(1, 2) @ metric.R[i]
    rotations = scipy.spatial.transform.Rotation.from_matrix(relative).as_rotvec()
    spread, axes = np.linalg.eigh(rotations.T @ rotations / len(rotations))
    # The direction nearest to all rotation axes.
    axis, (z_i, z_j) = axes[:, 2], metric.R[[i, j], 2]
    views = np.arctan2(np.linalg.norm(np.cross(z_i, z_j), axis=1), np.sum(z_i * z_j, axis=1))
    H, offset = metric.infinite_homographies(), metric.C - metric.C.mean(axis=0)
    # Distances of the centres from a common circular motion about one line along the axis.
    seen = metric.R @ (np.eye(3) - np.outer(axis, axis))
    places = np.einsum("vab,vb->va", seen, metric.C)
    coefficients, right = seen - seen.mean(axis=0), places - places.mean(axis=0)
    c = np.linalg.lstsq(coefficients.reshape(-1, 3), right.ravel(), rcond=1e-9)[0]
    return {
        "scene_planarity_ratio": _planarity_ratio(metric.X),
        "centre_spread_over_distance": _rms(offset) / metric.distance,
        "infinity_shift": _infinite_homography_shift(H, roll=False),
        "infinity_shift_beyond_roll": _infinite_homography_shift(H, roll=True),
        "largest_rotation_deg": float(np.degrees(np.linalg.norm(rotations, axis=1).max())),
        "rotation_rms_deg": float(np.degrees(_rms(rotations))),
        "optical_axis_rms_deg": float(np.degrees(_rms(views[:, None]))),
        "rotation_axis_spread_deg": float(np.degrees(np.sqrt(max(spread[1], 0.0)))),
        "turntable_residual_over_distance": _rms(right - coefficients @ c) / metric.distance,
        "axial_translation_over_distance": _rms((offset @ axis)[:, None]) / metric.distance,
    }


def nearest_critical_motion(measures: Mapping[str, float]) -> tuple[str, float]:
    """The nearest critical motion, and its largest measure over its tolerance (chapter 7)."""
    ratio = {key: measures[key] / TOLERANCES[key] for key in measures.keys() & TOLERANCES.keys()}
    for key, alternative in _ALTERNATIVE.items():
        if key in ratio:
            ratio[key] = min(ratio[key], ratio.get(alternative, np.inf))
    near = {
        name: max(ratio[key] for key in needed)
        for name, needed in _MEASURES_OF.items()
        if ratio.keys() >= set(needed)
    }
    within = [name for name, distance in near.items() if distance < 1.0]
    if ROTATION in within and near.get(TRANSLATION, 1.0) < near[ROTATION]:
        within.remove(ROTATION)
    chosen = within[0] if within else min(near, key=lambda name: near[name])
    return chosen, near[chosen]


def _infinite_homography_shift(H: F64, *, roll: bool) -> float:
    """Rms shift (long sides) of points at infinity by H (V, 3, 3) beyond zoom and, with ``roll``, roll."""
    template = np.zeros_like(H)
    zoom = (H[:, 0, 0] + H[:, 1, 1]) / 2.0
    # A roll of 180 degrees is no zoom, although it maps points as one with a negative scale.
    template[:, 0, 0] = template[:, 1, 1] = zoom if roll else np.where(zoom * H[:, 2, 2] > 0.0, zoom, 0.0)
    template[:, 2, 2] = H[:, 2, 2]
    if roll:
        template[:, 1, 0] = (H[:, 1, 0] - H[:, 0, 1]) / 2.0
        template[:, 0, 1] = -template[:, 1, 0]
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.4, 0.4, 5))
    grid = np.stack([u.ravel(), v.ravel(), np.ones(25)])
    shift = np.sum((_dehomogenized(H @ grid) - _dehomogenized(template @ grid)) ** 2, axis=1)
    return float(np.sqrt(np.mean(np.minimum(shift, _MAX_SHIFT**2))))


def _dehomogenized(x: F64) -> F64:
    """Return (V, 2, M) from (V, 3, M), finite."""
    w = x[:, 2:]
    return np.asarray(x[:, :2] / np.where(np.abs(w) < 1e-9, 1e-9, w))


def projective_infinity_shifts(A: F64, a: F64) -> dict[str, float]:
    """Return lower bounds of the shifts of points at infinity from projective cameras [A | a] alone.

    For the plane p with A_i - a_i p' nearest to diag(g, g, h), with roll [[g, -k, 0], [k, g, 0], [0, 0, h]].
    """
    identity = np.zeros((3, 3, 3))
    identity[0, 0, 0] = identity[0, 1, 1] = identity[1, 2, 2] = identity[2, 1, 0] = 1.0
    identity[2, 0, 1] = -1.0
    shifts = {}
    for name, kinds in (("infinity_shift", 2), ("infinity_shift_beyond_roll", 3)):
        rows = np.zeros((len(A), 9, 3 + kinds * len(A)))
        for k in range(3):
            rows[:, k::3, k] = a
        for i in range(len(A)):
            rows[i, :, 3 + kinds * i : 3 + kinds * (i + 1)] = identity[:kinds].reshape(kinds, 9).T
        p = np.linalg.lstsq(rows.reshape(9 * len(A), -1), A.reshape(-1), rcond=None)[0][:3]
        shifts[name] = _infinite_homography_shift(A - a[:, :, None] * p, roll=kinds == 3)
    return shifts


def _rms(vectors: F64) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _planarity_ratio(X: F64) -> float:
    """Rms thickness of the nearest 95 % of points (N, 3) about their plane over their rms extent in it."""

    def nearest(distance: F64) -> I64:
        return np.argsort(distance, kind="stable")[: max(int(0.95 * len(distance)), 4)]

    X = X[nearest(np.linalg.norm(X - np.median(X, axis=0), axis=1))]
    near = X
    for _ in range(3):
        normal = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][2]
        near = X[nearest(np.abs((X - near.mean(axis=0)) @ normal))]
    s = np.linalg.svd(near - near.mean(axis=0), compute_uv=False)
    return float(s[2] / max(float(s[1]), 1e-300))


def excess_equations(prior: IntrinsicsPrior, registered: B8) -> int:
    """The counting argument: m n_known + (m - 1) n_constant - 8 (Pollefeys et al. 1999)."""
    unknown = 0
    for column in range(5):
        open_ = registered & ~np.isfinite(prior.std[:, column])
        unknown += len(np.unique(prior.shared[open_, column]))
    return 5 * int(registered.sum()) - unknown - 8


@dataclass(frozen=True)
class CalibrationProblem:
    """Adjustment of the ``views`` with own intrinsics, to a ``share`` of their observations."""

    cameras: MetricCameras
    X: F64
    observations: Observations
    prior: IntrinsicsPrior
    sigma_px: float
    share: float
    longest: F64
    views: I64
    projective_px: float = np.inf

    def adjust(self, *, iterations: int) -> MetricBundleResult:
        """Adjust focal length, aspect ratio and principal point under the prior, with their covariance."""
        free = np.isin(np.arange(self.cameras.intrinsics.shape[1]), (0, 1, 3, 4))
        return refine_metric_bundle(
            self.cameras, self.X, self.observations, free=free, prior=self.prior,
            # 0.1 standard deviations do not change a covariance; few residuals may be small by chance.
            options=BundleOptions(
                sigma_px=self.sigma_px, loss_px=2.0 * self.sigma_px, max_iterations=iterations,
                settled=5e-3, covariance=True, noise_floor_px=0.05,
            ),
        )  # fmt: skip

    def with_free_intrinsics(self, fit: MetricBundleResult) -> "CalibrationProblem":
        """The problem at the solution ``fit`` with a free aspect and principal point per focal."""
        std = np.full_like(self.prior.std, 1e3)
        std[:, 3:5] *= self.longest.max()
        shared = np.array(fit.cameras.shared)
        shared[:, 1:5] = shared[:, :1]
        # Shared values take those of the first view.
        first = np.unique(shared[:, 0], return_index=True)[1][np.unique(shared[:, 0], return_inverse=True)[1]]
        intrinsics = np.column_stack([fit.cameras.intrinsics[:, 0], fit.cameras.intrinsics[first, 1:]])
        cameras = replace(fit.cameras, shared=shared, intrinsics=intrinsics)
        prior = IntrinsicsPrior.unshared(intrinsics, std)
        return replace(self, cameras=cameras, X=fit.X, prior=prior, sigma_px=max(fit.sigma_px, 1e-6))


def identifiability_report(
    problem: CalibrationProblem, excess: int, *, iterations: int = 0,
    motion: Mapping[str, float] | None = None, focal_std: F64 | None = None,
) -> IdentifiabilityReport:  # fmt: skip
    """Return the report; focal lengths in long sides, ``focal_std_rel`` of the worst view, others medians.

    The measures of the ``motion`` with the median focal length, and the relative standard deviations of the
    focal lengths (V,) are by default those of the adjusted problem.
    """
    fit = problem.adjust(iterations=iterations)
    free = problem.with_free_intrinsics(fit).adjust(iterations=0)
    cameras, views = fit.cameras, problem.views
    focal = cameras.intrinsics[cameras.group, 0] / problem.longest
    adjusted = UpgradedCameras(focal, cameras.R, cameras.centres, fit.X)
    evidence = dict(motion or measure_motion(adjusted))
    long_sides = evidence.pop("focal_long_sides", float(np.median(focal)))
    nearest, distance = nearest_critical_motion(evidence)
    evidence["critical_motion_distance"] = distance
    own, free_std = _focal_std(fit, problem), _focal_std(free, problem)
    std = own if focal_std is None else focal_std
    # The given standard deviations do not contain the effect of the free intrinsics.
    free_std = np.hypot(std, np.sqrt(np.maximum(free_std**2 - np.minimum(own, free_std) ** 2, 0.0)))
    variance = np.diagonal(free.intrinsics_covariance, axis1=1, axis2=2)[cameras.group, 3:5].max(axis=1)
    centre = np.sqrt(variance) / problem.longest
    root_share = float(np.sqrt(problem.share))
    # The rms rotation of the optical axes in units of its standard deviation.
    assert fit.pose_covariance is not None
    axis = cameras.R[:, 2].mean(axis=0)
    tilt = (cameras.R @ (axis / max(float(np.linalg.norm(axis)), 1e-12)))[:, :2]
    noise = float(np.mean(np.diagonal(fit.pose_covariance, axis1=1, axis2=2)[:, :2]))
    turned = float(np.sqrt(np.mean(tilt**2) / max(noise, 1e-300))) if np.isfinite(noise) else 0.0
    projective_px = max(problem.projective_px, 3e-5 * float(np.median(problem.longest)))
    evidence |= {
        "focal_long_sides": long_sides,
        "focal_std_rel": float(std.max()),
        "focal_std_rel_median": float(np.median(std)),
        "focal_std_rel_free": float(np.median(free_std)),
        "principal_point_std_free": float(np.median(centre) * root_share),
        "rotation_significance": turned / root_share,
        "excess_equations": float(excess),
        "noise_px": fit.sigma_px,
        "noise_ratio_to_projective": fit.sigma_px / projective_px,
    }
    undetermined = views[std >= MAX_FOCAL_STD]
    # A prior that fixes the focal length does so for any motion.
    known_focal = bool((problem.prior.std[:, 0] < MAX_FOCAL_STD).all())
    has_rotated = (
        evidence["rotation_significance"] >= MIN_ROTATION_SIGNIFICANCE
        and evidence["infinity_shift_beyond_roll"] >= MIN_INFINITY_SHIFT
    )
    determined = (
        len(views) - len(undetermined) >= max(2 if known_focal else 3, (len(views) + 1) // 2)
        and excess >= 0
        and (has_rotated or known_focal)
    )
    contradicted = _has_excess_noise(evidence)
    identifiable = determined and not contradicted
    given = float(problem.prior.std[:, 0].max())
    sentences = identifiability_sentences(nearest, evidence, identifiable=identifiable, focal_std=given)
    views_without = tuple(int(v) for v in undetermined)
    found = (nearest, distance < 1.0, evidence, sentences, views_without)
    return IdentifiabilityReport(identifiable, *found, determined and contradicted)


def _focal_std(fit: MetricBundleResult, problem: CalibrationProblem) -> F64:
    """Return the relative standard deviations (V,) that all observations would give."""
    group = fit.cameras.group
    variance = np.maximum(fit.intrinsics_covariance[group, 0, 0], 0.0)
    std = np.sqrt(variance) / fit.cameras.intrinsics[group, 0] * np.sqrt(problem.share)
    return np.asarray(np.where(np.isfinite(std), std, np.inf), dtype=np.float64)


def identifiability_sentences(
    motion: str, evidence: Mapping[str, float], *, identifiable: bool, focal_std: float
) -> tuple[str, ...]:
    """What was found, what it means and what to do, as clauses; empty for a general motion."""
    is_critical = bool(motion) and evidence["critical_motion_distance"] < 1.0
    calibrated = "focal_std_rel" in evidence
    sentences: list[str] = []
    if evidence["excess_equations"] < 0:
        sentences.append(Notice("too-few-equations", -evidence["excess_equations"]))
    if is_critical:
        kind = motion if calibrated else f"projective {motion}"
        sentences.append(Notice(kind.replace(" ", "-"), evidence))
    if _has_excess_noise(evidence):
        sentences.append(excess_noise(evidence))
    if identifiable and is_critical:
        std, free_std = evidence["focal_std_rel_median"], evidence["focal_std_rel_free"]
        if motion in (TURNTABLE, PLANAR, PARALLEL_AXES) and free_std > 2.0 * std:
            given = _percent(std), _percent(free_std), _ADVICE[motion]
            sentences.append(Notice("resolved-by-square-pixels", *given))
        elif motion in (PLANE, ROTATION):
            sentences.append(Notice("resolved-by-prior", _percent(std), _ADVICE[motion]))
        else:
            sentences.append(Notice("resolved-by-departure", _percent(std)))
    if identifiable:
        return tuple(sentences)
    return (*sentences, *_failure(motion, evidence, is_critical, focal_std))


def excess_noise(evidence: Mapping[str, float]) -> str:
    """A clause on a prior of the intrinsics that the images contradict."""
    return Notice("excess-noise", evidence["noise_ratio_to_projective"])


def _failure(motion: str, evidence: Mapping[str, float], is_critical: bool, focal_std: float) -> list[str]:
    """Return clauses with the reason why the focal length is not determined, and advice."""
    advice = _ADVICE.get(motion, _ROTATE) if is_critical else _ROTATE
    if advice in (_ROTATE, _ADVICE[OPTICAL_AXIS]) and focal_std > 0.0:
        given = " more exactly" if focal_std < float("inf") else ""
        advice += f", or give the focal length{given}"
    if "focal_std_rel" not in evidence:
        return [advice] if motion else [Notice("untested-focal", advice)]
    std = evidence["focal_std_rel_median"]
    if evidence["rotation_significance"] < MIN_ROTATION_SIGNIFICANCE and std < MAX_FOCAL_STD:
        return [Notice("rotations-within-noise", advice)]
    if evidence["infinity_shift_beyond_roll"] < MIN_INFINITY_SHIFT and std < MAX_FOCAL_STD:
        return [Notice("small-rotations", evidence["infinity_shift_beyond_roll"], advice)]
    if std >= MAX_FOCAL_STD:
        return [Notice("uncertain-focal", _percent(std), advice)]
    # Rotating the camera does not help against a wrong prior of the intrinsics.
    return [] if _has_excess_noise(evidence) else [advice]


def _has_excess_noise(evidence: Mapping[str, float]) -> bool:
    """Whether the noise of metric over projective cameras means a wrong prior (distortion gives less)."""
    return evidence.get("noise_ratio_to_projective", 0.0) >= 3.0


def _percent(share: float) -> str:
    if share < 0.001:
        return "better than 0.1 %"
    return f"{100.0 * share:.1f} %" if share < 0.1 else f"{100.0 * min(share, 9.99):.0f} %"
