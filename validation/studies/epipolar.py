"""Chapter 5 on synthetic pairs: F and its 95 % intervals against the KCR bound."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from thesisrecon.api.pairs import epipolar_lines, estimate_fundamental
from thesisrecon.arrays import F64
from thesisrecon.epipolar._matches import PairFrame
from thesisrecon.epipolar.linear import estimate_eight_point
from thesisrecon.epipolar.refinement import fundamental_covariance, refine_fundamental
from thesisrecon.epipolar.verification import Configuration
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.two_view import epipoles, sampson_residuals, symmetric_residuals
from thesisrecon.records import FundamentalFit
from validation.metrics.fundamental_precision import (
    epipolar_distance_interval,
    epipoles_of,
    fundamental_bound,
)
from validation.runs.study import Part
from validation.runs.tables import Metric
from validation.scenes.two_views import make_two_views

GOLD, DEFAULT = "gold standard", "default"
DISTANCES, EPIPOLES, PIXELS = INTERVALS = ("distances", "epipoles", "epipoles in pixels")


def gold_standard(xy1: F64, xy2: F64) -> FundamentalFit:
    """Estimate F of least reprojection error with its noise and covariance."""
    F = refine_fundamental(estimate_eight_point(xy1, xy2), xy1, xy2, "reprojection")
    r = sampson_residuals(F, xy1, xy2)
    sigma, frame = float(np.sqrt(r @ r / (len(r) - 7))), PairFrame.of(xy1, xy2)
    covariance = fundamental_covariance(
        frame, frame.matrix_in_frame(F), frame.points(xy1, xy2), sigma * frame.scale
    )
    return FundamentalFit(F, np.ones(len(xy1), dtype=bool), sigma, covariance)


def check_precision(sigma_px: float, n: int, trials: int) -> list[Metric]:
    """Measure RMS distance over the KCR bound and coverage of 95 % intervals."""
    ratios: dict[str, list[float]] = {GOLD: [], DEFAULT: []}
    held: dict[str, dict[str, list[float]]] = {w: {GOLD: [], DEFAULT: []} for w in INTERVALS}
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        scene = make_two_views(Configuration.GENERAL, n, rng)
        bound = fundamental_bound(scene.P1, scene.P2, scene.X, sigma_px=sigma_px)
        xy1, xy2 = (xy + rng.normal(0.0, sigma_px, xy.shape) for xy in (scene.xy1, scene.xy2))
        for name, fit in ((GOLD, gold_standard(xy1, xy2)), (DEFAULT, estimate_fundamental(xy1, xy2))):
            squared = np.mean(symmetric_residuals(fit.F, scene.xy1, scene.xy2) ** 2) / 2.0
            ratios[name].append(float(squared) / bound.rms_distance_px**2)
            off = np.abs(np.sum(homogenize(scene.xy2) * epipolar_lines(fit.F, scene.xy1), axis=1))
            half = epipolar_distance_interval(fit, scene.xy1, scene.xy2)
            truths = list(zip(epipoles_of(fit), epipoles(bound.F), strict=True))
            held[DISTANCES][name].append(float(np.mean(off <= half)))
            held[EPIPOLES][name].append(float(np.mean([e.contains(t) for e, t in truths])))
            held[PIXELS][name].append(float(np.mean([e.contains_xy(t[:2] / t[2]) for e, t in truths])))
    scene_name = f"sigma {sigma_px:g} px, n = {n}"
    rms = {name: float(np.sqrt(np.mean(values))) for name, values in ratios.items()}
    rows = [Metric(scene_name, "RMS distance over bound", "", {name: rms[name]}, name, 1.05) for name in rms]
    for kind, values in held.items():
        for name, shares in values.items():
            mean = {name: float(np.mean(shares))}
            rows.append(Metric(scene_name, f"coverage of {kind}", "", mean, name, 0.93, at_most=False))
            rows.append(Metric(scene_name, f"coverage of {kind}", "", mean, name, 0.97))
    return rows


def epipolar_study(
    trials: int = 500, points: Sequence[int] = (30, 100, 1000), noise: Sequence[float] = (0.5, 1.0, 2.0)
) -> Iterator[Part]:
    """Compare F with theory: precision and coverage of intervals."""
    for sigma_px in noise:
        for n in points:
            yield check_precision(sigma_px, n, trials)
