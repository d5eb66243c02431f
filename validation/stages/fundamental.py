"""Chapter 5: F of the same matches by ours, OpenCV, COLMAP and PoseLib, against the truth."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from thesisrecon.api.pairs import estimate_fundamental
from thesisrecon.arrays import B8, F64
from thesisrecon.epipolar.refinement import refine_fundamental
from thesisrecon.geometry.two_view import epipoles
from thesisrecon.testing import assert_fundamental
from validation.metrics.fundamental_precision import NONE_PX, rms_epipolar_distance
from validation.references.fundamental import estimate_with
from validation.references.libraries import INSTALLED, NoReference
from validation.runs.records import (
    IMAGE_SCENES,
    Judgement,
    Outcome,
    ReportOptions,
    Stage,
    Task,
    load_images,
    read_arrays,
)
from validation.runs.tables import OURS, Metric, Plot, each, plot, row, scatter
from validation.scenes.real_pairs import RealPair, camera_pairs, kusvod2_pairs

MATCHES = "SIFT matches"
VARIANTS, MINIMAL = ("ours (thesis)", "ours (eight points)"), "ours (seven points)"
REFERENCES = ("FM_RANSAC", "FM_LMEDS", "USAC_ACCURATE", "USAC_MAGSAC", "COLMAP", "PoseLib")
QUICK = ("USAC_MAGSAC", "PoseLib")
GATED = "courtyard"
THRESHOLD_PX, _QUICK_SEEDS = 1.0, 2
FAILED_PX = 5.0
ERROR = "RMS distance of right correspondences to their epipolar lines, over both images (5.6)"
Answers = dict[str, F64]
"""Answers of a method for all pairs and seeds: ``F`` (pairs, seeds, 3, 3), NaN if missing, ``inliers``
(pairs, seeds) their number, ``seconds`` (pairs, seeds) of one processor."""


class FundamentalStage(Stage):
    """F of SIFT matches with one threshold for all methods."""

    name = "fundamental"
    scenes, own = IMAGE_SCENES, True

    def takes(self, scene: str, options: ReportOptions) -> bool:
        return scene == "kusvod2" or (super().takes(scene, options) and load_images(scene, options).has_truth)

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        references = () if options.gates_only else QUICK if options.quick else (*REFERENCES, *INSTALLED)
        return (MATCHES, OURS, *VARIANTS, MINIMAL, *references)

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:
        return () if method in ("", MATCHES) else ((self.name, MATCHES),)

    def run(self, task: Task, folder: Path, options: ReportOptions) -> None:
        pairs = _pairs(task.scene, options)
        if task.method == MATCHES:
            return

        def answer(pair: RealPair, seed: int) -> tuple[F64 | None, B8, float]:
            start = time.process_time()
            found = estimate_with(task.method, pair.xy1, pair.xy2, threshold_px=THRESHOLD_PX, seed=seed)
            return *found, time.process_time() - start

        answer(pairs[0], 0)  # compiles
        answers = [[answer(pair, options.seed + seed) for seed in range(_seeds(options))] for pair in pairs]
        none = np.full((3, 3), np.nan)
        own = [_deviations(pair) for pair in pairs] if (task.method, task.scene) == (OURS, GATED) else []
        np.savez(
            folder / "answers.npz",
            deviations=np.reshape(own, (-1, 2)),
            F=[[none if F is None else F for F, _, _ in found] for found in answers],
            inliers=[[float(inliers.sum()) for _, inliers, _ in found] for found in answers],
            seconds=[[seconds for _, _, seconds in found] for found in answers],
        )

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        pairs = _pairs(scene, options)
        answers = {m: read_arrays(o, "answers.npz") for m, o in outcomes.items() if m != MATCHES}
        errors = {m: None if a is None else _errors(a, pairs) for m, a in answers.items()}
        notes = [f"{len(pairs)} pairs, {_seeds(options)} seeds each."]
        metrics = _metrics(scene, pairs, answers, errors)
        if scene == GATED:
            metrics += _gated(scene, pairs[: len(load_images(scene, options).image_paths) - 1], answers)
        return Judgement(metrics, notes, [_plot(errors)])


def _deviations(pair: RealPair) -> tuple[float, float]:
    """Error of F, and the distance of its refinement from the minimum, in stated standard deviations."""
    fit = estimate_fundamental(pair.xy1, pair.xy2, threshold_px=THRESHOLD_PX, seed=0)
    right = pair.xy1[fit.inliers], pair.xy2[fit.inliers]
    refined = refine_fundamental(fit.F, *right)
    minimum = refine_fundamental(refined, *right)
    pairs = (fit, pair.F), (replace(fit, F=refined), minimum)
    error, off = (assert_fundamental(found, F, false_alarm=1e-300) for found, F in pairs)
    return error, off


def _seeds(options: ReportOptions) -> int:
    return _QUICK_SEEDS if options.quick else 5


def _pairs(scene: str, options: ReportOptions) -> list[RealPair]:
    cache = options.folder("fundamental", scene, MATCHES)
    try:
        if scene == "kusvod2":
            return list(kusvod2_pairs(cache))
        gaps = (1,) if options.quick else (1, 2)
        return list(camera_pairs(load_images(scene, options), cache, gaps))
    except NoReference as error:
        raise NoReference(f"there are no SIFT matches: {error}") from error


def _errors(answers: Answers, pairs: list[RealPair]) -> F64:
    """(pairs, seeds) px."""
    truths = [(pair.truth, found) for pair, found in zip(pairs, answers["F"], strict=True)]
    return np.array(
        [[rms_epipolar_distance(F, truth) for F in found] for truth, found in truths if truth is not None]
    )


def _metrics(
    scene: str, pairs: list[RealPair], answers: Mapping[str, Answers | None], errors: Mapping[str, F64 | None]
) -> list[Metric]:
    median, worst = each(errors, np.median), each(errors, lambda e: np.quantile(e, 0.9))
    failed = each(errors, lambda e: 100.0 * np.mean(e > FAILED_PX))
    counts = np.array([len(pair.xy1) for pair in pairs])[:, None]
    inliers = each(answers, lambda a: 100.0 * np.mean(a["inliers"] / counts))
    spent = each(answers, lambda a: 1e3 * np.median(a["seconds"]))
    minimal = answers.get(MINIMAL)
    rank = None if minimal is None else _third_singular_value(minimal)
    rank_text = "largest third singular value of F over the second: F has rank 2"
    rows = [
        row(scene, "median error", "px", median, ERROR),
        row(scene, "tenth worst error", "px", worst, "the 90 % quantile of it"),
        row(scene, "failed", "%", failed, f"runs with an error above {FAILED_PX:g} px"),
        row(scene, "inliers", "%", inliers, "mean share of the matches accepted as inliers", ranked=False),
        row(scene, "time", "ms", spent, "median processor time of a pair"),
        *(row(scene, f"{name}: median error", "px", median.get(name), ERROR) for name in VARIANTS),
        row(scene, f"{MINIMAL}: rank", "", rank, rank_text),
    ]
    if all(pair.F is not None for pair in pairs):
        angle = each(answers, lambda a: np.median(_epipole_angles(a, pairs)))
        text = "median angle between found and true epipole"
        rows.insert(1, row(scene, "epipole angle", "deg", angle, text))
    return rows


def _gated(scene: str, pairs: list[RealPair], answers: Mapping[str, Answers | None]) -> list[Metric]:
    """Return the rows that have gates: the same pairs and seeds in a quick and a full report."""
    kinds = ("F", "inliers", "seconds")
    some = {
        name: None if a is None else {kind: a[kind][: len(pairs), :_QUICK_SEEDS] for kind in kinds}
        for name, a in answers.items()
    }
    rows = _metrics(
        scene, pairs, some, {n: None if a is None else _errors(a, pairs) for n, a in some.items()}
    )
    rows = [one for one in rows if "error" in one.name or "angle" in one.name]
    if (own := answers.get(OURS)) is not None:
        error, off = np.sqrt(np.mean(own["deviations"][: len(pairs)] ** 2, axis=0))
        text = "RMS of the pairs, in stated standard deviations"
        rows += [
            row(scene, "error in deviations", "", float(error), f"error of F: {text}"),
            row(scene, "distance of the refinement", "", float(off), f"from the minimum: {text}"),
        ]
    return [replace(one, name=f"neighbours: {one.name}") for one in rows]


def _third_singular_value(answers: Answers) -> float:
    """Return the largest over all runs with an F, NaN without any."""
    F = answers["F"]
    s = np.linalg.svd(F[np.isfinite(F).all(axis=(2, 3))], compute_uv=False)
    return float((s[:, 2] / s[:, 1]).max()) if len(s) else float("nan")


def _epipole_angles(answers: Answers, pairs: list[RealPair]) -> F64:
    """Angles (deg) of epipoles in image 1, seen from the middle of the matches; 90 without F."""
    angles = []
    for pair, found in zip(pairs, answers["F"], strict=True):
        assert pair.F is not None
        middle, spread = pair.xy1.mean(axis=0), float(np.linalg.norm(pair.xy1.std(axis=0)))
        true = _direction(pair.F, middle, spread)
        for F in found:
            cosine = abs(float(true @ _direction(F, middle, spread))) if np.isfinite(F).all() else 0.0
            angles.append(float(np.degrees(np.arccos(min(cosine, 1.0)))))
    return np.array(angles)


def _direction(F: F64, middle: F64, spread: float) -> F64:
    e = epipoles(F)[0]
    moved = np.array([e[0] - middle[0] * e[2], e[1] - middle[1] * e[2], spread * e[2]])
    return np.asarray(moved / np.linalg.norm(moved))


def _plot(errors: Mapping[str, F64 | None]) -> Plot:
    """Plot the sorted errors of every method."""
    traces = []
    for name, found in errors.items():
        if found is not None:
            x = np.sort(np.minimum(found.ravel(), NONE_PX))
            share = 100.0 * np.arange(1, len(x) + 1) / len(x)
            traces.append(scatter(name, x.tolist(), share.tolist(), "lines"))
    log, whole, text = {"type": "log"}, {"range": [0, 100]}, "To the left is better."
    return plot("Errors of all runs", traces, "error (px)", "runs below (%)", text, xaxis=log, yaxis=whole)
