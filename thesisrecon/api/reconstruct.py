"""Algorithm 1 of the thesis: from images to cameras, points and a textured model."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from thesisrecon.api.given import Model, given_cameras, known_by_name, source_of_known
from thesisrecon.arrays import F64
from thesisrecon.config.intrinsics import IntrinsicsOptions
from thesisrecon.config.text import Config, Pairs, Settings, build_config
from thesisrecon.errors import Notice, UsageError, counted
from thesisrecon.io import _images
from thesisrecon.io._frames import FrameSource
from thesisrecon.matching.pair_selection import ListedPairs
from thesisrecon.pipeline.algorithm1 import claimed, run_adopted
from thesisrecon.pipeline.matching import FromImages
from thesisrecon.pipeline.run import Job, Progress, Run, RunOptions, start_run
from thesisrecon.results import RunResult


def reconstruct(
    images: _images.ImageSource, out: str | Path, *, config: Config | None = None, preset: str | None = None,
    max_size: int | None = None, cameras: str | None = None, pairs: Pairs | None = None, set: Settings = (),
    masks: str | Path | None = None, every: int | None = None, known: Model | None = None,
    refine: bool = False, seed: int = 0, progress: Progress | None = None,
    **options: Unpack[RunOptions],
) -> RunResult:  # fmt: skip
    """Reconstruct metric cameras, points and a textured model from images of one scene.

    Parameters
    ----------
    images : path, or sequence of path, ndarray (H, W), (H, W, 3) or (H, W, 4) uint8, or Image
        A folder with its subfolders, or the images; with ``every`` a video (extra ``video``) or a folder of
        frames.
    out : path
        Output folder: created if missing, resumed if it holds the same run.
    config : PipelineConfig, str or path, optional
        Settings, the name of a preset, or a TOML file; None: the preset ``default``.
    preset : {"default", "thesis"}, optional
        Pipeline to start from.
    max_size : int, optional
        Long side (px) to which larger images are reduced (1600).
    cameras : {"shared", "per-size", "per-image"}, optional
        One camera for the images of one size in one folder (default), of one size in all folders, or one per
        image.
    pairs : str, path or list of (str, str), optional
        "all", "overlap", "window:N", a file of pairs, or pairs of file names.
    set : mapping or list of str
        Single settings: ``{"matching.ratio": 0.7}`` or ``["matching.ratio=0.7"]``.
    masks : path, optional
        Folder of masks: the black pixels of ``NAME.png``, or of a file like the image with any suffix, give
        no features, no depth and no texture; transparent pixels of images give none either.
    every : int, optional
        Take the sharpest of each ``every`` frames; those of a video are written to ``out/00-frames``.
    known : model, optional
        Cameras that are known before, by image name, as for :func:`thesisrecon.compare_models`: of a robot,
        of a phone, or of another program, in original pixels. The model is made in their frame and scale;
        other images are registered to them.
    refine : bool
        Adjust known cameras to the images: their poses, and the intrinsics that have a standard deviation.
    seed : int
        Random seed, at least 0. The same images, settings and seed give the same bytes for any number of
        workers.
    progress : callable, optional
        Called with (stage, done, total). By default a notebook prints one line per stage.
    **options
        ``until``: last stage, "features", "matches", "projective", "metric", "dense" or "model" (by default
        "model", where a surface that fails is only a warning); ``threads``: number of workers;
        ``executor``: "local" (threads), "processes", "dask://HOST:PORT" or "tls://HOST:PORT" (both need the
        extra ``distributed``) or a :class:`concurrent.futures.Executor`; ``overwrite``: replace another run
        in the output folder; ``shared``: folder in which runs share cached results of stages.

    Returns
    -------
    RunResult
        All results, as written to ``out``. The scale of a reconstruction is arbitrary.

    Raises
    ------
    UsageError
        If there are no images, options contradict each other, the output folder cannot be used, or the
        workers are lost.
    StageFailure
        If the images cannot be reconstructed; intermediate results, summary and report are in ``out``.

    Notes
    -----
    The steps of Algorithm 1 of the thesis (section 1.4) stand in order in
    ``thesisrecon.pipeline.algorithm1``.

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
    chosen = build_config(
        config, preset=preset, max_size=max_size, cameras=cameras, pairs=pairs, settings=set
    )
    until, run, overwrite = start_run(out, chosen, seed, progress, options)
    frames = None if every is None else _frame_source(images, every, run)
    if isinstance(images, str | Path):
        if Path(images).is_file() and frames is None:
            raise UsageError(Notice("file-of-images", images))
    else:
        images = _images.list_of_images("reconstruct", images)
    run.images_folder = _images.images_folder(images) if frames is None else frames.home(run.directory.path)
    source: Any = frames or images
    if source is not frames and isinstance(images, str | Path):
        source = _images.files_by_name(images, run.directory.path, masks)
        if not source:
            raise UsageError(f"there are no images in {images} and its subfolders")
        if len(folders := Counter(Path(name).parent.as_posix() for name in source)) > 1:
            run.warnings.append(Notice("subfolders", ", ".join(f"{n} ({k})" for n, k in folders.items())))
    if isinstance(images, str | Path):
        run.title = _images.scene_name(Path(images)) or run.title
    if masks is not None:
        run.masks_folder = _images.check_masks_folder(masks, run.images_folder)
    cameras_known = None if known is None else known_by_name("reconstruct", known, until)
    run.as_stored = cameras_known is not None and any(c.as_stored for c in cameras_known.values())
    # Claim the folder first: reading images takes long.
    surface_required = options.get("until") is not None
    identity = None if frames is None else frames.identity
    identity = identity if cameras_known is None else source_of_known(cameras_known, refine)
    with claimed(run, overwrite=overwrite, source=identity):
        inputs = _read_inputs(run, source, None if masks is None else Path(masks))
        listed = run.config.pairs
        if isinstance(listed, ListedPairs) and until != "features" and len(inputs.images) >= 2:
            # Checked before the folder is adopted: the same run can then be resumed with a corrected list.
            listed.check([image.name for image in inputs.images], inputs.refused)
        given = None if cameras_known is None else given_cameras(cameras_known, inputs, refine=refine)
        job = Job(run, inputs, FromImages(), until, surface_required, given=given)
        return run_adopted(job, overwrite=overwrite, source=identity)


