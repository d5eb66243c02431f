"""What each photograph sees of a surface, and how well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from thesisrecon.geometry.pinhole import PinholeCamera
from thesisrecon.geometry.zbuffer import rasterize, sample_texture
from thesisrecon.types import B8, F32, F64, PinholeView, TexturedMesh

TOLERANCE_PX = 3.0
"""How far behind what is seen a vertex may lie and still be seen, in pixels at its depth: the z-buffer holds
one depth a pixel, and of a slanted surface a pixel sees many."""


def camera_of(view: PinholeView) -> PinholeCamera:
    """The camera of a view with the size of its picture."""
    return PinholeCamera.from_matrix(view.P, (view.rgb.shape[1], view.rgb.shape[0]))


def project(camera: PinholeCamera, vertices: F64) -> tuple[F64, F64]:
    """Pixels (N, 2), NaN behind the camera, and depths (N,)."""
    xyz = (vertices @ camera.R.T + camera.t) @ camera.K.T
    depth = xyz[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = np.where(depth[:, None] > 0.0, xyz[:, :2] / depth[:, None], np.nan)
    return xy, depth


def visible_vertices(mesh: TexturedMesh, view: PinholeView, xy: F64, depth: F64, *, threads: int = 1) -> B8:
    """(N,) vertices with pixels ``xy`` and ``depth`` that lie in the picture and behind nothing."""
    camera = camera_of(view)
    buffer = rasterize(mesh.vertices, mesh.faces, camera, threads=threads).depth
    width, height = camera.size
    with np.errstate(invalid="ignore"):
        inside = (xy >= 0.0).all(axis=1) & (xy[:, 0] <= width - 1.0) & (xy[:, 1] <= height - 1.0)
    x, y = np.where(inside[:, None], xy, 0.0).astype(np.int64).T
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    places = ((y, x), (y, right), (below, x), (below, right))
    farthest = np.max([buffer[place] for place in places], axis=0)
    seen = np.all([view.seen[place] for place in places], axis=0)
    slack = TOLERANCE_PX * depth / np.sqrt(camera.K[0, 0] * camera.K[1, 1])
    return np.asarray(inside & seen & (depth <= farthest + slack))


def face_quality(mesh: TexturedMesh, views: Sequence[PinholeView], *, threads: int = 1) -> F32:
    """(M, V) pixels that each face covers in each view, 0 where a view does not see all of its outside."""
    quality = np.zeros((len(mesh.faces), len(views)), dtype=np.float32)
    for v, view in enumerate(views):
        xy, depth = project(camera_of(view), mesh.vertices)
        seen = visible_vertices(mesh, view, xy, depth, threads=threads)
        a, b, c = (xy[mesh.faces[:, k]] for k in range(3))
        # Pixels run downwards: what is anticlockwise outside has a negative area here.
        area = 0.5 * ((c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1]) - (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]))
        whole = seen[mesh.faces].all(axis=1) & (np.nan_to_num(area) > 0.0)
        quality[whole, v] = area[whole]
    return quality


def sample_view(view: PinholeView, xy: F64, image: F32 | None = None) -> F32:
    """Bilinear colours (N, 3) of a view, or of ``image`` (H, W, 3) in its place, at pixels (N, 2)."""
    color = np.zeros((1, len(xy), 3), dtype=np.float32)
    source = view.rgb.astype(np.float32) if image is None else image
    drawn = np.zeros((1, len(xy)), dtype=np.int64)
    sample_texture(source, np.ascontiguousarray(xy, dtype=np.float32)[None], drawn, color)
    sampled: F32 = color[0]
    return sampled


def color_vertices(mesh: TexturedMesh, views: Sequence[PinholeView], *, threads: int = 1) -> TexturedMesh:
    """The mesh with colours of its vertices: the mean over the views that see a vertex, nearer ones and those
    that look at it straight counting more. Grey where none does."""
    total = np.zeros((len(mesh.vertices), 3))
    weight = np.zeros(len(mesh.vertices))
    quality = face_quality(mesh, views, threads=threads)
    for v, view in enumerate(views):
        share = np.zeros(len(mesh.vertices))
        for k in range(3):
            share += np.bincount(mesh.faces[:, k], quality[:, v], minlength=len(share))
        xy = np.nan_to_num(project(camera_of(view), mesh.vertices)[0])
        total += share[:, None] * sample_view(view, xy)
        weight += share
    mean = np.where(weight[:, None] > 0.0, total / np.maximum(weight, 1e-30)[:, None], 128.0)
    return replace(mesh, colors=np.rint(mean).astype(np.uint8), uv=None, texture=None)
