"""Harsh image sets: trusted answers whose focal length is wrong and outside its interval.

``harsh``: random sets (:mod:`validation.scenes.harsh`) with noisy tracks and verified pairs become metric
cameras as in the pipeline. A trusted focal length that errs by more than 3 % and by more than its 95 %
interval is a silent error.
``harsh-images``: tracks and verified pairs of real images, as if fewer had been taken or as if they had been
cropped, zoomed or stretched. Noise and wrong matches are real, focal lengths are known, the assumed camera
mode may be wrong.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig
from thesisrecon.records import MetricResult, Tracks, TwoView
from validation.scenes.dinosaur import pairs_from_tracks
from validation.scenes.harsh import KINDS
from validation.studies.runner import Part, Rows, scenes_here, text_table
from validation.studies.subsets import Matched, match_scene, solve, take_views

OURS = "ours"
OFF = 0.03
LEVEL = 1.96


@dataclass(frozen=True)
class Trial:
    """One set and its outcome.

    Attributes
    ----------
    said : str
        "refused", "doubted" or "trusted".
    worst, median : float
        Relative focal errors of the registered cameras.
    quiet : int
        Cameras that err by more than 3 % and by more than their 95 % intervals.
    failed_checks : tuple of str
        Failed checks, or the refusal.
    """

    number: int
    said: str
    registered: int
    worst: float
    median: float
    quiet: int
    failed_checks: tuple[str, ...]

    @property
    def is_silent_error(self) -> bool:
        """Whether the answer is trusted, wrong, and has an interval that does not show it."""
        return self.said == "trusted" and self.quiet > 0


def run_trial(kind: str, number: int) -> Trial:
    """Go from tracks to the self-check on one synthetic set."""
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
    """Compare the result of a set with its true focal lengths."""
    if result is None:
        return Trial(number, "refused", 0, np.nan, np.nan, 0, tuple(failures[-1:]))
    error, stated = focal_errors(result, matched)
    quiet = int(((error > OFF) & (error > stated)).sum())
    said = "trusted" if result.trusted else "doubted"
    worst, median = float(error.max()), float(np.median(error))
    return Trial(number, said, len(error), worst, median, quiet, tuple(result.failed_checks))


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


SCENES = ("courtyard", "fountain-P11", "Herz-Jesus-P8", "kermit")
CameraMode = Literal["shared", "per-image"]


@dataclass(frozen=True)
class Made:
    """Affine maps x -> scale x + shift of the pixels of each view, (V, 2), and the assumed camera mode."""

    scale: F64
    shift: F64
    cameras: CameraMode


def _maps(sizes: F64, factors: F64, crop: F64, cameras: CameraMode) -> Made:
    """Zoom about the middle by ``factors`` (V,) or (V, 2) and shift by ``crop`` (V, 2) image sizes."""
    scale = np.ones((len(sizes), 2)) * np.reshape(factors, (len(sizes), -1))
    middle = (sizes - 1.0) / 2.0
    return Made(scale, middle - scale * middle + crop * sizes, cameras)


def apply_map(matched: Matched, made: Made) -> Matched:
    """Move the pixels of all views; a focal length is the geometric mean of both directions."""
    t = matched.tracks
    T = np.zeros((len(made.scale), 3, 3))
    T[:, 0, 0], T[:, 1, 1], T[:, 2, 2] = made.scale[:, 0], made.scale[:, 1], 1.0
    T[:, :2, 2] = made.shift
    back = np.linalg.inv(T)
    pairs = []
    for pair in matched.pairs:
        F = back[pair.j].T @ pair.F @ back[pair.i]
        xy1 = made.scale[pair.i] * pair.xy1 + made.shift[pair.i]
        xy2 = made.scale[pair.j] * pair.xy2 + made.shift[pair.j]
        pairs.append(replace(pair, F=F / np.linalg.norm(F), xy1=xy1, xy2=xy2))
    xy = made.scale[t.view_index] * t.xy + made.shift[t.view_index]
    focal = matched.focal_px * np.sqrt(made.scale.prod(axis=1))
    return replace(matched, tracks=replace(t, xy=xy), pairs=pairs, focal_px=focal)


def _as_they_are(sizes: F64, rng: np.random.Generator) -> Made:  # noqa: ARG001 - one signature for all kinds
    return _maps(sizes, np.ones(len(sizes)), np.zeros(2), "shared")


def _by_turns(sizes: F64, rng: np.random.Generator) -> Made:
    factors = np.where(np.arange(len(sizes)) % 2 == 0, 1.0, rng.uniform(1.04, 1.5))
    return _maps(sizes, factors, np.zeros(2), "shared")


def _one_other(sizes: F64, rng: np.random.Generator) -> Made:
    factors = np.ones(len(sizes))
    factors[rng.integers(len(sizes))] = rng.uniform(1.05, 1.4)
    return _maps(sizes, factors, np.zeros(2), "shared")


def _cropped_alike(sizes: F64, rng: np.random.Generator) -> Made:
    return _maps(sizes, np.ones(len(sizes)), rng.uniform(-0.12, 0.12, 2), "shared")


def _own_crops(sizes: F64, rng: np.random.Generator, cameras: CameraMode = "shared") -> Made:
    return _maps(sizes, np.ones(len(sizes)), rng.uniform(-0.1, 0.1, (len(sizes), 2)), cameras)


def _own_zooms(sizes: F64, rng: np.random.Generator) -> Made:
    factors = np.exp(rng.uniform(-0.3, 0.3, len(sizes)))
    return _maps(sizes, factors, rng.uniform(-0.1, 0.1, (len(sizes), 2)), "per-image")


def _stretched(sizes: F64, rng: np.random.Generator) -> Made:
    high = np.array([1.0, 1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(0.01, 0.05)])
    return _maps(sizes, np.tile(high, (len(sizes), 1)), np.zeros(2), "shared")


MAKERS: Mapping[str, tuple[Callable[[F64, np.random.Generator], Made], tuple[int, int]]] = {
    "three or four, one camera": (_as_they_are, (3, 4)),
    "three or four, each its zoom and crop": (_own_zooms, (3, 4)),
    "two zooms by turns, one camera assumed": (_by_turns, (5, 8)),
    "one of another zoom, one camera assumed": (_one_other, (4, 8)),
    "cropped alike": (_cropped_alike, (4, 8)),
    "each cropped for itself, one camera assumed": (_own_crops, (4, 8)),
    "each zoomed and cropped for itself": (_own_zooms, (5, 8)),
    "stretched by 1 to 5 %": (_stretched, (5, 8)),
}
"""Name -> how the images are changed, and the fewest and most images."""


def run_image_trial(matched: Matched, kind: str, number: int) -> Trial:
    """Go from the tracks of one modified subset to the self-check."""
    rng = np.random.default_rng([number, list(MAKERS).index(kind), 8])
    make, (fewest, most) = MAKERS[kind]
    count = int(rng.integers(fewest, min(most, matched.tracks.n_views) + 1))
    # Neighbours, because few images with gaps have no common points.
    first = int(rng.integers(0, matched.tracks.n_views - count + 1))
    views = np.arange(first, first + count)
    subset = take_views(matched, views, np.ones(matched.tracks.n_points, dtype=bool))
    made = make(subset.sizes.astype(np.float64), rng)
    config = PipelineConfig()
    config = replace(config, intrinsics=replace(config.intrinsics, cameras=made.cameras))
    harsh = apply_map(subset, made)
    result, failures, _ = solve(harsh, config, seed=number, first=0)
    return judge(number, result, failures, harsh)


def table_row(kind: str, trials: Sequence[Trial]) -> list[object]:
    """Return one row of the table."""
    count = Counter(t.said for t in trials)
    trusted, doubted = ([t for t in trials if t.said == said] for said in ("trusted", "doubted"))
    median = f"{100.0 * float(np.median([t.worst for t in trusted])):.2f}" if trusted else "-"
    good, off = sum(t.worst <= OFF for t in doubted), sum(t.worst > OFF for t in trusted)
    quiet = sum(t.quiet > 0 for t in trusted)
    return [kind, count["refused"], count["doubted"], good, count["trusted"], median, off, quiet]


def _report(found: Iterable[tuple[str, Sequence[Trial]]]) -> Iterator[Part]:
    """Give the table of all kinds and the number of silent errors."""
    lines, silent, total = [], [], 0
    for kind, trials in found:
        lines.append(table_row(kind, trials))
        total += sum(t.said == "trusted" for t in trials)
        silent += [f"{kind}: {t}" for t in trials if t.is_silent_error]
        print(kind, "done", file=sys.stderr, flush=True)
    yield text_table(HEAD, lines)
    yield "\n".join(silent)
    rows = Rows(f"{total} trusted", OURS)
    rows.add("trusted, wrong, outside its interval", len(silent), at_most=0.0)
    yield rows


HEAD = ["set", "refused", "doubted", "doubted though within 3 %", "trusted", "their worst focal, median, %"]
HEAD += ["off by more than 3 %", "and by more than the interval"]


def harsh_study(trials: int = 20, workers: int = 1, kinds: Sequence[str] | None = None) -> Iterator[Part]:
    """Look for trusted answers with a wrong focal length outside its interval, on harsh synthetic sets.

    Parameters
    ----------
    kinds : sequence of str
        Words; kinds of sets that contain one of them are taken.
    """
    chosen = [k for k in KINDS if kinds is None or any(word in k for word in kinds)]
    with ProcessPoolExecutor(workers) as pool:
        yield from _report((k, list(pool.map(partial(run_trial, k), range(trials)))) for k in chosen)


def harsh_images_study(out: Path, trials: int = 5, scenes: Sequence[str] = SCENES) -> Iterator[Part]:
    """Look for the same errors on real matches of images that are cropped, zoomed or stretched."""
    sets = [match_scene(scene, out, threads=1) for scene in scenes_here(scenes)]
    if sets:
        yield from _report(
            (k, [run_image_trial(m, k, n) for m in sets for n in range(trials)]) for k in MAKERS
        )
