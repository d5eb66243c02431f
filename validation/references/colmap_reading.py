"""COLMAP sparse models as our reconstructions: half pixels, quaternions and numbers from 1 converted.

Binary models are read here, so that our own results need no reference library; pycolmap converts text.
"""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import compose_camera, project_camera
from thesisrecon.io._files import read_bytes
from thesisrecon.records import Reconstruction, Tracks
from validation.references.libraries import pycolmap

_Row: TypeAlias = tuple[Any, ...]
_NEEDED = ("cameras", "images", "points3D")
_MAX_BYTES = 2**32
_POINT_2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
# Camera model -> number of parameters, and the places of fx, fy, cx, cy, k1, k2, k3; the others must be 0.
_MODELS = {
    0: (3, (0, 0, 1, 2)), 1: (4, (0, 1, 2, 3)), 2: (4, (0, 0, 1, 2, 3)), 3: (5, (0, 0, 1, 2, 3, 4)),
    4: (8, (0, 1, 2, 3, 4, 5)), 6: (12, (0, 1, 2, 3, 4, 5, 8)),
}  # fmt: skip


def read_colmap_model(folder: Path, names: Sequence[str]) -> Reconstruction:
    """Read a COLMAP model as a metric reconstruction in the pixels of its images.

    ``names`` number the views; those without an image are not registered. All points are valid and all
    observations inliers; of two observations of a point in an image the first is used. ``sigma_px`` is 1.4826
    times the median absolute coordinate residual. Raises StageFailure for missing or damaged files and for
    cameras other than pinholes with three radial coefficients, ``ValueError`` for an image not in ``names``.
    """
    files = [folder / f"{name}.bin" for name in _NEEDED]
    if not all(file.is_file() for file in files):
        if not all(file.with_suffix(".txt").is_file() for file in files):
            raise StageFailure(
                f"{folder} holds no COLMAP model",
                "it must contain cameras, images and points3D, all .bin or all .txt",
                "give the folder of these files, often called sparse/0",
            )
        with tempfile.TemporaryDirectory() as place:
            try:
                pycolmap.Reconstruction(folder).write_binary(place)
            except (ValueError, RuntimeError) as error:
                raise StageFailure(f"{folder} is not a valid COLMAP model", str(error)) from error
            return read_colmap_model(Path(place), names)
    cameras, images, points = (_parsed(file) for file in files)
    return _reconstruction(cameras, images, points, names)


def _parsed(file: Path) -> list[_Row]:
    """The records of a file; the list at the end of a record is its last field."""
    parse = {"cameras": _camera, "images": _image, "points3D": _point}[file.stem]
    try:
        data = read_bytes(file, largest=_MAX_BYTES)
        (count,), at, records = struct.unpack_from("<Q", data), 8, []
        for _ in range(count):
            record, at = parse(data, at)
            records.append(record)
        if at != len(data):
            raise ValueError(f"its records need {at} bytes, not {len(data)}")
    except (struct.error, ValueError, OverflowError, OSError) as error:
        raise StageFailure(
            f"{file} is not a valid COLMAP file", f"it cannot be parsed: {error}", "export the model again"
        ) from error
    return records


def _camera(data: bytes, at: int) -> tuple[_Row, int]:
    number, kind, width, height = struct.unpack_from("<IiQQ", data, at)
    advice = ("only three radial coefficients are supported", "undistort the images")
    if kind not in _MODELS:
        raise StageFailure(f"camera {number} of the COLMAP model has the model number {kind}", *advice)
    count, places = _MODELS[kind]
    params = np.array(struct.unpack_from(f"<{count}d", data, at + 24))
    if np.delete(params, places).any():
        raise StageFailure(f"camera {number} of the COLMAP model has other distortion", *advice)
    if not (np.isfinite(params).all() and params[places[:2],].min() > 0.0):
        raise ValueError("a focal length is not positive, or a parameter not finite")
    fx, fy, cx, cy, *k = params[places,]
    K = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
    return (number, K, np.array([*k, 0.0, 0.0, 0.0][:3]), (width, height)), at + 24 + 8 * count


