"""COLMAP sparse models of any camera kind, databases, and COLMAP's conventions.

COLMAP puts the centre of the top-left pixel at (0.5, 0.5), numbers from 1, separates cameras from images and
stores quaternions as (w, x, y, z). Its SIMPLE_RADIAL distortion is the one used here, x (1 + k1 r^2) on
normalized points; FULL_OPENCV adds k2 and k3. Since COLMAP 3.12 a model has rigs and frames: each camera is
its own rig and each image its own frame here.
"""

import math
import shutil
import sqlite3
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, TypeVar

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64, U8, are_finite, resizing_transform, rows_of_views
from thesisrecon.camera import project_camera
from thesisrecon.errors import Notice, UsageError, in_words
from thesisrecon.io._files import first_repeated, read_bytes, require_image_name, write_atomically
from thesisrecon.lens import Lens, named_lens, simplest_row
from thesisrecon.records import Reconstruction
from thesisrecon.results import SparseModel, SparseView

PIXEL_CENTRE = 0.5
COLMAP_FILES = tuple(f"sparse/0/{name}.bin" for name in ("rigs", "cameras", "frames", "images", "points3D"))
POINT_2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_FILES = ("cameras", "images", "points3D")
MAX_SIDE_PX = 2**24
_KINDS = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4), ("DIVISION", 5), ("SIMPLE_FISHEYE", 3), ("FISHEYE", 4), ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
)  # fmt: skip
"""Camera models by number: name and number of parameters."""
_LENSES: dict[str, Lens] = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL"), "radial"),
    **dict.fromkeys(("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "fisheye"),
    "OPENCV": "brown", "FULL_OPENCV": "rational", "OPENCV_FISHEYE": "fisheye",
    "THIN_PRISM_FISHEYE": "thin-prism-fisheye", "SIMPLE_DIVISION": "division", "DIVISION": "division",
}  # fmt: skip
"""Lens of each kind; its coefficients, after focal lengths and principal point, have the same order."""
_KIND_OF = {lens: kind for kind, lens in _LENSES.items()} | {"fisheye": "OPENCV_FISHEYE"}
_Row = TypeVar("_Row")
_Point = tuple[int, tuple[float, float, float], bytes]  # number, position and colour


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


def is_colmap_model(folder: Path) -> bool:
    """Return whether a folder holds cameras, images and points3D, all ``.bin`` or all ``.txt``."""
    return any(all((folder / (name + kind)).is_file() for name in _FILES) for kind in (".bin", ".txt"))


def read_colmap_model(folder: Path) -> SparseModel:
    """Read a COLMAP model, binary rather than text, without rigs, frames and repeated observations."""
    binary = all((folder / f"{name}.bin").is_file() for name in _FILES)
    readers = (_binary_camera, _binary_image, _binary_point)
    parsers: Sequence[Callable[[bytes], Iterator[Any]]] = (_text_cameras, _text_images, _text_points)
    if binary:
        parsers = [partial(_binary, reader) for reader in readers]
    files = [folder / f"{name}{'.bin' if binary else '.txt'}" for name in _FILES]
    cameras, images, points = (_parsed(*given) for given in zip(files, parsers, strict=True))
    known = {camera.number: camera for camera in cameras}
    view, point, xy = _observations(images, np.array([number for number, *_ in points], np.int64))
    X = np.array([xyz for _, xyz, _ in points], np.float64).reshape(-1, 3)
    if not are_finite(X, xy):
        raise UsageError(f"the COLMAP model in {folder} has coordinates that are not finite; export it again")
    colors = np.frombuffer(b"".join(rgb for *_, rgb in points), np.uint8).reshape(-1, 3)
    views = [_view(image, known) for image in images]
    return SparseModel(views, X, colors, view, point, xy, as_stored=True)


def _parsed(file: Path, parse: Callable[[bytes], Iterator[Any]]) -> list[Any]:
    try:
        return list(parse(read_bytes(file, largest=2**32)))
    except (struct.error, ValueError, OverflowError, IndexError, OSError) as error:
        raise UsageError(Notice("no-colmap-file", file, getattr(error, "strerror", error))) from None


def _camera(number: int, kind: int, size: tuple[int, int], params: Sequence[float]) -> _Camera:
    name, count = _KINDS[kind] if 0 <= kind < len(_KINDS) else ("", 0)
    if len(params) != count or not count:
        raise ValueError(f"camera {number} is of an unknown kind, or has another number of parameters")
    if not 1 <= min(size) <= max(size) <= MAX_SIDE_PX:
        raise ValueError(Notice("camera-sides", *map(in_words, (number, *size)), MAX_SIDE_PX))
    if not (are_finite(params) and min(params[: _last_focal(name) + 1]) > 1e-100):
        raise ValueError(f"camera {number} needs finite parameters and positive focal lengths")
    return _Camera(number, name, size, np.array(params, np.float64))


def _last_focal(kind: str) -> int:
    """Place of the last focal length, of one or two, among the parameters."""
    return 0 if kind.startswith(("SIMPLE_", "RADIAL")) else 1


def _image(camera: int, name: str, pose: Sequence[float], xy: F64, point: I64) -> _Image:
    if not (are_finite(pose) and 1e-9 < math.hypot(*pose[:4]) < 1e9):
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
    return (number, (x, y, z), rgb), at + 51 + 8 * length


def _lines(data: bytes) -> Iterator[str]:
    text = data.decode("utf-8", "surrogateescape")
    # Windows writes a byte order mark before the text.
    return (line for line in text.removeprefix("\ufeff").split("\n") if line[:1] != "#")


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
        point = np.array([-1 if word == str(2**64 - 1) else int(word) for word in words[2::3]], np.int64)
        yield _image(int(camera), name, [float(word) for word in pose], xy, point)


def _text_points(data: bytes) -> Iterator[_Point]:
    for words in filter(None, map(str.split, _lines(data))):
        x, y, z = (float(word) for word in words[1:4])
        r, g, b = (int(word) for word in words[4:7])
        yield int(np.int64(words[0])), (x, y, z), bytes([r, g, b])


def _view(image: _Image, cameras: dict[int, _Camera]) -> SparseView:
    if image.camera not in cameras:
        raise UsageError(f"image {image.name!r} of the COLMAP model refers to a missing camera")
    _, kind, size, params = cameras[image.camera]
    K = distortion = None
    if kind != "EQUIRECTANGULAR":
        focal = _last_focal(kind)
        K = np.diag([params[0], params[focal], 1.0])
        K[:2, 2] = params[focal + 1 : focal + 3] - PIXEL_CENTRE
        if kind in _LENSES:
            distortion = simplest_row(_LENSES[kind], params[focal + 3 :])
    R = scipy.spatial.transform.Rotation.from_quat(np.roll(image.pose[:4], -1)).as_matrix()
    return SparseView(image.name, R, image.pose[4:], K, size, distortion, image.camera)


def _observations(images: Sequence[_Image], ids: I64) -> tuple[I64, I64, F64]:
    """View, point and pixel of the observations of points, sorted by point, then view."""
    order = np.argsort(ids, kind="stable")
    known = ids[order]
    views, points, xy = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros((0, 2))]
    for i, image in enumerate(images):
        seen = image.point >= 0
        place = np.searchsorted(known, image.point[seen])
        if not (place < len(known)).all() or (known[place] != image.point[seen]).any():
            raise UsageError(f"image {image.name!r} of the COLMAP model refers to a missing point")
        points.append(order[place])
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


