"""Synthetic data as tasks: F of the cube of the thesis (5.5), triangulation, and chapter 7."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from typing import ClassVar, get_args

import numpy as np

from thesisrecon.api.cameras import triangulate
from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_from_options
from thesisrecon.errors import StageFailure, unknown_word
from thesisrecon.geometry.polynomial_triangulation import triangulate_polynomial
from thesisrecon.geometry.two_view import epipoles, fundamental_from_cameras, symmetric_residuals
from thesisrecon.records import IntrinsicsPrior, Reconstruction
from validation.ablation.statistics import Sample
from validation.ablation.study import Measure, Place, Task
from validation.metrics.focal_bound import focal_bound
from validation.metrics.fundamental_precision import fundamental_bound
from validation.references.fundamental import colmap_points, opencv_linear, opencv_polynomial
from validation.scenes.cube import OFF_FACE, K, cube_pairs, make_cube
from validation.scenes.rigs import SCENES as RIGS
from validation.scenes.rigs import (
    Group,
    Rig,
    cube_rig,
    draw_rig,
    make_cloud,
    noisy_tracks,
    projective_from_truth,
    squared_distances,
    zoomed,
)
from validation.scenes.two_views import TwoViews
from validation.studies.epipolar_methods import MATCHED_SIGMAS, METHODS, THRESHOLD_PX

BY_METHOD = {m.name: m for m in METHODS}
OF_CONFIG = "epipolar of the configuration"


@dataclass(frozen=True)
class FundamentalOfCube(Task):
    """``pairs`` pairs of the 27 cameras, drawn by the seed, with Gaussian noise of ``noise_px`` and a share
    ``outliers`` of matches thrown anywhere. ``method`` is one of the catalogue of methods of F; "epipolar of
    the configuration" is the variant of that stage, whose threshold is its own. ``iterations`` and the like
    are then paths of that stage.
    """

    method: str = OF_CONFIG
    noise_px: float = 1.0
    outliers: float = 0.0
    pairs: int = 8

    scenes: ClassVar[Sequence[str]] = ("cube",)
    sample: ClassVar[Sample] = "draws"
    measures: ClassVar[Sequence[Measure]] = (
        Measure(
            "distance_px", "px", "less", True, "median over the pairs of the RMS distance of the exact points"
            " to their epipolar lines",
        ),
        Measure("over_bound", "", "less", True, "the same over the least possible, RMS over the pairs"),
        Measure("epipole_deg", "deg", "less", True, "median error of the worse epipole, 90 without F"),
        Measure("within_pct", "%", "more", False, "share of the pairs whose distance is below 1 px"),
    )  # fmt: skip

    def __post_init__(self) -> None:
        if self.method not in (OF_CONFIG, *BY_METHOD):
            raise ValueError(unknown_word("method", self.method, [OF_CONFIG, *BY_METHOD]))
        if self.noise_px < 0.0 or not 0.0 <= self.outliers < 1.0 or self.pairs < 1:
            raise ValueError("noise_px is at least 0, outliers between 0 and 1, pairs at least 1")

    def unavailable(self, scene: str) -> set[str]:
        """Without noise there is no bound."""
        return set() if self.noise_px > 0.0 else {"over_bound"}

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        rng = np.random.default_rng((seed, round(1e3 * self.noise_px), round(1e3 * self.outliers)))
        chosen = rng.choice(len(_pairs()), self.pairs, replace=False)
        threshold = max(THRESHOLD_PX, MATCHED_SIGMAS * self.noise_px)
        pairs, found, bounds = [_pairs()[k] for k in chosen], [], []
        for pair in pairs:
            xy1, xy2 = self._matches(pair, rng)
            found.append(measure_pair(self._fundamental(config, xy1, xy2, threshold, seed), pair))
            if self.noise_px:
                bound = fundamental_bound(pair.P1, pair.P2, pair.X, sigma_px=self.noise_px)
                bounds.append(bound.rms_distance_px)
        distance, angle = np.array(found).T
        if np.isnan(distance).all():
            raise StageFailure("no pair has an F")
        distance = np.where(np.isnan(distance), np.inf, distance)
        # Error of an epipole without F, the largest that a direction of either sign can have.
        angle = np.where(np.isnan(angle), 90.0, angle)
        numbers = {"distance_px": float(np.median(distance)), "epipole_deg": float(np.median(angle))}
        numbers["within_pct"] = 100.0 * float(np.mean(distance < 1.0))
        if self.noise_px:
            numbers["over_bound"] = float(np.sqrt(np.mean((distance / bounds) ** 2)))
        return numbers

    def _matches(self, pair: TwoViews, rng: np.random.Generator) -> tuple[F64, F64]:
        xy1, xy2 = (xy + self.noise_px * rng.normal(size=xy.shape) for xy in (pair.xy1, pair.xy2))
        wrong = rng.random(len(xy2)) < self.outliers
        anywhere = rng.uniform(pair.xy2.min(axis=0), pair.xy2.max(axis=0), xy2.shape)
        return xy1, np.where(wrong[:, None], anywhere, xy2)

    def _fundamental(
        self, config: PipelineConfig, xy1: F64, xy2: F64, threshold_px: float, seed: int
    ) -> F64 | None:
        if self.method != OF_CONFIG:
            return BY_METHOD[self.method].fundamental(xy1, xy2, threshold_px=threshold_px, seed=seed)
        try:
            return config.epipolar.estimate(xy1, xy2, np.random.default_rng(seed)).F
        except StageFailure:
            return None


@cache
def _pairs() -> list[TwoViews]:
    return cube_pairs(make_cube())


def measure_pair(F: F64 | None, pair: TwoViews) -> tuple[float, float]:
    """RMS distance (px) of exact points to their lines, larger epipole error (degrees); NaN without F."""
    if F is None:
        return float("nan"), float("nan")
    distance = float(np.sqrt(np.mean(symmetric_residuals(F, pair.xy1, pair.xy2) ** 2) / 2.0))
    return distance, _epipole_error_deg(F, pair)


def _epipole_error_deg(F: F64, pair: TwoViews) -> float:
    truths = epipoles(fundamental_from_cameras(pair.P1, pair.P2))
    angles = []
    for found, true in zip(epipoles(F), truths, strict=True):
        a, b = (np.linalg.solve(K, e) for e in (found, true))
        sine, cosine = np.linalg.norm(np.cross(a, b)), abs(float(a @ b))
        angles.append(float(np.degrees(np.arctan2(sine, cosine))))
    return max(angles)


POLYNOMIAL = "polynomial"
SOLVERS: dict[str, Callable[[F64, F64], F64]] = {
    **{name: partial(triangulate, method=name) for name in ("linear", "iterated", "optimal")},
    "mid-point": partial(triangulate, method="midpoint"),
    POLYNOMIAL: triangulate_polynomial,
    "COLMAP": colmap_points,
    "OpenCV linear": opencv_linear,
    "OpenCV polynomial": opencv_polynomial,
}  # Points X (N, 4) from cameras P (V, 3, 4) and pixels (V, N, 2)


@dataclass(frozen=True)
class TriangulationOverNoise(Task):
    """``points`` points of a rig drawn by the seed, seen with Gaussian noise of ``noise_px``, triangulated by
    ``method`` in a ``frame`` of space that is "metric", "affine" or "projective". Every method meets the same
    rig, noise and frame.
    """

    method: str = POLYNOMIAL
    noise_px: float = 1.0
    frame: str = "metric"
    points: int = 200

    scenes: ClassVar[Sequence[str]] = tuple(RIGS)
    sample: ClassVar[Sample] = "draws"
    measures: ClassVar[Sequence[Measure]] = (
        Measure("image_px", "px", "less", True, "RMS distance of projected from measured points"),
        Measure("space_pct", "%", "less", True, "median distance from the true point over its depth"),
        Measure("worst_pct", "%", "less", True, "95 % quantile of the same"),
    )

    def __post_init__(self) -> None:
        for what, word, known in (("method", self.method, SOLVERS), ("frame", self.frame, get_args(Group))):
            if word not in known:
                raise ValueError(unknown_word(what, word, known))
        if self.noise_px < 0.0 or self.points < 1:
            raise ValueError("noise_px is at least 0, points at least 1")

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        if RIGS[scene][1] > 2 and self.method == POLYNOMIAL:
            raise ValueError("the polynomial method is one of two views")
        rng = np.random.default_rng(seed)
        drawn = draw_rig(scene, self.noise_px, self.frame, rng, self.points)  # type: ignore[arg-type]
        X = SOLVERS[self.method](drawn.P, drawn.xy)
        squared = squared_distances(drawn.P, X, drawn.xy) / len(drawn.P)
        errors_pct = drawn.errors_pct(X)
        return {
            "image_px": float(np.sqrt(np.mean(squared))),
            "space_pct": float(np.median(errors_pct)),
            "worst_pct": float(np.quantile(errors_pct, 0.95)),
        }


SCENES = ("cube", "cloud")
MODES = ("constant", "zooming")
PRINCIPAL_STD = 0.01  # Prior standard deviation of the principal point over the long side
ZOOM = 0.3  # Focal lengths are multiplied by e^u with u uniform in +-ZOOM


@dataclass(frozen=True)
class CalibrationOverNoise(Task):
    """``views`` cameras of the cube or of a cloud with Gaussian noise of ``noise_px``, handed to the
    self-calibration as the minimum of the projective bundle adjustment in a random frame. ``mode`` is
    "constant" (one focal length) or "zooming". With ``bundle`` the metric stage follows.
    """

    noise_px: float = 1.0
    views: int = 9
    mode: str = "constant"
    bundle: bool = False

    scenes: ClassVar[Sequence[str]] = SCENES
    sample: ClassVar[Sample] = "draws"
    measures: ClassVar[Sequence[Measure]] = (
        Measure("focal_error_pct", "%", "less", True, "median |f / f_true - 1| of the cameras"),
        Measure("worst_focal_error_pct", "%", "less", True, "largest |f / f_true - 1| of the cameras"),
        Measure("focal_error_over_bound", "", "less", True, "the first over its Cramer-Rao bound"),
        Measure("success_pct", "%", "more", False, "100 where the median focal error is below 3 %, else 0"),
    )

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ValueError(unknown_word("mode", self.mode, MODES))
        if self.noise_px < 0.0 or not 3 <= self.views <= 27:
            raise ValueError("noise_px is at least 0, views between 3 and 27")

    def unavailable(self, scene: str) -> Collection[str]:
        return () if self.noise_px else ("focal_error_over_bound",)

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        cell = (scene, self.mode, self.noise_px, self.views, seed)
        rig, projective = draw_rig_over_noise(*cell)
        prior, rng = assumptions(rig, self.mode), np.random.default_rng(seed)
        calibration = config.selfcalibration.calibrate(projective, prior=prior, rng=rng)
        K = calibration.K
        if self.bundle:
            refined = config.metric.refine(projective, calibration, prior=prior, rng=rng, threads=1)
            assert refined.reconstruction.K is not None
            K = refined.reconstruction.K
        judged = projective.registered
        error = 100.0 * np.abs(K[judged, 0, 0] / rig.K[judged, 0, 0] - 1.0)
        median = float(np.median(error))
        bound = _bound_pct(*cell)
        return {
            "focal_error_pct": median,
            "focal_error_over_bound": median / bound if bound else float("nan"),
            "worst_focal_error_pct": float(error.max()),
            "success_pct": 100.0 * (median <= 3.0),
        }


def make_rig(scene: str, mode: str, views: int, rng: np.random.Generator) -> Rig:
    """Draw the cameras."""
    if scene == "cloud":
        rig = make_cloud(views, rng)
    else:
        rig = whole = cube_rig()
        assert whole.flat is not None
        usable = np.flatnonzero(~whole.flat)
        while views < len(whole.K) and (rig is whole or not rig.tied_off_planes(OFF_FACE)):
            rig = whole.subset(np.sort(rng.choice(usable, views, replace=False)))
    return zoomed(rig, np.exp(rng.uniform(-ZOOM, ZOOM, len(rig.K)))) if mode == "zooming" else rig


def assumptions(rig: Rig, mode: str) -> IntrinsicsPrior:
    """Return the prior: square pixels, principal point near the middle, no distortion."""
    options = IntrinsicsOptions(
        focal="constant" if mode == "constant" else "free", principal_point_std_rel=PRINCIPAL_STD, k1="known"
    )
    n = len(rig.K)
    return prior_from_options(options, [rig.size] * n, np.full(n, np.nan), np.ones(n))


@lru_cache(maxsize=4)
def draw_rig_over_noise(
    scene: str, mode: str, sigma_px: float, views: int, seed: int
) -> tuple[Rig, Reconstruction]:
    """Return the true cameras and the projective reconstruction of noisy observations."""
    rng = np.random.default_rng((seed, SCENES.index(scene), MODES.index(mode), views, round(100 * sigma_px)))
    rig = make_rig(scene, mode, views, rng)
    return rig, projective_from_truth(rig, noisy_tracks(rig, sigma_px, rng), rng)


@lru_cache(maxsize=4)
def _bound_pct(scene: str, mode: str, sigma_px: float, views: int, seed: int) -> float:
    """Median |error| of the focal lengths (%) at the Cramer-Rao bound; 0 without noise."""
    if sigma_px == 0.0:
        return 0.0
    rig, projective = draw_rig_over_noise(scene, mode, sigma_px, views, seed)
    principal_px = PRINCIPAL_STD * max(rig.size)
    std = focal_bound(rig, sigma_px, zooming=mode == "zooming", principal_std_px=principal_px)
    # Median of |x| for standard normal x.
    return 0.6745 * float(np.median(std[projective.registered]))
