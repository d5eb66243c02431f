"""Sections 1.2 and 1.3: interpolated views compared with the real images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from thesisrecon.api.views import prepare_rectified_pair
from thesisrecon.arrays import F32, U8
from thesisrecon.records import DisparityMap
from thesisrecon.stereo._postprocessing import match_both_sides
from thesisrecon.stereo.semi_global import SemiGlobalMatching
from thesisrecon.views import render as similarity
from thesisrecon.views.tensor import (
    AGREE_PX,
    CalibratedPair,
    TensorSynthesis,
    camera_at,
    default_intrinsics,
    prepare_synthesis,
)
from validation.references.libraries import one_thread
from validation.references.opencv import OpenCVSemiGlobal
from validation.runs.records import Judgement, Outcome, Picture, ReportOptions, Stage, Task
from validation.runs.tables import OURS, Metric, Values, each, row
from validation.scenes.real import read_rgb
from validation.scenes.stereo import read_disparity, stereo_folder

SSIM_BORDER_PX = 5  # Radius of the SSIM windows


def psnr_db(image: NDArray[Any], truth: NDArray[Any]) -> float:
    """Peak signal-to-noise ratio of images (H, W, 3)."""
    return similarity.psnr_db(truth, image, np.ones(truth.shape[:2], dtype=bool))


def ssim(image: NDArray[Any], truth: NDArray[Any]) -> float:
    """Mean structural similarity of images (H, W, 3), 1 for equal ones, where whole windows fit."""
    found = similarity._ssim_map(truth, image, np.ones(truth.shape[:2], dtype=bool))
    return float(found[SSIM_BORDER_PX:-SSIM_BORDER_PX, SSIM_BORDER_PX:-SSIM_BORDER_PX].mean())


ENDS = (2, 6)
BETWEEN = (3, 4, 5)
BEYOND = (1, 7)
DISPARITIES = 64  # Between the ends; their disparities are less than this


class NineViews(NamedTuple):
    """``images`` (H, W, 3) by their number, and the true disparities (H, W) of both ends, NaN = unknown."""

    images: dict[int, U8]
    disparities: tuple[F32, F32]

    def share(self, view: int) -> float:
        """Return the position of a view between the ends, 0 to 1."""
        return (view - ENDS[0]) / (ENDS[1] - ENDS[0])


def load_cones() -> NineViews:
    """The Cones of Scharstein and Szeliski (CVPR 2003)."""
    folder = stereo_folder("Cones")
    if folder is None:
        raise ValueError("the nine views are not on this machine")
    numbers = sorted({*ENDS, *BETWEEN, *BEYOND})
    images = {k: read_rgb(folder / f"im{k}.png") for k in numbers}
    first, second = (read_disparity(folder / f"disp{k}.png", 4.0) for k in ENDS)
    return NineViews(images, (first, second))


def synthesis_of_disparities(
    left: U8, right: U8, of_left: F32, of_right: F32, *, agree_px: float = AGREE_PX
) -> TensorSynthesis:
    """A rectified pair of parallel cameras as a pair for the tensor, unknown pixels treated as background."""
    height, width = of_left.shape
    places = []
    for d, sign in ((of_left, -1.0), (of_right, 1.0)):
        y, x = np.indices(d.shape, dtype=np.float32)
        filled = DisparityMap(d, np.zeros_like(d), 0.0).filled()
        places.append(np.stack([x + np.float32(sign) * filled, y], axis=-1))
    K = default_intrinsics((width, height))
    pair = CalibratedPair(K, K, np.eye(3), np.array([-1.0, 0.0, 0.0]))
    return prepare_synthesis(pair, (left, right), (places[0], places[1]), agree_px=agree_px)


def dissolved(first: U8, second: U8, share: float) -> U8:
    """Cross-dissolve of both images, the baseline of interpolation."""
    mixed = (1.0 - share) * first.astype(np.float64) + share * second
    return np.asarray(np.rint(mixed), dtype=np.uint8)


TRUE, DISSOLVE = "true disparities", "cross-dissolve"
THREE_WAY, HH = "SGBM 3-way", "SGBM HH"
BY_TENSOR = " (tensor)"
TENSOR = OURS + BY_TENSOR
SGBM_SIGMA_PX = 0.2  # Not exact: as for ours, both sides must agree
BORDER_PX = 50  # Border columns of extrapolated views that no input image covers


class ViewInterpolationStage(Stage):
    """The same warp with our disparities, OpenCV's and the true ones, and the tensor with each."""

    name = "view-interpolation"

    def takes(self, scene: str, options: ReportOptions) -> bool:
        return scene == "Cones" and stereo_folder(scene) is not None

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        sources = (OURS, THREE_WAY, HH, TRUE)
        tensors = (OURS,) if options.gates_only else sources
        return (*sources, DISSOLVE, *(source + BY_TENSOR for source in tensors))

    def run(self, task: Task, folder: Path, options: ReportOptions) -> None:
        for view, picture in _pictures(task.method, load_cones()).items():
            PIL.Image.fromarray(picture).save(_file(folder, view))

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        cones = load_cones()
        made = {name: _read(outcome) for name, outcome in outcomes.items()}

        def mean(measure: Callable[[U8, U8], float]) -> Values:
            """Over the views between the inputs; None if they are missing."""
            some = {name: images or None for name, images in made.items()}
            return each(some, lambda images: np.mean([measure(images[k], cones.images[k]) for k in BETWEEN]))

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
        wanted = cones.images[k]
        apart = np.clip(128.0 + 4.0 * (picture.astype(np.float32) - wanted), 0.0, 255.0).astype(np.uint8)
        PIL.Image.fromarray(np.concatenate([wanted, picture, apart], axis=1)).save(_file(folder, k))
        text = "The image, ours, and four times the difference from middle grey."
        shown.append(Picture(_file(folder, k).name, f"View {k}", text))
    return shown


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
        match = partial(SemiGlobalMatching().match, disparity_range=(0, DISPARITIES - 1))
        return match_both_sides(match, left, right)
    one_thread()
    reference = OpenCVSemiGlobal(source)
    # Seen in a mirror, the right image is a left one.
    mirrored = [np.ascontiguousarray(image[:, ::-1]) for image in (right, left)]
    back = reference.match(mirrored[0], mirrored[1], DISPARITIES)
    found = reference.match(left, right, DISPARITIES), np.ascontiguousarray(back[:, ::-1])
    first, second = (DisparityMap(d, np.isfinite(d).astype(np.float32), SGBM_SIGMA_PX) for d in found)
    return first, second


def _file(folder: Path, view: int) -> Path:
    return folder / f"{view}.png"


def _read(outcome: Outcome) -> dict[int, U8]:
    folder = Path(outcome.folder)
    return {
        k: read_rgb(_file(folder, k)) for k in (*BETWEEN, *BEYOND) if outcome.ok and _file(folder, k).exists()
    }
