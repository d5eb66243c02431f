"""View interpolation between two images (thesis, section 1.2; Seitz and Dyer 1995)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from thesisrecon._numba import empty, kernel
from thesisrecon.arrays import B8, F32, F64, U8
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.two_view import homography_linear
from thesisrecon.imaging.raster import run_in_strips
from thesisrecon.imaging.resampling import weighted_median
from thesisrecon.records import DisparityMap
from thesisrecon.views._warping import fill_holes, forward_map, sample

ONE_SURFACE_PX = 1.0
"""Neighbouring disparities that differ by more belong to different surfaces."""
REACH, STEP = 12, 3
"""Radius and step of the search for the disparity of a guessed pixel."""
WINDOW = 2 * REACH // STEP + 1
NEAR = 2
"""Radius of the median over guessed pixels."""
MIN_DEPTH = 0.2
"""Minimum third coordinate of its corners, in units of that of its centre."""
SPARSE = 7
"""Subsampling step for medians."""
UNKNOWN_WEIGHT, MIN_KNOWN_WEIGHT, EDGE_FACTOR = 0.01, 0.2, 0.2
"""Blending weight of guessed pixels, minimum of known ones, and factor beside a depth discontinuity."""


@kernel
def disparity_from_rectified(
    maps: tuple[F32, F32], H: F64, rows: tuple[int, int], places: F64, disparity: F32, sure: F32
) -> None:
    """Transfer disparity and confidence from the rectified frame to the pixels of an image.

    ``maps``: disparities without holes, confidences (0 if unknown); H takes the image to the frame.
    ``places`` (h, w, 2) receives positions in the frame, NaN beyond the line at infinity; ``disparity`` is
    bilinear on one surface, otherwise nearest; ``sure`` receives the confidence, 0 outside the frame.
    """
    field, confidence = maps
    height, width = field.shape
    for y in range(rows[0], rows[1]):
        for x in range(disparity.shape[1]):
            w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
            if not w > 0.0:
                places[y, x] = np.nan
                disparity[y, x] = np.nan
                sure[y, x] = 0.0
                continue
            px = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w
            py = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w
            places[y, x, 0], places[y, x, 1] = px, py
            inside = px > -0.5 and py > -0.5 and px < width - 0.5 and py < height - 0.5
            u, v = min(max(px, 0.0), width - 1.0), min(max(py, 0.0), height - 1.0)
            x0, y0 = min(int(u), max(width - 2, 0)), min(int(v), max(height - 2, 0))
            x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
            a, b, c, d = field[y0, x0], field[y0, x1], field[y1, x0], field[y1, x1]
            near_y, near_x = int(np.rint(v)), int(np.rint(u))
            if max(max(a, b), max(c, d)) - min(min(a, b), min(c, d)) <= ONE_SURFACE_PX:
                top, bottom = a + (u - x0) * (b - a), c + (u - x0) * (d - c)
                disparity[y, x] = top + (v - y0) * (bottom - top)
            else:
                disparity[y, x] = field[near_y, near_x]
            sure[y, x] = confidence[near_y, near_x] if inside else 0.0


@kernel
def filter_extrapolated_by_colour(
    levels: F32, disparity: F32, sure: F32, rows: tuple[int, int], limits: tuple[float, float], out: F32
) -> None:
    """Replace disparities of confidence 0 by a colour-weighted median of their surroundings.

    ``limits``: colour difference at which weights fall to 1 / e; weight of guesses relative to known values.
    """
    height, width = disparity.shape
    values, weights = empty(WINDOW * WINDOW, np.float32), empty(WINDOW * WINDOW)
    for y in range(rows[0], rows[1]):
        for x in range(width):
            out[y, x] = disparity[y, x]
            if sure[y, x] > 0.0 or np.isnan(disparity[y, x]):
                continue
            n, total = 0, 0.0
            least, most = disparity[y, x], disparity[y, x]
            for v in range(max(y - REACH, y % STEP), min(y + REACH + 1, height), STEP):
                for u in range(max(x - REACH, x % STEP), min(x + REACH + 1, width), STEP):
                    d = disparity[v, u]
                    if np.isnan(d):
                        continue
                    apart = 0.0
                    for c in range(levels.shape[2]):
                        apart += abs(levels[y, x, c] - levels[v, u, c])
                    weight = np.exp(-apart / limits[0])
                    if sure[v, u] <= 0.0:
                        weight *= limits[1]
                    values[n], weights[n] = d, weight
                    least, most = min(least, d), max(most, d)
                    total += weight
                    n += 1
            # On one surface there is nothing to choose.
            if most - least > ONE_SURFACE_PX:
                out[y, x] = weighted_median(values[:n], weights[:n], np.argsort(values[:n]), 0.5 * total)


@kernel
def filter_extrapolated_by_median(disparity: F32, sure: F32, rows: tuple[int, int], out: F32) -> None:
    """Replace disparities of confidence 0 by the median of their neighbours."""
    height, width = disparity.shape
    values = empty((2 * NEAR + 1) ** 2, np.float32)
    for y in range(rows[0], rows[1]):
        for x in range(width):
            out[y, x] = disparity[y, x]
            if sure[y, x] > 0.0 or np.isnan(disparity[y, x]):
                continue
            n = 0
            for v in range(max(y - NEAR, 0), min(y + NEAR + 1, height)):
                for u in range(max(x - NEAR, 0), min(x + NEAR + 1, width)):
                    if not np.isnan(disparity[v, u]):
                        values[n] = disparity[v, u]
                        n += 1
            if values[:n].max() - values[:n].min() > ONE_SURFACE_PX:
                out[y, x] = np.sort(values[:n])[n // 2]


@kernel
def intermediate_positions(
    places: F64, disparity: F32, share: float, G: F64, rows: tuple[int, int], target: F64
) -> None:
    """Move pixels at ``places`` left by a share of their disparity and map them by G to the view."""
    for y in range(rows[0], rows[1]):
        for x in range(disparity.shape[1]):
            u, v = places[y, x, 0] - share * disparity[y, x], places[y, x, 1]
            w = G[2, 0] * u + G[2, 1] * v + G[2, 2]
            if w > 0.0:
                target[y, x, 0] = (G[0, 0] * u + G[0, 1] * v + G[0, 2]) / w
                target[y, x, 1] = (G[1, 0] * u + G[1, 1] * v + G[1, 2]) / w
            else:
                target[y, x] = np.nan


@kernel
def _at(values: F32, source: F32, y: int, x: int) -> float:
    """The value (h, w) of the pixel nearest to the source (H, W, 2) of a pixel."""
    v = min(max(int(np.rint(source[y, x, 1])), 0), values.shape[0] - 1)
    u = min(max(int(np.rint(source[y, x, 0])), 0), values.shape[1] - 1)
    return float(values[v, u])


@kernel
def blend(
    colors: tuple[F32, F32],
    fronts: tuple[F32, F32],
    sources: tuple[F32, F32],
    weights: tuple[F32, F32],
    limits: tuple[float, float, float],
    out: tuple[F32, F32],
) -> None:
    """Blend two warped images of colours (H, W, 3), inverse depths ``fronts`` and positions ``sources``.

    Where both inverse depths agree, the weighted mean is used. Otherwise known pixels replace guessed ones,
    the nearer of two known pixels is used, and the farther of two guessed ones. ``weights`` (h, w) belong to
    the source pixels; ``limits``: tolerance of inverse depth, weight up to which a pixel is guessed, and s.
    """
    alike, guess, s = limits
    rgb, near = out
    for y in range(near.shape[0]):
        for x in range(near.shape[1]):
            n0, n1 = fronts[0][y, x], fronts[1][y, x]
            if np.isnan(n0) and np.isnan(n1):
                rgb[y, x] = np.nan
                near[y, x] = np.nan
                continue
            w0 = 0.0 if np.isnan(n0) else _at(weights[0], sources[0], y, x)
            w1 = 0.0 if np.isnan(n1) else _at(weights[1], sources[1], y, x)
            if w0 > 0.0 and w1 > 0.0 and abs(n0 - n1) > alike:
                sure0, sure1 = w0 > guess, w1 > guess
                first = n0 > n1 if sure0 and sure1 else (n0 < n1 if sure0 == sure1 else sure0)
                w0, w1 = (w0, 0.0) if first else (0.0, w1)
            if w0 > 0.0 and w1 > 0.0:
                w0, w1 = (1.0 - s) * w0, s * w1
            t = w1 / (w0 + w1)
            for c in range(rgb.shape[2]):
                if t == 0.0:
                    rgb[y, x, c] = colors[0][y, x, c]
                elif t == 1.0:
                    rgb[y, x, c] = colors[1][y, x, c]
                else:
                    rgb[y, x, c] = (1.0 - t) * colors[0][y, x, c] + t * colors[1][y, x, c]
            near[y, x] = n0 if w0 >= w1 else n1


def original_from_rectified(H: F64, size: tuple[int, int], s: float) -> F64:
    """Return the homography from the rectified frame to the pixels of the view between two images at s.

    In the rectified frame a point of the view is (1 - s) x_left + s x_right, its exact image in a camera on
    the baseline. The homography takes a quadrilateral to the image corners: that of the first image for
    s = 0, that of the second for s = 1, and linear in between.
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

    If u1 is left of v1 then u2 must be left of v2; u is then left of v in every view between. A thin object
    in front of a distant background violates it, together with the background that it passes.
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


