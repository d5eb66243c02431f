"""Nine equally spaced rectified images, with real views between the inputs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from thesisrecon.arrays import F32, U8
from thesisrecon.records import DisparityMap
from thesisrecon.stereo._postprocessing import match_both_sides
from thesisrecon.stereo.semi_global import SemiGlobalMatching
from thesisrecon.views.tensor import CalibratedPair, default_intrinsics
from thesisrecon.views.tensor_synthesis import AGREE_PX, TensorSynthesis, prepare_synthesis
from validation.scenes.image_files import read_rgb
from validation.scenes.stereo import read_disparity, stereo_folder

ENDS = (2, 6)
BETWEEN = (3, 4, 5)
BEYOND = (1, 7)
DISPARITIES = 64
"""Between the ends; their disparities are less than this."""


@dataclass(frozen=True)
class NineViews:
    """``images`` (H, W, 3) by their number, and the true disparities (H, W) of both ends, NaN = unknown."""

    images: dict[int, U8]
    disparities: tuple[F32, F32]

    def share(self, view: int) -> float:
        """Return the position of a view between the ends, 0 to 1."""
        return (view - ENDS[0]) / (ENDS[1] - ENDS[0])


def load_cones() -> NineViews | None:
    """The Cones of Scharstein and Szeliski (CVPR 2003); None if they are not on this machine."""
    folder = stereo_folder("Cones")
    if folder is None:
        return None
    numbers = sorted({*ENDS, *BETWEEN, *BEYOND})
    images = {k: read_rgb(folder / f"im{k}.png") for k in numbers}
    first, second = (read_disparity(folder / f"disp{k}.png", 4.0) for k in ENDS)
    return NineViews(images, (first, second))


def mirrored(image: U8) -> U8:
    """The image from right to left: the right one of a pair becomes a left one."""
    return np.ascontiguousarray(image[:, ::-1])


def both_ways(match: Callable[[U8, U8], F32], left: U8, right: U8) -> tuple[F32, F32]:
    """Return disparities of both images by a method for the left one."""
    back = match(mirrored(right), mirrored(left))
    return match(left, right), np.ascontiguousarray(back[:, ::-1])


def our_disparities(left: U8, right: U8) -> tuple[DisparityMap, DisparityMap]:
    """The maps of both images by the library's default matcher, with its confidences."""
    match = partial(SemiGlobalMatching().match, disparity_range=(0, DISPARITIES - 1))
    return match_both_sides(match, left, right)


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