def _image(data: bytes, at: int) -> tuple[_Row, int]:
    _, *pose, camera = struct.unpack_from("<I7dI", data, at)
    at, end = at + 64, data.index(b"\0", at + 64)
    (count,) = struct.unpack_from("<Q", data, end + 1)
    seen = np.frombuffer(data, _POINT_2D, count, end + 9) if count else np.empty(0, _POINT_2D)
    name = data[at:end].decode("utf-8", "surrogateescape")
    return (camera, name, np.array(pose), seen), end + 9 + _POINT_2D.itemsize * count


def _point(data: bytes, at: int) -> tuple[_Row, int]:
    number, *xyz, _, _, _, _, length = struct.unpack_from("<Q3d3BdQ", data, at)
    return (number, xyz), at + 51 + 8 * length


def _reconstruction(
    cameras: list[_Row], images: list[_Row], points: list[_Row], names: Sequence[str]
) -> Reconstruction:
    known, found = {number: rest for number, *rest in cameras}, [name for _, name, _, _ in images]
    unknown = sorted(set(found) - set(names))
    if unknown or len(set(found)) < len(found):
        raise ValueError(f"names must hold each image once; missing or repeated: {(unknown or found)[:3]}")
    V = len(names)
    K, distortion, P = np.zeros((V, 3, 3)), np.zeros((V, 3)), np.zeros((V, 3, 4))
    sizes, registered = np.zeros((V, 2), np.int64), np.isin(names, found)
    xyz = np.array([xyz for _, xyz in points]).reshape(-1, 3)
    tracks = _tracks(images, np.array([number for number, _ in points], np.int64), names)
    residual = np.zeros((len(tracks.xy), 2))
    for camera, name, pose, _ in images:
        if camera not in known:
            raise StageFailure(f"image {name!r} of the COLMAP model refers to a missing camera")
        i = names.index(name)
        K[i], distortion[i], sizes[i] = known[camera]
        R = Rotation.from_quat(np.roll(pose[:4], -1)).as_matrix()
        P[i] = compose_camera(K[i], R, pose[4:])
        here = tracks.view_index == i
        # Points may lie in a camera's principal plane, or so far away that squares overflow.
        with np.errstate(all="ignore"):
            X = xyz[tracks.point_index[here]]
            seen = project_camera(K[i], R, pose[4:], X, distortion=distortion[i])
            residual[here] = np.abs(seen - tracks.xy[here])
    residual = residual[np.isfinite(residual)]
    return Reconstruction(
        stratum="metric",
        P=P,
        X=np.column_stack([xyz, np.ones(len(xyz))]),
        registered=registered,
        valid=np.ones(len(xyz), dtype=np.bool_),
        inlier=np.ones(len(tracks.xy), dtype=np.bool_),
        tracks=tracks,
        sizes=sizes,
        sigma_px=1.4826 * float(np.median(residual)) if len(residual) else 0.0,
        reasons=tuple("" if there else "not in the COLMAP model" for there in registered),
        K=K,
        distortion=distortion,
    )


def _tracks(images: list[_Row], ids: I64, names: Sequence[str]) -> Tracks:
    order = np.argsort(ids, kind="stable")
    views, points = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    xy: list[F64] = [np.zeros((0, 2))]
    for _, name, _, seen in images:
        seen = seen[seen["point"] >= 0]
        if not np.isin(seen["point"], ids).all():
            raise StageFailure(f"image {name!r} of the COLMAP model refers to a missing point")
        place = order[np.searchsorted(ids[order], seen["point"])]
        views.append(np.full(len(place), names.index(name)))
        points.append(place)
        xy.append(seen["xy"] - 0.5)
    view, point = np.concatenate(views), np.concatenate(points)
    _, first = np.unique(point * len(names) + view, return_index=True)
    return Tracks(view[first], point[first], np.concatenate(xy)[first], len(names), len(ids))