@dataclass(frozen=True)
class InterpolatedPair:
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

    def __post_init__(self) -> None:
        a, b = (image.shape for image in self.images)
        if a != b or len(a) != 3 or a[2] != 3:
            raise ValueError(f"views need two images (h, w, 3) of the same size; got {a} and {b}")
        if self.left.disparity.shape != self.right.disparity.shape:
            shapes = f"{self.left.disparity.shape} and {self.right.disparity.shape}"
            raise ValueError(f"disparities of both sides must have the same shape; got {shapes}")

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
        places = first.places[grid].copy()
        places[..., 0] -= first.disparity[grid]
        back = np.linalg.inv(self.H[1])
        at = np.concatenate([places, np.ones((*places.shape[:2], 1))], axis=2) @ back.T
        with np.errstate(divide="ignore", invalid="ignore"):
            source = np.where(at[..., 2:] > 0.0, at[..., :2] / at[..., 2:], np.nan).astype(np.float32)
        levels = first.levels[grid], sample(self._sides[1].levels, source)
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
        weights = self._sides[0].weight, self._sides[1].weight
        limits = same_surface_px, 1.5 * UNKNOWN_WEIGHT, s
        out = np.empty_like(warped[0][0]), np.empty_like(warped[0][1])

        def work(rows: tuple[int, int]) -> None:
            part = slice(*rows)
            colors, near, sources = ((a[part], b[part]) for a, b in zip(*warped, strict=True))
            blend(colors, near, sources, weights, limits, (out[0][part], out[1][part]))

        run_in_strips(work, self.size[1], threads)
        return out

    def _warped(self, side: int, s: float, threads: int) -> tuple[F32, F32, F32]:
        """Image ``side`` in the view at s: colours with its exposure, disparities and source pixels."""
        this = self._sides[side]
        target = np.empty_like(this.places)
        G = original_from_rectified(self.H, self.size, s)
        share = s - side

        def move(rows: tuple[int, int]) -> None:
            intermediate_positions(this.places, this.disparity, share, G, rows, target)

        run_in_strips(move, self.size[1], threads)
        source, near = forward_map(
            target, this.disparity, size=self.size, step=ONE_SURFACE_PX, threads=threads
        )
        colors = sample(this.levels, source, threads=threads)
        colors *= self.gain ** np.float32(share)
        return colors, near, source


