"""Export of reconstructions as COLMAP sparse models and COLMAP's conventions; see ``_colmap_reading.py``.

COLMAP puts the centre of the top-left pixel at (0.5, 0.5), numbers from 1, separates cameras from images and
stores quaternions as (w, x, y, z). Its SIMPLE_RADIAL distortion is the one used here, x (1 + k1 r^2) on
normalized points; FULL_OPENCV adds k2 and k3. Since COLMAP 3.12 a model has rigs and frames: each camera is
its own rig and each image its own frame here.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64, U8, rows_of_views
from thesisrecon.camera import project_camera
from thesisrecon.io._files import write_atomically
from thesisrecon.records import Reconstruction
from thesisrecon.results import SparseModel

PIXEL_CENTRE = 0.5
_SKEW_REL = 1e-9
"""Skew below this fraction of the focal length is rounding."""
_MODELS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "OPENCV": 4, "FULL_OPENCV": 6}
_CAMERA_SENSOR = 0
COLMAP_FILES = tuple(f"sparse/0/{name}.bin" for name in ("rigs", "cameras", "frames", "images", "points3D"))
POINT_2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_TRACK_ENTRY = np.dtype([("image", "<u4"), ("row", "<u4")])


def write_colmap_model(
    folder: str | Path,
    reconstruction: Reconstruction,
    names: Sequence[str],
    *,
    colors: U8,
    groups: I64,
    scales: F64,
    original_sizes: I64,
) -> int:
    """Write a metric reconstruction as a binary COLMAP model in original pixels; return 0.

    It contains the registered views and the valid points with at least two inlier observations in them; view
    i is image i + 1 and point j is point j + 1. The error of a point is its mean distance in original pixels.
    Views of one of the ``groups`` share a camera if their intrinsics and sizes are equal. COLMAP has no
    camera with skew: then nothing is written, and the number of such views is returned.
    """
    r = reconstruction
    assert r.K is not None
    assert r.distortion is not None
    skewed = r.registered & has_skew(r.K)
    if skewed.any():
        return int(skewed.sum())
    view, point = r.tracks.view_index, r.tracks.point_index
    kept = r.used
    kept &= np.bincount(point[kept], minlength=len(r.X))[point] >= 2
    view, point, xy = view[kept], point[kept], r.tracks.xy[kept]
    posed, distance = dict[int, _PosedImage](), np.zeros(len(view))
    rows = rows_of_views(view, len(r.P))
    for i in np.flatnonzero(r.registered).tolist():
        width, height = (int(size) for size in original_sizes[i])
        camera = (int(groups[i]), width, height, *_camera_params(r.K[i], r.distortion[i], scales[i]))
        R, t = _pose(r.K[i], r.P[i])
        posed[i] = _PosedImage(names[i], R, t, camera)
        here = rows[i]
        seen = project_camera(r.K[i], R, t, _points(r.X[point[here]]), distortion=r.distortion[i])
        distance[here] = np.linalg.norm((seen - xy[here]) * scales[i], axis=1)
    observed = _Observations(view, point, (xy + PIXEL_CENTRE) * scales[view, None], distance)
    _write(Path(folder), posed, observed, np.unique(point), (r.X, colors))
    return 0


def write_sparse_model(folder: str | Path, model: SparseModel, *, pinhole: bool = False) -> None:
    """Write a sparse model, without skew, as a binary COLMAP model; ``pinhole`` uses PINHOLE throughout."""
    posed, distance = dict[int, _PosedImage](), np.zeros(len(model.xy))
    rows = rows_of_views(model.view_index, len(model.views))
    for i, view in enumerate(model.views):
        assert view.K is not None
        assert view.size is not None
        assert view.distortion is not None
        kind, params = _camera_params(view.K, view.distortion, 1.0, pinhole=pinhole)
        posed[i] = _PosedImage(view.name, view.R, view.t, (0, *view.size, kind, params))
        here = rows[i]
        X = model.X[model.point_index[here]]
        seen = project_camera(view.K, view.R, view.t, X, distortion=view.distortion)
        distance[here] = np.linalg.norm(seen - model.xy[here], axis=1)
    observed = _Observations(model.view_index, model.point_index, model.xy + PIXEL_CENTRE, distance)
    Xh = np.column_stack([model.X, np.ones(len(model.X))])
    _write(Path(folder), posed, observed, np.arange(len(Xh)), (Xh, colors_of(model)))


def has_skew(K: F64) -> B8:
    """Whether calibration matrices (..., 3, 3) have skew beyond rounding."""
    return np.asarray(np.abs(K[..., 0, 1]) > _SKEW_REL * K[..., 0, 0])


class _PosedImage(NamedTuple):
    name: str
    R: F64
    t: F64
    camera: tuple[int, int, int, str, tuple[float, ...]]  #: group, width, height, model, parameters


class _Observations(NamedTuple):
    """Observations in COLMAP's pixels, and their reprojection distances."""

    view: I64
    point: I64
    xy: F64
    distance: F64


