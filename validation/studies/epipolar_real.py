"""F of real image pairs beside OpenCV, COLMAP and PoseLib.

Each method runs with several seeds on three sets. ``kusvod2``: errors on hand-made correspondences;
``strecha``: errors on noise-free correspondences of the true cameras; ``adelaide``: inliers against labels.
An error is the RMS distance to the epipolar lines over both images. The bounds are the best of OpenCV's two
USAC variants, COLMAP and PoseLib; PoseLib; and the reference with the best F1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar.degeneracy import assess_degeneracy
from validation.metrics.epipolar import precision_recall, rms_epipolar_distance, rms_sampson_distance
from validation.metrics.record import Metric
from validation.references.fundamental import OURS, SOLVERS, Estimate, estimate_with
from validation.references.libraries import one_thread
from validation.scenes.real_pairs import (
    SCENES_WITH_CAMERAS,
    RealPair,
    adelaide_pairs,
    camera_pairs,
    kusvod2_pairs,
)
from validation.studies.runner import CACHE, Part, Rows, load_scene, pick

Runs = dict[str, list[list[Estimate]]]
THRESHOLD_PX = 1.0
FAILED_PX = 5.0
STRONG, STRONGEST = ("USAC_ACCURATE", "USAC_MAGSAC", "COLMAP", "PoseLib"), ("PoseLib",)
"""References that bound our errors on kusvod2, and on the scenes with cameras."""


def run_pair(
    pair: RealPair, methods: Iterable[str], *, seeds: int, threshold_px: float
) -> dict[str, list[Estimate]]:
    return {
        method: [
            estimate_with(method, pair.xy1, pair.xy2, threshold_px=threshold_px, seed=seed)
            for seed in range(seeds)
        ]
        for method in methods
    }


def least(values: dict[str, float], references: tuple[str, ...]) -> float | None:
    """Return the smallest number of the methods whose names begin like a reference, or None."""
    return min((value for method, value in values.items() if method.startswith(references)), default=None)


def errors_of(
    runs: dict[str, list[Estimate]], pair: RealPair, error: Callable[[F64 | None, F64], float]
) -> dict[str, F64]:
    assert pair.truth is not None
    return {name: np.array([error(e.F, pair.truth) for e in found]) for name, found in runs.items()}


def error_rows(
    scene: str,
    pairs: list[str],
    errors: list[dict[str, F64]],
    references: tuple[str, ...],
    limits: tuple[float, ...],
) -> list[Metric]:
    """Return medians of each pair, and bounds on the medians and on the large errors of all runs."""
    medians = [{m: float(np.median(e)) for m, e in row.items()} for row in errors]
    rows = Rows(scene, OURS)
    for pair, row in zip(pairs, medians, strict=True):
        rows.add(pair, row, "px")
    every = {method: np.concatenate([row[method] for row in errors]) for method in errors[0]}

    def judge(name: str, values: dict[str, float], unit: str = "") -> None:
        rows.add(name, values, unit, at_most=least(values, references))

    judge("**median of all runs**", {method: float(np.median(e)) for method, e in every.items()}, "px")
    over_pairs = {m: float(np.median([row[m] for row in medians])) for m in every}
    judge("**median of the pairs' medians**", over_pairs, "px")
    for limit in limits:
        beyond = {method: float(np.sum(e > limit)) for method, e in every.items()}
        judge(f"**runs > {limit:g} px**, of {len(next(iter(every.values())))}", beyond)
    return rows


def check_kusvod2(pairs: Iterable[RealPair], methods: list[str], seeds: int) -> list[Metric]:
    """Measure errors on the hand-made correspondences."""
    labels: list[str] = []
    errors: list[dict[str, F64]] = []
    sampson: list[dict[str, F64]] = []
    sure = 0
    for pair in pairs:
        runs = run_pair(pair, methods, seeds=seeds, threshold_px=THRESHOLD_PX)
        labels.append(f"{pair.name} ({len(pair.xy1)} matches)")
        errors.append(errors_of(runs, pair, rms_epipolar_distance))
        sampson.append(errors_of(runs, pair, rms_sampson_distance))
        sure += sum(called_sure(e, pair, FAILED_PX) for e in runs.get(OURS, []))
    if not labels:
        return []
    rows = error_rows("kusvod2", labels, errors, STRONG, (FAILED_PX,))
    for label, row in zip(labels, errors, strict=True):
        failed = {method: float(np.sum(e > FAILED_PX)) for method, e in row.items()}
        if any(failed.values()):
            rows.append(Metric("kusvod2", f"runs > {FAILED_PX:g} px of {label.split()[0]}", "", failed, OURS))
    middle = {m: float(np.median(np.concatenate([row[m] for row in sampson]))) for m in methods}
    rows.append(Metric("kusvod2", "median Sampson distance of all runs", "px", middle, OURS))
    if OURS in methods:
        name = f"runs > {FAILED_PX:g} px and called sure"
        rows.append(Metric("kusvod2", name, "", {OURS: float(sure)}, OURS))
    return rows


def called_sure(estimate: Estimate, pair: RealPair, limit_px: float) -> bool:
    """Return whether F errs by more than the limit and the degeneracy test accepts it."""
    assert pair.truth is not None
    if estimate.fit is None or rms_epipolar_distance(estimate.F, pair.truth) <= limit_px:
        return False
    rng = np.random.default_rng(0)
    return assess_degeneracy(estimate.fit, pair.xy1, pair.xy2, rng=rng).determined


def check_cameras(
    pairs: Iterable[RealPair], methods: list[str], seeds: int, *, verbose: bool
) -> list[Metric]:
    """Measure errors on noise-free correspondences of the true cameras of one scene."""
    labels: list[str] = []
    errors: list[dict[str, F64]] = []
    sure = 0
    scene = ""
    for pair in pairs:
        assert pair.truth is not None
        scene = pair.name.split()[0]
        runs = run_pair(pair, methods, seeds=seeds, threshold_px=THRESHOLD_PX)
        labels.append(f"{pair.name.split()[1]} ({len(pair.xy1)} matches)")
        errors.append(errors_of(runs, pair, rms_epipolar_distance))
        sure += sum(called_sure(e, pair, 1.0) for e in runs.get(OURS, []))
    if not labels:
        return []
    rows = error_rows(scene, labels, errors, STRONGEST, (1.0, 3.0))
    for limit in (1.0, 3.0):
        off = {m: float(sum(np.median(row[m]) > limit for row in errors)) for m in methods}
        name = f"**pairs off by > {limit:g} px**, of {len(labels)}"
        rows.append(Metric(scene, name, "", off, OURS, least(off, STRONGEST)))
    if OURS in methods:
        rows.append(Metric(scene, "runs > 1 px and called sure", "", {OURS: float(sure)}, OURS, 0.0))
    return rows if verbose else rows[len(labels) :]


def check_adelaide(methods: list[str], seeds: int) -> list[Metric]:
    """Measure precision and recall of the inliers, means over the seeds.

    The bound is the reference with the largest F1: a method that accepts every match has the best recall.
    """
    rows = []
    for pair in adelaide_pairs():
        assert pair.right is not None
        for threshold in (1.0, 2.0):
            runs = run_pair(pair, methods, seeds=seeds, threshold_px=threshold)
            shares = {
                m: np.mean([precision_recall(e.inliers, pair.right) for e in found], axis=0)
                for m, found in runs.items()
            }
            f1 = {m: float(2.0 * v.prod() / max(v.sum(), 1e-9)) for m, v in shares.items()}
            others = [m for m in methods if m != OURS]
            best = max(others, key=lambda m: f1[m]) if others else None
            for label, values in (
                ("precision", {m: float(v[0]) for m, v in shares.items()}),
                ("recall", {m: float(v[1]) for m, v in shares.items()}),
                ("F1", f1),
            ):
                name, note = f"{pair.name}, {label} at {threshold:g} px", best or ""
                target = values[best] if best else None
                rows.append(Metric("adelaide", name, "", values, OURS, target, at_most=False, note=note))
    return rows


def epipolar_real_study(
    parts: Sequence[Literal["kusvod2", "strecha", "adelaide"]] = ("kusvod2", "strecha", "adelaide"),
    seeds: int = 20,
    methods: Sequence[str] | None = None,
    pairs: Sequence[str] | None = None,
    mutual: bool = False,
    verbose: bool = False,
    cache: Path = CACHE,
) -> Iterator[Part]:
    """Compare F of real images with OpenCV, COLMAP and PoseLib."""
    one_thread()
    names = pick(methods, SOLVERS)
    if "kusvod2" in parts:
        chosen = tuple(pairs) if pairs else None
        yield check_kusvod2(kusvod2_pairs(cache, chosen, mutual=mutual), names, seeds)
    for scene in SCENES_WITH_CAMERAS if "strecha" in parts else ():
        yield check_cameras(camera_pairs(load_scene(scene), cache), names, seeds, verbose=verbose)
    if "adelaide" in parts:
        yield check_adelaide(names, seeds)
