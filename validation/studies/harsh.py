"""Harsh sets: is any answer trusted whose focal is off while its interval does not say so?
``python -m validation.studies.harsh [--trials N] [--kinds WORD ...]``.

Every trial is a random set (:mod:`validation.scenes.harsh`), its noisy tracks and verified pairs, and goes
from there to metric cameras as the pipeline does, with its three attempts. A focal that is off by more than
3 % and by more than its 95 % interval, in an answer that is trusted, is a lie.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig
from thesisrecon.records import MetricResult, Tracks, TwoView
from validation.studies.subsets import Matched, solve
from validation.metrics.record import Metric, markdown_table
from validation.scenes.dinosaur import pairs_from_tracks
from validation.scenes.harsh import KINDS

OURS = "ours"
OFF = 0.03
LEVEL = 1.96


@dataclass(frozen=True)
class Trial:
    """``said``: refused, doubted or trusted; ``worst`` focal error of the registered cameras (relative);
    ``quiet`` of them are off by more than 3 % and than their intervals; the ``failed_checks`` or the refusal."""

    number: int
    said: str
    registered: int
    worst: float
    median: float
    quiet: int
    failed_checks: tuple[str, ...]

    @property
    def is_lie(self) -> bool:
        """Whether it is trusted, off, and does not say so."""
        return self.said == "trusted" and self.quiet > 0


def run_trial(kind: str, number: int) -> Trial:
    """One set from tracks to the self-check."""
    rng = np.random.default_rng([number, list(KINDS).index(kind), 7])
    scene = KINDS[kind](rng)
    observed = scene.observe(rng)
    pairs = pairs_from_tracks(observed, seed=number)
    tracks = verified_tracks(observed, pairs)
    config = PipelineConfig()
    config = replace(config, intrinsics=replace(config.intrinsics, cameras=scene.told))
    matched = Matched(kind, tracks, pairs, scene.sizes, scene.focal_px)
    result, failures, _ = solve(matched, config, seed=number, first=0)
    return judge(number, result, failures, matched)


def judge(number: int, result: MetricResult | None, failures: Sequence[str], matched: Matched) -> Trial:
    """What came of a set whose focals are known."""
    if result is None:
        return Trial(number, "refused", 0, np.nan, np.nan, 0, tuple(failures[-1:]))
    error, stated = focal_errors(result, matched)
    quiet = int(((error > OFF) & (error > stated)).sum())
    said = "trusted" if result.trusted else "doubted"
    worst, median = float(error.max()), float(np.median(error))
    return Trial(number, said, len(error), worst, median, quiet, tuple(result.failed_checks))


def verified_tracks(t: Tracks, pairs: Sequence[TwoView]) -> Tracks:
    """The observations that some verified pair has, as tracks are built of."""
    kept = np.zeros((t.n_views, t.n_points), dtype=bool)
    for pair in pairs:
        if pair.accepted:
            kept[pair.i, pair.index1] = kept[pair.j, pair.index2] = True
    k = kept[t.view_index, t.point_index]
    return Tracks(t.view_index[k], t.point_index[k], t.xy[k], t.n_views, t.n_points)


def focal_errors(result: MetricResult, matched: Matched) -> tuple[F64, F64]:
    """Of the registered cameras: |log f / f_true| and half the width of the 95 % interval (relative)."""
    views = np.flatnonzero(result.reconstruction.registered)
    found = [result.intrinsics[v]["focal_px"] for v in views]
    value = np.array([interval.value for interval in found])
    error = np.abs(np.log(value / matched.focal_px[views]))
    return error, LEVEL * np.array([interval.std for interval in found]) / value


def print_head() -> None:
    """The first two lines of the table."""
    print(
        "| set | refused | doubted | doubted though within 3 % | trusted | their worst focal, median, % | "
        "off by more than 3 % | and by more than the interval |"
    )
    print("| --- |" + " --- |" * 7, flush=True)


def line_of(kind: str, trials: Sequence[Trial]) -> str:
    """A line of the table."""
    count = Counter(t.said for t in trials)
    trusted = [t for t in trials if t.said == "trusted"]
    doubted = [t for t in trials if t.said == "doubted"]
    median = f"{100.0 * float(np.median([t.worst for t in trusted])):.2f}" if trusted else "-"
    return (
        f"| {kind} | {count['refused']} | {count['doubted']} | {sum(t.worst <= OFF for t in doubted)} | "
        f"{count['trusted']} | {median} | {sum(t.worst > OFF for t in trusted)} | "
        f"{sum(t.quiet > 0 for t in trusted)} |"
    )


def main(arguments: list[str] | None = None) -> int:
    """Print the table and every lie; 1 where there is one."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.harsh", description=__doc__)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--kinds", nargs="+", help="words; the kinds that have one of them")
    wishes = parser.parse_args(arguments)
    kinds = [k for k in KINDS if wishes.kinds is None or any(word in k for word in wishes.kinds)]
    print_head()
    lies: list[str] = []
    total = 0
    with ProcessPoolExecutor(wishes.workers) as pool:
        for kind in kinds:
            trials = list(pool.map(partial(run_trial, kind), range(wishes.trials)))
            print(line_of(kind, trials), flush=True)
            total += sum(t.said == "trusted" for t in trials)
            found = [f"{kind}, {t}" for t in trials if t.is_lie]
            print(*found, sep="\n", end="\n" if found else "", file=sys.stderr, flush=True)
            lies += found
    rows = [Metric(f"{total} trusted", "trusted, off and not said", "", {OURS: float(len(lies))}, OURS, 0.0)]
    print("", markdown_table(rows), sep="\n")
    return int(bool(lies))


if __name__ == "__main__":
    raise SystemExit(main())
