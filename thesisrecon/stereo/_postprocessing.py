"""Compiled selection of disparities, left-right check, speckle filter, smoothing, and confidence."""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from thesisrecon._numba import copy_to, empty, full, kernel, zeros
from thesisrecon.arrays import B8, F32, F64, I16, U8, U16
from thesisrecon.records import DisparityMap
from thesisrecon.stereo._cost import LEVELS, StereoImage

UNREACHED = np.uint16(65535)


@kernel
def _keep_best(total: U16, q: np.int16, best: U16, index: I16) -> None:
    for x in range(len(best)):
        # Loads precede the selections: a load inside one would prevent vectorisation.
        value, least, at = total[x], best[x], index[x]
        index[x] = q if value < least else at
        best[x] = value if value < least else least


@kernel
def _keep_second_best(total: U16, q: np.int16, index: I16, second: U16) -> None:
    """Least total of a disparity that is not adjacent to the best one."""
    for x in range(len(second)):
        apart = np.int16(index[x] - q)
        apart = np.int16(-apart) if apart < 0 else apart
        value, least = total[x], second[x]
        value = value if apart > 1 else UNREACHED
        second[x] = value if value < least else least


@kernel
def best_disparities(sums: U8, start: int, first: int, out: tuple[F32, F32, F32], half: float) -> None:
    """Select the best disparity of every pixel from path sums (P, N, D, W), rows from ``start`` on."""
    # `out` (3 of (H, W)): left disparities at the vertex of two lines of opposite slope through three totals,
    # whole right ones (NaN out of range), and the confidence m / (m + `half`), m the margin to the second
    # best.
    pairs, _, n, width = sums.shape
    left, right, confidence = out
    total = empty((n, width), np.uint16)
    best, index, second = empty(width, np.uint16), empty(width, np.int16), empty(width, np.uint16)
    best_r, index_r = empty(width, np.uint16), empty(width, np.int16)
    for y in range(len(left)):
        total[:] = 0
        for q in range(n):
            for k in range(pairs):
                values, of_pairs = sums[k, start + y, q], total[q]
                for x in range(width):
                    of_pairs[x] = np.uint16(of_pairs[x] + np.uint16(values[x]))
        best[:], index[:], second[:], best_r[:], index_r[:] = UNREACHED, 0, UNREACHED, UNREACHED, -1
        for q in range(n):
            d = first + q
            _keep_best(total[q], np.int16(q), best, index)
            lo, hi = min(max(d, 0), width), max(min(width, width + d), 0)
            if hi > lo:
                _keep_best(total[q, lo:hi], np.int16(q), best_r[lo - d : hi - d], index_r[lo - d : hi - d])
        for q in range(n):
            _keep_second_best(total[q], np.int16(q), index, second)
        for x in range(width):
            q = int(index[x])
            value = np.float32(first + q)
            if 0 < q < n - 1:
                a = np.float32(total[q - 1, x]) - np.float32(best[x])
                b = np.float32(total[q + 1, x]) - np.float32(best[x])
                steep = max(a, b)
                if steep > 0:
                    value += np.float32(0.5) * (a - b) / steep
            left[y, x] = value
            margin = np.float32(second[x]) - np.float32(best[x])
            confidence[y, x] = margin / (margin + np.float32(half))
            right[y, x] = np.float32(first + index_r[x]) if index_r[x] >= 0 else np.float32(np.nan)


def check_left_right(left: F32, right: F32, confidence: F32, largest_px: float, least: float) -> None:
    """Set disparities of the left image to NaN that differ from their partner's, or of low confidence."""
    width = left.shape[1]
    partner = np.floor(np.arange(width, dtype=np.float32) - left + np.float32(0.5))
    # Comparisons with NaN are false.
    inside = (partner >= 0.0) & (partner < width)
    at = np.where(inside, partner, 0.0).astype(np.int64)
    agree = inside & (np.abs(np.take_along_axis(right, at, axis=1) - left) <= largest_px)
    left[~agree | (confidence < least)] = np.nan


