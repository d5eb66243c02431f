"""Integer images of rectified pairs, their noise, and matching costs of rows, strip by strip."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thesisrecon._numba import empty, full, kernel, zeros
from thesisrecon.arrays import I16, I32, U8, U16

LEVELS = 4  #: integer steps of one grey level: resampled images have fractional levels
ARM = 2  #: maximal length of a support arm in pixels
CENSUS_BITS = 24
WEIGHT_SHIFT = 8  #: weights are in units of 1 / 256
MAX_DISPARITIES = 4096  #: upper limit of the number of disparities searched

CostFeatures = tuple[I32, I16, U8]
"""Census transform (H, W), channels (K, H, W) and valid pixels (H, W) of rows of an image."""


def checked_range(disparity_range: tuple[int, int]) -> tuple[int, int]:
    """Check that a disparity range is not empty or too large."""
    first, last = (int(d) for d in disparity_range)
    if not 0 <= last - first < MAX_DISPARITIES:
        raise ValueError(f"disparities need first <= last < first + {MAX_DISPARITIES}; got {disparity_range}")
    return first, last


def row_strips(height: int, bytes_per_row: int, memory_bytes: float) -> list[tuple[int, int, int, int]]:
    """Fewest strips (first, last, from, to) of rows that fit the memory; ``from`` and ``to`` have margins."""
    # Additional rows above and below a strip: pixels farther away hardly change a path cost.
    strip_margin = 24
    min_strip_rows = 32
    fitting = int(memory_bytes // max(bytes_per_row, 1))
    if height <= fitting:
        return [(0, height, 0, height)]
    own = max(fitting - 2 * strip_margin, min_strip_rows)
    count = -(-height // own)
    edges = [height * k // count for k in range(count + 1)]
    return [
        (first, last, max(first - strip_margin, 0), min(last + strip_margin, height))
        for first, last in pairwise(edges)
    ]


@dataclass(frozen=True)
class StereoImage:
    """One image of a rectified pair."""

    channels: I16  #: (K, H, W) in quarters of a grey level, 0 where there is no pixel
    grey: I16  #: (H, W) their sum
    valid: U8  #: (H, W) 255 where there is a pixel, else 0


def prepare_stereo_images(left: ArrayLike, right: ArrayLike) -> tuple[StereoImage, StereoImage]:
    """Convert grey levels 0 .. 255, (H, W) or (H, W, K <= 4), NaN = no pixel, to integer channels."""
    if np.shape(left) != np.shape(right):
        raise ValueError(f"rectified images need the same shape; got {np.shape(left)}, {np.shape(right)}")
    return _side(np.asarray(left)), _side(np.asarray(right))


def _side(image: NDArray[np.generic]) -> StereoImage:
    if image.ndim not in (2, 3) or 0 in image.shape or (image.ndim == 3 and image.shape[2] > 4):
        raise ValueError(f"an image must be (H, W) or (H, W, K) with K <= 4; got {image.shape}")
    levels = np.moveaxis(image.reshape(*image.shape[:2], -1).astype(np.float32), 2, 0) * np.float32(LEVELS)
    known = np.isfinite(levels)
    levels = np.clip(np.where(known, levels, np.float32(0.0)), np.float32(0.0), np.float32(255.0 * LEVELS))
    channels = np.ascontiguousarray(levels + np.float32(0.5)).astype(np.int16)
    valid = np.where(known.all(axis=0), 255, 0).astype(np.uint8)
    return StereoImage(channels, channels.sum(axis=0, dtype=np.int16), valid)


def estimate_noise(image: StereoImage) -> float:
    """Noise of a channel in grey levels: median difference of two Laplacians (Immerkaer 1996: mean)."""
    rows_for_noise = 24  # Number of evenly spaced rows used for the median
    if min(image.valid.shape) < 3:
        return 0.0
    step = max(image.valid.shape[0] // rows_for_noise, 1)
    top = np.arange(0, image.valid.shape[0] - 2, step)
    rows = [image.channels[:, top + k].copy() for k in range(3)]
    mixed = rows[0] - 2 * rows[1] + rows[2]
    response = mixed[..., :-2] - 2 * mixed[..., 1:-1] + mixed[..., 2:]
    whole = np.minimum(np.minimum(image.valid[top], image.valid[top + 1]), image.valid[top + 2]) > 0
    inimage = whole[:, :-2] & whole[:, 1:-1] & whole[:, 2:]
    if not inimage.any():
        return 0.0
    # The squared filter coefficients sum to 36.
    median = np.quantile(np.abs(response[:, inimage]), 0.5, method="inverted_cdf")
    return float(1.4826 * median / 6.0 / LEVELS)


@kernel
def _count_ones(word: np.int32) -> np.uint32:
    """Population count in a form that the compiler replaces by one instruction."""
    x = np.uint32(word)
    x = np.uint32(x - np.uint32(np.uint32(x >> np.uint32(1)) & np.uint32(0x55555555)))
    twos = np.uint32(np.uint32(x >> np.uint32(2)) & np.uint32(0x33333333))
    x = np.uint32(np.uint32(x & np.uint32(0x33333333)) + twos)
    x = np.uint32(np.uint32(x + np.uint32(x >> np.uint32(4))) & np.uint32(0x0F0F0F0F))
    return np.uint32(np.uint32(x * np.uint32(0x01010101)) >> np.uint32(24))


def census(grey: I16) -> I32:
    """Census transform (Zabih and Woodfill 1994): one bit per window pixel, 1 if darker than the centre."""
    # Windows of 5 x 5 pixels, 24 comparisons; the border is repeated.
    (height, width), padded = grey.shape, np.pad(grey, 2, mode="edge")
    bits = np.zeros(grey.shape, np.int32)
    for k in range(25):
        if k != 12:
            bits <<= 1
            bits |= padded[k // 5 :, k % 5 :][:height, :width] < grey
    return bits


@kernel
def _add_difference(a: I16, b: I16, total: I16) -> None:
    for x in range(len(total)):
        apart = np.int16(a[x] - b[x])
        apart = np.int16(-apart) if apart < 0 else apart
        total[x] = np.int16(total[x] + apart)


@kernel
def _hamming(a: I32, b: I32, out: I16) -> None:
    for x in range(len(out)):
        out[x] = np.int16(_count_ones(np.int32(a[x] ^ b[x])))


@kernel
def _join(bits: I16, colour: I16, known: U8, weights: I16, outside: np.uint8, out: U8) -> None:
    """Combine Hamming distance and truncated colour difference."""
    of_bit, of_level, cap = weights[0], weights[1], weights[2]
    for x in range(len(out)):
        level = colour[x]
        level = cap if level > cap else level
        cost = np.int16(np.int16(bits[x] * of_bit) + np.int16(level * of_level)) >> WEIGHT_SHIFT
        inside = known[x]
        out[x] = np.uint8(cost) if inside != 0 else outside


@kernel
def _both(a: U8, b: U8, out: U8) -> None:
    for x in range(len(out)):
        out[x] = a[x] & b[x]


@kernel
def _row_costs(
    y: int, left: CostFeatures, right: CostFeatures, first: int, weights: I16, outside: np.uint8, padded: U8
) -> None:
    """Costs (D, W), in the middle of ``padded``, of row y of the left image at the disparities from first on.

    ``weights``: of a census bit, of a quarter level, and truncation; ``outside``: cost with a missing pixel.
    """
    bits_l, a, valid_l = left
    bits_r, b, valid_r = right
    width = bits_l.shape[1]
    total, differing = empty(width, np.int16), empty(width, np.int16)
    known = empty(width, np.uint8)
    margin = (padded.shape[1] - width) // 2
    for q in range(len(padded)):
        d = first + q
        lo, hi = min(max(d, 0), width), max(min(width, width + d), 0)
        out = padded[q, margin : margin + width]
        out[:lo], out[hi:] = outside, outside
        if hi <= lo:
            continue
        n = hi - lo
        total[:n] = 0
        for k in range(len(a) if weights[1] != 0 else 0):
            _add_difference(a[k, y, lo:hi], b[k, y, lo - d : hi - d], total[:n])
        _hamming(bits_l[y, lo:hi], bits_r[y, lo - d : hi - d], differing[:n])
        _both(valid_l[y, lo:hi], valid_r[y, lo - d : hi - d], known[:n])
        _join(differing[:n], total[:n], known[:n], weights, outside, out[lo:hi])


def support_masks(channels: I16, valid: U8, tolerance: np.int16) -> U8:
    """Cross-shaped support arms (4, ARM, H, W) of all pixels (Zhang, Lu and Lafruit 2009)."""
    # 255 where the pixel s + 1 to the left, right, top or bottom is within `tolerance` in each channel.
    height, width = valid.shape
    levels, known = np.pad(channels, [(0, 0), (ARM, ARM), (ARM, ARM)]), np.pad(valid, ARM)
    masks = np.zeros((4, ARM, height, width), np.uint8)
    for arm, (dy, dx) in enumerate(((0, -1), (0, 1), (-1, 0), (1, 0))):
        joined = np.full(valid.shape, 255, np.uint8)
        for s in range(ARM):
            beside = np.s_[..., ARM + (s + 1) * dy :, ARM + (s + 1) * dx :]
            alike = (np.abs(levels[beside][..., :height, :width] - channels) <= tolerance).all(axis=0)
            joined = masks[arm, s] = np.where(alike, joined & known[beside][:height, :width], 0)
    return masks


@kernel
def _sum_five(values: Any, masks: Any, out: U16) -> None:
    """Sum five rows of bytes or words, the four beside the middle one under their masks."""
    far_a, near_a, here, near_b, far_b = values
    mask_a, mask_far_a, mask_b, mask_far_b = masks
    for x in range(len(out)):
        total = np.uint16(np.uint16(here[x]) + np.uint16(near_a[x] & mask_a[x]))
        total = np.uint16(total + np.uint16(far_a[x] & mask_far_a[x]))
        total = np.uint16(total + np.uint16(near_b[x] & mask_b[x]))
        out[x] = np.uint16(total + np.uint16(far_b[x] & mask_far_b[x]))


@kernel
def _sum_along_row(padded: U8, masks: U8, y: int, out: U16) -> None:
    """Sums (W,) of the costs over the horizontal arms of row y; ``padded`` (W + 2 ARM,)."""
    n = len(out)
    beside = padded[:n], padded[1 : n + 1], padded[2 : n + 2], padded[3 : n + 3], padded[4 : n + 4]
    _sum_five(beside, (masks[0, 0, y], masks[0, 1, y], masks[1, 0, y], masks[1, 1, y]), out)


@kernel
def _sum_along_column(ring: U16, y: int, masks: U16, out: U16) -> None:
    """Sums (W,) over the vertical arms; ``ring`` (2 ARM + 1, W) holds row y at y modulo its length."""
    n = len(ring)
    rows = ring[(y - 2) % n], ring[(y - 1) % n], ring[y % n], ring[(y + 1) % n], ring[(y + 2) % n]
    _sum_five(rows, (masks[0], masks[1], masks[2], masks[3]), out)


@kernel
def cost_volume(
    left: CostFeatures, right: CostFeatures, masks: U8, first: int, weights: I16, outside: np.uint8,
    volume: U8,
) -> None:  # fmt: skip
    """Matching costs (H, D, W) of :func:`_row_costs`, averaged over support arms."""
    height, n, width = volume.shape
    span = 2 * ARM + 1
    ring, counts = zeros((n, span, width), np.uint16), zeros((span, width), np.uint16)
    costs, ones = zeros((n, width + 2 * ARM), np.uint8), full(width + 2 * ARM, 1, np.uint8)
    share, wide = empty(width, np.float32), empty((2 * ARM, width), np.uint16)
    total = empty(width, np.uint16)
    summed = 0
    for y in range(height):
        while summed < min(y + ARM + 1, height):
            _row_costs(summed, left, right, first, weights, outside, costs)
            _sum_along_row(ones, masks, summed, counts[summed % span])
            for q in range(n):
                _sum_along_row(costs[q], masks, summed, ring[q, summed % span])
            summed += 1
        for k in range(2 * ARM):
            mask, words = masks[2 + k // ARM, k % ARM, y], wide[k]
            for x in range(width):
                words[x] = np.uint16(np.uint16(mask[x]) * np.uint16(257))
        _sum_along_column(counts, y, wide, total)
        for x in range(width):
            share[x] = np.float32(1.0) / np.float32(total[x])
        for q in range(n):
            _sum_along_column(ring[q], y, wide, total)
            out = volume[y, q]
            for x in range(width):
                out[x] = np.uint8(np.int32(np.float32(total[x]) * share[x] + np.float32(0.5)))
