"""Models in the formats of other programs: transforms.json (NeRF, nerfstudio), Bundler, OpenMVS and Kalibr.

Cameras of data sets: par.txt (Middlebury), NAME_cam.txt (MVSNet, BlendedMVS, DTU), a matrix P for each image.

The inverse of the writers of :mod:`thesisrecon.io._exports`, with what other writers of these formats add.
"""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import PIL.Image

from thesisrecon.arrays import F64
from thesisrecon.camera import decompose_camera
from thesisrecon.errors import UsageError, in_words
from thesisrecon.geometry.strata import nearest_rotation
from thesisrecon.io._colmap import PIXEL_CENTRE
from thesisrecon.io._files import read_bytes, read_json, read_text
from thesisrecon.lens import simplest_row
from thesisrecon.results import SparseModel, SparseView

LOOKS_BACK = np.diag([1.0, -1.0, -1.0])
"""From axes x right, y down, z forward to x right, y up, z back."""
_MVS_VERSIONS = range(1, 7)
_MOST_OF_A_MATRIX = 2000  # bytes


def read_other(path: Path) -> SparseModel | None:
    """The model in a file or folder of another program; None for others."""
    if path.suffix == ".json" and isinstance(content := read_json(path), dict) and "frames" in content:
        rule = "must hold frames with file_path and transform_matrix (nerfstudio, NeRF)"
        read = read_transforms
    elif path.suffix == ".mvs":
        read, rule = read_openmvs, "must be an OpenMVS scene"
    elif path.suffix == ".out":
        rule = "must be a Bundler file v0.3, a camera in five lines and a point in three"
        read = read_bundler
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
    except (LookupError, ArithmeticError, TypeError, ValueError, AttributeError, struct.error) as error:
        raise UsageError(f"{path} {rule} ({in_words(str(error))})") from None
    if not model.views:
        raise UsageError(f"{path} holds no camera; {rule}")
    return model


