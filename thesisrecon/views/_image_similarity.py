"""Similarity of a rendered and a real image over the pixels that both show: PSNR and SSIM.

Images are ndarray (H, W, 3) of uint8; ``compared`` (H, W) selects the pixels.
"""

from __future__ import annotations

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, U8
from thesisrecon.records import RenderedView

WINDOW_PX = 1.5
"""Standard deviation of the Gaussian window of SSIM."""
GREY = np.array([0.299, 0.587, 0.114])
"""Luma weights of Rec. 601."""
FLOOR_LUMINANCE, FLOOR_CONTRAST = (0.01 * 255.0) ** 2, (0.03 * 255.0) ** 2
"""Stabilising constants of SSIM for dark and uniform regions."""


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
    a, b = (np.where(compared, picture @ GREY, 0.0) for picture in (real, rendered))
    share = np.maximum(_windowed(compared.astype(np.float64)), 1e-6)
    mean_a, mean_b = _windowed(a) / share, _windowed(b) / share
    spread_a = _windowed(a * a) / share - mean_a**2
    spread_b = _windowed(b * b) / share - mean_b**2
    common = _windowed(a * b) / share - mean_a * mean_b
    luminance = (2.0 * mean_a * mean_b + FLOOR_LUMINANCE) / (mean_a**2 + mean_b**2 + FLOOR_LUMINANCE)
    structure = (2.0 * common + FLOOR_CONTRAST) / (spread_a + spread_b + FLOOR_CONTRAST)
    return np.asarray(luminance * structure)


def _check(real: U8, rendered: U8, compared: B8) -> None:
    if real.shape != rendered.shape or real.shape != (*compared.shape, 3):
        shapes = f"{real.shape}, {rendered.shape} and {compared.shape}"
        raise ValueError(f"images and mask must have the same size; got {shapes}")
    if not compared.any():
        raise ValueError("no pixel is shown by both images")


def _windowed(values: F64) -> F64:
    """Gaussian-weighted means (H, W), zero beyond the border."""
    return np.asarray(scipy.ndimage.gaussian_filter(values, WINDOW_PX, mode="constant", truncate=3.5))
