"""Compiled loops of rendering; each has a plain twin in the tests.

Light sources and the way a surface answers to them (2.6): Lambert's law and a highlight.

Section 2.6: the model seen by any camera, in colour and depth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from thesisrecon.arrays import F32, F64, I64
from thesisrecon.camera import Camera
from thesisrecon.geometry.zbuffer import Raster, in_strips, rasterize, sample_texture
from thesisrecon.records import RenderedView, TexturedMesh


@njit(cache=True, nogil=True)
def sum_face_normals(vertices: F64, faces: I64, total: F64) -> None:
    """Add to ``total`` (N, 3), for each vertex, the cross products of the sides of its faces: their normals
    by twice their areas."""
    for m in range(faces.shape[0]):
        i, j, l = faces[m, 0], faces[m, 1], faces[m, 2]
        ux, uy, uz = (
            vertices[j, 0] - vertices[i, 0],
            vertices[j, 1] - vertices[i, 1],
            vertices[j, 2] - vertices[i, 2],
        )
        vx, vy, vz = (
            vertices[l, 0] - vertices[i, 0],
            vertices[l, 1] - vertices[i, 1],
            vertices[l, 2] - vertices[i, 2],
        )
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for v in (i, j, l):
            total[v, 0] += nx
            total[v, 1] += ny
            total[v, 2] += nz


@njit(cache=True, nogil=True)
def _unit(x: float, y: float, z: float) -> tuple[float, float, float]:
    length = max(np.sqrt(x * x + y * y + z * z), 1e-20)
    return x / length, y / length, z / length


@njit(cache=True, nogil=True)
def shade_points(
    color: F32, points: F32, normals: F32, eye: F64, lamps: F64, surface: tuple[float, float, float]
) -> None:
    """Turn colours (P, 3), 0 to 255, into what the eye (3,) sees of them under lamps.

    ``points``, ``normals`` (P, 3), the latter of any length, turned towards the eye; those of length 0 have
    no lamp's light. ``lamps`` (L, 7): 1 and a position, or 0 and the direction towards the lamp, and its
    colour. ``surface``: ambient light, strength and exponent of the highlight.
    """
    ambient, specular, shininess = surface
    for p in range(color.shape[0]):
        px, py, pz = points[p, 0], points[p, 1], points[p, 2]
        nx, ny, nz = _unit(normals[p, 0], normals[p, 1], normals[p, 2])
        ex, ey, ez = _unit(eye[0] - px, eye[1] - py, eye[2] - pz)
        if nx * ex + ny * ey + nz * ez < 0.0:
            nx, ny, nz = -nx, -ny, -nz
        light_r = light_g = light_b = ambient
        shine_r = shine_g = shine_b = 0.0
        for k in range(lamps.shape[0]):
            at = lamps[k, 0]
            lx, ly, lz = _unit(lamps[k, 1] - at * px, lamps[k, 2] - at * py, lamps[k, 3] - at * pz)
            cosine = nx * lx + ny * ly + nz * lz
            if cosine <= 0.0:
                continue
            light_r += cosine * lamps[k, 4]
            light_g += cosine * lamps[k, 5]
            light_b += cosine * lamps[k, 6]
            if specular > 0.0:
                hx, hy, hz = _unit(lx + ex, ly + ey, lz + ez)
                shine = 255.0 * specular * max(nx * hx + ny * hy + nz * hz, 0.0) ** shininess
                shine_r += shine * lamps[k, 4]
                shine_g += shine * lamps[k, 5]
                shine_b += shine * lamps[k, 6]
        color[p, 0] = np.float32(color[p, 0] * light_r + shine_r)
        color[p, 1] = np.float32(color[p, 1] * light_g + shine_g)
        color[p, 2] = np.float32(color[p, 2] * light_b + shine_b)


@njit(cache=True, nogil=True)
def average_blocks(color: F32, drawn: I64, samples: int, background: F32, out: np.ndarray) -> None:
    """Means of ``samples`` x ``samples`` blocks of colours (samples H, samples W, 3), the background (3,)
    where ``drawn`` < 0, rounded into ``out`` (H, W, 3) uint8."""
    total = np.empty(3, dtype=np.float32)
    share = np.float32(1.0 / (samples * samples))
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            total[:] = np.float32(0.0)
            for v in range(samples * y, samples * (y + 1)):
                for u in range(samples * x, samples * (x + 1)):
                    for k in range(3):
                        total[k] += color[v, u, k] if drawn[v, u] >= 0 else background[k]
            for k in range(3):
                out[y, x, k] = np.uint8(min(max(np.rint(total[k] * share), 0.0), 255.0))


@dataclass(frozen=True)
class Light:
    """A lamp: at ``position`` (3,), or far away in ``direction`` (3,), the one towards it; ``color`` is its
    strength in red, green and blue, 1 as bright as the texture says. Exactly one of the two is given."""

    direction: tuple[float, float, float] | None = None
    position: tuple[float, float, float] | None = None
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        if (self.direction is None) == (self.position is None):
            raise ValueError("a Light has either a direction or a position")
        if self.direction is not None and not np.linalg.norm(self.direction) > 0.0:
            raise ValueError("the direction of a Light must not be zero")

    @property
    def row(self) -> list[float]:
        """As :func:`~thesisrecon.views.render.shade_points` takes it."""
        if self.position is not None:
            return [1.0, *self.position, *self.color]
        return [0.0, *(self.direction or (0.0, 0.0, 0.0)), *self.color]


@dataclass(frozen=True)
class Shading:
    """Light everywhere (``ambient``), ``lights``, and a highlight (Blinn 1977) of strength ``specular`` and
    width by ``shininess``. Both sides of a surface answer alike. Photographs hold the light they were taken
    in: a texture is as it was seen without any shading."""

    ambient: float = 0.3
    lights: tuple[Light, ...] = ()
    specular: float = 0.0
    shininess: float = 30.0

    def shade(self, color: F32, points: F32, normals: F32, eye: F64) -> None:
        """Light colours (P, 3), 0 to 255, in place, of points (P, 3) seen from ``eye`` (3,), with
        normals (P, 3) of any length."""
        lamps = np.array([light.row for light in self.lights], dtype=np.float64).reshape(-1, 7)
        surface = (float(self.ambient), float(self.specular), float(self.shininess))
        shade_points(color, points, normals, np.asarray(eye, dtype=np.float64), lamps, surface)


def vertex_normals(mesh: TexturedMesh) -> F64:
    """Unit normals (N, 3): the mean over the faces at a vertex, by their area."""
    total = np.zeros_like(mesh.vertices)
    sum_face_normals(mesh.vertices, mesh.faces, total)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None])


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
    camera: Camera,
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
