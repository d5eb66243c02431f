"""COLMAP databases, and sparse models of any camera kind, in our conventions; see ``_colmap_writing.py``."""

from __future__ import annotations

import math
import sqlite3
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
import scipy

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import UsageError
from thesisrecon.io._colmap_writing import PIXEL_CENTRE, POINT_2D
from thesisrecon.io._files import read_bytes
from thesisrecon.sparse_model import SparseModel, SparseView

_FILES = ("cameras", "images", "points3D")
_MAX_BYTES = 2**32
_MAX_IMAGES = 2**31 - 1
"""COLMAP numbers the pair of images a < b as a times this plus b."""
_NO_POINT = str(2**64 - 1)
_KINDS = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4), ("DIVISION", 5), ("SIMPLE_FISHEYE", 3), ("FISHEYE", 4), ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
)  # fmt: skip
"""Camera models by number: name and number of parameters."""
_RADIAL = {
    "SIMPLE_PINHOLE": (), "PINHOLE": (), "SIMPLE_RADIAL": (3,), "RADIAL": (3, 4), "OPENCV": (4, 5),
    "FULL_OPENCV": (4, 5, 8),
}  # fmt: skip
"""Places of k1, k2, k3 among the parameters; the further ones must be zero."""
_Row = TypeVar("_Row")


class _Camera(NamedTuple):
    number: int
    kind: str
    size: tuple[int, int]
    params: F64


class _Image(NamedTuple):
    camera: int
    name: str
    pose: F64  #: quaternion w, x, y, z and translation, world to camera
    xy: F64
    point: I64


class _Point(NamedTuple):
    number: int
    xyz: Sequence[float]
    rgb: bytes


def is_colmap_model(folder: Path) -> bool:
    """Return whether a folder holds cameras, images and points3D, all ``.bin`` or all ``.txt``."""
    return any(all((folder / (name + kind)).is_file() for name in _FILES) for kind in (".bin", ".txt"))


def read_colmap_model(folder: Path) -> SparseModel:
    """Read a COLMAP model, binary rather than text; UsageError if it is damaged.

    The poses are those of the images; rigs and frames are not read. Of two observations of a point in an
    image the first is kept. Views have no K if their camera has no focal length (EQUIRECTANGULAR).
    """
    binary = all((folder / f"{name}.bin").is_file() for name in _FILES)
    kind, parsers = (".bin", _BINARY) if binary else (".txt", _TEXT)
    cameras, images, points = (_parsed(folder / (name + kind), parsers[name]) for name in _FILES)
    known = {camera.number: camera for camera in cameras}
    ids = np.array([point.number for point in points], np.int64)
    view, point, xy = _observations(images, ids)
    X = np.array([point.xyz for point in points], np.float64).reshape(-1, 3)
    if not (np.isfinite(X).all() and np.isfinite(xy).all()):
        raise UsageError(f"the COLMAP model in {folder} has coordinates that are not finite; export it again")
    colors = np.frombuffer(b"".join(point.rgb for point in points), np.uint8).reshape(-1, 3)
    views = [_view(image, known) for image in images]
    return SparseModel(views, X, colors, view, point, xy, as_stored=True)


