"""COLMAP's binary files: bytes of a model, and a model of bytes."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thesisrecon.io.colmap_model import (
    MODEL_NUMBERS,
    PARAMETER_COUNTS,
    TRACK_ENTRY,
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    broken_file,
    points_of_records,
)

_IMAGE_POINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3BdQ")
_RIG = struct.Struct("<IIiI")
_FRAME = struct.Struct("<II7dIiIQ")
_CAMERA_SENSOR = 0


def _encode_cameras(model: ColmapModel) -> bytes:
    parts = [_COUNT.pack(len(model.cameras))]
    for camera in model.cameras:
        parts.append(_CAMERA.pack(camera.camera_id, MODEL_NUMBERS[camera.model], camera.width, camera.height))
        parts.append(np.asarray(camera.params, dtype="<f8").tobytes())
    return b"".join(parts)


def _encode_images(model: ColmapModel) -> bytes:
    parts = [_COUNT.pack(len(model.images))]
    for image in model.images:
        parts.append(_IMAGE.pack(image.image_id, *image.quaternion_wxyz, *image.translation, image.camera_id))
        parts.append(image.name.encode("utf-8", "surrogateescape") + b"\0" + _COUNT.pack(len(image.xy)))
        observations = np.empty(len(image.xy), dtype=_IMAGE_POINT)
        observations["xy"], observations["point"] = image.xy, image.point_ids
        parts.append(observations.tobytes())
    return b"".join(parts)


def _encode_points(model: ColmapModel) -> bytes:
    points = model.points
    entries = np.empty(len(points.track_image), dtype=TRACK_ENTRY)
    entries["image"], entries["xy"] = points.track_image, points.track_xy
    packed, step = entries.tobytes(), TRACK_ENTRY.itemsize
    parts = [_COUNT.pack(len(points.ids))]
    starts = points.track_start.tolist()
    columns = zip(
        points.ids.tolist(), points.xyz.tolist(), points.rgb.tolist(), points.error.tolist(), strict=True
    )
    for n, (number, xyz, rgb, error) in enumerate(columns):
        parts.append(_POINT.pack(number, *xyz, *rgb, error, starts[n + 1] - starts[n]))
        parts.append(packed[starts[n] * step : starts[n + 1] * step])
    return b"".join(parts)


def _encode_rigs(model: ColmapModel) -> bytes:
    rigs = [_RIG.pack(camera.camera_id, 1, _CAMERA_SENSOR, camera.camera_id) for camera in model.cameras]
    return _COUNT.pack(len(rigs)) + b"".join(rigs)


def _encode_frames(model: ColmapModel) -> bytes:
    parts = [_COUNT.pack(len(model.images))]
    for image in model.images:
        pose = (*image.quaternion_wxyz, *image.translation)
        number, camera = image.image_id, image.camera_id
        parts.append(_FRAME.pack(number, camera, *pose, 1, _CAMERA_SENSOR, camera, number))
    return b"".join(parts)


ENCODERS: dict[str, Callable[[ColmapModel], bytes]] = {
    "rigs": _encode_rigs,
    "cameras": _encode_cameras,
    "frames": _encode_frames,
    "images": _encode_images,
    "points3D": _encode_points,
}


class _Cursor:
    """Reads forward through bytes and fails with a sentence, never past the end."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.data, self.path, self.at = data, path, 0

    def take(self, size: int) -> bytes:
        if size > len(self.data) - self.at:
            raise broken_file(self.path, f"it ends after {len(self.data)} bytes, in the middle of a record")
        self.at += size
        return self.data[self.at - size : self.at]

    def unpack(self, record: struct.Struct) -> tuple[int | float, ...]:
        return record.unpack(self.take(record.size))

    def count(self, smallest: int) -> int:
        """A count of records of at least ``smallest`` bytes each, checked before anything is allocated."""
        number = int(self.unpack(_COUNT)[0])
        if number > (len(self.data) - self.at) // smallest:
            raise broken_file(self.path, f"it claims {number} records and is too short to hold them")
        return number

    def array(self, dtype: np.dtype[np.void] | np.dtype[np.float64], count: int) -> NDArray[np.void]:
        return np.frombuffer(self.take(dtype.itemsize * count), dtype=dtype)

    def string(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise broken_file(self.path, f"it ends after {len(self.data)} bytes, in the middle of a name")
        text = self.data[self.at : end].decode("utf-8", "surrogateescape")
        self.at = end + 1
        return text

    def finish(self) -> None:
        if self.at < len(self.data):
            raise broken_file(self.path, f"{len(self.data) - self.at} bytes follow after its last record")


def read_cameras(data: bytes, path: Path) -> tuple[ColmapCamera, ...]:
    cursor, cameras = _Cursor(data, path), []
    names = {number: name for name, number in MODEL_NUMBERS.items()}
    for _ in range(cursor.count(_CAMERA.size)):
        number, kind, width, height = (int(value) for value in cursor.unpack(_CAMERA))
        if kind not in names:
            raise broken_file(path, f"camera {number} has the unknown model number {kind}")
        params = struct.unpack(
            f"<{PARAMETER_COUNTS[names[kind]]}d", cursor.take(8 * PARAMETER_COUNTS[names[kind]])
        )
        cameras.append(ColmapCamera(number, names[kind], width, height, params))
    cursor.finish()
    return tuple(cameras)


def read_images(data: bytes, path: Path) -> tuple[ColmapImage, ...]:
    cursor, images = _Cursor(data, path), []
    for _ in range(cursor.count(_IMAGE.size + 1 + _COUNT.size)):
        number, *pose, camera = cursor.unpack(_IMAGE)
        name = cursor.string()
        observations = cursor.array(_IMAGE_POINT, cursor.count(_IMAGE_POINT.itemsize))
        xy, owners = observations["xy"].astype(np.float64), observations["point"].astype(np.int64)
        images.append(
            ColmapImage(int(number), np.array(pose[:4]), np.array(pose[4:]), int(camera), name, xy, owners)
        )
    cursor.finish()
    return tuple(images)


def read_points(data: bytes, path: Path) -> ColmapPoints:
    cursor = _Cursor(data, path)
    heads, tracks = [], []
    for _ in range(cursor.count(_POINT.size)):
        head = cursor.unpack(_POINT)
        length = int(head[-1])
        heads.append(head)
        tracks.append(cursor.take(TRACK_ENTRY.itemsize * length))
    cursor.finish()
    return points_of_records(heads, np.frombuffer(b"".join(tracks), dtype=TRACK_ENTRY), path)
