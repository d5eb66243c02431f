"""Polar rectification: rows are half epipolar lines, columns are distances from the epipole.

Pollefeys, Koch and Van Gool, "A simple and efficient rectification method for general motion", ICCV 1999.
Epipoles may lie anywhere, and the size of the frame is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.imaging.resampling import Rectification
from thesisrecon.stereo._epipolar_pair import (
    MAX_SHRINK,
    MIN_MATCHES,
    EpipolarPair,
    EpipolarPencil,
    HalfLines,
    common_crop,
    frame_size,
    image_corners,
)
from thesisrecon.stereo._rectification_quality import disparity_gradients, matches_in_frame

ANGLES = 4096
"""Number of half-planes at which the row spacing is computed."""
MAX_LOG_SCALE, MAX_SHEAR = 0.1, 0.06
"""Limits of the alignment of the disparities along the rows."""


@dataclass(frozen=True)
class PolarRectification(Rectification):
    """Polar maps of two images to a common rectified frame.

    Row r shows the half-plane ``angles[r]``, with linear interpolation between rows. The point s px farther
    from the epipole than the image centre (nearer if the pencil is flipped) has the column ``scales[side]`` s
    + ``shears[side]`` r - ``origins[side]``.
    """

    pencil: EpipolarPencil
    angles: F64
    scales: F64
    shears: F64
    origins: F64
    size: tuple[int, int]

    def _original(self, side: int, xy: F64) -> F64:
        return self._on_lines(side, self.pencil.half_lines(side, self._angle_of(xy[:, 1])), xy)

    def _on_lines(self, side: int, lines: HalfLines, xy: F64) -> F64:
        along = (xy[:, 0] + self.origins[side] - self.shears[side] * xy[:, 1]) / self.scales[side]
        t = self._sign * along / self.pencil.units[side] + lines.sagitta
        pixels = self.pencil.pixels(side, lines.foot + t[:, None] * lines.direction)
        return np.where(lines.on_half(t)[:, None], pixels, np.nan)

    def _rectified(self, side: int, xy: F64) -> F64:
        phi = self.pencil.angles(side, xy, about=0.5 * float(self.angles[0] + self.angles[-1]))
        lines, rows = self.pencil.half_lines(side, phi), self._row_of(phi)
        t = np.sum(self.pencil.normalized(side, xy) * lines.direction, axis=1)
        along = self._sign * self.pencil.units[side] * (t - lines.sagitta)
        columns = self.scales[side] * along + self.shears[side] * rows - self.origins[side]
        return np.stack([columns, rows], axis=1)

    def _lookup(self, side: int, rows: range) -> F64:
        width = self.size[0]
        lines = self.pencil.half_lines(side, self.angles[rows.start : rows.stop])
        foot, direction, distance = (
            np.repeat(part, width, axis=0) for part in (lines.foot, lines.direction, lines.distance)
        )
        columns = np.tile(np.arange(float(width)), len(rows))
        xy = np.stack([columns, np.repeat(np.array(rows, dtype=np.float64), width)], axis=1)
        found = self._on_lines(side, HalfLines(foot, direction, distance, lines.epipole), xy)
        return found.reshape(len(rows), width, 2)

    @property
    def _sign(self) -> float:
        return -1.0 if self.pencil.flipped else 1.0

    def _angle_of(self, rows: F64) -> F64:
        """Angles of rows (N,), which may be fractional; NaN more than half a row outside."""
        last = len(self.angles) - 1
        valid = (rows >= -0.5) & (rows <= last + 0.5)
        k = np.clip(np.floor(np.where(valid, rows, 0.0)), 0, last - 1).astype(np.int64)
        step = self.angles[k + 1] - self.angles[k]
        return np.where(valid, self.angles[k] + (rows - k) * step, np.nan)

    def _row_of(self, phi: F64) -> F64:
        """Inverse of :meth:`_angle_of`."""
        last = len(self.angles) - 1
        k = np.searchsorted(self._sign * self.angles, self._sign * phi, side="right") - 1
        k = np.clip(k, 0, last - 1)
        rows = k + (phi - self.angles[k]) / (self.angles[k + 1] - self.angles[k])
        return np.where((rows >= -0.5) & (rows <= last + 0.5), rows, np.nan)


def polar(pair: EpipolarPair, *, aligned: bool = True) -> PolarRectification:
    """Rectify in polar coordinates with bounded reduction (2.5).

    Adjacent rows are at most one pixel apart in the middle of each half-line, and closer where its end would
    be reduced by more than ``MAX_SHRINK`` (1: no pixel is lost, as in the paper). The row spacing is a
    function of the angle whose integral counts the rows, instead of walking from line to line.

    ``aligned`` reduces the disparity gradients of the matches by shear and scale along the rows.
    """
    pencil, sign = pair.pencil, -1 if pair.pencil.flipped else 1
    phi = _half_planes(pair)
    both = [pencil.chords(side, phi) for side in (0, 1)]
    angles = _rows_of(pencil, phi, both)[::sign]
    frame = PolarRectification(pencil, angles, np.ones(2), np.zeros(2), np.zeros(2), (1, len(angles)))
    frame = _align_disparities(frame, pair) if aligned else frame
    ends = []
    for side, (lines, enter, leave) in enumerate(both):
        met = leave >= enter
        rim = [(lines.foot + t[:, None] * lines.direction)[met] for t in (enter, leave)]
        xy = frame.rectified_from_original(side, pencil.pixels(side, np.concatenate(rim)), within=False)
        ends.append(xy[np.isfinite(xy).all(axis=1)])
    low, high = common_crop(ends, matches_in_frame(frame, pair.matches, within=False))
    extent = np.array([(high - low)[:, 0].max() + 1.0, len(angles)])
    return replace(frame, origins=low[:, 0].copy(), size=frame_size(extent, pair))


def _align_disparities(frame: PolarRectification, pair: EpipolarPair) -> PolarRectification:
    left, right = matches_in_frame(frame, pair.matches, within=False)
    if len(left) < MIN_MATCHES:
        return frame
    # The disparity slope is the difference of the scales along x and of the shears along y.
    slope = disparity_gradients(left, right).mean(axis=0)
    scale = np.exp(np.clip(-slope[0], -MAX_LOG_SCALE, MAX_LOG_SCALE))
    shear = np.clip(-0.5 * slope[1], -MAX_SHEAR, MAX_SHEAR)
    scales = np.array([max(scale, 1.0), max(1.0 / scale, 1.0)])
    return replace(frame, scales=scales, shears=np.array([shear, -shear]))


def _half_planes(pair: EpipolarPair) -> F64:
    """Angles over the arc, including those of the image corners, where the row spacing is extreme."""
    low, high = pair.arc
    corners, about = [image_corners(size) for size in pair.pencil.sizes], 0.5 * (low + high)
    peaks = np.concatenate([pair.pencil.angles(side, xy, about=about) for side, xy in enumerate(corners)])
    return np.unique(np.concatenate([np.linspace(low, high, ANGLES), peaks[(peaks > low) & (peaks < high)]]))


def _rows_of(pencil: EpipolarPencil, phi: F64, both: list[tuple[HalfLines, F64, F64]]) -> F64:
    """Angles of the rows, increasing (H,)."""
    per_radian = np.zeros(len(phi))
    for side, (lines, enter, leave) in enumerate(both):
        met = leave >= enter
        for t, shrink in ((0.5 * (enter + leave), 1.0), (enter, MAX_SHRINK), (leave, MAX_SHRINK)):
            at = np.where(met, t, 0.0)[:, None]
            sweep_rate = pencil.sweep_rate(side, phi, lines.foot + at * lines.direction) * pencil.units[side]
            per_radian = np.maximum(per_radian, np.where(met, sweep_rate / shrink, 0.0))
    # The maximum of both ends bounds the reduction between the samples.
    each = np.maximum(per_radian[:-1], per_radian[1:]) * np.diff(phi)
    rows = np.concatenate([[0.0], np.cumsum(np.maximum(each, 1e-12))])
    count = max(int(np.ceil(rows[-1])) + 1, 2)
    return np.interp(np.linspace(0.0, rows[-1], count), rows, phi)