def _parsed(file: Path, parse: Callable[[bytes], Iterator[Any]]) -> list[Any]:
    try:
        return list(parse(read_bytes(file, largest=_MAX_BYTES)))
    except (struct.error, ValueError, OverflowError, IndexError, OSError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise UsageError(
            f"{file} is not a valid COLMAP file; it cannot be parsed: {reason}; export the model again"
        ) from None


def _camera(number: int, kind: int, size: tuple[int, int], params: Sequence[float]) -> _Camera:
    name, count = _KINDS[kind] if 0 <= kind < len(_KINDS) else ("", 0)
    if not (len(params) == count > 0 and min(size) > 0 and np.isfinite(params).all() and params[0] > 0.0):
        raise ValueError(f"camera {number} is of an unknown kind, or its parameters are invalid")
    return _Camera(number, name, size, np.array(params, np.float64))


def _image(camera: int, name: str, pose: Sequence[float], xy: F64, point: I64) -> _Image:
    if not (np.isfinite(pose).all() and 1e-9 < math.hypot(*pose[:4]) < 1e9):
        raise ValueError(f"image {name!r} has no valid pose")
    return _Image(camera, name, np.array(pose, np.float64), xy, point)


def _binary(parse: Callable[[bytes, int], tuple[_Row, int]], data: bytes) -> Iterator[_Row]:
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        record, at = parse(data, at)
        yield record
    if at != len(data):
        raise ValueError(f"its records need {at} bytes, not {len(data)}")


def _binary_camera(data: bytes, at: int) -> tuple[_Camera, int]:
    number, kind, width, height = struct.unpack_from("<IiQQ", data, at)
    count = _KINDS[kind][1] if 0 <= kind < len(_KINDS) else 0
    params = struct.unpack_from(f"<{count}d", data, at + 24)
    return _camera(number, kind, (width, height), params), at + 24 + 8 * count


def _binary_image(data: bytes, at: int) -> tuple[_Image, int]:
    _, *pose, camera = struct.unpack_from("<I7dI", data, at)
    at, end = at + 64, data.index(b"\0", at + 64)
    (count,) = struct.unpack_from("<Q", data, end + 1)
    seen = np.frombuffer(data, POINT_2D, count, end + 9) if count else np.empty(0, POINT_2D)
    name = data[at:end].decode("utf-8", "surrogateescape")
    return _image(camera, name, pose, seen["xy"], seen["point"]), end + 9 + POINT_2D.itemsize * count


def _binary_point(data: bytes, at: int) -> tuple[_Point, int]:
    number, x, y, z, rgb, _, length = struct.unpack_from("<q3d3sdQ", data, at)
    return _Point(number, (x, y, z), rgb), at + 51 + 8 * length


def _lines(data: bytes) -> Iterator[str]:
    return (line for line in data.decode("utf-8", "surrogateescape").split("\n") if line[:1] != "#")


def _text_cameras(data: bytes) -> Iterator[_Camera]:
    kinds = [name for name, _ in _KINDS]
    for words in filter(None, map(str.split, _lines(data))):
        params = [float(word) for word in words[4:]]
        yield _camera(int(words[0]), kinds.index(words[1]), (int(words[2]), int(words[3])), params)


def _text_images(data: bytes) -> Iterator[_Image]:
    lines = _lines(data)
    for line in filter(str.strip, lines):
        _, *pose, camera, name = line.strip().split(maxsplit=9)
        # The line of observations is empty if there are none.
        words = next(lines, "").split()
        if len(words) % 3:
            raise ValueError(f"image {name!r} needs three numbers per observation")
        xy = np.array([words[0::3], words[1::3]]).T.astype(np.float64)
        point = np.array([-1 if word == _NO_POINT else int(word) for word in words[2::3]], np.int64)
        yield _image(int(camera), name, [float(word) for word in pose], xy, point)


def _text_points(data: bytes) -> Iterator[_Point]:
    for words in filter(None, map(str.split, _lines(data))):
        x, y, z = (float(word) for word in words[1:4])
        r, g, b = (int(word) for word in words[4:7])
        yield _Point(int(np.int64(words[0])), (x, y, z), bytes([r, g, b]))


_Parsers: TypeAlias = dict[str, Callable[[bytes], Iterator[Any]]]
_BINARY: _Parsers = {
    "cameras": partial(_binary, _binary_camera),
    "images": partial(_binary, _binary_image),
    "points3D": partial(_binary, _binary_point),
}
_TEXT: _Parsers = {"cameras": _text_cameras, "images": _text_images, "points3D": _text_points}


def _view(image: _Image, cameras: dict[int, _Camera]) -> SparseView:
    if image.camera not in cameras:
        raise UsageError(f"image {image.name!r} of the COLMAP model refers to a missing camera")
    _, kind, size, params = cameras[image.camera]
    K = distortion = None
    if kind != "EQUIRECTANGULAR":
        # The last focal length, of one or two.
        focal = 0 if kind.startswith(("SIMPLE_", "RADIAL")) else 1
        K = np.diag([params[0], params[focal], 1.0])
        K[:2, 2] = params[focal + 1 : focal + 3] - PIXEL_CENTRE
        places = _RADIAL.get(kind)
        if places is not None and not np.delete(params, places)[focal + 3 :].any():
            distortion = np.array([*params[list(places)], 0.0, 0.0, 0.0][:3])
    R = scipy.spatial.transform.Rotation.from_quat(np.roll(image.pose[:4], -1)).as_matrix()
    return SparseView(image.name, R, image.pose[4:], K, size, distortion, image.camera)


def _observations(images: Sequence[_Image], ids: I64) -> tuple[I64, I64, F64]:
    """View, point and pixel of the observations of points, sorted by point, then view."""
    order = np.argsort(ids, kind="stable")
    views, points, xy = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros((0, 2))]
    for i, image in enumerate(images):
        seen = image.point >= 0
        if not np.isin(image.point[seen], ids).all():
            raise UsageError(f"image {image.name!r} of the COLMAP model refers to a missing point")
        points.append(order[np.searchsorted(ids[order], image.point[seen])])
        views.append(np.full(len(points[-1]), i))
        xy.append(image.xy[seen] - PIXEL_CENTRE)
    view, point = np.concatenate(views), np.concatenate(points)
    _, first = np.unique(point * len(images) + view, return_index=True)
    return view[first], point[first], np.concatenate(xy)[first]


