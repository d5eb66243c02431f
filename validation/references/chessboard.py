"""OpenCV's corners of a chessboard, and its calibration from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from validation.references.libraries import cv2

HALF_WINDOW_PX = 5


@dataclass(frozen=True)
class BoardCalibration:
    """``K`` (3, 3) and ``k1`` as OpenCV finds them, ``std`` (5,) its deviations of fx, fy, cx, cy, k1, and
    ``rms_px`` of the corners."""

    K: F64
    k1: float
    std: F64
    rms_px: float


def board_corners(picture: NDArray[np.uint8], size: tuple[int, int]) -> F64:
    """(N, 2) inner corners, ``size`` along and across, row by row from the corner that comes first on the
    image's diagonal; :class:`StageFailure` if OpenCV does not find them."""
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


def calibrate_from_corners(X: F64, corners: Sequence[F64], size: tuple[int, int]) -> BoardCalibration:
    """``cv2.calibrateCamera`` of board points X (N, 3) and what each image of ``size`` shows of them;
    free are fx, fy, cx, cy and k1."""
    points = [X.astype(np.float32)] * len(corners)
    places = [np.ascontiguousarray(xy, dtype=np.float32) for xy in corners]
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    found = cv2.calibrateCameraExtended(points, places, size, np.eye(3), np.zeros(5), flags=flags)
    rms, K, distortion, std = found[0], found[1], found[2], found[5]
    return BoardCalibration(
        np.asarray(K, dtype=np.float64),
        float(np.ravel(distortion)[0]),
        np.asarray(np.ravel(std)[:5], dtype=np.float64),
        float(rms),
    )
