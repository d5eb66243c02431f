"""Models of any kind as one record: runs, ``cameras.json``, models of other programs, trajectories.

Known camera positions are read from CSV files: lengths, or latitude, longitude and height (WGS84).
"""

import csv
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median_low
from typing import Any, NamedTuple

import numpy as np
import scipy

from thesisrecon.arrays import F64, require_calibration
from thesisrecon.camera import Camera
from thesisrecon.errors import Notice, UsageError, in_words
from thesisrecon.io._colmap import MAX_SIDE_PX, is_colmap_model, read_colmap_model
from thesisrecon.io._files import first_repeated, read_json, read_text, require_image_name, shortened
from thesisrecon.io._other_models import checked_pose, read_other
from thesisrecon.results import SparseModel, SparseView


def read_model(path: str | Path) -> SparseModel:
    """Read a model and recognise its format.

    A path is the folder of a run or of a COLMAP model (itself, or the parent of ``0`` or ``sparse/0``), a
    ``cameras.json`` or a trajectory, camera-to-world: TUM (time, centre and quaternion x, y, z, w per line,
    named by time) or KITTI (3 x 4 matrix per line, named by its number from 000000); a transforms.json,
    camchain.yaml or par.txt; a folder with NAME_cam.txt or P of each image.
    UsageError for anything else.
    """
    path = Path(path)
    if not path.exists():
        raise UsageError(f"there is no {path}; give {_KNOWN}")
    model = _read_folder(path) if path.is_dir() else read_other(path)
    if model is None:
        model = SparseModel(_read_views(path) if path.suffix == ".json" else _read_trajectory(path))
        model = replace(model, as_stored=_from_colmap(path.parent))
    twice = first_repeated(require_image_name(name, path) for name in model.names)
    if twice is not None:
        raise UsageError(f"{path} holds {twice!r} twice; each view needs a name of its own")
    return model


_KNOWN = (
    "the folder of a run, a COLMAP model (cameras, images and points3D as .bin or .txt), a cameras.json, a "
    "transforms.json, camchain.yaml or par.txt, a folder with NAME_cam.txt or a matrix P of each image, or a "
    "trajectory as text with 8 (TUM) or 12 (KITTI) numbers per line"
)


def read_calibration(path: Path) -> F64 | None:
    """The calibration matrix K (3, 3) of a text file of its nine numbers; None for any other file."""
    words = read_text(path).split() if path.is_file() and path.suffix == ".txt" else []
    try:
        K = np.array(words, dtype=np.float64).reshape(3, 3)
        require_calibration(str(path), K)
    except ValueError:
        return None
    return K


def colmap_model_in(folder: Path) -> Path | None:
    """The COLMAP model of a folder: itself, or below it."""
    places = (folder, folder / "sparse" / "0", folder / "sparse", folder / "0")
    return next((place for place in places if is_colmap_model(place)), None)


def _read_folder(folder: Path) -> SparseModel:
    colmap = colmap_model_in(folder)
    if (folder / "cameras.json").is_file():
        model = SparseModel(_read_views(folder / "cameras.json"), as_stored=_from_colmap(folder))
        if colmap is None:
            return model
        found, index = read_colmap_model(colmap), {name: i for i, name in enumerate(model.names)}
        place = np.array([index.get(name, -1) for name in found.names], np.int64)[found.view_index]
        kept = place >= 0
        point, xy = found.point_index[kept], found.xy[kept]
        points = replace(model, X=found.X, colors=found.colors)
        return replace(points, view_index=place[kept], point_index=point, xy=xy)
    if colmap is None:
        if (other := read_other(folder)) is not None:
            return other
        raise UsageError(f"{folder} holds no model; give {_KNOWN}")
    # The sparse/0 of a run has the pixels of the run.
    run = colmap.resolve().parent.parent
    own = colmap.resolve().match("sparse/0") and (run / "summary.json").is_file()
    return replace(read_colmap_model(colmap), as_stored=not own or _from_colmap(run))


def _from_colmap(run: Path) -> bool:
    """Whether a run was made from COLMAP's matches or tracks."""
    summary = read_json(run / "summary.json")
    return isinstance(summary, dict) and summary.get("as_stored") is True


