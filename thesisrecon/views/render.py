"""Rendering of a mesh from any camera, in colour and depth (thesis, section 2.6), and similarity of images.

PSNR and SSIM of a rendered and a real image (H, W, 3) of uint8 use the pixels ``compared`` (H, W).
"""

from collections.abc import Callable

import numpy as np
import scipy

from thesisrecon._numba import empty, kernel
from thesisrecon.arrays import B8, F32, F64, I64, U8
from thesisrecon.camera import Camera
from thesisrecon.imaging.raster import (
    Raster,
    raster_of_camera,
    run_in_strips,
    sample_texture,
    vertex_normals,
)
from thesisrecon.records import RenderedView, TexturedMesh

STRIP = 16  #: rows that are coloured at a time, so that intermediate arrays stay in cache
PART_SAMPLES = 2**21  #: samples that are rasterised at a time in each thread: one takes 20 bytes


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


def render_mesh(
    mesh: TexturedMesh, camera: Camera, *, background: tuple[int, int, int] = (0, 0, 0), samples: int = 2,
    threads: int = 1,
) -> RenderedView:  # fmt: skip
    """Render a mesh; arguments as for :func:`thesisrecon.render`."""
    shape = camera.size[::-1]
    rgb, depth = np.empty((*shape, 3), dtype=np.uint8), np.empty(shape, dtype=np.float32)
    valid = np.empty(shape, dtype=bool)
    behind = np.asarray(background, dtype=np.float32)
    values = mesh.colors if mesh.texture is None or mesh.uv is None else mesh.uv
    source = None if values is None else np.ascontiguousarray(values, dtype=np.float32)
    lit: list[F32] = []
    if source is None:
        # About the camera: single precision would round coordinates of a map grid.
        lit = [a.astype(np.float32) for a in (mesh.vertices - camera.centre, vertex_normals(mesh))]

    def measure(start: int, stop: int, raster: Raster) -> None:
        valid[start:stop] = raster.face >= 0
        depth[start:stop] = np.where(valid[start:stop], raster.depth, np.float32(np.nan))

    def paint(start: int, stop: int, raster: Raster) -> None:
        for first in range(start, stop, STRIP):
            last = min(first + STRIP, stop)
            part = raster[samples * (first - start) : samples * (last - start)]
            if source is None:
                color = _lit(*(part.interpolate(v, mesh.faces) for v in lit))
            else:
                color = _colors(mesh, source, part)
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
    find, (width, height) = raster_of_camera(mesh.vertices, mesh.faces, camera, threads), camera.size
    step = max(PART_SAMPLES // (samples * width), 1)

    def work(rows: tuple[int, int]) -> None:
        for first in range(rows[0], rows[1], step):
            last = min(first + step, rows[1])
            raster = find((samples * first, samples * last))
            for use in uses:
                use(first, last, raster)

    run_in_strips(work, height // samples, threads)


def _lit(points: F32, normals: F32) -> F32:
    """Grey levels (H, W, 3) of a bare surface by Lambert's law, with a lamp at the camera, the origin."""
    ambient, lamp = 60.0, 160.0
    length = np.linalg.norm(points, axis=2) * np.linalg.norm(normals, axis=2)
    cosine = np.abs(np.sum(points * normals, axis=2)) / np.maximum(length, 1e-20)
    return np.repeat((ambient + lamp * cosine).astype(np.float32)[..., None], 3, axis=2)


def _colors(mesh: TexturedMesh, source: F32, raster: Raster) -> F32:
    """Colours (H, W, 3), 0 to 255; ``source``: texture coordinates, or colours of the vertices."""
    if mesh.texture is None or mesh.uv is None:
        return raster.interpolate(source, mesh.faces)
    color = np.zeros((*raster.face.shape, 3), dtype=np.float32)
    sample_texture(mesh.texture, raster.interpolate(source), raster.face, color)
    return color


GREY = np.array([0.299, 0.587, 0.114])  # Luma weights of Rec. 601.


def covered_pixels(rendered: RenderedView) -> B8:
    """The pixels (H, W) whose eight neighbours are covered too; others blend with the background."""
    return np.asarray(scipy.ndimage.binary_erosion(rendered.valid, np.ones((3, 3))))


def match_exposure(real: U8, rendered: U8, compared: B8) -> U8:
    """Match the exposure of a rendered image to a real one by one factor per channel (least squares)."""
    a, b = real[compared].astype(np.float64), rendered[compared].astype(np.float64)
    factor = (a * b).sum(axis=0) / np.maximum((b * b).sum(axis=0), 1.0)
    return np.asarray(np.clip(np.rint(rendered * factor), 0.0, 255.0), dtype=np.uint8)


def psnr_db(real: U8, rendered: U8, compared: B8) -> float:
    """Peak signal-to-noise ratio over all channels; infinite for equal images."""
    apart = (real.astype(np.float64) - rendered)[compared]
    mean_square = float(np.mean(apart**2))
    return float("inf") if mean_square == 0.0 else float(10.0 * np.log10(255.0**2 / mean_square))


def ssim(real: U8, rendered: U8, compared: B8) -> float:
    """Mean structural similarity of the luma (Wang, Bovik, Sheikh and Simoncelli 2004)."""
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


def _windowed(values: F64) -> F64:
    """Gaussian-weighted means (H, W), zero beyond the border."""
    window_px = 1.5  # Standard deviation of the Gaussian window of SSIM
    return np.asarray(scipy.ndimage.gaussian_filter(values, window_px, mode="constant", truncate=3.5))
