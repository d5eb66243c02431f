"""One run as a sequence of steps: its folder, its identity, its failures and its outputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from thesisrecon._settings import tables_from_config
from thesisrecon.errors import StageFailure
from thesisrecon.intrinsics import camera_numbers
from thesisrecon.io._images import ImageSet
from thesisrecon.pipeline._outputs import write_outputs
from thesisrecon.pipeline._stages import (
    build_model,
    build_tracks,
    estimate_depth_maps,
    find_features,
    match_pairs,
    reconstruct_metric,
    reconstruct_projective,
    select_pairs,
)
from thesisrecon.pipeline._state import PipelineState, name_images
from thesisrecon.results import RunResult
from thesisrecon.runtime._precompilation import precompile
from thesisrecon.runtime._run import Run

STEPS = {
    "features": (find_features,),
    "matches": (find_features, select_pairs, match_pairs),
    "projective": (find_features, select_pairs, match_pairs, build_tracks, reconstruct_projective),
    "metric": (find_features, select_pairs, match_pairs, build_tracks, reconstruct_metric),
}
"""Algorithm 1: the steps up to each last stage."""
SURFACE_STEPS = (estimate_depth_maps, build_model)
STEPS["dense"] = (*STEPS["metric"], *SURFACE_STEPS[:1])
STEPS["model"] = (*STEPS["metric"], *SURFACE_STEPS)

Source = Mapping[str, str]
"""Name and digest of the matches or tracks that a run starts from."""


@contextmanager
def claimed(run: Run, *, overwrite: bool, source: Source | None = None) -> Iterator[None]:
    """Hold the workers and the output folder of a run."""
    claim = run.directory.claim(_settings_identity(run, source), overwrite=overwrite)
    with run.workers, claim, run.resumable():
        yield


def run_steps(
    state: PipelineState, steps: Sequence[Callable[[PipelineState], None]], *, surface_required: bool
) -> RunResult:
    """Run the steps and write the outputs, of a failed run too."""
    run = state.run
    try:
        state.require_images()
        precompile(state.until, run.workers.threads, run.progress)
        _run_all(state, steps, surface_required=surface_required)
    except StageFailure as error:
        parts = (error.reason, error.evidence, error.advice)
        failure = StageFailure(*(name_images(part, state.names) for part in parts))
        write_outputs(run, state.result, until=state.until, failure=failure)
        raise failure from None
    return write_outputs(run, state.result, until=state.until, failure=None)


def _run_all(
    state: PipelineState, steps: Sequence[Callable[[PipelineState], None]], *, surface_required: bool
) -> None:
    """Run the steps; a surface that fails is only a warning unless it was asked for."""
    for step in steps:
        try:
            step(state)
        except StageFailure as failure:
            if surface_required or step not in SURFACE_STEPS:
                raise
            state.run.warnings.append(f"No surface model was built: {failure}")
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
