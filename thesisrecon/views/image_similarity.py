"""How like two pictures of one camera are, over the pixels that both have."""

from __future__ import annotations

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, U8
from thesisrecon.records import RenderedView

WINDOW_PX = 1.5
"""Deviation of the Gaussian window of the structural similarity."""

GREY = np.array([0.299, 0.587, 0.114])
"""Shares of red, green and blue in the luma of Rec. 601."""

FLOOR_LUMINANCE, FLOOR_CONTRAST = (0.01 * 255.0) ** 2, (0.03 * 255.0) ** 2
"""What keeps the quotients of the structural similarity steady where a picture is black or even."""


def whole_pixels(rendered: RenderedView) -> B8:
    """(H, W) pixels that the surface covers together with their eight neighbours: the colour of others is
    partly that of the background."""
    return np.asarray(scipy.ndimage.binary_erosion(rendered.valid, np.ones((3, 3))))


def exposed_alike(real: U8, rendered: U8, compared: B8) -> U8:
    """The picture ``rendered`` (H, W, 3) as bright as ``real``: one factor for each channel, by least squares
    over the pixels ``compared`` (H, W).

    A model has one exposure and photographs have each their own, which nothing but the photograph tells.
    Raises ``ValueError`` where the shapes do not agree or nothing is compared.
    """
    _check(real, rendered, compared)
    a, b = real[compared].astype(np.float64), rendered[compared].astype(np.float64)
    factor = (a * b).sum(axis=0) / np.maximum((b * b).sum(axis=0), 1.0)
    return np.asarray(np.clip(np.rint(rendered * factor), 0.0, 255.0), dtype=np.uint8)


def psnr_db(real: U8, rendered: U8, compared: B8) -> float:
    """Peak signal-to-noise ratio of two pictures (H, W, 3), in dB over the pixels ``compared`` (H, W).

    All channels alike; infinite for pictures that are the same. Raises ``ValueError`` where the shapes do not
    agree or nothing is compared.
    """
    _check(real, rendered, compared)
    apart = (real.astype(np.float64) - rendered)[compared]
    mean_square = float(np.mean(apart**2))
    return float("inf") if mean_square == 0.0 else float(10.0 * np.log10(255.0**2 / mean_square))


def ssim(real: U8, rendered: U8, compared: B8) -> float:
    """Structural similarity of two pictures (H, W, 3): its mean over the pixels ``compared`` (H, W).

    See :func:`ssim_map`; raises ``ValueError`` like it.
    """
    return float(np.mean(ssim_map(real, rendered, compared)[compared]))


def ssim_map(real: U8, rendered: U8, compared: B8) -> F64:
    """Structural similarity at each pixel (H, W) of two pictures (H, W, 3).

    Luma in Gaussian windows of 1.5 px, constants 0.01 and 0.03 (Wang, Bovik, Sheikh and Simoncelli, IEEE
    Transactions on Image Processing 2004). A window takes in only pixels that are ``compared`` (H, W). Raises
    ``ValueError`` where the shapes do not agree or nothing is compared.
    """
    _check(real, rendered, compared)
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
        raise ValueError(
            f"pictures and mask must be of one size; got {real.shape}, {rendered.shape} and {compared.shape}"
        )
    if not compared.any():
        raise ValueError("nothing to compare: no pixel is in both pictures")


def _windowed(values: F64) -> F64:
    """(H, W) means in Gaussian windows, nothing beyond the border."""
    return np.asarray(scipy.ndimage.gaussian_filter(values, WINDOW_PX, mode="constant", truncate=3.5))
