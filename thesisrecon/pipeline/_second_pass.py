"""Second pass for images that are not registered: resection with the matches of rejected pairs.

A few matches are not enough to verify the epipolar geometry of a pair. If they lead to points of the model, a
camera must explain them with twice as many equations. They are used for missing images only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from thesisrecon.arrays import B8
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.triangulation import triangulate_observations
from thesisrecon.matching._repeated_structure import reject_repeated_structure
from thesisrecon.pipeline._state import PipelineState
from thesisrecon.records import MetricResult, Reconstruction, SelfCalibration, Tracks, TwoView, Upgrade
from thesisrecon.runtime._run import stream

MIN_AGREEMENT = 0.5
"""Smallest share of a rejected pair's matches that agree with its F."""


def pairs_of_missing(pairs: Sequence[TwoView], missing: B8) -> list[TwoView]:
    """The accepted pairs, and the rejected ones of missing images whose matches mostly agree with one F.

    Pairs that were rejected as repeated structure stay rejected.
    """

    def of_use(pair: TwoView) -> bool:
        agree = pair.inliers >= MIN_AGREEMENT * pair.candidates
        return bool(pair.configuration) and agree and bool(missing[pair.i] or missing[pair.j])

    more = [
        p if p.accepted else replace(p, accepted=True, reason="") for p in pairs if p.accepted or of_use(p)
    ]
    return [pair for pair in reject_repeated_structure(more, len(missing)) if pair.accepted]


def register_more(state: PipelineState, attempt: int, metric: MetricResult) -> MetricResult:
    """Register missing images; return the old model if none is added or the new one is not trusted."""
    missing = ~metric.reconstruction.registered
    pairs = pairs_of_missing(state.used_pairs, missing)
    if len(pairs) <= sum(pair.accepted for pair in state.used_pairs):
        return metric
    run, item = state.run, f"attempt-{attempt}-more"
    key = run.key(
        "metric", run.logs["metric"].keys[f"attempt-{attempt}"], run.variant_key("tracks"), run.seed
    )
    more: MetricResult = run.cached(
        "metric", item, key, partial(_registered_more, state, attempt, metric, pairs)
    )
    return more


def _registered_more(
    state: PipelineState, attempt: int, metric: MetricResult, pairs: Sequence[TwoView]
) -> MetricResult:
    rng, calibration = stream(state.run.seed, "metric", attempt, 1), state.result.calibration
    assert calibration is not None
    workers = state.run.workers
    tracks = state.config.tracks.build(state.prepared_views(), pairs, map_all=workers.map_all, rng=rng)
    start, again = (
        cameras_on_tracks(metric.reconstruction, tracks),
        from_metric(metric.reconstruction, calibration),
    )
    try:
        found = state.config.metric.refine(start, again, prior=state.prior, rng=rng, threads=workers.threads)
    except StageFailure:
        return metric
    before, after = metric.reconstruction.registered, found.reconstruction.registered
    joined = after.sum() > before.sum() and (before <= after).all()
    return found if joined and found.trusted >= metric.trusted else metric


def cameras_on_tracks(metric: Reconstruction, tracks: Tracks) -> Reconstruction:
    """Metric cameras with the points of other tracks, triangulated without distortion."""
    seen = metric.registered[tracks.view_index]
    view, point, xy = tracks.view_index[seen], tracks.point_index[seen], tracks.xy[seen]
    X = triangulate_observations(metric.P, view, point, xy, tracks.n_points)
    valid = np.bincount(point, minlength=tracks.n_points) >= 2
    inlier = seen & valid[tracks.point_index]
    return replace(metric, X=X, valid=valid, inlier=inlier, tracks=tracks)


def from_metric(metric: Reconstruction, calibration: SelfCalibration) -> SelfCalibration:
    """The self-calibration with the cameras of a metric reconstruction as its only candidate."""
    assert metric.K is not None
    only = Upgrade(np.eye(4), metric.K, 0.0, calibration.candidates[0].method)
    return replace(calibration, metric_from_projective=np.eye(4), K=metric.K, candidates=(only,))
