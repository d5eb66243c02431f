"""OpenCV's semi-global block matching with our interface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F32, U8
from validation.references.libraries import cv2

MODES = {"SGBM 3-way": "STEREO_SGBM_MODE_SGBM_3WAY", "SGBM HH": "STEREO_SGBM_MODE_HH"}


@dataclass(frozen=True)
class OpenCVSemiGlobal:
    """``cv2.StereoSGBM`` on colour, block 3, P1 = 216, P2 = 864, with its checks; ``mode`` one of ``MODES``.

    It has no disparities for the left columns that a disparity of the range would take out of the image.
    With ``widened`` the images are repeated to the left so that it has them.
    """

    mode: str
    widened: bool = True

    def match(self, left: U8, right: U8, disparities: int) -> F32:
        """(H, W) disparities 0 .. disparities - 1 (a multiple of 16) of RGB images, NaN = unknown."""
        mode = getattr(cv2, MODES[self.mode])
        matcher = cv2.StereoSGBM.create(0, disparities, 3, 216, 864, 1, 0, 10, 100, 2, mode)
        extra = disparities if self.widened else 0
        images = [
            cv2.copyMakeBorder(image[..., ::-1], 0, 0, extra, 0, cv2.BORDER_REPLICATE)
            for image in (left, right)
        ]
        found = matcher.compute(*images)[:, extra:].astype(np.float32) / np.float32(16.0)
        found[found < 0.0] = np.nan
        return np.asarray(found, dtype=np.float32)
