"""Places between two photographs: along the rows of the rectified frame, and out of it again.

The monotonicity constraint (figure 1.1): pixels of a row keep their order in the other photograph.

Views between two photographs whose dense correspondence is known.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from thesisrecon.arrays import B8, F32, F64, U8
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.zbuffer import in_strips
from thesisrecon.records import DisparityMap
from thesisrecon.views.interpolation_kernels import (
    ONE_SURFACE_PX,
    blend,
    fill_empty_rows,
    mark_crossings,
    place_between,
    settle_guesses,
    smooth_guesses,
    take_back,
    weigh,
)
from thesisrecon.views.warping import fill_holes, forward_map, sample

SHRINK = 0.8
"""Steps by which the quadrilateral is made smaller until it is in front of both cameras."""
LEAST_DEPTH = 0.2
"""Third coordinates of its corners are at least so many times that of the middle."""


@dataclass(frozen=True)
class FrameBetween:
    """The frames of views between two photographs of ``size`` (width, height), after Seitz and Dyer.

    ``H`` (2, 3, 3) take the photographs to the rectified frame. There a point of the view at s is (1 - s)
    x_left + s x_right: exactly its image in a camera on the baseline, all three being parallel. Out of the
    rectified frame leads a homography that takes a quadrilateral to the corners of the picture; the
    quadrilateral is that of the first photograph for s = 0, that of the second for s = 1, and runs in
    straight lines in between, so that both ends are the photographs.
    """

    H: F64
    size: tuple[int, int]

    def original_from_rectified(self, s: float) -> F64:
        """(3, 3) from the rectified frame at s to the pixels of the view, det > 0 where H's are."""
        corners = self._corners()
        ends = [_mapped(H, corners) for H in self.H]
        return _homography((1.0 - s) * ends[0] + s * ends[1], corners)

    def points(self, xy1: F64, xy2: F64, s: float) -> F64:
        """Where the view at s sees points whose pixels (N, 2), (N, 2) in the photographs are known."""
        left, right = _mapped(self.H[0], xy1), _mapped(self.H[1], xy2)
        return _mapped(self.original_from_rectified(s), (1.0 - s) * left + s * right)

    def _corners(self) -> F64:
        """The four points of the quadrilateral (4, 2) px: the corners, drawn to the middle where they
        must."""
        width, height = self.size
        middle = 0.5 * np.array([width - 1.0, height - 1.0])
        reach = np.maximum(middle, 0.5) * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        third = self.H[:, 2]
        least = LEAST_DEPTH * (third @ np.append(middle, 1.0))
        if not (least > 0.0).all():
            raise ValueError("the middle of the photograph is beyond the line sent to infinity")
        while not (homogenize(middle + reach) @ third.T >= least).all():
            reach *= SHRINK
        corners: F64 = middle + reach
        return corners


def _mapped(H: F64, xy: F64) -> F64:
    xh = homogenize(np.asarray(xy, dtype=np.float64)) @ H.T
    return np.asarray(xh[:, :2] / xh[:, 2:])


def _homography(source: F64, target: F64) -> F64:
    """(3, 3) that takes four points to four others, H[2] positive at the first of them."""
    rows = []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows.append([x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y, -u])
        rows.append([0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y, -v])
    # Columns of one size: coordinates are of thousands.
    system = np.array(rows)
    scale = np.linalg.norm(system, axis=0)
    H = (np.linalg.svd(system / scale)[2][-1] / scale).reshape(3, 3)
    return np.asarray(H * np.sign(H[2] @ np.append(source[0], 1.0)))


SLACK_PX = 0.5
"""Partners may cross by so much: less is the noise of disparities, not the scene."""


@dataclass(frozen=True)
class Monotonicity:
    """How far a pair obeys the constraint: ``violated`` (H, W) pixels that change their order with another
    one of their row, ``share`` of the ``known`` ones (a share of all pixels, too)."""

    violated: B8
    share: float
    known: float

    @property
    def holds(self) -> bool:
        """Whether no pixel violates it: every view between shows the same points."""
        return self.share == 0.0


def check_monotonicity(disparity: F32, *, slack_px: float = SLACK_PX) -> Monotonicity:
    """Which pixels of a rectified photograph violate the constraint, from their disparities (H, W), NaN =
    unknown.

    For pixels u1 left of v1 their partners must be u2 left of v2; then u lies left of v in every view
    between. A thin thing in front of a far background violates it, with all of the background that it passes.
    Raises ``ValueError`` for another shape.
    """
    disparity = np.ascontiguousarray(disparity, dtype=np.float32)
    if disparity.ndim != 2:
        raise ValueError(f"disparities must be (H, W); got {disparity.shape}")
    violated = np.zeros(disparity.shape, dtype=np.bool_)
    mark_crossings(disparity, slack_px, violated)
    known = np.isfinite(disparity)
    count = max(int(known.sum()), 1)
    return Monotonicity(violated, float(violated.sum() / count), float(known.mean()) if known.size else 0.0)


