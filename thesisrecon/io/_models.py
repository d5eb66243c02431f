"""Models of any kind as one record: runs, ``cameras.json``, models of other programs, trajectories.

Of other programs: COLMAP, transforms.json (NeRF, nerfstudio) and Kalibr; of data sets: par.txt (Middlebury),
NAME_cam.txt (MVSNet, BlendedMVS, DTU), a matrix P for each image. Known camera positions are read from CSV
files: lengths, or latitude, longitude and height (WGS84).
"""

import csv
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from statistics import median_low
from typing import Any, NamedTuple

import numpy as np
import PIL.Image
import scipy

from thesisrecon.arrays import F64, are_finite, require_calibration
from thesisrecon.camera import Camera, decompose_camera
from thesisrecon.errors import Notice, UsageError, in_words, shortened
from thesisrecon.geometry.strata import nearest_rotation
from thesisrecon.io._colmap import MAX_SIDE_PX, PIXEL_CENTRE, is_colmap_model, read_colmap_model
from thesisrecon.io._files import first_repeated, read_json, read_text, require_image_name
from thesisrecon.lens import simplest_row
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
    if not are_finite(row):
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


class Positions(NamedTuple):
    """Positions by image name; those of degrees in metres east, north and up of an origin."""

    places: dict[str, Place]
    origin: Place | None = None  #: latitude and longitude in degrees, height in metres


def read_positions(path: Path) -> Positions:
    """Read camera positions: "name,x,y,z" per line, or columns of a header; degrees become metres."""
    columns, width, degrees, found = [0, 1, 2, 3], 4, False, dict[str, Place]()
    for number, cells in _rows(path):
        if number == 0:
            columns, width, degrees = _columns_of(cells, path)
            continue
        name, values = _named_numbers([cells[k] for k in columns] if len(cells) == width else [])
        outside = degrees and len(values) == 3 and (abs(values[0]) > 90.0 or abs(values[1]) > 360.0)
        if len(values) != 3 or name in found or outside or not are_finite(values):
            what = "name,x,y,z with finite numbers"
            if degrees:
                what = "the name, latitude, longitude and height of an image, in decimal degrees and metres"
            line = shortened(",".join(cells).strip())
            raise UsageError(Notice("no-position-in-line", number, path, what, line))
        found[name] = values[0], values[1], values[2]
    if not degrees or not found:
        return Positions(found)
    metres, origin = east_north_up(np.array([*found.values()]))
    placed = {name: (e, n, u) for name, (e, n, u) in zip(found, metres.tolist(), strict=True)}
    return Positions(placed, origin)


def read_point_pairs(path: Path) -> dict[str, list[list[float]]]:
    """Read the pixels of two points in images, "name,x1,y1,x2,y2" per line."""
    found = {}
    for number, cells in _rows(path):
        name, values = _named_numbers(cells)
        if len(values) == 4:
            found[name] = [values[:2], values[2:]]
        elif number > 0:
            what, line = "name,x1,y1,x2,y2: the pixels of two points", shortened(",".join(cells).strip())
            raise UsageError(Notice("no-position-in-line", number, path, what, line))
    return found


def _named_numbers(cells: Sequence[str]) -> tuple[str, list[float]]:
    """The name and the numbers of cells; none if one is no number."""
    try:
        return cells[0].strip(), [float(cell) for cell in cells[1:]]
    except (ValueError, IndexError):
        return "", []


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


def _columns_of(cells: Sequence[str], path: Path) -> tuple[list[int], int, bool]:
    """Columns of name and coordinates by the words of a header, those of a line, and if they are degrees."""
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
        return [name, x, y, z], len(cells), degrees
    if degrees:
        raise UsageError(Notice("header-of-positions", path, shortened(",".join(cells))))
    return [0, 1, 2, 3], 4, False


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


LOOKS_BACK = np.diag([1.0, -1.0, -1.0])  # From axes x right, y down, z forward to x right, y up, z back
_MOST_OF_A_MATRIX = 2000  # bytes


def read_other(path: Path) -> SparseModel | None:
    """The model in a file or folder of another program; None for others."""
    if path.suffix == ".json" and isinstance(content := read_json(path), dict) and "frames" in content:
        rule = "must hold frames with file_path and transform_matrix (nerfstudio, NeRF)"
        read = read_transforms
    elif path.suffix in (".yaml", ".yml"):
        read, rule = read_kalibr, "must be a camchain.yaml of pinhole cameras cam0, cam1, ..."
    elif path.name.endswith("par.txt"):
        read, rule = read_middlebury, "must have a line with the name, K, R and t of each camera"
    elif path.is_dir() and any(path.glob("*_cam.txt")):
        read, rule = read_mvsnet, "must hold files NAME_cam.txt with extrinsic and intrinsic"
    elif path.is_dir() and (any(path.glob("*.P")) or _matrix_files(path)):
        read, rule = read_matrices, "must hold a 3 x 4 camera matrix for each image"
    else:
        return None
    try:
        model = read(path)
    except UsageError:
        raise
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}") from None
    except (LookupError, ArithmeticError, TypeError, ValueError, AttributeError) as error:
        raise UsageError(f"{path} {rule} ({in_words(str(error))})") from None
    if not model.views:
        raise UsageError(f"{path} holds no camera; {rule}")
    return model


