"""Chapter 5: distance of every F estimator from the KCR bound, and its processor time.

A cell is the root mean square (and the median) over trials of the RMS distance of the exact points to their
epipolar lines over the KCR bound. An efficient estimator has the ratio 1; its median is then about 0.95,
because seven parameters carry the error. OpenCV's robust methods get our confidence 0.9999 and 20000
iterations, the others their defaults. Set OPENBLAS_NUM_THREADS=1.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from thesisrecon.api.pairs import epipolar_lines, estimate_fundamental
from thesisrecon.arrays import F64
from thesisrecon.config import FundamentalEstimator
from thesisrecon.epipolar._matches import PairFrame
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.epipolar.ransac import ThesisRansac, estimate_eight_point
from thesisrecon.epipolar.refinement import Criterion, fundamental_covariance, refine_fundamental
from thesisrecon.epipolar.verification import Configuration
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.two_view import epipoles, sampson_residuals, symmetric_residuals
from thesisrecon.records import FundamentalFit
from validation.metrics.fundamental_precision import (
    epipolar_distance_interval,
    epipoles_of,
    fundamental_bound,
)
from validation.references.fundamental import OURS, SOLVERS, opencv_eight_point
from validation.references.libraries import INSTALLED, one_thread
from validation.runs.study import Part, pick, report_progress
from validation.runs.tables import Metric, Rows, text_table
from validation.scenes.two_views import make_two_views

Estimate = Callable[[F64, F64, float, int], F64 | None]
"""F (3, 3) or None from matches (N, 2), (N, 2), a threshold in px and a seed."""

GOLD, DEFAULT = "gold standard, orthonormal", "default"
RAW, NORMALISED = "eight-point, raw pixels", "eight-point, normalised"
THRESHOLD_PX, MATCHED_SIGMAS = 1.0, 3.0


@dataclass(frozen=True)
class Method:
    """A named estimator of F: whether it is ``robust`` and uses the threshold, and whether this one is
    ``matched``, :data:`MATCHED_SIGMAS` times the noise.
    """

    name: str
    estimate: Estimate
    robust: bool = False
    thresholded: bool = False
    matched: bool = False

    def fundamental(self, xy1: F64, xy2: F64, *, threshold_px: float, seed: int) -> F64 | None:
        """Estimate F (3, 3); None if the method fails or the result is not finite."""
        try:
            F = self.estimate(xy1, xy2, threshold_px, seed)
        except StageFailure:
            return None
        return F if F is not None and F.shape == (3, 3) and np.isfinite(F).all() and F.any() else None


def _refined(criterion: Criterion) -> Estimate:
    return lambda xy1, xy2, _, __: refine_fundamental(estimate_eight_point(xy1, xy2), xy1, xy2, criterion)


def _linear(**options: bool) -> Estimate:
    return lambda xy1, xy2, _, __: estimate_eight_point(xy1, xy2, **options)


def _robust(make: Callable[..., FundamentalEstimator], **variant: Any) -> Estimate:
    return lambda xy1, xy2, t, seed: (
        make(threshold_px=t, **variant).estimate(xy1, xy2, np.random.default_rng(seed)).F
    )


def _library(name: str) -> Estimate:
    def estimate(xy1: F64, xy2: F64, threshold_px: float, seed: int) -> F64 | None:
        F = SOLVERS[name](xy1, xy2, threshold_px, seed)[0]
        return None if F is None else np.asarray(F, dtype=np.float64)

    return estimate


OWN = (
    Method("eight-point, raw pixels, rank 3", _linear(normalized=False, rank_two=False)),
    Method(RAW, _linear(normalized=False)),
    Method(NORMALISED, _linear()),
    Method("Sampson (5.4), orthonormal", _refined("sampson")),
    Method("epipolar distance (5.6), orthonormal", _refined("epipolar-distance")),
    Method(GOLD, _refined("reprojection")),
    *(
        Method(f"Algorithm 2, {label}", _robust(ThesisRansac, **variant), robust=True, thresholded=True)
        for label, variant in (
            ("seven-point search alone", {"rounds": 0}),
            ("Sampson", {}),
            ("epipolar distance", {"epipolar_distance": True}),
            ("Sampson, test of both lines", {"inlier_test": "epipolar-distance"}),
            ("Sampson, test of the sum", {"inlier_test": "symmetric-distance"}),
        )
    ),
    Method(DEFAULT, _robust(LocallyOptimisedRansac), robust=True, thresholded=True),
)
LIBRARIES = (
    Method("OpenCV FM_8POINT", lambda xy1, xy2, _, __: opencv_eight_point(xy1, xy2)),
    Method("OpenCV FM_LMEDS", _library("FM_LMEDS"), robust=True),
    *(
        Method(label, _library(name), robust=True, thresholded=True)
        for label, name in (
            ("OpenCV FM_RANSAC", "FM_RANSAC"),
            ("OpenCV USAC_ACCURATE", "USAC_ACCURATE"),
            ("OpenCV USAC_MAGSAC", "USAC_MAGSAC"),
            ("PoseLib", "PoseLib"),
            *((name, name) for name in INSTALLED),
        )
    ),
)
METHODS = OWN + LIBRARIES
WRONG, WRONG_NOISE_PX = 0.2, 1.0


class Setting(NamedTuple):
    """Noise of each coordinate (px), number of matches, and their share of wrong ones."""

    sigma_px: float
    n: int
    wrong: float = 0.0


class Result(NamedTuple):
    """One method in one setting: distance of the exact points over the bound over all trials with an F,
    median processor time, and number of trials without an F.
    """

    rms_ratio: float
    median_ratio: float
    time_ms: float
    failures: int


Results = dict[Setting, dict[str, Result]]
"""Results of each setting by the names of methods."""


class Trial(NamedTuple):
    """Noisy matches (N, 2), the exact points of the right ones (M, 2), their KCR bound (px), the true F."""

    xy1: F64
    xy2: F64
    exact1: F64
    exact2: F64
    bound_px: float
    F: F64

    def ratio(self, F: F64) -> float:
        """Return the RMS distance of the exact points to their epipolar lines over the bound."""
        squared = float(np.mean(symmetric_residuals(F, self.exact1, self.exact2) ** 2))
        return float(np.sqrt(squared / 2.0)) / self.bound_px


def make_trial(setting: Setting, seed: int) -> Trial:
    """Draw scene, noise and wrong matches (uniform in image 2) of one seed."""
    rng = np.random.default_rng(seed)
    scene = make_two_views(Configuration.GENERAL, setting.n, rng)
    xy1, xy2 = (xy + rng.normal(0.0, setting.sigma_px, xy.shape) for xy in (scene.xy1, scene.xy2))
    right = np.ones(setting.n, dtype=bool)
    right[: round(setting.wrong * setting.n)] = False
    xy2[~right] = rng.uniform((0.0, 0.0), (1280.0, 960.0), (int(np.sum(~right)), 2))
    bound = fundamental_bound(scene.P1, scene.P2, scene.X[right], sigma_px=setting.sigma_px)
    return Trial(xy1, xy2, scene.xy1[right], scene.xy2[right], bound.rms_distance_px, bound.F)


def measure(method: Method, trials: Sequence[Trial], setting: Setting) -> Result:
    """Run one method on the trials of one setting, after two calls that are not timed."""
    threshold = MATCHED_SIGMAS * setting.sigma_px if method.matched else THRESHOLD_PX
    ratios, seconds = [], []
    for seed in (-2, -1, *range(len(trials))):
        trial = trials[max(seed, 0)]
        start = time.process_time()
        F = method.fundamental(trial.xy1, trial.xy2, threshold_px=threshold, seed=max(seed, 0))
        elapsed = time.process_time() - start
        if seed >= 0:
            seconds.append(elapsed)
            ratios += [trial.ratio(F)] if F is not None else []
    good = np.array(ratios) if ratios else np.array([np.inf])
    rms, middle, time_ms = np.sqrt(np.mean(good**2)), np.median(good), 1e3 * np.median(seconds)
    return Result(float(rms), float(middle), float(time_ms), len(trials) - len(ratios))


def run_methods(setting: Setting, methods: Sequence[Method], trials: int) -> dict[str, Result]:
    """Run all methods in a setting; thresholded ones with the default and with the matched threshold."""
    one_thread()
    data, results = [make_trial(setting, seed) for seed in range(trials)], dict[str, Result]()
    for method in methods:
        if method.robust or not setting.wrong:
            results[method.name] = measure(method, data, setting)
            if method.thresholded:
                matched = replace(method, matched=True)
                results[f"{method.name}, {MATCHED_SIGMAS:g} sigma"] = measure(matched, data, setting)
    report_progress(f"done: {setting}")
    return results


def report(results: Results, trials: int) -> str:
    """Return ratio and time tables for every share of wrong matches."""
    blocks = []
    for wrong in sorted({s.wrong for s in results}):
        some = {s: found for s, found in results.items() if s.wrong == wrong}
        title = f"{100.0 * wrong:.0f} % wrong matches, {trials} trials"
        sigmas = {s.sigma_px for s in some}
        sigma = 1.0 if 1.0 in sigmas else min(sigmas)
        timed = {s: found for s, found in some.items() if s.sigma_px == sigma}
        ratios = _table(some, [f"{s.sigma_px:g} px, {s.n}" for s in some], _ratio_cell)
        times = _table(timed, [f"n = {s.n}" for s in timed], lambda r: f"{r.time_ms:.3g}")
        blocks.append(f"{title}: RMS (median) of the distance over the bound\n\n{ratios}")
        blocks.append(f"{title}: median processor time, ms\n\n{times}")
    return "\n\n".join(blocks)


def _ratio_cell(r: Result) -> str:
    rms, median = (f"{v:.2f}" if v < 10.0 else f"{v:.0f}" for v in (r.rms_ratio, r.median_ratio))
    return f"{rms} ({median}{f'; {r.failures} none' if r.failures else ''})"


def _table(results: Results, head: Sequence[str], cell: Callable[[Result], str]) -> str:
    rows = {name: [name] for found in results.values() for name in found}
    for name, row in rows.items():
        row += [cell(found[name]) if name in found else "-" for found in results.values()]
    return text_table(["", *head], rows.values())


def check_methods(setting: Setting, results: Mapping[str, Result]) -> Rows:
    """Return the RMS ratio of the gold standard and of the default; infinite if a trial has no F."""
    rows = Rows(f"n = {setting.n}, {setting.sigma_px:g} px", OURS)
    for name in (GOLD, DEFAULT):
        if name in results and not setting.wrong:
            r = results[name]
            rows.add(name, np.inf if r.failures else r.rms_ratio, at_most=1.05)
    return rows


def epipolar_methods_study(
    trials: int = 500,
    points: Sequence[int] = (30, 100, 1000),
    noise: Sequence[float] = (0.5, 1.0, 2.0),
    wrong: Sequence[float] = (0.0, WRONG),
    methods: Sequence[str] | None = None,
) -> Iterator[Part]:
    """Compare every estimator of F with the KCR bound."""
    names = pick(methods, [m.name for m in METHODS])
    chosen = [m for m in METHODS if m.name in names]
    found: Results = {}
    for share in wrong:
        for sigma, n in product([WRONG_NOISE_PX] if share else noise, points):
            setting = Setting(sigma, n, share)
            found[setting] = run_methods(setting, chosen, trials)
            yield check_methods(setting, found[setting])
    yield report(found, trials)


LEAST = "gold standard"
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
    ratios: dict[str, list[float]] = {LEAST: [], DEFAULT: []}
    held: dict[str, dict[str, list[float]]] = {w: {LEAST: [], DEFAULT: []} for w in INTERVALS}
    for trial in (make_trial(Setting(sigma_px, n), seed) for seed in range(trials)):
        matches, exact = (trial.xy1, trial.xy2), (trial.exact1, trial.exact2)
        for name, fit in ((LEAST, gold_standard(*matches)), (DEFAULT, estimate_fundamental(*matches))):
            ratios[name].append(trial.ratio(fit.F) ** 2)
            off = np.abs(np.sum(homogenize(trial.exact2) * epipolar_lines(fit.F, trial.exact1), axis=1))
            truths = list(zip(epipoles_of(fit), epipoles(trial.F), strict=True))
            held[DISTANCES][name].append(float(np.mean(off <= epipolar_distance_interval(fit, *exact))))
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
