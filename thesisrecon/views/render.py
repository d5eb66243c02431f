"""Rendering of a mesh from any camera, in colour and depth (thesis, section 2.6), and similarity of images.

PSNR and SSIM of a rendered and a real image (H, W, 3) of uint8 use the pixels ``compared`` (H, W).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon._numba import empty, kernel
from thesisrecon.arrays import B8, F32, F64, I64, U8
from thesisrecon.camera import Camera
from thesisrecon.imaging.raster import (
    Raster,
    image_corners,
    rasterize_rows,
    run_in_strips,
    sample_texture,
    vertex_normals,
)
from thesisrecon.records import RenderedView, TexturedMesh

STRIP = 16  #: rows that are coloured at a time, so that intermediate arrays stay in cache
PART_SAMPLES = 2**21  #: samples that are rasterised at a time in each thread: one takes 20 bytes


@kernel
def _unit(x: float, y: float, z: float) -> tuple[float, float, float]:
    length = max(np.sqrt(x * x + y * y + z * z), 1e-20)
    return x / length, y / length, z / length


@kernel
def _shade_points(color: F32, points: F32, normals: F32, lights: F64, ambient: float) -> None:
    """Shade colours (P, 3) in place by Lambert's law; normals are flipped towards the eye at 0."""
    # `lights` (L, 7): 1 and a position, or 0 and the direction towards the light; then its colour.
    light = empty(3)
    for p in range(color.shape[0]):
        px, py, pz = points[p, 0], points[p, 1], points[p, 2]
        nx, ny, nz = _unit(normals[p, 0], normals[p, 1], normals[p, 2])
        ex, ey, ez = _unit(-px, -py, -pz)
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
    """A light source at a position or at infinity."""

    direction: tuple[float, float, float] | None = None  #: towards a distant light
    position: tuple[float, float, float] | None = None  #: of a point light; exactly one of both is given
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)  #: 1 leaves the texture as it is

    def __post_init__(self) -> None:
        if (self.direction is None) == (self.position is None):
            raise ValueError("a Light has either a direction or a position")
        if self.direction is not None and not np.linalg.norm(self.direction) > 0.0:
            raise ValueError("the direction of a Light must not be zero")


@dataclass(frozen=True)
class Shading:
    """Ambient light and light sources. Both sides of a surface are lit equally."""

    ambient: float = 0.3
    lights: tuple[Light, ...] = ()


def render_mesh(
    mesh: TexturedMesh, camera: Camera, *, shading: Shading | None = None,
    background: tuple[int, int, int] = (0, 0, 0), samples: int = 2, threads: int = 1,
) -> RenderedView:  # fmt: skip
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
        lights = _light_rows(shading, camera.centre)
        lit = [a.astype(np.float32) for a in (mesh.vertices - camera.centre, vertex_normals(mesh))]

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
                _shade_points(color.reshape(-1, 3), points, normals, lights, shading.ambient)
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
    bare = (200, 200, 200)  # Colour of a mesh without texture and vertex colours
    if source is None:
        return np.tile(np.asarray(bare, dtype=np.float32), (*raster.face.shape, 1))
    if mesh.texture is None or mesh.uv is None:
        return raster.interpolate(source, mesh.faces)
    color = np.zeros((*raster.face.shape, 3), dtype=np.float32)
    sample_texture(mesh.texture, raster.interpolate(source), raster.face, color)
    return color


def _light_rows(shading: Shading, origin: F64) -> F64:
    """Rows (L, 7) of the lights for :func:`_shade_points`, in coordinates about an origin."""
    rows = [
        (1.0, *np.subtract(light.position, origin), *light.color)
        if light.position is not None
        else (0.0, *(light.direction or ()), *light.color)
        for light in shading.lights
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 7)


GREY = np.array([0.299, 0.587, 0.114])  # Luma weights of Rec. 601.


def covered_pixels(rendered: RenderedView) -> B8:
    """The pixels (H, W) whose eight neighbours are covered too; others blend with the background."""
    return np.asarray(scipy.ndimage.binary_erosion(rendered.valid, np.ones((3, 3))))


def match_exposure(real: U8, rendered: U8, compared: B8) -> U8:
    """Match the exposure of a rendered image to a real one by one factor per channel (least squares)."""
    _check(real, rendered, compared)
    a, b = real[compared].astype(np.float64), rendered[compared].astype(np.float64)
    factor = (a * b).sum(axis=0) / np.maximum((b * b).sum(axis=0), 1.0)
    return np.asarray(np.clip(np.rint(rendered * factor), 0.0, 255.0), dtype=np.uint8)


def psnr_db(real: U8, rendered: U8, compared: B8) -> float:
    """Peak signal-to-noise ratio over all channels; infinite for equal images."""
    _check(real, rendered, compared)
    apart = (real.astype(np.float64) - rendered)[compared]
    mean_square = float(np.mean(apart**2))
    return float("inf") if mean_square == 0.0 else float(10.0 * np.log10(255.0**2 / mean_square))


def ssim(real: U8, rendered: U8, compared: B8) -> float:
    """Mean structural similarity of the luma (Wang, Bovik, Sheikh and Simoncelli 2004)."""
    _check(real, rendered, compared)
    return float(np.mean(_ssim_map(real, rendered, compared)[compared]))


def _ssim_map(real: U8, rendered: U8, compared: B8) -> F64:
    # Stabilising constants of SSIM for dark and uniform regions.
    floor_luminance, floor_contrast = (0.01 * 255.0) ** 2, (0.03 * 255.0) ** 2
    a, b = (np.where(compared, picture @ GREY, 0.0) for picture in (real, rendered))
    share = np.maximum(_windowed(compared.astype(np.float64)), 1e-6)
    mean_a, mean_b = _windowed(a) / share, _windowed(b) / share
    spread_a = _windowed(a * a) / share - mean_a**2
    spread_b = _windowed(b * b) / share - mean_b**2
    common = _windowed(a * b) / share - mean_a * mean_b
    luminance = (2.0 * mean_a * mean_b + floor_luminance) / (mean_a**2 + mean_b**2 + floor_luminance)
    structure = (2.0 * common + floor_contrast) / (spread_a + spread_b + floor_contrast)
    return np.asarray(luminance * structure)


def _check(real: U8, rendered: U8, compared: B8) -> None:
    if real.shape != rendered.shape or real.shape != (*compared.shape, 3):
        shapes = f"{real.shape}, {rendered.shape} and {compared.shape}"
        raise ValueError(f"images and mask must have the same size; got {shapes}")
    if not compared.any():
        raise ValueError("no pixel is shown by both images")


def _windowed(values: F64) -> F64:
    """Gaussian-weighted means (H, W), zero beyond the border."""
    window_px = 1.5  # Standard deviation of the Gaussian window of SSIM
    return np.asarray(scipy.ndimage.gaussian_filter(values, window_px, mode="constant", truncate=3.5))
