"""View interpolation (view morphing) between two images (thesis, section 1.2; Seitz and Dyer 1995)."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from thesisrecon.arrays import B8, F32, F64, U8, Record
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize, map_in_front
from thesisrecon.geometry.two_view import homography_linear
from thesisrecon.imaging.raster import run_in_strips
from thesisrecon.imaging.resampling import bilinear_samples
from thesisrecon.records import DisparityMap
from thesisrecon.views._warping import fill_holes, forward_map, sample

ONE_SURFACE_PX = 1.0  #: neighbouring disparities that differ by more belong to different surfaces
NEAR = 2  #: radius of the median over guessed pixels
MIN_DEPTH = 0.2  #: minimum third coordinate of its corners, in units of that of its centre
SPARSE = 7  #: subsampling step for medians
UNKNOWN_WEIGHT, MIN_KNOWN_WEIGHT, EDGE_FACTOR = 0.01, 0.2, 0.2
"""Blending weight of guessed pixels, minimum of known ones, and factor beside a depth discontinuity."""


def filter_extrapolated_by_median(disparity: F32, sure: F32) -> F32:
    """Replace disparities of confidence 0 by the median of their neighbours if these differ."""
    out, padded = disparity.copy(), np.pad(disparity, NEAR, constant_values=np.nan)
    y, x = np.nonzero((sure <= 0.0) & ~np.isnan(disparity))
    # Sorted, unknown pixels come last.
    around = np.sort([padded[y + b, x + a] for b in range(2 * NEAR + 1) for a in range(2 * NEAR + 1)], axis=0)
    n, known = np.arange(len(y)), np.isfinite(around).sum(axis=0)
    differ = around[known - 1, n] - around[0] > ONE_SURFACE_PX
    out[y[differ], x[differ]] = around[known // 2, n][differ]
    return out


def blend(
    colors: tuple[F32, F32], fronts: tuple[F32, F32], weights: tuple[F32, F32],
    limits: tuple[float, float, float], out: tuple[F32, F32],
) -> None:  # fmt: skip
    """Blend two warped images of colours (H, W, 3), inverse depths ``fronts`` and ``weights`` (H, W).

    The weighted mean if both inverse depths agree; else known before guessed pixels, the nearer of two known
    ones and the farther of two guessed ones. ``limits``: tolerance of inverse depth, weight of a guessed
    pixel, and s.
    """
    alike, guess, s = limits
    (n0, n1), (w0, w1), (first, second) = fronts, weights, colors
    with np.errstate(invalid="ignore"):
        # Comparisons with NaN are false.
        apart, nearer = np.abs(n0 - n1) > alike, n0 > n1
        sure0, sure1 = w0 > guess, w1 > guess
        second_only = np.where(sure0 == sure1, nearer != sure0, sure1)
        t = s * w1 / ((1.0 - s) * w0 + s * w1)
    empty0, empty1 = np.isnan(n0), np.isnan(n1)
    t = np.select([empty0 & empty1, empty0, empty1, apart], [np.nan, 1.0, 0.0, second_only], t)[..., None]
    # Weights of 0 must not meet NaN.
    mixed = (1.0 - t) * np.where(t < 1.0, first, 0.0) + t * np.where(t > 0.0, second, 0.0)
    out[0][:], out[1][:] = mixed, np.where(t[..., 0] <= 0.5, n0, n1)


def original_from_rectified(H: F64, size: tuple[int, int], s: float) -> F64:
    """Return the homography from the rectified frame to the pixels of the view between two images at s.

    In the frame a point is (1 - s) x_left + s x_right, its exact image in a camera on the baseline. The
    homography takes a quadrilateral, linear between those of both images, to the image corners.
    """
    corners, left, right = _quadrilaterals(H, size)
    between = (1.0 - s) * left + s * right
    H = homography_linear(between, corners)
    return np.asarray(H * np.sign(H[2] @ np.append(between[0], 1.0)))


def roll_between(H: F64, size: tuple[int, int]) -> float:
    """Return the angle by which the second image is rotated about its axis against the first, in degrees."""
    _, *both = _quadrilaterals(H, size)
    left, right = (quadrilateral - quadrilateral.mean(axis=0) for quadrilateral in both)
    across = left[:, 0] * right[:, 1] - left[:, 1] * right[:, 0]
    return float(np.degrees(np.arctan2(across.sum(), (left * right).sum())))


def _quadrilaterals(H: F64, size: tuple[int, int]) -> tuple[F64, F64, F64]:
    """A rectangle (4, 2) of image pixels in front of both cameras, and its place in the frame for each."""
    shrink = 0.8  # Factor by which the quadrilateral is reduced until it lies in front of both cameras
    width, height = size
    middle = 0.5 * np.array([width - 1.0, height - 1.0])
    reach = np.maximum(middle, 0.5) * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    third = H[:, 2]
    min_depth = MIN_DEPTH * (third @ np.append(middle, 1.0))
    if not (min_depth > 0.0).all():
        raise ValueError("the image centre lies beyond the line at infinity of the rectification")
    while not (homogenize(middle + reach) @ third.T >= min_depth).all():
        reach *= shrink
    corners = middle + reach
    left, right = (dehomogenize(homogenize(corners) @ side.T) for side in H)
    return corners, left, right


def detect_monotonicity_violations(disparity: F32) -> B8:
    """Find the pixels of a rectified image that violate the monotonicity constraint (figure 1.1).

    If u1 is left of v1 then u2 must be left of v2; then u is left of v in every view between.
    """
    slack_px = 0.5  # Largest violation of monotonicity that counts as noise of the disparities
    at = np.arange(disparity.shape[1]) - disparity.astype(np.float64)
    padded = np.pad(at, ((0, 0), (1, 1)), constant_values=((0, 0), (-np.inf, np.inf)))
    rightmost = np.fmax.accumulate(padded[:, :-2], axis=1)
    leftmost = np.fmin.accumulate(padded[:, :1:-1], axis=1)[:, ::-1]
    return np.asarray((rightmost > at + slack_px) | (leftmost < at - slack_px))


@dataclass(frozen=True)
class _Side:
    """An image with its pixel positions in the rectified frame, disparities without holes and weights."""

    levels: F32
    places: F64
    disparity: F32
    weight: F32


@dataclass(frozen=True, eq=False)
class InterpolatedPair(Record):
    """Two images and the views between them (thesis, section 1.2).

    Each pixel of either image moves along its row by a share of its disparity and out of the rectified frame
    in one step. Nearer pixels occlude farther ones, which also handles violations of monotonicity. A pixel
    seen in one image only is taken from it, with the disparity of the adjacent background; a pixel seen in
    neither is filled from behind.
    """

    images: tuple[U8, U8]  #: (h, w, 3)
    H: F64  #: (2, 3, 3) homographies to the rectified frame, third coordinate positive for visible pixels
    left: DisparityMap  #: of the first image in the rectified frame, x_right = x_left - d
    right: DisparityMap  #: of the second image, of the same sign

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images and of the views."""
        return self.images[0].shape[1], self.images[0].shape[0]

    @cached_property
    def _sides(self) -> tuple[_Side, _Side]:
        return _side(self.images[0], self.H[0], self.left), _side(self.images[1], self.H[1], self.right)

    @cached_property
    def known(self) -> float:
        """Share of the pixels of both images with known correspondence."""
        return float(np.mean([side.weight > 1.5 * UNKNOWN_WEIGHT for side in self._sides]))

    @cached_property
    def gain(self) -> F32:
        """Ratio (3,) of the exposure of the second image to the first, the median over known pixels."""
        dark, bright = 8.0, 247.0  # Range of levels used for the ratio of exposures
        first = self._sides[0]
        grid = np.ix_(range(0, self.size[1], SPARSE), range(0, self.size[0], SPARSE))
        source = map_in_front(np.linalg.inv(self.H[1]), _shifted(first.places[grid], first.disparity[grid]))
        levels = first.levels[grid], sample(self._sides[1].levels, source.astype(np.float32))
        known = first.weight[grid] > UNKNOWN_WEIGHT
        with np.errstate(invalid="ignore"):
            for level in levels:
                known &= ((level > dark) & (level < bright)).all(axis=2)
        if int(known.sum()) < SPARSE:
            return np.ones(3, dtype=np.float32)
        return np.asarray(np.exp(np.median(np.log(levels[1][known] / levels[0][known]), axis=0)), np.float32)

    def view(self, s: float, *, threads: int = 1) -> U8:
        """Render the view at s."""
        if not 0.0 <= s <= 1.0:
            raise ValueError(f"s must be from 0 (first image) to 1 (second image); got {s}")
        if s in (0.0, 1.0):
            return self.images[int(s)].copy()
        rgb, near = self._seen(s, threads)
        filled = fill_holes(rgb, near, step=ONE_SURFACE_PX)
        return np.clip(np.rint(np.nan_to_num(filled)), 0.0, 255.0).astype(np.uint8)

    def _seen(self, s: float, threads: int = 1) -> tuple[F32, F32]:
        """Colours (h, w, 3) and disparities (h, w), NaN where neither image shows the scene."""
        same_surface_px = 1.5  # Largest difference of disparity between pixels of one surface
        warped = [self._warped(side, s, threads) for side in (0, 1)]
        limits = same_surface_px, 1.5 * UNKNOWN_WEIGHT, np.float64(s)
        out = np.empty_like(warped[0][0]), np.empty_like(warped[0][1])

        def work(rows: tuple[int, int]) -> None:
            part = slice(*rows)
            colors, near, weights = ((a[part], b[part]) for a, b in zip(*warped, strict=True))
            blend(colors, near, weights, limits, (out[0][part], out[1][part]))

        run_in_strips(work, self.size[1], threads)
        return out

    def _warped(self, side: int, s: float, threads: int) -> tuple[F32, F32, F32]:
        """Image ``side`` in the view at s: colours with its exposure, disparities and blending weights."""
        this, share = self._sides[side], s - side
        G = original_from_rectified(self.H, self.size, s)
        target = np.empty_like(this.places)

        def move(rows: tuple[int, int]) -> None:
            part = slice(*rows)
            target[part] = map_in_front(G, _shifted(this.places[part], share * this.disparity[part]))

        run_in_strips(move, self.size[1], threads)
        source, near = forward_map(
            target, this.disparity, size=self.size, step=ONE_SURFACE_PX, threads=threads
        )
        colors = sample(this.levels, source, threads=threads)
        colors *= self.gain ** np.float32(share)
        x, y = np.rint(np.nan_to_num(source)).astype(np.int64).transpose(2, 0, 1)
        return colors, near, this.weight[y, x]


