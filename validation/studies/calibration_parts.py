"""Self-calibration on parts of real sets, and coverage of its intervals on synthetic scenes.

The parts are random subsets of the images and points of a set, and sets with one image that hardly overlaps
with the others. ``calibration-coverage``: general scenes of random cameras with noisy tracks, from the
projective maximum-likelihood reconstruction through self-calibration to the metric stage. 95 % intervals of
focal length and principal point should contain the truth in 95 of 100 cases.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure
from thesisrecon.intrinsics import prior_for
from thesisrecon.records import MetricResult, Reconstruction, RunResult, Tracks
from thesisrecon.runtime.run import stream
from validation.metrics.cameras import TrueCameras
from validation.metrics.intervals import (
    LEVEL,
    IntervalScores,
    focal_errors_pct,
    holding_std,
    interval_scores,
    join_scores,
)
from validation.metrics.record import Metric
from validation.scenes.critical import Motion, make_sequence, projective_estimate
from validation.scenes.critical import Sequence as SyntheticSequence
from validation.studies.main_job import OURS
from validation.studies.runner import Part, Rows
from validation.studies.subsets import Matched, solve, take_views

Cameras = Literal["shared", "per-image"]
MODES: tuple[Cameras, ...] = ("shared", "per-image")
SUBSETS = 20
SUBSET_SIZES = (5, 8)
SUCCESS_PCT = 3.0
KEPT_TRACKS = 0.7
MIN_HOLDING = 0.92
WINDOW_SHARE = 0.35
PLANE_SHARE = 0.004
"""Largest distance of a point to its plane over its depth."""
WIDE_REL = 0.02
"""Relative standard deviation from which on a focal length counts as marked uncertain."""


def check_parts(name: str, run: RunResult | None, truth: TrueCameras) -> list[list[Metric]]:
    """Return the tables of both studies; none if the run of the whole set failed."""
    if run is None or run.metric is None or run.tracks is None:
        return []
    sizes = np.array([image.size for image in run.images], dtype=np.int64)
    matched = Matched(name, run.tracks, run.pairs, sizes, truth.K[:, 0, 0])
    tables = [check_subsets(f"{name}, subsets, {cameras}", matched, truth.K, cameras) for cameras in MODES]
    weak = list(weak_views(matched, run.metric.reconstruction))
    for common_prior in (True, False):
        title = f"{name}, per-image, one weak image, {'common prior' if common_prior else 'no common prior'}"
        tables.append(check_weak(title, weak, truth.K, common_prior=common_prior))
    return tables


def check_subsets(title: str, matched: Matched, K: F64, cameras: Cameras) -> list[Metric]:
    """Measure the intervals on random subsets of the images with random points.

    :mod:`validation.studies.subsets` measures how often subsets succeed.
    """
    scores: list[IntervalScores] = []
    errors: list[float] = []
    for trial in range(SUBSETS):
        part, views = draw_subset(matched, np.random.default_rng([trial, len(K)]))
        result = _try(part, cameras, trial)
        if result is None or not result.trusted:
            continue
        assert result.reconstruction.K is not None
        errors.append(float(np.nanmax(focal_errors_pct(result.reconstruction.K, K[views]))))
        scores.append(one_camera(interval_scores(result, K[views]), cameras))
    rows = Rows(title, OURS)
    rows.add(f"trusted of {SUBSETS}", float(len(scores)))
    if not scores:
        return rows
    rows.add("focal error of the worst camera, median over subsets, %", float(np.median(errors)))
    rows.add("focal error of the worst camera of all, %", float(np.max(errors)))
    add_intervals(rows, join_scores(scores), MIN_HOLDING)
    return rows


def add_intervals(rows: Rows, scores: IntervalScores, least: float | None) -> None:
    """Add coverage and width of the 95 % intervals of focal length and principal point."""
    for label, columns in COLUMNS.items():
        row = f"95 % intervals of the {label} that hold the truth"
        rows.add(row, scores.holding(columns), at_least=least)
        rows.add(f"largest error, {label}", scores.worst(columns), "stated standard deviations")
    width = float(100.0 * np.nanmedian(scores.std_rel))
    rows.add("stated standard deviation of the focal, median", width, "%")


def draw_subset(matched: Matched, rng: np.random.Generator) -> tuple[Matched, I64]:
    """Draw 5 to 8 images and a part of the points; also return the view numbers."""
    low, high = SUBSET_SIZES
    n = matched.tracks.n_views
    size = int(rng.integers(low, min(high, n - 1) + 1))
    views = np.sort(rng.choice(n, size, replace=False)).astype(np.int64)
    return take_views(matched, views, rng.random(matched.tracks.n_points) < KEPT_TRACKS), views


def one_camera(scores: IntervalScores, cameras: Cameras) -> IntervalScores:
    """Keep one view if all views share a camera."""
    if cameras == "per-image":
        return scores
    first = int(np.flatnonzero(np.isfinite(scores.std_rel))[0])
    return IntervalScores(scores.z[first : first + 1], scores.std_rel[first : first + 1])


def _try(matched: Matched, cameras: Cameras, seed: int, *, common_prior: bool = True) -> MetricResult | None:
    options = replace(PipelineConfig().intrinsics, cameras=cameras, common_prior=common_prior)
    result, failures, _ = solve(matched, PipelineConfig(intrinsics=options), seed=seed, first=0)
    if result is None:
        print(f"{matched.name}, seed {seed}: {failures[0]}", file=sys.stderr, flush=True)
    return result


@dataclass(frozen=True)
class Weak:
    """A set in which one ``view`` keeps few observations, chosen by ``kind``."""

    matched: Matched
    view: int
    kind: str


def weak_views(matched: Matched, model: Reconstruction) -> Iterator[Weak]:
    """Reduce every image in turn to a small window, and to the points of one plane."""
    t = matched.tracks
    for view in np.flatnonzero(model.registered):
        rng = np.random.default_rng([7, int(view)])
        mine = np.flatnonzero((t.view_index == view) & model.valid[t.point_index])
        if len(mine) < 100:
            continue
        for kind, choose in KINDS.items():
            kept = np.zeros(len(t.xy), dtype=bool)
            kept[mine[choose(matched, model, mine, rng)]] = True
            yield Weak(without(matched, (t.view_index == view) & ~kept, int(view)), int(view), kind)


def without(matched: Matched, observations: B8, view: int) -> Matched:
    """Drop these ``observations`` (K,) of one ``view``, and the pairs of this view."""
    tracks = keep_observations(matched.tracks, ~observations)
    return replace(matched, tracks=tracks, pairs=[p for p in matched.pairs if view not in (p.i, p.j)])


def keep_observations(tracks: Tracks, kept: B8) -> Tracks:
    """Return the ``kept`` (K,) observations of points that still have two of them."""
    t = tracks
    kept = kept & (np.bincount(t.point_index[kept], minlength=t.n_points)[t.point_index] >= 2)
    return Tracks(t.view_index[kept], t.point_index[kept], t.xy[kept], t.n_views, t.n_points)


def _in_window(matched: Matched, _: Reconstruction, mine: np.ndarray, rng: np.random.Generator) -> B8:
    xy = matched.tracks.xy[mine]
    half = 0.5 * WINDOW_SHARE * matched.sizes[matched.tracks.view_index[mine[0]]]
    return np.asarray((np.abs(xy - xy[rng.integers(len(xy))]) <= half).all(axis=1))


def _in_plane(matched: Matched, model: Reconstruction, mine: np.ndarray, rng: np.random.Generator) -> B8:
    """Keep the points of the plane that holds most of them."""
    Xh = model.X[matched.tracks.point_index[mine]]
    depth = np.abs(Xh @ model.P[matched.tracks.view_index[mine[0]], 2])
    best = np.zeros(len(Xh), dtype=bool)
    for _ in range(300):
        plane = np.linalg.svd(Xh[rng.choice(len(Xh), 3, replace=False)])[2][3]
        on = np.abs(Xh @ plane) / max(float(np.linalg.norm(plane[:3])), 1e-12) < PLANE_SHARE * depth
        best = on if on.sum() > best.sum() else best
    return best


KINDS: dict[str, Callable[[Matched, Reconstruction, np.ndarray, np.random.Generator], B8]] = {
    "window": _in_window,
    "plane": _in_plane,
}


def check_weak(title: str, sets: Sequence[Weak], K: F64, *, common_prior: bool) -> list[Metric]:
    """Measure error and interval of the weak image, and whether the result marks it."""
    rows = Rows(title, OURS)
    for kind in KINDS:
        found = [_judge(weak, K, common_prior) for weak in sets if weak.kind == kind]
        error, width, z, marked, others = (np.array(part) for part in zip(*found, strict=True))
        _add_weak(rows, f"{kind}: ", error, z, marked.astype(bool), MIN_HOLDING)
        rows.add(f"{kind}: stated standard deviation, median", float(np.nanmedian(width)), "%")
        rows.add(f"{kind}: focal error of the other images, median", float(np.nanmedian(others)), "%")
    return rows


def _add_weak(rows: Rows, kind: str, error: F64, z: F64, marked: B8, least: float) -> None:
    """Add errors (%), |z| and marking of the weak images, NaN if one is not registered."""
    there = np.isfinite(error)
    unmarked = there & (error > SUCCESS_PCT) & ~marked
    rows.add(f"{kind}registered of {len(error)}", there.sum())
    rows.add(f"{kind}focal error, median", float(np.nanmedian(error)), "%")
    rows.add(f"{kind}focal error, worst", float(np.nanmax(error)), "%")
    held = float(np.mean(z[there] <= LEVEL))
    rows.add(f"{kind}95 % intervals of the focal that hold the truth", held, at_least=least)
    rows.add(f"{kind}largest error", float(np.nanmax(z)), "stated standard deviations")
    rows.add(f"{kind}off by more than {SUCCESS_PCT:.0f} % and not marked", unmarked.sum(), at_most=0.0)
    rows.add(f"{kind}marked", float(np.mean(marked)))


def _judge(weak: Weak, K: F64, common_prior: bool) -> tuple[float, float, float, bool, float]:
    """Return error %, std %, |z| and marking of the weak view, and the median error of the others."""
    result = _try(weak.matched, "per-image", weak.view, common_prior=common_prior)
    if result is None:
        return np.nan, np.nan, np.nan, True, np.nan
    scores, found = interval_scores(result, K), result.reconstruction.K
    assert found is not None
    errors = focal_errors_pct(found, K)
    width, view = scores.std_rel[weak.view], weak.view
    rest = float(np.nanmedian(np.delete(errors, view)))
    return float(errors[view]), 100.0 * float(width), abs(float(scores.z[view, 0])), named(result, view), rest


def named(result: MetricResult, view: int) -> bool:
    """Return whether the result marks the focal length of a view as uncertain.

    The view is not registered, a sentence names it, its value is shrunk, or its standard deviation is
    large.
    """
    if not result.reconstruction.registered[view]:
        return True
    sentence = re.compile(rf"#{view}\b")
    if any(sentence.search(said) for said in (*result.warnings, *result.failed_checks)):
        return True
    interval = result.intrinsics[view]["focal_px"]
    return interval.source.startswith("shrunk") or interval.std / interval.value >= WIDE_REL


COVERAGE = 0.92, 0.98
ZOOM = 0.3
COLUMNS = {"focal": (0,), "principal point": (1, 2)}


def run_trial(cameras: Cameras, number: int) -> tuple[IntervalScores, MetricResult] | None:
    """Solve one synthetic scene; None if calibration fails.

    With one camera per image the focal lengths vary by factors of up to e^0.3.
    """
    rng = np.random.default_rng([number, 5])
    scene = make_sequence(Motion.GENERAL, rng, zoom=0.0 if cameras == "shared" else ZOOM)
    return _solve_sequence(scene, cameras, number, rng)


def _solve_sequence(
    scene: SyntheticSequence,
    cameras: Cameras,
    number: int,
    rng: np.random.Generator,
    deferred: tuple[int, ...] = (),
) -> tuple[IntervalScores, MetricResult] | None:
    projective = projective_estimate(scene, rng)
    registered = ~np.isin(np.arange(len(scene.K)), deferred)
    projective = replace(
        projective,
        registered=registered,
        P=np.where(registered[:, None, None], projective.P, 0.0),
        inlier=projective.inlier & registered[scene.tracks.view_index],
    )
    config = PipelineConfig()
    config = replace(config, intrinsics=replace(config.intrinsics, cameras=cameras))
    prior = prior_for(projective, config.intrinsics)
    try:
        calibration = config.selfcalibration.calibrate(
            projective, prior=prior, rng=stream(number, "selfcalibration")
        )
        result = config.metric.refine(projective, calibration, prior=prior, rng=stream(number, "metric"))
    except StageFailure:
        return None
    return one_camera(interval_scores(result, scene.K), cameras), result


def run_weak_trial(number: int) -> tuple[IntervalScores, MetricResult] | None:
    """Solve one scene with a camera per image whose first image is weak.

    The first image keeps a window of 30 % of width and height, or in every other trial the points near a
    plane; it is not registered in the projective reconstruction.
    """
    rng = np.random.default_rng([number, 6])
    scene = make_sequence(Motion.GENERAL, rng, zoom=ZOOM)
    keep = _window_of_image(scene, rng) if number % 2 else _near_plane(scene)
    tracks = keep_observations(scene.tracks, keep | (scene.tracks.view_index != 0))
    return _solve_sequence(replace(scene, tracks=tracks), "per-image", number, rng, deferred=(0,))


def _window_of_image(scene: SyntheticSequence, rng: np.random.Generator) -> B8:
    xy, mine = scene.tracks.xy, np.flatnonzero(scene.tracks.view_index == 0)
    return np.asarray((np.abs(xy - xy[rng.choice(mine)]) <= 0.15 * scene.sizes[0]).all(axis=1))


def _near_plane(scene: SyntheticSequence) -> B8:
    return np.asarray(np.abs(scene.X[scene.tracks.point_index, 0]) < 0.1)


def check_weak_coverage(numbers: Iterable[int]) -> list[Metric]:
    """Measure error, interval and marking of the first image of these trials."""
    rows = Rows("synthetic, per-image, one image with little overlap", OURS)
    found = [part for part in map(run_weak_trial, numbers) if part is not None]
    z = np.array([abs(scores.z[0, 0]) for scores, _ in found])
    width = np.array([scores.std_rel[0] for scores, _ in found])
    marked = np.array([named(result, 0) for _, result in found])
    _add_weak(rows, "", 100.0 * z * width, z, marked, COVERAGE[0])
    return rows


def check_coverage(cameras: Cameras, numbers: Iterable[int]) -> list[Metric]:
    """Measure one mode over these trials; results that are not trusted do not count."""
    found = [run_trial(cameras, number) for number in numbers]
    trusted = [part for part in found if part is not None and part[1].trusted]
    rows = Rows(f"synthetic, {cameras}", OURS)
    rows.add(f"calibrated of {len(found)}", float(sum(part is not None for part in found)))
    rows.add(f"trusted of {len(found)}", float(len(trusted)))
    if not trusted:
        return rows
    scores = [part[0] for part in trusted]
    joined = join_scores(scores)
    for label, columns in COLUMNS.items():
        z, share = joined.z[:, columns], joined.holding(columns)
        name = f"95 % intervals of the {label} that hold the truth"
        rows.add(name, share, at_least=COVERAGE[0])
        rows.add(f"{name} (no wider than needed)", share, at_most=COVERAGE[1])
        rows.add(f"{name}, 95 % uncertainty of this share", LEVEL * holding_std(scores, columns))
        rows.add(f"error, {label}, rms in stated standard deviations", float(np.sqrt(np.nanmean(z**2))))
    rows.add("stated standard deviation of the focal, median, %", float(100 * np.nanmedian(joined.std_rel)))
    return rows


def calibration_coverage_study(trials: int = 200) -> Iterator[Part]:
    """Count 95 % intervals that contain the truth, on synthetic scenes that match the model."""
    numbers = range(trials)
    for cameras in MODES:
        yield check_coverage(cameras, numbers)
    yield check_weak_coverage(numbers)
