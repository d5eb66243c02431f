"""Chapter 5 on synthetic pairs: precision, coverage of intervals, degeneracy and certainty of F.

``epipolar`` compares estimates with the KCR bound, counts 95 % intervals that contain the truth, and the
classification of degenerate configurations, without wrong matches and with 30 % of them.
``epipolar-certainty`` calls F right if the RMS distance of exact correspondences to its epipolar lines is at
most 1 px, and sure if the degeneracy test says that the matches determine it.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar._frame import PairFrame
from thesisrecon.epipolar.configuration import Configuration, classify_configuration
from thesisrecon.epipolar.degeneracy import assess_degeneracy
from thesisrecon.epipolar.linear import estimate_eight_point
from thesisrecon.epipolar.locally_optimised import estimate_fundamental
from thesisrecon.epipolar.precision import (
    epipolar_distance_interval,
    epipoles_of,
    fundamental_bound,
    fundamental_covariance,
)
from thesisrecon.epipolar.refinement import refine_fundamental
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import compose_camera
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.two_view import epipolar_lines, epipoles, sampson_residuals, symmetric_residuals
from thesisrecon.records import FundamentalFit
from validation.metrics.record import Metric
from validation.scenes.facade import FacadeMaker
from validation.scenes.real import Scene
from validation.scenes.real_pairs import exact_correspondences, match_photographs
from validation.scenes.two_views import make_two_views
from validation.studies.runner import CACHE, Part, Rows, scenes_here, text_table

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
    rows = [Metric(scene_name, "RMS distance over bound", "", rms, name, 1.05) for name in rms]
    for kind, values in held.items():
        mean = {name: float(np.mean(v)) for name, v in values.items()}
        for name in mean:
            rows.append(Metric(scene_name, f"coverage of {kind}", "", mean, name, 0.93, at_most=False))
            rows.append(Metric(scene_name, f"coverage of {kind}", "", mean, name, 0.97))
    return rows


RIGHT_PX = 1.0
NOISES_PX = (0.1, 0.25, 0.5, 1.0, 2.0)
SIZE = (1280.0, 960.0)
OURS = "ours"
MIN_TRUTH = 20
CELLS = ("right and sure", "right and unsure", "wrong and unsure", "wrong and sure", "refused")


@dataclass(frozen=True)
class JudgedPair:
    """Matches ``xy1``, ``xy2`` (N, 2) and exact correspondences ``exact1``, ``exact2`` (M, 2), px."""

    group: str
    xy1: F64
    xy2: F64
    exact1: F64
    exact2: F64


def named_rightly(kind: Configuration, sigma_px: float, n: int, trials: int, *, wrong: float) -> float:
    """Return the share of scenes of one configuration that are classified so.

    With ``wrong`` matches, F comes from the robust estimate.
    """
    right = 0
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        scene = make_two_views(kind, n, rng)
        xy1, xy2 = (xy + rng.normal(0.0, sigma_px, xy.shape) for xy in (scene.xy1, scene.xy2))
        if wrong == 0.0:
            found = classify_configuration(estimate_eight_point(xy1, xy2), xy1, xy2)
        else:
            chosen = rng.random(n) < wrong
            xy2[chosen] = rng.uniform((0.0, 0.0), SIZE, (int(chosen.sum()), 2))
            # A user who expects large noise sets a larger threshold.
            fit = estimate_fundamental(xy1, xy2, threshold_px=max(1.0, 2.0 * sigma_px), seed=seed)
            found = classify_configuration(fit.F, xy1, xy2, inliers=fit.inliers)
        right += found.kind is kind
    return right / trials


def check_degeneracy(n: int, trials: int, *, wrong: float) -> list[Metric]:
    """Measure the share of right classifications for each configuration and noise."""
    rows = Rows(f"n = {n}, {100.0 * wrong:.0f} % wrong", OURS)
    for kind in Configuration:
        target = 0.99 if kind is Configuration.GENERAL else 0.98
        for sigma_px in NOISES_PX:
            share = named_rightly(kind, sigma_px, n, trials, wrong=wrong)
            # The bounds hold from 100 matches on.
            bound = target if n >= 100 else None
            rows.add(f"named {kind.value}, {sigma_px:g} px, of {trials}", share, at_least=bound)
    return rows


def facade_pairs(scenes: int) -> Iterator[JudgedPair]:
    """Draw facades, grouped by the number of right matches off the plane."""
    for seed in range(scenes):
        rng = np.random.default_rng(seed)
        facade = FacadeMaker.drawn(rng).make(rng)
        group = "facades, 15 or more matches off the wall" if facade.off_plane >= 15 else "facades, flat"
        yield JudgedPair(group, facade.xy1, facade.xy2, facade.exact1, facade.exact2)


def image_pairs(name: str, cache: Path, *, ratios: Sequence[float]) -> Iterator[JudgedPair]:
    """Give pairs (i, i + 1) to (i, i + 4) of a scene with known cameras, with one-way SIFT matches."""
    for scene in scenes_here([name]):
        for i in range(len(scene.image_paths)):
            for j in range(i + 1, min(i + 5, len(scene.image_paths))):
                yield from _pairs_of(scene, i, j, cache, ratios)


def _pairs_of(scene: Scene, i: int, j: int, cache: Path, ratios: Sequence[float]) -> Iterator[JudgedPair]:
    assert scene.K is not None
    assert scene.R is not None
    assert scene.C is not None
    paths = (scene.image_paths[i], scene.image_paths[j])
    P1, P2 = (compose_camera(scene.K[v], scene.R[v], -scene.R[v] @ scene.C[v]) for v in (i, j))
    for ratio in ratios:
        xy1, xy2 = match_photographs(paths, cache, ratio=ratio, mutual=False)
        exact = exact_correspondences(P1, P2, xy1, xy2)
        if len(exact) >= MIN_TRUTH:
            yield JudgedPair(f"{scene.name}, i + {j - i}", xy1, xy2, exact[:, :2], exact[:, 2:])


def judge_pairs(pairs: Iterable[JudgedPair], seeds: int) -> tuple[dict[str, Counter[str]], list[float]]:
    """Count how each group ends; also return ratios of the degeneracy test's time to the fit's."""
    cells: dict[str, Counter[str]] = {}
    ratios = []
    for pair in pairs:
        counter = cells.setdefault(pair.group, Counter())
        for seed in range(seeds):
            start = time.process_time()
            try:
                fit = estimate_fundamental(pair.xy1, pair.xy2, seed=seed)
            except StageFailure:
                counter["refused"] += 1
                continue
            middle = time.process_time()
            degeneracy = assess_degeneracy(fit, pair.xy1, pair.xy2, rng=np.random.default_rng(seed))
            ratios.append((time.process_time() - middle) / max(middle - start, 1e-9))
            distances = symmetric_residuals(fit.F, pair.exact1, pair.exact2)
            right = np.sqrt(np.mean(distances**2) / 2.0) <= RIGHT_PX
            sure = "sure" if degeneracy.determined else "unsure"
            counter[f"{'right' if right else 'wrong'} and {sure}"] += 1
    return cells, ratios


def certainty_metrics(cells: dict[str, Counter[str]]) -> list[Metric]:
    """Return the shares of wrong F called determined and of right F called undetermined."""
    everything = sum(cells.values(), Counter())
    ordinary = sum((c for group, c in cells.items() if group.endswith(("i + 1", "i + 2"))), Counter())
    rows = []
    for name, counter, first, second, target in (
        ("wrong ones called sure, of all pairs", everything, "wrong and sure", "wrong and unsure", 0.01),
        (
            "right ones called unsure, of (i, i + 1) and (i, i + 2)",
            ordinary,
            "right and unsure",
            "right and sure",
            0.05,
        ),
    ):
        of = counter[first] + counter[second]
        if of:
            rows.append(Metric("certainty", f"{name} ({of})", "", {OURS: counter[first] / of}, OURS, target))
    return rows


def certainty_table(cells: dict[str, Counter[str]]) -> str:
    """Return the counts of every group as a Markdown table."""
    return text_table(["", *CELLS], ([g, *(counter[c] for c in CELLS)] for g, counter in cells.items()))


def epipolar_study(
    parts: Sequence[Literal["precision", "degeneracy"]] = ("precision", "degeneracy"),
    trials: int = 500,
    points: Sequence[int] = (30, 100, 1000),
    noise: Sequence[float] = (0.5, 1.0, 2.0),
) -> Iterator[Part]:
    """Compare F with theory: precision, coverage of intervals, degenerate configurations."""
    for sigma_px in noise if "precision" in parts else ():
        for n in points:
            yield check_precision(sigma_px, n, trials)
    for n in points if "degeneracy" in parts else ():
        for wrong in (0.0, 0.3):
            yield check_degeneracy(n, trials, wrong=wrong)


def epipolar_certainty_study(
    seeds: int = 10, facades: int = 300, ratios: Sequence[float] = (0.8, 0.85), cache: Path = CACHE
) -> Iterator[Part]:
    """Count wrong F that are called determined, on synthetic facades and on real images.

    Parameters
    ----------
    facades : int
        Number of synthetic facades.
    ratios : sequence of float
        Ratios of SIFT's test of the second best match.
    """
    cells, times = judge_pairs(facade_pairs(facades), 1)
    for name in ("fountain-P11", "Herz-Jesus-P8", "courtyard"):
        more, other = judge_pairs(image_pairs(name, cache, ratios=ratios), seeds)
        cells, times = cells | more, times + other
    yield certainty_table(cells)
    yield certainty_metrics(cells)
    yield f"time of the degeneracy test over that of the estimate: median {np.median(times):.2f}"