def checked_pose(R: F64, t: F64) -> tuple[F64, F64]:
    """A finite pose with the rotation nearest to R, which printed digits may leave inexact."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    if R.shape != (3, 3) or t.shape != (3,) or not (np.isfinite(R).all() and np.isfinite(t).all()):
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
    if not (np.isfinite(K).all() and min(fx, fy) > 0.0):
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


def read_bundler(path: Path) -> SparseModel:
    """Read ``bundle.out`` (v0.3): f, k1, k2, R and t of cameras that look along -z with y up, and points.

    Names are those of ``list.txt`` beside it; sizes, and with them K and pixels, those of the images there.
    """
    words = [line.split() for line in read_text(path).splitlines() if not line.startswith("#")]
    n, points = (int(word) for word in words[0])
    names = _bundler_names(path.parent / "list.txt", n)
    views: list[SparseView] = []
    centres, kept = np.full((n, 2), np.nan), np.full(n, -1)
    for i in range(n):
        (f, k1, k2), *rows = (np.array(row, dtype=np.float64) for row in words[1 + 5 * i : 6 + 5 * i])
        if not f > 0.0:
            continue  # a camera that Bundler did not register
        R, t = checked_pose(LOOKS_BACK @ np.array(rows[:3]), LOOKS_BACK @ rows[3])
        size = _size_of(path.parent, names[i])
        K = None
        if size is not None:
            centres[i] = (np.array(size) - 1.0) / 2.0
            K = _calibration(f, f, *centres[i].tolist())
        kept[i] = len(views)
        views.append(SparseView(_name(names[i]), R, t, K, size, np.array([k1, k2, 0.0]), i))
    return _bundler_points(words[1 + 5 * n :], points, views, (centres, kept))


def _bundler_names(path: Path, n: int) -> list[str]:
    if not path.is_file():
        return [f"{i:06d}" for i in range(n)]
    names = [line.split()[0] for line in read_text(path).splitlines() if line.strip()]
    if len(names) < n:
        raise ValueError(f"list.txt names {len(names)} of {n} images")
    return names


def _bundler_points(
    lines: Sequence[list[str]], n: int, views: list[SparseView], of_camera: tuple[F64, Any]
) -> SparseModel:
    """The model with points, colours and the observations in images of known size."""
    if len(lines) < 3 * n:
        raise ValueError(f"it ends before its {n} points")
    X = np.array([lines[3 * j] for j in range(n)], dtype=np.float64).reshape(n, 3)
    colors = np.array([lines[3 * j + 1] for j in range(n)], dtype=np.float64).reshape(n, 3).astype(np.uint8)
    seen = [np.array(lines[3 * j + 2][1:], dtype=np.float64).reshape(-1, 4) for j in range(n)]
    point = np.repeat(np.arange(n), [len(rows) for rows in seen])
    rows = np.concatenate([np.zeros((0, 4)), *seen])
    centres, kept = of_camera
    camera = rows[:, 0].astype(np.int64)
    xy = centres[camera] + rows[:, 2:] * [1.0, -1.0]
    known = np.isfinite(xy).all(axis=1) & (kept[camera] >= 0)
    return SparseModel(views, X, colors, kept[camera[known]], point[known], xy[known])


class _Bytes:
    """Numbers, texts and arrays of a binary file, one after another."""

    def __init__(self, content: bytes) -> None:
        self._content, self._at = content, 0

    def take(self, form: str) -> tuple[Any, ...]:
        values = struct.unpack_from(form, self._content, self._at)
        self._at += struct.calcsize(form)
        return values

    def count(self) -> int:
        (n,) = self.take("<Q")
        if n > len(self._content):
            raise ValueError(f"it claims {n} elements in {len(self._content)} bytes")
        return int(n)

    def text(self) -> str:
        (value,) = self.take(f"{self.count()}s")
        return str(value.decode("utf-8", "surrogateescape"))

    def array(self, *shape: int) -> F64:
        return np.array(self.take(f"<{math.prod(shape)}d")).reshape(shape)


def read_openmvs(path: Path) -> SparseModel:
    """Read ``scene.mvs`` ("MVSI", versions 1 to 6): cameras and points; their views have no pixels."""
    b = _Bytes(read_bytes(path, largest=2**31))
    magic, version, _ = b.take("<4sII")
    if magic != b"MVSI" or version not in _MVS_VERSIONS:
        known = f"MVSI {_MVS_VERSIONS[0]} to {_MVS_VERSIONS[-1]}"
        raise ValueError(f"its format is {magic!r} {version}; known are {known}")
    platforms = [_platform(b, version) for _ in range(b.count())]
    views = []
    for _ in range(b.count()):
        name = b.text()
        if version > 4:
            b.text()  # mask
        platform, camera, pose = b.take("<III")
        if version > 2:
            b.take("<I")
        if pose == 2**32 - 1:
            continue  # an image without a pose
        cameras, poses = platforms[platform]
        (K, size, R_camera, C_camera), (R, C) = cameras[camera], poses[pose]
        R, centre = checked_pose(R_camera @ R, R.T @ C_camera + C)
        views.append(SparseView(_name(name), R, -R @ centre, K, size, np.zeros(3), camera))
    X = []
    for _ in range(b.count()):
        X.append(b.take("<3f"))
        b.take(f"<{2 * b.count()}I")
    return SparseModel(views, np.array(X, dtype=np.float64).reshape(-1, 3))


def _platform(b: _Bytes, version: int) -> tuple[list[tuple[F64, tuple[int, int], F64, F64]], list[Any]]:
    """Cameras (K, size, R, centre) and poses (R, centre) of a platform."""
    b.text()
    cameras = []
    for _ in range(b.count()):
        b.text()
        if version > 3:
            b.text()  # band
        width, height = b.take("<II")
        K, R, C = b.array(3, 3), b.array(3, 3), b.array(3)
        # Without a size K is in units of the long side.
        cameras.append((_calibration(K[0, 0], K[1, 1], K[0, 2], K[1, 2]), (width, height), R, C))
    return cameras, [(b.array(3, 3), b.array(3)) for _ in range(b.count())]


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