def _write(
    folder: Path, posed: dict[int, _PosedImage], observed: _Observations, used: I64, points: tuple[F64, U8]
) -> None:
    """Write images by number, and the points ``used`` of (Xh, colors)."""
    view, point, xy, distance = observed
    # One camera per group and set of intrinsics.
    cameras: dict[tuple[object, ...], int] = {}
    camera_parts, images, frames = list[bytes](), list[bytes](), list[bytes]()
    row, rows = np.zeros(len(view), dtype=np.int64), rows_of_views(view, max(posed, default=-1) + 1)
    for i, (name, R, t, camera) in posed.items():
        _, width, height, model, params = camera
        if camera not in cameras:
            cameras[camera] = len(cameras) + 1
            head = (cameras[camera], _MODELS[model], width, height)
            camera_parts.append(struct.pack(f"<IiQQ{len(params)}d", *head, *params))
        here = rows[i]
        row[here] = np.arange(len(here))
        quaternion = np.roll(scipy.spatial.transform.Rotation.from_matrix(R).as_quat(canonical=True), 1)
        observations = np.empty(len(here), dtype=POINT_2D)
        observations["xy"], observations["point"] = xy[here], point[here] + 1
        image = struct.pack("<I7dI", i + 1, *quaternion, *t, cameras[camera])
        encoded = name.encode("utf-8", "surrogateescape") + b"\0"
        images.append(image + encoded + struct.pack("<Q", len(here)) + observations.tobytes())
        sensor = (1, _CAMERA_SENSOR, cameras[camera], i + 1)
        frames.append(struct.pack("<II7dIiIQ", i + 1, cameras[camera], *quaternion, *t, *sensor))
    order = np.lexsort((view, point))
    tracks = np.empty(len(order), dtype=_TRACK_ENTRY)
    tracks["image"], tracks["row"] = view[order] + 1, row[order]
    Xh, colors = points
    counts = np.bincount(point, minlength=len(Xh))[used]
    error = np.bincount(point, weights=distance, minlength=len(Xh))[used] / np.maximum(counts, 1)
    columns = (used + 1, _points(Xh[used]), colors[used], error, np.split(tracks, np.cumsum(counts)))
    parts = [
        struct.pack("<Q3d3BdQ", number, *xyz, *rgb, mean, len(track)) + track.tobytes()
        for number, xyz, rgb, mean, track in zip(*columns, strict=False)
    ]
    rigs = [struct.pack("<IIiI", number, 1, _CAMERA_SENSOR, number) for number in cameras.values()]
    files = {"rigs": rigs, "cameras": camera_parts, "frames": frames, "images": images, "points3D": parts}
    for file, records in files.items():
        write_atomically(folder / f"{file}.bin", struct.pack("<Q", len(records)) + b"".join(records))


def colors_of(model: SparseModel) -> U8:
    """Colours (N, 3) of the points; mid-grey if they are not known."""
    return np.full((len(model.X), 3), 128, np.uint8) if model.colors is None else model.colors


def _points(Xh: F64) -> F64:
    return Xh[:, :3] / Xh[:, 3:]


def _pose(K: F64, P: F64) -> tuple[F64, F64]:
    """R (3, 3) and t (3,) of P = s K [R t] with s > 0."""
    pose = np.asarray(np.linalg.solve(K, P), dtype=np.float64)
    pose /= np.cbrt(np.linalg.det(pose[:, :3]))
    return pose[:, :3], pose[:, 3]


def _camera_params(
    K: F64, distortion: F64, scale: float, *, pinhole: bool = False
) -> tuple[str, tuple[float, ...]]:
    """Return the smallest COLMAP camera model for K and (k1, k2, k3), with parameters in original pixels."""
    fx, fy = float(K[0, 0] * scale), float(K[1, 1] * scale)
    centre = tuple(float(value) for value in (K[:2, 2] + PIXEL_CENTRE) * scale)
    k1, k2, k3 = distortion.tolist()
    if k2 or k3:
        return "FULL_OPENCV", (fx, fy, *centre, k1, k2, 0.0, 0.0, k3, 0.0, 0.0, 0.0)
    # One focal length for both moves no pixel by more than rounding.
    if not pinhole and abs(fx - fy) <= 1e-12 * fx:
        return ("SIMPLE_RADIAL", (fx, *centre, k1)) if k1 else ("SIMPLE_PINHOLE", (fx, *centre))
    return ("OPENCV", (fx, fy, *centre, k1, 0.0, 0.0, 0.0)) if k1 else ("PINHOLE", (fx, fy, *centre))