def _shifted(places: F64, disparity: F32 | F64) -> F64:
    """Positions (..., 2) moved left by disparities (...)."""
    return np.stack([places[..., 0] - disparity, places[..., 1]], axis=-1)


def _side(image: U8, H: F64, found: DisparityMap) -> _Side:
    # Without any known disparity the views are cross-dissolved.
    field, shape = np.nan_to_num(_with_all_rows(found.filled())), image.shape[:2]
    places = map_in_front(H, np.moveaxis(np.indices(shape, dtype=np.float64)[::-1], 0, -1))
    last = np.array(field.shape[::-1]) - 1.0
    inside = ((places > -0.5) & (places < last + 0.5)).all(axis=2)
    x, y = np.clip(np.nan_to_num(places), 0.0, last).transpose(2, 0, 1)
    between, spread = (part[..., 0] for part in bilinear_samples(field[..., None], x, y))
    nearest = np.rint(y).astype(np.int64), np.rint(x).astype(np.int64)
    disparity = np.where(spread <= ONE_SURFACE_PX, between, field[nearest]).astype(np.float32)
    disparity[np.isnan(places[..., 0])] = np.nan
    sure = np.where(inside, found.confidence[nearest], 0.0).astype(np.float32)
    disparity = filter_extrapolated_by_median(disparity, sure)
    return _Side(image.astype(np.float32), places, disparity, _blending_weights(disparity, sure))


