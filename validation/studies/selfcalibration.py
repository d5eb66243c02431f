"""Chapter 7: error and success of every self-calibration method.

``selfcalibration``: every method of the settings alone, and the whole with the metric stage, on the thesis'
cube and on a general cloud, over noise (27 cameras) and over the number of cameras (1 px), with one focal
length and with zoom. The projective cameras are the minimum of projective bundle adjustment in a random
frame, so chapter 7 alone is measured. A success is a focal length within 3 % (with zoom: that of the median
camera).
``stratified``: every method for the plane at infinity and both methods from it to K, in closed form and
refined.
"""

from __future__ import annotations

import json
import time
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np

import thesisrecon
from thesisrecon.arrays import F64
from thesisrecon.config import KINDS, SelfCalibrator
from thesisrecon.errors import StageFailure
from thesisrecon.intrinsics import IntrinsicsOptions, IntrinsicsPrior, prior_for, prior_from_options
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.records import Image, Reconstruction
from thesisrecon.selfcalibration.absolute_conic import FixedPlaneQuadric, LinearAbsoluteConic
from thesisrecon.selfcalibration.cheirality import CheiralitySearch
from thesisrecon.selfcalibration.hypotheses import HypothesesAndRefinement
from thesisrecon.selfcalibration.modulus import ModulusConstraint
from thesisrecon.selfcalibration.parallel_lines import ParallelLines
from thesisrecon.selfcalibration.stratified import Stratified
from validation.metrics.focal_bound import focal_bound
from validation.metrics.record import Metric
from validation.scenes.cloud import make_cloud
from validation.scenes.cube import OFF_FACE
from validation.scenes.real import REAL_SCENES
from validation.scenes.rigs import Rig, cube_rig, noisy_tracks, projective_from_truth, zoomed
from validation.studies.runner import Part, Rows, pick, scenes_here, text_table

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
"""Every method of the settings, and the stratified method (Hartley's search and K) in its parts."""

SCENES = ("cube", "cloud")
MODES = ("constant", "zooming")
NOISES_PX = (0.0, 0.5, 1.0, 2.0)
VIEWS = (3, 5, 9, 18, 27)
SUCCESS_PCT, WORST_PCT = 3.0, 5.0
PRINCIPAL_STD = 0.01
"""Prior standard deviation of the principal point over the long side."""
ZOOM = 0.3
"""Focal lengths are multiplied by e^u with u uniform in +-ZOOM."""


@dataclass(frozen=True)
class Cell:
    """One setting: scene, mode, noise and number of cameras."""

    scene: str
    mode: str
    sigma_px: float
    views: int


