"""Images that a model leaves over: a second pass registers them, or their models are joined with it.

A few matches are not enough to verify the epipolar geometry of a pair. If they lead to points of the model, a
camera must explain them with twice as many equations: the second pass uses them for missing images only.
Models of images left over are joined with the model where they share enough points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from thesisrecon._numba import code_digest
from thesisrecon.arrays import B8
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.triangulation import triangulate_observations
from thesisrecon.matching.pair_selection import reject_repeated_structure
from thesisrecon.metric._joined_models import join_all, join_models, joinable
from thesisrecon.pipeline.job import Job
from thesisrecon.pipeline.large_sets import align_parts, from_metric, input_of_part, reconstruct_part
from thesisrecon.pipeline.matching import image_groups
from thesisrecon.pipeline.run import stream
from thesisrecon.records import (
    IntrinsicsPrior,
    MetricResult,
    Reconstruction,
    SelfCalibration,
    Tracks,
    TwoView,
)

NAMES = ("focal_px", "aspect", "skew_px", "principal_x_px", "principal_y_px", "k1")
"""Intrinsics of a result in the columns of a prior."""


def groups_left_over(job: Job, pairs: Sequence[TwoView], model: Reconstruction) -> list[list[int]]:
    """The groups of images that ``pairs`` connect with each other and that the model does not contain."""
    return image_groups(len(model.registered), pairs, ~model.registered) if job.config.images.groups else []


def register_more(
    job: Job, views: Sequence[Any], pairs: Sequence[TwoView], calibration: SelfCalibration,
    metric: MetricResult, attempt: int,
) -> MetricResult:  # fmt: skip
    """Register missing images; return the old model if none is added or the new one is not trusted."""
    run, old = job.run, metric.reconstruction
    more = pairs_of_missing(pairs, ~old.registered)
    if len(more) <= sum(pair.accepted for pair in pairs):
        return metric

    def register() -> MetricResult:
        rng = stream(run.seed, "metric", attempt, 1)
        tracks = job.config.tracks.build(views, more, map_all=run.workers.map_all, rng=rng)
        return _better_model(job, metric, cameras_on_tracks(old, tracks), calibration, rng)

    upstream = run.logs["metric"].keys[f"attempt-{attempt}"]
    key = run.key("metric", upstream, run.variant_key("tracks"), run.seed)
    found: MetricResult = run.cached("metric", f"attempt-{attempt}-more", key, register)
    return found


def pairs_of_missing(pairs: Sequence[TwoView], missing: B8) -> list[TwoView]:
    """The accepted pairs, and rejected ones of missing images that agree with one F and repeat nothing."""

    def of_use(pair: TwoView) -> bool:
        agree = pair.inliers >= 0.5 * pair.candidates
        return bool(pair.configuration) and agree and bool(missing[pair.i] or missing[pair.j])

    more = [replace(p, accepted=True, reason="") for p in pairs if p.accepted or of_use(p)]
    return [pair for pair in reject_repeated_structure(more, len(missing)) if pair.accepted]


def _better_model(
    job: Job, old: MetricResult, start: Reconstruction, calibration: SelfCalibration, rng: np.random.Generator
) -> MetricResult:
    """Refine ``start``: if it then has more images, all of the old ones, and is as trusted; else ``old``."""
    known, threads = from_metric(start, calibration), job.run.workers.threads
    try:
        new = job.config.metric.refine(start, known, prior=job.prior, rng=rng, threads=threads)
    except StageFailure:
        return old
    before, after = old.reconstruction.registered, new.reconstruction.registered
    joined = after.sum() > before.sum() and (before <= after).all()
    return new if joined and new.trusted >= old.trusted else old


def cameras_on_tracks(metric: Reconstruction, tracks: Tracks) -> Reconstruction:
    """Metric cameras with the points of other tracks, triangulated without distortion."""
    seen = metric.registered[tracks.view_index]
    view, point, xy = tracks.view_index[seen], tracks.point_index[seen], tracks.xy[seen]
    X = triangulate_observations(metric.P, view, point, xy, tracks.n_points)
    valid = np.bincount(point, minlength=tracks.n_points) >= 2
    return replace(metric, X=X, valid=valid, inlier=seen & valid[tracks.point_index], tracks=tracks)


def join_left_over(
    job: Job, pairs: Sequence[TwoView], calibration: SelfCalibration, metric: MetricResult,
    attempt: int, attempts: int,
) -> MetricResult:  # fmt: skip
    """Reconstruct groups left over, join those that share points and adjust; else the old model."""
    run, model, item = job.run, metric.reconstruction, f"attempt-{attempt}"
    if not (groups := joinable(model, groups_left_over(job, pairs, model))):
        return metric

    def join() -> MetricResult:
        rng, known = stream(run.seed, "metric", attempt, 2), known_cameras(job.prior, metric)
        others, pending, n = list[Reconstruction](), list(groups), len(model.registered)
        while pending:
            views = np.array(pending.pop(0))
            given = input_of_part(model.tracks, pairs, model.sizes, known, views)
            own = reconstruct_part(job.config, given, len(others), run.seed, attempts)
            if (other := align_parts(model.tracks, model.sizes, [views], [views], own)) is not None:
                others.append(other)
                pending += image_groups(n, pairs, np.isin(np.arange(n), views) & ~other.registered)
        joined = join_all(model, others, rng)
        return metric if joined is model else _better_model(job, metric, joined, calibration, rng)

    keys = [key for name, key in run.logs["metric"].keys.items() if name.startswith(item)]
    variants = [run.variant_key(stage) for stage in ("projective", "selfcalibration", "metric")]
    key = run.key("metric", variants, keys, code_digest(join_models), run.seed)
    found: MetricResult = run.cached("metric", f"{item}-joined", key, join)
    return found


def known_cameras(prior: IntrinsicsPrior, metric: MetricResult | None) -> IntrinsicsPrior:
    """The prior in which cameras of a trusted model have its intrinsics and their standard deviations."""
    if metric is None or not metric.trusted:
        return prior
    mean, std = prior.mean.copy(), prior.std.copy()
    for view in np.flatnonzero(metric.reconstruction.registered)[::-1]:
        for column, name in enumerate(NAMES):
            if (found := metric.intrinsics[view].get(name)) is None:
                continue
            wide = found.std / found.value if name == "focal_px" else found.std
            same = prior.shared[:, column] == prior.shared[view, column]
            same &= wide < prior.std[:, column]
            mean[same, column], std[same, column] = found.value, wide
    return replace(prior, mean=mean, std=std)
