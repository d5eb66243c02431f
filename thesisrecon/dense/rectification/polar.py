"""Polar rectification: rows are half epipolar lines, columns the distance from the epipole.

Pollefeys, Koch and Van Gool, "A simple and efficient rectification method for general motion", ICCV 1999:
epipoles may lie anywhere, and the frame is never larger than a few times the photograph.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from thesisrecon.dense.rectification.pair import EpipolarPair
from thesisrecon.dense.rectification.pencil import EpipolarPencil, HalfLines
from thesisrecon.dense.rectification.planar import FrameLimits, common_crop
from thesisrecon.dense.rectification.sampling import require_side, warp_image
from thesisrecon.types import F32, F64

ANGLES = 4096
"""Half-planes at which the spacing of rows is computed."""


@dataclass(frozen=True)
class PolarRectification:
    """Rows of half-planes and columns of equal distance from the epipole.

    Row r shows the half-plane ``angles[r]`` (H,) of ``pencil``, rows between are interpolated linearly in
    the angle; column c of a side is c + ``origins[side]`` px farther along the half-line than the centre of
    that photograph is from the epipole (and against it where the pencil is turned). ``size`` (width, height)
    is common to both. The same convention holds as for planar rectification: side 0 is the left one.
    """

    pencil: EpipolarPencil
    angles: F64
    origins: F64
    size: tuple[int, int]

    def original_from_rectified(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """Pixels (N, 2) of the photograph at places (N, 2) of the frame; NaN outside the frame and beyond the
        epipole. With ``within`` False columns may be any."""
        lines = self.pencil.half_lines(require_side(side), self._angle_of(xy[:, 1]))
        return self._on_lines(side, lines, xy[:, 0], within)

    def _on_lines(self, side: int, lines: HalfLines, columns: F64, within: bool) -> F64:
        sign = -1.0 if self.pencil.turned else 1.0
        t = sign * (columns + self.origins[side]) / self.pencil.units[side] + lines.sagitta
        valid = lines.on_half(t)
        if within:
            valid = np.logical_and(valid, (columns >= -0.5) & (columns <= self.size[0] - 0.5))
        xy = self.pencil.pixels(side, lines.foot + t[:, None] * lines.direction)
        return np.where(valid[:, None], xy, np.nan)

    def rectified_from_original(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """The inverse of :meth:`original_from_rectified`, for pixels (N, 2) of the photograph."""
        middle = 0.5 * float(self.angles[0] + self.angles[-1])
        phi = self.pencil.angles(require_side(side), xy, about=middle)
        lines = self.pencil.half_lines(side, phi)
        sign = -1.0 if self.pencil.turned else 1.0
        t = np.sum(self.pencil.places(side, xy) * lines.direction, axis=1)
        columns = sign * self.pencil.units[side] * (t - lines.sagitta) - self.origins[side]
        valid = (columns >= -0.5) & (columns <= self.size[0] - 0.5) if within else np.full(len(xy), True)
        return np.where(valid[:, None], np.stack([columns, self._row_of(phi)], axis=1), np.nan)

    def lookup(self, side: int, rows: range) -> F64:
        """(len(rows), width, 2) px in the photograph for the pixels of these rows."""
        width = self.size[0]
        lines = self.pencil.half_lines(require_side(side), self.angles[rows.start : rows.stop])
        foot, direction, distance = (
            np.repeat(part, width, axis=0) for part in (lines.foot, lines.direction, lines.distance)
        )
        every = HalfLines(foot, direction, distance, lines.epipole)
        columns = np.tile(np.arange(float(width)), len(rows))
        return self._on_lines(side, every, columns, True).reshape(len(rows), width, 2)

    def warp(self, image: F32, side: int) -> F32:
        """``image`` (H, W) or (H, W, C) in the frame: float32, NaN outside."""
        return warp_image(self, image, require_side(side))

    def _angle_of(self, rows: F64) -> F64:
        """Half-planes of rows (N,), which may be fractions; NaN half a row beyond the first and last."""
        last = len(self.angles) - 1
        valid = (rows >= -0.5) & (rows <= last + 0.5)
        k = np.clip(np.floor(np.where(valid, rows, 0.0)), 0, last - 1).astype(np.int64)
        step = self.angles[k + 1] - self.angles[k]
        return np.where(valid, self.angles[k] + (rows - k) * step, np.nan)

    def _row_of(self, phi: F64) -> F64:
        """The inverse of :meth:`_angle_of`."""
        last = len(self.angles) - 1
        sign = -1.0 if self.pencil.turned else 1.0
        k = np.clip(np.searchsorted(sign * self.angles, sign * phi, side="right") - 1, 0, last - 1)
        rows = k + (phi - self.angles[k]) / (self.angles[k + 1] - self.angles[k])
        return np.where((rows >= -0.5) & (rows <= last + 0.5), rows, np.nan)


@dataclass(frozen=True)
class Polar:
    """Half epipolar lines in either photograph, no pixel shrinking by more than ``limits.most_shrink``.

    Neighbouring rows are at most a pixel apart at the middle of what either view shows of them, and nearer
    where a far end would shrink by more (up to 1 % more just at corners). With ``most_shrink`` 1 no pixel is
    lost, as Pollefeys et al. have it, at the price of rows that are too near elsewhere. They walk from line
    to line; here the spacing is a function of the angle whose integral counts the rows.
    """

    limits: FrameLimits = field(default_factory=FrameLimits)

    def rectify(self, pair: EpipolarPair) -> PolarRectification:
        """The polar frame; ``StageFailure`` where it would be too large or the views share nothing."""
        pencil, sign = pair.pencil, -1.0 if pair.pencil.turned else 1.0
        phi = _half_planes(pair)
        chords = [_chord(pencil, side, phi) for side in (0, 1)]
        angles = _rows_of(pencil, phi, chords, self.limits.most_shrink)[:: int(sign)]
        whole = PolarRectification(pencil, angles, np.zeros(2), (1, len(angles)))
        ends = []
        for side, (lines, enter, leave) in enumerate(chords):
            met = leave >= enter
            t = np.concatenate([enter[met] - lines.sagitta[met], leave[met] - lines.sagitta[met]])
            columns = sign * pencil.units[side] * t
            ends.append(np.stack([columns, np.zeros(len(columns))], axis=1))
        matches = tuple(
            whole.rectified_from_original(side, xy, within=False) for side, xy in enumerate(pair.matches)
        )
        seen = np.isfinite(matches[0]).all(axis=1) & np.isfinite(matches[1]).all(axis=1)
        low, high = common_crop(ends, (matches[0][seen], matches[1][seen]))
        width, height = self.limits.require(np.array([(high - low)[:, 0].max() + 1.0, len(angles)]), pair)
        return PolarRectification(pencil, angles, low[:, 0].copy(), (width, height))


def _half_planes(pair: EpipolarPair) -> F64:
    """Half-planes over the arc, those of the corners among them: there the spacing of rows has its peaks."""
    low, high = pair.arc
    corners = [
        np.array([[0.0, 0.0], [w - 1.0, 0.0], [w - 1.0, h - 1.0], [0.0, h - 1.0]]) for w, h in pair.sizes
    ]
    peaks = [pair.pencil.angles(side, xy, about=0.5 * (low + high)) for side, xy in enumerate(corners)]
    inside = np.concatenate(peaks)
    return np.unique(
        np.concatenate([np.linspace(low, high, ANGLES), inside[(inside > low) & (inside < high)]])
    )


def _chord(pencil: EpipolarPencil, side: int, phi: F64) -> tuple[HalfLines, F64, F64]:
    """The half-lines and where they enter and leave the photograph, in places, the later first where not."""
    width, height = pencil.sizes[side]
    lines = pencil.half_lines(side, phi)
    low = pencil.places(side, np.zeros(2))
    high = pencil.places(side, np.array([width - 1.0, height - 1.0]))
    return lines, *lines.chord(low, high)


def _rows_of(
    pencil: EpipolarPencil, phi: F64, chords: list[tuple[HalfLines, F64, F64]], most_shrink: float
) -> F64:
    """Half-planes of the rows, increasing (H,)."""
    per_radian = np.zeros(len(phi))
    for side, (lines, enter, leave) in enumerate(chords):
        met = leave >= enter
        for t, shrink in ((0.5 * (enter + leave), 1.0), (enter, most_shrink), (leave, most_shrink)):
            at = np.where(met, t, 0.0)[:, None]
            swept = pencil.swept(side, phi, lines.foot + at * lines.direction) * pencil.units[side]
            per_radian = np.maximum(per_radian, np.where(met, swept / shrink, 0.0))
    # The most that neighbours need, so that nothing shrinks between the sampled half-planes either.
    each = np.maximum(per_radian[:-1], per_radian[1:]) * np.diff(phi)
    rows = np.concatenate([[0.0], np.cumsum(np.maximum(each, 1e-12))])
    count = max(int(np.ceil(rows[-1])) + 1, 2)
    return np.interp(np.linspace(0.0, rows[-1], count), rows, phi)
