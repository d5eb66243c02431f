"""Pixels that stay the same while the scene moves: a text, a part of the vehicle, the room of a turntable."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
import scipy

from thesisrecon.arrays import B8, F32
from thesisrecon.imaging.resampling import resample
from thesisrecon.records import Image

FEWEST = 4  # images of one size
SAMPLES = 9  # images whose median is the static image
LONG_SIDE = 640  # pixels of the images that are compared
RADIUS = 3  # of the windows that are compared
CORRELATION, SHIFT_PX = 0.9, 0.5  # of a window with the static image
CONTRAST, SLOPE = 3.0, 1.0  # of a window in levels, and in its flattest direction in levels per pixel
LEAST = 1e-3  # share of the pixels below which agreement is chance
STANDING = 0.95  # share of the textured pixels from which the camera itself stands still


def static_pixels(
    images: Sequence[Image], *, map_all: Callable[[Callable[[Any], Any], list[Any]], Iterable[Any]] = map
) -> dict[int, B8]:
    """Pixels (H, W) of each image that look the same at the same place in most images of its size.

    A window is static if it correlates with the median of the images and is not shifted against it. So are
    distant points if the camera does not turn at all; images that are static everywhere, or have a mask, are
    left alone, and not among the numbers of the result.
    """
    groups = defaultdict(list)
    for n, image in enumerate(images):
        # A mask that is given decides what is left out.
        if image.mask is None:
            groups[image.size].append(n)
    found: dict[int, B8] = {}
    for group in groups.values():
        if len(group) >= FEWEST:
            found |= _of_equal_size(images, group, map_all)
    return found


def _of_equal_size(images: Sequence[Image], group: Sequence[int], map_all: Any) -> dict[int, B8]:
    some = np.unique(np.linspace(0, len(group) - 1, SAMPLES).round().astype(int))
    sample = list(map_all(_reduced, [images[group[k]] for k in some]))
    template = np.median(sample, axis=0).astype(np.float32)
    parts = [_agreement(template, reduced) for reduced in sample]
    # Most sets have none, which a sample shows.
    if sum(same.mean() >= LEAST for same, _ in parts) < FEWEST - 1:
        return {}
    if len(some) < len(group):
        parts = list(map_all(lambda n: _agreement(template, _reduced(images[n])), list(group)))
    # The median shows a static part that most images show.
    often = np.sum([same for same, _ in parts], axis=0) >= max(FEWEST - 1, len(group) / 2.0)
    window = np.ones((2 * RADIUS + 1, 2 * RADIUS + 1), dtype=bool)
    masks = dict[int, B8]()
    for n, (same, textured) in zip(group, parts, strict=True):
        kept = same & often
        if kept.mean() < LEAST or (kept & textured).sum() > STANDING * textured.sum():
            continue
        wide = scipy.ndimage.binary_dilation(kept, window)
        width, height = images[n].size
        rows, columns = (
            (np.arange(side) * there // side) for side, there in zip((height, width), wide.shape, strict=True)
        )
        masks[n] = wide[np.ix_(rows, columns)]
    # The middle of a slow film agrees with the median, too.
    return masks if 2 * len(masks) >= len(group) else {}


def _reduced(image: Image) -> F32:
    width, height = image.size
    factor = min(LONG_SIDE / max(width, height), 1.0)
    return resample(image.gray, max(round(width * factor), 1), max(round(height * factor), 1))


def _agreement(template: F32, reduced: F32) -> tuple[B8, B8]:
    """Windows (H, W) that agree with the static image, and those with texture."""
    mean = partial(scipy.ndimage.uniform_filter, size=2 * RADIUS + 1, mode="nearest")
    a, b = (levels - mean(levels) for levels in (reduced, template))
    # Rounding may leave a mean of squares below 0.
    aa, bb, ab = np.maximum(mean(a * a), 0.0), np.maximum(mean(b * b), 0.0), mean(a * b)
    textured = aa > CONTRAST**2
    same = textured & (bb > CONTRAST**2) & (ab > CORRELATION * np.sqrt(aa * bb))
    if same.mean() >= LEAST:
        # The shift of Lucas and Kanade, in pixels.
        y, x = np.gradient(b)
        d = a * np.sqrt(bb / np.maximum(aa, 1e-12)) - b
        xx, xy, yy, xd, yd = (mean(p) for p in (x * x, x * y, y * y, x * d, y * d))
        det = np.maximum(xx * yy - xy * xy, 1e-12)
        shift = np.hypot(yy * xd - xy * yd, xx * yd - xy * xd) / det
        # An edge or a ramp shows no shift along it; windows beside a corner are taken with it.
        same &= (shift < SHIFT_PX) & (det > SLOPE**2 * (xx + yy))
    return same, textured
