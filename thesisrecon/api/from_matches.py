"""Reconstruction from corners, matches or tracks of other programs: Algorithm 1 from chapter 5 on."""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Unpack

import numpy as np

from thesisrecon.api.given import Model, as_sparse_model
from thesisrecon.arrays import F64, I64
from thesisrecon.config.text import Config, Settings, build_config
from thesisrecon.errors import UsageError
from thesisrecon.io._colmap import read_database
from thesisrecon.io._images import USELESS_MASKS, add_masks, check_masks_folder, images_folder
from thesisrecon.matching.tracks import AlignedTracks, PlainTracks
from thesisrecon.pipeline import inputs
from thesisrecon.pipeline.algorithm1 import claimed, run_adopted
from thesisrecon.pipeline.run import Job, Progress, RunOptions, start_run
from thesisrecon.records import Tracks
from thesisrecon.results import RunResult
from thesisrecon.runtime._run_folder import key_of


class GivenOptions(RunOptions, total=False):
    """Options of the functions of this module: those of :func:`reconstruct` except ``pairs``."""

    config: Config | None
    seed: int
    progress: Progress | None
    masks: str | Path | None
    preset: str | None
    max_size: int | None
    cameras: str | None
    set: Settings


def reconstruct_from_matches(
    keypoints: Sequence[F64] | None, matches: Mapping[tuple[int, int], inputs.PairMatches],
    sizes: Sequence[tuple[int, int]] | I64, out: str | Path | None = None, *,
    names: Sequence[str] | None = None, images: str | Path | Sequence[Any] | None = None,
    **options: Unpack[GivenOptions],
) -> RunResult:  # fmt: skip
    """Reconstruct metric cameras and points from matches of any program.

    The matches are verified (chapter 5), joined to tracks and used like those of thesisrecon's matching.

    Parameters
    ----------
    keypoints : sequence of V ndarray (N_i, 2), or None
        Positions in pixels of the images, (0, 0) = centre of the top-left pixel; None if all matches are
        positions.
    matches : mapping
        (i, j) -> (M, 2) rows of ``keypoints[i]`` and ``keypoints[j]``; or a pair of (M, 2) positions in
        images i and j, which are joined to tracks where they lie within a pixel of each other.
    sizes : array_like (V, 2)
        Width and height of the images.
    out : path, optional
        Output folder, as for :func:`reconstruct`; None: no files are kept.
    names : sequence of V str, optional
        Names of the images; by default "image-0" and so on.
    images : path, or sequence of V path, array or Image, optional
        The images, for colours, depth maps and the textured model: a folder with files of these names, or the
        images in the order of the keypoints.
    **options
        As for :func:`reconstruct`: ``config``, ``seed``, ``progress``, ``preset``, ``max_size``, ``cameras``,
        ``set``, ``masks`` (matches in masked pixels are dropped), ``until`` ("metric" without images),
        ``threads``, ``executor``, ``overwrite``, ``shared``.

    Returns
    -------
    RunResult
        As of :func:`reconstruct`.

    Raises
    ------
    UsageError, StageFailure
        If the input contradicts itself; if it cannot be reconstructed.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from thesisrecon import Camera, reconstruct_from_matches
    >>> rng = np.random.default_rng(0)
    >>> K = np.array([[900.0, 0, 319.5], [0, 900, 239.5], [0, 0, 1]])
    >>> angles = np.radians([[0, -30, 5], [25, -15, 0], [-5, 0, 20], [15, 15, 0], [-20, 25, 5]])
    >>> X = rng.uniform(-1, 1, (200, 3))
    >>> R = Rotation.from_euler("xyz", angles).as_matrix()
    >>> cameras = [Camera(K, r, np.array([0, 0, 6.0]), (640, 480)) for r in R]
    >>> keypoints = [camera.project(X) + rng.normal(0, 0.3, (200, 2)) for camera in cameras]
    >>> same = np.column_stack([np.arange(200), np.arange(200)])
    >>> pairs = {(i, j): same for i in range(5) for j in range(i + 1, 5)}
    >>> result = reconstruct_from_matches(keypoints, pairs, [(640, 480)] * 5)
    >>> bool(abs(result.cameras[0].K[0, 0] - 900) < 5 * result.cameras[0].std["focal_px"])
    True
    """
    views = inputs.views_of(sizes, names, images)
    given = inputs.given_matches(keypoints, matches, views)
    return _reconstruct("the given matches", given, views, out, options)


def reconstruct_from_tracks(
    tracks: Tracks | F64, sizes: Sequence[tuple[int, int]] | I64, out: str | Path | None = None, *,
    names: Sequence[str] | None = None, images: str | Path | Sequence[Any] | None = None,
    **options: Unpack[GivenOptions],
) -> RunResult:  # fmt: skip
    """Reconstruct metric cameras and points from tracks of any program (chapters 6 and 7; HZ 10, 19).

    Parameters
    ----------
    tracks : Tracks or ndarray (V, N, 2)
        Observations in pixels of the images; in an array NaN where a point is not seen. They may contain
        outliers: pairs of images are verified by the points that they share.
    sizes, out, names, images, **options
        As for :func:`reconstruct_from_matches`.

    Returns
    -------
    RunResult
        As of :func:`reconstruct`.

    Raises
    ------
    UsageError, StageFailure
        If the input contradicts itself; if it cannot be reconstructed.

    Examples
    --------
    ``keypoints`` as in the example of `thesisrecon.reconstruct_from_matches`:

    >>> import numpy as np
    >>> from thesisrecon import reconstruct_from_tracks
    >>> result = reconstruct_from_tracks(np.stack(keypoints), [(640, 480)] * 5)
    >>> bool(abs(result.cameras[0].K[0, 0] - 900) < 5 * result.cameras[0].std["focal_px"])
    True
    """
    views = inputs.views_of(sizes, names, images)
    given = inputs.given_tracks(tracks, views)
    return _reconstruct("the given tracks", given, views, out, options)


