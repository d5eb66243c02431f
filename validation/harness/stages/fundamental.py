"""Chapter 5: F of the same matches by ours, OpenCV, COLMAP and PoseLib, against the truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.arrays import B8, F64
from thesisrecon.geometry.two_view import epipoles
from validation.harness.records import Judgement, Outcome, Plot, ReportOptions, Task
from validation.harness.scenes import is_photographs, load_photographs
from validation.metrics.epipolar import NONE_PX, rms_epipolar_distance
from validation.metrics.record import Metric
from validation.references.fundamental import estimate_with
from validation.references.libraries import NoReference
from validation.scenes.real_pairs import RealPair, camera_pairs, kusvod2_pairs

OURS, MATCHES = "ours", "SIFT matches"
VARIANTS, MINIMAL = ("ours (thesis)", "ours (eight points)"), "ours (seven points)"
REFERENCES = (
    "FM_RANSAC",
    "FM_LMEDS",
    "USAC_ACCURATE",
    "USAC_MAGSAC",
    "COLMAP",
    "PoseLib",
)
QUICK = ("USAC_MAGSAC", "PoseLib")
THRESHOLD_PX = 1.0
FAILED_PX = 5.0
ERROR = "RMS distance of right correspondences to their epipolar lines, over both images (5.6)"


@dataclass(frozen=True)
class Answers:
    """Answers of a method for all pairs and seeds: ``F`` (pairs, seeds, 3, 3), NaN if missing,
    ``inliers`` (pairs, seeds) their number, ``seconds`` (pairs, seeds) of one processor."""

    F: F64
    inliers: F64
    seconds: F64


class FundamentalStage:
    """F of SIFT matches with one threshold for all methods."""

    name = "fundamental"
    title = "Fundamental matrices"
    definition = (
        "F of the same SIFT matches, threshold 1 px, several seeds, which also order the matches. "
        "Errors are on correspondences of the true cameras (or hand-made ones) that no method was given."
    )

    def takes(self, scene: str, options: ReportOptions) -> bool:
        return scene == "kusvod2" or (
            is_photographs(scene, options) and load_photographs(scene, options).has_truth
        )

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:  # noqa: ARG002 (the same everywhere)
        if options.gates_only:
            return (MATCHES, OURS, *VARIANTS, MINIMAL)
        return (MATCHES, OURS, *VARIANTS, MINIMAL, *(QUICK if options.quick else REFERENCES))

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:
        return () if method in ("", MATCHES) else ((self.name, MATCHES),)

    def run(self, task: Task, options: ReportOptions) -> None:
        pairs = _pairs(task.scene, options)
        if task.method == MATCHES:
            return

        def answer(pair: RealPair, seed: int) -> tuple[F64 | None, B8, float]:
            start = time.process_time()
            found = estimate_with(task.method, pair.xy1, pair.xy2, threshold_px=THRESHOLD_PX, seed=seed)
            return found.F, found.inliers, time.process_time() - start

        answer(pairs[0], 0)  # compiles
        answers = [[answer(pair, options.seed + seed) for seed in range(_seeds(options))] for pair in pairs]
        none = np.full((3, 3), np.nan)
        np.savez(
            options.place(task.stage, task.scene, task.method) / "answers.npz",
            F=[[none if F is None else F for F, _, _ in row] for row in answers],
            inliers=[[float(inliers.sum()) for _, inliers, _ in row] for row in answers],
            seconds=[[seconds for _, _, seconds in row] for row in answers],
        )

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        pairs = _pairs(scene, options)
        answers = {m: _read(o) if o.ok else None for m, o in outcomes.items() if m != MATCHES}
        errors = {m: None if a is None else _errors(a, pairs) for m, a in answers.items()}
        metrics = _metrics(scene, pairs, answers, errors)
        notes = [f"{len(pairs)} pairs, {_seeds(options)} seeds each."]
        notes += [f"{name}: {o.failure}." for name, o in outcomes.items() if not o.ok]
        return Judgement(metrics, plots=[_plot(errors)], notes=notes)


def _seeds(options: ReportOptions) -> int:
    return 2 if options.quick else 5


def _pairs(scene: str, options: ReportOptions) -> list[RealPair]:
    """Return the pairs of a scene, with the matches of the matching task.

    Raises :class:`NoReference` if SIFT is unavailable.
    """
    cache = options.place("fundamental", scene, MATCHES)
    try:
        if scene == "kusvod2":
            return list(kusvod2_pairs(cache))
        gaps = (1,) if options.quick else (1, 2)
        return list(camera_pairs(load_photographs(scene, options), cache, gaps))
    except NoReference as error:
        raise NoReference(f"there are no SIFT matches: {error}") from error


def _read(outcome: Outcome) -> Answers:
    with np.load(Path(outcome.place) / "answers.npz") as kept:
        return Answers(kept["F"], kept["inliers"], kept["seconds"])


def _errors(answers: Answers, pairs: list[RealPair]) -> F64:
    """(pairs, seeds) px."""
    rows = []
    for pair, row in zip(pairs, answers.F, strict=True):
        assert pair.truth is not None
        rows.append([rms_epipolar_distance(F if np.isfinite(F).all() else None, pair.truth) for F in row])
    return np.array(rows)


def _metrics(
    scene: str,
    pairs: list[RealPair],
    answers: Mapping[str, Answers | None],
    errors: Mapping[str, F64 | None],
) -> list[Metric]:
    def row(name: str, unit: str, values: Mapping[str, float | None], definition: str) -> Metric:
        return Metric(scene, name, unit, values, OURS, definition=definition)

    def of_errors(read: Callable[[F64], Any]) -> dict[str, float | None]:
        return {m: None if e is None else float(read(e)) for m, e in errors.items()}

    def of_answers(read: Callable[[Answers], float]) -> dict[str, float | None]:
        return {m: None if a is None else float(read(a)) for m, a in answers.items()}

    counts = np.array([len(pair.xy1) for pair in pairs])[:, None]
    rows = [
        row("median error", "px", of_errors(np.median), ERROR),
        row("tenth worst error", "px", of_errors(lambda e: np.quantile(e, 0.9)), "the 90 % quantile of it"),
        row(
            "failed",
            "%",
            of_errors(lambda e: 100.0 * np.mean(e > FAILED_PX)),
            f"runs with an error above {FAILED_PX:g} px",
        ),
        row(
            "inliers",
            "%",
            of_answers(lambda a: 100.0 * np.mean(a.inliers / counts)),
            "mean share of the matches accepted as inliers",
        ),
        row(
            "time",
            "ms",
            of_answers(lambda a: 1e3 * np.median(a.seconds)),
            "median processor time of a pair",
        ),
    ]
    found = of_errors(np.median)
    rows += [row(f"{name}: median error", "px", {OURS: found.get(name)}, ERROR) for name in VARIANTS]
    singular = of_answers(_third_singular_value).get(MINIMAL)
    words = "largest third singular value of F over the second: F has rank 2"
    rows.append(row(f"{MINIMAL}: rank", "", {OURS: singular}, words))
    if all(pair.F is not None for pair in pairs):
        angle = of_answers(lambda a: float(np.median(_epipole_angles(a, pairs))))
        rows.insert(1, row("epipole angle", "deg", angle, "median angle between found and true epipole"))
    return rows


def _third_singular_value(answers: Answers) -> float:
    s = np.linalg.svd(answers.F[np.isfinite(answers.F).all(axis=(2, 3))], compute_uv=False)
    return float((s[:, 2] / s[:, 1]).max())


def _epipole_angles(answers: Answers, pairs: list[RealPair]) -> F64:
    """Return the angles (deg) between estimated and true epipoles of image 1, as directions from the centre
    of the matches at the distance of their spread; 90 without F."""
    angles = []
    for pair, row in zip(pairs, answers.F, strict=True):
        assert pair.F is not None
        middle, spread = pair.xy1.mean(axis=0), np.linalg.norm(pair.xy1.std(axis=0))
        true = _direction(pair.F, middle, float(spread))
        for F in row:
            if not np.isfinite(F).all():
                angles.append(90.0)
                continue
            cosine = abs(float(true @ _direction(F, middle, float(spread))))
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
        if found is None:
            continue
        x = np.sort(np.minimum(found.ravel(), NONE_PX))
        share = 100.0 * np.arange(1, len(x) + 1) / len(x)
        traces.append(
            {"type": "scatter", "mode": "lines", "name": name, "x": x.tolist(), "y": share.tolist()}
        )
    layout = {
        "xaxis": {"type": "log", "title": {"text": "error (px)"}},
        "yaxis": {"title": {"text": "runs below (%)"}, "range": [0, 100]},
        "margin": {"l": 60, "r": 10, "t": 10, "b": 50},
    }
    return Plot("Errors of all runs", {"data": traces, "layout": layout}, "To the left is better.")
