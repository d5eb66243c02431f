"""Images that a model leaves over: their models are joined with it where they share enough points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from thesisrecon._numba import code_digest
from thesisrecon.errors import StageFailure
from thesisrecon.metric._joined_models import join_all, join_models, joinable
from thesisrecon.pipeline.job import Job
from thesisrecon.pipeline.large_sets import (
    align_parts,
    better_model,
    from_metric,
    input_of_part,
    reconstruct_part,
)
from thesisrecon.pipeline.matching import image_groups
from thesisrecon.pipeline.run import stream
from thesisrecon.records import IntrinsicsPrior, MetricResult, Reconstruction, SelfCalibration, TwoView

NAMES = ("focal_px", "aspect", "skew_px", "principal_x_px", "principal_y_px", "k1")
"""Intrinsics of a result in the columns of a prior."""


def join_left_over(
    job: Job,
    pairs: Sequence[TwoView],
    calibration: SelfCalibration,
    metric: MetricResult,
    attempt: int,
    attempts: int,
) -> MetricResult:
    """Reconstruct groups of images left over, join those that share enough points, and adjust all together.

    Returns the old model if none is joined, or the new one is not trusted.
    """
    run, model, item = job.run, metric.reconstruction, f"attempt-{attempt}"
    n, threads = len(model.registered), run.workers.threads
    groups = image_groups(n, pairs, ~model.registered) if job.config.images.groups else []
    if not (groups := joinable(model, groups)):
        return metric

    def join() -> MetricResult:
        rng, known = stream(run.seed, "metric", attempt, 2), known_cameras(job.prior, metric)
        others, pending = list[Reconstruction](), list(groups)
        while pending:
            views = np.array(pending.pop(0))
            given = input_of_part(model.tracks, pairs, model.sizes, known, views)
            own = reconstruct_part(job.config, given, len(others), run.seed, attempts)
            if (other := align_parts(model.tracks, model.sizes, [views], [views], own)) is not None:
                others.append(other)
                rest = np.isin(np.arange(n), views) & ~other.registered
                pending += image_groups(n, pairs, rest)
        joined = join_all(model, others, rng)
        if joined is model:
            return metric
        start = from_metric(joined, calibration)
        try:
            found = job.config.metric.refine(joined, start, prior=job.prior, rng=rng, threads=threads)
        except StageFailure:
            return metric
        return better_model(metric, found)

    keys = [key for name, key in run.logs["metric"].keys.items() if name.startswith(item)]
    variants = [run.variant_key(stage) for stage in ("projective", "selfcalibration", "metric")]
    key = run.key("metric", variants, keys, code_digest(join_models), run.seed)
    joined: MetricResult = run.cached("metric", f"{item}-joined", key, join)
    return joined


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
