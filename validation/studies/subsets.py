"""Chapters 6 and 7 on random subsets of real photographs: ``python -m validation.studies.subsets``.

Each trial takes 5 to 8 of a set's cameras (``--views``), a random share of the tracks, another seed and
another initial pair, and goes from tracks to metric cameras as the pipeline does, with its three attempts. A
trial succeeds where the median focal length of its cameras is within 3 % of the truth; the self-check must
flag what does not. Where a set has no truth, the answer from all of its photographs stands in. The nine views
of the Cones, a camera that was shifted without turning, have no right answer but a refusal that says so.
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

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure
from thesisrecon.intrinsics import IntrinsicsOptions, prior_from_options
from thesisrecon.pipeline.cameras import ATTEMPTS
from thesisrecon.pipeline.reconstruction import reconstruct
from thesisrecon.records import MetricResult, Tracks, TwoView
from thesisrecon.runtime.run import stream
from validation.scenes.real import REAL_SCENES, Scene, data_root, load_fixture_scene, load_real_scene

MODES = ("shared", "per-image")
SUCCESS_PCT = 3.0
LEAST_SUCCESS = 0.98
MIN_VIEWS, MAX_VIEWS = 5, 8
SHIFTED = "Cones9"
SHIFTED_REASONS = ("pure translation", "leaves the focal length open", "at least 3 photographs")
LEAST_SHARE = 0.3
LATEST_START = 4


@dataclass(frozen=True)
class Matched:
    """A set after its front end: tracks, pairs, image ``sizes`` (V, 2), and the ``focal_px`` (V,) at working
    size that the answers are held against; ``reasons`` one of which a refusal must give, empty where any
    will do."""

    name: str
    tracks: Tracks
    pairs: Sequence[TwoView]
    sizes: I64
    focal_px: F64
    reasons: tuple[str, ...] = ()


OUTCOMES = ("right", "open", "refused", "refused, another reason", "right, doubted", "wrong", "crash")
"""Of a trial: within 3 % and trusted; farther off, but not farther than its 95 % interval; wrong or without
an answer and not trusted, for the right reason or another; within 3 % and not trusted; wrong and trusted."""


@dataclass(frozen=True)
class Trial:
    """One subset: its views, what came of it, and how long it took.

    ``median_pct`` and ``worst_pct`` are focal errors over the registered cameras, NaN where there is no
    answer; ``failed_checks`` is empty where the answer is trusted; ``interval_pct`` is half of the median 95 %
    interval of the focals; ``reasons`` as in :class:`Matched`.
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
        """Whether there is an answer whose median focal is within 3 %."""
        return self.median_pct <= SUCCESS_PCT

    @property
    def outcome(self) -> str:
        """One of ``OUTCOMES``."""
        if self.crash:
            return "crash"
        if self.right:
            return "right, doubted" if self.failed_checks else "right"
        if self.failed_checks:
            told = "; ".join(self.failed_checks)
            named = not self.reasons or any(reason in told for reason in self.reasons)
            return "refused" if named else "refused, another reason"
        return "open" if self.median_pct <= self.interval_pct else "wrong"


def match_scene(scene: Scene, work: Path, *, threads: int) -> Matched:
    """The front end of a set, resumed from ``work`` where it was run before."""
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
    return replace(
        matched, tracks=tracks, pairs=pairs, sizes=matched.sizes[views], focal_px=matched.focal_px[views]
    )


