"""Reconstruction of images, or its first steps, evaluated with the true cameras."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, get_args

import numpy as np

import thesisrecon
from thesisrecon._numba import code_digest
from thesisrecon.arrays import resizing_transform
from thesisrecon.config import KINDS, PipelineConfig
from thesisrecon.config.text import tables_from_config
from thesisrecon.errors import UsageError, unknown_word
from thesisrecon.pipeline.run import Until
from thesisrecon.results import RunResult
from thesisrecon.runtime._run_folder import key_of
from validation.ablation.study import Measure, Place, Task, window_names, window_parts, window_slice
from validation.metrics.cameras import (
    AUC_DEG,
    TrueCameras,
    measure_cameras,
    measure_reprojection,
    pose_pair_errors,
    pose_scores_pct,
)
from validation.runs.records import IMAGE_SCENES, ReportOptions, load_images
from validation.scenes.many_views import load_yard, yard_number
from validation.scenes.real import Scene

SETTINGS_OF: Mapping[str, tuple[str, ...]] = {
    "features": ("images", "features"),
    "matches": ("pairs", "matching", "epipolar", "verification"),
    "projective": ("tracks", "projective"),
    "metric": ("intrinsics", "selfcalibration", "metric"),
    "dense": ("dense",),
    "model": ("model",),
}  # The settings that each step adds to those before it
POSE_MEASURES = tuple(
    Measure(name, "%", "more", False, about, extra=True)
    for name, about in {
        **{f"auc{at:g}_pct": f"AUC of relative poses up to {at:g} degrees" for at in AUC_DEG},
        "maa_pct": "mean recall of relative poses at 1, 2 ... 10 degrees",
    }.items()
)
NEED_POSES = ("centre_error_mm", "rotation_error_deg", *(m.name for m in POSE_MEASURES))
AVAILABLE_FROM: Mapping[str, tuple[str, ...]] = {
    "matches": ("verified", "sigma_px"),
    "projective": ("registered_pct", "points"),
    "metric": ("reprojection_px", "trusted", "focal_error_pct", *NEED_POSES),
}  # The first step after which a number is known


@dataclass(frozen=True)
class Reconstruction(Task):
    """:func:`thesisrecon.reconstruct` up to and with ``until``, on one thread. A scene is one with a name, or
    a folder of images with true cameras of any format, or K.txt, if there are any. "NAME#k/n" is a
    subset: the k-th of n windows of two thirds of the images, in the order of their names. "yard-N" is a
    rendered yard with true cameras, another one for each number.
    """

    until: str = "metric"

    measures: ClassVar[Sequence[Measure]] = (
        Measure("focal_error_pct", "%", "less", True, "median |f / f_true - 1| of the registered cameras"),
        Measure("centre_error_mm", "mm", "less", True, "mean distance of the centres after a similarity"),
        Measure("rotation_error_deg", "deg", "less", True, "median angle after the common rotation"),
        Measure("registered_pct", "%", "more", False, "share of the images that have a camera"),
        Measure("points", "", "more", True, "points of the model"),
        Measure("reprojection_px", "px", "less", True, "median distance of observations from their points"),
        Measure("verified", "", "more", True, "verified matches of all accepted pairs"),
        Measure("sigma_px", "px", "less", True, "median noise of the accepted pairs"),
        Measure("trusted", "", "more", False, "1: the result passed its own check"),
        *POSE_MEASURES,
    )

    def __post_init__(self) -> None:
        if self.until not in get_args(Until):
            raise ValueError(unknown_word("stage", self.until, get_args(Until)))

    def names_of_scenes(self) -> Sequence[str]:
        return [*IMAGE_SCENES, "yard-1", "a folder of images"]

    def scene_of(self, scene: str) -> str:
        return window_parts(scene)[0]

    def subsets(self, scene: str, count: int) -> list[str]:
        return window_names(scene, count)

    def check(self, scene: str) -> None:
        scene_or_folder(scene)

    def scene_key(self, scene: str) -> str:
        whole = scene_or_folder(scene)
        return content_key(whole, range(len(whole.image_paths))[window_slice(scene, len(whole.image_paths))])

    def unavailable(self, scene: str) -> set[str]:
        """Return the measures that need missing true cameras or a later step."""
        steps = list(SETTINGS_OF)
        reached = steps.index(self.until)
        found = {
            name for step, names in AVAILABLE_FROM.items() if reached < steps.index(step) for name in names
        }
        whole = scene_or_folder(scene)
        unknown = {"focal_error_pct"} if whole.K is None else set()
        return found | unknown | (set() if whole.truth is not None else {*NEED_POSES})

    def steps(self, config: PipelineConfig, scene: str, seed: int) -> list[tuple[str, str]]:
        """A step is named by all settings up to it; corners alone do not depend on the seed."""
        tables, settings, found = tables_from_config(config), dict[str, Any](), []
        for step, stages in SETTINGS_OF.items():
            for stage in stages:
                variant = getattr(config, stage)
                code = code_digest(variant) if stage in KINDS else ""
                settings[stage] = [type(variant).__module__, code, tables[stage]]
            drawn = [] if step == "features" else [seed]
            found.append((step, key_of("step", step, scene, settings, drawn)))
            if step == self.until:
                break
        return found

    def prepare(self, config: PipelineConfig, scene: str, seed: int, place: Place, *, step: str) -> None:
        _reconstruct(config, scene, seed, place, step)

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        result = _reconstruct(config, scene, seed, place, self.until)
        return _measured(result, scene_or_folder(scene), len(_images(scene)))


def _reconstruct(config: PipelineConfig, scene: str, seed: int, place: Place, until: str) -> RunResult:
    given: Any = {"config": config, "seed": seed, "until": until, "threads": 1, "shared": place.shared}
    return thesisrecon.reconstruct(_images(scene), place.own, **given)


def content_key(scene: Scene, views: Sequence[int]) -> str:
    """Digest of some images of a scene and of their truth."""
    content = hashlib.sha256()
    for path in (scene.image_paths[k] for k in views):
        content.update(path.name.encode() + path.read_bytes())
    for part in scene.cameras_of(views):
        content.update(np.ascontiguousarray(part).tobytes())
    return content.hexdigest()[:32]


def _images(scene: str) -> tuple[Path, ...]:
    paths = scene_or_folder(scene).image_paths
    return paths[window_slice(scene, len(paths))]


def scene_or_folder(scene: str) -> Scene:
    """The images of a whole scene by its name or its folder; :class:`UsageError` if there are none."""
    scene = window_parts(scene)[0]
    yard = yard_number(scene)
    if yard is not None:
        return load_yard(yard)
    folder = Path(scene)
    named = {} if scene in IMAGE_SCENES or not folder.is_dir() else {scene: str(folder)}
    if scene not in IMAGE_SCENES and not named:
        raise UsageError(f"{unknown_word('scene', scene, IMAGE_SCENES)}; a folder of images is one too")
    try:
        return load_images(scene, ReportOptions(Path(), (), (), named))
    except ValueError as error:
        raise UsageError(str(error)) from None


def _measured(result: RunResult, scene: Scene, images: int) -> dict[str, float]:
    accepted = [pair for pair in result.pairs if pair.accepted]
    found = {"verified": float(sum(pair.inliers for pair in accepted))} if result.pairs else {}
    if accepted:
        found["sigma_px"] = float(np.median([pair.sigma_px for pair in accepted]))
    if result.metric is None:
        if result.projective is not None:
            found["registered_pct"] = 100.0 * float(result.projective.registered.mean())
            found["points"] = float(result.projective.valid.sum())
        return found
    model = result.metric.reconstruction
    found["registered_pct"] = 100.0 * float(model.registered.sum()) / images
    found["points"] = float(model.valid.sum())
    found["trusted"] = float(result.metric.trusted)
    found["reprojection_px"] = measure_reprojection(model).median_px
    truth = _truth_at_working_size(result, scene)
    errors = measure_cameras(model, truth)
    if scene.K is not None:
        found["focal_error_pct"] = errors.focal_error_pct
    if scene.truth is not None:
        found |= pose_scores_pct(pose_pair_errors(model, truth))
        found["rotation_error_deg"] = errors.rotation_error_deg
        found["centre_error_mm"] = np.nan if errors.centre_error_mm is None else errors.centre_error_mm
    return found


def _truth_at_working_size(result: RunResult, scene: Scene) -> TrueCameras:
    number = {path.name: n for n, path in enumerate(scene.image_paths)}
    chosen = [number[image.name] for image in result.images]
    K, R, C = scene.cameras_of(chosen)
    return np.stack([resizing_transform(image.scale) for image in result.images]) @ K, R, C
