"""Steps of Algorithm 1 that take corners, matches or tracks that other programs found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig
from thesisrecon.pipeline._image_pair import verify_matches
from thesisrecon.pipeline._stages import finish_matches, finish_tracks, require_accepted_pair
from thesisrecon.pipeline._state import PipelineState
from thesisrecon.records import Features, Matches, PairChoice, Tracks, TwoView
from thesisrecon.runtime._run import Batch, stream


@dataclass(frozen=True)
class Given:
    """Corners (N_i, 2) of V views in working pixels, their matches, and tracks unless they are built."""

    corners: Sequence[F64]
    matches: Sequence[Matches]
    tracks: Tracks | None = None


def take_corners(given: Given, state: PipelineState) -> None:
    """Set ``result.features`` to the given corners."""
    run, found = state.run, list[Features]()
    for i, xy in enumerate(given.corners):
        ones = np.ones(len(xy), dtype=np.float32)
        key = run.key("features", "given", xy)
        found.append(run.cached("features", f"{i:05d}", key, partial(Features, xy, ones, ones)))
    counts = [len(xy) for xy in given.corners]
    report = {"images": len(counts), "corners": sum(counts), "fewest_in_one_image": min(counts)}
    run.finish("features", counts=report)
    # Tracks are built from the corners alone.
    state.prepared = [SimpleNamespace(features=features) for features in found]
    state.result = replace(state.result, features=tuple(found))


def take_pairs(given: Given, state: PipelineState) -> None:
    """Set ``result.pair_choice`` to the pairs with given matches."""
    run, views = state.run, len(given.corners)
    pairs = np.array([(m.i, m.j) for m in given.matches], dtype=np.int64).reshape(-1, 2)
    choice = run.cached(
        "pairs",
        "choice",
        run.key("pairs", "given", pairs),
        partial(PairChoice, pairs, "the pairs with matches"),
    )
    state.result = replace(state.result, pair_choice=choice)
    run.finish("pairs", counts={"possible": views * (views - 1) // 2, "compared": 0, "chosen": len(pairs)})


def verify_pairs(given: Given, state: PipelineState) -> None:
    """Estimate and verify the epipolar geometry of the given matches (chapter 5); sets ``result.pairs``."""
    run, matches = state.run, given.matches
    variants = [run.variant_key(stage) for stage in ("epipolar", "verification")]
    keys = {
        f"{m.i:05d}-{m.j:05d}": run.key(
            "matches", "given", variants, m.xy1, m.xy2, m.index1, m.index2, run.seed
        )
        for m in matches
    }

    def batches(missing: Sequence[int]) -> Iterator[Batch]:
        return (([n], (state.config, matches[n], run.seed)) for n in missing)

    finish_matches(state, run.map_cached("matches", keys, _verify, batches))


def _verify(config: PipelineConfig, matches: Matches, seed: int) -> list[TwoView]:
    return [verify_matches(config, matches, stream(seed, "matches", matches.i, matches.j))]


def take_tracks(given: Given, state: PipelineState) -> None:
    """Set ``result.tracks`` to the given tracks."""
    require_accepted_pair(state)
    tracks, run = given.tracks, state.run
    assert tracks is not None
    key = run.key("tracks", "given", tracks.view_index, tracks.point_index, tracks.xy)
    finish_tracks(state, run.cached("tracks", "tracks", key, lambda: tracks))
