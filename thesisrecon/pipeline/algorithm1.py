"""Algorithm 1 of the thesis: from images to cameras, points and a textured model, stage after stage."""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np

from thesisrecon._numba import code_digest
from thesisrecon.config.intrinsics import camera_numbers
from thesisrecon.config.text import tables_from_config
from thesisrecon.errors import Notice, StageFailure, WorkersLost, counted
from thesisrecon.io._images import ImageSet
from thesisrecon.metric._joined_models import join_all, join_models, joinable
from thesisrecon.pipeline import outputs, stages
from thesisrecon.pipeline.large_sets import calibrated_part, cameras_from_parts, from_metric, prior_of_views
from thesisrecon.pipeline.lens import as_imaged
from thesisrecon.pipeline.matching import FromRun, image_groups, require_accepted_pair
from thesisrecon.pipeline.next_photographs import next_photographs
from thesisrecon.pipeline.run import Job, Run, name_images, stream
from thesisrecon.records import MetricResult, Reconstruction, TwoView
from thesisrecon.results import RunResult
from thesisrecon.runtime._blas import one_blas_thread
from thesisrecon.runtime._executors import library_versions
from thesisrecon.runtime._precompilation import precompile
from thesisrecon.runtime._run_folder import RunDirectory

ATTEMPTS = 3  # maximum number of initial pairs to try until the self-check passes
MAX_NAMED = 10  # images that one warning names
Source = Mapping[str, str]  # name and digest of the matches or tracks that a run starts from


def algorithm1(job: Job) -> Iterator[RunResult]:
    """Yield the result of the largest group of images after each stage; ``StageFailure`` ends it."""
    run, front, until = job.run, job.front, job.until
    job.require_images()
    with run.clock("kernels"):
        compiled = precompile(until, run.workers.threads, run.progress)
    if compiled:
        run.finish("kernels", counts={"compiled": compiled})
    result = empty_result(run, job.inputs)

    # Before everything: lenses that bend lines much, seen in pairs of images (Fitzgibbon 2001).
    if job.prior.lens is None and until != "features":
        run.lens = front.lens(job)

    # Section 4.2.1: corners and seeds of every image.
    features = front.detect(job)
    yield (result := replace(result, features=tuple(features)))
    if until == "features":
        return

    # Section 4.2.2 and chapter 5: pairs that may overlap, their matches and fundamental matrices.
    views = front.prepare(job, features)
    choice = front.select(job, features)
    yield (result := replace(result, pair_choice=choice))
    yield (result := replace(result, pairs=tuple(front.match(job, views, choice))))
    if until == "matches":
        return

    # Tracks: the images of one point in several views.
    pairs = pairs_of_group(job, result.pairs)
    require_accepted_pair(pairs)
    tracks = front.track(job, views, pairs)
    yield (result := replace(result, tracks=tracks))

    # Cameras that are given leave nothing to chapters 6 and 7 but the points, and the other images.
    if job.given is not None:
        yield (result := replace(result, metric=stages.metric_of_given(job, tracks, pairs)))
        assert result.metric is not None
        stages.report_metric(job, result.metric)

    # Chapter 6: projective cameras and points.
    elif until == "projective":
        yield (result := replace(result, projective=stages.reconstruct_projective(job, tracks, pairs)))
        stages.report_projective(job, result)
        return

    # Chapter 7: self-calibration and metric refinement.
    else:
        for found in metric_cameras(job, result, views, pairs):
            yield (result := found)
    if until == "metric":
        return

    # Sections 2.5 and 2.6: depth maps, surface and texture.
    assert result.metric is not None
    try:
        maps, undistorted = stages.estimate_depth_maps(job, result.metric.reconstruction)
        yield (result := replace(result, depth_maps=maps, views=undistorted))
        stages.report_depth_maps(job, maps)
        if until == "model":
            mesh, held_out = stages.build_model(job, maps, undistorted)
            yield replace(result, mesh=mesh, held_out=held_out)
    except StageFailure as failure:
        if job.surface_required:
            raise
        run.warnings.append(Notice("no-surface", failure))


