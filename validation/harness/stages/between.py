"""Sections 1.2 and 1.3: views between two photographs, without a model, beside the real ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from thesisrecon.between import rectified_pair
from thesisrecon.dense.matching import CohesiveScanlines
from thesisrecon.types import F32, DisparityMap
from thesisrecon.views.likeness import psnr_db, ssim
from thesisrecon.views.tensor import CalibratedPair, camera_at, guessed_intrinsics, prepare_synthesis
from validation.harness.records import Judgement, Outcome, Picture, Task, Wishes
from validation.metrics.record import Metric
from validation.scenes.nine_views import (
    BETWEEN,
    DISPARITIES,
    ENDS,
    NineViews,
    both_ways,
    dissolved,
    load_cones,
    mirrored,
    read_rgb,
)

U8 = NDArray[np.uint8]
OURS, TENSOR, TRUE, DISSOLVE = "ours", "ours (tensor)", "true disparities", "cross-dissolve"
THREE_WAY, HH = "SGBM 3-way", "SGBM HH"


class BetweenStage:
    """The same warp with our disparities, OpenCV's and the true ones, and the tensor with ours."""

    name = "between"
    title = "Views between photographs"
    definition = (
        "Photographs 3, 4 and 5 of nine, made from 2 and 6, beside the real ones: interpolation with our "
        "disparities, with OpenCV's and with the true ones, the tensor with ours, and a mere mixture."
    )

    def takes(self, scene: str, wishes: Wishes) -> bool:  # noqa: ARG002 (the same for all wishes)
        return scene == "Cones" and load_cones() is not None

    def methods(self, scene: str, wishes: Wishes) -> tuple[str, ...]:  # noqa: ARG002 (the same everywhere)
        return (OURS, TENSOR, THREE_WAY, HH, TRUE, DISSOLVE)

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:  # noqa: ARG002 (nothing)
        return ()

    def run(self, task: Task, wishes: Wishes) -> None:
        cones = _cones()
        place = wishes.place(task.stage, task.scene, task.method)
        for view, picture in _pictures(task.method, cones).items():
            PIL.Image.fromarray(picture).save(place / f"{view}.png")

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], wishes: Wishes) -> Judgement:
        cones = _cones()
        made = {n: _read(o) if o.ok else None for n, o in outcomes.items()}
        everywhere = np.ones(cones.images[ENDS[0]].shape[:2], dtype=bool)
        peak, alike = dict[str, float | None](), dict[str, float | None]()
        for name, pictures in made.items():
            told = [] if pictures is None else [(cones.images[k], p) for k, p in pictures.items()]
            peak[name] = float(np.mean([psnr_db(a, b, everywhere) for a, b in told])) if told else None
            alike[name] = float(np.mean([ssim(a, b, everywhere) for a, b in told])) if told else None
        sgbm = max((v for n in (THREE_WAY, HH) if (v := peak[n]) is not None), default=None)
        words = "mean over photographs 3, 4 and 5"
        metrics = [
            Metric(scene, "PSNR", "dB", peak, OURS, at_most=False, definition=words),
            Metric(scene, "SSIM", "", alike, OURS, at_most=False, definition=words),
            *(
                _over(scene, f"{what}PSNR over {name}", peak[method], other)
                for what, method in (("", OURS), ("tensor: ", TENSOR))
                for name, other in (("the better SGBM", sgbm), ("cross-dissolve", peak[DISSOLVE]))
            ),
        ]
        place = wishes.place(self.name, scene)
        shown = []
        ours = made[OURS]
        if ours is not None:
            for k in BETWEEN:
                row = np.concatenate([cones.images[k], ours[k]], axis=1)
                PIL.Image.fromarray(row).save(place / f"{k}.png")
                shown.append(Picture(f"{k}.png", f"View {k}", "The photograph, and ours."))
        return Judgement(
            metrics, pictures=shown, notes=[f"{n}: {o.failure}." for n, o in outcomes.items() if not o.ok]
        )


def _over(scene: str, name: str, peak: float | None, other: float | None) -> Metric:
    over = None if peak is None or other is None else peak - other
    return Metric(scene, name, "dB", {OURS: over}, OURS, at_most=False, definition="difference of the means")


def _cones() -> NineViews:
    cones = load_cones()
    if cones is None:
        raise ValueError("the nine views are not on this machine")
    return cones


def _pictures(method: str, cones: NineViews) -> dict[int, U8]:
    left, right = (cones.images[k] for k in ENDS)
    if method == DISSOLVE:
        return {k: dissolved(left, right, cones.share(k)) for k in BETWEEN}
    if method == TENSOR:
        return _by_tensor(cones, left, right)
    pair = rectified_pair(left, right, disparity=_disparities(method, cones, left, right))
    return {k: pair.view(cones.share(k)) for k in BETWEEN}


def _disparities(
    method: str, cones: NineViews, left: U8, right: U8
) -> tuple[DisparityMap, DisparityMap] | tuple[F32, F32]:
    if method == TRUE:
        return cones.disparities
    if method == OURS:
        matcher, limits = CohesiveScanlines(), (0, DISPARITIES - 1)
        back = matcher.match(mirrored(right), mirrored(left), disparity_range=limits)
        turned, sure = (np.ascontiguousarray(part[:, ::-1]) for part in (back.disparity, back.confidence))
        return matcher.match(left, right, disparity_range=limits), DisparityMap(turned, sure, back.sigma_px)
    import cv2

    from validation.references.semi_global import OpenCVSemiGlobal

    cv2.setNumThreads(1)
    reference = OpenCVSemiGlobal(method)
    return both_ways(lambda a, b: reference.match(a, b, DISPARITIES), left, right)


def _by_tensor(cones: NineViews, left: U8, right: U8) -> dict[int, U8]:
    """A rectified pair is one of parallel cameras; what only one sees is taken for background."""
    matcher, limits = CohesiveScanlines(), (0, DISPARITIES - 1)
    maps = both_ways(lambda a, b: matcher.match(a, b, disparity_range=limits).disparity, left, right)
    places = []
    for d, sign in zip(maps, (-1.0, 1.0), strict=True):
        y, x = np.indices(d.shape, dtype=np.float32)
        filled = DisparityMap(d, np.zeros_like(d), 0.0).filled()
        places.append(np.stack([x + np.float32(sign) * filled, y], axis=-1))
    height, width = maps[0].shape
    K = guessed_intrinsics((width, height))
    pair = CalibratedPair(K, K, np.eye(3), np.array([-1.0, 0.0, 0.0]))
    synthesis = prepare_synthesis(pair, (left, right), (places[0], places[1]))
    return {k: synthesis.render(camera_at(pair, cones.share(k), sizes=synthesis.sizes)) for k in BETWEEN}


def _read(outcome: Outcome) -> dict[int, U8]:
    return {k: read_rgb(Path(outcome.place) / f"{k}.png") for k in BETWEEN}
