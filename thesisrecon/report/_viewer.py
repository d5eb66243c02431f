"""Data of the model for ``viewer.js``: upright, quantized, in base64."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from thesisrecon.arrays import F64, I64
from thesisrecon.camera import decompose_camera
from thesisrecon.records import Reconstruction, TexturedMesh
from thesisrecon.report._data import pictured
from thesisrecon.report._drawing import embed_jpeg
from thesisrecon.report._figures import upright_rotation

LEVELS = 65535
"""Quantization levels along each axis of the bounding box and of the texture."""
MAX_TEXELS = 2100 * 2100
"""Larger textures are reduced: with 45,000 faces they then add less than 3 MB to the page."""
_OUTLIER = 8.0
"""Largest distance of a face from the median, relative to the 95 % quantile."""
_PLAIN = (200, 200, 200)
"""Colour of a model without colours."""
_DIRECTIONS = (
    ("Behind the cameras", (0.35, -1.45, 0.6)),
    ("From above", (0.0, -0.01, 1.9)),
    ("From the left", (-1.3, -0.9, 0.5)),
    ("From the right", (1.3, -0.9, 0.5)),
)
"""Viewing directions; z is up and the mean viewing direction of the cameras is along y."""


def viewer_data(mesh: TexturedMesh, reconstruction: Reconstruction, names: Sequence[str]) -> dict[str, Any]:
    """Build the JSON data of the 3D viewer; z is up.

    ``positions`` (N, 3) uint16 in the box ``low`` to ``high``, ``uv`` (N, 2) uint16 or ``colors`` (N, 3)
    uint8, ``indices`` (M, 3) uint32, each little-endian in base64; ``texture`` a JPEG; ``viewpoints`` of the
    images with pictures, the most central one as ``start``. Faces beyond 8 times the 95 % quantile from the
    median are left out.
    """
    mesh = _without_outliers(mesh)
    views = np.flatnonzero(reconstruction.registered).tolist()
    rotations = np.stack([decompose_camera(reconstruction.P[i])[1] for i in views])
    upright = upright_rotation(rotations)
    vertices = mesh.vertices @ upright.T
    low, high = (end(vertices[mesh.faces], axis=(0, 1)) for end in (np.min, np.max))
    steps = np.where(high > low, high - low, 1.0) / LEVELS
    positions = np.rint(np.clip((vertices - low) / steps, 0, LEVELS)).astype("<u2")
    color, faces, vertex = _colored(mesh)
    shown = sorted(set(views) & set(pictured(len(names)))) or views[:1]
    places = _viewpoints(mesh, reconstruction, upright, names, shown)
    eyes = np.array([place["eye"] for place in places])
    middle = int(np.argmin(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1)))
    return {
        "low": low.tolist(),
        "high": (low + steps * LEVELS).tolist(),
        "positions": _packed(positions[vertex]),
        "indices": _packed(faces.astype("<u4")),
        **color,
        "viewpoints": places,
        "start": middle,
        "directions": [{"name": name, "from": list(direction)} for name, direction in _DIRECTIONS],
    }


def _without_outliers(mesh: TexturedMesh) -> TexturedMesh:
    """Remove far faces, which would leave few quantization levels for the rest, if there is a rest."""
    distance = np.linalg.norm(mesh.vertices - np.median(mesh.vertices, axis=0), axis=1)
    keep = (distance <= _OUTLIER * np.quantile(distance, 0.95))[mesh.faces].all(axis=1)
    if not keep.any():
        return mesh
    return replace(mesh, faces=mesh.faces[keep], uv=None if mesh.uv is None else mesh.uv[keep])


def _colored(mesh: TexturedMesh) -> tuple[dict[str, Any], I64, I64]:
    """Return the colour data, the faces (M, 3) and the vertex of each corner."""
    every = np.arange(len(mesh.vertices))
    if mesh.texture is None or mesh.uv is None:
        colors = mesh.colors
        if colors is None:
            colors = np.tile(np.array(_PLAIN, dtype=np.uint8), (len(mesh.vertices), 1))
        return {"colors": _packed(colors)}, mesh.faces, every
    height, width = mesh.texture.shape[:2]
    # (0, 0) is the centre of the first texel; WebGL counts from its corner.
    uv = np.clip((mesh.uv + 0.5) / (width, height), 0.0, 1.0)
    corners = np.column_stack([mesh.faces.ravel(), np.rint(LEVELS * uv.reshape(-1, 2)).astype(np.int64)])
    # Sorting one integer key per corner is ten times faster than sorting rows.
    key = (corners[:, 0] * (LEVELS + 1) + corners[:, 1]) * (LEVELS + 1) + corners[:, 2]
    _, first, index = np.unique(key, return_index=True, return_inverse=True)
    texture = embed_jpeg(_within(mesh.texture), quality=82).uri
    color = {"uv": _packed(corners[first, 1:].astype("<u2")), "texture": texture}
    return color, index.reshape(-1, 3).astype(np.int64), corners[first, 0]


def _within(texture: NDArray[np.uint8]) -> PillowImage.Image:
    """Reduce the texture to at most ``MAX_TEXELS``."""
    picture = PillowImage.fromarray(texture)
    scale = np.sqrt(MAX_TEXELS / (picture.width * picture.height))
    if scale >= 1.0:
        return picture
    size = max(1, int(scale * picture.width)), max(1, int(scale * picture.height))
    return picture.resize(size, PillowImage.Resampling.BOX)


def _viewpoints(
    mesh: TexturedMesh, reconstruction: Reconstruction, upright: F64, names: Sequence[str], views: list[int]
) -> list[dict[str, Any]]:
    """The viewpoints of images, in the axes of the viewer, with target and field of view."""
    found = []
    for i in views:
        K, R, t = decompose_camera(reconstruction.P[i])
        size = reconstruction.sizes[i].astype(np.float64)
        field = size / 2 / np.diag(K)[:2]
        local = mesh.vertices @ R.T + t
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = (local[:, 2] > 0) & (np.abs(local[:, :2] / local[:, 2:]) < field).all(axis=1)
        depth = float(np.median(local[seen, 2])) if seen.any() else float(np.linalg.norm(t)) or 1.0
        eye = upright @ (-R.T @ t)
        name, target = f"{i + 1} · {names[i]}", eye + depth * (upright @ R[2])
        found.append({"name": name, "eye": eye.tolist(), "target": target.tolist(), "field": field.tolist()})
    return found


def _packed(values: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")
