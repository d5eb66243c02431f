"""Section 2.6: the model seen by any camera, in colour and depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thesisrecon.geometry.pinhole import PinholeCamera
from thesisrecon.geometry.zbuffer import Raster, rasterize, sample_texture
from thesisrecon.types import F32, RenderedView, TexturedMesh
from thesisrecon.views.shading import Shading, vertex_normals

BARE = (200, 200, 200)
"""Colour of a mesh that has none."""


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