def _side(image: U8, H: F64, found: DisparityMap) -> _Side:
    preparing = 2  # Number of threads that prepare an image
    # Difference of colour (sum over channels) at which weights of guessed disparities fall to 1 / e.
    colour = 30.0
    guess_weight = 0.5  # Weight of guessed disparities relative to known ones in the median
    # Without any known disparity the views are cross-dissolved.
    maps = np.nan_to_num(_with_all_rows(found.filled())), np.ascontiguousarray(found.confidence)
    shape = image.shape[:2]
    places = np.empty((*shape, 2))
    disparity, sure = (np.empty(shape, dtype=np.float32) for _ in range(2))
    disparity_from_rectified(maps, np.ascontiguousarray(H), (0, shape[0]), places, disparity, sure)
    levels, filtered = image.astype(np.float32), np.empty_like(disparity)

    def by_colour(rows: tuple[int, int]) -> None:
        filter_extrapolated_by_colour(levels, disparity, sure, rows, (colour, guess_weight), filtered)

    run_in_strips(by_colour, shape[0], preparing)
    run_in_strips(
        lambda rows: filter_extrapolated_by_median(filtered, sure, rows, disparity), shape[0], preparing
    )
    return _Side(levels, places, disparity, _blending_weights(disparity, sure))


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
