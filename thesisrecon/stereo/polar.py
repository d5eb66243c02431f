"""Polar rectification: rows are half epipolar lines, columns are distances from the epipole.

Pollefeys, Koch and Van Gool, "A simple and efficient rectification method for general motion", ICCV 1999.
Epipoles may lie anywhere, and the size of the frame is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from thesisrecon.arrays import F32, F64
from thesisrecon.stereo.epipolar_pair import MIN_MATCHES, EpipolarPair, EpipolarPencil, HalfLines
from thesisrecon.stereo.planar import FrameLimits, common_crop, disparity_gradients
from thesisrecon.stereo.resampling import require_side, warp_image

ANGLES = 4096
"""Number of half-planes at which the row spacing is computed."""


@dataclass(frozen=True)
class PolarRectification:
    """Polar maps of two images to a common rectified frame.

    Row r shows the half-plane ``angles[r]``, with linear interpolation between rows. The point s px farther
    from the epipole than the image centre (nearer if the pencil is flipped) has the column ``scales[side]`` s
    + ``shears[side]`` r - ``origins[side]``. Conventions are those of planar rectification: side 0 is the
    left image.

    Attributes
    ----------
    pencil : EpipolarPencil
        Epipolar lines of the pair.
    angles : ndarray (H,)
        Angles of the rows.
    scales, shears, origins : ndarray (2,)
        Column coordinates of both images.
    size : tuple of int
        (width, height) of the frame.
    """

    pencil: EpipolarPencil
    angles: F64
    scales: F64
    shears: F64
    origins: F64
    size: tuple[int, int]

    def original_from_rectified(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """Map positions of the frame to pixels of an image.

        Parameters
        ----------
        side : {0, 1}
        xy : ndarray (N, 2)
        within : bool
            Return NaN for columns outside the frame too.

        Returns
        -------
        ndarray (N, 2)
            Pixels of the image, NaN beyond the epipole and outside the rows.
        """
        lines = self.pencil.half_lines(require_side(side), self._angle_of(xy[:, 1]))
        return self._on_lines(side, lines, xy, within)

    def _on_lines(self, side: int, lines: HalfLines, xy: F64, within: bool) -> F64:
        along = (xy[:, 0] + self.origins[side] - self.shears[side] * xy[:, 1]) / self.scales[side]
        t = self._sign * along / self.pencil.units[side] + lines.sagitta
        valid = lines.on_half(t)
        if within:
            valid = np.logical_and(valid, (xy[:, 0] >= -0.5) & (xy[:, 0] <= self.size[0] - 0.5))
        pixels = self.pencil.pixels(side, lines.foot + t[:, None] * lines.direction)
        return np.where(valid[:, None], pixels, np.nan)

    def rectified_from_original(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """Map pixels of an image to the frame.

        Parameters
        ----------
        side : {0, 1}
        xy : ndarray (N, 2)
        within : bool
            Return NaN for columns outside the frame too.

        Returns
        -------
        ndarray (N, 2)
        """
        middle = 0.5 * float(self.angles[0] + self.angles[-1])
        phi = self.pencil.angles(require_side(side), xy, about=middle)
        lines, rows = self.pencil.half_lines(side, phi), self._row_of(phi)
        t = np.sum(self.pencil.normalized(side, xy) * lines.direction, axis=1)
        along = self._sign * self.pencil.units[side] * (t - lines.sagitta)
        columns = self.scales[side] * along + self.shears[side] * rows - self.origins[side]
        valid = (columns >= -0.5) & (columns <= self.size[0] - 0.5) if within else np.full(len(xy), True)
        return np.where(valid[:, None], np.stack([columns, rows], axis=1), np.nan)

    @property
    def _sign(self) -> float:
        return -1.0 if self.pencil.flipped else 1.0

    def lookup(self, side: int, rows: range) -> F64:
        """Return the image positions of some rows of the frame.

        Parameters
        ----------
        side : {0, 1}
        rows : range

        Returns
        -------
        ndarray (len(rows), width, 2)
        """
        width = self.size[0]
        lines = self.pencil.half_lines(require_side(side), self.angles[rows.start : rows.stop])
        foot, direction, distance = (
            np.repeat(part, width, axis=0) for part in (lines.foot, lines.direction, lines.distance)
        )
        every = HalfLines(foot, direction, distance, lines.epipole)
        columns, row = (
            np.tile(np.arange(float(width)), len(rows)),
            np.repeat(np.array(rows, dtype=np.float64), width),
        )
        return self._on_lines(side, every, np.stack([columns, row], axis=1), True).reshape(
            len(rows), width, 2
        )

    def warp(self, image: F32, side: int) -> F32:
        """Resample an image into the frame.

        Parameters
        ----------
        image : ndarray (H, W) or (H, W, C)
        side : {0, 1}

        Returns
        -------
        ndarray float32
            The rectified image, NaN outside.
        """
        return warp_image(self, image, require_side(side))

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
        k = np.clip(
            np.searchsorted(self._sign * self.angles, self._sign * phi, side="right") - 1, 0, last - 1
        )
        rows = k + (phi - self.angles[k]) / (self.angles[k + 1] - self.angles[k])
        return np.where((rows >= -0.5) & (rows <= last + 0.5), rows, np.nan)


@dataclass(frozen=True)
class PolarRectifier:
    """Polar rectification with bounded reduction.

    Adjacent rows are at most one pixel apart in the middle of each half-line, and closer where its end would
    be reduced by more than ``limits.max_shrink`` (1: no pixel is lost, as in the paper). The row spacing is a
    function of the angle whose integral counts the rows, instead of walking from line to line. Shear and
    scale along the rows reduce the disparity gradients of the matches.

    Parameters
    ----------
    limits : FrameLimits
    max_scale : float
        Limit of the log scale along the rows.
    max_shear : float
        Limit of the shear.
    """

    limits: FrameLimits = field(default_factory=FrameLimits)
    max_scale: float = 0.1
    max_shear: float = 0.06

    def rectify(self, pair: EpipolarPair) -> PolarRectification:
        """Compute the polar maps.

        Parameters
        ----------
        pair : EpipolarPair

        Returns
        -------
        PolarRectification

        Raises
        ------
        StageFailure
            If the frame would be too large or the views do not overlap.
        """
        pencil, sign = pair.pencil, -1 if pair.pencil.flipped else 1
        phi = _half_planes(pair)
        chords = [_chord(pencil, side, phi) for side in (0, 1)]
        angles = _rows_of(pencil, phi, chords, self.limits.max_shrink)[::sign]
        bare = PolarRectification(pencil, angles, np.ones(2), np.zeros(2), np.zeros(2), (1, len(angles)))
        alike = self._align_disparities(bare, pair)
        ends = []
        for side, (lines, enter, leave) in enumerate(chords):
            met = leave >= enter
            rim = [(lines.foot + t[:, None] * lines.direction)[met] for t in (enter, leave)]
            xy = alike.rectified_from_original(side, pencil.pixels(side, np.concatenate(rim)), within=False)
            ends.append(xy[np.isfinite(xy).all(axis=1)])
        low, high = common_crop(ends, _matches_in(alike, pair))
        extent = np.array([(high - low)[:, 0].max() + 1.0, len(angles)])
        return replace(alike, origins=low[:, 0].copy(), size=self.limits.require(extent, pair))

    def _align_disparities(self, bare: PolarRectification, pair: EpipolarPair) -> PolarRectification:
        left, right = _matches_in(bare, pair)
        if len(left) < MIN_MATCHES:
            return bare
        # The disparity slope is the difference of the scales along x and of the shears along y.
        slope = disparity_gradients(left, right).mean(axis=0)
        scale = np.exp(np.clip(-slope[0], -self.max_scale, self.max_scale))
        shear = np.clip(-0.5 * slope[1], -self.max_shear, self.max_shear)
        scales = np.array([max(scale, 1.0), max(1.0 / scale, 1.0)])
        return replace(bare, scales=scales, shears=np.array([shear, -shear]))


def _matches_in(frame: PolarRectification, pair: EpipolarPair) -> tuple[F64, F64]:
    left, right = (frame.rectified_from_original(s, xy, within=False) for s, xy in enumerate(pair.matches))
    seen = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
    return left[seen], right[seen]


def _half_planes(pair: EpipolarPair) -> F64:
    """Angles over the arc, including those of the image corners, where the row spacing is extreme."""
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
    """Half-lines with the positions of entry into and exit from the image; entry > exit if they miss it."""
    width, height = pencil.sizes[side]
    lines = pencil.half_lines(side, phi)
    low = pencil.normalized(side, np.zeros(2))
    high = pencil.normalized(side, np.array([width - 1.0, height - 1.0]))
    return lines, *lines.chord(low, high)


def _rows_of(
    pencil: EpipolarPencil, phi: F64, chords: list[tuple[HalfLines, F64, F64]], max_shrink: float
) -> F64:
    """Angles of the rows, increasing (H,)."""
    per_radian = np.zeros(len(phi))
    for side, (lines, enter, leave) in enumerate(chords):
        met = leave >= enter
        for t, shrink in ((0.5 * (enter + leave), 1.0), (enter, max_shrink), (leave, max_shrink)):
            at = np.where(met, t, 0.0)[:, None]
            sweep_rate = pencil.sweep_rate(side, phi, lines.foot + at * lines.direction) * pencil.units[side]
            per_radian = np.maximum(per_radian, np.where(met, sweep_rate / shrink, 0.0))
    # The maximum of both ends bounds the reduction between the samples.
    each = np.maximum(per_radian[:-1], per_radian[1:]) * np.diff(phi)
    rows = np.concatenate([[0.0], np.cumsum(np.maximum(each, 1e-12))])
    count = max(int(np.ceil(rows[-1])) + 1, 2)
    return np.interp(np.linspace(0.0, rows[-1], count), rows, phi)
