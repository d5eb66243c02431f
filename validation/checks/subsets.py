"""Chapters 6 and 7 on random subsets of real photographs: ``python -m validation.checks.subsets``.

Each trial takes 5 to 8 of a set's cameras, a random share of the tracks, another seed and another initial
pair, and goes from tracks to metric cameras as the pipeline does, with its three attempts. A trial succeeds
where the median focal length of its cameras is within 3 % of the truth, and every one of them too in the mode
with one camera per image; the self-check must flag what does not. Where a set has no truth, the answer from
all of its photographs stands in.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thesisrecon.assumptions import IntrinsicsAssumption, assumptions_of_views
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure
from thesisrecon.pipeline import ATTEMPTS, reconstruct
from thesisrecon.run import stream
from thesisrecon.types import B8, F64, I64, MetricResult, Tracks, TwoView
from validation.scenes.real import REAL_SCENES, Scene, load_fixture_scene, load_real_scene

MODES = ("shared", "per-image")
SUCCESS_PCT = 3.0
LEAST_SUCCESS = 0.98
MIN_VIEWS, MAX_VIEWS = 5, 8
LEAST_SHARE = 0.3
LATEST_START = 4


@dataclass(frozen=True)
class Matched:
    """A set after its front end: tracks, pairs, image ``sizes`` (V, 2), and the ``focal_px`` (V,) at working
    size that the answers are held against."""

    name: str
    tracks: Tracks
    pairs: Sequence[TwoView]
    sizes: I64
    focal_px: F64


@dataclass(frozen=True)
class Trial:
    """One subset: its views, what came of it, and how long it took.

    ``median_pct`` and ``worst_pct`` are focal errors over the registered cameras, NaN where there is no
    answer; ``doubts`` is empty where the answer is trusted.
    """

    number: int
    views: tuple[int, ...]
    registered: int
    median_pct: float
    worst_pct: float
    doubts: tuple[str, ...]
    attempts: int
    seconds: float
    crash: str = ""

    @property
    def right(self) -> bool:
        """Whether there is an answer whose median focal is within 3 %."""
        return self.median_pct <= SUCCESS_PCT

    @property
    def unflagged_failure(self) -> bool:
        """Whether a wrong answer was trusted."""
        return not self.right and not self.doubts and not self.crash


def match_scene(scene: Scene, work: Path, *, threads: int) -> Matched:
    """The front end of a set, resumed from ``work`` where it was run before."""
    folder = scene.image_paths[0].parent
    result = reconstruct(folder, work / scene.name, until="metric", threads=threads)
    assert result.tracks is not None
    assert result.metric is not None
    sizes = np.array([image.size for image in result.images], dtype=np.int64)
    if scene.K is not None:
        focal = np.sqrt(scene.K[:, 0, 0] * scene.K[:, 1, 1])
        focal = focal * np.array([image.scale for image in result.images])
    else:
        found = result.metric.reconstruction.K
        assert found is not None
        focal = np.where(result.metric.reconstruction.registered, found[:, 0, 0], np.nan)
    return Matched(scene.name, result.tracks, result.pairs, sizes, focal)


def take_views(matched: Matched, views: I64, kept: B8) -> Matched:
    """The set as if only these views had been taken, and only the tracks ``kept`` (N,) had been found."""
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
    return Matched(matched.name, tracks, pairs, matched.sizes[views], matched.focal_px[views])


def solve(
    matched: Matched, config: PipelineConfig, *, seed: int, first: int
) -> tuple[MetricResult | None, tuple[str, ...], int]:
    """From tracks to metric cameras; the answer, the failures' sentences, the number of attempts.

    As the pipeline: up to three attempts, the first trusted answer, else the one with most cameras.
    """
    n = len(matched.sizes)
    sizes = [(int(width), int(height)) for width, height in matched.sizes]
    assumed = assumptions_of_views(config.intrinsics, sizes, np.full(n, np.nan), np.ones(n))
    found: list[MetricResult] = []
    failures: list[str] = []
    for attempt in range(first, first + ATTEMPTS):
        try:
            projective = config.projective.reconstruct(
                matched.tracks, matched.pairs, matched.sizes,
                rng=stream(seed, "projective", attempt), attempt=attempt,
            )  # fmt: skip
            calibration = config.selfcalibration.calibrate(
                projective, assumed=assumed, rng=stream(seed, "selfcalibration", attempt)
            )
            found.append(
                config.metric.refine(
                    projective, calibration, assumed=assumed, rng=stream(seed, "metric", attempt)
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


def run_trial(matched: Matched, mode: str, number: int) -> Trial:
    """Draw one subset and solve it."""
    rng = stream(number, "subsets")
    most = min(MAX_VIEWS, matched.tracks.n_views)
    count = int(rng.integers(min(MIN_VIEWS, most), most + 1))
    views = np.sort(rng.choice(matched.tracks.n_views, count, replace=False))
    kept = rng.random(matched.tracks.n_points) < rng.uniform(LEAST_SHARE, 1.0)
    subset, first = take_views(matched, views, kept), int(rng.integers(LATEST_START))
    wish = IntrinsicsAssumption(cameras="shared" if mode == "shared" else "per-image")
    start, names = time.perf_counter(), tuple(int(view) for view in views)
    try:
        result, failures, attempts = solve(subset, PipelineConfig(intrinsics=wish), seed=number, first=first)
    except Exception as error:  # a crash is one of the results
        seconds = time.perf_counter() - start
        return Trial(number, names, 0, np.nan, np.nan, (), 0, seconds, f"{type(error).__name__}: {error}")
    seconds = time.perf_counter() - start
    if result is None:
        return Trial(number, names, 0, np.nan, np.nan, failures, attempts, seconds)
    model = result.reconstruction
    known = model.registered & np.isfinite(subset.focal_px)
    assert model.K is not None
    focal = np.sqrt(model.K[known, 0, 0] * model.K[known, 1, 1])
    errors = 100.0 * np.abs(focal / subset.focal_px[known] - 1.0)
    doubts = () if result.trusted else result.doubts or ("not trusted",)
    return Trial(
        number, names, int(model.registered.sum()), float(np.median(errors)), float(errors.max()), doubts,
        attempts, seconds,
    )  # fmt: skip


def describe(trial: Trial) -> str:
    """One line on a trial."""
    verdict = "crashed: " + trial.crash if trial.crash else "; ".join(trial.doubts) or "trusted"
    return (
        f"{trial.number}: views {trial.views}, {trial.registered} registered, focal {trial.median_pct:.2f} % "
        f"median {trial.worst_pct:.2f} % worst, {trial.attempts} attempts, {trial.seconds:.1f} s, {verdict}"
    )


def table_row(name: str, mode: str, trials: Sequence[Trial]) -> str:
    """One row of the table of :func:`main`."""
    right = [trial for trial in trials if trial.right]
    flagged = sum(bool(trial.doubts) for trial in trials)
    worst = np.array([trial.worst_pct for trial in trials if not trial.doubts])
    return (
        f"| {name} | {mode} | {len(right)} / {len(trials)} "
        f"| {np.nanmedian([trial.median_pct for trial in trials]):.2f} "
        f"| {np.nanmax(worst) if len(worst) else np.nan:.2f} "
        f"| {flagged} | {sum(trial.right for trial in trials if trial.doubts)} "
        f"| {sum(trial.unflagged_failure for trial in trials)} | {sum(bool(t.crash) for t in trials)} "
        f"| {np.median([trial.seconds for trial in trials]):.1f} |"
    )


HEAD = (
    "| set | cameras | focal within 3 % | median error, % | worst camera of a trusted answer, % | flagged "
    "| of these right | wrong and trusted | crashes | median time, s |\n" + "| --- " * 10 + "|"
)


def main(arguments: list[str] | None = None) -> int:
    """Print every trial that is not right and trusted, and the table; 1 where a set misses the bounds."""
    parser = argparse.ArgumentParser(prog="python -m validation.checks.subsets", description=__doc__)
    scenes = [*REAL_SCENES, "courtyard"]
    parser.add_argument("--scenes", nargs="*", default=scenes, choices=scenes)
    parser.add_argument("--modes", nargs="*", default=list(MODES), choices=MODES)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--work", type=Path, help="folder that keeps the matched photographs")
    wishes = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as place:
        matched = []
        for name in wishes.scenes:
            scene = load_fixture_scene() if name == "courtyard" else load_real_scene(name)
            if scene is None:
                print(f"{name} is not on this machine")
                continue
            matched.append(match_scene(scene, wishes.work or Path(place), threads=wishes.threads))
    return report(matched, wishes.modes, wishes.trials)


def report(sets: Sequence[Matched], modes: Sequence[str], trials: int) -> int:
    """Run the trials, print them and the table; 1 where a set misses the bounds."""
    rows, missed = [], False
    for matched in sets:
        for mode in modes:
            done = [run_trial(matched, mode, number) for number in range(trials)]
            for trial in done:
                if not trial.right or trial.doubts or trial.crash:
                    print(f"{matched.name}, {mode}, {describe(trial)}", flush=True)
            rows.append(table_row(matched.name, mode, done))
            success = sum(trial.right for trial in done) / len(done)
            bad = any(trial.unflagged_failure or trial.crash for trial in done)
            missed |= bad or success < LEAST_SUCCESS
            print(rows[-1], flush=True)
    print("\n".join([HEAD, *rows]))
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