SPARSE = 7
"""Every seventh pixel of every seventh row suffices for a median."""
PREPARING = 2
"""Threads that prepare a photograph."""
DARK, BRIGHT = 8.0, 247.0
"""Levels whose ratio tells how much brighter a photograph is."""


@dataclass(frozen=True)
class Blending:
    """How two warped photographs become one.

    Pixels whose inverse depth differs by no more than ``alike_px`` show the same surface. Weights are the
    confidence, but at least ``least``; ``guessed`` of what only the other photograph's holes can show, whose
    disparity is that of the background beside it; ``rim`` is what is left of them beside a cut. Guessed
    disparities are the median of those around, weighted by their likeness in colour, which falls to 1 / e at
    a difference of ``colour`` levels in sum over the channels; other guesses count ``hearsay`` of known ones.
    """

    alike_px: float = 1.5
    colour: float = 30.0
    hearsay: float = 0.5
    least: float = 0.2
    guessed: float = 0.01
    rim: float = 0.2


@dataclass(frozen=True)
class Warped:
    """One photograph seen from between: ``colors`` (H, W, 3), ``near`` (H, W), ``source`` (H, W, 2)."""

    colors: F32
    near: F32
    source: F32


@dataclass(frozen=True)
class _Side:
    """What is known of a photograph's pixels: ``places`` (h, w, 2) in the rectified frame, ``disparity`` (h,
    w) without holes, ``weight`` (h, w)."""

    levels: F32
    places: F64
    disparity: F32
    weight: F32


