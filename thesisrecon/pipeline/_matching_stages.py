"""The first steps of Algorithm 1: features, pairs and matches (chapters 4 and 5), and groups of images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from thesisrecon.arrays import rows_of_views
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import Notice, counted
from thesisrecon.matching._prepared import strongest_corners, strongest_share
from thesisrecon.matching._repeated_structure import reject_repeated_structure
from thesisrecon.matching.growth import SeedsAndGrowth
from thesisrecon.matching.pair_selection import connected_groups, pairs_to_connect
from thesisrecon.matching.tracks import tracks_of_corners
from thesisrecon.pipeline._image_pair import detect_features, match_views, oblique_pairs, prepare_oblique
from thesisrecon.pipeline._parts import has_narrow_cut
from thesisrecon.pipeline._state import PipelineState, PreparedViews, batch_pairs
from thesisrecon.records import Features, Image, PairChoice, TwoView
from thesisrecon.runtime._run import Batch, stream

FEWER, FINAL = "-fewer", "final"
"""Suffix of the records of pairs matched with part of the corners, and name of the record of final pairs."""
MIN_CORNERS = 16
MIN_VERIFIED = 240
"""Number of verified matches from part of the corners above which a pair is not matched again with all."""
MIN_GROUP = 3
"""Minimum number of images of a group that is reconstructed separately."""


def find_features(state: PipelineState) -> None:
    """Detect the features of all images (4.2.1); sets ``result.features``."""
    run, images = state.run, state.result.images
    variant = run.variant_key("features")
    digests = enumerate(image.digest for image in state.inputs.decoded)
    keys = {f"{i:05d}": run.key("features", variant, digest) for i, digest in digests}

    def batches(missing: Sequence[int]) -> Iterator[Batch]:
        return (([i], (state.config, images[i])) for i in missing)

    finish_features(state, run.map_cached("features", keys, _detect, batches))


def finish_features(state: PipelineState, features: Sequence[Features]) -> None:
    """Report the features; sets ``result.features``."""
    images = state.result.images
    state.result = replace(state.result, features=tuple(features))
    found = [len(f.xy) for f in features]
    few = [(image, n) for image, n in zip(images, found, strict=True) if n < MIN_CORNERS]
    poor = [Notice("few-corners", image.name, counted(n, "corner")) for image, n in few]
    counts = {"images": len(images), "corners": sum(found), "fewest_in_one_image": min(found)}
    state.run.finish("features", counts=counts, warnings=poor)


def _detect(config: PipelineConfig, image: Image) -> list[Features]:
    return [detect_features(config, image)]


def select_pairs(state: PipelineState) -> None:
    """Select the pairs of images to match; sets ``result.pair_choice``."""
    run, images, features = state.run, state.result.images, state.result.features
    names = [image.name for image in images]
    key = run.key("pairs", run.variant_key("pairs"), names, run.logs["features"].keys, run.seed)
    run.progress("pairs", 0, 1)
    select, map_all, rng = state.config.pairs.select, run.workers.map_all, stream(run.seed, "pairs")
    compute = partial(select, names, features, map_all=map_all, rng=rng)
    choice: PairChoice = run.cached("pairs", "choice", key, compute)
    state.result = replace(state.result, pair_choice=choice)
    possible = len(images) * (len(images) - 1) // 2
    counts = {"possible": possible, "compared": choice.compared, "chosen": len(choice.pairs)}
    run.finish("pairs", counts=counts)
    run.progress("pairs", 1, 1)


def match_pairs(state: PipelineState) -> None:
    """Match the pairs and estimate their epipolar geometry (4.2.2, chapter 5); sets ``result.pairs``."""
    assert state.result.pair_choice is not None
    pairs = [(int(i), int(j)) for i, j in state.result.pair_choice.pairs]
    found, kinds = _matched_in_turn(state, pairs)
    again = pairs_to_connect(state.result.features, found, oblique_pairs(state.config))
    if again:
        second = _matched(state, [pairs[n] for n in again], "-oblique", lambda: _prepared_oblique(state))
        for n, pair in zip(again, second, strict=True):
            if pair.accepted:
                found[n], kinds[n] = pair, "-oblique"
    final = reject_repeated_structure(found, len(state.result.images))
    rejected = {n: pair.reason for n, pair in enumerate(final) if pair is not found[n]}
    finish_matches(state, final, kinds, rejected)


def _matched_in_turn(
    state: PipelineState, pairs: Sequence[tuple[int, int]]
) -> tuple[list[TwoView], list[str]]:
    """Match pairs; in large sets first with part of the corners, then with all where this is not enough.

    It is not enough for weak pairs, and for all pairs of a long sequence, where errors accumulate. Returns
    the pairs, and the kind of record of each.
    """
    features, matching = state.result.features, state.config.matching
    if not isinstance(matching, SeedsAndGrowth) or len(features) <= matching.many_images:
        return _matched(state, pairs, "", state.prepared_views), [""] * len(pairs)
    prepare = partial(_prepare_share, matching)
    found = _matched(state, pairs, FEWER, lambda: PreparedViews(prepare, state.given()))
    found, kinds = _of_all_corners(found, features, matching.many_share), [FEWER] * len(pairs)
    kept = reject_repeated_structure(found, len(features))
    long = has_narrow_cut(tracks_of_corners([found.xy for found in features], kept))
    again = [n for n, pair in enumerate(found) if long or not pair.accepted or pair.inliers < MIN_VERIFIED]
    second = _matched(state, [pairs[n] for n in again], "", state.prepared_views)
    for n, pair in zip(again, second, strict=True):
        if pair.accepted or not found[n].accepted:
            found[n], kinds[n] = pair, ""
    return found, kinds


def _of_all_corners(pairs: Sequence[TwoView], features: Sequence[Features], share: float) -> list[TwoView]:
    """Pairs matched with part of the corners, with indices into all corners."""
    rows = [strongest_corners(f, share) for f in features]
    return [replace(p, index1=rows[p.i][p.index1], index2=rows[p.j][p.index2]) for p in pairs]


def _prepare_share(matching: SeedsAndGrowth, image: Image, features: Features) -> Any:
    return matching.prepare(image, strongest_share(features, matching.many_share))


def _matched(
    state: PipelineState, pairs: Sequence[tuple[int, int]], kind: str, prepared: Callable[[], Sequence[Any]]
) -> list[TwoView]:
    """Match pairs of prepared views; ``kind`` names another way of preparation."""
    run = state.run
    variants = [run.variant_key(stage) for stage in ("matching", "epipolar", "verification")]
    features = list(run.logs["features"].keys.values())
    inputs = {(i, j): (features[i], features[j], run.seed, i, j, *([kind] if kind else [])) for i, j in pairs}
    keys = {_item(i, j, kind): run.key("matches", variants, *inputs[i, j]) for i, j in pairs}

    def batches(missing: Sequence[int]) -> Iterator[Batch]:
        views, shared = prepared(), run.workers.in_process
        assert isinstance(views, PreparedViews)
        corners = [len(f.xy) for f in state.result.features]
        for numbers in batch_pairs(pairs, missing, None if shared else run.workers.parallel(), corners):
            some = [pairs[n] for n in numbers]
            given = views if shared else views.subset({view for pair in some for view in pair})
            yield numbers, (state.config, given, some, run.seed)

    return list(run.map_cached("matches", keys, _match_all, batches))


def finish_matches(
    state: PipelineState,
    two_views: Sequence[TwoView],
    kinds: Sequence[str] | None = None,
    rejected: Mapping[int, str] | None = None,
) -> None:
    """Report the matched pairs; sets ``result.pairs``.

    If the final pairs are not exactly the stored records, another record lists the final ones with their
    ``kinds``, and the reasons of those that are ``rejected`` (by number) because of other pairs.
    """
    run, rejected, kinds = state.run, rejected or {}, kinds or [""] * len(two_views)
    state.result = replace(state.result, pairs=tuple(two_views))
    items = [_item(pair.i, pair.j, kind) for pair, kind in zip(two_views, kinds, strict=True)]
    if rejected or any(kinds) or items != sorted(run.logs["matches"].keys):
        final = {"items": items, "rejected": {items[n]: reason for n, reason in rejected.items()}}
        run.cached("matches", FINAL, run.key("matches", FINAL, final), lambda: final)
    accepted = [pair for pair in two_views if pair.accepted]
    counts = {
        "pairs": len(two_views),
        "accepted": len(accepted),
        "verified": sum(pair.inliers for pair in accepted),
        "undetermined": sum(pair.undetermined for pair in accepted),
    }
    metrics = {"median_sigma_px": float(np.median([p.sigma_px for p in accepted]))} if accepted else {}
    run.finish("matches", counts=counts, metrics=metrics, warnings=_degenerate_pairs(accepted))


def final_pairs(records: Mapping[str, Any], features: Sequence[Features]) -> tuple[TwoView, ...]:
    """The pairs that :func:`finish_matches` reported, from the records of the stage."""
    if FINAL not in records:
        return tuple(records.values())
    final = records[FINAL]
    fewer = [item for item in final["items"] if item.endswith(FEWER)]
    whole = _of_all_corners([records[item] for item in fewer], features, SeedsAndGrowth.many_share)
    pairs = {item: records[item] for item in final["items"]} | dict(zip(fewer, whole, strict=True))
    for item, reason in final["rejected"].items():
        pairs[item] = replace(pairs[item], accepted=False, reason=reason)
    return tuple(pairs.values())


def _item(i: int, j: int, kind: str) -> str:
    return f"{i:05d}-{j:05d}{kind}"


def _degenerate_pairs(accepted: Sequence[TwoView]) -> list[str]:
    """A warning if the epipolar geometry of most pairs is degenerate."""
    undetermined = [pair for pair in accepted if pair.undetermined]
    if 2 * len(undetermined) <= len(accepted):
        return []
    kinds = Counter(pair.configuration for pair in undetermined)
    listed = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
    of_all = f"{len(undetermined)} of {len(accepted)} accepted pairs"
    return [Notice("degenerate-pairs", of_all, listed)]


def _prepared_oblique(state: PipelineState) -> PreparedViews:
    return PreparedViews(partial(prepare_oblique, state.config), state.given())


def _match_all(
    config: PipelineConfig, views: PreparedViews, pairs: Sequence[tuple[int, int]], seed: int
) -> list[TwoView]:
    return [match_views(config, views[i], views[j], (i, j), seed, views.masks(i, j)) for i, j in pairs]


def split_groups(state: PipelineState) -> None:
    """Find the groups of images that accepted pairs connect; sets ``groups`` if there are several."""
    views, links = len(state.result.images), [(p.i, p.j) for p in state.result.pairs if p.accepted]
    if not links or not state.config.images.groups:
        return
    large = _groups(views, links, MIN_GROUP)
    state.groups = large if len(large) > 1 else ()


def _groups(views: int, links: Sequence[tuple[int, int]], fewest: int) -> list[list[int]]:
    """The groups of ``fewest`` or more views, the largest first."""
    label = connected_groups(views, links)
    groups = [group.tolist() for group in rows_of_views(label, label.max() + 1)]
    return sorted((group for group in groups if len(group) >= fewest), key=lambda group: -len(group))


def groups_left_over(state: PipelineState) -> list[list[int]]:
    """The groups of images that overlap with each other but are not registered in the model of this run."""
    model = state.result.best_reconstruction
    if model is None or not model.registered.any() or not state.config.images.groups:
        return []
    # A projective run may end at the core of a large set.
    if state.until == "projective":
        return []
    missing = ~model.registered
    links = [(p.i, p.j) for p in state.used_pairs if p.accepted and missing[p.i] and missing[p.j]]
    return _groups(len(missing), links, MIN_GROUP)


def take_group(whole: PipelineState, views: Sequence[int], state: PipelineState) -> None:
    """Take features and pairs of some views from a run, instead of the first three steps."""
    run, number = state.run, {view: k for k, view in enumerate(views)}
    keys = list(whole.run.logs["features"].keys.values())
    features = [
        run.cached("features", f"{k:05d}", keys[i], partial(whole.result.features.__getitem__, i))
        for k, i in enumerate(views)
    ]
    finish_features(state, features)
    inside = [n for n, pair in enumerate(whole.result.pairs) if {pair.i, pair.j} <= number.keys()]
    keys, pairs = list(whole.run.logs["matches"].keys.values()), list[TwoView]()
    for n in inside:
        pair = whole.result.pairs[n]
        pair = replace(pair, i=number[pair.i], j=number[pair.j])
        # The final matches and the decision about a pair depend on all images, not only on its two.
        content = [pair.index1, pair.index2, pair.xy1, pair.xy2, pair.affine, pair.accepted, pair.reason]
        key = run.key("matches", keys[n], pair.i, pair.j, content)
        pairs.append(run.cached("matches", _item(pair.i, pair.j, ""), key, partial(replace, pair)))
    finish_matches(state, pairs)
