"""Chapters 6 and 7, and the metric stage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thesisrecon.config import with_images
from thesisrecon.errors import StageFailure
from thesisrecon.pipeline.state import Work
from thesisrecon.records import RunResult, SelfCalibration
from thesisrecon.runtime.run import stream

ATTEMPTS = 3
"""Initial pairs that are tried until the self-check is content."""


def reconstruct_projective(work: Work, attempt: int = 0) -> None:
    run, result = work.run, work.result
    assert result.tracks is not None
    tracks, sizes = result.tracks, np.array([image.size for image in result.images], dtype=np.int64)
    key = run.key("projective", run.variant_key("projective"), run.logs["tracks"].keys, run.seed, attempt)
    run.progress("projective", 0, 1)
    projective = run.kept(
        "projective",
        f"attempt-{attempt}",
        key,
        lambda: work.config.projective.reconstruct(
            tracks, result.pairs, sizes, rng=stream(run.seed, "projective", attempt), attempt=attempt
        ),
    )
    work.result = replace(result, projective=projective)
    counts = {"registered": int(projective.registered.sum()), "points": int(projective.valid.sum())}
    run.finish("projective", counts=counts, metrics={"sigma_px": projective.sigma_px})
    run.progress("projective", 1, 1)


def _calibrate(work: Work, attempt: int) -> None:
    run, prior = work.run, work.prior
    projective = work.result.projective
    assert projective is not None
    upstream = run.logs["projective"].keys[f"attempt-{attempt}"]
    wish = [prior.shared, prior.mean, prior.std, prior.kind]
    key = run.key("selfcalibration", run.variant_key("selfcalibration"), upstream, wish, run.seed)
    run.progress("selfcalibration", 0, 1)
    calibration = run.kept(
        "selfcalibration",
        f"attempt-{attempt}",
        key,
        lambda: with_images(work.config.selfcalibration, work.result.images).calibrate(
            projective,
            prior=prior,
            rng=stream(run.seed, "selfcalibration", attempt),
        ),
    )
    work.result = replace(work.result, calibration=calibration)
    counts = {"hypotheses": len(calibration.candidates), "identifiable": int(calibration.identifiable)}
    run.finish("selfcalibration", counts=counts, warnings=_critical(calibration))
    run.progress("selfcalibration", 1, 1)


def _critical(calibration: SelfCalibration) -> tuple[str, ...]:
    """What is to be said of a critical motion that the assumptions make good for; the rest is a doubt."""
    identifiability = calibration.identifiability
    if identifiability is None or not (identifiability.critical and identifiability.identifiable):
        return ()
    return ("; ".join(identifiability.sentences),)


def _refine(work: Work, attempt: int) -> None:
    run, prior = work.run, work.prior
    projective, calibration = work.result.projective, work.result.calibration
    assert projective is not None
    assert calibration is not None
    upstream = run.logs["selfcalibration"].keys[f"attempt-{attempt}"]
    key = run.key("metric", run.variant_key("metric"), upstream, run.seed)
    run.progress("metric", 0, 1)
    metric = run.kept(
        "metric",
        f"attempt-{attempt}",
        key,
        lambda: work.config.metric.refine(
            projective,
            calibration,
            prior=prior,
            rng=stream(run.seed, "metric", attempt),
        ),
    )
    work.result = replace(work.result, metric=metric)
    best = metric.reconstruction
    counts = {"registered": int(best.registered.sum()), "points": int(best.valid.sum())}
    run.finish("metric", counts=counts, metrics={"sigma_px": best.sigma_px}, warnings=metric.warnings)
    run.progress("metric", 1, 1)


def reconstruct_metric(work: Work) -> None:
    """Projective, self-calibration, metric; where the self-check fails, again from another initial pair.

    Kept is the first result that is trusted; else the one with most cameras, then most points.
    """
    tried: list[RunResult] = []
    failures: list[StageFailure] = []
    start = work.result
    for attempt in range(ATTEMPTS):
        work.result = start
        try:
            reconstruct_projective(work, attempt)
            _calibrate(work, attempt)
            _refine(work, attempt)
        except StageFailure as failure:
            failures.append(failure)
            tried.append(work.result)
            continue
        tried.append(work.result)
        if work.result.metric is not None and work.result.metric.trusted:
            break
    work.result = max(tried, key=_quality)
    if work.result.metric is None:
        raise failures[0]
    if len(tried) > 1:
        work.run.warnings.append(f"{len(tried)} initial pairs were tried; the best result was kept")


def _quality(result: RunResult) -> tuple[bool, bool, int, int]:
    best = result.metric.reconstruction if result.metric is not None else result.projective
    if best is None:
        return False, False, 0, 0
    trusted = result.metric is not None and result.metric.trusted
    return result.metric is not None, trusted, int(best.registered.sum()), int(best.valid.sum())
