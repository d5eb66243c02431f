"""How near a picture is to the one that it should be."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

B8 = NDArray[np.bool_]
F64 = NDArray[np.float64]

LUMINANCE = np.array([0.299, 0.587, 0.114])


def psnr_db(picture: ArrayLike, truth: ArrayLike, *, where: B8 | None = None) -> float:
    """10 log10 of 255^2 over the mean squared difference of levels (H, W, 3), of the pixels ``where`` (H, W);
    inf for equal pictures."""
    apart = np.asarray(picture, dtype=np.float64) - np.asarray(truth, dtype=np.float64)
    squared = float(np.mean((apart if where is None else apart[where]) ** 2))
    return float("inf") if squared == 0.0 else float(10.0 * np.log10(255.0**2 / squared))


def ssim(picture: ArrayLike, truth: ArrayLike) -> float:
    """Mean structural similarity of the luminances of (H, W, 3) levels, 1 for equal ones.

    Gaussian windows of 1.5 px, C1 = (0.01 255)^2, C2 = (0.03 255)^2 (Wang et al. 2004); the outermost five
    pixels, whose windows leave the picture, are left out.
    """
    x, y = (np.asarray(image, dtype=np.float64) @ LUMINANCE for image in (picture, truth))

    def mean(a: F64) -> F64:
        return np.asarray(gaussian_filter(a, 1.5, truncate=3.5))

    mx, my = mean(x), mean(y)
    vx, vy, vxy = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    c1, c2 = (0.01 * 255.0) ** 2, (0.03 * 255.0) ** 2
    found = (2.0 * mx * my + c1) * (2.0 * vxy + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    return float(found[5:-5, 5:-5].mean())
