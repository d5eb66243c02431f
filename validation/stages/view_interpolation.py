"""Sections 1.2 and 1.3: interpolated views compared with the real images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import PIL.Image

from thesisrecon.api.views import prepare_rectified_pair
from thesisrecon.arrays import F32, U8
from thesisrecon.records import DisparityMap
from thesisrecon.views.tensor import camera_at
from validation.metrics.image_similarity import psnr_db, ssim
from validation.references.libraries import one_thread
from validation.references.opencv import OpenCVSemiGlobal
from validation.runs.records import Judgement, Outcome, Picture, ReportOptions, Stage, Task
from validation.runs.rows import OURS, Values, row
from validation.runs.tables import Metric
from validation.scenes.image_files import read_rgb
from validation.scenes.nine_views import (
    BETWEEN,
    BEYOND,
    DISPARITIES,
    ENDS,
    NineViews,
    both_ways,
    dissolved,
    load_cones,
    our_disparities,
    synthesis_of_disparities,
)

TRUE, DISSOLVE = "true disparities", "cross-dissolve"
THREE_WAY, HH = "SGBM 3-way", "SGBM HH"
BY_TENSOR = " (tensor)"
TENSOR = OURS + BY_TENSOR
BORDER_PX = 50
"""Border columns of extrapolated views that no input image covers."""


class ViewInterpolationStage(Stage):
    """The same warp with our disparities, OpenCV's and the true ones, and the tensor with each."""

    name = "view-interpolation"
    title = "View interpolation"
    definition = (
        "Images 3, 4 and 5 of nine are computed from 2 and 6 and compared: interpolation with our "
        "disparities, with OpenCV's and with the true ones, the tensor with the same, and a cross-dissolve. "
        "The tensor also computes 1 and 7, a quarter of the baseline beyond the ends."
    )

    def takes(self, scene: str, options: ReportOptions) -> bool:
        return scene == "Cones" and load_cones() is not None

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        sources = (OURS, THREE_WAY, HH, TRUE)
        tensors = (OURS,) if options.gates_only else sources
        return (*sources, DISSOLVE, *(source + BY_TENSOR for source in tensors))

    def run(self, task: Task, options: ReportOptions) -> None:
        folder = options.folder(task.stage, task.scene, task.method)
        for view, picture in _pictures(task.method, _cones()).items():
            PIL.Image.fromarray(picture).save(_file(folder, view))

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        cones = _cones()
        made = {name: _read(outcome) for name, outcome in outcomes.items()}

        def mean(measure: Callable[[U8, U8], float]) -> Values:
            """Over the views between the inputs; None if they are missing."""
            return {
                name: float(np.mean([measure(images[k], cones.images[k]) for k in BETWEEN]))
                if images
                else None
                for name, images in made.items()
            }

        peak, text = mean(psnr_db), "mean over images 3, 4 and 5"
        sgbm = max((v for n in (THREE_WAY, HH) if (v := peak[n]) is not None), default=None)
        metrics = [
            row(scene, "PSNR", "dB", peak, text, more=True),
            row(scene, "SSIM", "", mean(ssim), text, more=True),
        ]
        for what, method in (("", OURS), ("tensor: ", TENSOR)):
            for name, other in (("the better SGBM", sgbm), ("cross-dissolve", peak[DISSOLVE])):
                ours = peak[method]
                over = None if ours is None or other is None else ours - other
                difference = "difference of the means"
                metrics.append(row(scene, f"{what}PSNR over {name}", "dB", over, difference, more=True))
        metrics += [_of_view(scene, k, cones, made) for k in (*BETWEEN, *BEYOND)]
        return Judgement(metrics, pictures=_beside(options.folder(self.name, scene), cones, made))


def _of_view(scene: str, k: int, cones: NineViews, made: Mapping[str, Mapping[int, U8]]) -> Metric:
    """Return the row of one view."""
    beyond = k in BEYOND
    shown = slice(BORDER_PX, -BORDER_PX) if beyond else slice(None)
    wanted = cones.images[k][:, shown]
    values: Values = {
        name: psnr_db(images[k][:, shown], wanted) if k in images else None
        for name, images in made.items()
        if not beyond or BY_TENSOR in name
    }
    text = f"without {BORDER_PX} columns at the borders" if beyond else "of this view alone"
    return row(scene, f"PSNR, view {k}", "dB", values, text, more=True, judged=TENSOR if beyond else OURS)


def _beside(folder: Path, cones: NineViews, made: Mapping[str, Mapping[int, U8]]) -> list[Picture]:
    shown = []
    for k, picture in made[OURS].items():
        row = np.concatenate([cones.images[k], picture, _difference(picture, cones.images[k])], axis=1)
        PIL.Image.fromarray(row).save(_file(folder, k))
        text = "The image, ours, and four times the difference from middle grey."
        shown.append(Picture(_file(folder, k).name, f"View {k}", text))
    return shown


def _difference(picture: U8, wanted: U8) -> U8:
    apart = 4.0 * (picture.astype(np.float32) - wanted)
    return np.asarray(np.clip(128.0 + apart, 0.0, 255.0), dtype=np.uint8)


def _cones() -> NineViews:
    cones = load_cones()
    if cones is None:
        raise ValueError("the nine views are not on this machine")
    return cones


def _pictures(method: str, cones: NineViews) -> dict[int, U8]:
    left, right = (cones.images[k] for k in ENDS)
    if method == DISSOLVE:
        return {k: dissolved(left, right, cones.share(k)) for k in BETWEEN}
    maps = _disparities(method.removesuffix(BY_TENSOR), cones, left, right)
    if not method.endswith(BY_TENSOR):
        pair = prepare_rectified_pair(left, right, disparity=maps)
        return {k: pair.view(cones.share(k)) for k in BETWEEN}
    of_left, of_right = (m.disparity if isinstance(m, DisparityMap) else m for m in maps)
    # True disparities include hidden pixels, which need not agree.
    agree = {"agree_px": np.inf} if method.startswith(TRUE) else {}
    made = synthesis_of_disparities(left, right, of_left, of_right, **agree)
    return {
        k: made.render(camera_at(made.pair, cones.share(k), sizes=made.sizes)) for k in (*BETWEEN, *BEYOND)
    }


def _disparities(
    source: str, cones: NineViews, left: U8, right: U8
) -> tuple[DisparityMap, DisparityMap] | tuple[F32, F32]:
    if source == TRUE:
        return cones.disparities
    if source == OURS:
        return our_disparities(left, right)
    one_thread()
    reference = OpenCVSemiGlobal(source)
    return both_ways(lambda a, b: reference.match(a, b, DISPARITIES), left, right)


def _file(folder: Path, view: int) -> Path:
    return folder / f"{view}.png"


def _read(outcome: Outcome) -> dict[int, U8]:
    folder = Path(outcome.folder)
    return {
        k: read_rgb(_file(folder, k)) for k in (*BETWEEN, *BEYOND) if outcome.ok and _file(folder, k).exists()
    }
