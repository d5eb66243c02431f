"""Algorithm 1 of the thesis, from photographs to a textured model: the only place that composes stages."""

from __future__ import annotations

from pathlib import Path
from typing import Unpack

from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.io.images import ImageSource, list_images, scene_name
from thesisrecon.pipeline.cameras import reconstruct_metric, reconstruct_projective
from thesisrecon.pipeline.features_to_tracks import (
    build_tracks,
    choose_pairs,
    find_features,
    match_pairs,
)
from thesisrecon.pipeline.inputs import check_pairs, empty_result, identity, read_set, wishes
from thesisrecon.pipeline.outputs import RESULT_FILES, write_outputs
from thesisrecon.pipeline.state import Work
from thesisrecon.pipeline.surface import build_model, match_densely
from thesisrecon.records import RunResult
from thesisrecon.runtime.run import Progress, RunOptions, start_run

STEPS = {
    "features": (find_features,),
    "matches": (find_features, choose_pairs, match_pairs),
    "projective": (find_features, choose_pairs, match_pairs, build_tracks, reconstruct_projective),
    "metric": (find_features, choose_pairs, match_pairs, build_tracks, reconstruct_metric),
}
SURFACE_STEPS = (match_densely, build_model)
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
    """Reconstruct metric cameras, points and a textured model from photographs of one scene.

    Parameters
    ----------
    images : a folder, or a sequence of files, uint8 arrays (H, W) or (H, W, 3), or :class:`Image` records.
    out : the output folder; made where absent, resumed where it holds the same run.
    config : what runs; the preset ``default`` where None.
    seed : of all random steps, at least 0. The same photographs, config and seed give the same bytes,
        whatever the number of workers.
    progress : hears (stage, done, total) as parts of stages are done.
    **options : see :class:`RunOptions`.

    Returns
    -------
    RunResult : everything that was found, as it also stands in ``out``. The length unit of a reconstruction
        is free: photographs do not tell it.

    Raises
    ------
    UsageError : no such folder of photographs, no photographs in it, an output folder that cannot be
        written or holds another run, workers that cannot be reached or are lost (:class:`WorkersLost`).
    StageFailure : these photographs cannot be reconstructed. What was computed, the summary and the page are
        in ``out`` all the same.
    """
    until, run, overwrite = start_run(out, config or PipelineConfig(), seed, progress, options)
    if isinstance(images, str | Path):
        if not list_images(Path(images)):
            raise UsageError(f"there are no photographs in {images} (folders in it are not searched)")
        run.title = scene_name(Path(images)) or run.title
    # Reading photographs takes long: whether the folder is free for this run is asked before.
    claim = run.directory.claimed(wishes(run), overwrite=overwrite)
    with run.workers, claim, run.kept_in_folder():
        photographs = read_set(run, images)
        check_pairs(run, photographs, until)
        run.directory.adopt(identity(run, photographs), overwrite=overwrite, results=RESULT_FILES)
        work = Work(run, photographs, empty_result(run, photographs), until)
        try:
            work.check_photographs()
            _take_steps(work, surface_asked=options.get("until") is not None)
        except StageFailure as failure:
            write_outputs(run, work.result, until=until, failure=failure)
            raise
        return write_outputs(run, work.result, until=until, failure=None)


def _take_steps(work: Work, *, surface_asked: bool) -> None:
    """Cameras and points are a result by themselves: only who asks for a surface is refused without it."""
    for step in STEPS[work.until]:
        try:
            step(work)
        except StageFailure as failure:
            if surface_asked or step not in SURFACE_STEPS:
                raise
            work.run.warnings.append(f"No surface model was built: {failure}")
            return
