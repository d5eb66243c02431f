"""Point clouds, images, ``cameras.json``, and sparse models for nerfstudio.

The centre of the top-left pixel is (0, 0) here; in nerfstudio it is (0.5, 0.5), and cameras look along -z
with y up. Images lie in ``images/`` beside its file, masks in ``masks/``.
"""

import csv
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image

from thesisrecon.arrays import F64, U8
from thesisrecon.camera import POSE_STDS, Camera
from thesisrecon.io._colmap import PIXEL_CENTRE, has_skew
from thesisrecon.io._files import write_atomically, write_json
from thesisrecon.io._models import LOOKS_BACK
from thesisrecon.lens import named_lens
from thesisrecon.results import SparseModel


def write_nerfstudio(folder: Path, model: SparseModel, *, masked: bool) -> Path:
    """Write ``transforms.json`` (camera-to-world, OpenGL axes) and ``points.ply``; lenses may be fisheye."""
    cameras, fisheye = [], is_fisheye(model)
    for view in model.views:
        K, (width, height), lens = view.intrinsics
        cx, cy = (K[:2, 2] + PIXEL_CENTRE).tolist()
        known = {"w": width, "h": height, "fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": cx, "cy": cy}
        k = dict(zip(("k1", "k2", "k3", "k4"), named_lens(lens)[1].tolist(), strict=True)) if fisheye else {}
        cameras.append(known | dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0) | k)
    shared = all(camera == cameras[0] for camera in cameras)
    frames = []
    for view, camera in zip(model.views, cameras, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = view.R.T @ LOOKS_BACK, view.centre
        own: dict[str, Any] = {} if shared else camera
        if masked:
            own = {**own, "mask_path": f"masks/{view.name}.png"}
        frames.append({"file_path": f"images/{view.name}", **own, "transform_matrix": pose})
    kind = "OPENCV_FISHEYE" if fisheye else "OPENCV"
    head = {"camera_model": kind, **(cameras[0] if shared else {}), "ply_file_path": "points.ply"}
    write_point_cloud(folder / "points.ply", model.X, model.point_colors)
    write_json(folder / "transforms.json", {**head, "frames": frames})
    return folder / "transforms.json"


def is_fisheye(model: SparseModel) -> bool:
    """Whether all lenses of a model are those of nerfstudio's fisheye cameras."""
    every = (view.intrinsics for view in model.views)
    return all(named_lens(lens)[0] == "fisheye" and not has_skew(K) for K, _, lens in every)


def write_point_cloud(path: Path, xyz: F64, rgb: U8) -> None:
    """Write coloured points (N, 3) as binary little-endian PLY with float32 coordinates."""
    if not (np.abs(xyz) < np.finfo(np.float32).max).all():
        raise ValueError("write_point_cloud needs finite coordinates")
    vertices = np.empty(len(xyz), dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    vertices["xyz"], vertices["rgb"] = xyz, rgb
    properties = [f"property float {axis}\n" for axis in "xyz"]
    properties += [f"property uchar {name}\n" for name in ("red", "green", "blue")]
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n{''.join(properties)}end_header\n"
    )
    write_atomically(path, header.encode("ascii") + vertices.tobytes())


def cameras_table(cameras: Mapping[str, Camera]) -> dict[str, Any]:
    """Content of ``cameras.json``: cameras by image name."""
    listed = [
        {"name": name, "width": camera.size[0], "height": camera.size[1]}
        | {key: getattr(camera, key) for key in ("K", "distortion", "R", "t", "centre")}
        | ({"lens": camera.lens} if camera.lens != "radial" else {})
        | ({"std": dict(sorted(camera.std.items()))} if camera.std else {})
        for name, camera in cameras.items()
    ]
    convention = (
        "x ~ K d(R X + t), d(u) = u (1 + k1 |u|^2 + k2 |u|^4 + k3 |u|^6), distortion = (k1, k2, k3); "
        "(0, 0) is the centre of the top-left pixel"
    )
    return {"convention": convention, "cameras": listed}


def cameras_csv(cameras: Mapping[str, Camera]) -> str:
    """Content of ``cameras.csv``: centres and focal lengths with standard deviations, an image per line."""
    stds = [*POSE_STDS[3:], *POSE_STDS[:3]]
    names = ["name", "x", "y", "z", "focal_px", *(f"std_{std}" for std in ("focal_px", *stds))]
    table = io.StringIO()
    rows = csv.writer(table, lineterminator="\n")
    rows.writerow(names)
    for name, camera in cameras.items():
        std = camera.std or {}
        values = [*camera.centre, camera.K[0, 0], *(std.get(one, math.nan) for one in ("focal_px", *stds))]
        rows.writerow([name, *(f"{value:.9g}" for value in values)])
    return table.getvalue()


def write_image(path: Path, rgb: U8) -> None:
    """Write an RGB image as JPEG or, by the suffix, PNG."""
    encoded, kind = io.BytesIO(), "PNG" if path.suffix.lower() == ".png" else "JPEG"
    # Level 6 saves two percent for three times the time. Each format ignores the options of the other.
    PIL.Image.fromarray(rgb).save(encoded, kind, compress_level=3, quality=95, subsampling=0)
    write_atomically(path, encoded.getvalue())
