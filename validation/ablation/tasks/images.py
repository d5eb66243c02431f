"""Image pairs with known cameras, and rectified pairs with dense truth, as tasks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure, UsageError, unknown_word
from thesisrecon.io._images import read_images
from thesisrecon.pipeline.matching import match_views
from thesisrecon.records import Image
from thesisrecon.stereo.depth import MultiViewStereo
from validation.ablation.study import Measure, Place, Task, window_names, window_parts, window_slice
from validation.metrics.depth import bad_pixels
from validation.metrics.fundamental_precision import RIGHT_PX, rms_epipolar_distance
from validation.scenes.many_views import load_yard, yard_number
from validation.scenes.real import Scene, load_scene
from validation.scenes.real_pairs import CACHE, SCENES_WITH_CAMERAS, camera_pairs
from validation.scenes.stereo import STEREO_PAIRS, StereoPair, load_stereo_pair

MAX_SIZE_PX = 1536
_SCENES = (*SCENES_WITH_CAMERAS, "courtyard")


@dataclass(frozen=True)
class ImagePairs(Task):
    """Images ``i`` and ``i + gap`` of the scene "NAME/i" (fountain-P11/3), long side at most 1536: corners,
    matches, F and verification of the configuration, judged by correspondences of the true cameras. A row
    whose F is wrong (error of 1 px and more) fails. The pairs of a scene are subsets of it. A yard (yard-1/0)
    has its images in the order of their cameras.
    """

    gap: int = 2

    measures: ClassVar[Sequence[Measure]] = (
        Measure("verified", "", "more", True, "inliers of F"),
        Measure("error_px", "px", "less", True, "RMS distance of true correspondences to their lines"),
        Measure("sigma_px", "px", "less", True, "noise of the inliers"),
    )

    def names_of_scenes(self) -> Sequence[str]:
        return [f"{name}/0" for name in (*_SCENES, "yard-1")]

    def scene_of(self, scene: str) -> str:
        return scene.rpartition("/")[0]

    def check(self, scene: str) -> None:
        name, _, first = scene.rpartition("/")
        if not (name in _SCENES or yard_number(name) is not None) or not first.isdecimal():
            raise UsageError(unknown_word("pair", scene, [f"{s}/0" for s in _SCENES]))
        found = _load(name)
        if found is None:
            raise UsageError(f"the images of {name} are not on this machine (THESISRECON_DATA)")
        if int(first) + self.gap >= len(found.image_paths):
            raise UsageError(f"{name} has {len(found.image_paths)} images: there is no pair {scene}")

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        name, _, first = scene.rpartition("/")
        i = int(first)
        images, truth = read_pair(name, i, self.gap)
        views = [config.matching.prepare(image, config.features.detect(image)) for image in images]
        return numbers_of_pair(config, views, (i, i + self.gap), seed, truth)


def numbers_of_pair(
    config: PipelineConfig, views: Sequence[Any], pair: tuple[int, int], seed: int, truth: F64
) -> dict[str, float]:
    """Measure two prepared views against true correspondences (M, 4) px."""
    view = match_views(config, views[0], views[1], pair, seed)
    if not view.F.any():
        raise StageFailure("the pair has no F", view.reason)
    error_px = rms_epipolar_distance(view.F, truth)
    if error_px >= RIGHT_PX:
        raise StageFailure("F is wrong", f"its error is {error_px:.1f} px, with {view.inliers} inliers")
    return {"verified": float(view.inliers), "error_px": error_px, "sigma_px": float(view.sigma_px)}


@lru_cache(maxsize=8)
def _load(name: str) -> Scene | None:
    yard = yard_number(name)
    if yard is None:
        return load_scene(name)
    scene = load_yard(yard)
    K, R, C = scene.cameras
    order = np.argsort(C[:, 0])
    return Scene(name, tuple(scene.image_paths[k] for k in order), K[order], R[order], C[order])


@lru_cache(maxsize=16)
def read_pair(name: str, i: int, gap: int) -> tuple[tuple[Image, ...], F64]:
    """Both images and correspondences (M, 4) px of the true cameras."""
    scene = _load(name)
    assert scene is not None
    # One by one: several are sorted by name.
    paths = scene.image_paths[i], scene.image_paths[i + gap]
    images = tuple(read_images([path], max_size_px=MAX_SIZE_PX).images[0] for path in paths)
    truths = [pair.truth for pair in camera_pairs(scene, CACHE, (gap,))]
    truth = truths[i]
    assert truth is not None
    return images, np.asarray(truth)


@dataclass(frozen=True)
class RectifiedPairs(Task):
    """``dense.pairs.matcher`` on a pair with dense truth, judged where both cameras see. "yard-N" is a
    rendered pair, another one for each number. A subset is a window of two thirds of the rows.
    """

    measures: ClassVar[Sequence[Measure]] = (
        Measure("bad1_pct", "%", "less", True, "pixels off by more than 1 px, holes filled along the row"),
        Measure("bad2_pct", "%", "less", True, "pixels off by more than 2 px, holes filled along the row"),
        Measure("known_pct", "%", "more", False, "share of the pixels that are known before the filling"),
    )

    def names_of_scenes(self) -> Sequence[str]:
        return [*STEREO_PAIRS, "yard-1"]

    def scene_of(self, scene: str) -> str:
        return window_parts(scene)[0]

    def subsets(self, scene: str, count: int) -> list[str]:
        return window_names(scene, count)

    def check(self, scene: str) -> None:
        name = self.scene_of(scene)
        if name not in STEREO_PAIRS and yard_number(name) is None:
            raise UsageError(unknown_word("scene", name, STEREO_PAIRS))
        if load_stereo_pair(name) is None:
            raise UsageError(f"the pair {name} is not on this machine (THESISRECON_DATA; scikit-image)")

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        pair = matched_pair(scene)
        if not isinstance(config.dense, MultiViewStereo):
            found = config.dense.match_rectified(
                pair.left, pair.right, max_disparity_px=float(pair.disparities - 1)
            )
        else:
            limits = (0, pair.disparities - 1)
            found = config.dense.pairs.matcher.match(pair.left, pair.right, disparity_range=limits)
        known = np.isfinite(found.disparity)[pair.judged]
        return {
            "bad1_pct": bad_pixels(found.disparity, pair, 1.0),
            "bad2_pct": bad_pixels(found.disparity, pair, 2.0),
            "known_pct": 100.0 * float(known.mean()),
        }


@lru_cache(maxsize=4)
def matched_pair(scene: str) -> StereoPair:
    """The rectified pair of a scene or the rows of a window of it."""
    pair = load_stereo_pair(window_parts(scene)[0])
    assert pair is not None
    rows = window_slice(scene, len(pair.left))
    cut = {name: getattr(pair, name)[rows] for name in ("left", "right", "truth", "judged")}
    return replace(pair, **cut)