def checked_pose(R: F64, t: F64) -> tuple[F64, F64]:
    """A finite pose with the rotation nearest to R, which printed digits may leave inexact."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    if R.shape != (3, 3) or t.shape != (3,) or not are_finite(R, t):
        raise ValueError("a pose needs 3 x 4 finite numbers")
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0.0:
        raise ValueError("a pose is no rotation")
    return nearest_rotation(R), t


def _name(path: str) -> str:
    """Name of an image without ``./`` and the folder ``images/``."""
    return str(PurePosixPath(path.replace("\\", "/"))).removeprefix("images/")


def _size_of(folder: Path, file: str) -> tuple[int, int] | None:
    """Width and height of an image beside a model, also without its suffix, as NeRF writes it."""
    for name in (file, f"{file}.png", f"{file}.jpg"):
        try:
            with PIL.Image.open(folder / name) as image:
                return image.size
        except (OSError, ValueError):
            continue
    return None


def _calibration(fx: float, fy: float, cx: float, cy: float) -> F64:
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=np.float64)
    if not (are_finite(K) and min(fx, fy) > 1e-100):
        raise ValueError("a calibration needs positive focal lengths")
    return K


def read_transforms(path: Path) -> SparseModel:
    """Read ``transforms.json``: camera-to-world matrices with axes x right, y up, z back.

    Intrinsics stand in the head or in each frame (``fl_x, fl_y, cx, cy, w, h, k1 ... p2``), or follow from
    ``camera_angle_x`` of NeRF: f = w / (2 tan(angle / 2)), centre in the middle.
    """
    content = read_json(path)
    views: list[SparseView] = []
    for frame in content["frames"]:
        M = np.array(frame["transform_matrix"], dtype=np.float64)
        if M.shape not in ((3, 4), (4, 4)):
            raise ValueError(f"transform_matrix must be 4 x 4; got {M.shape}")
        R, centre = checked_pose(M[:3, :3] @ LOOKS_BACK, M[:3, 3])
        given, file = {**content, **frame}, str(frame["file_path"])
        K, size, lens = _nerf_camera(given, path.parent, file)
        views.append(SparseView(_name(file), R.T, -R.T @ centre, K, size, lens, len(views)))
    return SparseModel(views)


def _nerf_camera(
    given: dict[str, Any], folder: Path, file: str
) -> tuple[F64 | None, tuple[int, int] | None, F64 | None]:
    """K, size and lens of a frame; None for what is not given or of an unknown kind."""
    size = (int(given["w"]), int(given["h"])) if "w" in given and "h" in given else _size_of(folder, file)
    numbers = {k: float(given.get(k, 0.0)) for k in ("k1", "k2", "k3", "k4", "p1", "p2")}
    fisheye = "FISHEYE" in str(given.get("camera_model", "")).upper()
    order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    known = not any(numbers[k] for k in numbers.keys() - set(order))
    coefficients = np.array([numbers[k] for k in order])
    lens = simplest_row("fisheye" if fisheye else "brown", coefficients) if known else None
    if "fl_x" not in given and size is None:
        return None, None, lens
    if "fl_x" in given:
        fx = float(given["fl_x"])
        fy = float(given.get("fl_y", fx))
    else:
        assert size is not None
        fx = fy = 0.5 * size[0] / math.tan(0.5 * float(given["camera_angle_x"]))
        if "camera_angle_y" in given:
            fy = 0.5 * size[1] / math.tan(0.5 * float(given["camera_angle_y"]))
    middle = (np.nan, np.nan) if size is None else (0.5 * size[0], 0.5 * size[1])
    cx, cy = (float(given.get(k, at)) - PIXEL_CENTRE for k, at in zip(("cx", "cy"), middle, strict=True))
    return _calibration(fx, fy, cx, cy), size, lens


def read_middlebury(path: Path) -> SparseModel:
    """Read ``par.txt`` of the Middlebury multi-view data: a name, K, R and t per line after their number."""
    count, *rows = [line.split() for line in read_text(path).splitlines() if line.strip()]
    if len(rows) != int(count[0]):
        raise ValueError(f"{count[0]} cameras are announced, {len(rows)} follow")
    views = []
    for i, (name, *words) in enumerate(rows):
        values = np.array(words, dtype=np.float64)
        R, t = checked_pose(values[9:18].reshape(3, 3), values[18:])
        views.append(SparseView(_name(name), R, t, _upper(values[:9].reshape(3, 3)), None, np.zeros(3), i))
    return SparseModel(views)


def read_mvsnet(path: Path) -> SparseModel:
    """Read the files ``NAME_cam.txt`` of a folder: ``extrinsic`` (4 x 4, world to camera), ``intrinsic``."""
    views = []
    for i, file in enumerate(sorted(path.glob("*_cam.txt"))):
        words = read_text(file).split()
        at, K_at = words.index("extrinsic") + 1, words.index("intrinsic") + 1
        M = np.array(words[at : at + 16], dtype=np.float64).reshape(4, 4)
        K = np.array(words[K_at : K_at + 9], dtype=np.float64).reshape(3, 3)
        name = file.name.removesuffix("_cam.txt")
        views.append(SparseView(name, *checked_pose(M[:3, :3], M[:3, 3]), _upper(K), None, np.zeros(3), i))
    return SparseModel(views)


def read_matrices(path: Path) -> SparseModel:
    """Read a camera matrix P (3 x 4) in a file of each image, NAME.P or NAME.txt; P = K [R t] (3.1)."""
    views = []
    for i, file in enumerate(sorted(path.glob("*.P")) or _matrix_files(path)):
        P = _matrix_of(file)
        if P is None:
            raise ValueError(f"{file.name} holds no 3 x 4 matrix")
        K, R, t = decompose_camera(P)
        views.append(SparseView(file.stem, *checked_pose(R, t), _upper(K), None, np.zeros(3), i))
    return SparseModel(views)


def _matrix_files(folder: Path) -> list[Path]:
    """Files NAME.txt if each holds a matrix P."""
    found = sorted(folder.glob("*.txt"))
    return found if found and all(_matrix_of(path) is not None for path in found) else []


def _matrix_of(path: Path) -> F64 | None:
    """The only 12 numbers of a small file, after the word CONTOUR of PMVS if it is there."""
    if path.stat().st_size > _MOST_OF_A_MATRIX:
        return None
    words = read_text(path).removeprefix("CONTOUR").split()
    try:
        return np.array(words, dtype=np.float64).reshape(3, 4)
    except ValueError:
        return None


def _upper(K: F64) -> F64:
    """A calibration with square or oblong pixels; ``ValueError`` for skew beyond rounding."""
    if not abs(K[0, 1]) <= 1e-3 * abs(K[0, 0]):
        raise ValueError("a camera has skewed pixels, which have no model here")
    return _calibration(K[0, 0], K[1, 1], K[0, 2], K[1, 2])


def read_kalibr(path: Path) -> SparseModel:
    """Read ``camchain.yaml`` of Kalibr: cam0, cam1, ... with ``T_cn_cnm1``, from each camera to the next."""
    views, R, t = [], np.eye(3), np.zeros(3)
    for i, (name, camera) in enumerate(_camchain(read_text(path)).items()):
        if i and "T_cn_cnm1" in camera:
            T = np.array(camera["T_cn_cnm1"], dtype=np.float64)
            R_next, t_next = checked_pose(T[:3, :3], T[:3, 3])
            R, t = R_next @ R, R_next @ t + t_next
        fx, fy, cx, cy = (float(v) for v in camera["intrinsics"])
        width, height = (int(v) for v in camera["resolution"])
        model = camera.get("distortion_model", "none")
        lens = np.zeros(4) if model == "none" else np.array(camera["distortion_coeffs"], dtype=np.float64)
        kind = {"radtan": "brown", "none": "brown", "equidistant": "fisheye"}.get(model)
        k = simplest_row(kind, lens) if kind and camera["camera_model"] == "pinhole" else None
        views.append(SparseView(name, R, t, _calibration(fx, fy, cx, cy), (width, height), k, i))
    return SparseModel(views)


def _camchain(text: str) -> dict[str, dict[str, Any]]:
    """Cameras of a camchain: keys with numbers, words, lists in brackets, and rows that begin with "-"."""
    cameras: dict[str, dict[str, Any]] = {}
    key = ""
    for line in text.splitlines():
        line = line.split("#")[0].rstrip()
        if found := re.fullmatch(r"(cam\d+):", line):
            cameras[found[1]] = {}
        elif cameras and (row := re.fullmatch(r"\s+-\s*(\[.*\])", line)):
            [*cameras.values()][-1].setdefault(key, []).append(json.loads(row[1]))
        elif cameras and (entry := re.fullmatch(r"\s+(\w+):\s*(.*)", line)):
            key, value = entry[1], entry[2]
            if value:
                value = json.loads(value) if value.startswith("[") else value.strip("'\"")
                [*cameras.values()][-1][key] = value
    return cameras
