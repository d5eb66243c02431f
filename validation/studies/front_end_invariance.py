"""Turned, scaled and darkened copies of photographs: corners found again and matches, ours beside SIFT.

A copy is a photograph under a known map, so every position in it is known. A corner is repeated where the
copy has one within ``REPEATED_PX`` of its place, a match right where it is within ``RIGHT_PX``, in pixels of
the copy. The copy turned by 45 degrees shows a third of the photograph and gets as many corners as the whole,
most of which the photograph lacks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from thesisrecon.arrays import F64, U8
from thesisrecon.config import PipelineConfig
from thesisrecon.io.images import read_photographs
from thesisrecon.pipeline.features_to_tracks import detect_features, match_views
from thesisrecon.records import Features, Image
from validation.studies.front_end_pairs import MAX_SIZE_PX, OURS, SIFT, front_ends
from validation.metrics.record import Metric
from validation.references.pictures import shrink, warp_affine
from validation.scenes.real import load_real_scene

REPEATED_PX, RIGHT_PX = 1.5, 1.5
PHOTOGRAPHS = (("fountain-P11", 5), ("Herz-Jesus-P8", 3))


@dataclass(frozen=True)
class Copy:
    """A copy ``rgb`` of a photograph: the pixel x of the photograph is at A x + b, ``copy_from_photograph``
    (2, 3), of the copy."""

    name: str
    rgb: U8
    copy_from_photograph: F64


def make_copies(rgb: U8) -> Iterator[Copy]:
    """All copies of a photograph (H, W, 3)."""
    same = np.eye(3)[:2]
    width = rgb.shape[1]
    turned = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, width - 1.0]])
    yield Copy("turned by 90 degrees", np.ascontiguousarray(np.rot90(rgb)), turned)
    yield _turned(rgb, 45.0)
    for scale in (0.7, 0.5):
        yield _scaled(rgb, scale)
    for factor in (0.5, 0.25):
        yield Copy(f"times {factor:g}", np.rint(rgb * factor).astype(np.uint8), same)
    darker = np.rint(255.0 * (rgb / 255.0) ** 2.0).astype(np.uint8)
    yield Copy("to the power of 2", darker, same)


def _turned(rgb: U8, degrees: float) -> Copy:
    """Turned about the middle, the part that has no empty corners: a square of the short side over
    sqrt(2)."""
    height, width = rgb.shape[:2]
    side = int(min(height, width) / np.sqrt(2.0))
    middle = ((width - 1) / 2.0, (height - 1) / 2.0)
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[cos, sin], [-sin, cos]])
    A = np.column_stack([turn, (side - 1) / 2.0 - turn @ middle])
    return Copy(f"turned by {degrees:g} degrees", warp_affine(rgb, A, (side, side)), A)


def _scaled(rgb: U8, scale: float) -> Copy:
    """Smaller, by the mean over the area of each pixel."""
    height, width = (round(scale * n) for n in rgb.shape[:2])
    sx, sy = width / rgb.shape[1], height / rgb.shape[0]
    A = np.array([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5]])
    return Copy(f"scaled by {scale:g}", shrink(rgb, (width, height)), A)


@dataclass(frozen=True)
class CopyScore:
    """What a front end makes of a copy.

    ``repeated`` is the share of the corners found in both, ``corners`` how many there are in the part of the
    photograph that the copy shows, ``right`` the verified matches within ``RIGHT_PX`` of their place and
    ``verified`` all of them.
    """

    repeated: float
    corners: int
    right: int
    verified: int


def score_copy(config: PipelineConfig, image: Image, copy: Copy) -> CopyScore:
    """Detect, match and verify a photograph and its copy."""
    images = (image, Image(copy.name, copy.rgb, (copy.rgb.shape[1], copy.rgb.shape[0])))
    features = [detect_features(config, one) for one in images]
    views = [config.matching.prepare(one, f) for one, f in zip(images, features, strict=True)]
    pair = match_views(config, views[0], views[1], (0, 1), 0)
    error = np.linalg.norm(_mapped(copy.copy_from_photograph, pair.xy1) - pair.xy2, axis=1)
    repeated, corners = repeatability(features[0], features[1], image.size, copy)
    return CopyScore(repeated, corners, int(np.sum(error < RIGHT_PX)), pair.inliers)


def repeatability(first: Features, second: Features, size: tuple[int, int], copy: Copy) -> tuple[float, int]:
    """Share of the corners that are found in both pictures (Mikolajczyk and Schmid, PAMI 2005), and how many
    corners of the photograph the copy shows.

    Two corners are one where each is the other's nearest and within ``REPEATED_PX``; the share is of the
    smaller of the two numbers of corners in the part that both pictures show. SIFT's keypoints of several
    angles at one place are one.
    """
    A = copy.copy_from_photograph
    inverse = np.linalg.inv(np.vstack([A, [0.0, 0.0, 1.0]]))[:2]
    there, found = _mapped(A, _places(first)), _places(second)
    there = there[_inside(there, (copy.rgb.shape[1], copy.rgb.shape[0]))]
    found = found[_inside(_mapped(inverse, found), size)]
    if not len(there) or not len(found):
        return 0.0, len(there)
    distance, nearest = cKDTree(found).query(there)
    mutual = cKDTree(there).query(found)[1][nearest] == np.arange(len(there))
    same = np.count_nonzero(mutual & (distance < REPEATED_PX))
    return float(same / min(len(there), len(found))), len(there)


def _places(features: Features) -> F64:
    return np.unique(features.xy, axis=0)


def _mapped(A: F64, xy: F64) -> F64:
    return np.asarray(xy @ A[:, :2].T + A[:, 2], dtype=np.float64)


def _inside(xy: F64, size: tuple[int, int]) -> NDArray[np.bool_]:
    return np.asarray(((xy >= 0.0) & (xy <= np.array(size) - 1.0)).all(axis=1))


def measure_invariance() -> dict[str, dict[str, dict[str, CopyScore]]]:
    """Photograph -> copy -> front end -> score; empty where the photographs are not on this machine."""
    configs = {name: config for name, config in front_ends().items() if name in (OURS, SIFT)}
    found: dict[str, dict[str, dict[str, CopyScore]]] = {}
    for scene_name, view in PHOTOGRAPHS:
        scene = load_real_scene(scene_name)
        if scene is None:
            continue
        image = read_photographs(scene.image_paths[view : view + 1], max_size_px=MAX_SIZE_PX).images[0]
        found[f"{scene_name}, photograph {view}"] = {
            copy.name: {name: score_copy(config, image, copy) for name, config in configs.items()}
            for copy in make_copies(image.rgb)
        }
    return found


def check_invariance(title: str, copies: dict[str, dict[str, CopyScore]]) -> list[Metric]:
    """Right matches and repeatability of every copy; SIFT is beside and no bound, for SIFT is made for
    this."""

    def rows(name: str, unit: str, read: Callable[[CopyScore], float]) -> Iterator[Metric]:
        for copy, by in copies.items():
            yield Metric(title, f"{copy}: {name}", unit, {m: read(score) for m, score in by.items()}, OURS)

    return [
        *rows("right matches", "", lambda s: float(s.right)),
        *rows("right of the verified", "%", lambda s: 100.0 * s.right / max(s.verified, 1)),
        *rows("repeatability", "%", lambda s: 100.0 * s.repeated),
        *rows("corners in the copy's part", "", lambda s: float(s.corners)),
    ]
