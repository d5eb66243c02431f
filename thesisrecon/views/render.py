"""Rendering of a mesh from any camera, in colour and depth (thesis, section 2.6)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from thesisrecon._numba import empty, kernel
from thesisrecon.arrays import F32, F64, I64, U8
from thesisrecon.camera import Camera
from thesisrecon.imaging.raster import Raster, image_corners, rasterize_rows, run_in_strips, sample_texture
from thesisrecon.records import RenderedView, TexturedMesh

STRIP = 16
"""Rows that are coloured at a time, so that intermediate arrays stay in cache."""
PART_SAMPLES = 2**21
"""Samples that are rasterised at a time in each thread: one takes 20 bytes."""
BARE = (200, 200, 200)
"""Colour of a mesh without texture and vertex colours."""


@kernel
def _unit(x: float, y: float, z: float) -> tuple[float, float, float]:
    length = max(np.sqrt(x * x + y * y + z * z), 1e-20)
    return x / length, y / length, z / length


@kernel
def _shade_points(color: F32, points: F32, normals: F32, eye: F64, lights: F64, ambient: float) -> None:
    """Shade colours (P, 3) in place by Lambert's law; normals are flipped towards the eye.

    ``lights`` (L, 7): 1 and a position, or 0 and the direction towards the light; then its colour.
    """
    light = empty(3)
    for p in range(color.shape[0]):
        px, py, pz = points[p, 0], points[p, 1], points[p, 2]
        nx, ny, nz = _unit(normals[p, 0], normals[p, 1], normals[p, 2])
        ex, ey, ez = _unit(eye[0] - px, eye[1] - py, eye[2] - pz)
        if nx * ex + ny * ey + nz * ez < 0.0:
            nx, ny, nz = -nx, -ny, -nz
        light[:] = ambient
        for k in range(lights.shape[0]):
            at = lights[k, 0]
            lx, ly, lz = _unit(lights[k, 1] - at * px, lights[k, 2] - at * py, lights[k, 3] - at * pz)
            cosine = nx * lx + ny * ly + nz * lz
            if cosine > 0.0:
                for c in range(3):
                    light[c] += cosine * lights[k, 4 + c]
        for c in range(3):
            color[p, c] = np.float32(color[p, c] * light[c])


@kernel
def _average_blocks(color: F32, drawn: I64, samples: int, background: F32, out: U8) -> None:
    """Average blocks of ``samples`` x ``samples`` pixels; those with negative ``drawn`` are background."""
    total = empty(3, np.float32)
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
    """A light source at a position or at infinity.

    Parameters
    ----------
    direction, position : tuple of float, optional
        Direction towards a distant light or position of a point light; exactly one of them is given.
    color : tuple of float
        Strength in red, green and blue; 1 leaves the texture as it is.
    """

    direction: tuple[float, float, float] | None = None
    position: tuple[float, float, float] | None = None
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        if (self.direction is None) == (self.position is None):
            raise ValueError("a Light has either a direction or a position")
        if self.direction is not None and not np.linalg.norm(self.direction) > 0.0:
            raise ValueError("the direction of a Light must not be zero")

    @property
    def _row(self) -> list[float]:
        """Row of ``lights`` in :func:`_shade_points`."""
        place = self.direction if self.position is None else self.position
        return [float(self.position is not None), *(place or (0.0, 0.0, 0.0)), *self.color]


@dataclass(frozen=True)
class Shading:
    """Ambient light and light sources. Both sides of a surface are lit equally.

    Parameters
    ----------
    ambient, lights : float, tuple of Light
        Ambient light and light sources.
    """

    ambient: float = 0.3
    lights: tuple[Light, ...] = ()


def _vertex_normals(mesh: TexturedMesh) -> F64:
    """Unit normals (N, 3), area-weighted means over the adjacent faces; zero for unused vertices."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    count, corner = len(mesh.vertices), mesh.faces.ravel()
    total = np.stack([np.bincount(corner, normal[:, d], count) for d in range(3)], axis=1)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None])