def solve(
    matched: Matched, config: PipelineConfig, *, seed: int, first: int
) -> tuple[MetricResult | None, tuple[str, ...], int]:
    """From tracks to metric cameras; the answer, the failures' sentences, the number of attempts.

    As the pipeline: up to three attempts, the first trusted answer, else the one with most cameras.
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
                    projective, calibration, prior=prior, rng=stream(seed, "metric", attempt)
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
    matched: Matched, mode: str, number: int, *, views: tuple[int, int] = (MIN_VIEWS, MAX_VIEWS)
) -> Trial:
    """Draw one subset of as many ``views`` (fewest, most) and solve it."""
    rng = stream(number, "subsets")
    most = min(views[1], matched.tracks.n_views)
    count = int(rng.integers(min(views[0], most), most + 1))
    chosen = np.sort(rng.choice(matched.tracks.n_views, count, replace=False))
    kept = rng.random(matched.tracks.n_points) < rng.uniform(LEAST_SHARE, 1.0)
    subset = take_views(matched, chosen, kept)
    # Two photographs have one pair to begin with.
    first = int(rng.integers(max(min(LATEST_START, sum(pair.accepted for pair in subset.pairs)), 1)))
    wish = IntrinsicsOptions(cameras="shared" if mode == "shared" else "per-image")
    start, names = time.perf_counter(), tuple(int(view) for view in chosen)
    nothing = Trial(number, names, 0, np.nan, np.nan, (), 0, 0.0, reasons=matched.reasons)
    try:
        result, failures, attempts = solve(subset, PipelineConfig(intrinsics=wish), seed=number, first=first)
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


def describe(trial: Trial) -> str:
    """One line on a trial."""
    verdict = f"{trial.outcome}: {trial.crash or '; '.join(trial.failed_checks) or 'trusted'}"
    return (
        f"{trial.number}: views {trial.views}, {trial.registered} registered, focal {trial.median_pct:.2f} % "
        f"median {trial.worst_pct:.2f} % worst, {trial.attempts} attempts, {trial.seconds:.1f} s, {verdict}"
    )


def table_row(name: str, mode: str, trials: Sequence[Trial]) -> str:
    """One row of the table of :func:`main`."""
    errors = [trial.median_pct for trial in trials if np.isfinite(trial.median_pct)]
    worst = [t.worst_pct for t in trials if not t.failed_checks and np.isfinite(t.worst_pct)]
    return (
        f"| {name} | {mode} | {len(trials)} "
        f"| {' | '.join(str(sum(t.outcome == kind for t in trials)) for kind in OUTCOMES)} "
        f"| {f'{np.median(errors):.2f}' if errors else '-'} | {f'{max(worst):.2f}' if worst else '-'} "
        f"| {np.median([trial.seconds for trial in trials]):.1f} |"
    )


HEAD = (
    f"| set | cameras | trials | {' | '.join(OUTCOMES)} | median error, % "
    "| worst camera of a trusted answer, % | median time, s |\n" + "| --- " * (len(OUTCOMES) + 6) + "|"
)


def load_scene(name: str) -> Scene | None:
    """A set by its name, None where it is not on this machine."""
    if name == "courtyard":
        return load_fixture_scene()
    if name != SHIFTED:
        return load_real_scene(name)
    root = data_root()
    paths = () if root is None else tuple(sorted((root / "stereo" / SHIFTED).glob("im*.png")))
    return Scene(SHIFTED, paths) if paths else None


def main(arguments: list[str] | None = None) -> int:
    """Print every trial that is not right and trusted, and the table; 1 where a set misses the bounds."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.subsets", description=__doc__)
    scenes = [*REAL_SCENES, "courtyard", SHIFTED]
    parser.add_argument("--scenes", nargs="*", default=scenes, choices=scenes)
    parser.add_argument("--modes", nargs="*", default=list(MODES), choices=MODES)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument(
        "--views", type=int, nargs=2, default=[MIN_VIEWS, MAX_VIEWS], metavar=("LEAST", "MOST")
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--work", type=Path, help="folder that keeps the matched photographs")
    wishes = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as place:
        matched = []
        for name in wishes.scenes:
            scene = load_scene(name)
            if scene is None:
                print(f"{name} is not on this machine")
                continue
            matched.append(match_scene(scene, wishes.work or Path(place), threads=wishes.threads))
    return report(matched, wishes.modes, wishes.trials, tuple(wishes.views))


def report(sets: Sequence[Matched], modes: Sequence[str], trials: int, views: tuple[int, int]) -> int:
    """Run the trials, print them and the table; 1 where a set misses the bounds."""
    rows, missed = [], False
    for matched in sets:
        for mode in modes:
            done = [run_trial(matched, mode, number, views=views) for number in range(trials)]
            for trial in done:
                if trial.outcome != "right":
                    print(f"{matched.name}, {mode}, {describe(trial)}", flush=True)
            rows.append(table_row(matched.name, mode, done))
            wanted = "refused" if matched.reasons else "right"
            missed |= any(trial.outcome in ("wrong", "crash") for trial in done)
            missed |= sum(trial.outcome == wanted for trial in done) < LEAST_SUCCESS * len(done)
            print(rows[-1], flush=True)
    print("\n".join([HEAD, *rows]))
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
