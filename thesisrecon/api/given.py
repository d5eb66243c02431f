"""Cameras and models as they are given to calls: records, arrays, runs, folders and models of pycolmap."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from thesisrecon.arrays import F64, I64, numbers, require_shapes, sizes_of_images
from thesisrecon.camera import Camera, camera_of_row
from thesisrecon.errors import Notice, UsageError, in_words
from thesisrecon.geometry.camera_matrix import pose_of_camera
from thesisrecon.io._files import require_image_name
from thesisrecon.io._images import ImageSet
from thesisrecon.io._models import read_model
from thesisrecon.lens import BASE, simplest_row
from thesisrecon.metric.given_cameras import GivenCameras
from thesisrecon.records import Reconstruction
from thesisrecon.results import RunResult, SparseModel, SparseView
from thesisrecon.runtime._run_folder import key_of

Model = str | Path | SparseModel | RunResult | Reconstruction | Mapping[str, Camera] | Sequence[Camera]
"""A model in memory or a folder; what has the interface of ``pycolmap.Reconstruction`` is one, too."""
CameraInput = Model | tuple[F64, F64, F64]
"""Cameras in the order of the images or by image name, (K, R, t), a metric reconstruction, or a model."""


def as_sparse_model(model: Model, what: str = "a model") -> SparseModel:
    """Return the sparse model, ``what`` it is in messages, of anything that holds cameras: see ``Model``.

    Cameras without names are called image-0 and so on. A run without cameras and anything else are a
    ``UsageError``.
    """
    if isinstance(model, SparseModel):
        return model
    if isinstance(model, str | PathLike):
        return read_model(model)
    if isinstance(model, Mapping) or (isinstance(model, list | tuple) and len(model)):
        return _model_of_cameras(model)
    if isinstance(model, Reconstruction):
        X, view, point, xy = points_of_reconstruction(model)
        views = _model_of_cameras(as_cameras("a model", model)).views
        return SparseModel(views, X, view_index=view, point_index=point, xy=xy)
    if _is_of_pycolmap(model):
        with TemporaryDirectory() as folder:
            try:
                model.write(folder)  # type: ignore[union-attr]
            except Exception as error:
                raise UsageError(f"{what}, a {type(model).__name__}, cannot be read ({error})") from None
            return read_model(folder)
    if not isinstance(model, RunResult):
        raise UsageError(Notice("no-model", what, in_words(model), type(model).__name__))
    # Imported on use: models in memory need no stages.
    from thesisrecon.pipeline.outputs import folder_with, save_result

    if (out := folder_with(model)) is not None:
        return read_model(out)
    if model.metric is None:
        raise UsageError("the result has no cameras; it ended before the metric stage")
    with TemporaryDirectory() as folder:
        save_result(replace(model, mesh=None), Path(folder), overwrite=False)
        return read_model(folder)


def _is_of_pycolmap(model: object) -> bool:
    """Whether an object has the interface of ``pycolmap.Reconstruction``, which is not imported for it."""
    return all(hasattr(model, name) for name in ("cameras", "images", "points3D", "write"))


def _model_of_cameras(cameras: Mapping[str, Camera] | Sequence[Camera]) -> SparseModel:
    """The model of cameras alone; those with equal intrinsics have one number."""
    if not isinstance(cameras, Mapping):
        width = len(str(len(cameras) - 1))
        cameras = {f"image-{i:0{width}d}": camera for i, camera in enumerate(cameras)}
    for name, camera in cameras.items():
        if not isinstance(camera, Camera):
            raise UsageError(Notice("no-camera-in-model", name, type(camera).__name__))
        require_image_name(name, "a model of cameras")
    numbers_of: dict[bytes, int] = {}
    views = []
    for name, one in cameras.items():
        lens = simplest_row(one.lens, np.zeros(1) if one.distortion is None else one.distortion)
        key = np.concatenate([one.K.ravel(), one.size, lens]).tobytes()
        number = numbers_of.setdefault(key, len(numbers_of))
        views.append(SparseView(name, one.R, one.t, one.K, one.size, lens, number, one.std))
    stored = {camera.as_stored for camera in cameras.values()}
    if len(stored) > 1:
        raise UsageError("a model needs cameras that are all as_stored, or none; some of these are")
    return SparseModel(views, as_stored=stored == {True})


def known_by_name(caller: str, known: Model, until: str) -> Mapping[str, Camera]:
    """The cameras that a run is given; ``until`` is its last stage."""
    if until == "projective":
        raise UsageError('known cameras leave no projective stage; use until="metric"')
    cameras: Mapping[str, Camera] = named_cameras(as_sparse_model(known, "the known cameras"))
    if not cameras:
        raise UsageError(f"{caller} got no known cameras; the model has none")
    return cameras


def source_of_known(cameras: Mapping[str, Camera], refine: bool) -> dict[str, str]:
    """What identifies the known cameras of a run."""
    facts = [(n, c.K, c.R, c.t, c.size, c.lens_row, c.std) for n, c in sorted(cameras.items())]
    return {"name": "known cameras", "digest": key_of(facts, refine)}


def given_cameras(
    cameras: Mapping[str, Camera], inputs: ImageSet, *, refine: bool, of_images: bool = False
) -> GivenCameras:
    """The known cameras of the images that were read; UsageError if they do not fit.

    ``of_images``: they were estimated from these images.
    """
    found = [cameras.get(image.name) for image in inputs.images]
    if not any(found) and inputs.images:
        raise UsageError(Notice("no-known-camera", inputs.images[0].name, next(iter(cameras))))
    for image, camera in zip(inputs.images, found, strict=True):
        if camera is not None and camera.size != image.original_size:
            sizes = "{} x {} pixels, its known camera {} x {}".format(*image.original_size, *camera.size)
            raise UsageError(f"{image.name} has {sizes}; scale the camera (Camera.scaled) to the image")
    return GivenCameras.of(found, inputs.images, refine=refine, of_images=of_images)


def cameras_of_model(model: SparseModel, path: object) -> dict[str, Camera]:
    """The cameras of a model by name; UsageError, with its path, if one is incomplete."""
    cameras = {}
    for view in model.views:
        if view.K is None or view.size is None:
            raise UsageError(f"{path} gives {view.name} no intrinsics, or no width and height")
        if view.distortion is None:
            raise UsageError(Notice("unknown-lens", path, view.name))
        pose = view.K, view.R, view.t
        cameras[view.name] = camera_of_row(
            pose, view.size, view.distortion, std=view.std, as_stored=model.as_stored
        )
    return cameras


def as_cameras(
    caller: str, cameras: CameraInput, sizes: I64 | None = None, names: Sequence[str] = ()
) -> list[Camera]:
    """The cameras in order; the registered ones of a reconstruction; of a mapping those of ``names``."""
    if isinstance(cameras, Reconstruction):
        return _registered_cameras(caller, cameras)
    cameras = named_cameras(cameras)
    if isinstance(cameras, Mapping):
        if not cameras:
            raise ValueError(f"{caller} needs cameras; the model has none")
        missing = [name for name in names if name not in cameras]
        if missing:
            first = next(iter(cameras), None)
            raise ValueError(f"{caller} got no camera for {missing[0]}; the first camera is that of {first}")
        for name, camera in cameras.items():
            if not isinstance(camera, Camera):
                raise ValueError(Notice("no-camera-by-name", caller, name, type(camera).__name__))
        return [cameras[name] for name in names or cameras]
    given: list[Any] = list(cameras) if isinstance(cameras, Sequence) else []
    if given and all(isinstance(one, Camera) for one in given):
        return given
    if len(given) != 3 or any(isinstance(one, Camera | str) for one in given):
        raise ValueError(Notice("no-camera-input", caller, type(cameras).__name__))
    if sizes is None:
        raise ValueError(f"{caller} needs sizes (V, 2) or (2,), width and height, with (K, R, t)")
    K, R, t = calibrated_arrays(caller, *given)
    return [Camera(*one) for one in zip(K, R, t, checked_sizes(caller, sizes, len(R)), strict=True)]


def named_cameras(cameras: Any) -> Any:
    """The cameras by name of a run, a folder or a model of other kinds; anything else as it is."""
    if isinstance(cameras, RunResult):
        if cameras.metric is None:
            raise UsageError("the result has no cameras; it ended before the metric stage")
        return cameras.cameras
    if isinstance(cameras, str | PathLike | SparseModel) or _is_of_pycolmap(cameras):
        source = cameras if isinstance(cameras, str | PathLike) else "the model"
        return cameras_of_model(as_sparse_model(cameras), source)
    return cameras


def _registered_cameras(caller: str, r: Reconstruction) -> list[Camera]:
    if r.stratum != "metric" or r.K is None:
        raise ValueError(f"{caller} needs a metric reconstruction with K; got {r.stratum}")
    lenses = np.zeros((len(r.P), 3)) if r.distortion is None else r.distortion
    views = []
    for i in np.flatnonzero(r.registered):
        pose = r.K[i], *pose_of_camera(r.K[i], r.P[i])
        views.append(camera_of_row(pose, tuple(r.sizes[i].tolist()), lenses[i]))
    return views


def points_of_reconstruction(r: Reconstruction) -> tuple[F64, I64, I64, F64]:
    """Valid points (N, 3), and view, point and pixels of the inlier observations in registered views."""
    tracks, used = r.tracks, r.used
    view, point = np.cumsum(r.registered) - 1, np.cumsum(r.valid) - 1
    X = np.asarray(r.X[r.valid, :3] / r.X[r.valid, 3:])
    return X, view[tracks.view_index[used]], point[tracks.point_index[used]], tracks.xy[used]


def lens_table(caller: str, views: Sequence[Camera], width: int) -> F64:
    """Rows (V, C) of the lenses of cameras, of ``width`` columns or seven: k1 to k4, p1, p2 and the base.

    ``ValueError`` if a lens has other coefficients that are not 0.
    """
    rows = [simplest_row(view.lens, np.zeros(0) if (k := view.distortion) is None else k) for view in views]
    for row, view in zip(rows, views, strict=True):
        if np.any(row[BASE + 1 :]):
            raise ValueError(f"{caller} takes lenses with k1 to k4, p1 and p2; got one that is {view.lens}")
    wide = max(width, *(BASE + 1 if len(row) > 3 else 3 for row in rows))
    return np.array([np.append(row, np.zeros(wide))[:wide] for row in rows])


def calibrated_arrays(caller: str, K: F64, R: F64, t: F64) -> tuple[F64, F64, F64]:
    """K (V, 3, 3), also of one camera, R (V, 3, 3) and t (V, 3)."""
    K, R, t = numbers(caller, K=K, R=R, t=t)
    K = np.broadcast_to(K, (len(R), 3, 3)) if K.shape == (3, 3) else K
    require_shapes(caller, K=(K, ("V", 3, 3)), R=(R, ("V", 3, 3)), t=(t, ("V", 3)))
    return K, R, t


def checked_sizes(caller: str, sizes: Any, n: int) -> I64:
    """Image sizes (n, 2) of (n, 2) or (2,) whole numbers above 0."""
    (given,) = numbers(caller, sizes=sizes_of_images(sizes))
    if given.shape not in ((2,), (n, 2)):
        raise ValueError(f"{caller} needs sizes (V, 2) or (2,), width and height; got {given.shape}, V = {n}")
    if not (np.isfinite(given).all() and (given >= 1).all() and (given == np.round(given)).all()):
        raise ValueError(f"{caller} needs sizes of whole numbers above 0; got {given.tolist()}")
    return np.broadcast_to(given, (n, 2)).astype(np.int64)
