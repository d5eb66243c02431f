"""Rectification by OpenCV with our signature: homographies of both images and a common frame."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import decompose_camera
from thesisrecon.stereo._planar import PlanarRectification
from validation.references.libraries import cv2

Size = tuple[int, int]


def opencv_uncalibrated(F: F64, xy1: F64, xy2: F64, size: Size) -> PlanarRectification | None:
    """``cv2.stereoRectifyUncalibrated`` (Hartley), the frame as large as the image as it is used there;
    None if it refuses."""
    done, H1, H2 = cv2.stereoRectifyUncalibrated(xy1.copy(), xy2.copy(), F, size)
    if not done:
        return None
    return PlanarRectification(np.stack([_positive(np.asarray(H), size) for H in (H1, H2)]), size)


def opencv_calibrated(P1: F64, P2: F64, size: Size) -> PlanarRectification:
    """``cv2.stereoRectify`` of two metric cameras without distortion, its defaults, the frame of the
    image's size."""
    (K1, R1, t1), (K2, R2, t2) = decompose_camera(P1), decompose_camera(P2)
    R = R2 @ R1.T
    none = np.zeros(5)
    found = cv2.stereoRectify(K1, none, K2, none, size, R, (t2 - R @ t1)[:, None])
    turn1, turn2, new1, new2 = (np.asarray(part, dtype=np.float64) for part in found[:4])
    H1 = new1[:, :3] @ turn1 @ np.linalg.inv(K1)
    H2 = new2[:, :3] @ turn2 @ np.linalg.inv(K2)
    return PlanarRectification(np.stack([_positive(H, size) for H in (H1, H2)]), size)


def warp_perspective(image: NDArray[Any], H: F64, size: Size) -> NDArray[Any]:
    """The image (H, W, C) whose pixel x goes to H x, H (3, 3), by cubic interpolation."""
    return np.asarray(cv2.warpPerspective(image, H, size, flags=cv2.INTER_CUBIC))


def _positive(H: F64, size: Size) -> F64:
    """H scaled such that the third coordinate is positive at the image's centre."""
    third = float(H[2] @ [0.5 * (size[0] - 1.0), 0.5 * (size[1] - 1.0), 1.0])
    return np.asarray(H * np.sign(third), dtype=np.float64)
