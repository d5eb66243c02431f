"""Chapters 6 and 7 on random subsets of real images.

Each trial takes 5 to 8 cameras of a set (``--views``), a random share of the tracks, another seed and another
initial pair, and goes from tracks to metric cameras as the pipeline does. A trial succeeds if the median
focal length of its cameras is within 3 % of the truth; the self-check must flag the others. Without truth,
the result of all images stands in. The nine views of the Cones come from a camera that moves without
rotation: a refusal that says so is the only right answer.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.arrays import B8, F64, I64
from thesisrecon.config import PipelineConfig
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_from_options
from thesisrecon.errors import StageFailure
from thesisrecon.pipeline.algorithm1 import ATTEMPTS
from thesisrecon.records import MetricResult, Tracks, TwoView
from thesisrecon.runtime._run import stream
from validation.runs.study import Part, report_progress
from validation.runs.tables import Rows, text_table
from validation.scenes.real import REAL_SCENES, SHIFTED, Scene, scenes_here
from validation.studies.calibration_coverage import MODES, SUCCESS_PCT, Cameras

MIN_SUCCESS = 0.98
MIN_VIEWS, MAX_VIEWS = 5, 8
SHIFTED_REASONS = ("pure translation", "not determine the focal length", "at least 3 registered images")
MIN_SHARE = 0.3
LATEST_START = 4


@dataclass(frozen=True)
class Matched:
    """An image set after its front end.

    ``sizes`` (V, 2): image sizes; ``focal_px`` (V,): true focal lengths at working size; ``reasons``:
    accepted reasons of a refusal; empty if any reason will do.
    """

    name: str
    tracks: Tracks
    pairs: Sequence[TwoView]
    sizes: I64
    focal_px: F64
    reasons: tuple[str, ...] = ()


OUTCOMES = ("right", "open", "refused", "refused, another reason", "right, not trusted", "wrong", "crash")
"""Outcomes: within 3 % and trusted; farther off but inside its 95 % interval; not trusted (wrong or without
an answer) for an accepted reason or another one; within 3 % and not trusted; wrong and trusted."""


@dataclass(frozen=True)
class Trial:
    """One subset and its outcome.

    ``median_pct``, ``worst_pct``: focal errors over the registered cameras, NaN without an answer;
    ``failed_checks``: empty if the answer is trusted; ``interval_pct``: half of the median 95 % interval of
    the focal lengths.
    """

    number: int
    views: tuple[int, ...]
    registered: int
    median_pct: float
    worst_pct: float
    failed_checks: tuple[str, ...]
    attempts: int
    seconds: float
    crash: str = ""
    interval_pct: float = 0.0
    reasons: tuple[str, ...] = ()

    @property
    def right(self) -> bool:
        return self.median_pct <= SUCCESS_PCT

    @property
    def outcome(self) -> str:
        """One of ``OUTCOMES``."""
        if self.crash:
            return "crash"
        if self.right:
            return "right, not trusted" if self.failed_checks else "right"
        if self.failed_checks:
            text = "; ".join(self.failed_checks)
            named = not self.reasons or any(reason in text for reason in self.reasons)
            return "refused" if named else "refused, another reason"
        return "open" if self.median_pct <= self.interval_pct else "wrong"


def match_scene(scene: Scene, work: Path, *, threads: int) -> Matched:
    """Run the front end of a set, or resume it in ``work``."""
    result = reconstruct(scene.image_paths, work / scene.name, until="metric", threads=threads)
    assert result.tracks is not None
    assert result.metric is not None
    sizes = np.array([image.size for image in result.images], dtype=np.int64)
    if scene.K is not None:
        focal = np.sqrt(scene.K[:, 0, 0] * scene.K[:, 1, 1])
        focal = focal * np.array([image.scale for image in result.images])
    elif scene.name == SHIFTED:
        focal = np.full(len(sizes), np.nan)
    else:
        found = result.metric.reconstruction.K
        assert found is not None
        focal = np.where(result.metric.reconstruction.registered, found[:, 0, 0], np.nan)
    reasons = SHIFTED_REASONS if scene.name == SHIFTED else ()
    return Matched(scene.name, result.tracks, result.pairs, sizes, focal, reasons)


def take_views(matched: Matched, views: I64, kept: B8) -> Matched:
    """Return the set as if only these views and only the ``kept`` (N,) tracks existed."""
    t, number = matched.tracks, np.full(matched.tracks.n_views, -1, dtype=np.int64)
    number[views] = np.arange(len(views))
    k = (number[t.view_index] >= 0) & kept[t.point_index]
    k &= np.bincount(t.point_index[k], minlength=t.n_points)[t.point_index] >= 2
    points, point_index = np.unique(t.point_index[k], return_inverse=True)
    tracks = Tracks(number[t.view_index[k]], point_index, t.xy[k], len(views), len(points))
    pairs = [
        replace(pair, i=int(number[pair.i]), j=int(number[pair.j]))
        for pair in matched.pairs
        if number[pair.i] >= 0 and number[pair.j] >= 0
    ]
    return replace(
        matched, tracks=tracks, pairs=pairs, sizes=matched.sizes[views], focal_px=matched.focal_px[views]
    )


def solve(
    matched: Matched, config: PipelineConfig, *, seed: int, first: int
) -> tuple[MetricResult | None, tuple[str, ...], int]:
    """Go from tracks to metric cameras with the attempts of the pipeline.

    Return the first trusted result, else the one with most cameras; the failures; the number of attempts.
    """
    n = len(matched.sizes)
    sizes = [(int(width), int(height)) for width, height in matched.sizes]
    prior = prior_from_options(config.intrinsics, sizes, np.full(n, np.nan), np.ones(n))
    found: list[MetricResult] = []
    failures: list[str] = []
    for attempt in range(first, first + ATTEMPTS):
        try:
            projective = config.projective.reconstruct(
                matched.tracks, matched.pairs, matched.sizes,
                rng=stream(seed, "projective", attempt), attempt=attempt,
            )  # fmt: skip
            calibration = config.selfcalibration.calibrate(
                projective, prior=prior, rng=stream(seed, "selfcalibration", attempt)
            )
            found.append(
                config.metric.refine(
                    projective, calibration, prior=prior, rng=stream(seed, "metric", attempt), threads=1
                )
            )
        except StageFailure as failure:
            failures.append(str(failure))
            continue
        if found[-1].trusted:
            break
    best = max(found, key=_quality, default=None)
    return best, tuple(failures), len(found) + len(failures)


def _quality(result: MetricResult) -> tuple[bool, int, int]:
    model = result.reconstruction
    return result.trusted, int(model.registered.sum()), int(model.valid.sum())


def run_trial(
    matched: Matched, mode: Cameras, number: int, *, views: tuple[int, int] = (MIN_VIEWS, MAX_VIEWS)
) -> Trial:
    """Draw one subset of as many ``views`` (fewest, most) and solve it."""
    rng = stream(number, "subsets")
    most = min(views[1], matched.tracks.n_views)
    count = int(rng.integers(min(views[0], most), most + 1))
    chosen = np.sort(rng.choice(matched.tracks.n_views, count, replace=False))
    kept = rng.random(matched.tracks.n_points) < rng.uniform(MIN_SHARE, 1.0)
    subset = take_views(matched, chosen, kept)
    # Two images have a single pair.
    first = int(rng.integers(max(min(LATEST_START, sum(pair.accepted for pair in subset.pairs)), 1)))
    options = IntrinsicsOptions(cameras=mode)
    start, names = time.perf_counter(), tuple(int(view) for view in chosen)
    nothing = Trial(number, names, 0, np.nan, np.nan, (), 0, 0.0, reasons=matched.reasons)
    try:
        result, failures, attempts = solve(
            subset, PipelineConfig(intrinsics=options), seed=number, first=first
        )
    except Exception as error:  # a crash is one of the results
        seconds = time.perf_counter() - start
        return replace(nothing, seconds=seconds, crash=f"{type(error).__name__}: {error}")
    seconds = time.perf_counter() - start
    if result is None:
        return replace(nothing, failed_checks=failures, attempts=attempts, seconds=seconds)
    model = result.reconstruction
    assert model.K is not None
    focal = np.sqrt(model.K[:, 0, 0] * model.K[:, 1, 1])[model.registered]
    errors = 100.0 * np.abs(focal / subset.focal_px[model.registered] - 1.0)
    intervals = [result.intrinsics[view]["focal_px"] for view in np.flatnonzero(model.registered)]
    known = errors[np.isfinite(errors)]
    return replace(
        nothing,
        registered=len(focal),
        median_pct=float(np.median(known)) if len(known) else np.nan,
        worst_pct=float(known.max()) if len(known) else np.nan,
        failed_checks=() if result.trusted else result.failed_checks or ("not trusted",),
        attempts=attempts,
        seconds=seconds,
        interval_pct=196.0 * float(np.median([one.std / one.value for one in intervals])),
    )


def table_row(name: str, mode: str, trials: Sequence[Trial]) -> list[object]:
    errors = [trial.median_pct for trial in trials if np.isfinite(trial.median_pct)]
    worst = [t.worst_pct for t in trials if not t.failed_checks and np.isfinite(t.worst_pct)]
    counts = [sum(t.outcome == kind for t in trials) for kind in OUTCOMES]
    numbers = [f"{np.median(errors):.2f}" if errors else "-", f"{max(worst):.2f}" if worst else "-"]
    return [name, mode, len(trials), *counts, *numbers, f"{np.median([t.seconds for t in trials]):.1f}"]


HEAD = ["set", "cameras", "trials", *OUTCOMES, "median error, %", "worst camera of a trusted answer, %"]


def subsets_study(
    out: Path,
    scenes: Sequence[str] = (*REAL_SCENES, "courtyard", SHIFTED),
    modes: Sequence[Cameras] = MODES,
    trials: int = 100,
    views: Sequence[int] = (MIN_VIEWS, MAX_VIEWS),
    threads: int = 2,
) -> Iterator[Part]:
    """Reconstruct random subsets of images and of tracks."""
    rows, judged = [], Rows("subsets", "share")
    for scene in scenes_here(scenes):
        matched = match_scene(scene, out, threads=threads)
        for mode in modes:
            done = [run_trial(matched, mode, number, views=(views[0], views[1])) for number in range(trials)]
            for trial in (t for t in done if t.outcome != "right"):
                report_progress(f"{matched.name}, {mode}: {trial.outcome}: {trial}")
            rows.append(table_row(matched.name, mode, done))
            wanted = "refused" if matched.reasons else "right"
            share = sum(trial.outcome == wanted for trial in done) / len(done)
            bad = sum(trial.outcome in ("wrong", "crash") for trial in done)
            judged.add(f"{matched.name}, {mode}: {wanted}", share, at_least=MIN_SUCCESS)
            judged.add(f"{matched.name}, {mode}: wrong or crash", bad, at_most=0.0)
    if rows:
        yield text_table([*HEAD, "median time, s"], rows)
        yield judged