def metric_cameras(
    job: Job, result: RunResult, views: Sequence[Any], pairs: Sequence[TwoView]
) -> Iterator[RunResult]:
    """Calibrate and refine, from other initial pairs until a result is trusted, then add missing images."""
    tried, failures = list[RunResult](), list[StageFailure]()
    for attempt in range(ATTEMPTS):
        # Large sets are divided once.
        in_parts = all(other.calibration is None for other in tried)
        found, failure = last_result(attempt_cameras(job, result, pairs, attempt, in_parts=in_parts), result)
        tried.append(found)
        if failure is not None:
            failures.append(failure)
        # Another start may keep the images that were left out.
        elif found.metric and found.metric.trusted and "views_left_out" not in found.metric.self_check:
            break
    best = outputs.best_result(tried)
    yield best
    stages.report_projective(job, best)
    if best.metric is None or best.calibration is None:
        raise failures[0]
    chosen = next(k for k, other in enumerate(tried) if other is best)
    metric = stages.register_more(job, result.features, views, pairs, best.calibration, best.metric, chosen)
    job.run.cameras = job.known or stages.known_cameras(job.prior, metric)
    metric = join_left_over(job, replace(best, metric=metric), chosen)
    metric = stages.metric_in_world(job, metric, chosen)
    stages.report_metric(job, metric)
    if len(tried) > 1:
        job.run.warnings.append(Notice("several-starts", len(tried)))
    yield replace(best, metric=metric)


def join_left_over(job: Job, result: RunResult, attempt: int) -> MetricResult:
    """Reconstruct groups left over, join those that share points and adjust; else the old model."""
    run, metric, calibration, features = job.run, result.metric, result.calibration, result.features
    assert metric is not None
    assert calibration is not None
    model, item = metric.reconstruction, f"attempt-{attempt}"
    if not (groups := joinable(model, _unregistered_groups(job, result))):
        return metric

    def join() -> MetricResult:
        others, pending = list[Reconstruction](), list(groups)
        trial = replace(run.directory, path=run.directory.path / "trial", trial=True)
        while pending:
            views = pending.pop(0)
            part = replace(_part_of(job, result, trial, views), until="metric")
            found, _ = _last_named(part)
            pending += [[views[k] for k in rest] for rest in _unregistered_groups(part, found)]
            if found.metric is not None and found.metric.trusted:
                others.append(stages.model_among(model, views, found.metric.reconstruction))
        rng = stream(run.seed, "metric", attempt, 2)
        joined = join_all(model, others, rng)
        return (
            metric
            if joined is model
            else stages.better_model(job, features, metric, joined, calibration, rng)
        )

    keys = [key for name, key in run.logs["metric"].keys.items() if name.startswith(item)]
    variants = [run.variant_key(stage) for stage in ("projective", "selfcalibration", "metric")]
    key = run.key("metric", variants, keys, code_digest(join_models), run.seed)
    found: MetricResult = run.cached("metric", f"{item}-joined", key, join)
    return found


def attempt_cameras(
    job: Job, result: RunResult, pairs: Sequence[TwoView], attempt: int, *, in_parts: bool
) -> Iterator[RunResult]:
    """Chapters 6 and 7 from one initial pair; ``in_parts``: large sets are divided if they can be."""
    tracks = result.tracks
    assert tracks is not None
    projective = stages.reconstruct_projective(job, tracks, pairs, attempt)
    yield (result := replace(result, projective=projective))
    calibration = stages.self_calibrate(job, projective, attempt)
    yield (result := replace(result, calibration=calibration))
    aligned, keys = None, list[str]()
    if in_parts:
        aligned, keys = cameras_from_parts(job, tracks, pairs, ATTEMPTS)
    if aligned is None:
        part = calibrated_part(projective, calibration)
        start, known = as_imaged(part, tracks, job.prior), calibration
    else:
        start, known = aligned, from_metric(aligned, calibration)
    yield replace(result, metric=stages.refine_metric(job, result.features, start, known, attempt, keys))


def last_result(stages: Iterator[RunResult], result: RunResult) -> tuple[RunResult, StageFailure | None]:
    """Run all stages; return the last result, or ``result``, and the failure that ended them."""
    try:
        for found in stages:
            result = found
    except StageFailure as failure:
        return result, failure
    return result, None


