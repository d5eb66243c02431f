"""Cameras and points: projective reconstruction, self-calibration (chapters 6 and 7), metric refinement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from thesisrecon.config import with_images
from thesisrecon.errors import StageFailure
from thesisrecon.pipeline._state import PipelineState, name_images
from thesisrecon.records import MetricResult, Reconstruction, RunResult, SelfCalibration
from thesisrecon.runtime._run import stream

ATTEMPTS = 3
"""Maximum number of initial pairs to try until the self-check passes."""


def _cached(
    state: PipelineState, stage: str, attempt: int, inputs: Any, compute: Callable[[np.random.Generator], Any]
) -> Any:
    """The record of one attempt, which depends on ``inputs``."""
    run = state.run
    key = run.key(stage, run.variant_key(stage), inputs, run.seed, attempt)
    run.progress(stage, 0, 1)
    found = run.cached(stage, f"attempt-{attempt}", key, lambda: compute(stream(run.seed, stage, attempt)))
    run.progress(stage, 1, 1)
    return found


def _sizes_of(reconstruction: Reconstruction) -> dict[str, int]:
    return {"registered": int(reconstruction.registered.sum()), "points": int(reconstruction.valid.sum())}


def reconstruct_projective(state: PipelineState, attempt: int = 0) -> None:
    """Reconstruct up to a projective transform (chapter 6); ``attempt`` is the rank of the initial pair."""
    run, result = state.run, state.result
    assert result.tracks is not None
    tracks, sizes = result.tracks, np.array([image.size for image in result.images], dtype=np.int64)
    method = state.config.projective
    projective: Reconstruction = _cached(
        state, "projective", attempt, run.logs["tracks"].keys,
        lambda rng: method.reconstruct(tracks, result.pairs, sizes, rng=rng, attempt=attempt),
    )  # fmt: skip
    state.result = replace(result, projective=projective)
    run.finish("projective", counts=_sizes_of(projective), metrics={"sigma_px": projective.sigma_px})


def _calibrate(state: PipelineState, attempt: int) -> SelfCalibration:
    run, prior, projective = state.run, state.prior, state.result.projective
    assert projective is not None
    upstream = run.logs["projective"].keys[f"attempt-{attempt}"]
    method = state.config.selfcalibration
    calibration: SelfCalibration = _cached(
        state, "selfcalibration", attempt, [upstream, prior.shared, prior.mean, prior.std, prior.kind],
        lambda rng: with_images(method, state.result.images).calibrate(projective, prior=prior, rng=rng),
    )  # fmt: skip
    state.result = replace(state.result, calibration=calibration)
    counts = {"hypotheses": len(calibration.candidates), "identifiable": int(calibration.identifiable)}
    warnings = [name_images(text, state.names) for text in _critical(calibration)]
    run.finish("selfcalibration", counts=counts, warnings=warnings)
    return calibration


def _critical(calibration: SelfCalibration) -> tuple[str, ...]:
    """A warning about a critical motion that the prior resolves; others fail the self-check."""
    identifiability = calibration.identifiability
    if identifiability is None or not (identifiability.critical and identifiability.identifiable):
        return ()
    return ("; ".join(identifiability.sentences),)


def _refine(state: PipelineState, attempt: int, calibration: SelfCalibration) -> MetricResult:
    run, prior, projective = state.run, state.prior, state.result.projective
    assert projective is not None
    metric: MetricResult = _cached(
        state, "metric", attempt, run.logs["selfcalibration"].keys[f"attempt-{attempt}"],
        lambda rng: state.config.metric.refine(projective, calibration, prior=prior, rng=rng),
    )  # fmt: skip
    state.result = replace(state.result, metric=metric)
    warnings = [name_images(text, state.names) for text in metric.warnings]
    best = metric.reconstruction
    run.finish("metric", counts=_sizes_of(best), metrics={"sigma_px": best.sigma_px}, warnings=warnings)
    return metric


def reconstruct_metric(state: PipelineState) -> None:
    """Reconstruct, calibrate and refine; try other initial pairs if the self-check fails.

    The first trusted result is used, else the one with most cameras, then most points.
    """
    tried: list[RunResult] = []
    failures: list[StageFailure] = []
    start = state.result
    for attempt in range(ATTEMPTS):
        state.result, trusted = start, False
        try:
            reconstruct_projective(state, attempt)
            trusted = _refine(state, attempt, _calibrate(state, attempt)).trusted
        except StageFailure as failure:
            failures.append(failure)
        tried.append(state.result)
        if trusted:
            break
    state.result = max(tried, key=_quality)
    if state.result.metric is None:
        raise failures[0]
    if len(tried) > 1:
        state.run.warnings.append(f"{len(tried)} initial pairs were tried; the best result is used")


def _quality(result: RunResult) -> tuple[bool, bool, int, int]:
    best = result.metric.reconstruction if result.metric is not None else result.projective
    if best is None:
        return False, False, 0, 0
    trusted = result.metric is not None and result.metric.trusted
    return result.metric is not None, trusted, int(best.registered.sum()), int(best.valid.sum())