@dataclass(frozen=True)
class Database:
    """V images by name: sizes (V, 2), keypoints (N_i, 2) in our pixels, and matches (i, j) -> rows (M, 2)."""

    names: list[str]
    sizes: I64
    keypoints: Sequence[F64]
    matches: dict[tuple[int, int], I64]


def read_database(path: Path) -> Database:
    """Read the keypoints and the verified matches, or the raw matches if none are verified."""
    if not path.is_file():
        raise UsageError(f"there is no COLMAP database or model at {path}")
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as base:
            return _read_tables(base, path)
    except (sqlite3.Error, ValueError, TypeError, KeyError) as error:
        raise UsageError(f"{path} is not a COLMAP database: {error}") from None


def _read_tables(base: sqlite3.Connection, path: Path) -> Database:
    columns = "SELECT image_id, name, width, height FROM images JOIN cameras USING (camera_id) ORDER BY name"
    images = base.execute(columns).fetchall()
    number = {row[0]: i for i, row in enumerate(images)}
    keypoints = [np.zeros((0, 2)) for _ in images]
    for image, rows, cols, data in base.execute("SELECT image_id, rows, cols, data FROM keypoints"):
        if rows and image in number:
            values = np.frombuffer(data, dtype="<f4").reshape(rows, cols)[:, :2]
            keypoints[number[image]] = values.astype(np.float64) - PIXEL_CENTRE
    for table in ("two_view_geometries", "matches"):
        found: dict[tuple[int, int], I64] = {}
        for pair, rows, data in base.execute(f"SELECT pair_id, rows, data FROM {table} WHERE rows > 0"):
            i, j = (number[image] for image in divmod(pair, _MAX_IMAGES))
            found[i, j] = np.frombuffer(data, dtype="<u4").reshape(rows, 2).astype(np.int64)
        if found:
            sizes = np.array([row[2:] for row in images], dtype=np.int64)
            return Database([row[1] for row in images], sizes, keypoints, found)
    raise UsageError(f"{path} holds no matches; run COLMAP's matcher first")
