"""Harsh synthetic image sets: trusted answers whose focal length is wrong and outside its interval.

Random sets (:mod:`validation.scenes.harsh`) with noisy tracks and verified pairs become metric cameras as in
the pipeline. A trusted focal length that errs by more than 3 % and by more than its 95 % interval is a silent
error.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import UsageError
from thesisrecon.records import MetricResult, Tracks, TwoView
from validation.metrics.intervals import LEVEL
from validation.runs.study import Part, report_progress
from validation.runs.tables import Rows, text_table
from validation.scenes.dinosaur import pairs_from_tracks
from validation.scenes.harsh import KINDS
from validation.studies.subsets import Matched, solve

OURS = "ours"
OFF = 0.03


@dataclass(frozen=True)
class Trial:
    """One set and its outcome.

    ``outcome``: "refused", "not trusted" or "trusted"; ``worst``, ``median``: relative focal errors of the
    registered cameras; ``silent``: cameras that err by more than 3 % and by more than their 95 % intervals;
    ``failed_checks``: failed checks, or the refusal.
    """

    number: int
    outcome: str
    registered: int
    worst: float
    median: float
    silent: int
    failed_checks: tuple[str, ...]

    @property
    def is_silent_error(self) -> bool:
        """Whether the answer is trusted, wrong, and has an interval that does not show it."""
        return self.outcome == "trusted" and self.silent > 0


def run_trial(kind: str, number: int) -> Trial:
    rng = np.random.default_rng([number, list(KINDS).index(kind), 7])
    scene = KINDS[kind](rng)
    observed = scene.observe(rng)
    pairs = pairs_from_tracks(observed, seed=number)
    tracks = verified_tracks(observed, pairs)
    config = PipelineConfig()
    config = replace(config, intrinsics=replace(config.intrinsics, cameras=scene.cameras))
    matched = Matched(kind, tracks, pairs, scene.sizes, scene.focal_px)
    result, failures, _ = solve(matched, config, seed=number, first=0)
    return judge(number, result, failures, matched)


def judge(number: int, result: MetricResult | None, failures: Sequence[str], matched: Matched) -> Trial:
    if result is None:
        return Trial(number, "refused", 0, np.nan, np.nan, 0, tuple(failures[-1:]))
    error, stated = focal_errors(result, matched)
    silent = int(((error > OFF) & (error > stated)).sum())
    outcome = "trusted" if result.trusted else "not trusted"
    worst, median = float(error.max()), float(np.median(error))
    return Trial(number, outcome, len(error), worst, median, silent, tuple(result.failed_checks))


def verified_tracks(t: Tracks, pairs: Sequence[TwoView]) -> Tracks:
    """Return the observations that some verified pair has."""
    kept = np.zeros((t.n_views, t.n_points), dtype=bool)
    for pair in pairs:
        if pair.accepted:
            kept[pair.i, pair.index1] = kept[pair.j, pair.index2] = True
    k = kept[t.view_index, t.point_index]
    return Tracks(t.view_index[k], t.point_index[k], t.xy[k], t.n_views, t.n_points)


def focal_errors(result: MetricResult, matched: Matched) -> tuple[F64, F64]:
    """Return |log f / f_true| of the registered cameras and half their 95 % intervals (relative)."""
    views = np.flatnonzero(result.reconstruction.registered)
    found = [result.intrinsics[v]["focal_px"] for v in views]
    value = np.array([interval.value for interval in found])
    error = np.abs(np.log(value / matched.focal_px[views]))
    return error, LEVEL * np.array([interval.std for interval in found]) / value


def table_row(kind: str, trials: Sequence[Trial]) -> list[object]:
    count = Counter(t.outcome for t in trials)
    trusted = [t for t in trials if t.outcome == "trusted"]
    rejected = [t for t in trials if t.outcome == "not trusted"]
    median = f"{100.0 * float(np.median([t.worst for t in trusted])):.2f}" if trusted else "-"
    good, off = sum(t.worst <= OFF for t in rejected), sum(t.worst > OFF for t in trusted)
    silent = sum(t.silent > 0 for t in trusted)
    return [kind, count["refused"], count["not trusted"], good, count["trusted"], median, off, silent]


def _report(found: Iterable[tuple[str, Sequence[Trial]]]) -> Iterator[Part]:
    lines, errors, total = [], [], 0
    for kind, trials in found:
        lines.append(table_row(kind, trials))
        total += sum(t.outcome == "trusted" for t in trials)
        errors += [f"{kind}: {t}" for t in trials if t.is_silent_error]
        report_progress(f"{kind} done")
    yield text_table(HEAD, lines)
    yield "\n".join(errors)
    rows = Rows(f"{total} trusted", OURS)
    rows.add("trusted, wrong, outside its interval", len(errors), at_most=0.0)
    yield rows


HEAD = ["set", "refused", "not trusted", "not trusted though within 3 %", "trusted"]
HEAD += ["their worst focal, median, %", "off by more than 3 %", "and by more than the interval"]


def harsh_study(trials: int = 20, workers: int = 1, kinds: Sequence[str] | None = None) -> Iterator[Part]:
    """Look for trusted answers with a wrong focal length outside its interval, on harsh synthetic sets."""
    chosen = [k for k in KINDS if kinds is None or any(word in k for word in kinds)]
    if not chosen:
        raise UsageError(f"no kind has one of these words; choose from {', '.join(KINDS)}")
    with ProcessPoolExecutor(workers) as pool:
        yield from _report((k, list(pool.map(partial(run_trial, k), range(trials)))) for k in chosen)
