"""Image pairs with known cameras, and rectified pairs with dense truth, as tasks."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from thesisrecon.arrays import F64, resizing_transform
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure, UsageError, unknown_word
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.relative_pose import pose_in_front
from thesisrecon.geometry.two_view import fundamental_from_cameras, sampson_residuals
from thesisrecon.io._files import read_pairs
from thesisrecon.io._images import read_images
from thesisrecon.pipeline.matching import match_views
from thesisrecon.records import Image, TwoView
from thesisrecon.stereo.depth import MultiViewStereo
from validation.ablation.study import Measure, Place, Task, window_names, window_parts, window_slice
from validation.ablation.tasks.reconstruction import POSE_MEASURES, content_key, scene_or_folder
from validation.metrics.cameras import pose_scores_pct, relative_pose_errors
from validation.metrics.depth import bad_pixels
from validation.metrics.fundamental_precision import RIGHT_PX, rms_epipolar_distance
from validation.scenes.many_views import yard_number
from validation.scenes.real import Scene
from validation.scenes.real_pairs import CONSISTENT_PX, SCENES_WITH_CAMERAS, camera_pair
from validation.scenes.stereo import STEREO_PAIRS, StereoPair, load_stereo_pair

_SCENES = (*SCENES_WITH_CAMERAS, "courtyard")


@dataclass(frozen=True)
class ImagePairs(Task):
    """Two images of a scene, a yard (yard-1) or a folder with true cameras: "NAME/3", which is image 3 with
    image 3 + ``gap`` in the order of their names (of a yard, of its cameras), or "NAME/a.jpg+b.jpg". "NAME/*"
    means all pairs of this gap, "NAME/LIST" those of a text file of the folder, two names a line. The long
    side is at most ``max_size_px``. Corners, matches, F and verification of the configuration are judged by
    correspondences of the true cameras. A row whose F is wrong (error of 1 px and more) fails; if not
    ``strict`` it counts with its error, 99 px at most, and without F as a wrong pose. The pairs of a scene
    are subsets of it.
    """

    gap: int = 2
    max_size_px: int = 1536
    strict: bool = True

    measures: ClassVar[Sequence[Measure]] = (
        Measure("verified", "", "more", True, "inliers of F"),
        Measure("error_px", "px", "less", True, "RMS distance of true correspondences to their lines"),
        Measure("sigma_px", "px", "less", True, "noise of the inliers"),
        Measure(
            "precision_pct", "%", "more", False,
            f"verified matches within {CONSISTENT_PX:g} px of the true epipolar geometry", extra=True,
        ),
        Measure(
            "matching_score_pct", "%", "more", False,
            "the same matches over the features of the image with fewer of them", extra=True,
        ),
        *POSE_MEASURES,
    )  # fmt: skip

    def names_of_scenes(self) -> Sequence[str]:
        return [*(f"{name}/0" for name in (*_SCENES, "yard-1")), "FOLDER/*", "FOLDER/a.jpg+b.jpg"]

    def scene_of(self, scene: str) -> str:
        return scene.rpartition("/")[0]

    def expand(self, scene: str) -> Sequence[str]:
        name, _, which = scene.rpartition("/")
        if which == "*":
            return [f"{name}/{i}" for i in range(len(_scene_of_pairs(name).image_paths) - self.gap)]
        if Path(scene).is_file():
            return [f"{name}/{'+'.join(pair)}" for pair in read_pairs(Path(scene))]
        return [scene]

    def check(self, scene: str) -> None:
        pair_of(scene, self.gap)

    def scene_key(self, scene: str) -> str:
        return content_key(*pair_of(scene, self.gap))

    def unavailable(self, scene: str) -> Collection[str]:
        return () if self.strict else ("sigma_px",)

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        pair = read_pair(scene, self.gap, self.max_size_px)
        views = [config.matching.prepare(image, config.features.detect(image)) for image in pair.images]
        return numbers_of_pair(config, views, pair, seed, strict=self.strict)


class TruePair(NamedTuple):
    """Two images at working size, their numbers, true correspondences (M, 4) px, and the true cameras K, R
    (2, 3, 3) and centres C (2, 3).
    """

    images: tuple[Image, ...]
    numbers: tuple[int, int]
    truth: F64
    K: F64
    R: F64
    C: F64


def numbers_of_pair(
    config: PipelineConfig, views: Sequence[Any], pair: TruePair, seed: int, *, strict: bool = True
) -> dict[str, float]:
    """Measure two prepared views against the truth."""
    view = match_views(config, views[0], views[1], pair.numbers, seed)
    error_px = rms_epipolar_distance(view.F, pair.truth)
    if strict and not view.F.any():
        raise StageFailure("the pair has no F", view.reason)
    if strict and error_px >= RIGHT_PX:
        raise StageFailure("F is wrong", f"its error is {error_px:.1f} px, with {view.inliers} inliers")
    P1, P2 = camera_from_centre(pair.K, pair.R, pair.C)
    distance = np.abs(sampson_residuals(fundamental_from_cameras(P1, P2), view.xy1, view.xy2))
    right = float(np.sum(distance < CONSISTENT_PX))
    fewest = min(len(prepared.features.xy) for prepared in views)
    return {
        "verified": float(view.inliers),
        "error_px": error_px,
        "sigma_px": float(view.sigma_px),
        "precision_pct": 100.0 * right / max(view.inliers, 1),
        "matching_score_pct": 100.0 * right / max(fewest, 1),
        **pose_scores_pct(_pose_error(view, pair)),
    }


def _pose_error(view: TwoView, pair: TruePair) -> F64:
    """Error (1,) of the relative pose of F and the true K, degrees; infinite without F."""
    R, C = np.full((2, 3, 3), np.nan), np.full((2, 3), np.nan)
    if view.F.any():
        rays = [
            homogenize(xy) @ np.linalg.inv(K).T for xy, K in zip((view.xy1, view.xy2), pair.K, strict=True)
        ]
        turn, t, _ = pose_in_front(pair.K[1].T @ view.F @ pair.K[0], *rays)
        R[:], C[:] = [np.eye(3), turn], [np.zeros(3), -turn.T @ t]
    return relative_pose_errors(R, C, pair.R, pair.C)


def pair_of(scene: str, gap: int) -> tuple[Scene, tuple[int, int]]:
    """The scene of a pair and the numbers of its images; :class:`UsageError` if one is not there."""
    name, _, which = scene.rpartition("/")
    found = _scene_of_pairs(name)
    count, number = len(found.image_paths), {path.name: n for n, path in enumerate(found.image_paths)}
    if which.isdecimal():
        i, j = int(which), int(which) + gap
        if j >= count:
            raise UsageError(f"{name} has {count} images: there is no pair {scene}")
    else:
        names = which.split("+")
        if len(names) != 2:
            raise UsageError(f"a pair is {name}/0, {name}/a.jpg+b.jpg or a list of pairs; got {scene}")
        if unknown := [one for one in names if one not in number]:
            raise UsageError(unknown_word(f"image of {name}", unknown[0], number))
        i, j = (number[one] for one in names)
    if not found.known[[i, j]].all() or not np.isfinite(found.cameras_of((i, j))[0]).all():
        raise UsageError(f"the true cameras of the pair {scene} are not known")
    return found, (i, j)


@lru_cache(maxsize=8)
def _scene_of_pairs(name: str) -> Scene:
    scene = scene_or_folder(name)
    if yard_number(name) is None:
        return scene
    order = np.argsort(scene.cameras[2][:, 0])
    return Scene(name, tuple(scene.image_paths[k] for k in order), *(part[order] for part in scene.cameras))


@lru_cache(maxsize=16)
def read_pair(scene: str, gap: int, max_size_px: int = 1536) -> TruePair:
    """Both images of a pair with their truth at working size."""
    whole, (i, j) = pair_of(scene, gap)
    # One by one: several are sorted by name.
    images = tuple(read_images([whole.image_paths[k]], max_size_px=max_size_px).images[0] for k in (i, j))
    truth = camera_pair(whole, i, j).truth
    assert truth is not None
    scale = np.repeat([image.scale for image in images], 2)
    K, R, C = whole.cameras_of((i, j))
    smaller = np.stack([resizing_transform(image.scale) for image in images])
    return TruePair(images, (i, j), (truth + 0.5) * scale - 0.5, smaller @ K, R, C)


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
