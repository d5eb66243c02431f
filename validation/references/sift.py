"""OpenCV's SIFT with Lowe's ratio test."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from thesisrecon.types import F32, F64, I64, Image
from validation.references.libraries import cv2

U8 = NDArray[np.uint8]


@dataclass(frozen=True)
class SiftKeypoints:
    """All keypoints of one photograph: ``xy`` (N, 2) px, ``size`` and ``response`` (N,), ``descriptors``
    (N, 128)."""

    xy: F64
    size: F32
    response: F32
    descriptors: F32


def detect_sift(grey: U8) -> SiftKeypoints:
    """What :func:`compute_sift` finds; the keypoints of the last photographs are kept."""
    return _detect(grey.tobytes(), grey.shape)


@lru_cache(maxsize=32)
def _detect(pixels: bytes, shape: tuple[int, ...]) -> SiftKeypoints:
    return compute_sift(np.frombuffer(pixels, dtype=np.uint8).reshape(shape))


def compute_sift(grey: U8) -> SiftKeypoints:
    """SIFT of a grey photograph (H, W) with OpenCV's defaults."""
    # Without this its places are a quarter of a pixel right of and below those of the photograph.
    sift = cv2.SIFT.create(enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(grey, None)
    return SiftKeypoints(
        np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2),
        np.array([k.size for k in keypoints], dtype=np.float32),
        np.array([k.response for k in keypoints], dtype=np.float32),
        np.zeros((0, 128), np.float32) if descriptors is None else np.asarray(descriptors, np.float32),
    )


def nearest_two(first: F32, second: F32) -> tuple[I64, F32]:
    """Of each descriptor (N, D) the nearest two of (M, D) by brute force, and their distances; (N, 2)."""
    found = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first, second, k=2)
    index = np.array([[m.trainIdx for m in pair] for pair in found], dtype=np.int64)
    return index, np.array([[m.distance for m in pair] for pair in found], dtype=np.float32)


def match_sift(first: SiftKeypoints, second: SiftKeypoints, *, ratio: float, mutual: bool) -> I64:
    """Pairs of indices (M, 2) whose nearest descriptor is below ``ratio`` times the second nearest; with
    ``mutual`` each must be the other's nearest."""
    if len(first.xy) == 0 or len(second.xy) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    # One feature of the second image may be the nearest of many in the first: a fact of plain ratio matching.
    pairs = [
        (m.queryIdx, m.trainIdx)
        for m, rival in matcher.knnMatch(first.descriptors, second.descriptors, k=2)
        if m.distance < ratio * rival.distance
    ]
    if mutual:
        back = {m.queryIdx: m.trainIdx for m in matcher.match(second.descriptors, first.descriptors)}
        pairs = [(a, b) for a, b in pairs if back[b] == a]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def grey_of(image: Image) -> U8:
    """8-bit luminance (H, W)."""
    return np.asarray(PillowImage.fromarray(image.rgb).convert("L"))
