"""COLMAP from images to cameras.

SIFT, exhaustive matching and mapping (Schönberger and Frahm, CVPR 2016; Pan et al., ECCV 2024) without
priors: EXIF focal lengths are replaced by COLMAP's default, 1.2 times the long side. Models come back in our
types.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.camera import compose_camera, project_camera
from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.io._files import write_text
from thesisrecon.io._models import read_model
from thesisrecon.lens import stacked_rows
from thesisrecon.records import Reconstruction, Tracks
from validation.references.libraries import load, pycolmap
from validation.runs.processes import timed


def read_colmap_model(folder: Path, names: Sequence[str]) -> Reconstruction:
    """Read a COLMAP model as a metric reconstruction in the pixels of its images, which ``names`` number. All
    points are valid and all observations inliers. ``sigma_px`` is 1.4826 times the median absolute coordinate
    residual. UsageError for missing or damaged files and for lenses of an unknown kind.
    """
    model = read_model(folder)
    unknown = sorted(set(model.names) - set(names))
    if unknown:
        raise ValueError(f"names must hold each image once; missing: {unknown[:3]}")
    V, N = len(names), len(model.X)
    K, rows, P = np.zeros((V, 3, 3)), [np.zeros(3)] * V, np.zeros((V, 3, 4))
    sizes, registered = np.zeros((V, 2), np.int64), np.isin(names, model.names)
    index = np.array([names.index(name) for name in model.names], np.int64)
    residual = np.zeros((len(model.xy), 2))
    for k, (i, view) in enumerate(zip(index.tolist(), model.views, strict=True)):
        if view.K is None or view.distortion is None or view.size is None:
            raise UsageError(f"the camera of {view.name} has a lens of an unknown kind")
        K[i], rows[i], sizes[i] = view.K, view.distortion, view.size
        P[i] = compose_camera(view.K, view.R, view.t)
        here = model.view_index == k
        # Points may lie in a camera's principal plane, or so far away that squares overflow.
        with np.errstate(all="ignore"):
            X = model.X[model.point_index[here]]
            seen = project_camera(view.K, view.R, view.t, X, distortion=view.distortion)
            residual[here] = np.abs(seen - model.xy[here])
    residual, distortion = residual[np.isfinite(residual)], stacked_rows(rows)
    order = np.lexsort((index[model.view_index], model.point_index))
    view_index, point_index = index[model.view_index][order], model.point_index[order]
    sigma_px = 1.4826 * float(np.median(residual)) if len(residual) else 0.0
    reasons = tuple("" if there else "not in the COLMAP model" for there in registered)
    tracks, X = Tracks(view_index, point_index, model.xy[order], V, N), np.column_stack([model.X, np.ones(N)])
    valid, inlier = np.ones(N, dtype=np.bool_), np.ones(len(order), dtype=np.bool_)
    given = (P, X, registered, valid, inlier, tracks, sizes, sigma_px, reasons)
    return Reconstruction("metric", *given, K=K, distortion=distortion)


def principal_points_by_pycolmap(folder: Path, names: Sequence[str]) -> F64:
    """Return the principal points (V, 2) of a model as pycolmap reads them, NaN without a camera; (0, 0) is
    the centre of the top-left pixel, which COLMAP puts at (0.5, 0.5). It shares no code with our files.
    """
    model = pycolmap.Reconstruction(str(folder))
    xy = np.full((len(names), 2), np.nan)
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        xy[list(names).index(image.name)] = camera.principal_point_x, camera.principal_point_y
    return xy - 0.5


def match_with_pycolmap(
    images: Path, out: Path, *, threads: int = 2, pairs: Path | None = None,
    camera: tuple[str, Sequence[float]] | None = None,
) -> dict[str, float]:  # fmt: skip
    """SIFT and matching of all pairs, or of a list, with their verification; the seconds of both. ``camera``:
    COLMAP's camera model and its parameters; without it COLMAP guesses.
    """
    _begin(out)
    database, seconds, start = out / "database.db", {}, time.perf_counter()

    mode, reader = pycolmap.CameraMode.SINGLE, pycolmap.ImageReaderOptions()
    if camera is not None:
        reader.camera_model, reader.camera_params = camera[0], ", ".join(map(str, camera[1]))
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False)
    pycolmap.extract_features(
        database, images, camera_mode=mode, extraction_options=extraction, device=pycolmap.Device.cpu,
        reader_options=reader,
    )  # fmt: skip
    if camera is None:
        _guess_focals(database)
    seconds["extract"], start = time.perf_counter() - start, time.perf_counter()

    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    if pairs is None:
        pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
    else:
        listed = pycolmap.ImportedPairingOptions(match_list_path=str(pairs))
        pycolmap.match_image_pairs(
            database, matching_options=matching, pairing_options=listed, device=pycolmap.Device.cpu
        )
    seconds["match"] = time.perf_counter() - start
    write_text(out / "seconds.json", json.dumps(seconds))
    return seconds


def _begin(out: Path) -> None:
    """Empty the folder and seed COLMAP, which then reports errors only."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    pycolmap.set_random_seed(0)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value


