"""From linear light to an image: lens blur, vignetting, exposure, noise, tone curve, JPEG."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from thesisrecon.arrays import F32, U8
from validation.scenes.pose import Pose
from validation.scenes.raycast import World, trace
from validation.scenes.real import write_png

PER_PIXEL = 2


class Sensor(NamedTuple):
    """An ordinary camera. ``blur_px`` Gaussian point spread (before the pixel's own square), ``vignetting``
    loss of light at the corner, ``full_well`` electrons at white, ``read_noise`` electrons.
    """

    blur_px: float = 0.42
    vignetting: float = 0.16
    full_well: float = 6000.0
    read_noise: float = 6.0


def _convolve_rows(a: F32, weights: list[float]) -> F32:
    radius = len(weights) // 2
    padded = np.pad(a, ((radius, radius), (0, 0), (0, 0)), mode="edge")
    total = np.zeros_like(a)
    for k, weight in enumerate(weights):
        total += np.float32(weight) * padded[k : k + a.shape[0]]
    return total


def integrate_pixels(samples: F32, per_pixel: int, blur_px: float) -> F32:
    """Blur and bin: (H n, W n, 3) samples -> (H, W, 3) linear light; nothing is shifted."""
    sigma = blur_px * per_pixel
    radius = round(3 * sigma)
    weights = [float(np.exp(-0.5 * (k / sigma) ** 2)) for k in range(-radius, radius + 1)]
    weights = [w / sum(weights) for w in weights]
    a = _convolve_rows(samples, weights)
    a = _convolve_rows(np.ascontiguousarray(a.transpose(1, 0, 2)), weights).transpose(1, 0, 2)
    total = np.zeros((a.shape[0] // per_pixel, a.shape[1] // per_pixel, 3), np.float32)
    for r in range(per_pixel):
        for c in range(per_pixel):
            total += a[r::per_pixel, c::per_pixel]
    return (total / np.float32(per_pixel**2)).astype(np.float32)


def expose(light: F32, sensor: Sensor, *, gains: tuple[float, float, float], rng: np.random.Generator) -> U8:
    """8-bit image of linear light (H, W, 3); ``gains`` = exposure times white balance per channel."""
    height, width = light.shape[:2]
    y = (np.arange(height) - 0.5 * (height - 1))[:, None] / (0.5 * width)
    x = (np.arange(width) - 0.5 * (width - 1))[None, :] / (0.5 * width)
    corner = 1.0 + (height / width) ** 2
    falloff = 1.0 - sensor.vignetting * (x * x + y * y) / corner
    electrons = np.clip(light * np.array(gains) * falloff[..., None], 0.0, 1.6) * sensor.full_well
    noisy = electrons + np.sqrt(electrons + sensor.read_noise**2) * rng.standard_normal(light.shape)
    return _develop(noisy / sensor.full_well)


def take_image(
    world: World,
    pose: Pose,
    size: tuple[int, int],
    rng: np.random.Generator,
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> U8:
    """Return the image (H, W, 3) of one camera, ``PER_PIXEL`` samples a pixel along each axis."""
    sensor, (red, green, blue) = Sensor(), (0.82 * pose.exposure * gain for gain in balance)
    light = integrate_pixels(trace(world, pose, size, per_pixel=PER_PIXEL)[0], PER_PIXEL, sensor.blur_px)
    return expose(light, sensor, gains=(red, green, blue), rng=rng)


def write_images(
    folder: Path, world: World, poses: Mapping[int, Pose], size: tuple[int, int], seed: Sequence[int],
    threads: int = 2,
) -> None:  # fmt: skip
    """Write the images ``0000.png`` and so on of cameras by their number; each has its own noise."""

    def write(k: int) -> None:
        rgb = take_image(world, poses[k], size, np.random.default_rng([*seed, k]))
        write_png(folder / f"{k:04d}.png", rgb)

    folder.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(write, poses))


def _develop(linear: NDArray[np.float64]) -> U8:
    """A tone curve like sRGB with a soft shoulder, from a table: the same on every machine."""
    knots = np.linspace(0.0, 1.6, 4097)
    bent = [v if v < 0.6 else 0.6 + 0.4 * (1.0 - 1.0 / (1.0 + (v - 0.6) / 0.4)) * 1.3 for v in knots.tolist()]
    curve = [
        12.92 * v if v <= 0.0031308 else 1.055 * v ** (1 / 2.4) - 0.055 for v in (min(b, 1.0) for b in bent)
    ]
    levels = 255.0 * np.interp(np.clip(linear, 0.0, 1.6), knots, np.array(curve))
    return np.asarray(np.floor(levels + 0.5), dtype=np.uint8)


def encode_jpeg(rgb: U8) -> bytes:
    """The file's bytes, without metadata; fixed settings."""
    buffer = io.BytesIO()
    PillowImage.fromarray(rgb).save(buffer, "JPEG", quality=91, subsampling=2, optimize=True)
    return buffer.getvalue()
