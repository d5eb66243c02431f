"""PSNR and SSIM of images, as rows of a table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import U8
from thesisrecon.views import _image_similarity as likeness
from validation.metrics.record import Metric

BORDER_PX = 5
"""Radius of the SSIM windows."""


def psnr_db(picture: NDArray[Any], truth: NDArray[Any], *, where: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio of images (H, W, 3) over the pixels ``where`` (H, W), or all."""
    compared = np.ones(truth.shape[:2], dtype=bool) if where is None else where
    return likeness.psnr_db(truth, picture, compared)


def ssim(picture: NDArray[Any], truth: NDArray[Any]) -> float:
    """Mean structural similarity of images (H, W, 3), 1 for equal ones, where whole windows fit."""
    found = likeness._ssim_map(truth, picture, np.ones(truth.shape[:2], dtype=bool))
    return float(found[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX].mean())


def picture_metrics(scene: str, pictures: Mapping[str, U8], wanted: U8) -> list[Metric]:
    """PSNR and SSIM of every image; the first is judged."""

    def row(name: str, unit: str, measure: Callable[[U8, U8], float]) -> Metric:
        values: dict[str, float | None] = {n: measure(p, wanted) for n, p in pictures.items()}
        return Metric(scene, name, unit, values, next(iter(pictures)), at_most=False)

    return [row("PSNR", "dB", psnr_db), row("SSIM", "", ssim)]
