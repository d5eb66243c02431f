"""Section 2.6: the model seen by any camera, in colour and depth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.pinhole import PinholeCamera
from thesisrecon.geometry.zbuffer import Raster, in_strips, rasterize, sample_texture
from thesisrecon.types import F32, F64, I64, RenderedView, TexturedMesh
from thesisrecon.views.kernels import average_blocks
from thesisrecon.views.shading import Shading, vertex_normals

STRIP = 16
"""Rows that are coloured at a time."""

BARE = (200, 200, 200)
"""Colour of a mesh that has none."""


@dataclass(frozen=True)
class _Surface:
    """A mesh as the kernels take it: ``points``, ``normals``, ``colors`` (N, 3) of its vertices, ``uv``
    (M, 3, 2); what is not drawn is None."""

    faces: I64
    points: F32 | None
    normals: F32 | None
    colors: F32 | None
    uv: F32 | None
    texture: NDArray[np.uint8] | None


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
    rgb = np.empty((*valid.shape, 3), dtype=np.uint8)
    behind = np.asarray(background, dtype=np.float32)
    surface = _prepared(mesh, lit=shading is not None)

    def paint(rows: tuple[int, int]) -> None:
        # A few rows at a time: what lies between is soon used, and little.
        for first in range(rows[0], rows[1], STRIP):
            last = min(first + STRIP, rows[1])
            part = fine.rows(samples * first, samples * last)
            color = _colors(surface, part)
            if shading is not None:
                _light(surface, part, color, camera.centre, shading)
            average_blocks(color, part.face, samples, behind, rgb[first:last])

    in_strips(paint, len(rgb), threads)
    return RenderedView(rgb, depth, valid)


def _check(mesh: TexturedMesh) -> None:
    if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise ValueError("the faces of the mesh name vertices that it does not have")
    if mesh.uv is not None and mesh.uv.shape != (len(mesh.faces), 3, 2):
        raise ValueError(f"uv must be ({len(mesh.faces)}, 3, 2); got {mesh.uv.shape}")
    if mesh.colors is not None and mesh.colors.shape != mesh.vertices.shape:
        raise ValueError(f"colors must be {mesh.vertices.shape}; got {mesh.colors.shape}")


def _prepared(mesh: TexturedMesh, *, lit: bool) -> _Surface:
    textured = mesh.texture is not None and mesh.uv is not None
    return _Surface(
        mesh.faces,
        points=mesh.vertices.astype(np.float32) if lit else None,
        normals=vertex_normals(mesh).astype(np.float32) if lit else None,
        colors=None if mesh.colors is None or textured else mesh.colors.astype(np.float32),
        uv=None if mesh.uv is None or not textured else np.ascontiguousarray(mesh.uv, dtype=np.float32),
        texture=mesh.texture if textured else None,
    )


def _colors(surface: _Surface, raster: Raster) -> F32:
    """(H, W, 3) 0..255 before any light."""
    if surface.texture is not None and surface.uv is not None:
        color = np.zeros((*raster.face.shape, 3), dtype=np.float32)
        sample_texture(surface.texture, raster.interpolate(surface.uv), raster.face, color)
        return color
    if surface.colors is not None:
        return raster.interpolate_vertices(surface.faces, surface.colors)
    return np.tile(np.asarray(BARE, dtype=np.float32), (*raster.face.shape, 1))


def _light(surface: _Surface, raster: Raster, color: F32, eye: F64, shading: Shading) -> None:
    """Shade the colours (H, W, 3) in place."""
    assert surface.points is not None
    assert surface.normals is not None
    points = raster.interpolate_vertices(surface.faces, surface.points).reshape(-1, 3)
    normals = raster.interpolate_vertices(surface.faces, surface.normals).reshape(-1, 3)
    shading.shade(color.reshape(-1, 3), points, normals, eye)


def bare(mesh: TexturedMesh) -> TexturedMesh:
    """The shape alone, without texture and colours."""
    return replace(mesh, colors=None, uv=None, texture=None)