def reconstruct_from_colmap(
    path: Model, out: str | Path | None = None, *, images: str | Path | Sequence[Any] | None = None,
    **options: Unpack[GivenOptions],
) -> RunResult:  # fmt: skip
    """Reconstruct metric cameras and points from a COLMAP database or sparse model.

    Nothing of its calibration and poses is used (COLMAP: Schönberger and Frahm, CVPR 2016).

    Parameters
    ----------
    path : path, or model in memory
        A database with keypoints and matches (the verified matches, or the raw ones if there are none), or a
        folder with a sparse model of any kind of camera, binary or text, whose tracks are used; or a
        ``pycolmap.Reconstruction`` or another model with observations.
    out, images, **options
        As for :func:`reconstruct_from_matches`; ``images`` is the folder of COLMAP's images,
        which are used as stored, without EXIF rotation.

    Returns
    -------
    RunResult
        As of :func:`reconstruct`.

    Raises
    ------
    UsageError, StageFailure
        If there is no database or model; if it cannot be reconstructed.

    Examples
    --------
    ``result`` as in the example of `thesisrecon.reconstruct_from_matches`; its sparse model is calibrated
    again, from its tracks alone:

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from thesisrecon import reconstruct_from_colmap, save
    >>> with TemporaryDirectory() as out:
    ...     save(result, out)
    ...     again = reconstruct_from_colmap(Path(out) / "sparse" / "0")
    >>> abs(round(float(again.cameras[0].K[0, 0] / result.cameras[0].K[0, 0] - 1), 2))
    0.0
    """
    name = str(path) if isinstance(path, str | PathLike) else f"the given {type(path).__name__}"
    if isinstance(path, str | PathLike) and not Path(path).is_dir():
        database = read_database(Path(path))
        views = inputs.views_of(database.sizes, database.names, images, as_stored=True)
        given = inputs.given_matches(database.keypoints, database.matches, views)
    else:
        model = as_sparse_model(path, "the model of reconstruct_from_colmap")
        if any(view.size is None for view in model.views) or not len(model.xy):
            raise UsageError(f"{name} holds no observations of points; give a COLMAP model or a database")
        order = np.lexsort((model.view_index, model.point_index))
        view, point = model.view_index[order], model.point_index[order]
        tracks = Tracks(view, point, model.xy[order], len(model.views), len(model.X))
        sizes = [view.size for view in model.views if view.size is not None]
        views = inputs.views_of(sizes, model.names, images, as_stored=model.as_stored)
        given = inputs.given_tracks(tracks, views)
    return _reconstruct(name, given, views, out, options)


def _reconstruct(
    name: str, given: inputs.Given, views: inputs.Views, out: str | Path | None, options: Mapping[str, Any],
) -> RunResult:  # fmt: skip
    options = dict(options)
    chosen = {name: options.pop(name, None) for name in ("preset", "max_size", "cameras")}
    config = build_config(options.pop("config", None), **chosen, settings=options.pop("set", ()))
    masks = options.pop("masks", None)
    if isinstance(config.tracks, AlignedTracks):
        # There are no prepared images to align the observations with.
        config = replace(config, tracks=PlainTracks())
    seed, progress = options.pop("seed", 0), options.pop("progress", None)
    with TemporaryDirectory() if out is None else nullcontext(out) as folder:
        until, run, overwrite = start_run(folder, config, seed, progress, options)
        run.as_stored = views.as_stored
        requested = options.get("until") is not None
        if views.images is None:
            if requested and until in ("dense", "model"):
                raise UsageError(f"until = {until!r} needs the images; give images, or until = 'metric'")
            until = "metric" if until == "model" else until
        else:
            run.images_folder = images_folder(views.images)
        if masks is not None:
            run.masks_folder = check_masks_folder(masks, run.images_folder)
        matches = [[m.i, m.j, m.xy1, m.xy2] for m in given.matches]
        content = [views.names, views.sizes, given.corners, matches]
        source = {"name": name, "digest": key_of(content)}
        with claimed(run, overwrite=overwrite, source=source):
            with run.clock("images"):
                digests = [key_of(views.names[i], views.sizes[i], xy) for i, xy in enumerate(given.corners)]
                read, warnings = views.read(run, digests), list[str]()
                if masks is not None:
                    read, warnings = add_masks(
                        read, Path(masks), as_stored=views.as_stored, map_all=run.workers.map_all
                    )
                    if all(image.mask is None for image in read.images):
                        warnings.append(USELESS_MASKS)
                given = inputs.outside_masks(inputs.at_working_size(given, read.images), read.images)
            run.finish("images", counts={"read": len(digests), "refused": 0}, warnings=warnings)
            job = Job(run, read, given, until, requested)
            found = run_adopted(job, overwrite=overwrite, source=source)
        return found if out is not None else _without_folder(found)


def _without_folder(found: RunResult) -> RunResult:
    """The result with all depth maps in memory, as its folder is removed."""
    further = tuple(_without_folder(model) for model in found.further_models)
    return replace(found, out=None, depth_maps=list(found.depth_maps), further_models=further)
