"""Corners by OpenCV: ``cornerHarris`` with the same rule of choice as a textbook, and SIFT keypoints."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.records import Image
from validation.references.libraries import cv2
from validation.references.sift import detect_sift, grey_of

BLOCK, APERTURE, K = 3, 3, 0.04
"""Window, Sobel aperture and k as OpenCV's tutorial has them."""


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
