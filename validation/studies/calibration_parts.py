"""Self-calibration of parts of a real set that was matched once: random subsets of its photographs, and the
set with one photograph of which little is left, so that its matches do not determine its focal length."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.config import PipelineConfig
from thesisrecon.records import MetricResult, Reconstruction, RunResult, Tracks
from validation.metrics.cameras import TrueCameras
from validation.metrics.intervals import (
    LEVEL,
    IntervalScores,
    focal_errors_pct,
    interval_scores,
    join_scores,
)
from validation.metrics.record import Metric
from validation.studies.reconstruction import OURS
from validation.studies.subsets import Matched, solve, take_views

Cameras = Literal["shared", "per-image"]
MODES: tuple[Cameras, ...] = ("shared", "per-image")
SUBSETS = 20
SUBSET_SIZES = (5, 8)
SUCCESS_PCT = 3.0
KEPT_TRACKS = 0.7
LEAST_HOLDING = 0.92
WINDOW_SHARE = 0.35
PLANE_SHARE = 0.004
"""A point this share of its depth off a plane is on it."""
WIDE_REL = 0.02
"""A stated sigma from which on a focal length says of itself that it is hardly known."""


def check_parts(name: str, run: RunResult | None, truth: TrueCameras) -> list[list[Metric]]:
    """The tables of both studies; none where the run of the whole set failed."""
    if run is None or run.metric is None or run.tracks is None:
        return []
    sizes = np.array([image.size for image in run.images], dtype=np.int64)
    matched = Matched(name, run.tracks, run.pairs, sizes, truth.K[:, 0, 0])
    tables = [check_subsets(f"{name}, subsets, {cameras}", matched, truth.K, cameras) for cameras in MODES]
    weak = list(weak_views(matched, run.metric.reconstruction))
    for alike in (True, False):
        title = f"{name}, per-image, one weak photograph, {'alike' if alike else 'nothing prior alike'}"
        tables.append(check_weak(title, weak, truth.K, alike=alike))
    return tables


# ---------------------------------------------------------------- random subsets


def check_subsets(title: str, matched: Matched, K: F64, cameras: Cameras) -> list[Metric]:
    """What the intervals hold for random subsets of the photographs with random points; how often subsets
    succeed is measured by :mod:`validation.studies.subsets`."""
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
    rows = OwnRows(title)
    rows.add(f"trusted of {SUBSETS}", float(len(scores)))
    if not scores:
        return rows.metrics
    held = join_scores(scores)
    rows.add("focal error of the worst camera, median over subsets, %", float(np.median(errors)))
    rows.add("focal error of the worst camera of all, %", float(np.max(errors)))
    for what, columns in (("focal", (0,)), ("principal point", (1, 2))):
        share = held.holding(columns)
        rows.add(f"95 % intervals of the {what} that hold the truth", share, LEAST_HOLDING, at_most=False)
        rows.add(f"largest deviation, {what}, stated sigmas", held.worst(columns))
    rows.add("stated sigma of the focal, median, %", float(100.0 * np.nanmedian(held.std_rel)))
    return rows.metrics


class OwnRows:
    """The rows of one table of ours alone."""

    def __init__(self, title: str) -> None:
        self.title, self.metrics = title, list[Metric]()

    def add(self, name: str, value: float, target: float | None = None, *, at_most: bool = True) -> None:
        """One row."""
        self.metrics.append(Metric(self.title, name, "", {OURS: value}, OURS, target, at_most=at_most))


def draw_subset(matched: Matched, rng: np.random.Generator) -> tuple[Matched, I64]:
    """5 to 8 of the photographs with a part of the points, and which photographs these are."""
    low, high = SUBSET_SIZES
    n = matched.tracks.n_views
    size = int(rng.integers(low, min(high, n - 1) + 1))
    views = np.sort(rng.choice(n, size, replace=False)).astype(np.int64)
    return take_views(matched, views, rng.random(matched.tracks.n_points) < KEPT_TRACKS), views


def one_camera(scores: IntervalScores, cameras: Cameras) -> IntervalScores:
    """A value that all views share is one value, not as many as there are views."""
    if cameras == "per-image":
        return scores
    first = int(np.flatnonzero(np.isfinite(scores.std_rel))[0])
    return IntervalScores(scores.z[first : first + 1], scores.std_rel[first : first + 1])


def _try(matched: Matched, cameras: Cameras, seed: int, *, alike: bool = True) -> MetricResult | None:
    wish = replace(PipelineConfig().intrinsics, cameras=cameras, common_prior=alike)
    result, failures, _ = solve(matched, PipelineConfig(intrinsics=wish), seed=seed, first=0)
    if result is None:
        print(f"{matched.name}, seed {seed}: {failures[0]}", flush=True)
    return result


# ---------------------------------------------------------------- one photograph that hardly overlaps


@dataclass(frozen=True)
class Weak:
    """A set of which one ``view`` keeps few observations, chosen as ``kind`` says."""

    matched: Matched
    view: int
    kind: str


def weak_views(matched: Matched, model: Reconstruction) -> Iterator[Weak]:
    """Every photograph in turn, with only a small window of it left, and with only what lies in one plane."""
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
    """The set without these ``observations`` (K,), all of one ``view``, and without its pairs, whose matches
    are no longer what they were."""
    tracks = keep_observations(matched.tracks, ~observations)
    return replace(matched, tracks=tracks, pairs=[p for p in matched.pairs if view not in (p.i, p.j)])


def keep_observations(tracks: Tracks, kept: B8) -> Tracks:
    """The ``kept`` (K,) observations of the points that still have two of them."""
    t = tracks
    kept = kept & (np.bincount(t.point_index[kept], minlength=t.n_points)[t.point_index] >= 2)
    return Tracks(t.view_index[kept], t.point_index[kept], t.xy[kept], t.n_views, t.n_points)


def _in_window(matched: Matched, _: Reconstruction, mine: np.ndarray, rng: np.random.Generator) -> B8:
    xy = matched.tracks.xy[mine]
    half = 0.5 * WINDOW_SHARE * matched.sizes[matched.tracks.view_index[mine[0]]]
    return np.asarray((np.abs(xy - xy[rng.integers(len(xy))]) <= half).all(axis=1))


def _in_plane(matched: Matched, model: Reconstruction, mine: np.ndarray, rng: np.random.Generator) -> B8:
    """The points of the plane that holds most of them."""
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


def check_weak(title: str, sets: Sequence[Weak], K: F64, *, alike: bool) -> list[Metric]:
    """What becomes of the weak photograph: its error, its interval, and whether it is named."""
    rows = OwnRows(title)
    for kind in KINDS:
        found = [_judge(weak, K, alike) for weak in sets if weak.kind == kind]
        error, width, z, named, others = (np.array(part) for part in zip(*found, strict=True))
        there = np.isfinite(error)
        unnamed = there & (error > SUCCESS_PCT) & ~named.astype(bool)
        rows.add(f"{kind}: registered of {len(found)}", float(there.sum()))
        rows.add(f"{kind}: focal error, median, %", float(np.nanmedian(error)))
        rows.add(f"{kind}: focal error, worst, %", float(np.nanmax(error)))
        rows.add(f"{kind}: stated sigma, median, %", float(np.nanmedian(width)))
        held = float((z[there] <= LEVEL).mean())
        rows.add(f"{kind}: 95 % intervals that hold the truth", held, LEAST_HOLDING, at_most=False)
        rows.add(f"{kind}: largest deviation, stated sigmas", float(np.nanmax(z)))
        rows.add(f"{kind}: off by more than {SUCCESS_PCT:.0f} % and not named", float(unnamed.sum()), 0.0)
        rows.add(f"{kind}: named", float(named.mean()))
        rows.add(f"{kind}: focal error of the other photographs, median, %", float(np.nanmedian(others)))
    return rows.metrics


def _judge(weak: Weak, K: F64, alike: bool) -> tuple[float, float, float, bool, float]:
    """Of the weak view: focal error %, stated sigma %, |z|, whether it is named; the others' median error."""
    result = _try(weak.matched, "per-image", weak.view, alike=alike)
    if result is None:
        return np.nan, np.nan, np.nan, True, np.nan
    scores, found = interval_scores(result, K), result.reconstruction.K
    assert found is not None
    errors = focal_errors_pct(found, K)
    width, view = scores.std_rel[weak.view], weak.view
    rest = float(np.nanmedian(np.delete(errors, view)))
    return float(errors[view]), 100.0 * float(width), abs(float(scores.z[view, 0])), named(result, view), rest


def named(result: MetricResult, view: int) -> bool:
    """Whether the result says of a view that its own matches hardly determine its focal length: it is not
    registered, a sentence names it, its value is said to be borrowed, or its stated sigma is wide."""
    if not result.reconstruction.registered[view]:
        return True
    sentence = re.compile(rf"\bviews?\b[^;:]*\b{view}\b")
    if any(sentence.search(said) for said in (*result.warnings, *result.failed_checks)):
        return True
    interval = result.intrinsics[view]["focal_px"]
    return interval.source.startswith("borrowed") or interval.std / interval.value >= WIDE_REL