def render_mesh(
    mesh: TexturedMesh,
    camera: Camera,
    *,
    shading: Shading | None = None,
    background: tuple[int, int, int] = (0, 0, 0),
    samples: int = 2,
    threads: int = 1,
) -> RenderedView:
    """Render a mesh; arguments as for :func:`thesisrecon.render`."""
    shape = camera.size[::-1]
    rgb, depth = np.empty((*shape, 3), dtype=np.uint8), np.empty(shape, dtype=np.float32)
    valid = np.empty(shape, dtype=bool)
    behind = np.asarray(background, dtype=np.float32)
    values = mesh.colors if mesh.texture is None or mesh.uv is None else mesh.uv
    source = None if values is None else np.ascontiguousarray(values, dtype=np.float32)
    lit: list[F32] = []
    if shading is not None:
        # About the camera: single precision would round coordinates of a map grid.
        shading = _moved(shading, camera.centre)
        lit = [a.astype(np.float32) for a in (mesh.vertices - camera.centre, _vertex_normals(mesh))]

    def measure(start: int, stop: int, raster: Raster) -> None:
        valid[start:stop] = raster.face >= 0
        depth[start:stop] = np.where(valid[start:stop], raster.depth, np.float32(np.nan))

    def paint(start: int, stop: int, raster: Raster) -> None:
        for first in range(start, stop, STRIP):
            last = min(first + STRIP, stop)
            part = raster[samples * (first - start) : samples * (last - start)]
            color = _colors(mesh, source, part)
            if shading is not None:
                points, normals = (part.interpolate(v, mesh.faces).reshape(-1, 3) for v in lit)
                _shade(color.reshape(-1, 3), points, normals, np.zeros(3), shading)
            _average_blocks(color, part.face, samples, behind, rgb[first:last])

    if samples == 1:
        _in_parts(mesh, camera, 1, threads, measure, paint)
    else:
        _in_parts(mesh, camera, 1, threads, measure)
        _in_parts(mesh, camera.scaled(samples), samples, threads, paint)
    return RenderedView(rgb, depth, valid)


def _in_parts(
    mesh: TexturedMesh, camera: Camera, samples: int, threads: int, *uses: Callable[[int, int, Raster], None]
) -> None:
    """Rasterise parts of an image (first row, last + 1) with ``samples`` rows per row, and use each."""
    corners, near = image_corners(mesh.vertices, mesh.faces, camera)
    width, height = camera.size
    step = max(PART_SAMPLES // (samples * width), 1)

    def work(rows: tuple[int, int]) -> None:
        for first in range(rows[0], rows[1], step):
            last = min(first + step, rows[1])
            raster = rasterize_rows(corners, near, (samples * first, samples * last), width)
            for use in uses:
                use(first, last, raster)

    run_in_strips(work, height // samples, threads)


def _colors(mesh: TexturedMesh, source: F32 | None, raster: Raster) -> F32:
    """Unlit colours (H, W, 3), 0 to 255; ``source``: texture coordinates, colours of the vertices or None."""
    if source is None:
        return np.tile(np.asarray(BARE, dtype=np.float32), (*raster.face.shape, 1))
    if mesh.texture is None or mesh.uv is None:
        return raster.interpolate(source, mesh.faces)
    color = np.zeros((*raster.face.shape, 3), dtype=np.float32)
    sample_texture(mesh.texture, raster.interpolate(source), raster.face, color)
    return color


def _moved(shading: Shading, origin: F64) -> Shading:
    """The shading in coordinates about another origin."""
    lights = (
        light
        if light.position is None
        else replace(light, position=tuple(np.subtract(light.position, origin)))
        for light in shading.lights
    )
    return replace(shading, lights=tuple(lights))


def _shade(color: F32, points: F32, normals: F32, eye: F64, shading: Shading) -> None:
    """Shade the colours (P, 3) of surface points in place."""
    lights = np.array([light._row for light in shading.lights], dtype=np.float64).reshape(-1, 7)
    _shade_points(color, points, normals, np.asarray(eye, dtype=np.float64), lights, float(shading.ambient))