@dataclass(frozen=True)
class InterpolatedPair:
    """Two photographs (h, w, 3) uint8 of one size and what lies between them (thesis, section 1.2).

    ``H`` (2, 3, 3) takes either one's pixels to the rectified frame, third coordinate positive for what is
    seen; ``left`` and ``right`` are the disparities of the first and the second one there (x_right = x_left -
    d either way), larger for nearer points.

    Every pixel of either photograph is moved along its row by its share of its disparity and out of the
    rectified frame at once, so that colours are sampled once only and from the photographs. Nearer pixels
    hide farther ones, which is all it takes where monotonicity fails. What one photograph alone shows is
    taken from it, with the disparity of the background beside it; what none shows is filled from behind.

    Raises ``ValueError`` for photographs of different sizes and maps of different shapes.
    """

    images: tuple[U8, U8]
    H: F64
    left: DisparityMap
    right: DisparityMap
    blending: Blending = field(default_factory=Blending)

    def __post_init__(self) -> None:
        a, b = (image.shape for image in self.images)
        if a != b or len(a) != 3 or a[2] != 3:
            raise ValueError(f"views lie between two images (h, w, 3) of one size; got {a} and {b}")
        if self.left.disparity.shape != self.right.disparity.shape:
            raise ValueError(
                "disparities of both sides must have one shape; got "
                f"{self.left.disparity.shape} and {self.right.disparity.shape}"
            )

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the photographs and of the views."""
        return self.images[0].shape[1], self.images[0].shape[0]

    @cached_property
    def frame(self) -> FrameBetween:
        """Where points lie between."""
        return FrameBetween(self.H, self.size)

    @cached_property
    def _sides(self) -> tuple[_Side, _Side]:
        sides = [
            _side(image, H, found, self.blending)
            for image, H, found in zip(self.images, self.H, (self.left, self.right), strict=True)
        ]
        return sides[0], sides[1]

    @cached_property
    def known(self) -> float:
        """Share of the pixels of both photographs whose partner is known."""
        return float(np.mean([side.weight > 1.5 * self.blending.guessed for side in self._sides]))

    @cached_property
    def gain(self) -> F32:
        """(3,) by how much the second photograph is brighter than the first, the median of known pixels."""
        first = self._sides[0]
        grid = np.ix_(range(0, self.size[1], SPARSE), range(0, self.size[0], SPARSE))
        places = first.places[grid].copy()
        places[..., 0] -= first.disparity[grid]
        back = np.linalg.inv(self.H[1])
        at = np.concatenate([places, np.ones((*places.shape[:2], 1))], axis=2) @ back.T
        with np.errstate(divide="ignore", invalid="ignore"):
            source = np.where(at[..., 2:] > 0.0, at[..., :2] / at[..., 2:], np.nan).astype(np.float32)
        levels = first.levels[grid], sample(self._sides[1].levels, source)
        known = first.weight[grid] > self.blending.guessed
        with np.errstate(invalid="ignore"):
            for level in levels:
                known &= ((level > DARK) & (level < BRIGHT)).all(axis=2)
        if int(known.sum()) < SPARSE:
            return np.ones(3, dtype=np.float32)
        return np.asarray(np.exp(np.median(np.log(levels[1][known] / levels[0][known]), axis=0)), np.float32)

    def view(self, s: float, *, turn: F64 | None = None, threads: int = 1) -> U8:
        """The view at s in [0, 1] from the first photograph to the second, (h, w, 3) uint8.

        s = 0 and s = 1 are the photographs themselves. ``turn`` (3, 3), of pixels, is what the camera there
        is turned or zoomed by. ``threads`` draw strips of rows and change no byte. Raises ``ValueError`` for
        s elsewhere: there is nothing beyond the photographs.
        """
        if not 0.0 <= s <= 1.0:
            raise ValueError(f"s is a place from 0 (the first photograph) to 1 (the second); got {s}")
        if turn is None and s in (0.0, 1.0):
            return self.images[int(s)].copy()
        rgb, near = self.seen(s, turn=turn, threads=threads)
        filled = fill_holes(rgb, near, step=ONE_SURFACE_PX)
        return np.clip(np.rint(np.nan_to_num(filled)), 0.0, 255.0).astype(np.uint8)

    def seen(self, s: float, *, turn: F64 | None = None, threads: int = 1) -> tuple[F32, F32]:
        """Colours (h, w, 3) and disparities (h, w) of the view at s before what neither photograph shows is
        filled, NaN there."""
        warped = [self.warped(side, s, turn=turn, threads=threads) for side in (0, 1)]
        sides, blending = self._sides, self.blending
        out = np.empty_like(warped[0].colors), np.empty_like(warped[0].near)

        def work(rows: tuple[int, int]) -> None:
            part = slice(*rows)
            blend(
                (warped[0].colors[part], warped[1].colors[part]),
                (warped[0].near[part], warped[1].near[part]),
                (warped[0].source[part], warped[1].source[part]),
                (sides[0].weight, sides[1].weight),
                (blending.alike_px, 1.5 * blending.guessed, s),
                (out[0][part], out[1][part]),
            )

        in_strips(work, self.size[1], threads)
        return out

    def warped(self, side: int, s: float, *, turn: F64 | None = None, threads: int = 1) -> Warped:
        """One photograph alone as the view at s sees it, as bright as this is."""
        this = self._sides[side]
        target = np.empty_like(this.places)
        G = self.frame.original_from_rectified(s)
        if turn is not None:
            # Of any sign and scale: what is in the middle of the view stays in front.
            middle = np.array([0.5 * (self.size[0] - 1.0), 0.5 * (self.size[1] - 1.0), 1.0])
            G = np.ascontiguousarray(np.sign(turn[2] @ middle) * (turn @ G))
        share = s - side
        in_strips(
            lambda rows: place_between(this.places, this.disparity, share, G, rows, target),
            self.size[1],
            threads,
        )
        source, near = forward_map(
            target, this.disparity, size=self.size, step=ONE_SURFACE_PX, threads=threads
        )
        colors = sample(this.levels, source, threads=threads)
        colors *= self.gain ** np.float32(share)
        return Warped(colors, near, source)


def _side(image: U8, H: F64, found: DisparityMap, blending: Blending) -> _Side:
    whole = np.ascontiguousarray(found.filled())
    fill_empty_rows(whole)
    # A pair of which nothing is known dissolves.
    maps = np.nan_to_num(whole), np.ascontiguousarray(found.confidence)
    shape = image.shape[:2]
    places = np.empty((*shape, 2))
    disparity, sure, weight = (np.empty(shape, dtype=np.float32) for _ in range(3))
    take_back(maps, np.ascontiguousarray(H), (0, shape[0]), places, disparity, sure)
    levels, settled = image.astype(np.float32), np.empty_like(disparity)
    likeness = (blending.colour, blending.hearsay)
    in_strips(
        lambda rows: settle_guesses(levels, disparity, sure, rows, likeness, settled), shape[0], PREPARING
    )
    in_strips(lambda rows: smooth_guesses(settled, sure, rows, disparity), shape[0], PREPARING)
    weigh(disparity, sure, (blending.guessed, blending.least, blending.rim), weight)
    return _Side(levels, places, disparity, weight)


def pair_of_rectified(left: U8, right: U8, maps: tuple[DisparityMap, DisparityMap]) -> InterpolatedPair:
    """Two photographs (h, w, 3) that are rectified as they are."""
    for found in maps:
        if found.disparity.shape != left.shape[:2]:
            raise ValueError(
                f"disparities must have the shape of the photographs {left.shape[:2]}; got "
                f"{found.disparity.shape}"
            )
    return InterpolatedPair((left, right), np.stack([np.eye(3)] * 2), *maps)


def unsure(disparity: F32) -> DisparityMap:
    """Disparities (H, W), NaN = unknown, of which no more is known: each as sure as the next."""
    known = np.isfinite(disparity)
    return DisparityMap(disparity, known.astype(np.float32), 0.0)


def other_side(left: DisparityMap) -> DisparityMap:
    """The disparities of the right photograph that those of the left one imply: the nearer of two that meet
    there; pixels that none meets take the farther of their neighbours within two pixels on both sides."""
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
    return replace(left, disparity=_cracks_closed(disparity), confidence=confidence)


def _cracks_closed(disparity: F32) -> F32:
    """Single unknown pixels between two known ones of a row, which rounding left, take the smaller."""
    closed = disparity.copy()
    between = np.fmin(disparity[:, :-2], disparity[:, 2:])
    both = np.isfinite(disparity[:, :-2]) & np.isfinite(disparity[:, 2:]) & np.isnan(disparity[:, 1:-1])
    closed[:, 1:-1] = np.where(both, between, disparity[:, 1:-1])
    return closed
