"""Chapter 7 on synthetic scenes: error and success per method.

``python -m validation.studies.selfcalibration``: every method of the table of kinds alone, and the whole with
the metric stage behind it, on the thesis' cube and on a general cloud, over noise (at 27 cameras) and over
the number of cameras (at 1 px), with one focal and with a zoomed one. The projective cameras are the minimum
of the projective bundle adjustment, in a random frame: what is measured is chapter 7 alone. Success is a
focal within 3 % (zoomed: the median camera's).
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.config import KINDS, SelfCalibrator
from thesisrecon.errors import StageFailure
from thesisrecon.intrinsics import IntrinsicsOptions, IntrinsicsPrior, prior_from_options
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.records import Reconstruction
from thesisrecon.selfcalibration.hartley import FixedPlaneQuadric
from thesisrecon.selfcalibration.hypotheses import HypothesesAndRefinement
from thesisrecon.selfcalibration.modulus import ModulusConstraint
from thesisrecon.selfcalibration.stratified import Stratified
from validation.metrics.focal_bound import focal_bound
from validation.metrics.record import Metric, markdown_table
from validation.scenes.cloud import make_cloud
from validation.scenes.rigs import Rig, cube_rig, noisy_tracks, projective_from_truth, zoomed
from validation.studies.epipolar_cube import OFF_FACE

WITH_BUNDLE = "the whole, with the metric stage"
BOUND = "the bound"
VARIANTS: dict[str, SelfCalibrator] = {
    **{kind: variant() for kind, variant in KINDS["selfcalibration"].items()},
    "stratified, closed form": Stratified(refine=False),
    "stratified, Pollefeys' K, closed form": Stratified(calibration=FixedPlaneQuadric(), refine=False),
    "modulus constraint": Stratified(ModulusConstraint()),
    "modulus constraint, closed form": Stratified(ModulusConstraint(), refine=False),
    "modulus constraint, Pollefeys' K, closed form": Stratified(
        ModulusConstraint(), FixedPlaneQuadric(), refine=False
    ),
}
"""Every kind of the table, and the stratified one (by default Hartley's search, then his K) in its parts."""

SCENES = ("cube", "cloud")
MODES = ("constant", "zooming")
NOISES_PX = (0.0, 0.5, 1.0, 2.0)
VIEWS = (3, 5, 9, 18, 27)
SUCCESS_PCT, WORST_PCT = 3.0, 5.0
PRINCIPAL_STD = 0.01
"""What is told of the principal point: its deviation over the long side."""
ZOOM = 0.3
"""Focals are multiplied by e^u, u uniform within this of 0."""


@dataclass(frozen=True)
class Cell:
    """One place of the tables."""

    scene: str
    mode: str
    sigma_px: float
    views: int


@dataclass(frozen=True)
class Trial:
    """One method on one draw: median and worst |f / f_true - 1| over the cameras in percent, NaN where it
    refused, with the reason; whether it called itself identifiable (the whole: trusted); seconds.

    The cameras are those that see more than a plane; of the others no method can tell the focal to 5 %. The
    bound's "errors" are those of a normal deviate of the Cramer-Rao standard deviation, its median |error|.
    """

    scene: str
    mode: str
    sigma_px: float
    views: int
    seed: int
    method: str
    median_pct: float
    worst_pct: float
    sure: bool
    seconds: float
    refusal: str = ""


def make_rig(cell: Cell, rng: np.random.Generator) -> Rig:
    """The cameras of one draw. Of the cube's, subsets leave out the six that see a single face, and are such
    that pairs whose common points are on more than one face tie all together: others have no projective
    reconstruction."""
    if cell.scene == "cloud":
        rig = make_cloud(cell.views, rng)
    else:
        rig = cube_rig()
        if cell.views < len(rig.K):
            assert rig.flat is not None
            usable, whole = np.flatnonzero(~rig.flat), rig
            rig = whole.subset(np.sort(rng.choice(usable, cell.views, replace=False)))
            while not rig.tied_off_planes(OFF_FACE):
                rig = whole.subset(np.sort(rng.choice(usable, cell.views, replace=False)))
    return zoomed(rig, np.exp(rng.uniform(-ZOOM, ZOOM, len(rig.K)))) if cell.mode == "zooming" else rig


def assumptions(rig: Rig, mode: str) -> IntrinsicsPrior:
    """Square pixels, a principal point near the middle, no distortion; the focal constant or free."""
    wish = IntrinsicsOptions(
        focal="constant" if mode == "constant" else "free",
        principal_point_std_rel=PRINCIPAL_STD,
        k1="known",
    )
    n = len(rig.K)
    return prior_from_options(wish, [rig.size] * n, np.full(n, np.nan), np.ones(n))


def run_cell(cell: Cell, methods: Sequence[str], seeds: Iterable[int]) -> list[Trial]:
    """All methods on all draws of a cell; every method sees the same draws."""
    trials = []
    for seed in seeds:
        rig, projective = draw_cell(cell, seed)
        prior = assumptions(rig, cell.mode)
        for method in methods:
            if method == BOUND:
                trials.append(_bound(cell, seed, rig))
            else:
                trials.append(_run(cell, seed, method, rig, projective, prior))
    return trials


def draw_cell(cell: Cell, seed: int) -> tuple[Rig, Reconstruction]:
    """One draw of a cell: the true cameras, and the projective reconstruction of noisy observations."""
    place = (
        seed,
        SCENES.index(cell.scene),
        MODES.index(cell.mode),
        cell.views,
        round(100 * cell.sigma_px),
    )
    rng = np.random.default_rng(place)
    rig = make_rig(cell, rng)
    return rig, projective_from_truth(rig, noisy_tracks(rig, cell.sigma_px, rng), rng)


def _run(
    cell: Cell, seed: int, method: str, rig: Rig, projective: Reconstruction, prior: IntrinsicsPrior
) -> Trial:
    start = time.perf_counter()
    head = (cell.scene, cell.mode, cell.sigma_px, cell.views, seed, method)
    try:
        K, sure = focals_of(method, projective, prior)
    except StageFailure as failure:
        return Trial(*head, np.nan, np.nan, False, time.perf_counter() - start, failure.reason)
    seconds = time.perf_counter() - start
    judged = projective.registered
    error = 100.0 * np.abs(K[judged, 0, 0] / rig.K[judged, 0, 0] - 1.0)
    return Trial(*head, float(np.median(error)), float(error.max()), sure, seconds)


def _bound(cell: Cell, seed: int, rig: Rig) -> Trial:
    head = (cell.scene, cell.mode, cell.sigma_px, cell.views, seed, BOUND)
    if cell.sigma_px == 0.0:
        return Trial(*head, 0.0, 0.0, True, 0.0)
    std = focal_bound(
        rig, cell.sigma_px, zooming=cell.mode == "zooming", principal_std_px=PRINCIPAL_STD * max(rig.size)
    )
    judged = std if rig.flat is None else std[~rig.flat]
    return Trial(*head, 0.6745 * float(np.median(judged)), 0.6745 * float(judged.max()), True, 0.0)


def focals_of(method: str, projective: Reconstruction, prior: IntrinsicsPrior) -> tuple[F64, bool]:
    """K (V, 3, 3) by a kind of the table or by the whole, and whether the method stands by it."""
    rng = np.random.default_rng(0)
    if method == WITH_BUNDLE:
        calibration = HypothesesAndRefinement().calibrate(projective, prior=prior, rng=rng)
        result = MetricRefinement().refine(projective, calibration, prior=prior, rng=rng)
        assert result.reconstruction.K is not None
        return result.reconstruction.K, result.trusted
    answer = VARIANTS[method].calibrate(projective, prior=prior, rng=rng)
    return answer.K, answer.identifiable


def cells(
    scenes: Sequence[str],
    modes: Sequence[str],
    noises: Sequence[float],
    views: Sequence[int],
    *,
    grid: bool = False,
) -> list[Cell]:
    """Noise at the most cameras, cameras at 1 px (or the noise nearest to it); or every noise at each."""
    middle = min(noises, key=lambda s: abs(s - 1.0))
    cross = [(s, max(views)) for s in noises] + [(middle, v) for v in views]
    places = dict.fromkeys([(s, v) for s in noises for v in views] if grid else cross)
    return [Cell(scene, mode, s, v) for scene in scenes for mode in modes for s, v in places]


def report(trials: Sequence[Trial]) -> str:
    """Markdown: for each scene and mode a table over cameras at 1 px and over noise at the most cameras, and
    after these one for every other noise that has more than one number of cameras."""
    crosses, others = [], []
    for scene in dict.fromkeys(t.scene for t in trials):
        for mode in dict.fromkeys(t.mode for t in trials if t.scene == scene):
            here = [t for t in trials if (t.scene, t.mode) == (scene, mode)]
            places = {(t.sigma_px, t.views) for t in here}
            noises, most = sorted({s for s, _ in places}), max(v for _, v in places)
            cross = sorted(p for p in places if p[0] == 1.0) + [(s, most) for s in noises if s != 1.0]
            crosses.append(_table(f"{scene}, {mode}", here, cross))
            for sigma in noises:
                row = sorted(p for p in places if p[0] == sigma)
                if sigma != 1.0 and len(row) > 1:
                    others.append(_table(f"{scene}, {mode}, {sigma:g} px", here, row))
    return "\n\n".join([*crosses, *others])


def _table(title: str, trials: Sequence[Trial], places: Sequence[tuple[float, int]]) -> str:
    """A row a method, a column a place (noise, number of cameras); ``title`` tells what they share."""
    cells = [[t for t in trials if (t.sigma_px, t.views) == place] for place in places]
    lines = [
        f"| {title} | {' | '.join(f'{v} cameras, {s:g} px' for s, v in places)} |",
        f"| --- |{' --- |' * len(places)}",
    ]
    for method in dict.fromkeys(t.method for t in trials):
        shown = [[t for t in cell if t.method == method] for cell in cells]
        if any(shown):
            lines.append(f"| {method} | {' | '.join(map(_entry, shown))} |")
    whole = [[t for t in cell if t.method == WITH_BUNDLE] for cell in cells]
    alone = [[t for t in cell if t.method not in (WITH_BUNDLE, BOUND)] for cell in cells]
    for name, parts in (("draws of the whole", whole), ("draws of the others", alone)):
        if any(parts):
            lines.append(f"| {name} | {' | '.join(map(_draws, parts))} |")
    return "\n".join(lines)


def _draws(trials: Sequence[Trial]) -> str:
    """The number of draws that the entries of one column rest on."""
    counts = Counter(t.method for t in trials).values() or [0]
    return f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"


def _entry(trials: Sequence[Trial]) -> str:
    """Median error (those that refused count as infinite); where not all draws are near enough, the share
    that is, and zoomed that of the worst cameras within 5 %."""
    if not trials:
        return "-"
    error = np.array([t.median_pct if np.isfinite(t.median_pct) else np.inf for t in trials])
    worst = np.array([t.worst_pct if np.isfinite(t.worst_pct) else np.inf for t in trials])
    middle = float(np.median(error))
    text = f"{middle:.2g}" if middle < 99.5 else f"{middle:.0f}" if np.isfinite(middle) else "refused"
    text = "0" if middle < 1e-4 else text
    shares = [100.0 * np.mean(error <= SUCCESS_PCT)]
    if trials[0].mode == "zooming":
        shares.append(100.0 * np.mean(worst <= WORST_PCT))
    if min(shares) == 100.0 or trials[0].method == BOUND or not np.isfinite(error).any():
        return text
    return f"{text} ({', '.join(f'{share:.0f}' for share in shares)})"


def targets(trials: Sequence[Trial]) -> str:
    """What the study must show, at 1 px and 27 cameras."""
    rows = []
    for scene in SCENES:
        for mode in MODES:
            place = (scene, mode, 1.0, 27, WITH_BUNDLE)
            some = [t for t in trials if (t.scene, t.mode, t.sigma_px, t.views, t.method) == place]
            if not some:
                continue
            error = np.nan_to_num([t.median_pct for t in some], nan=np.inf)
            worst = np.nan_to_num([t.worst_pct for t in some], nan=np.inf)
            name = f"{scene}, {mode}, {len(some)} trials"
            if mode == "constant":
                rows.append(_metric(name, "median focal error", "%", float(np.median(error)), 0.06, True))
                success = float(100.0 * np.mean(error <= SUCCESS_PCT))
                rows.append(_metric(name, "success", "%", success, 100.0, False))
            else:
                share = float(100.0 * np.mean(worst <= WORST_PCT))
                rows.append(_metric(name, "worst camera within 5 %", "% of trials", share, 90.0, False))
    return "\n\n".join(f"{m.scene}\n\n{markdown_table([m])}" for m in rows)


def _metric(scene: str, name: str, unit: str, value: float, target: float, at_most: bool) -> Metric:
    return Metric(scene, name, unit, {WITH_BUNDLE: value}, WITH_BUNDLE, target, at_most)


def read_trials(paths: Sequence[Path]) -> list[Trial]:
    """Trials written before; of two of the same draw and method the later counts."""
    lines = [line for path in paths for line in path.read_text(encoding="utf-8").splitlines()]
    trials = [Trial(**json.loads(line)) for line in lines]
    unique = {(t.scene, t.mode, t.sigma_px, t.views, t.seed, t.method): t for t in trials}
    order = [*VARIANTS, WITH_BUNDLE, BOUND]
    return sorted(unique.values(), key=lambda t: order.index(t.method) if t.method in order else len(order))


def _quiet_cell(job: tuple[Cell, tuple[str, ...], int, int]) -> list[Trial]:
    cell, methods, first, count = job
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return run_cell(cell, methods, range(first, first + count))


def main() -> int:
    """Run the cells, append every trial to a file, print the tables."""
    known = [*VARIANTS, WITH_BUNDLE, BOUND]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=SCENES, choices=SCENES)
    parser.add_argument("--modes", nargs="+", default=MODES, choices=MODES)
    parser.add_argument("--noise", type=float, nargs="+", default=NOISES_PX)
    parser.add_argument("--views", type=int, nargs="+", default=VIEWS)
    parser.add_argument("--methods", nargs="+", default=known, choices=known, metavar="NAME")
    parser.add_argument("--grid", action="store_true", help="every noise at every number of cameras")
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="number of the first draw")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument(
        "--read", type=Path, nargs="*", default=[], help="trials of earlier runs; with --trials 0 only report"
    )
    parser.add_argument(
        "-o", "--out", type=Path, help="file that every trial is appended to, a JSON line each"
    )
    arguments = parser.parse_args()
    jobs = [
        (cell, tuple(arguments.methods), arguments.first + k, 1)
        for k in range(arguments.trials)
        for cell in cells(
            arguments.scenes, arguments.modes, arguments.noise, arguments.views, grid=arguments.grid
        )
    ]
    trials = read_trials(arguments.read)
    with ProcessPoolExecutor(arguments.workers) as pool:
        for found in pool.map(_quiet_cell, jobs):
            trials += found
            if arguments.out:
                with arguments.out.open("a", encoding="utf-8") as file:
                    file.writelines(json.dumps(asdict(t)) + "\n" for t in found)
    print(report(trials), targets(trials), sep="\n\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