def _guess_focals(database: Path) -> None:
    store = pycolmap.Database.open(database)
    for camera in store.read_all_cameras():
        guess = 1.2 * max(camera.width, camera.height)
        camera.params = [guess, *camera.params[1:]]
        camera.has_prior_focal_length = False
        store.update_camera(camera)
    store.close()


def _change_lens(database: Path, lens: str) -> None:
    store = pycolmap.Database.open(database)
    for camera in store.read_all_cameras():
        focal = camera.mean_focal_length()
        other = pycolmap.Camera.create_from_model_name(
            camera.camera_id, lens, focal, camera.width, camera.height
        )
        other.has_prior_focal_length = camera.has_prior_focal_length
        store.update_camera(other)
    store.close()


def map_with_pycolmap(
    images: Path, out: Path, *, matched: Path | None = None, refine_principal_point: bool = False,
    fixed: bool = False, threads: int = 2, mapper: Literal["incremental", "global"] = "incremental",
    lens: str = "", seed: int = 0,
) -> None:  # fmt: skip
    """Map the matches of ``match_with_pycolmap`` in ``out`` or ``matched``, for :func:`read_run`; ``fixed``
    intrinsics stay, and ``lens`` is another camera model. The global mapper calibrates the view graph first.
    The models are not read: that would count as COLMAP's work. StageFailure without a model.
    """
    if matched is not None:
        if not (matched / "seconds.json").is_file():
            raise StageFailure("COLMAP left no matches to start from")
        _begin(out)
        shutil.copy(matched / "database.db", out / "database.db")
    seconds = json.loads(((matched or out) / "seconds.json").read_text(encoding="utf-8"))
    pycolmap.set_random_seed(seed)
    paths, begun = (out / "database.db", images, out / "sparse"), time.perf_counter()
    if lens:
        _change_lens(paths[0], lens)
    if mapper == "global":
        paths[2].mkdir(exist_ok=True)
        if not fixed:
            pycolmap.calibrate_view_graph(paths[0])
        all_at_once = pycolmap.GlobalPipelineOptions(num_threads=threads, random_seed=seed)
        adjustment = all_at_once.mapper.bundle_adjustment
        adjustment.refine_principal_point = refine_principal_point and not fixed
        adjustment.refine_focal_length = adjustment.refine_extra_params = not fixed
        pycolmap.global_mapping(*paths, all_at_once)
    else:
        options = pycolmap.IncrementalPipelineOptions(num_threads=threads, random_seed=seed)
        options.mapper.num_threads = threads
        options.ba_refine_principal_point = refine_principal_point and not fixed
        options.ba_refine_focal_length = options.ba_refine_extra_params = not fixed
        pycolmap.incremental_mapping(*paths, options)
    seconds["map"] = time.perf_counter() - begun
    write_text(out / "seconds.json", json.dumps(seconds))
    _model_folders(out)


def read_run(images: Path, out: Path) -> tuple[Reconstruction, dict[str, float]]:
    """Return the largest model in ``out``, its views in the order of the images, and the seconds of
    "extract", "match" and "map"; :class:`StageFailure` without a model.
    """
    names = sorted(path.name for path in images.iterdir() if path.is_file())
    models = [read_colmap_model(path, names) for path in _model_folders(out)]
    seconds: dict[str, float] = json.loads((out / "seconds.json").read_text(encoding="utf-8"))
    return max(models, key=lambda model: model.registered.sum()), seconds


def _model_folders(out: Path) -> list[Path]:
    folders = sorted(path for path in (out / "sparse").glob("*") if path.is_dir())
    if not folders:
        raise StageFailure("COLMAP made no model of these images")
    return folders


def map_and_read(images: Path, out: Path, **options: Any) -> Reconstruction | None:
    """The model of :func:`map_with_pycolmap`, None without one."""
    try:
        map_with_pycolmap(images, out, **options)
        return read_run(images, out)[0]
    except StageFailure:
        return None


def reconstruct_with_pycolmap(
    images: str | Path, out: str | Path, pairs: str | Path | None = None, threads: int = 2,
    refine_principal_point: bool = False,
) -> tuple[float, float]:  # fmt: skip
    """Match (all pairs or a list) and map a folder of images on the CPU; ``out`` is emptied first. Return
    the wall and the processor seconds, without the import of COLMAP.
    """
    load("pycolmap")
    given = Path(images), Path(out)

    def work() -> None:
        match_with_pycolmap(*given, threads=threads, pairs=None if pairs is None else Path(pairs))
        map_with_pycolmap(*given, threads=threads, refine_principal_point=refine_principal_point)

    return timed(work)[1:]