@dataclass(frozen=True)
class Trial:
    """One method on one draw.

    ``median_pct``, ``worst_pct``: median and largest |f / f_true - 1| over the cameras that see more than a
    plane, NaN after a refusal. For the bound, 0.6745 times the Cramer-Rao standard deviation: the median of
    |error|; ``sure``: whether the method calls its result identifiable (the whole: trusted).
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
    """Draw the cameras.

    Subsets of the cube leave out the six cameras that see one face only, and all their cameras are tied
    together by pairs with common points on more than one face; others have no projective reconstruction.
    """
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
    """Return the prior: square pixels, principal point near the middle, no distortion."""
    options = IntrinsicsOptions(
        focal="constant" if mode == "constant" else "free", principal_point_std_rel=PRINCIPAL_STD, k1="known"
    )
    n = len(rig.K)
    return prior_from_options(options, [rig.size] * n, np.full(n, np.nan), np.ones(n))


def run_cell(cell: Cell, methods: Sequence[str], seeds: Iterable[int]) -> list[Trial]:
    """Run all methods on all draws of a cell; every method gets the same draws."""
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
    """Return the true cameras and the projective reconstruction of noisy observations."""
    place = (seed, SCENES.index(cell.scene), MODES.index(cell.mode), cell.views, round(100 * cell.sigma_px))
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
    """Return K (V, 3, 3), and whether the method calls its result identifiable."""
    rng = np.random.default_rng(0)
    if method == WITH_BUNDLE:
        calibration = HypothesesAndRefinement().calibrate(projective, prior=prior, rng=rng)
        result = MetricRefinement().refine(projective, calibration, prior=prior, rng=rng)
        assert result.reconstruction.K is not None
        return result.reconstruction.K, result.trusted
    answer = VARIANTS[method].calibrate(projective, prior=prior, rng=rng)
    return answer.K, answer.identifiable


def cells(
    scenes: Sequence[str], modes: Sequence[str], noises: Sequence[float], views: Sequence[int]
) -> list[Cell]:
    """Return all noises at the most cameras and all numbers of cameras at 1 px."""
    middle = min(noises, key=lambda s: abs(s - 1.0))
    places = dict.fromkeys([(s, max(views)) for s in noises] + [(middle, v) for v in views])
    return [Cell(scene, mode, s, v) for scene in scenes for mode in modes for s, v in places]


def report(trials: Sequence[Trial]) -> str:
    """Return a table for each scene and mode: cameras at 1 px, other noises at the most cameras."""
    tables = []
    for scene, mode in dict.fromkeys((t.scene, t.mode) for t in trials):
        here = [t for t in trials if (t.scene, t.mode) == (scene, mode)]
        places = {(t.sigma_px, t.views) for t in here}
        noises, most = sorted({s for s, _ in places}), max(v for _, v in places)
        cross = sorted(p for p in places if p[0] == 1.0) + [(s, most) for s in noises if s != 1.0]
        tables.append(_table(f"{scene}, {mode}", here, cross))
    return "\n\n".join(tables)


def _table(title: str, trials: Sequence[Trial], places: Sequence[tuple[float, int]]) -> str:
    cells = [[t for t in trials if (t.sigma_px, t.views) == place] for place in places]
    rows = []
    for method in dict.fromkeys(t.method for t in trials):
        shown = [[t for t in cell if t.method == method] for cell in cells]
        if any(shown):
            rows.append([method, *map(_entry, shown)])
    whole = [[t for t in cell if t.method == WITH_BUNDLE] for cell in cells]
    alone = [[t for t in cell if t.method not in (WITH_BUNDLE, BOUND)] for cell in cells]
    for name, parts in (("draws of the whole", whole), ("draws of the others", alone)):
        if any(parts):
            rows.append([name, *map(_draws, parts)])
    return text_table([title, *(f"{v} cameras, {s:g} px" for s, v in places)], rows)


def _draws(trials: Sequence[Trial]) -> str:
    counts = Counter(t.method for t in trials).values() or [0]
    return f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"


def _entry(trials: Sequence[Trial]) -> str:
    """Return the median error (refusals count as infinite) and the shares of good draws in percent.

    Shares are shown unless all are 100: draws within 3 %, and with zoom draws whose worst camera is within 5
    %.
    """
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


def targets(trials: Sequence[Trial]) -> list[Metric]:
    metrics: list[Metric] = []
    for scene in SCENES:
        for mode in MODES:
            place = (scene, mode, 1.0, 27, WITH_BUNDLE)
            some = [t for t in trials if (t.scene, t.mode, t.sigma_px, t.views, t.method) == place]
            if not some:
                continue
            error, worst = (
                np.nan_to_num([getattr(t, name) for t in some], nan=np.inf)
                for name in ("median_pct", "worst_pct")
            )
            rows = Rows(f"{scene}, {mode}, {len(some)} trials", WITH_BUNDLE)
            if mode == "constant":
                rows.add("median focal error", float(np.median(error)), "%", at_most=0.06)
                rows.add("success", float(100.0 * np.mean(error <= SUCCESS_PCT)), "%", at_least=100.0)
            else:
                share = float(100.0 * np.mean(worst <= WORST_PCT))
                rows.add("worst camera within 5 %", share, "% of trials", at_least=90.0)
            metrics += rows
    return metrics


def read_trials(paths: Sequence[Path]) -> list[Trial]:
    """Read trials of earlier runs; the later of two equal draws and methods counts."""
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


# ---------------------------------------------------------------- stratified methods

PLANES: Mapping[str, CheiralitySearch | ModulusConstraint | ParallelLines] = {
    "cheirality, grid alone": CheiralitySearch(refine_iterations=0),
    "cheirality search": CheiralitySearch(),
    "modulus constraint": ModulusConstraint(),
    "parallel lines": ParallelLines(),
    "parallel lines, right angles": ParallelLines(orthogonal_directions=True),
}
K_METHODS: dict[str, LinearAbsoluteConic | FixedPlaneQuadric] = {
    "Hartley": LinearAbsoluteConic(),
    "Pollefeys": FixedPlaneQuadric(),
}


@dataclass(frozen=True)
class Row:
    """One method on one image set.

    ``focal_pct``: focal error, median over the views; ``principal_px``: error of the principal point;
    ``refusal``: reason of a refusal.
    """

    plane: str
    k_method: str
    refined: bool
    focal_pct: float
    principal_px: float
    seconds: float
    refusal: str = ""


def measure_stratified(
    projective: Reconstruction, images: Sequence[Image], K: F64, *, cameras: str = "shared"
) -> Iterator[Row]:
    """Run every stratified method on one set, against K (V, 3, 3) at working size."""
    options = IntrinsicsOptions(cameras="per-image" if cameras == "per-image" else "shared")
    prior = prior_for(projective, options)
    views = np.flatnonzero(projective.registered)
    for plane_name, plane in PLANES.items():
        for k_name, k_method in K_METHODS.items():
            for refined in (False, True):
                variant = Stratified(plane, k_method, refine=refined).with_images(images)
                start = time.perf_counter()
                head = (plane_name, k_name, refined)
                try:
                    answer = variant.calibrate(projective, prior=prior, rng=np.random.default_rng(0))
                except StageFailure as failure:
                    yield Row(*head, np.nan, np.nan, time.perf_counter() - start, failure.reason)
                    continue
                focal = 100.0 * np.abs(answer.K[views, 0, 0] / K[views, 0, 0] - 1.0)
                principal = np.linalg.norm(answer.K[views, :2, 2] - K[views, :2, 2], axis=1)
                seconds = time.perf_counter() - start
                yield Row(*head, float(np.median(focal)), float(np.median(principal)), seconds)


def stratified_table(name: str, rows: Sequence[Row]) -> str:
    """Return focal errors in closed form and refined, the refined principal point and the time."""
    cells = []
    for closed, refined in zip(rows[::2], rows[1::2], strict=True):
        numbers = [f"{row.focal_pct:.3f} %" if not row.refusal else "refused" for row in (closed, refined)]
        principal = f"{refined.principal_px:.1f} px" if not refined.refusal else refined.refusal
        cells.append([closed.plane, closed.k_method, *numbers, principal, f"{closed.seconds:.1f}"])
    head = [name, "method for K", "focal, closed form", "focal, refined", "principal point, refined", "s"]
    return text_table(head, cells)


# ---------------------------------------------------------------- the studies


def selfcalibration_study(
    scenes: Sequence[Literal["cube", "cloud"]] = ("cube", "cloud"),
    modes: Sequence[Literal["constant", "zooming"]] = ("constant", "zooming"),
    noise: Sequence[float] = NOISES_PX,
    views: Sequence[int] = VIEWS,
    methods: Sequence[str] | None = None,
    trials: int = 10,
    first: int = 0,
    workers: int = 1,
    read: Sequence[Path] = (),
    append: Path | None = None,
) -> Iterator[Part]:
    """Compare all self-calibration methods on the thesis' cube and on a point cloud."""
    names = tuple(pick(methods, [*VARIANTS, WITH_BUNDLE, BOUND]))
    places = cells(scenes, modes, noise, views)
    jobs = [(cell, names, first + k, 1) for k in range(trials) for cell in places]
    done = read_trials(read)
    with ProcessPoolExecutor(workers) as pool:
        for found in pool.map(_quiet_cell, jobs):
            done += found
            if append is not None:
                with append.open("a", encoding="utf-8") as file:
                    file.writelines(json.dumps(asdict(t)) + "\n" for t in found)
    yield report(done)
    judged = targets(done)
    for scene in dict.fromkeys(row.scene for row in judged):
        yield [row for row in judged if row.scene == scene]


def stratified_study(
    out: Path,
    scenes: Sequence[str] = ("courtyard", *REAL_SCENES),
    cameras: Literal["shared", "per-image"] = "shared",
) -> Iterator[Part]:
    """Compare the stratified methods alone on real images.

    Without truth, the metric result of the default pipeline stands in.
    """
    for scene in scenes_here(scenes):
        run = thesisrecon.reconstruct(scene.image_paths[0].parent, out / scene.name, until="metric")
        assert run.projective is not None
        assert run.metric is not None
        K = run.metric.reconstruction.K if scene.K is None else scene.K
        assert K is not None
        rows = list(measure_stratified(run.projective, run.images, K, cameras=cameras))
        yield stratified_table(scene.name, rows)
