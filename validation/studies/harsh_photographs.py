"""Harsh sets of real matches: ``python -m validation.studies.harsh_photographs --runs RUNS [--trials N]``.

The tracks and verified pairs of real photographs as if fewer had been taken, or as if they had been cropped,
zoomed or stretched after they were taken: noise and wrong matches are real, focals known. What is told of the
cameras may be wrong. As in :mod:`validation.studies.harsh`, an answer that is trusted, whose focal is off by
more than 3 % and than its 95 % interval, is a lie.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig
from validation.studies.harsh import OURS, Trial, judge, line_of, print_head
from validation.studies.subsets import Matched, match_scene, solve, take_views
from validation.metrics.record import Metric, markdown_table
from validation.scenes.real import load_fixture_scene, load_real_scene

SCENES = ("courtyard", "fountain-P11", "Herz-Jesus-P8", "kermit")
Told = Literal["shared", "per-image"]


@dataclass(frozen=True)
class Made:
    """Affine maps of the pixels of each view, x -> scale (2,) * x + shift (2,), all (V, 2), and what is told
    of the cameras."""

    scale: F64
    shift: F64
    told: Told


def _maps(sizes: F64, factors: F64, crop: F64, told: Told) -> Made:
    """Zoomed about the middle by ``factors`` (V,) or (V, 2) and moved by ``crop`` (V, 2) widths and
    heights."""
    scale = np.ones((len(sizes), 2)) * np.reshape(factors, (len(sizes), -1))
    middle = (sizes - 1.0) / 2.0
    return Made(scale, middle - scale * middle + crop * sizes, told)


def apply_map(matched: Matched, made: Made) -> Matched:
    """The set with the pixels of its views moved; a focal is the geometric mean of both directions."""
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


def _own_crops(sizes: F64, rng: np.random.Generator, told: Told = "shared") -> Made:
    return _maps(sizes, np.ones(len(sizes)), rng.uniform(-0.1, 0.1, (len(sizes), 2)), told)


def _own_zooms(sizes: F64, rng: np.random.Generator) -> Made:
    factors = np.exp(rng.uniform(-0.3, 0.3, len(sizes)))
    return _maps(sizes, factors, rng.uniform(-0.1, 0.1, (len(sizes), 2)), "per-image")


def _stretched(sizes: F64, rng: np.random.Generator) -> Made:
    high = np.array([1.0, 1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(0.01, 0.05)])
    return _maps(sizes, np.tile(high, (len(sizes), 1)), np.zeros(2), "shared")


KINDS: Mapping[str, tuple[Callable[[F64, np.random.Generator], Made], tuple[int, int]]] = {
    "three or four, one camera": (_as_they_are, (3, 4)),
    "three or four, each its zoom and crop": (_own_zooms, (3, 4)),
    "two zooms by turns, one camera told": (_by_turns, (5, 8)),
    "one of another zoom, one camera told": (_one_other, (4, 8)),
    "cropped alike": (_cropped_alike, (4, 8)),
    "each cropped for itself, one camera told": (_own_crops, (4, 8)),
    "each zoomed and cropped for itself": (_own_zooms, (5, 8)),
    "stretched by 1 to 5 %": (_stretched, (5, 8)),
}
"""What is made, and of how many photographs."""


def run_trial(matched: Matched, kind: str, number: int) -> Trial:
    """One set from tracks to the self-check."""
    rng = np.random.default_rng([number, list(KINDS).index(kind), 8])
    make, (fewest, most) = KINDS[kind]
    count = int(rng.integers(fewest, min(most, matched.tracks.n_views) + 1))
    # Neighbours: few photographs with gaps between them do not hang together.
    first = int(rng.integers(0, matched.tracks.n_views - count + 1))
    views = np.arange(first, first + count)
    subset = take_views(matched, views, np.ones(matched.tracks.n_points, dtype=bool))
    made = make(subset.sizes.astype(np.float64), rng)
    config = PipelineConfig()
    config = replace(config, intrinsics=replace(config.intrinsics, cameras=made.told))
    harsh = apply_map(subset, made)
    result, failures, _ = solve(harsh, config, seed=number, first=0)
    return judge(number, result, failures, harsh)


def main(arguments: list[str] | None = None) -> int:
    """Print the table and every lie; 1 where there is one."""
    parser = argparse.ArgumentParser(
        prog="python -m validation.studies.harsh_photographs", description=__doc__
    )
    parser.add_argument("--runs", type=Path, required=True, help="folder that keeps the reconstructions")
    parser.add_argument("--trials", type=int, default=5, help="of each kind and set")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    wishes = parser.parse_args(arguments)
    scenes = [load_fixture_scene(n) if n == "courtyard" else load_real_scene(n) for n in wishes.scenes]
    sets = [match_scene(scene, wishes.runs, threads=1) for scene in scenes if scene is not None]
    print_head()
    lies: list[str] = []
    total = 0
    for kind in KINDS:
        trials = [(m.name, run_trial(m, kind, n)) for m in sets for n in range(wishes.trials)]
        print(line_of(kind, [trial for _, trial in trials]), flush=True)
        total += sum(trial.said == "trusted" for _, trial in trials)
        lies += [f"{kind}, {name}, {trial}" for name, trial in trials if trial.is_lie]
    print("", *lies, sep="\n")
    rows = [Metric(f"{total} trusted", "trusted, off and not said", "", {OURS: float(len(lies))}, OURS, 0.0)]
    print("", markdown_table(rows), sep="\n")
    return int(bool(lies))


if __name__ == "__main__":
    raise SystemExit(main())