def _read_views(path: Path) -> list[SparseView]:
    """Views of a ``cameras.json``: a list with names, or a table by name, as some data sets have it."""
    content, views, last = read_json(path), list[SparseView](), ""
    try:
        cameras = content["cameras"]
        entries = cameras.items() if isinstance(cameras, dict) else [(item["name"], item) for item in cameras]
        for i, (name, entry) in enumerate(entries):
            last = f"; the entry {in_words(name)} cannot be used"
            views.append(_view(str(name), entry, i))
    except (TypeError, KeyError, ValueError, OverflowError, np.linalg.LinAlgError):
        raise UsageError(Notice("no-cameras", path, last)) from None
    if not views:
        raise UsageError(f"{path} holds no camera; no image of this run was registered")
    return views


def _view(name: str, entry: Any, camera: int) -> SparseView:
    entry = {"distortion": (0.0, 0.0, 0.0), "lens": "radial"} | entry
    keys = ("K", "R", "distortion", "t" if "t" in entry else "C")
    K, R, k, t = (np.array(entry[key], dtype=np.float64) for key in keys)
    if "t" not in entry:
        t = -R @ t
    size = (int(entry["width"]), int(entry["height"])) if "width" in entry else None
    # The record checks shapes and values; its tolerance for R is that of four digits.
    camera_of = Camera(K, R, t, size or (1, 1), k, lens=entry["lens"])
    if (camera_of.lens == "radial" and k.shape != (3,)) or max(size or (1, 1)) > MAX_SIDE_PX:
        raise ValueError("three coefficients and possible sides are needed")
    std = {str(part): float(value) for part, value in entry.get("std", {}).items()}
    return SparseView(name, R, t, K, size, camera_of.lens_row, camera, std or None)


def _read_trajectory(path: Path) -> list[SparseView]:
    lines = enumerate(read_text(path).splitlines(), start=1)
    rows = [(number, line.split()) for number, line in lines if line.strip() and line.lstrip()[0] != "#"]
    if not rows:
        raise UsageError(f"{path} holds no pose; give {_KNOWN}")
    views, expected = [], len(rows[0][1])
    for i, (number, words) in enumerate(rows):
        try:
            if len(words) != expected or expected not in (8, 12):
                raise ValueError("numbers are missing")
            R, centre = _pose(np.array(words, dtype=np.float64))
        except ValueError:
            raise UsageError(Notice("no-pose-in-line", number, path, in_words(" ".join(words)))) from None
        views.append(SparseView(words[0] if expected == 8 else f"{i:06d}", R, -R @ centre))
    return views


def _pose(row: F64) -> tuple[F64, F64]:
    """R (3, 3), world to camera, and centre (3,) of a row of TUM (8,) or KITTI (12,), or ``ValueError``."""
    if not np.isfinite(row).all():
        raise ValueError("a number is not finite")
    if len(row) == 8:
        if not 1e-9 < math.hypot(*row[4:]) < 1e9:
            raise ValueError("the quaternion has no direction")
        return scipy.spatial.transform.Rotation.from_quat(row[4:]).as_matrix().T, row[1:4]
    R, centre = checked_pose(row.reshape(3, 4)[:, :3], row.reshape(3, 4)[:, 3])
    return R.T, centre


Place = tuple[float, float, float]
# Words of a header for the columns.
_HEIGHT = {
    *("alt", "altitude", "gpsaltitude", "gpsalt", "ele", "elev", "elevation", "height", "h", "z", "up", "u")
}
_NAME = {"name", "image", "imagename", "img", "file", "filename", "sourcefile", "label", "photo", "path"}
_DEGREES = (
    {"lat", "latitude", "gpslatitude", "gpslat"},
    {"lon", "long", "lng", "longitude", "gpslongitude", "gpslong", "gpslon", "gpslng"},
)
_LENGTHS = ({"x", "east", "easting", "e"}, {"y", "north", "northing", "n"})
_QUALITY = {"error", "accuracy", "acc", "sigma", "std", "stdev", "variance"}
_ORDER = [0, 1, 2, 3]  # Columns without a header: name,x,y,z


class Positions(NamedTuple):
    """Positions by image name; those of degrees in metres east, north and up of an origin."""

    places: dict[str, Place]
    origin: Place | None = None  #: latitude and longitude in degrees, height in metres


class _Header(NamedTuple):
    columns: Sequence[int]  #: of the name and of three coordinates
    width: int
    degrees: bool = False