def final_confidence(confidence: F32, confirmed: F32, disparity: F32, texture: F32) -> F32:
    """Confidence (H, W): 0 for unknown disparities, halved for filled ones, less with weak ``texture``."""
    excess = np.maximum(texture - np.float32(1.0), np.float32(0.0))
    share = np.maximum(excess / (excess + np.float32(1.0)), np.float32(0.05))
    share[np.isnan(confirmed)] *= np.float32(0.5)
    return np.where(np.isnan(disparity), np.float32(0.0), confidence * share)


@kernel
def remove_speckles(disparity: F32, textured: B8, step: np.float32, smallest: int) -> None:
    """Set regions of fewer than ``smallest`` pixels, or too few ``textured`` in or beside them, to NaN."""
    # Neighbours are connected if their disparities differ by at most `step`.
    min_textured = 20  # A region needs one textured pixel per this number of pixels
    height, width = disparity.shape
    # Padding with unknown pixels gives every pixel four neighbours; one column serves both sides.
    line = width + 1
    flat = full((height + 2) * line, np.float32(np.nan), np.float32)
    counted = zeros((height + 2) * line, np.bool_)
    for y in range(height):
        start = (y + 1) * line
        copy_to(flat[start : start + width], disparity[y])
        copy_to(counted[start : start + width], textured[y])
    open_ = ~np.isnan(flat)
    queue = empty(height * width, np.int32)
    for seed in range(line, (height + 1) * line):
        if not open_[seed]:
            continue
        open_[seed] = False
        queue[0] = seed
        at, n, size = 0, 1, 0
        while at < n:
            place = queue[at]
            at += 1
            size += counted[place]
            here = flat[place]
            for k in range(4):
                other = place + (1 if k == 0 else -1 if k == 1 else line if k == 2 else -line)
                if not abs(flat[other] - here) <= step:
                    size += counted[other]
                elif open_[other]:
                    open_[other] = False
                    queue[n] = other
                    n += 1
        if n < smallest or min_textured * size < n:
            for k in range(n):
                y, x = queue[k] // line - 1, queue[k] % line
                disparity[y, x] = np.nan
                flat[queue[k]] = np.nan


