"""Features, matches, epipolar geometry and tracks: 4.2.1, 4.2.2 and chapter 5."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure, counted
from thesisrecon.pipeline._state import PipelineState, PreparedViews, batch_pairs
from thesisrecon.pipeline.image_pair import match_views
from thesisrecon.records import Features, Image, PairChoice, TwoView
from thesisrecon.runtime._run import Batch, stream

MIN_CORNERS = 16

# ---------------------------------------------------------------- 4.2.1: features


def find_features(state: PipelineState) -> None:
    """Detect the features of all images (4.2.1); sets ``result.features``."""
    run, images = state.run, state.result.images
    variant = run.variant_key("features")
    digests = enumerate(image.digest for image in state.inputs.decoded)
    keys = {f"{i:05d}": run.key("features", variant, digest) for i, digest in digests}

    def batches(missing: Sequence[int]) -> Iterator[Batch]:
        return (([i], (state.config, images[i])) for i in missing)

    features = run.map_cached("features", keys, _detect, batches)
    state.result = replace(state.result, features=tuple(features))
    found = [len(f.xy) for f in features]
    few = [(image, n) for image, n in zip(images, found, strict=True) if n < MIN_CORNERS]
    poor = [f"{image.name} has only {counted(n, 'corner')}" for image, n in few]
    counts = {"images": len(images), "corners": sum(found), "fewest_in_one_image": min(found)}
    run.finish("features", counts=counts, warnings=poor)


def _detect(config: PipelineConfig, image: Image) -> list[Features]:
    return [config.features.detect(image)]


# ---------------------------------------------------------------- 4.2.2 and chapter 5: pairs of views


def select_pairs(state: PipelineState) -> None:
    """Select the pairs of images to match; sets ``result.pair_choice``."""
    run, images, features = state.run, state.result.images, state.result.features
    names = [image.name for image in images]
    key = run.key("pairs", run.variant_key("pairs"), names, run.logs["features"].keys, run.seed)
    run.progress("pairs", 0, 1)
    select, map_all, rng = state.config.pairs.select, run.workers.map_all, stream(run.seed, "pairs")
    choice: PairChoice = run.cached(
        "pairs", "choice", key, lambda: select(names, features, map_all=map_all, rng=rng)
    )
    state.result = replace(state.result, pair_choice=choice)
    possible = len(images) * (len(images) - 1) // 2
    run.finish(
        "pairs", counts={"possible": possible, "compared": choice.compared, "chosen": len(choice.pairs)}
    )
    run.progress("pairs", 1, 1)


def match_pairs(state: PipelineState) -> None:
    """Match the pairs and estimate their epipolar geometry (4.2.2, chapter 5); sets ``result.pairs``."""
    run, result = state.run, state.result
    assert result.pair_choice is not None
    pairs = [(int(i), int(j)) for i, j in result.pair_choice.pairs]
    variants = [run.variant_key(stage) for stage in ("matching", "epipolar", "verification")]
    features = list(run.logs["features"].keys.values())
    inputs = {(i, j): (features[i], features[j], run.seed, i, j) for i, j in pairs}
    keys = {f"{i:05d}-{j:05d}": run.key("matches", variants, *inputs[i, j]) for i, j in pairs}

    def batches(missing: Sequence[int]) -> Iterator[Batch]:
        views, shared = _prepared(state), run.workers.in_process
        for numbers in batch_pairs(pairs, missing, None if shared else run.workers.parallel()):
            some = [pairs[n] for n in numbers]
            given = views if shared else views.subset({view for pair in some for view in pair})
            yield numbers, (state.config, given, some, run.seed)

    two_views: list[TwoView] = run.map_cached("matches", keys, _match_all, batches)
    state.result = replace(result, pairs=tuple(two_views))
    accepted = [pair for pair in two_views if pair.accepted]
    counts = {"pairs": len(pairs), "accepted": len(accepted), "verified": sum(p.inliers for p in accepted)}
    counts["undetermined"] = sum(pair.undetermined for pair in accepted)
    metrics = {"median_sigma_px": float(np.median([p.sigma_px for p in accepted]))} if accepted else {}
    run.finish("matches", counts=counts, metrics=metrics, warnings=_degenerate_pairs(accepted))


def _degenerate_pairs(accepted: Sequence[TwoView]) -> list[str]:
    """A warning if the epipolar geometry of most pairs is degenerate."""
    undetermined = [pair for pair in accepted if pair.undetermined]
    if 2 * len(undetermined) <= len(accepted):
        return []
    kinds = Counter(pair.configuration for pair in undetermined)
    listed = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    of_all = f"{len(undetermined)} of {len(accepted)} accepted pairs"
    return [f"The epipolar geometry of {of_all} is degenerate ({listed})"]


def _prepared(state: PipelineState) -> PreparedViews:
    """Prepared views, made only if a pair must be computed."""
    if state.prepared is None:
        given = zip(state.result.images, state.result.features, strict=True)
        state.prepared = PreparedViews(state.config.matching, dict(enumerate(given)))
    return state.prepared


def _match_all(
    config: PipelineConfig, views: Sequence[Any], pairs: Sequence[tuple[int, int]], seed: int
) -> list[TwoView]:
    return [match_views(config, views[i], views[j], (i, j), seed) for i, j in pairs]


def build_tracks(state: PipelineState) -> None:
    """Build tracks from the accepted pairs; sets ``result.tracks``."""
    run, result = state.run, state.result
    accepted = [pair for pair in result.pairs if pair.accepted]
    if not accepted:
        best = max(result.pairs, key=lambda pair: pair.inliers)
        tried, verified = counted(len(result.pairs), "pair"), counted(best.inliers, "verified match")
        evidence = f"the best of {tried} has {verified}: {best.reason}"
        advice = "add images with more overlap, all of one textured scene"
        raise StageFailure("no two images could be matched", evidence, advice)
    key = run.key("tracks", run.variant_key("tracks"), run.logs["matches"].keys, run.seed)
    build, rng = state.config.tracks.build, stream(run.seed, "tracks")
    tracks = run.cached("tracks", "tracks", key, lambda: build(_prepared(state), result.pairs, rng))
    state.result = replace(result, tracks=tracks)
    seen = np.bincount(tracks.point_index, minlength=tracks.n_points)
    counts = {"points": tracks.n_points, "observations": len(tracks.xy)}
    run.finish("tracks", counts=counts | {"seen_3_times": int((seen >= 3).sum())})
