"""Reading and writing the files of a COLMAP sparse model, binary and text.

A folder holds cameras, images and points3D; since COLMAP 3.12 also rigs and frames, which say which images
were taken together. Here every image is taken alone: on writing each camera is its own rig and each image its
own frame, as COLMAP itself does with the older folders; on reading rigs and frames are left alone, because
the images carry their whole poses. Numbers in text have 17 significant digits, so both forms keep every bit.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thesisrecon.errors import StageFailure
from thesisrecon.io.colmap_model import (
    MODEL_NUMBERS,
    PARAMETER_COUNTS,
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    inconsistency,
)

_IMAGE_POINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_TRACK_ENTRY = np.dtype([("image", "<u4"), ("xy", "<u4")])
_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3BdQ")
_RIG = struct.Struct("<IIiI")
_FRAME = struct.Struct("<II7dIiIQ")
_CAMERA_SENSOR = 0
_NEEDED = ("cameras", "images", "points3D")


def write_colmap_model(path: Path, model: ColmapModel, *, binary: bool = True) -> None:
    """Write ``model`` into the folder ``path`` (made where absent), as .bin or .txt files.

    Each file appears whole or not at all. The same model always gives the same bytes. Raises ``ValueError``
    for a model that breaks a rule of :func:`~thesisrecon.io.colmap_model.inconsistency`, and in text for
    names with blanks, which COLMAP's text reader cuts off.
    """
    problem = inconsistency(model)
    if problem:
        raise ValueError(f"write_colmap_model needs a consistent model; {problem}")
    if not binary and any(
        len(image.name.split()) > 1 or image.name != image.name.strip() for image in model.images
    ):
        raise ValueError("a name with blanks cannot be written as COLMAP text; write binary")
    path.mkdir(parents=True, exist_ok=True)
    encoders = _BINARY_ENCODERS if binary else _TEXT_ENCODERS
    for name, encode in encoders.items():
        target = path / f"{name}{'.bin' if binary else '.txt'}"
        partial = target.with_name(target.name + ".partial")
        partial.write_bytes(encode(model))
        partial.replace(target)


def read_colmap_model(path: Path) -> ColmapModel:
    """Read the COLMAP model in the folder ``path``; binary files win where both forms stand there.

    Works for folders with and without rigs and frames. Raises :class:`StageFailure` with the file and the
    reason where files are missing, cut short, hold impossible counts, numbers that are not finite, or
    references to what does not exist. Memory stays within a small multiple of the files' size, whatever
    counts they claim.
    """
    suffix = _suffix(path)
    files = [path / f"{name}{suffix}" for name in _NEEDED]
    cameras, images, points = ((_content(file), file) for file in files)
    if suffix == ".bin":
        model = ColmapModel(_decode_cameras(*cameras), _decode_images(*images), _decode_points(*points))
    else:
        model = ColmapModel(_parse_cameras(*cameras), _parse_images(*images), _parse_points(*points))
    problem = inconsistency(model)
    if problem:
        raise _broken(path, problem)
    return model


def _suffix(path: Path) -> str:
    for suffix in (".bin", ".txt"):
        if all((path / f"{name}{suffix}").is_file() for name in _NEEDED):
            return suffix
    raise StageFailure(
        f"{path} holds no COLMAP model",
        "cameras, images and points3D are needed, all .bin or all .txt",
        "give the folder that holds these files, often called sparse/0",
    )


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise _broken(path, error.strerror or "it cannot be read") from error


def _broken(path: Path, what: str) -> StageFailure:
    return StageFailure(f"{path} is not a sound COLMAP file", what, "export the model again")


# -------------------------------------------------------------------------------------------- binary, writing


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
    entries = np.empty(len(points.track_image), dtype=_TRACK_ENTRY)
    entries["image"], entries["xy"] = points.track_image, points.track_xy
    packed, step = entries.tobytes(), _TRACK_ENTRY.itemsize
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


_BINARY_ENCODERS: dict[str, Callable[[ColmapModel], bytes]] = {
    "rigs": _encode_rigs,
    "cameras": _encode_cameras,
    "frames": _encode_frames,
    "images": _encode_images,
    "points3D": _encode_points,
}


# -------------------------------------------------------------------------------------------- binary, reading


class _Cursor:
    """Reads forward through bytes and fails with a sentence, never past the end."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.data, self.path, self.at = data, path, 0

    def take(self, size: int) -> bytes:
        if size > len(self.data) - self.at:
            raise _broken(self.path, f"it ends after {len(self.data)} bytes, in the middle of a record")
        self.at += size
        return self.data[self.at - size : self.at]

    def unpack(self, record: struct.Struct) -> tuple[int | float, ...]:
        return record.unpack(self.take(record.size))

    def count(self, smallest: int) -> int:
        """A count of records of at least ``smallest`` bytes each, checked before anything is allocated."""
        number = int(self.unpack(_COUNT)[0])
        if number > (len(self.data) - self.at) // smallest:
            raise _broken(self.path, f"it claims {number} records and is too short to hold them")
        return number

    def array(self, dtype: np.dtype[np.void] | np.dtype[np.float64], count: int) -> NDArray[np.void]:
        return np.frombuffer(self.take(dtype.itemsize * count), dtype=dtype)

    def string(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise _broken(self.path, f"it ends after {len(self.data)} bytes, in the middle of a name")
        text = self.data[self.at : end].decode("utf-8", "surrogateescape")
        self.at = end + 1
        return text

    def finish(self) -> None:
        if self.at < len(self.data):
            raise _broken(self.path, f"{len(self.data) - self.at} bytes follow after its last record")


def _decode_cameras(data: bytes, path: Path) -> tuple[ColmapCamera, ...]:
    cursor, cameras = _Cursor(data, path), []
    names = {number: name for name, number in MODEL_NUMBERS.items()}
    for _ in range(cursor.count(_CAMERA.size)):
        number, kind, width, height = (int(value) for value in cursor.unpack(_CAMERA))
        if kind not in names:
            raise _broken(path, f"camera {number} has the unknown model number {kind}")
        params = struct.unpack(
            f"<{PARAMETER_COUNTS[names[kind]]}d", cursor.take(8 * PARAMETER_COUNTS[names[kind]])
        )
        cameras.append(ColmapCamera(number, names[kind], width, height, params))
    cursor.finish()
    return tuple(cameras)


def _decode_images(data: bytes, path: Path) -> tuple[ColmapImage, ...]:
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


def _decode_points(data: bytes, path: Path) -> ColmapPoints:
    cursor = _Cursor(data, path)
    heads, tracks = [], []
    for _ in range(cursor.count(_POINT.size)):
        head = cursor.unpack(_POINT)
        length = int(head[-1])
        heads.append(head)
        tracks.append(cursor.take(_TRACK_ENTRY.itemsize * length))
    cursor.finish()
    return _points(heads, np.frombuffer(b"".join(tracks), dtype=_TRACK_ENTRY), path)


def _points(heads: list[tuple[int | float, ...]], entries: NDArray[np.void], path: Path) -> ColmapPoints:
    """Columns of points; ``heads`` hold (id, x, y, z, r, g, b, error, track length)."""
    if any(head[0] >= 2**63 for head in heads):
        raise _broken(path, "a point has a number out of range")
    lengths = np.array([head[8] for head in heads], dtype=np.int64)
    return ColmapPoints(
        ids=np.array([head[0] for head in heads], dtype=np.int64),
        xyz=np.array([head[1:4] for head in heads], dtype=np.float64).reshape(-1, 3),
        rgb=np.array([head[4:7] for head in heads], dtype=np.uint8).reshape(-1, 3),
        error=np.array([head[7] for head in heads], dtype=np.float64),
        track_start=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        track_image=entries["image"].astype(np.int64),
        track_xy=entries["xy"].astype(np.int64),
    )


# ---------------------------------------------------------------------------------------------- text, writing


def _numbers(values: NDArray[np.float64] | tuple[float, ...]) -> str:
    return " ".join(format(value, ".17g") for value in values)


def _text(header: str, lines: list[str]) -> bytes:
    return "".join(f"{line}\n" for line in (*header.splitlines(), *lines)).encode("utf-8", "surrogateescape")


def _print_cameras(model: ColmapModel) -> bytes:
    header = (
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    )
    lines = [f"{c.camera_id} {c.model} {c.width} {c.height} {_numbers(c.params)}" for c in model.cameras]
    return _text(f"{header}# Number of cameras: {len(lines)}", lines)


def _print_images(model: ColmapModel) -> bytes:
    header = (
        "# Image list with two lines of data per image:\n"
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
        "#   POINTS2D[] as (X, Y, POINT3D_ID)\n"
    )
    lines = []
    for image in model.images:
        pose = f"{_numbers(image.quaternion_wxyz)} {_numbers(image.translation)}"
        lines.append(f"{image.image_id} {pose} {image.camera_id} {image.name}")
        observations = zip(image.xy.tolist(), image.point_ids.tolist(), strict=True)
        lines.append(" ".join(f"{_numbers(tuple(xy))} {owner}" for xy, owner in observations))
    return _text(f"{header}# Number of images: {len(model.images)}", lines)


def _print_points(model: ColmapModel) -> bytes:
    points = model.points
    header = (
        "# 3D point list with one line of data per point:\n"
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
    )
    entries = [f"{i} {k}" for i, k in zip(points.track_image.tolist(), points.track_xy.tolist(), strict=True)]
    starts, lines = points.track_start.tolist(), []
    for n, number in enumerate(points.ids.tolist()):
        rgb = " ".join(map(str, points.rgb[n].tolist()))
        track = " ".join(entries[starts[n] : starts[n + 1]])
        lines.append(
            f"{number} {_numbers(points.xyz[n])} {rgb} {_numbers((float(points.error[n]),))} {track}"
        )
    return _text(f"{header}# Number of points: {len(lines)}", lines)


def _print_rigs(model: ColmapModel) -> bytes:
    header = "# Rig list, one line each:\n#   RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[]"
    return _text(header, [f"{camera.camera_id} 1 CAMERA {camera.camera_id}" for camera in model.cameras])


def _print_frames(model: ColmapModel) -> bytes:
    header = (
        "# Frame list, one line each:\n#   FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], "
        "NUM_DATA_IDS, DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)"
    )
    lines = [
        f"{image.image_id} {image.camera_id} {_numbers(image.quaternion_wxyz)} {_numbers(image.translation)}"
        f" 1 CAMERA {image.camera_id} {image.image_id}"
        for image in model.images
    ]
    return _text(header, lines)


_TEXT_ENCODERS: dict[str, Callable[[ColmapModel], bytes]] = {
    "rigs": _print_rigs,
    "cameras": _print_cameras,
    "frames": _print_frames,
    "images": _print_images,
    "points3D": _print_points,
}


# ---------------------------------------------------------------------------------------------- text, reading


def _lines(data: bytes) -> Iterator[str]:
    return iter(data.decode("utf-8", "surrogateescape").split("\n"))


def _records(lines: Iterator[str]) -> Iterator[str]:
    return (line.strip() for line in lines if line.strip() and not line.startswith("#"))


def _parse_cameras(data: bytes, path: Path) -> tuple[ColmapCamera, ...]:
    cameras = []
    for line in _records(_lines(data)):
        words = line.split()
        try:
            number, width, height = int(words[0]), int(words[2]), int(words[3])
            cameras.append(ColmapCamera(number, words[1], width, height, tuple(map(float, words[4:]))))
        except (ValueError, IndexError) as error:
            raise _broken(path, f"the line {_short(line)} is no camera") from error
    return tuple(cameras)


def _parse_images(data: bytes, path: Path) -> tuple[ColmapImage, ...]:
    images, lines = [], _lines(data)
    for line in _records(lines):
        words = line.split(maxsplit=9)
        # An image without image points has an empty second line, so it must not be skipped like other blanks.
        second = next(lines, "").split()
        try:
            pose = np.array(words[1:8], dtype=np.float64)
            xy = np.array([second[0::3], second[1::3]], dtype=np.float64).T.reshape(-1, 2)
            owners = np.array([int(word) for word in second[2::3]], dtype=np.int64)
            image = ColmapImage(int(words[0]), pose[:4], pose[4:], int(words[8]), words[9], xy, owners)
        except (ValueError, IndexError, OverflowError) as error:
            raise _broken(path, f"the lines from {_short(line)} on are no image") from error
        images.append(image)
    return tuple(images)


def _parse_points(data: bytes, path: Path) -> ColmapPoints:
    heads: list[tuple[int | float, ...]] = []
    entries: list[tuple[int, int]] = []
    for line in _records(_lines(data)):
        words = line.split()
        try:
            track = [int(word) for word in words[8:]]
            pairs = list(zip(track[0::2], track[1::2], strict=True))
            rgb = [int(word) for word in words[4:7]]
            head = (int(words[0]), *map(float, words[1:4]), *rgb, float(words[7]), len(pairs))
        except (ValueError, IndexError) as error:
            raise _broken(path, f"the line {_short(line)} is no point") from error
        if (
            head[0] < 0
            or not all(0 <= value < 256 for value in rgb)
            or not all(0 <= k < 2**32 for k in track)
        ):
            raise _broken(path, f"the line {_short(line)} holds a number out of range")
        heads.append(head)
        entries.extend(pairs)
    return _points(heads, np.array(entries, dtype=_TRACK_ENTRY), path)


def _short(line: str) -> str:
    return repr(line if len(line) <= 60 else line[:57] + "...")
