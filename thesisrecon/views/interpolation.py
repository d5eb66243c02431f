"""View interpolation between two images (thesis, section 1.2; Seitz and Dyer 1995)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from thesisrecon.arrays import B8, F32, F64, U8
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.imaging.raster import run_in_strips
from thesisrecon.records import DisparityMap
from thesisrecon.views._interpolation_kernels import (
    ONE_SURFACE_PX,
    blend,
    disparity_from_rectified,
    filter_extrapolated_by_colour,
    filter_extrapolated_by_median,
    intermediate_positions,
)
from thesisrecon.views._warping import fill_holes, forward_map, sample

SHRINK = 0.8
"""Factor by which the quadrilateral is reduced until it lies in front of both cameras."""
MIN_DEPTH = 0.2
"""Minimum third coordinate of its corners, in units of that of its centre."""
SLACK_PX = 0.5
"""Largest violation of monotonicity that counts as noise of the disparities."""
SPARSE = 7
"""Subsampling step for medians."""
PREPARING = 2
"""Number of threads that prepare an image."""
DARK, BRIGHT = 8.0, 247.0
"""Range of levels used for the ratio of exposures."""
SAME_SURFACE_PX = 1.5
"""Largest difference of disparity between pixels of one surface."""
COLOUR = 30.0
"""Difference of colour (sum over channels) at which weights of guessed disparities fall to 1 / e."""
GUESS_WEIGHT = 0.5
"""Weight of guessed disparities relative to known ones in the median."""
UNKNOWN_WEIGHT, MIN_KNOWN_WEIGHT, EDGE_FACTOR = 0.01, 0.2, 0.2
"""Blending weight of guessed pixels, minimum of known ones, and factor beside a depth discontinuity."""


def original_from_rectified(H: F64, size: tuple[int, int], s: float) -> F64:
    """Return the homography from the rectified frame to the pixels of the view between two images at s.

    In the rectified frame a point of the view is (1 - s) x_left + s x_right, its exact image in a camera on
    the baseline. The homography takes a quadrilateral to the image corners: that of the first image for
    s = 0, that of the second for s = 1, and linear in between.

    Parameters
    ----------
    H, size : ndarray (2, 3, 3), tuple of int
        Homographies from the images to the rectified frame, and width and height of the images.
    s : float
        Position between the images, 0 to 1.

    Returns
    -------
    ndarray (3, 3)
        The homography; its determinant is positive where those of H are.
    """
    corners, left, right = _quadrilaterals(H, size)
    return _homography((1.0 - s) * left + s * right, corners)


def roll_between(H: F64, size: tuple[int, int]) -> float:
    """Return the angle by which the second image is rotated about its axis against the first, in degrees.

    Parameters
    ----------
    H, size
        As in :func:`original_from_rectified`. If the angle approaches 180 degrees, the quadrilateral of the
        views in the middle shrinks to a point.

    Returns
    -------
    float
        From -180 to 180.
    """
    _, *both = _quadrilaterals(H, size)
    left, right = (quadrilateral - quadrilateral.mean(axis=0) for quadrilateral in both)
    across = left[:, 0] * right[:, 1] - left[:, 1] * right[:, 0]
    return float(np.degrees(np.arctan2(across.sum(), (left * right).sum())))


def _quadrilaterals(H: F64, size: tuple[int, int]) -> tuple[F64, F64, F64]:
    """A rectangle (4, 2) of image pixels in front of both cameras, and its place in the frame for each."""
    width, height = size
    middle = 0.5 * np.array([width - 1.0, height - 1.0])
    reach = np.maximum(middle, 0.5) * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    third = H[:, 2]
    min_depth = MIN_DEPTH * (third @ np.append(middle, 1.0))
    if not (min_depth > 0.0).all():
        raise ValueError("the image centre lies beyond the line at infinity of the rectification")
    while not (homogenize(middle + reach) @ third.T >= min_depth).all():
        reach *= SHRINK
    corners = middle + reach
    left, right = (dehomogenize(homogenize(corners) @ side.T) for side in H)
    return corners, left, right


def _homography(source: F64, target: F64) -> F64:
    """The homography (3, 3) that takes four points to four others, H[2] positive at the first of them."""
    rows = []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows.append([x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y, -u])
        rows.append([0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y, -v])
    # Scaled to columns of similar size, since coordinates reach thousands.
    system = np.array(rows)
    scale = np.linalg.norm(system, axis=0)
    H = (np.linalg.svd(system / scale)[2][-1] / scale).reshape(3, 3)
    return np.asarray(H * np.sign(H[2] @ np.append(source[0], 1.0)))


def detect_monotonicity_violations(disparity: F32) -> B8:
    """Find the pixels of a rectified image that violate the monotonicity constraint (figure 1.1).

    If u1 is left of v1 then u2 must be left of v2; u is then left of v in every view between. A thin object
    in front of a distant background violates it, together with the background that it passes.

    Parameters
    ----------
    disparity : ndarray (H, W)
        Disparities, NaN if unknown.

    Returns
    -------
    ndarray (H, W) of bool
        Pixels whose order relative to another pixel of their row differs between the images.
    """
    at = np.arange(disparity.shape[1]) - disparity.astype(np.float64)
    padded = np.pad(at, ((0, 0), (1, 1)), constant_values=((0, 0), (-np.inf, np.inf)))
    rightmost = np.fmax.accumulate(padded[:, :-2], axis=1)
    leftmost = np.fmin.accumulate(padded[:, :1:-1], axis=1)[:, ::-1]
    return np.asarray((rightmost > at + SLACK_PX) | (leftmost < at - SLACK_PX))


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

    Parameters
    ----------
    images, H : tuple of ndarray (h, w, 3) of uint8, ndarray (2, 3, 3)
        Images, and homographies to the rectified frame, third coordinate positive for visible pixels.
    left, right : DisparityMap
        Disparities of both images in the rectified frame (x_right = x_left - d in both).
    """

    images: tuple[U8, U8]
    H: F64
    left: DisparityMap
    right: DisparityMap

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
                known &= ((level > DARK) & (level < BRIGHT)).all(axis=2)
        if int(known.sum()) < SPARSE:
            return np.ones(3, dtype=np.float32)
        return np.asarray(np.exp(np.median(np.log(levels[1][known] / levels[0][known]), axis=0)), np.float32)

    def view(self, s: float, *, turn: F64 | None = None, threads: int = 1) -> U8:
        """Render the view at s.

        Parameters
        ----------
        s : float
            Position from the first image (0) to the second (1), which are returned unchanged.
        turn : ndarray (3, 3), optional
            Homography of a rotation or zoom of the camera, in pixels.
        threads : int
            Number of threads; the result does not depend on it.

        Returns
        -------
        ndarray (h, w, 3) of uint8
        """
        if not 0.0 <= s <= 1.0:
            raise ValueError(f"s must be from 0 (first image) to 1 (second image); got {s}")
        if turn is None and s in (0.0, 1.0):
            return self.images[int(s)].copy()
        rgb, near = self._seen(s, turn, threads)
        filled = fill_holes(rgb, near, step=ONE_SURFACE_PX)
        return np.clip(np.rint(np.nan_to_num(filled)), 0.0, 255.0).astype(np.uint8)

    def _seen(self, s: float, turn: F64 | None = None, threads: int = 1) -> tuple[F32, F32]:
        """Colours (h, w, 3) and disparities (h, w), NaN where neither image shows the scene."""
        warped = [self._warped(side, s, turn, threads) for side in (0, 1)]
        weights = self._sides[0].weight, self._sides[1].weight
        limits = SAME_SURFACE_PX, 1.5 * UNKNOWN_WEIGHT, s
        out = np.empty_like(warped[0][0]), np.empty_like(warped[0][1])

        def work(rows: tuple[int, int]) -> None:
            part = slice(*rows)
            colors, near, sources = ((a[part], b[part]) for a, b in zip(*warped, strict=True))
            blend(colors, near, sources, weights, limits, (out[0][part], out[1][part]))

        run_in_strips(work, self.size[1], threads)
        return out

    def _warped(self, side: int, s: float, turn: F64 | None, threads: int) -> tuple[F32, F32, F32]:
        """Image ``side`` in the view at s: colours with its exposure, disparities and source pixels."""
        this = self._sides[side]
        target = np.empty_like(this.places)
        G = original_from_rectified(self.H, self.size, s)
        if turn is not None:
            # The sign that keeps the view centre in front of the camera.
            middle = np.array([0.5 * (self.size[0] - 1.0), 0.5 * (self.size[1] - 1.0), 1.0])
            G = np.ascontiguousarray(np.sign(turn[2] @ middle) * (turn @ G))
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
    # Without any known disparity the views are cross-dissolved.
    maps = np.nan_to_num(_with_all_rows(found.filled())), np.ascontiguousarray(found.confidence)
    shape = image.shape[:2]
    places = np.empty((*shape, 2))
    disparity, sure = (np.empty(shape, dtype=np.float32) for _ in range(2))
    disparity_from_rectified(maps, np.ascontiguousarray(H), (0, shape[0]), places, disparity, sure)
    levels, filtered = image.astype(np.float32), np.empty_like(disparity)

    def by_colour(rows: tuple[int, int]) -> None:
        filter_extrapolated_by_colour(levels, disparity, sure, rows, (COLOUR, GUESS_WEIGHT), filtered)

    run_in_strips(by_colour, shape[0], PREPARING)
    run_in_strips(
        lambda rows: filter_extrapolated_by_median(filtered, sure, rows, disparity), shape[0], PREPARING
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
    """Derive the disparities of the right image from those of the left one.

    Parameters
    ----------
    left : DisparityMap
        Disparities of the left image.

    Returns
    -------
    DisparityMap
        The larger disparity where two meet; isolated gaps of rounding take the smaller neighbour.
    """
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
