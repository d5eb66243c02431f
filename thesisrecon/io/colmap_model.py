"""COLMAP sparse models: records, the rules of a consistent model, and its files, binary and text.

COLMAP's conventions: pixel (0.5, 0.5) is the centre of the top-left pixel, quaternions are (w, x, y, z),
poses are world-to-camera. A folder holds cameras, images and points3D; since COLMAP 3.12 also rigs and
frames. Each image is its own frame and each camera its own rig here, as when COLMAP reads older folders. Rigs
and frames are not read: the images carry their whole poses. Numbers in text have 17 digits, so both forms
keep every bit.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F64, I64, U8
from thesisrecon.errors import StageFailure
from thesisrecon.io._files import shortened, write_atomically

# Camera model -> number of its parameters; the models are numbered in this order.
PARAMETER_COUNTS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16, "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4,
    "EUCM": 6, "EQUIRECTANGULAR": 2,
}  # fmt: skip
MODEL_NAMES = tuple(PARAMETER_COUNTS)
MAX_ID = 2**32 - 2
NO_POINT = -1
"""Space point of an image point that has none."""

_COUNT = struct.Struct("<Q")
_NEEDED = ("cameras", "images", "points3D")
_Record = tuple[tuple[Any, ...], "NDArray[Any]"]
"""Values of the fields, and the list at the end of a record."""
_NO_LIST = np.zeros(0)
_POINT_2D = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_TRACK_ENTRY = np.dtype([("image", "<u4"), ("row", "<u4")])


@dataclass(frozen=True)
class ColmapCamera:
    """One camera.

    Parameters
    ----------
    camera_id : int
        Unique number.
    model : str
        A key of :data:`PARAMETER_COUNTS`.
    width, height : int
        Image size (px).
    params : tuple of float
        In COLMAP's order.
    """

    camera_id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """One registered image: x_camera = R(quaternion_wxyz) X + translation.

    Parameters
    ----------
    image_id, camera_id : int
        Its unique number and its camera.
    quaternion_wxyz, translation : ndarray (4,) and (3,)
        Pose.
    name : str
        File name.
    xy, point_ids : ndarray (N, 2) and (N,)
        Image points in COLMAP's pixels, and the space point of each, -1 = none.
    """

    image_id: int
    quaternion_wxyz: F64
    translation: F64
    camera_id: int
    name: str
    xy: F64
    point_ids: I64


@dataclass(frozen=True)
class ColmapPoints:
    """All space points, by columns.

    Parameters
    ----------
    ids, error : ndarray (N,)
        Unique numbers and mean reprojection errors (px).
    xyz, rgb : ndarray (N, 3)
        Positions and colours.
    track_start : ndarray (N + 1,)
        Point n has the track entries ``track_start[n]:track_start[n + 1]``.
    track_image, track_xy : ndarray (M,)
        Image number and row of its ``xy`` of each track entry.
    """

    ids: I64
    xyz: F64
    rgb: U8
    error: F64
    track_start: I64
    track_image: I64
    track_xy: I64


@dataclass(frozen=True)
class ColmapModel:
    """A sparse model: tuples of cameras and images, and the space points."""

    cameras: tuple[ColmapCamera, ...]
    images: tuple[ColmapImage, ...]
    points: ColmapPoints


def inconsistency(model: ColmapModel) -> str:
    """Find the first rule that a model breaks.

    Numbers must be unique and in range, references must exist in both directions (image point to space point
    and back), values must be finite, and names must fit into a file.

    Parameters
    ----------
    model : ColmapModel
        Any model.

    Returns
    -------
    str
        A clause, or empty if the model is consistent.
    """
    if len({camera.camera_id for camera in model.cameras}) < len(model.cameras):
        return "two cameras have the same number"
    if len({image.image_id for image in model.images}) < len(model.images):
        return "two images have the same number"
    known = {camera.camera_id for camera in model.cameras}
    problems = (*map(_camera_problem, model.cameras), *(_image_problem(i, known) for i in model.images))
    points = model.points
    if len(np.unique(points.ids)) < len(points.ids) or (points.ids < 0).any():
        problems += ("two points have the same number, or one has a negative number",)
    elif not (np.isfinite(points.xyz).all() and np.isfinite(points.error).all()):
        problems += ("a point has a coordinate or an error that is not finite",)
    return next(filter(None, problems), "") or _track_problem(points, model.images)


def _camera_problem(camera: ColmapCamera) -> str:
    what = f"camera {camera.camera_id}"
    if not 0 <= camera.camera_id <= MAX_ID:
        return f"{what} has a number out of range"
    if camera.model not in PARAMETER_COUNTS:
        return f"{what} has the unknown camera model {camera.model!r}"
    needed = PARAMETER_COUNTS[camera.model]
    if len(camera.params) != needed:
        return f"{what} ({camera.model}) needs {needed} parameters, not {len(camera.params)}"
    if not np.isfinite(camera.params).all():
        return f"{what} has a parameter that is not a finite number"
    if not (0 < camera.width < 2**31 and 0 < camera.height < 2**31):
        return f"{what} has the impossible size {camera.width} x {camera.height}"
    return ""


def _image_problem(image: ColmapImage, cameras: set[int]) -> str:
    what = f"image {image.image_id} ({image.name!r})"
    if not 0 <= image.image_id <= MAX_ID:
        return f"{what} has a number out of range"
    if image.camera_id not in cameras:
        return f"{what} uses camera {image.camera_id}, which does not exist"
    if not image.name or any(mark in image.name for mark in "\0\n\r"):
        return f"{what} has an empty name or a name with a line break"
    if not all(np.isfinite(part).all() for part in (image.quaternion_wxyz, image.translation, image.xy)):
        return f"{what} has a pose or an image point that is not finite"
    if not 1e-6 < float(np.abs(image.quaternion_wxyz).max()) < 1e6:
        return f"{what} has an invalid quaternion"
    return ""


def _track_problem(points: ColmapPoints, images: tuple[ColmapImage, ...]) -> str:
    counts = np.array([len(image.xy) for image in images], dtype=np.int64)
    start = np.concatenate([[0], np.cumsum(counts)])
    if not images:
        return "a track refers to an image that does not exist" if len(points.track_image) else ""
    ids = np.array([image.image_id for image in images], dtype=np.int64)
    order = np.argsort(ids)
    place = order[np.minimum(np.searchsorted(ids[order], points.track_image), len(ids) - 1)]
    if (ids[place] != points.track_image).any():
        return "a track refers to an image that does not exist"
    if ((points.track_xy < 0) | (points.track_xy >= counts[place])).any():
        return "a track refers to an image point that does not exist"
    owners = np.concatenate([image.point_ids for image in images])
    seen = start[place] + points.track_xy
    listed = np.repeat(points.ids, np.diff(points.track_start))
    if (owners[seen] != listed).any() or len(np.unique(seen)) < len(seen):
        return "a point and its image points do not refer to each other"
    if np.count_nonzero(owners != NO_POINT) != len(seen):
        return "an image point refers to a point that does not list it"
    return ""


class _Table(NamedTuple):
    """Layout of one file.

    ``fields``: I, Q, B unsigned integers of 4, 8, 1 bytes; d double; M camera model, S sensor type (int32 in
    binary files, words in text); N name. ``header`` begins a text file. ``entry`` is the element of the list
    at the end of a record, which stands on a ``second_line`` of text files or not.
    """

    fields: str
    header: str
    entry: np.dtype[Any] | None = None
    second_line: bool = False

    @property
    def packing(self) -> struct.Struct:
        return struct.Struct("<" + self.fields.replace("M", "i").replace("S", "i").replace("N", ""))

    @property
    def counted(self) -> bool:
        """Whether a binary record holds the length of its list; that of the parameters follows from M."""
        return self.entry is not None and self.entry.names is not None


_TABLES = {
    "rigs": _Table(
        "IISI",
        "# Rig list, one line each:\n#   RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[]\n",
    ),
    "cameras": _Table(
        "IMQQ",
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        "# Number of cameras: {}\n",
        np.dtype("<f8"),
    ),
    "frames": _Table(
        "IIdddddddISIQ",
        "# Frame list, one line each:\n#   FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], "
        "NUM_DATA_IDS, DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)\n",
    ),
    "images": _Table(
        "IdddddddIN",
        "# Image list with two lines of data per image:\n"
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
        "#   POINTS2D[] as (X, Y, POINT3D_ID)\n# Number of images: {}\n",
        _POINT_2D,
        second_line=True,
    ),
    "points3D": _Table(
        "QdddBBBd",
        "# 3D point list with one line of data per point:\n"
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
        "# Number of points: {}\n",
        _TRACK_ENTRY,
    ),
}


def write_colmap_model(path: Path, model: ColmapModel, *, binary: bool = True) -> None:
    """Write a COLMAP model into a folder; the same model gives the same bytes.

    Parameters
    ----------
    path : Path
        Folder, created if necessary.
    model : ColmapModel
        A consistent model.
    binary : bool
        Write .bin files, else .txt.

    Raises
    ------
    ValueError
        If the model is inconsistent, or a name in a text file contains blanks (COLMAP cuts it off).
    OutputError
        If the folder cannot be written.
    """
    problem = inconsistency(model)
    if problem:
        raise ValueError(f"write_colmap_model needs a consistent model; {problem}")
    if not binary and any(image.name.split() != [image.name] for image in model.images):
        raise ValueError("a name with blanks cannot be written as COLMAP text; write binary")
    for name, content in encode_model(model, binary=binary).items():
        write_atomically(path / f"{name}{'.bin' if binary else '.txt'}", content)


def read_colmap_model(path: Path) -> ColmapModel:
    """Read the COLMAP model of a folder; binary files take precedence over text.

    Parameters
    ----------
    path : Path
        Folder, with or without rigs and frames.

    Returns
    -------
    ColmapModel
        A consistent model. Memory stays within a small multiple of the file sizes.

    Raises
    ------
    StageFailure
        With the file and the reason, if files are missing, truncated or inconsistent.
    """
    for suffix in (".bin", ".txt"):
        files = [path / f"{name}{suffix}" for name in _NEEDED]
        if all(file.is_file() for file in files):
            break
    else:
        raise StageFailure(
            f"{path} holds no COLMAP model",
            "it must contain cameras, images and points3D, all .bin or all .txt",
            "give the folder of these files, often called sparse/0",
        )
    contents = {}
    for file in files:
        try:
            contents[file] = file.read_bytes()
        except OSError as error:
            raise _damaged(file, error.strerror or "it cannot be read") from error
        except MemoryError:
            raise _damaged(file, "it does not fit in memory") from None
    model = decode_model(contents)
    problem = inconsistency(model)
    if problem:
        raise _damaged(path, problem)
    return model


def _damaged(path: Path, evidence: str) -> StageFailure:
    return StageFailure(f"{path} is not a valid COLMAP file", evidence, "export the model again")


def encode_model(model: ColmapModel, *, binary: bool = True) -> dict[str, bytes]:
    """Encode the five files of a consistent model: file name without suffix -> content.

    Parameters
    ----------
    model : ColmapModel
        The model.
    binary : bool
        Binary form, else text.

    Returns
    -------
    dict
        The files.
    """
    encode = _binary if binary else _text
    return {name: encode(_TABLES[name], records) for name, records in _records_of(model).items()}


def _records_of(model: ColmapModel) -> dict[str, list[_Record]]:
    """Values of all files."""
    cameras = [
        ((c.camera_id, c.model, c.width, c.height), np.asarray(c.params, dtype=np.float64))
        for c in model.cameras
    ]
    images, frames = [], []
    for image in model.images:
        pose = (*image.quaternion_wxyz.tolist(), *image.translation.tolist())
        seen = np.empty(len(image.xy), dtype=_POINT_2D)
        seen["x"], seen["y"], seen["point"] = image.xy[:, 0], image.xy[:, 1], image.point_ids
        images.append(((image.image_id, *pose, image.camera_id, image.name), seen))
        data = (1, "CAMERA", image.camera_id, image.image_id)
        frames.append(((image.image_id, image.camera_id, *pose, *data), _NO_LIST))
    points = model.points
    entries = np.empty(len(points.track_image), dtype=_TRACK_ENTRY)
    entries["image"], entries["row"] = points.track_image, points.track_xy
    columns = (points.ids.tolist(), points.xyz.tolist(), points.rgb.tolist(), points.error.tolist())
    tracks = np.split(entries, points.track_start[1:-1])
    return {
        "rigs": [((c.camera_id, 1, "CAMERA", c.camera_id), _NO_LIST) for c in model.cameras],
        "cameras": cameras,
        "frames": frames,
        "images": images,
        "points3D": [
            ((number, *xyz, *rgb, error), track)
            for number, xyz, rgb, error, track in zip(*columns, tracks[: len(points.ids)], strict=True)
        ],
    }


def _binary(table: _Table, records: list[_Record]) -> bytes:
    packing, named = table.packing, "N" in table.fields
    numbers = {"CAMERA": 0, **{name: number for number, name in enumerate(MODEL_NAMES)}}
    parts = [_COUNT.pack(len(records))]
    for head, entries in records:
        values = head[:-1] if named else head
        parts.append(packing.pack(*(numbers[v] if isinstance(v, str) else v for v in values)))
        if named:
            parts.append(head[-1].encode("utf-8", "surrogateescape") + b"\0")
        if table.counted:
            parts.append(_COUNT.pack(len(entries)))
        if table.entry is not None:
            parts.append(entries.astype(table.entry, copy=False).tobytes())
    return b"".join(parts)


def _text(table: _Table, records: list[_Record]) -> bytes:
    def words(values: Any) -> str:
        return " ".join(format(v, ".17g") if isinstance(v, float) else str(v) for v in values)

    between = "" if table.entry is None else "\n" if table.second_line else " "
    lines = [table.header.format(len(records))]
    for head, entries in records:
        values = entries.tolist()
        listed = [v for entry in values for v in entry] if table.counted else values
        lines.append(f"{words(head)}{between}{words(listed)}\n")
    return "".join(lines).encode("utf-8", "surrogateescape")


def decode_model(contents: Mapping[Path, bytes]) -> ColmapModel:
    """Decode the cameras, images and points3D of a model, whose consistency is not checked.

    Parameters
    ----------
    contents : mapping
        The three files -> their contents; the suffix .bin means the binary form.

    Returns
    -------
    ColmapModel
        The model.

    Raises
    ------
    StageFailure
        If a file is damaged.
    """
    found: dict[str, list[_Record]] = {}
    for path, content in contents.items():
        parse = _parse_binary if path.suffix == ".bin" else _parse_text
        found[path.stem] = list(parse(_TABLES[path.stem], content, path))
    cameras = tuple(
        ColmapCamera(head[0], head[1], head[2], head[3], tuple(params.tolist()))
        for head, params in found["cameras"]
    )
    images = tuple(
        ColmapImage(
            head[0],
            np.array(head[1:5], dtype=np.float64),
            np.array(head[5:8], dtype=np.float64),
            camera_id=head[8],
            name=head[9],
            xy=np.stack([seen["x"], seen["y"]], axis=1).astype(np.float64),
            point_ids=seen["point"].astype(np.int64),
        )
        for head, seen in found["images"]
    )
    heads = [head for head, _ in found["points3D"]]
    if any(not 0 <= head[0] < 2**63 or not 0 <= min(head[4:7]) <= max(head[4:7]) < 256 for head in heads):
        path = next(path for path in contents if path.stem == "points3D")
        raise _damaged(path, "a point has a number out of range")
    tracks = [track for _, track in found["points3D"]]
    entries = np.concatenate([np.zeros(0, dtype=_TRACK_ENTRY), *tracks])
    points = ColmapPoints(
        ids=np.array([head[0] for head in heads], dtype=np.int64),
        xyz=np.array([head[1:4] for head in heads], dtype=np.float64).reshape(-1, 3),
        rgb=np.array([head[4:7] for head in heads], dtype=np.uint8).reshape(-1, 3),
        error=np.array([head[7] for head in heads], dtype=np.float64),
        track_start=np.cumsum([0, *map(len, tracks)], dtype=np.int64),
        track_image=entries["image"].astype(np.int64),
        track_xy=entries["row"].astype(np.int64),
    )
    return ColmapModel(cameras, images, points)


class _Cursor:
    """Reads forward through bytes; never past the end."""

    def __init__(self, data: bytes, path: Path) -> None:
        self.data, self.path, self.at = data, path, 0

    def take(self, size: int) -> bytes:
        if size > len(self.data) - self.at:
            raise _damaged(self.path, f"it ends after {len(self.data)} bytes, in the middle of a record")
        self.at += size
        return self.data[self.at - size : self.at]

    def count(self, smallest: int) -> int:
        """Read a number of records of at least ``smallest`` bytes, checked before anything is allocated."""
        number = int(_COUNT.unpack(self.take(_COUNT.size))[0])
        if number > (len(self.data) - self.at) // smallest:
            raise _damaged(self.path, f"it claims {number} records and is too short to hold them")
        return number

    def string(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise _damaged(self.path, f"it ends after {len(self.data)} bytes, in the middle of a name")
        return self.take(end + 1 - self.at)[:-1].decode("utf-8", "surrogateescape")


def _parse_binary(table: _Table, data: bytes, path: Path) -> Iterator[_Record]:
    assert table.entry is not None
    cursor, packing = _Cursor(data, path), table.packing
    for _ in range(cursor.count(packing.size + ("N" in table.fields) + _COUNT.size * table.counted)):
        head = packing.unpack(cursor.take(packing.size))
        if "N" in table.fields:
            head = (*head, cursor.string())
        if table.counted:
            length = cursor.count(table.entry.itemsize)
        else:
            number, kind, *size = head
            if not 0 <= kind < len(MODEL_NAMES):
                raise _damaged(path, f"camera {number} has the unknown model number {kind}")
            head = (number, MODEL_NAMES[kind], *size)
            length = PARAMETER_COUNTS[MODEL_NAMES[kind]]
        yield head, np.frombuffer(cursor.take(table.entry.itemsize * length), dtype=table.entry)
    if cursor.at < len(data):
        raise _damaged(path, f"{len(data) - cursor.at} bytes follow after its last record")


def _parse_text(table: _Table, data: bytes, path: Path) -> Iterator[_Record]:
    types: list[Callable[[str], Any]] = [
        float if field == "d" else str if field in "MN" else int for field in table.fields
    ]
    lines = iter(data.decode("utf-8", "surrogateescape").split("\n"))
    for line in (line.strip() for line in lines if line.strip() and not line.startswith("#")):
        words = line.split(maxsplit=len(types) - 1 if table.second_line else -1)
        # The second line may be empty: it must not be skipped as other blank lines are.
        listed = next(lines, "").split() if table.second_line else words[len(types) :]
        try:
            head = tuple(parse(word) for parse, word in zip(types, words[: len(types)], strict=True))
            entries = _entries(table, listed)
        except ValueError as error:
            reason = f"the line {shortened(line)!r} is not a record of {path.stem}"
            raise _damaged(path, reason) from error
        except OverflowError:
            entries = None
        unsigned = [value for value, field in zip(head, table.fields, strict=True) if field in "IQB"]
        if entries is None or min(unsigned) < 0:
            raise _damaged(path, f"the line {shortened(line)!r} holds a number out of range")
        yield head, entries


def _entries(table: _Table, words: list[str]) -> NDArray[Any]:
    """Parse the list at the end of a record."""
    assert table.entry is not None
    if table.entry.names is None:
        return np.array([float(word) for word in words])
    step = len(table.entry.names)
    entries = np.empty(len(words) // step, dtype=table.entry)
    for k, name in enumerate(table.entry.names):
        kind = table.entry[name]
        # Out of range raises OverflowError, an incomplete entry ValueError.
        column = [(float if kind.kind == "f" else int)(word) for word in words[k::step]]
        entries[name] = np.array(column, dtype=kind)
    return entries
