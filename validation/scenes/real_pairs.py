"""Pairs of real images with matches and ground truth.

SIFT matches are OpenCV's and cached in a folder.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from thesisrecon.api.cameras import triangulate
from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.geometry.polynomial_triangulation import correct_matches
from thesisrecon.geometry.two_view import fundamental_from_cameras, sampson_residuals
from thesisrecon.io._files import write_atomically
from validation.references.sift import SETTINGS, SiftKeypoints, detect_sift, match_sift
from validation.scenes.real import Scene, cache_folder, data_root

HAND_MADE_RATIO, CAMERA_RATIO = 0.85, 0.8
CACHE = cache_folder("matches")  # Folder that keeps SIFT matches of image pairs
CONSISTENT_PX = 1.5
"""Sampson distance to the true F within which a match of a scene with cameras counts as right."""
FARTHEST = 3.0  # Depth in medians beyond which such a match counts as wrong
SCENES_WITH_CAMERAS = ("fountain-P11", "Herz-Jesus-P8")


class RealPair(NamedTuple):
    """Matches (N, 2) px; ``truth`` (M, 4): right correspondences; ``F`` of the true cameras."""

    name: str
    xy1: F64
    xy2: F64
    truth: F64 | None = None
    F: F64 | None = None


def match_images(paths: tuple[Path, Path], cache: Path, *, ratio: float, mutual: bool) -> tuple[F64, F64]:
    """OpenCV's SIFT matches (N, 2), (N, 2) by the ratio test, kept in ``cache`` by image contents."""
    content = hashlib.sha256(repr((SETTINGS, ratio, mutual)).encode())
    for path in paths:
        content.update(path.read_bytes())
    kept = cache / f"{paths[0].stem}-{paths[1].stem}-{content.hexdigest()[:24]}.npy"
    if kept.is_file():
        found = np.load(kept)
        return found[:, :2].copy(), found[:, 2:].copy()
    first, second = (_sift(path) for path in paths)
    index = match_sift(first, second, ratio=ratio, mutual=mutual)
    found = np.hstack([first.xy[index[:, 0]], second.xy[index[:, 1]]])
    whole = io.BytesIO()
    np.save(whole, found)
    write_atomically(kept, whole.getvalue())
    return found[:, :2].copy(), found[:, 2:].copy()


@lru_cache(maxsize=4)
def _sift(path: Path) -> SiftKeypoints:
    """Return the keypoints of an image, which is in several pairs of its neighbourhood."""
    with Image.open(path) as image:
        return detect_sift(np.asarray(image.convert("L")))


def kusvod2_pairs(cache: Path, names: tuple[str, ...] | None = None) -> Iterator[RealPair]:
    """The pairs of Lebeda, Matas and Chum (BMVC 2012) with their hand-made correspondences as ``truth``."""
    root = data_root()
    for folder in sorted((root / "kusvod2").iterdir()) if root and (root / "kusvod2").is_dir() else []:
        if folder.is_dir() and (names is None or folder.name in names):
            paths = (folder / "A.jpg", folder / "B.jpg")
            xy1, xy2 = match_images(paths, cache, ratio=HAND_MADE_RATIO, mutual=False)
            yield RealPair(folder.name, xy1, xy2, truth=np.loadtxt(folder / "validation.txt", ndmin=2)[:, :4])


def camera_pairs(scene: Scene | None, cache: Path, gaps: tuple[int, ...] = (1, 2)) -> Iterator[RealPair]:
    """Pairs (i, i + gap) of a scene with known cameras; ``truth`` is free of noise."""
    if scene is None or not scene.has_truth:
        return
    for gap in gaps:
        for i in range(len(scene.image_paths) - gap):
            yield camera_pair(scene, i, i + gap, cache)


def camera_pair(scene: Scene, i: int, j: int, cache: Path = CACHE) -> RealPair:
    """A pair of images whose cameras are known; ``truth`` is free of noise."""
    P1, P2 = camera_from_centre(*scene.cameras_of((i, j)))
    paths = scene.image_paths[i], scene.image_paths[j]
    xy1, xy2 = match_images(paths, cache, ratio=CAMERA_RATIO, mutual=True)
    truth = exact_correspondences(P1, P2, xy1, xy2)
    return RealPair(f"{scene.name} {i}-{j}", xy1, xy2, truth=truth, F=fundamental_from_cameras(P1, P2))


def exact_correspondences(P1: F64, P2: F64, xy1: F64, xy2: F64) -> F64:
    """The matches (N, 2) that agree with the cameras (3, 4), corrected to agree exactly; (M, 4). They lie
    within ``CONSISTENT_PX`` of the epipolar constraint, before both cameras and no farther than ``FARTHEST``
    median depths. Both cameras need to be [K R, K t] with det K > 0.
    """
    F = fundamental_from_cameras(P1, P2)
    near = np.abs(sampson_residuals(F, xy1, xy2)) < CONSISTENT_PX
    exact1, exact2 = correct_matches(F, xy1[near], xy2[near])
    Xh = triangulate(np.stack([P1, P2]), np.stack([exact1, exact2]), method="linear")
    depths = np.stack([Xh @ P1[2], Xh @ P2[2]]) / Xh[:, 3]
    typical = np.median(depths, axis=1, keepdims=True)
    seen = np.all((depths > 0.0) & (depths < FARTHEST * typical), axis=0)
    return np.hstack([exact1, exact2])[seen]