def pairs_of_group(job: Job, pairs: Sequence[TwoView]) -> Sequence[TwoView]:
    """The pairs of the largest group of images if there are several groups."""
    if not (groups := groups_of(job, pairs)):
        return pairs
    largest = set(groups[0])
    return tuple(pair for pair in pairs if {pair.i, pair.j} <= largest)


def groups_of(job: Job, pairs: Sequence[TwoView]) -> list[list[int]]:
    """The groups of images that accepted pairs connect, the largest first; none if there is only one."""
    divides = job.front.divides and job.config.images.groups and job.given is None
    if not (divides and any(pair.accepted for pair in pairs)):
        return []
    groups = image_groups(len(job.images), pairs)
    return groups if len(groups) > 1 else []


def run_job(job: Job) -> RunResult:
    """Reconstruct the largest group of images, then the rest; write outputs, of failures too."""
    result, failure = _last_named(job)
    if job.until not in ("features", "matches"):
        result = _with_further_models(job, result)
    result = outputs.write_outputs(job.run, result, until=job.until, failure=failure)
    if failure is not None:
        raise failure
    return result


def _last_named(job: Job) -> tuple[RunResult, StageFailure | None]:
    """The last result of a job; the failure that ended it names images by their files."""
    try:
        result, failure = last_result(algorithm1(job), empty_result(job.run, job.inputs))
    except WorkersLost as lost:
        raise WorkersLost(name_images(str(lost), job.names)) from None
    if failure is not None:
        parts = (failure.reason, failure.evidence, failure.advice)
        failure = StageFailure(*(name_images(part, job.names) for part in parts))
    return result, failure


def _with_further_models(job: Job, result: RunResult) -> RunResult:
    """Reconstruct the other groups and the images left over, in folders; remove those that are gone."""
    run, folder, places, further = job.run, job.run.directory.path, dict[int, str](), list[RunResult]()
    pending = deque[Sequence[int]]([*groups_of(job, result.pairs)[1:], *_unregistered_groups(job, result)])
    while pending:
        views, name = pending.popleft(), f"group-{len(run.groups) + 2}"
        part, found = _run_group(job, result, name, views)
        pending.extend([views[k] for k in rest] for rest in _unregistered_groups(part, found))
        if (model := found.best_reconstruction) is not None:
            places |= {i: name for i, there in zip(views, model.registered, strict=True) if there}
            further.append(found)
    for number in count(len(run.groups) + 2):
        if not (folder / f"group-{number}" / outputs.RESULT_FILES[0]).exists():
            break
        RunDirectory(folder / f"group-{number}").remove(outputs.RESULT_FILES)
    here = result.best_reconstruction
    if here is not None and job.until != "projective":
        # Images in no model that accepted pairs connect with one.
        known = {*np.flatnonzero(here.registered).tolist(), *places}
        ends = {end for p in result.pairs if p.accepted and {p.i, p.j} & known for end in (p.i, p.j)}
        if linked := [job.names[i] for i in sorted(ends - known)]:
            names = ", ".join(linked[:MAX_NAMED]) + (", ..." if len(linked) > MAX_NAMED else "")
            run.warnings.append(Notice("linked-images", counted(len(linked), "image"), names))
        if here.stratum == "metric":
            run.warnings += next_photographs(here, result.pairs, job.names)
    if not run.groups:
        return result
    registered = 0 if here is None else int(here.registered.sum())
    none = len(job.names) - registered - len(places)
    elsewhere = ", ".join(f"{group['registered']} in {group['folder']}" for group in run.groups)
    elsewhere += f", {none} in none" if none else ""
    models = Notice("several-models", len(run.groups) + 1)
    run.warnings.append(Notice("sizes-of-models", models, counted(registered, "image"), elsewhere))
    reasons = {i: Notice("other-group", name) for i, name in places.items()}

    def named(found: Reconstruction) -> Reconstruction:
        return replace(found, reasons=tuple(reasons.get(i, why) for i, why in enumerate(found.reasons)))

    projective, metric = result.projective, result.metric
    return replace(
        result,
        projective=projective and named(projective),
        metric=metric and replace(metric, reconstruction=named(metric.reconstruction)),
        further_models=tuple(further),
    )


