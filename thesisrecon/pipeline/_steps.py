"""One run as a sequence of steps: its folder, its identity, its failures and its outputs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.config.text import tables_from_config
from thesisrecon.errors import Notice, StageFailure, counted
from thesisrecon.intrinsics import camera_numbers
from thesisrecon.io._images import ImageSet
from thesisrecon.pipeline._matching_stages import (
    find_features,
    groups_left_over,
    match_pairs,
    select_pairs,
    split_groups,
    take_group,
)
from thesisrecon.pipeline._outputs import RESULT_FILES, WRITTEN_FILES, write_outputs
from thesisrecon.pipeline._stages import (
    build_model,
    build_tracks,
    estimate_depth_maps,
    finish_projective,
    reconstruct_metric,
    reconstruct_projective,
)
from thesisrecon.pipeline._state import PipelineState, name_images
from thesisrecon.records import Reconstruction
from thesisrecon.results import RunResult
from thesisrecon.runtime._precompilation import precompile
from thesisrecon.runtime._run import Run
from thesisrecon.runtime._run_folder import RunDirectory

Step = Callable[[PipelineState], None]
STEPS: dict[str, tuple[Step, ...]] = {
    "features": (find_features,),
    "matches": (find_features, select_pairs, match_pairs),
}
_TO_TRACKS: tuple[Step, ...] = (*STEPS["matches"], split_groups, build_tracks)
STEPS["projective"] = (*_TO_TRACKS, reconstruct_projective, finish_projective)
STEPS["metric"] = (*_TO_TRACKS, reconstruct_metric)
"""Algorithm 1: the steps up to each last stage."""
SURFACE_STEPS = (estimate_depth_maps, build_model)
STEPS["dense"] = (*STEPS["metric"], *SURFACE_STEPS[:1])
STEPS["model"] = (*STEPS["metric"], *SURFACE_STEPS)

Source = Mapping[str, str]
"""Name and digest of the matches or tracks that a run starts from."""


@contextmanager
def claimed(run: Run, *, overwrite: bool, source: Source | None = None) -> Iterator[None]:
    """Start the workers and lock the output folder of a run."""
    claim = run.directory.claim(_settings_identity(run, source), overwrite=overwrite, results=WRITTEN_FILES)
    with run.workers, claim, run.resumable():
        yield


def run_steps(state: PipelineState, steps: Sequence[Step], *, surface_required: bool) -> RunResult:
    """Run the steps for the largest group of images, then for the rest; write outputs, of failures too."""
    failure = _failure_of(state, (_begin, *steps), surface_required=surface_required)
    state.prepared = None
    if further := steps[len(STEPS["matches"]) :]:
        again = [step for step in further if step is not split_groups]
        _run_groups(state, again, surface_required=surface_required)
    result = write_outputs(state.run, state.result, until=state.until, failure=failure)
    if failure is not None:
        raise failure
    return result


def _begin(state: PipelineState) -> None:
    state.require_images()
    precompile(state.until, state.run.workers.threads, state.run.progress)


def _failure_of(
    state: PipelineState, steps: Sequence[Step], *, surface_required: bool
) -> StageFailure | None:
    """Run the steps; return the failure that ended them."""
    try:
        _run_all(state, steps, surface_required=surface_required)
    except StageFailure as error:
        parts = (error.reason, error.evidence, error.advice)
        return StageFailure(*(name_images(part, state.names) for part in parts))
    return None


def _run_groups(state: PipelineState, steps: Sequence[Step], *, surface_required: bool) -> None:
    """Reconstruct the other groups and the images left over, in folders; remove those that are gone."""
    run, folder, places = state.run, state.run.directory.path, dict[int, str]()
    camera = _focals(state)
    pending = deque[tuple[Sequence[int], F64 | None]]((views, None) for views in state.groups[1:])
    pending.extend((views, camera) for views in groups_left_over(state))
    while pending:
        (views, focals), name = pending.popleft(), f"group-{len(run.groups) + 2}"
        part = _run_group(state, name, views, focals, steps, surface_required)
        pending.extend(([views[k] for k in rest], camera) for rest in groups_left_over(part))
        if (model := part.result.best_reconstruction) is not None:
            places |= {i: name for i, there in zip(views, model.registered, strict=True) if there}
    for number in count(len(run.groups) + 2):
        if not (folder / f"group-{number}" / RESULT_FILES[0]).exists():
            break
        RunDirectory(folder / f"group-{number}").remove(RESULT_FILES)
    if run.groups:
        here = state.result.best_reconstruction
        registered = 0 if here is None else int(here.registered.sum())
        none = len(state.names) - registered - len(places)
        others = ", ".join(f"{group['registered']} in {group['folder']}" for group in run.groups)
        others += f", {none} in none" if none else ""
        models = Notice("several-models", len(run.groups) + 1)
        run.warnings.append(Notice("sizes-of-models", models, counted(registered, "image"), others))
        state.result = _with_group_reasons(state.result, places)


def _focals(state: PipelineState) -> F64 | None:
    """Focal length and its relative standard deviation (V, 2) from a trusted model; NaN: not estimated."""
    metric, shared = state.result.metric, state.prior.group
    if metric is None or not metric.trusted:
        return None
    found = np.full((len(shared), 2), np.nan)
    for view in np.flatnonzero(metric.reconstruction.registered)[::-1]:
        focal = metric.intrinsics[view]["focal_px"]
        found[shared == shared[view]] = focal.value, focal.std / focal.value
    return found


def _run_group(
    whole: PipelineState,
    name: str,
    views: Sequence[int],
    focals: F64 | None,
    steps: Sequence[Step],
    surface_required: bool,
) -> PipelineState:
    """Reconstruct a group as a run of its own, and add its entry to the summary of the whole.

    ``focals`` (V, 2) are focal lengths that another model of the same cameras determined, and their relative
    standard deviations.
    """
    directory = RunDirectory(whole.run.directory.path / name, whole.run.directory.shared, part=True)
    run = whole.run.inside(directory)
    inputs = ImageSet(tuple(whole.inputs.decoded[i] for i in views), {})
    state = PipelineState(run, inputs, empty_result(run, inputs), whole.until, views=views)
    state.focals = None if focals is None else focals[list(views)]
    identity = identity_of(run, inputs)
    with directory.claim(identity, overwrite=True):
        directory.adopt(identity, overwrite=True, results=RESULT_FILES)
        take_group(whole, views, state)
        failure = _failure_of(state, steps, surface_required=surface_required)
        state.prepared = None
        state.result = write_outputs(run, state.result, until=state.until, failure=failure)
    facts = {fact: state.result.summary[fact] for fact in ("images", "registered", "trusted", "failure")}
    model = state.result.best_reconstruction
    there = [model is not None and bool(model.registered[k]) for k in range(len(views))]
    missing = [image for image, registered in zip(state.names, there, strict=True) if not registered]
    whole.run.groups.append({"folder": name, "names": state.names, "missing": missing, **facts})
    return state


def _with_group_reasons(result: RunResult, places: Mapping[int, str]) -> RunResult:
    """The result in which the reason against each image that another model contains is that model."""

    def named(found: Reconstruction) -> Reconstruction:
        reasons = [
            Notice("other-group", places[i]) if i in places else reason
            for i, reason in enumerate(found.reasons)
        ]
        return replace(found, reasons=tuple(reasons))

    if result.projective is not None:
        result = replace(result, projective=named(result.projective))
    if result.metric is not None:
        metric = replace(result.metric, reconstruction=named(result.metric.reconstruction))
        result = replace(result, metric=metric)
    return result


def _run_all(state: PipelineState, steps: Sequence[Step], *, surface_required: bool) -> None:
    """Run the steps; a surface that fails is only a warning unless it was asked for."""
    for step in steps:
        try:
            step(state)
        except StageFailure as failure:
            if surface_required or step not in SURFACE_STEPS:
                raise
            state.run.warnings.append(Notice("no-surface", failure))
            return


def _settings_identity(run: Run, source: Source | None) -> dict[str, Any]:
    """The part of a run's identity that is known before its images are read."""
    given = {} if source is None else {"source": source}
    return {"version": 1, **given, "seed": run.seed, "settings": tables_from_config(run.config)}


def identity_of(run: Run, inputs: ImageSet, source: Source | None = None) -> dict[str, Any]:
    """Settings, seed and content of the images: runs with equal identity are the same."""
    digests = {p.image.name: p.digest for p in inputs.decoded}
    refused = {name: f"refused: {reason}" for name, reason in inputs.refused.items()}
    return _settings_identity(run, source) | {"images": digests | refused}


def empty_result(run: Run, inputs: ImageSet) -> RunResult:
    """The result before the first stage."""
    sizes = [image.original_size for image in inputs.images]
    groups = camera_numbers(sizes, run.config.intrinsics, inputs.exif_focal_px)
    settings = tables_from_config(run.config)
    return RunResult(run.directory.path, inputs.images, inputs.refused, (), (), groups, settings)
