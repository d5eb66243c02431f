"""OpenCV with our types: corners, rectification, semi-global matching, and calibration from a chessboard."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F32, F64, U8
from thesisrecon.errors import StageFailure
from thesisrecon.records import Image
from validation.references.libraries import cv2
from validation.references.sift import detect_sift, grey_of

BLOCK, APERTURE, K = 3, 3, 0.04  # Window, Sobel aperture and k as OpenCV's tutorial has them


def harris_corners(image: Image, count: int) -> F64:
    """The strongest local maxima (N, 2) of ``cv2.cornerHarris``, moved to sub-pixel by ``cornerSubPix``."""
    grey = grey_of(image)
    response = cv2.cornerHarris(np.asarray(grey, np.float32), BLOCK, APERTURE, K)
    peak = (response == cv2.dilate(response, np.ones((3, 3), np.uint8))) & (response > 0.0)
    y, x = np.nonzero(peak)
    strongest = np.argsort(-response[y, x], kind="stable")[:count]
    xy = np.stack([x[strongest], y[strongest]], axis=1).astype(np.float32, order="C")
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
    refined = cv2.cornerSubPix(grey, xy.reshape(-1, 1, 2).copy(), (3, 3), (-1, -1), criteria)
    return np.asarray(refined, dtype=np.float64).reshape(-1, 2)


def sift_corners(image: Image, count: int) -> F64:
    """The strongest SIFT keypoints (N, 2), one where several orientations share a place."""
    found = detect_sift(grey_of(image))
    order = np.argsort(-found.response, kind="stable")
    _, first = np.unique(found.xy[order], axis=0, return_index=True)
    return np.asarray(found.xy[order][np.sort(first)[:count]], dtype=np.float64)


MODES = {"SGBM 3-way": "STEREO_SGBM_MODE_SGBM_3WAY", "SGBM HH": "STEREO_SGBM_MODE_HH"}


class OpenCVSemiGlobal(NamedTuple):
    """``cv2.StereoSGBM`` on colour, block 3, P1 = 216, P2 = 864, with its checks; ``mode`` one of ``MODES``.
    It has no disparities for the left columns that a disparity of the range would take out of the image. With
    ``widened`` the images are repeated to the left so that it has them.
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


HALF_WINDOW_PX = 5


def board_corners(picture: NDArray[np.uint8], size: tuple[int, int]) -> F64:
    """(N, 2) inner corners, row by row from the corner that comes first on the image's diagonal."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    found, corners = cv2.findChessboardCorners(grey, size)
    if not found:
        raise StageFailure(
            "OpenCV finds no board", "an image without all corners", "keep the board in the frame"
        )
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    fine = cv2.cornerSubPix(grey, corners, (HALF_WINDOW_PX, HALF_WINDOW_PX), (-1, -1), until)
    xy = np.asarray(fine, dtype=np.float64).reshape(-1, 2)
    return xy if xy[0].sum() <= xy[-1].sum() else xy[::-1].copy()


def calibrate_from_corners(X: F64, corners: Sequence[F64], size: tuple[int, int]) -> tuple[F64, float, F64]:
    """K, k1 and the standard deviations (5,) of fx, fy, cx, cy, k1 that ``cv2.calibrateCamera`` states for
    board points X (N, 3) and their images.
    """
    points = [X.astype(np.float32)] * len(corners)
    places = [np.ascontiguousarray(xy, dtype=np.float32) for xy in corners]
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    found = cv2.calibrateCameraExtended(points, places, size, np.eye(3), np.zeros(5), flags=flags)
    K, distortion, std = (np.asarray(found[k], dtype=np.float64) for k in (1, 2, 5))
    return K, float(np.ravel(distortion)[0]), np.ravel(std)[:5]
