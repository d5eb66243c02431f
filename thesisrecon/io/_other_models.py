"""Cameras in the formats of other programs: transforms.json (NeRF, nerfstudio) and Kalibr.

Of data sets: par.txt (Middlebury), NAME_cam.txt (MVSNet, BlendedMVS, DTU), a matrix P for each image.
"""

import json
import math
import re
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import PIL.Image

from thesisrecon.arrays import F64
from thesisrecon.camera import decompose_camera
from thesisrecon.errors import UsageError, in_words
from thesisrecon.geometry.strata import nearest_rotation
from thesisrecon.io._colmap import PIXEL_CENTRE
from thesisrecon.io._files import read_json, read_text
from thesisrecon.lens import simplest_row
from thesisrecon.results import SparseModel, SparseView

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
