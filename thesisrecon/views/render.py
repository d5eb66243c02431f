"""Section 2.6: the model seen by any camera, in colour and depth."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from thesisrecon.types import F32, F64, I64, RenderedView, TexturedMesh
from thesisrecon.views.camera import PinholeCamera
from thesisrecon.views.kernels import interpolate_corners, rasterize_rows, sample_texture
from thesisrecon.views.shading import Shading, vertex_normals

BARE = (200, 200, 200)
"""Colour of a mesh that has none."""

NEAR = 1e-6
"""Nearest depth that is drawn, in units of the distance from the camera to the farthest vertex."""


@dataclass(frozen=True)
class Raster:
    """What a camera sees of a mesh before it has colours: ``depth`` (H, W) float32, inf where nothing is;
    ``face`` (H, W) int64, -1 where none; ``weights`` (H, W, 2) float32, the barycentric coordinates of the
    face's corners 1 and 2."""

    depth: F32
    face: I64
    weights: F32

    def interpolate(self, values: F64 | F32) -> F32:
        """Values (M, 3, C) of the corners of all faces, at every pixel (H, W, C); 0 where no face is."""
        out = np.zeros((*self.face.shape, values.shape[2]), dtype=np.float32)
        interpolate_corners(self.face, self.weights, np.ascontiguousarray(values, dtype=np.float32), out)
        return out


def rasterize(vertices: F64, faces: I64, camera: PinholeCamera, *, threads: int = 1) -> Raster:
    """Which face is seen at the centre of each pixel.

    ``vertices`` (N, 3), ``faces`` (M, 3); both sides of a face are seen. ``threads`` draw strips of rows: the
    result is the same whatever their number.
    """
    width, height = camera.size
    seen = (vertices @ camera.R.T + camera.t) @ (camera.K / camera.K[2, 2]).T
    corners = np.ascontiguousarray(seen[faces])
    near = NEAR * max(float(np.abs(seen[:, 2]).max(initial=0.0)), 1e-300)
    depth = np.full((height, width), np.inf, dtype=np.float32)
    face = np.full((height, width), -1, dtype=np.int64)
    weights = np.zeros((height, width, 2), dtype=np.float32)

    def draw(rows: tuple[int, int]) -> None:
        rasterize_rows(corners, near, rows, depth, face, weights)

    _in_strips(draw, height, threads)
    return Raster(depth, face, weights)


def _in_strips(work: Callable[[tuple[int, int]], None], height: int, threads: int) -> None:
    edges = np.linspace(0, height, max(threads, 1) + 1).round().astype(int)
    strips = [(int(a), int(b)) for a, b in pairwise(edges)]
    if len(strips) == 1:
        work(strips[0])
        return
    with ThreadPoolExecutor(len(strips)) as pool:
        list(pool.map(work, strips))


def render(
    mesh: TexturedMesh,
    camera: PinholeCamera,
    *,
    shading: Shading | None = None,
    background: tuple[int, int, int] = (0, 0, 0),
    samples: int = 2,
    threads: int = 1,
) -> RenderedView:
    """The mesh as ``camera`` sees it.

    Parameters
    ----------
    mesh : with a texture, colours of its vertices, or neither (then light grey).
    camera : where from; any pose, also within the model.
    shading : lights; None shows colours as they were photographed. A bare mesh is best seen with a light.
    background : colour where nothing is.
    samples : points a side that each pixel's colour is the mean of, at least 1. Depth and validity are
        those of the pixel's centre.
    threads : draw strips of rows; the picture does not depend on them.

    Raises
    ------
    ValueError : for fewer than one sample and a mesh whose arrays do not belong together.
    """
    if samples < 1:
        raise ValueError(f"render needs at least one sample a side; got {samples}")
    _check(mesh)
    centre = rasterize(mesh.vertices, mesh.faces, camera, threads=threads)
    valid = centre.face >= 0
    depth = np.where(valid, centre.depth, np.float32(np.nan)).astype(np.float32)
    if samples == 1:
        fine = centre
    else:
        fine = rasterize(mesh.vertices, mesh.faces, camera.resized(samples), threads=threads)
    color = _colors(mesh, fine)
    if shading is not None:
        color = _lit(mesh, fine, color, camera, shading)
    color[fine.face < 0] = background
    width, height = camera.size
    color = color.reshape(height, samples, width, samples, 3).mean(axis=(1, 3))
    rgb = np.clip(np.rint(color), 0, 255).astype(np.uint8)
    return RenderedView(rgb, depth, valid)


def _check(mesh: TexturedMesh) -> None:
    if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise ValueError("the faces of the mesh name vertices that it does not have")
    if mesh.uv is not None and mesh.uv.shape != (len(mesh.faces), 3, 2):
        raise ValueError(f"uv must be ({len(mesh.faces)}, 3, 2); got {mesh.uv.shape}")
    if mesh.colors is not None and mesh.colors.shape != mesh.vertices.shape:
        raise ValueError(f"colors must be {mesh.vertices.shape}; got {mesh.colors.shape}")


def _colors(mesh: TexturedMesh, raster: Raster) -> F32:
    """(H, W, 3) 0..255 before any light."""
    if mesh.texture is not None and mesh.uv is not None:
        color = np.zeros((*raster.face.shape, 3), dtype=np.float32)
        sample_texture(mesh.texture.astype(np.float32), raster.interpolate(mesh.uv), raster.face, color)
        return color
    if mesh.colors is not None:
        return raster.interpolate(mesh.colors[mesh.faces].astype(np.float32))
    return np.tile(np.asarray(BARE, dtype=np.float32), (*raster.face.shape, 1))


def _lit(mesh: TexturedMesh, raster: Raster, color: F32, camera: PinholeCamera, shading: Shading) -> F32:
    drawn = raster.face >= 0
    points = raster.interpolate(mesh.vertices[mesh.faces])[drawn]
    normals = raster.interpolate(vertex_normals(mesh)[mesh.faces])[drawn]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.float32(1e-20))
    color = color.copy()
    color[drawn] = shading.shade(color[drawn], points, normals, camera.centre)
    return color


def bare(mesh: TexturedMesh) -> TexturedMesh:
    """The shape alone, without texture and colours."""
    return replace(mesh, colors=None, uv=None, texture=None)