_TABLES = {
    "cameras": "camera_id, width, height",
    "images": "image_id, name, camera_id",
    "keypoints": "image_id, rows, cols, data",
    "two_view_geometries": "pair_id, rows, cols, data",
    "matches": "pair_id, rows, cols, data",
}


def read_database(path: Path) -> Database:
    """Read the keypoints and the verified matches, or the raw ones; nothing is written beside the file."""
    if not path.is_file():
        raise UsageError(f"there is no COLMAP database or model at {path}")
    path = path.resolve()
    try:
        before = _states(path)
        with _opened(path) as base:
            found = _read_tables(base, path, sum(size for size, _ in before))
        if _states(path) != before:
            raise UsageError(Notice("changed-database", path))
        return found
    except UsageError:
        raise
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror}") from None
    except MemoryError:
        raise UsageError(f"{path} does not fit in memory") from None
    except (sqlite3.Error, ValueError, TypeError, KeyError, OverflowError) as error:
        raise UsageError(f"{path} is not a valid COLMAP database: {error}") from None


def _beside(path: Path, kind: str) -> Path:
    return path.with_name(f"{path.name}-{kind}")


def _states(path: Path) -> list[tuple[int, int]]:
    """Size and time of a database and of its log of changes, if it has one."""
    found = [file.stat() for file in (path, _beside(path, "wal")) if file.is_file()]
    return [(state.st_size, state.st_mtime_ns) for state in found]


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a database; SQLite would create files beside it, so one with a log of changes is copied."""
    journal, log = _beside(path, "journal"), _beside(path, "wal")
    if journal.is_file():
        with journal.open("rb") as file:
            # SQLite may delete a file that the journal names.
            if file.read(8) == bytes.fromhex("d9d505f920a163d7"):
                raise UsageError(Notice("interrupted-database", path, journal.name))
    with TemporaryDirectory() as folder:
        place, mode = path, "mode=ro&immutable=1"
        if log.is_file() and log.stat().st_size:
            place, mode = Path(folder) / "copy.db", "mode=rw"
            shutil.copyfile(path, place)
            shutil.copyfile(log, _beside(place, "wal"))
        with closing(sqlite3.connect(f"{place.as_uri()}?{mode}", uri=True)) as base:
            # A value has at most the bytes of ten million keypoints with their shapes.
            base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 2**28)
            base.text_factory = lambda text: text.decode("utf-8", "surrogateescape")
            base.execute("PRAGMA trusted_schema = OFF")
            yield base


def _rows(base: sqlite3.Connection, table: str, size: int) -> Iterator[tuple[Any, ...]]:
    """Rows of a table that is stored in the file, of altogether at most its size."""
    kinds = base.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)).fetchall()
    computed = any(column[-1] for column in base.execute(f"PRAGMA table_xinfo({table})"))
    virtual = any("VIRTUAL" in (sql or "").upper().split()[:2] for _, sql in kinds)
    if [kind for kind, _ in kinds] != ["table"] or computed or virtual:
        raise ValueError(f"it has no stored table {table}, but perhaps a view; make it with COLMAP")
    total = 0
    for row in base.execute(f"SELECT {_TABLES[table]} FROM {table}"):
        # A row takes at least four bytes in a file.
        total += 4 + sum(len(value) for value in row if isinstance(value, bytes | str))
        if total > size:
            raise ValueError(f"its table {table} claims more data than the file holds")
        yield row


def _array(what: str, rows: Any, cols: Any, data: Any, dtype: str) -> Any:
    counts = isinstance(rows, int) and isinstance(cols, int) and rows >= 0 and cols >= 2
    if not counts or not isinstance(data, bytes) or len(data) != rows * cols * 4:
        held = f"{len(data)} bytes" if isinstance(data, bytes) else in_words(data)
        raise ValueError(f"{what} claim {in_words(rows)} x {in_words(cols)} numbers but hold {held}")
    return np.frombuffer(data, dtype).reshape(rows, cols)[:, :2]


def _read_tables(base: sqlite3.Connection, path: Path, size: int) -> Database:
    cameras = {}
    for camera, width, height in _rows(base, "cameras", size):
        if not all(isinstance(side, int) and 1 <= side <= MAX_SIDE_PX for side in (width, height)):
            raise ValueError(Notice("camera-sides", *map(in_words, (camera, width, height)), MAX_SIDE_PX))
        cameras[camera] = (width, height)
    images = []
    for image, name, camera in _rows(base, "images", size):
        if camera not in cameras:
            raise ValueError(f"image {in_words(name)} refers to a missing camera")
        images.append((require_image_name(name, path), image, cameras[camera]))
    if not images:
        raise UsageError(f"{path} holds no images; run COLMAP's feature extractor and matcher first")
    images.sort()
    names = [row[0] for row in images]
    if (twice := first_repeated(names)) is not None:
        raise UsageError(f"{path} holds {twice!r} twice; each image needs a name of its own")
    number = {row[1]: i for i, row in enumerate(images)}
    keypoints = [np.zeros((0, 2)) for _ in images]
    for image, rows, cols, data in _rows(base, "keypoints", size):
        if rows and image in number:
            i = number[image]
            values = _array(f"the keypoints of {in_words(names[i])}", rows, cols, data, "<f4")
            keypoints[i] = values.astype(np.float64) - PIXEL_CENTRE
            if not are_finite(values):
                raise ValueError(f"the keypoints of {in_words(names[i])} are not finite")
    for table in ("two_view_geometries", "matches"):
        found: dict[tuple[int, int], I64] = {}
        for pair, rows, cols, data in _rows(base, table, size):
            if not rows:
                continue
            # COLMAP numbers the pair of images a < b as (2^31 - 1) a + b.
            numbers = divmod(pair, 2**31 - 1) if isinstance(pair, int) else (None,)
            if any(image not in number for image in numbers):
                raise ValueError(f"its table {table} has a pair {in_words(pair)} of images that are missing")
            i, j = (number[image] for image in numbers)
            what = f"the matches of {in_words(names[i])} and {in_words(names[j])}"
            found[i, j] = _array(what, rows, cols, data, "<u4").astype(np.int64)
        if found:
            sizes = np.array([row[2] for row in images], dtype=np.int64)
            return Database(names, sizes, keypoints, found)
    raise UsageError(f"{path} holds no matches; run COLMAP's matcher first")


def write_colmap_model(
    folder: str | Path, reconstruction: Reconstruction, names: Sequence[str], *, colors: U8, groups: I64,
    scales: F64, original_sizes: I64,
) -> int:  # fmt: skip
    """Write a metric reconstruction as a binary COLMAP model in original pixels: view i as image i + 1.

    Views of one of the ``groups`` share a camera if their intrinsics and sizes are equal. COLMAP has no skew:
    then nothing is written. Returns the number of views with skew.
    """
    r = reconstruction
    assert r.K is not None
    assert r.distortion is not None
    if skewed := int((r.registered & has_skew(r.K)).sum()):
        return skewed
    views = {}
    for i in np.flatnonzero(r.registered).tolist():
        # P = s K [R t] with s > 0.
        Rt = np.linalg.solve(r.K[i], r.P[i])
        Rt /= np.cbrt(np.linalg.det(Rt[:, :3]))
        K, (width, height) = resizing_transform(scales[i]) @ r.K[i], original_sizes[i].tolist()
        views[i] = SparseView(
            names[i], Rt[:, :3], Rt[:, 3], K, (width, height), r.distortion[i], int(groups[i])
        )
    kept, every = r.used, r.tracks.point_index
    kept &= np.bincount(every[kept], minlength=len(r.X))[every] >= 2
    view, point = r.tracks.view_index[kept], every[kept]
    xy = (r.tracks.xy[kept] + 0.5) * scales[view, None] - 0.5
    X = r.X[:, :3] / np.where(r.valid, r.X[:, 3], 1.0)[:, None]
    _write(Path(folder), views, SparseModel([], X, colors, view, point, xy), np.unique(point))
    return 0


def write_sparse_model(folder: str | Path, model: SparseModel, *, pinhole: bool = False) -> None:
    """Write a sparse model, without skew, as a binary COLMAP model; ``pinhole`` uses PINHOLE throughout."""
    views = {i: replace(view, camera=0) for i, view in enumerate(model.views)}
    _write(Path(folder), views, model, np.arange(len(model.X)), pinhole=pinhole)


def has_skew(K: F64) -> B8:
    """Whether calibration matrices (..., 3, 3) have skew beyond rounding."""
    return np.asarray(np.abs(K[..., 0, 1]) > 1e-9 * K[..., 0, 0])


def _write(
    folder: Path, views: Mapping[int, SparseView], model: SparseModel, used: I64, *, pinhole: bool = False
) -> None:
    """Write views by number, and the points ``used`` of a model; those of a group may share a camera."""
    view, point, X = model.view_index, model.point_index, model.X
    kinds = [name for name, _ in _KINDS]
    # One camera per group and set of intrinsics.
    cameras: dict[tuple[object, ...], int] = {}
    camera_parts, images, frames = list[bytes](), list[bytes](), list[bytes]()
    row, distance = np.zeros(len(view), dtype=np.int64), np.zeros(len(view))
    rows = rows_of_views(view, max(views, default=-1) + 1)
    for i, one in views.items():
        K, size, distortion = one.intrinsics
        kind, params = _camera_params(K, distortion, pinhole=pinhole)
        number = cameras.setdefault((one.camera, size, kind, params), len(cameras) + 1)
        if number > len(camera_parts):
            head = (number, kinds.index(kind), *size)
            camera_parts.append(struct.pack(f"<IiQQ{len(params)}d", *head, *params))
        here = rows[i]
        seen = project_camera(K, one.R, one.t, X[point[here]], distortion=distortion)
        row[here], distance[here] = np.arange(len(here)), np.linalg.norm(seen - model.xy[here], axis=1)
        quaternion = np.roll(scipy.spatial.transform.Rotation.from_matrix(one.R).as_quat(canonical=True), 1)
        observations = np.empty(len(here), dtype=POINT_2D)
        observations["xy"], observations["point"] = model.xy[here] + PIXEL_CENTRE, point[here] + 1
        image = struct.pack("<I7dI", i + 1, *quaternion, *one.t, number)
        encoded = one.name.encode("utf-8", "surrogateescape") + b"\0"
        images.append(image + encoded + struct.pack("<Q", len(here)) + observations.tobytes())
        sensor = (1, 0, number, i + 1)  # a sensor of the kind 0, a camera
        frames.append(struct.pack("<II7dIiIQ", i + 1, number, *quaternion, *one.t, *sensor))
    order = np.lexsort((view, point))
    tracks = np.column_stack([view[order] + 1, row[order]]).astype("<u4")
    counts = np.bincount(point, minlength=len(X))[used]
    error = np.bincount(point, weights=distance, minlength=len(X))[used] / np.maximum(counts, 1)
    columns = (used + 1, X[used], model.point_colors[used], error, np.split(tracks, np.cumsum(counts)))
    parts = [
        struct.pack("<Q3d3BdQ", number, *xyz, *rgb, mean, len(track)) + track.tobytes()
        for number, xyz, rgb, mean, track in zip(*columns, strict=False)
    ]
    rigs = [struct.pack("<IIiI", number, 1, 0, number) for number in cameras.values()]
    files = {"rigs": rigs, "cameras": camera_parts, "frames": frames, "images": images, "points3D": parts}
    for file, records in files.items():
        write_atomically(folder / f"{file}.bin", struct.pack("<Q", len(records)) + b"".join(records))


def _camera_params(K: F64, distortion: F64, *, pinhole: bool) -> tuple[str, tuple[float, ...]]:
    """Return the smallest COLMAP camera model for K and the row of a lens, and its parameters."""
    (fx, fy), (cx, cy) = K[[0, 1], [0, 1]].tolist(), (K[:2, 2] + PIXEL_CENTRE).tolist()
    lens, known = named_lens(distortion)
    if lens != "radial":
        k = known.tolist()
        if lens == "brown":
            lens, k = ("rational", [*k, 0.0, 0.0, 0.0]) if k[4] else (lens, k[:4])
        return _KIND_OF[lens], (fx, fy, cx, cy, *k)
    k1, k2, k3 = known.tolist()
    if k2 or k3:
        return "FULL_OPENCV", (fx, fy, cx, cy, k1, k2, 0.0, 0.0, k3, 0.0, 0.0, 0.0)
    # One focal length for both moves no pixel by more than rounding.
    if not pinhole and abs(fx - fy) <= 1e-12 * fx:
        return ("SIMPLE_RADIAL", (fx, cx, cy, k1)) if k1 else ("SIMPLE_PINHOLE", (fx, cx, cy))
    return ("OPENCV", (fx, fy, cx, cy, k1, 0.0, 0.0, 0.0)) if k1 else ("PINHOLE", (fx, fy, cx, cy))