def _with_all_rows(disparity: F32) -> F32:
    """Disparities (H, W); rows without any are copies of the nearest other row, first the upper one."""
    known = np.flatnonzero(np.isfinite(disparity).any(axis=1))
    if not len(known):
        return disparity
    nearest = np.abs(np.arange(len(disparity))[:, None] - known).argmin(axis=1)
    return np.ascontiguousarray(disparity[known[nearest]])


def _blending_weights(disparity: F32, sure: F32) -> F32:
    """Weights (h, w): the confidence, less beside a depth discontinuity, where pixels are mixed."""
    padded = np.pad(disparity, 1, constant_values=np.nan)
    around = padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]
    edge = np.any([np.abs(other - disparity) > ONE_SURFACE_PX for other in around], axis=0)
    known = np.maximum(sure.astype(np.float64), MIN_KNOWN_WEIGHT) * np.where(edge, EDGE_FACTOR, 1.0)
    return np.where(sure > 0.0, known, UNKNOWN_WEIGHT).astype(np.float32)


def disparity_of_right(left: DisparityMap) -> DisparityMap:
    """Derive the disparities of the right image from those of the left one."""
    height, width = left.disparity.shape
    disparity = np.full((height, width), -np.inf, dtype=np.float32)
    confidence = np.zeros((height, width), dtype=np.float32)
    y, x = np.nonzero(np.isfinite(left.disparity))
    d = left.disparity[y, x]
    at = np.rint(x - d).astype(np.int64)
    inside = (at >= 0) & (at < width)
    y, x, at, d = y[inside], x[inside], at[inside], d[inside]
    np.maximum.at(disparity, (y, at), d)
    seen = disparity[y, at] == d
    confidence[y[seen], at[seen]] = left.confidence[y[seen], x[seen]]
    disparity[np.isinf(disparity)] = np.nan
    before, here, after = disparity[:, :-2], disparity[:, 1:-1], disparity[:, 2:]
    gap = np.isfinite(before) & np.isfinite(after) & np.isnan(here)
    here[gap] = np.fmin(before, after)[gap]
    return replace(left, disparity=disparity, confidence=confidence)