def _frame_source(images: _images.ImageSource, every: int, run: Run) -> FrameSource:
    if not isinstance(images, str | Path):
        raise UsageError("every needs a video or a folder of frames, not a list of images")
    if isinstance(run.config.pairs, ListedPairs):
        raise UsageError(Notice("pairs-of-frames"))
    return FrameSource(Path(images), every)


def _read_inputs(run: Run, images: Any, masks: Path | None) -> _images.ImageSet:
    """Read images: a :class:`FrameSource`, a list, or files by name."""
    warnings: list[str] = []
    counts: dict[str, int] = {}
    with run.clock("images"):
        if isinstance(images, FrameSource):
            images, counts["frames"], warnings = images.choose(
                run.directory.path, run.workers.threads, run.workers.map_all, run.progress
            )
        size = run.config.images.max_size_px
        inputs = _images.read_images(
            images, max_size_px=size, as_stored=run.as_stored, map_all=run.workers.map_all
        )
        unused: list[str] = []
        if masks is not None:
            inputs, unused = _images.add_masks(inputs, masks, map_all=run.workers.map_all)
        given = sum(image.mask is not None for image in inputs.images)
        static: list[str] = []
        if run.config.images.static == "mask":
            inputs, static = _images.mask_static(inputs, map_all=run.workers.map_all)
    found, refused = len(inputs.decoded), len(inputs.refused)
    if found + refused == 0:
        raise UsageError("the list of images is empty")
    warnings += [f"{p.image.name}: {p.note}" for p in inputs.decoded if p.note]
    warnings += _refusals(inputs.refused)
    # The masks of frames that were not chosen are no mistake.
    warnings += unused if not counts else []
    warnings += _exif_warnings(run.config.intrinsics, inputs.exif_focal_px)
    warnings += static
    masked = sum(image.mask is not None for image in inputs.images)
    warnings += [_images.USELESS_MASKS] if masks is not None and inputs.images and not given else []
    counts |= {"read": found, "refused": refused} | ({"masked": masked} if masked else {})
    run.finish("images", counts=counts, warnings=warnings)
    return inputs


def _refusals(refused: Mapping[str, str]) -> list[str]:
    """A warning about each file that is left out, and one about more than five of the same reason."""
    names: dict[str, list[str]] = {}
    for name, reason in refused.items():
        names.setdefault(reason, []).append(name)
    found: list[str] = []
    for reason, files in names.items():
        if len(files) > 5:
            found.append(Notice("files-left-out", files[0], len(files) - 1, reason))
        else:
            found += [Notice("image-left-out", name, reason) for name in files]
    return found


def _exif_warnings(options: IntrinsicsOptions, exif_focal_px: F64) -> list[str]:
    """A warning about requested EXIF focal lengths that are missing."""
    missing, total = int((~np.isfinite(exif_focal_px)).sum()), len(exif_focal_px)
    if not options.exif or options.focal_px is not None or not missing:
        return []
    # A known focal that is estimated instead must be reported.
    instead = ": it is estimated instead, one value per camera (constant)"
    rest = instead if options.focal == "known" else ""
    if missing == total:
        return [Notice("no-exif-focal", counted(total, "image"), rest or ": no focal prior is used")]
    return [Notice("missing-exif-focal", missing, total, rest or " and no focal prior")]
