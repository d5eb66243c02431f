"""Identifiability of the calibration: the nearest critical motion, and whether the prior resolves it.

The covariance of the focal lengths with free poses and points decides: a turntable leaves the scale along its
axis and the aspect ratio undetermined; square pixels resolve both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import Notice
from thesisrecon.geometry.critical_motions import (
    OPTICAL_AXIS,
    PARALLEL_AXES,
    PLANAR,
    PLANE,
    ROTATION,
    TRANSLATION,
    TURNTABLE,
    UpgradedCameras,
    measure_motion,
    nearest_critical_motion,
)
from thesisrecon.optimize.bundle.metric import BundleOptions, MetricBundleResult, refine_metric_bundle
from thesisrecon.optimize.bundle.metric_kernels import MetricCameras
from thesisrecon.optimize.bundle.observations import Observations
from thesisrecon.records import IdentifiabilityReport, IntrinsicsPrior

# A focal length with a larger relative standard deviation is undetermined.
MAX_FOCAL_STD = 0.15
# Image noise can be mistaken for a small rotation, which makes the covariance too small: a rotation counts if
# it exceeds its standard deviation by this factor.
MIN_ROTATION_SIGNIFICANCE = 4.0
# In long sides. Unmodelled lens errors (resampling, focus breathing) move images by about 1e-4, equally in
# all parts of the scene, so that no covariance contains them. A rotation that moves the image by s determines
# f by its second-order part s (x / f)^2, about s / 10: for f to 15 %, 2 (s / 10) 0.15 must exceed 1e-4.
MIN_INFINITY_SHIFT = 0.003
_FOUND: Mapping[str, str] = {
    PLANE: (
        "the scene is planar: the points lie in one plane to {scene_planarity_ratio:.1%} of its width, which "
        "hardly determines the cameras"
    ),
    ROTATION: (
        "close to a pure rotation: the camera moved by only {centre_spread_over_distance:.1%} of the "
        "distance to the scene, which determines the focal length but hardly any depth"
    ),
    TRANSLATION: (
        "close to a pure translation: the rotations (at most {largest_rotation_deg:.1f} degrees) move points "
        "at infinity by {infinity_shift:.1%} of the image, which hardly determines the focal length"
    ),
    OPTICAL_AXIS: (
        "the camera rotated about its optical axis only and looked in one direction, which does not "
        "determine the focal length"
    ),
    TURNTABLE: (
        "turntable motion: all views rotate about one axis (to within {rotation_axis_spread_deg:.1f} "
        "degrees), which does not determine the scale along the axis unless the aspect ratio of the pixels "
        "is known"
    ),
    PLANAR: (
        "planar motion: the camera moved in a plane and rotated about one direction (to within "
        "{rotation_axis_spread_deg:.1f} degrees), which does not determine the scale across the plane unless "
        "the aspect ratio of the pixels is known"
    ),
    PARALLEL_AXES: (
        "all rotation axes are parallel (to within {rotation_axis_spread_deg:.1f} degrees), which does not "
        "determine the scale along the axes unless the aspect ratio of the pixels is known"
    ),
}
_FOUND_PROJECTIVE: Mapping[str, str] = {
    TRANSLATION: (
        "the projective cameras fit a pure translation, which does not determine the focal length (points at "
        "infinity move by {infinity_shift:.1%} of the image)"
    ),
    OPTICAL_AXIS: (
        "the projective cameras fit a rotation about the optical axis, which does not determine the focal "
        "length (points at infinity move by {infinity_shift_beyond_roll:.1%} of the image)"
    ),
}
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


def excess_equations(prior: IntrinsicsPrior, registered: B8) -> int:
    """Equations beyond the 8 needed: m n_known + (m - 1) n_constant - 8 (Pollefeys et al. 1999)."""
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

    def with_free_intrinsics(self, fit: MetricBundleResult) -> CalibrationProblem:
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
    projective_px = max(problem.projective_px, 3e-5 * float(np.median(problem.longest)))
    evidence |= {
        "focal_long_sides": long_sides,
        "focal_std_rel": float(std.max()),
        "focal_std_rel_median": float(np.median(std)),
        "focal_std_rel_free": float(np.median(free_std)),
        "principal_point_std_free": float(np.median(centre) * root_share),
        "rotation_significance": _rotation_significance(cameras.R, fit.pose_covariance) / root_share,
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
        len(views) - len(undetermined) >= max(3, (len(views) + 1) // 2)
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


def _rotation_significance(R: F64, covariance: F64 | None) -> float:
    """Rms rotation of the optical axes in units of its standard deviation, 0 without covariances."""
    if covariance is None:
        return 0.0
    mean = R[:, 2].mean(axis=0)
    tilt = (R @ (mean / max(float(np.linalg.norm(mean)), 1e-12)))[:, :2]
    variance = float(np.mean(np.diagonal(covariance, axis1=1, axis2=2)[:, :2]))
    return float(np.sqrt(np.mean(tilt**2) / max(variance, 1e-300))) if np.isfinite(variance) else 0.0


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
        found = (_FOUND if calibrated else _FOUND_PROJECTIVE)[motion]
        sentences.append(found.format(**evidence))
    if _has_excess_noise(evidence):
        sentences.append(excess_noise(evidence))
    if identifiable:
        return (*sentences, *_resolution(motion, evidence)) if is_critical else tuple(sentences)
    return (*sentences, *_failure(motion, evidence, is_critical, focal_std))


def excess_noise(evidence: Mapping[str, float]) -> str:
    """A clause on a prior of the intrinsics that the images contradict."""
    return Notice("excess-noise", evidence["noise_ratio_to_projective"])


def _resolution(motion: str, evidence: Mapping[str, float]) -> list[str]:
    """Return clauses on how the focal length is determined in spite of the critical motion."""
    std, free_std = evidence["focal_std_rel_median"], evidence["focal_std_rel_free"]
    if motion in (TURNTABLE, PLANAR, PARALLEL_AXES) and free_std > 2.0 * std:
        return [Notice("resolved-by-square-pixels", _percent(std), _percent(free_std), _ADVICE[motion])]
    if motion in (PLANE, ROTATION):
        return [Notice("resolved-by-prior", _percent(std), _ADVICE[motion])]
    return [Notice("resolved-by-departure", _percent(std))]


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
    """Whether the noise of metric over projective cameras means a wrong prior.

    A principal point or distortion that only the projective cameras can absorb gives a smaller ratio.
    """
    return evidence.get("noise_ratio_to_projective", 0.0) >= 3.0


def _percent(share: float) -> str:
    if share < 0.001:
        return "better than 0.1 %"
    return f"{100.0 * share:.1f} %" if share < 0.1 else f"{100.0 * min(share, 9.99):.0f} %"
