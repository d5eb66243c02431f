"""Cameras and points: projective reconstruction, self-calibration (chapters 6 and 7), metric refinement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thesisrecon.config import with_images
from thesisrecon.errors import StageFailure
from thesisrecon.pipeline._state import PipelineState, name_images
from thesisrecon.records import RunResult, SelfCalibration
from thesisrecon.runtime.run import stream

ATTEMPTS = 3
"""Maximum number of initial pairs to try until the self-check passes."""


def reconstruct_projective(state: PipelineState, attempt: int = 0) -> None:
    """Reconstruct up to a projective transform (chapter 6); ``attempt`` is the rank of the initial pair."""
    run, result = state.run, state.result
    assert result.tracks is not None
    tracks, sizes = result.tracks, np.array([image.size for image in result.images], dtype=np.int64)
    key = run.key("projective", run.variant_key("projective"), run.logs["tracks"].keys, run.seed, attempt)
    run.progress("projective", 0, 1)
    projective = run.cached(
        "projective",
        f"attempt-{attempt}",
        key,
        lambda: state.config.projective.reconstruct(
            tracks, result.pairs, sizes, rng=stream(run.seed, "projective", attempt), attempt=attempt
        ),
    )
    state.result = replace(result, projective=projective)
    counts = {"registered": int(projective.registered.sum()), "points": int(projective.valid.sum())}
    run.finish("projective", counts=counts, metrics={"sigma_px": projective.sigma_px})
    run.progress("projective", 1, 1)


def _calibrate(state: PipelineState, attempt: int) -> None:
    run, prior = state.run, state.prior
    projective = state.result.projective
    assert projective is not None
    upstream = run.logs["projective"].keys[f"attempt-{attempt}"]
    prior_key = [prior.shared, prior.mean, prior.std, prior.kind]
    key = run.key("selfcalibration", run.variant_key("selfcalibration"), upstream, prior_key, run.seed)
    run.progress("selfcalibration", 0, 1)
    calibration = run.cached(
        "selfcalibration",
        f"attempt-{attempt}",
        key,
        lambda: with_images(state.config.selfcalibration, state.result.images).calibrate(
            projective,
            prior=prior,
            rng=stream(run.seed, "selfcalibration", attempt),
        ),
    )
    state.result = replace(state.result, calibration=calibration)
    counts = {"hypotheses": len(calibration.candidates), "identifiable": int(calibration.identifiable)}
    warnings = [name_images(text, state.names) for text in _critical(calibration)]
    run.finish("selfcalibration", counts=counts, warnings=warnings)
    run.progress("selfcalibration", 1, 1)


def _critical(calibration: SelfCalibration) -> tuple[str, ...]:
    """A warning about a critical motion that the prior resolves; others fail the self-check."""
    identifiability = calibration.identifiability
    if identifiability is None or not (identifiability.critical and identifiability.identifiable):
        return ()
    return ("; ".join(identifiability.sentences),)


def _refine(state: PipelineState, attempt: int) -> None:
    run, prior = state.run, state.prior
    projective, calibration = state.result.projective, state.result.calibration
    assert projective is not None
    assert calibration is not None
    upstream = run.logs["selfcalibration"].keys[f"attempt-{attempt}"]
    key = run.key("metric", run.variant_key("metric"), upstream, run.seed)
    run.progress("metric", 0, 1)
    metric = run.cached(
        "metric",
        f"attempt-{attempt}",
        key,
        lambda: state.config.metric.refine(
            projective,
            calibration,
            prior=prior,
            rng=stream(run.seed, "metric", attempt),
        ),
    )
    state.result = replace(state.result, metric=metric)
    best = metric.reconstruction
    counts = {"registered": int(best.registered.sum()), "points": int(best.valid.sum())}
    warnings = [name_images(text, state.names) for text in metric.warnings]
    run.finish("metric", counts=counts, metrics={"sigma_px": best.sigma_px}, warnings=warnings)
    run.progress("metric", 1, 1)


def reconstruct_metric(state: PipelineState) -> None:
    """Reconstruct, calibrate and refine; try other initial pairs if the self-check fails.

    The first trusted result is used, else the one with most cameras, then most points.
    """
    tried: list[RunResult] = []
    failures: list[StageFailure] = []
    start = state.result
    for attempt in range(ATTEMPTS):
        state.result = start
        try:
            reconstruct_projective(state, attempt)
            _calibrate(state, attempt)
            _refine(state, attempt)
        except StageFailure as failure:
            failures.append(failure)
            tried.append(state.result)
            continue
        tried.append(state.result)
        if state.result.metric is not None and state.result.metric.trusted:
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