def read_positions(path: Path) -> Positions:
    """Read camera positions: "name,x,y,z" per line, or columns of a header; degrees become metres."""
    header, found = _Header(_ORDER, 4), dict[str, Place]()
    for number, cells in _rows(path):
        if number == 0:
            header = _header_of(cells, path)
            continue
        places = [cells[k].strip() for k in header.columns] if len(cells) == header.width else []
        try:
            name, *values = places
            x, y, z = map(float, values)
            if name in found or not all(map(math.isfinite, (x, y, z))):
                raise ValueError
            if header.degrees and (abs(x) > 90.0 or abs(y) > 360.0):
                raise ValueError
        except ValueError:
            what = "name,x,y,z with finite numbers"
            if header.degrees:
                what = "the name, latitude, longitude and height of an image, in decimal degrees and metres"
            raise UsageError(
                Notice("no-position-in-line", number, path, what, shortened(",".join(cells).strip()))
            ) from None
        found[name] = x, y, z
    if not header.degrees or not found:
        return Positions(found)
    metres, origin = east_north_up(np.array([*found.values()]))
    placed = {name: (e, n, u) for name, (e, n, u) in zip(found, metres.tolist(), strict=True)}
    return Positions(placed, origin)


def read_point_pairs(path: Path) -> dict[str, list[list[float]]]:
    """Read the pixels of two points in images, "name,x1,y1,x2,y2" per line."""
    found = {}
    for number, cells in _rows(path):
        try:
            name, *values = (cell.strip() for cell in cells)
            x1, y1, x2, y2 = map(float, values)
        except ValueError:
            if number == 0:
                continue
            what, line = "name,x1,y1,x2,y2: the pixels of two points", shortened(",".join(cells).strip())
            raise UsageError(Notice("no-position-in-line", number, path, what, line)) from None
        found[name] = [[x1, y1], [x2, y2]]
    return found


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and cells; number 0 marks a header, which may be a comment before the first line."""
    comment, first = list[str](), True
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        is_comment = line.lstrip().startswith("#")
        try:
            (cells,) = csv.reader([line.lstrip("# ") if is_comment else line], skipinitialspace=True)
        except (ValueError, csv.Error):
            cells = [line]
        if is_comment:
            comment = cells
            continue
        if first:
            first = False
            if not any(map(_is_number, cells[1:])):
                yield 0, cells
                continue
            if len(comment) == len(cells):
                yield 0, comment
        yield number, cells


def _header_of(cells: Sequence[str], path: Path) -> _Header:
    words = [set(re.findall("[a-z]+", cell.lower())) for cell in cells]
    words = [set() if found & _QUALITY else found for found in words]

    def column(wanted: set[str], taken: Sequence[int | None] = ()) -> int | None:
        return next((k for k, found in enumerate(words) if found & wanted and k not in taken), None)

    x, y = map(column, _DEGREES)
    degrees = x is not None or y is not None
    if not degrees:
        x, y = map(column, _LENGTHS)
    z = column(_HEIGHT, (x, y))
    name = column(_NAME, (x, y, z))
    name = name if name is not None else next((k for k in range(len(cells)) if k not in (x, y, z)), None)
    if x is not None and y is not None and z is not None and name is not None:
        return _Header((name, x, y, z), len(cells), degrees)
    if degrees:
        raise UsageError(Notice("header-of-positions", path, shortened(",".join(cells))))
    return _Header(_ORDER, 4)


def east_north_up(places: F64, origin: Place | None = None) -> tuple[F64, Place]:
    """Metres (N, 3) in the tangent plane of WGS84 at the ``origin``, by default the median; and this.

    ``places`` are latitudes, longitudes (degrees) and heights (m), NaN where unknown.
    """
    # The median is one of the positions near most of them, also beside those without a fix (0, 0).
    known = places[np.isfinite(places).all(axis=1)].T.tolist()
    x, y, z = origin or (median_low(column) for column in known)
    (sin_lat, sin_lon), (cos_lat, cos_lon) = (f(np.radians([x, y])) for f in (np.sin, np.cos))
    east, north = [-sin_lon, cos_lon, 0.0], [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
    axes = np.array([east, north, np.cross(east, north)])
    return np.asarray((_geocentric(places) - _geocentric(np.array([x, y, z]))) @ axes.T), (x, y, z)


def _geocentric(place: F64) -> F64:
    latitude, longitude, height = np.radians(place[..., 0]), np.radians(place[..., 1]), place[..., 2]
    flattening = 1.0 / 298.257223563
    square = flattening * (2.0 - flattening)
    normal = 6_378_137.0 / np.sqrt(1.0 - square * np.sin(latitude) ** 2)
    across, up = (normal + height) * np.cos(latitude), normal * (1.0 - square) + height
    x, y, z = across * np.cos(longitude), across * np.sin(longitude), up * np.sin(latitude)
    return np.stack([x, y, z], axis=-1)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
