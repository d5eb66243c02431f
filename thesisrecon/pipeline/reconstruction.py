"""Algorithm 1 of the thesis, from images to a textured model: the only place that composes all stages."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from thesisrecon._settings import tables_from_config
from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure, UsageError, counted
from thesisrecon.intrinsics import IntrinsicsOptions, camera_numbers
from thesisrecon.io._images import ImageSet, ImageSource, list_images, read_images, scene_name
from thesisrecon.matching.pair_selection import ListedPairs
from thesisrecon.pipeline._outputs import RESULT_FILES, write_outputs
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
from thesisrecon.runtime._run import Progress, Run, RunOptions, start_run

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


def reconstruct(
    images: ImageSource,
    out: str | Path,
    *,
    config: PipelineConfig | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    **options: Unpack[RunOptions],
) -> RunResult:
    """Reconstruct metric cameras, points and a textured model from images of one scene.

    Parameters
    ----------
    images : path, or sequence of path, ndarray (H, W) or (H, W, 3) uint8, or Image
        A folder, or the images.
    out : path
        Output folder: created if missing, resumed if it holds the same run.
    config : PipelineConfig, optional
        Settings; None: the preset ``default``.
    seed : int
        Random seed, at least 0. The same images, settings and seed give the same bytes for any number of
        workers.
    progress : callable, optional
        Called with (stage, done, total).
    **options
        ``until``: last stage, "features", "matches", "projective", "metric", "dense" or "model" (by default
        "model", where a surface that fails is only a warning); ``threads``: number of workers;
        ``executor``: "local" (threads), "processes", "dask://HOST:PORT" (needs the extra ``distributed``) or
        a :class:`concurrent.futures.Executor`; ``overwrite``: replace another run in the output folder;
        ``shared``: folder in which runs share cached results of stages.

    Returns
    -------
    RunResult
        All results, as written to ``out``. The scale of a reconstruction is arbitrary.

    Raises
    ------
    UsageError
        If there are no images, the output folder cannot be used, or the workers are lost.
    StageFailure
        If the images cannot be reconstructed; intermediate results, summary and report are in ``out``.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> from thesisrecon import reconstruct
    >>> rng = np.random.default_rng(0)
    >>> images = [rng.integers(0, 256, (96, 128, 3), dtype=np.uint8) for _ in range(2)]
    >>> with TemporaryDirectory() as out:
    ...     result = reconstruct(images, out, until="features")
    >>> len(result.features), result.failure
    (2, '')
    """
    until, run, overwrite = start_run(out, config or PipelineConfig(), seed, progress, options)
    if isinstance(images, str | Path):
        if not list_images(Path(images)):
            raise UsageError(f"there are no images in {images} (subfolders are not searched)")
        run.title = scene_name(Path(images)) or run.title
    # Claim the folder first: reading images takes long.
    surface_required = options.get("until") is not None
    with claimed(run, overwrite=overwrite):
        inputs = _read_inputs(run, images)
        pairs = run.config.pairs
        if isinstance(pairs, ListedPairs) and until != "features" and len(inputs.images) >= 2:
            # Checked before the folder is adopted: the same run can then be resumed with a corrected list.
            pairs.check([image.name for image in inputs.images], inputs.refused)
        state = PipelineState(run, inputs, empty_result(run, inputs), until)
        run.directory.adopt(identity_of(run, inputs), overwrite=overwrite, results=RESULT_FILES)
        return run_steps(state, STEPS[until], surface_required=surface_required)


@contextmanager
def claimed(run: Run, *, overwrite: bool) -> Iterator[None]:
    """Hold the workers and the output folder of a run."""
    claim = run.directory.claim(_settings_identity(run), overwrite=overwrite)
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


def _read_inputs(run: Run, images: ImageSource) -> ImageSet:
    with run.clock("images"):
        size = run.config.images.max_size_px
        inputs = read_images(images, max_size_px=size, map_all=run.workers.map_all)
    found, refused = len(inputs.decoded), len(inputs.refused)
    if found + refused == 0:
        raise UsageError("no images")
    warnings = [f"{p.image.name}: {p.note}" for p in inputs.decoded if p.note]
    warnings += [f"{name} is left out: it {reason}" for name, reason in inputs.refused.items()]
    warnings += _exif_warnings(run.config.intrinsics, inputs.exif_focal_px)
    run.finish("images", counts={"read": found, "refused": refused}, warnings=warnings)
    return inputs


def _exif_warnings(options: IntrinsicsOptions, exif_focal_px: F64) -> list[str]:
    """A warning about requested EXIF focal lengths that are missing."""
    missing, total = int((~np.isfinite(exif_focal_px)).sum()), len(exif_focal_px)
    if not options.exif or options.focal_px is not None or not missing:
        return []
    # A known focal that is estimated instead must be reported.
    instead = ": it is estimated instead, one value per camera (constant)"
    rest = instead if options.focal == "known" else ""
    if missing == total:
        found = f"No EXIF focal length was found in {counted(total, 'image')}"
        return [f"{found}{rest or ': no focal prior is used'}"]
    return [f"{missing} of the {total} images have no EXIF focal length{rest or ' and no focal prior'}"]


def _settings_identity(run: Run) -> dict[str, Any]:
    """The part of a run's identity that is known before its images are read."""
    return {"version": 1, "seed": run.seed, "settings": tables_from_config(run.config)}


def identity_of(run: Run, inputs: ImageSet) -> dict[str, Any]:
    """Settings, seed and content of the images: runs with equal identity are the same."""
    digests = {p.image.name: p.digest for p in inputs.decoded}
    refused = {name: f"refused: {reason}" for name, reason in inputs.refused.items()}
    return _settings_identity(run) | {"images": digests | refused}


def empty_result(run: Run, inputs: ImageSet) -> RunResult:
    sizes = [image.original_size for image in inputs.images]
    groups = camera_numbers(sizes, run.config.intrinsics, inputs.exif_focal_px)
    settings = tables_from_config(run.config)
    return RunResult(run.directory.path, inputs.images, inputs.refused, (), (), groups, settings)
