"""Files of a COLMAP sparse model, binary and text, from one table of fields.

A folder holds cameras, images and points3D; since COLMAP 3.12 also rigs and frames. Each image is its own
frame and each camera its own rig here, as when COLMAP reads older folders. Rigs and frames are not read: the
images carry their whole poses. Numbers in text have 17 significant digits, so both forms keep every bit.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

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
from thesisrecon.io.files import shortened, write_atomically

_COUNT = struct.Struct("<Q")
_MODEL_NAMES = {number: name for name, number in MODEL_NUMBERS.items()}
_NEEDED = ("cameras", "images", "points3D")

_Record = tuple[tuple[Any, ...], "NDArray[Any]"]
"""Values of the fields, and the list at the end of a record."""
_NO_LIST = np.zeros(0)
_POINT_2D = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_TRACK_ENTRY = np.dtype([("image", "<u4"), ("row", "<u4")])


class _Table(NamedTuple):
    """Layout of one file.

    ``fields``: I, Q, B unsigned integers of 4, 8, 1 bytes; d double; M camera model, S sensor type (int32 in
    binary files, words in text); N name. ``header`` and ``total`` begin a text file. ``entry`` is the element
    of the list at the end of a record, which stands on a ``second_line`` of text files or not.
    """

    fields: str
    header: str
    total: str = ""
    entry: np.dtype[Any] | None = None
    second_line: bool = False

    @property
    def packing(self) -> struct.Struct:
        return struct.Struct("<" + self.fields.replace("M", "i").replace("S", "i").replace("N", ""))

    @property
    def counted(self) -> bool:
        """Whether a binary record holds the length of its list; that of the parameters follows from M."""
        return self.entry is not None and self.entry.names is not None

    @property
    def smallest(self) -> int:
        """Bytes of the smallest record."""
        return self.packing.size + ("N" in self.fields) + _COUNT.size * self.counted


_TABLES = {
    "rigs": _Table(
        "IISI",
        "# Rig list, one line each:\n#   RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[]\n",
    ),
    "cameras": _Table(
        "IMQQ",
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n",
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
        "#   POINTS2D[] as (X, Y, POINT3D_ID)\n",
        "# Number of images: {}\n",
        _POINT_2D,
        second_line=True,
    ),
    "points3D": _Table(
        "QdddBBBd",
        "# 3D point list with one line of data per point:\n"
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n",
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
    if not binary and any(
        len(image.name.split()) > 1 or image.name != image.name.strip() for image in model.images
    ):
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
    suffix = _suffix(path)
    contents = {}
    for file in (path / f"{name}{suffix}" for name in _NEEDED):
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


def _suffix(path: Path) -> str:
    for suffix in (".bin", ".txt"):
        if all((path / f"{name}{suffix}").is_file() for name in _NEEDED):
            return suffix
    raise StageFailure(
        f"{path} holds no COLMAP model",
        "it must contain cameras, images and points3D, all .bin or all .txt",
        "give the folder of these files, often called sparse/0",
    )


def _damaged(path: Path, evidence: str) -> StageFailure:
    return StageFailure(f"{path} is not a valid COLMAP file", evidence, "export the model again")


def encode_model(model: ColmapModel, *, binary: bool = True) -> dict[str, bytes]:
    """Encode the five files of a model.

    Parameters
    ----------
    model : ColmapModel
        A consistent model.
    binary : bool
        Binary form, else text.

    Returns
    -------
    dict
        File name without suffix -> content.
    """
    encode = _binary if binary else _text
    return {name: encode(_TABLES[name], records) for name, records in _records_of(model).items()}


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
            head[8],
            head[9],
            np.stack([seen["x"], seen["y"]], axis=1).astype(np.float64),
            seen["point"].astype(np.int64),
        )
        for head, seen in found["images"]
    )
    path = next(path for path in contents if path.stem == "points3D")
    return ColmapModel(cameras, images, _points(found["points3D"], path))


def _points(records: list[_Record], path: Path) -> ColmapPoints:
    heads = [head for head, _ in records]
    if any(not 0 <= head[0] < 2**63 or not 0 <= min(head[4:7]) <= max(head[4:7]) < 256 for head in heads):
        raise _damaged(path, "a point has a number out of range")
    entries = np.concatenate([np.zeros(0, dtype=_TRACK_ENTRY), *(track for _, track in records)])
    lengths = np.array([len(track) for _, track in records], dtype=np.int64)
    return ColmapPoints(
        ids=np.array([head[0] for head in heads], dtype=np.int64),
        xyz=np.array([head[1:4] for head in heads], dtype=np.float64).reshape(-1, 3),
        rgb=np.array([head[4:7] for head in heads], dtype=np.uint8).reshape(-1, 3),
        error=np.array([head[7] for head in heads], dtype=np.float64),
        track_start=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        track_image=entries["image"].astype(np.int64),
        track_xy=entries["row"].astype(np.int64),
    )


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
    starts = points.track_start.tolist()
    columns = (points.ids.tolist(), points.xyz.tolist(), points.rgb.tolist(), points.error.tolist())
    return {
        "rigs": [((c.camera_id, 1, "CAMERA", c.camera_id), _NO_LIST) for c in model.cameras],
        "cameras": cameras,
        "frames": frames,
        "images": images,
        "points3D": [
            ((number, *xyz, *rgb, error), entries[starts[n] : starts[n + 1]])
            for n, (number, xyz, rgb, error) in enumerate(zip(*columns, strict=True))
        ],
    }


def _binary(table: _Table, records: list[_Record]) -> bytes:
    packing, named = table.packing, "N" in table.fields
    numbers = {**MODEL_NUMBERS, "CAMERA": 0}
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
    lines = []
    for head, entries in records:
        values = [_word(value) for value in head]
        listed = " ".join(
            _word(value)
            for entry in entries.tolist()
            for value in (entry if isinstance(entry, tuple) else (entry,))
        )
        if table.second_line:
            lines += [" ".join(values), listed]
        else:
            lines.append(" ".join(values) if table.entry is None else f"{' '.join(values)} {listed}")
    header = table.header + table.total.format(len(records))
    return (header + "".join(f"{line}\n" for line in lines)).encode("utf-8", "surrogateescape")


def _word(value: Any) -> str:
    return format(value, ".17g") if isinstance(value, float) else str(value)


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
        text = self.data[self.at : end].decode("utf-8", "surrogateescape")
        self.at = end + 1
        return text


def _parse_binary(table: _Table, data: bytes, path: Path) -> Iterator[_Record]:
    assert table.entry is not None
    cursor, packing = _Cursor(data, path), table.packing
    for _ in range(cursor.count(table.smallest)):
        head = packing.unpack(cursor.take(packing.size))
        if "N" in table.fields:
            head = (*head, cursor.string())
        if table.counted:
            length = cursor.count(table.entry.itemsize)
        else:
            number, kind, *size = head
            if kind not in _MODEL_NAMES:
                raise _damaged(path, f"camera {number} has the unknown model number {kind}")
            head = (number, _MODEL_NAMES[kind], *size)
            length = PARAMETER_COUNTS[_MODEL_NAMES[kind]]
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
    columns: list[Iterable[str]] = [words[k::step] for k in range(step)]
    entries = np.empty(len(words) // step, dtype=table.entry)
    for name, column in zip(table.entry.names, columns, strict=True):
        kind = table.entry[name]
        # Out of range raises OverflowError, an incomplete entry ValueError.
        entries[name] = np.array([(float if kind.kind == "f" else int)(word) for word in column], dtype=kind)
    return entries