def _unregistered_groups(job: Job, result: RunResult) -> list[list[int]]:
    """The groups of images that the model of this job leaves over; none without a model."""
    model = result.best_reconstruction
    # A projective run may end at the core of a large set.
    if model is None or not model.registered.any() or job.until == "projective" or job.given is not None:
        return []
    pairs = pairs_of_group(job, result.pairs)
    return image_groups(len(job.images), pairs, ~model.registered) if job.config.images.groups else []


def _part_of(whole: Job, result: RunResult, directory: RunDirectory, views: Sequence[int]) -> Job:
    """The job of some images of a result, with what is known about their cameras."""
    of_all = whole.inputs.whole or whole.inputs
    inputs = ImageSet(tuple(whole.inputs.decoded[i] for i in views), {}, of_all)
    model = result.best_reconstruction
    front = FromRun(whole, views, result.features, result.pairs, None if model is None else model.tracks)
    known = prior_of_views(whole.run.cameras or whole.prior, views)
    return Job(whole.run.inside(directory), inputs, front, whole.until, whole.surface_required, known)


def _run_group(whole: Job, result: RunResult, name: str, views: Sequence[int]) -> tuple[Job, RunResult]:
    """Reconstruct a group as a run with the cameras of the whole; add it to the summary of the whole."""
    directory = replace(whole.run.directory, path=whole.run.directory.path / name, part=True)
    part = _part_of(whole, result, directory, views)
    known, identity = part.prior, identity_of(part.run, part.inputs)
    with directory.claim(identity, overwrite=True):
        directory.adopt(identity, overwrite=True, results=outputs.RESULT_FILES)
        found, failure = _last_named(part)
        alone = replace(part, run=whole.run.inside(directory), known=None)
        # Images of equal size may have another zoom.
        refuted = (known.std < alone.prior.std).any() and not (found.metric and found.metric.trusted)
        if refuted and part.until != "projective":
            part = alone
            found, failure = _last_named(part)
        found = outputs.write_outputs(part.run, found, until=part.until, failure=failure)
    facts = {fact: found.summary[fact] for fact in ("images", "registered", "trusted", "failure")}
    model = found.best_reconstruction
    there = [model is not None and bool(model.registered[k]) for k in range(len(views))]
    missing = [image for image, registered in zip(part.names, there, strict=True) if not registered]
    whole.run.groups.append({"folder": name, "names": part.names, "missing": missing, **facts})
    return part, found


@contextmanager
def claimed(run: Run, *, overwrite: bool, source: Source | None = None) -> Iterator[None]:
    """Start the workers and lock the output folder of a run."""
    claim = run.directory.claim(
        _settings_identity(run, source), overwrite=overwrite, results=outputs.WRITTEN_FILES
    )
    with run.workers, one_blas_thread(), claim, run.resumable():
        yield


def run_adopted(job: Job, *, overwrite: bool, source: Source | None = None) -> RunResult:
    """Make the output folder that of this job, and run it."""
    identity = identity_of(job.run, job.inputs, source)
    job.run.directory.adopt(identity, overwrite=overwrite, results=outputs.REPLACED_FILES)
    return run_job(job)


def _settings_identity(run: Run, source: Source | None) -> dict[str, Any]:
    """The part of a run's identity that is known before its images are read."""
    given = {} if source is None else {"source": source}
    settings = tables_from_config(run.config)
    return {"version": 1, **given, "seed": run.seed, "settings": settings, "versions": library_versions()}


def identity_of(run: Run, inputs: ImageSet, source: Source | None = None) -> dict[str, Any]:
    """Settings, seed and content of the images: runs with equal identity are the same."""
    digests = {p.image.name: p.digest for p in inputs.decoded}
    refused = {name: f"refused: {reason}" for name, reason in inputs.refused.items()}
    return _settings_identity(run, source) | {"images": digests | refused}


def empty_result(run: Run, inputs: ImageSet) -> RunResult:
    """The result before the first stage."""
    sizes = [image.original_size for image in inputs.images]
    names = [image.name for image in inputs.images]
    groups = camera_numbers(sizes, run.config.intrinsics, inputs.exif_focal_px, names)
    settings = tables_from_config(run.config)
    return RunResult(run.directory.path, inputs.images, inputs.refused, (), (), groups, settings)