def fill_pinholes(disparity: F32, least: int) -> F32:
    """Fill unknown pixels that have ``least`` known ones among 8 neighbours with their median, (H, W)."""
    y, x = np.nonzero(np.isnan(disparity))
    padded = np.pad(disparity, 1, constant_values=np.nan)
    # Sorted, unknown pixels come last; the pixel itself is one of them.
    around = np.sort([padded[y + b, x + a] for b in range(3) for a in range(3)], axis=0)
    known = np.isfinite(around).sum(axis=0)
    n, out = np.flatnonzero(known >= least), disparity.copy()
    below, above = (around[place, n] for place in ((known[n] - 1) // 2, known[n] // 2))
    out[y[n], x[n]] = np.float32(0.5) * (below + above)
    return out


@kernel
def _gather_similar(centre: F32, other: F32, step: np.float32, total: F32, count: F32) -> None:
    for x in range(len(centre)):
        value, summed, counted = other[x], total[x], count[x]
        # A comparison with NaN is false: unknown pixels do not contribute.
        similar = abs(value - centre[x]) <= step
        total[x] = summed + (value if similar else np.float32(0.0))
        count[x] = counted + (np.float32(1.0) if similar else np.float32(0.0))


@kernel(error_model="numpy")
def edge_preserving_mean(disparity: F32, step: np.float32, radius: int, out: F32) -> None:
    """Mean of the disparities in a square window that differ from the centre by at most ``step``, (H, W)."""
    height, width = disparity.shape
    total, count = empty(width, np.float32), empty(width, np.float32)
    for y in range(height):
        total[:], count[:] = 0.0, 0.0
        for b in range(max(y - radius, 0), min(y + radius + 1, height)):
            for dx in range(-radius, radius + 1):
                lo, hi = min(max(-dx, 0), width), max(min(width, width - dx), 0)
                if hi > lo:
                    _gather_similar(
                        disparity[y, lo:hi], disparity[b, lo + dx : hi + dx], step, total[lo:hi], count[lo:hi]
                    )
        for x in range(width):
            out[y, x] = total[x] / count[x] if count[x] > 0 else np.float32(np.nan)


LOCKING_PX = 0.17
"""Standard deviation of the vertex of two lines about the true disparity: it tends to whole pixels."""


def refine_by_gradient(disparity: F32, left: StereoImage, right: StereoImage, passes: int) -> F32:
    """Move disparities (H, W) by least squares of the intensities; none farther than half a pixel from whole.

    In a window (Lucas and Kanade 1981), L(x) = a R(x - d - s) + b with gain a and offset b is linear in a, b
    and a s for small s. Only pixels of the same surface count. The prior of d + s is the given disparity with
    its pixel locking, which rules where texture is missing; a result beyond half a pixel from the best whole
    disparity is not that of its minimum, and is dropped.
    """
    (grey, seen), other, refined = _smoothed(left), _smoothed(right), disparity
    for _ in range(passes):
        known = np.isfinite(refined) & seen
        place = np.arange(refined.shape[1], dtype=np.float32) - np.where(known, refined, np.float32(0.0))
        value, slope, inside = _sampled_row(*other, place)
        step = np.empty_like(refined)
        used = np.where(known & inside, refined, np.float32(np.nan))
        _least_squares_steps(used, disparity - refined, (grey, value, slope), step)
        refined = refined + step
    with np.errstate(invalid="ignore"):
        near = np.abs(refined - np.rint(disparity)) <= np.float32(0.5)
    return np.asarray(np.where(near, refined, disparity), dtype=np.float32)


@kernel
def _select_similar(other: F32, centre: F32, similar: F32) -> None:
    for x in range(len(similar)):
        # A comparison with NaN is false.
        similar[x] = np.float32(1.0) if abs(other[x] - centre[x]) <= np.float32(1.0) else np.float32(0.0)


@kernel
def _select_difference(similar: F32, values: F32, centre: F32, out: F32) -> None:
    for x in range(len(out)):
        out[x] = similar[x] * (values[x] - centre[x])


@kernel
def _add_product(a: F32, b: F32, out: F32) -> None:
    for x in range(len(out)):
        out[x] += a[x] * b[x]


@kernel
def _least_squares_steps(d: F32, prior: F32, images: tuple[F32, F32, F32], step: F32) -> None:
    """Fill the steps (H, W) of :func:`refine_by_gradient`; ``prior``: where the given disparities are."""
    # Window of 9 x 9 pixels, equal to that of the texture; every second one, as neighbours share their noise.
    radius, stride = 4, 2
    grey, value, slope = images
    height, width = d.shape
    sums, parts, none = (
        empty((10, width), np.float32),
        empty((4, width), np.float32),
        zeros(width, np.float32),
    )
    # Binomial means two pixels apart correlate by 1 / 6 along an axis: 9 / 16 of them are independent.
    variance, rounding = np.float32(9.0 / 16.0 * LOCKING_PX**2), np.float32(LEVELS**2 / 12.0)
    for y in range(height):
        sums[:] = 0.0
        for b in range(max(y - radius, (y - radius) % stride), min(y + radius + 1, height), stride):
            for dx in range(-radius, radius + 1, stride):
                lo, hi = min(max(-dx, 0), width), max(min(width, width - dx), 0)
                if hi <= lo:
                    continue
                start, end, n, k = lo + dx, hi + dx, hi - lo, 0
                _select_similar(d[b, start:end], d[y, lo:hi], parts[0, :n])
                _select_difference(parts[0, :n], grey[b, start:end], grey[y, lo:hi], parts[1, :n])
                _select_difference(parts[0, :n], value[b, start:end], value[y, lo:hi], parts[2, :n])
                _select_difference(parts[0, :n], slope[b, start:end], none[lo:hi], parts[3, :n])
                for i in range(4):
                    for j in range(i, 4):
                        _add_product(parts[i, :n], parts[j, :n], sums[k, lo:hi])
                        k += 1
        for x in range(width):
            step[y, x] = 0.0
            n = max(sums[0, x], np.float32(1.0))
            my, mr, mg = sums[1, x] / n, sums[2, x] / n, sums[3, x] / n
            syy, syr, syg = sums[4, x] / n - my * my, sums[5, x] / n - my * mr, sums[6, x] / n - my * mg
            srr, srg, sgg = sums[7, x] / n - mr * mr, sums[8, x] / n - mr * mg, sums[9, x] / n - mg * mg
            # The variance of the residuals without the prior weights it.
            det = srr * sgg - srg * srg
            gain, shift = (syr * sgg - syg * srg) / det, (syg * srr - syr * srg) / det
            ridge = max(syy - gain * syr - shift * syg, rounding) / (n * variance)
            sgg, syg = sgg + ridge, syg - ridge * gain * prior[y, x]
            det = srr * sgg - srg * srg
            gain, shift = (syr * sgg - syg * srg) / det, (syg * srr - syr * srg) / det
            moved = -shift / gain
            if gain > np.float32(0.25) and abs(moved) <= np.float32(0.5):
                step[y, x] = moved


def _smoothed(image: StereoImage) -> tuple[F32, B8]:
    """Binomial mean of 3 x 3 pixels, whose slopes have less noise, and where all of them exist."""
    grey = image.grey.astype(np.float32)
    for axis in (0, 1):
        grey = scipy.ndimage.correlate1d(grey, (0.25, 0.5, 0.25), axis)
    return grey, np.asarray(scipy.ndimage.minimum_filter(image.valid, 3) > 0)


def _sampled_row(grey: F32, valid: B8, place: F32) -> tuple[F32, F32, B8]:
    """Values and slopes (H, W) at columns of rows, by cubic convolution (Keys 1981), and where both exist."""
    width = grey.shape[1]
    whole = np.floor(place)
    t = place - whole
    first = np.clip(whole.astype(np.int64) - 1, 0, max(width - 4, 0))
    inside: B8 = np.asarray((whole >= 1.0) & (whole <= width - 3.0))
    taps = [np.minimum(first + k, width - 1) for k in range(4)]
    a, b, c, d = (np.take_along_axis(grey, at, axis=1) for at in taps)
    for at in taps:
        inside &= np.take_along_axis(valid, at, axis=1)
    one, two, three = c - a, 2.0 * a - 5.0 * b + 4.0 * c - d, 3.0 * (b - c) + d - a
    value = b + 0.5 * t * (one + t * (two + t * three))
    slope = 0.5 * (one + t * (2.0 * two + 3.0 * t * three))
    return value.astype(np.float32), slope.astype(np.float32), inside


def texture_of(image: StereoImage, noise: float) -> F32:
    """Squared horizontal gradient (H, W) relative to that of ``noise``: 1 = no texture, NaN = no pixel."""
    texture_radius = 4  # Radius of the window in which texture is measured, equal to that of the costs
    quantisation = float(1.0 / np.sqrt(12.0))  # Quantisation noise of integer grey levels
    squares: F64 = np.zeros(image.valid.shape)
    if image.valid.shape[1] > 2:
        step = image.channels[:, :, 2:].astype(np.int32) - image.channels[:, :, :-2]
        squares[:, 1:-1] = (step * step).mean(axis=0)
    mean = scipy.ndimage.uniform_filter(squares, 2 * texture_radius + 1, mode="constant")
    out: F32 = mean.astype(np.float32)
    out /= np.float32(2.0 * LEVELS**2 * np.hypot(noise, quantisation) ** 2)
    out[image.valid == 0] = np.nan
    return out


def disparity_noise(raw: F32, smooth: F32) -> float:
    """Standard deviation of the disparities: median deviation from the smoothed ones, plus pixel locking."""
    subsampling = 5  # Row and column step of the pixels used for a median
    # Standard deviation of the errors that neighbours share, measured on known disparities: what the
    # refinement leaves, 0.03 in clean to 0.13 in noisy images.
    locking_px = 0.1
    apart = np.abs(raw[::subsampling, ::subsampling] - smooth[::subsampling, ::subsampling])
    known = apart[np.isfinite(apart)]
    return float(np.hypot(1.4826 * np.median(known), locking_px)) if len(known) else float("nan")


def match_both_sides(
    match: Callable[[Any, Any], DisparityMap], left: NDArray[Any], right: NDArray[Any]
) -> tuple[DisparityMap, DisparityMap]:
    """Disparities of both images by a matcher of the left one: the mirrored right image is a left image."""

    def mirrored(image: NDArray[Any]) -> NDArray[Any]:
        return np.ascontiguousarray(image[:, ::-1])

    found, back = match(left, right), match(mirrored(right), mirrored(left))
    return found, DisparityMap(mirrored(back.disparity), mirrored(back.confidence), back.sigma_px)
