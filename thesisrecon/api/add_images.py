"""Images beside a finished run: added to its model, or only localised in it."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from thesisrecon.api.export import recorded, recorded_images
from thesisrecon.api.given import given_cameras, known_by_name, source_of_known
from thesisrecon.api.models import load
from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.camera import Camera
from thesisrecon.config.text import build_config
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.io import _images
from thesisrecon.matching.pair_selection import PairsOfAdded
from thesisrecon.pipeline.algorithm1 import algorithm1, claimed, empty_result, last_result, run_adopted
from thesisrecon.pipeline.matching import FromImages, ImageInput
from thesisrecon.pipeline.outputs import CONFIG
from thesisrecon.pipeline.run import Job, Progress, Run, RunOptions, name_images, start_run
from thesisrecon.results import RunResult
from thesisrecon.runtime._blas import one_blas_thread


def reconstruct_with_cameras(
    images: _images.ImageSource, cameras: Any, out: str | Path, *, refine: bool = False, **options: Any
) -> RunResult:
    """Reconstruct a scene from images whose cameras are known (of a robot, a rig, a phone).

    Images are matched, points triangulated, and the surface is made in the frame and scale of the cameras.

    Parameters
    ----------
    images : path, or sequence of path, ndarray or Image
        As for :func:`thesisrecon.reconstruct`.
    cameras : path, RunResult, mapping of str to Camera, or model
        Cameras by image name, as for :func:`thesisrecon.compare_models`, in original pixels. Images without
        one are registered to the others.
    out : path
        Output folder.
    refine : bool
        Adjust the cameras to the images: their poses, and the intrinsics with a standard deviation
        (``Camera.std``), under it.
    **options
        As for :func:`thesisrecon.reconstruct`.

    Returns
    -------
    RunResult
        ``result.metric.failed_checks`` says if the cameras are less exact than the matches.

    Raises
    ------
    UsageError, StageFailure
        If no image has a camera, or sizes differ; if the matches contradict the cameras.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> from thesisrecon import Camera, reconstruct_with_cameras
    >>> rng = np.random.default_rng(0)
    >>> images = [rng.integers(0, 256, (96, 128, 3), dtype=np.uint8) for _ in range(2)]
    >>> K = np.array([[120.0, 0, 63.5], [0, 120, 47.5], [0, 0, 1]])
    >>> known = {f"image-{i}": Camera(K, np.eye(3), np.array([-i, 0, 0]), (128, 96)) for i in range(2)}
    >>> with TemporaryDirectory() as out:
    ...     len(reconstruct_with_cameras(images, known, out, until="features").features)
    2
    """
    return reconstruct(images, out, known=cameras, refine=refine, **options)


def add_images(
    run: RunResult | str | Path, images: _images.ImageSource, *, refine: bool = False,
    progress: Progress | None = None, **options: Unpack[RunOptions],
) -> RunResult:  # fmt: skip
    """Register more images into the model of a finished run.

    The cameras of the run keep their poses and intrinsics, so that its frame and scale stay. The new images
    are matched with those of the run, resected and adjusted. The folder of the run then holds all images; if
    the call is interrupted, repeat it.

    Parameters
    ----------
    run : RunResult or path
        A finished run with cameras, whose folder and images are where they were.
    images : path, or sequence of path, ndarray or Image
        The new images. Those that the run has already are left out.
    refine : bool
        Adjust all cameras together then, and move them back into the old frame by a similarity.
    progress, **options
        As for :func:`thesisrecon.reconstruct`; ``until`` None: the last stage of the run.

    Returns
    -------
    RunResult
        Of all images; those that could not be added are in ``refused``.

    Raises
    ------
    UsageError, StageFailure
        If the run has no cameras, its images are not found, or a new image has the name of another one.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import UsageError, add_images
    >>> try:
    ...     add_images("/no/run", [np.zeros((96, 128, 3), dtype=np.uint8)])
    ... except UsageError as error:
    ...     print(error)
    /no/run holds no summary.json and run.json; no run has finished in this folder
    """
    with _job_with_more("add_images", run, images, refine, progress, options) as (job, source):
        return run_adopted(job, overwrite=False, source=source)


@one_blas_thread()
def localize(run: RunResult | str | Path, image: ImageInput, **options: Unpack[RunOptions]) -> Camera:
    """Find the camera of one image in the model of a finished run, which does not change.

    Parameters
    ----------
    run : RunResult or path
        A finished run with cameras, whose folder and images are where they were.
    image : path, ndarray (H, W, 3) uint8, or Image
        The image. One of the size of those of the run is taken to be of the same camera.
    **options
        ``threads``, ``executor`` as for :func:`thesisrecon.reconstruct`.

    Returns
    -------
    Camera
        In the frame of the run, with ``std`` of its pose. If the points that it sees leave another pose
        possible, as those of a small or distant plane do, ``std`` contains the difference, and a
        ``UserWarning`` names it.

    Raises
    ------
    StageFailure
        If the image sees too little of the model.

    Examples
    --------
    >>> from thesisrecon import UsageError, localize
    >>> try:
    ...     localize("/no/run", "image.jpg")
    ... except UsageError as error:
    ...     print(error)
    /no/run holds no summary.json and run.json; no run has finished in this folder
    """
    given = RunOptions(**{**options, "until": "metric"})
    with _job_with_more("localize", run, [image], False, None, given, trial=True) as (job, _):
        # Another run of the same images may have its result.
        found, failure = last_result(algorithm1(job), empty_result(job.run, job.inputs))
        if failure is not None:
            raise failure
        added = job.names[-1]
        if added not in found.cameras:
            raise StageFailure.of("not-localised", added, found.refused[added])
        assert found.metric is not None
        for text in found.metric.warnings:
            if getattr(text, "code", "") == "competing-pose":
                warnings.warn(f"localize: {name_images(text, job.names)}", UserWarning, stacklevel=3)
        return found.cameras[added]


@contextmanager
def _job_with_more(
    caller: str, old: RunResult | str | Path, images: Any, refine: bool, progress: Progress | None,
    options: RunOptions, *, trial: bool = False,
) -> Iterator[tuple[Job, dict[str, str]]]:  # fmt: skip
    """The job of a run and more images, whose cameras the run knows; ``trial``: it writes nothing."""
    old = old if isinstance(old, RunResult) else load(old)
    if old.out is None or not (old.out / CONFIG).is_file():
        raise UsageError(f"{caller} needs a run with an output folder")
    last = options.get("until") or old.summary.get("until")
    given = RunOptions(**{**options, "until": last})
    until, run, _ = start_run(old.out, build_config(old.out / CONFIG), old.summary["seed"], progress, given)
    run.directory = replace(run.directory, trial=trial, continues=not trial)
    known = known_by_name(caller, old, until)
    run.as_stored = old.summary.get("as_stored") is True
    run.images_folder, run.masks_folder = recorded(old, "images_folder"), recorded(old, "masks_folder")
    run.world = dict(old.summary.get("world", {}))
    source = source_of_known(known, refine)
    with run.workers if trial else claimed(run, overwrite=False, source=source), run.resumable():
        inputs = _inputs(caller, run, old, images)
        cameras = given_cameras(known, inputs, refine=refine, of_images=True)
        pairs = np.array([(pair.i, pair.j) for pair in old.pairs], dtype=np.int64).reshape(-1, 2)
        front = FromImages(PairsOfAdded(pairs, len(old.images)))
        yield Job(run, inputs, front, until, options.get("until") is not None, given=cameras), source


def _inputs(caller: str, run: Run, old: RunResult, images: Any) -> _images.ImageSet:
    """The images of the run in its order, then the new ones."""
    read = partial(
        _images.read_images, max_size_px=run.config.images.max_size_px, as_stored=run.as_stored,
        map_all=run.workers.map_all,
    )  # fmt: skip
    with run.clock("images"):
        run.images_elsewhere = dict(old.summary.get("images_elsewhere", {}))
        names, records = [image.name for image in old.images], {image.name: image for image in old.images}
        known = recorded_images(old)
        files = records if known is None else dict(zip(names, _images.find_images(known, names), strict=True))
        first, more = read(files), read(images)
        order = {decoded.image.name: decoded for decoded in first.decoded}
        if lost := [name for name in names if name not in order]:
            raise UsageError(f"{caller} needs the images of the run as they were; {lost[0]} has changed")
        there = {decoded.digest for decoded in first.decoded}
        new = [decoded for decoded in more.decoded if decoded.digest not in there]
        if twice := [decoded.image.name for decoded in new if decoded.image.name in order]:
            raise UsageError(f"{twice[0]} is the name of another image of the run; rename the new one")
        inputs = _images.ImageSet((*(order[name] for name in names), *new), more.refused)
        if run.masks_folder is not None:
            inputs, _ = _images.add_masks(inputs, run.masks_folder, map_all=run.workers.map_all)
        if run.config.images.static == "mask":
            inputs, _ = _images.mask_static(inputs, map_all=run.workers.map_all)
    run.images_elsewhere |= _images.files_by_name(images)
    run.finish(
        "images", counts={"read": len(inputs.decoded), "refused": len(more.refused), "added": len(new)}
    )
    return inputs
