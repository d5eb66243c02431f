"""What a rectification does to the photographs, in numbers: the better one distorts less."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from thesisrecon.dense.rectification.pair import EpipolarPair
from thesisrecon.dense.rectification.planar import disparity_bounds, disparity_gradients, singular_values
from thesisrecon.types import F64

STEP_PX = 0.01
"""Half the distance over which derivatives of a map are taken."""


class Rectification(Protocol):
    """A pair of maps from photographs to a common frame."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the frame."""

    def original_from_rectified(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """Pixels (N, 2) of the photograph."""

    def rectified_from_original(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """Places (N, 2) in the frame."""


@dataclass(frozen=True)
class RectificationQuality:
    """Distortion of a rectified pair; pairs of numbers are those of side 0 and 1.

    ``rms_dy_px`` of the matches in pixels of the frame, NaN without any. ``orthogonality_deg``: the angle of
    the photograph's midlines in the frame, ``aspect`` their ratio over what it was, NaN where they are not
    finite. ``kept`` share of each photograph inside the frame, ``growth`` pixels of the frame over those of
    the larger photograph. ``least_scale, greatest_scale`` pixels of the frame per pixel along any direction.
    ``stretch`` is the typical factor by which lengths change, exp of the RMS log singular value about their
    mean, 1 for similarities. ``slant`` (RMS gradient of the quadratic polynomial fitted to the
    disparities of the matches) says how unlike both sides are, and ``disparities`` their least and greatest.
    """

    rms_dy_px: float
    orthogonality_deg: tuple[float, float]
    aspect: tuple[float, float]
    kept: tuple[float, float]
    growth: float
    least_scale: float
    greatest_scale: float
    stretch: float
    slant: float
    disparities: tuple[float, float]

    @property
    def distortion(self) -> float:
        """The number that the choice is made by: what is done to either photograph and between both.

        ``log stretch`` and half the ``slant``, as the root of the sum of squares: a slant s stretches windows
        of one side against the other by s, to first order half of it for either.
        """
        slant = self.slant if np.isfinite(self.slant) else 0.0
        return float(np.hypot(np.log(self.stretch), 0.5 * slant))


def measure_quality(rectification: Rectification, pair: EpipolarPair) -> RectificationQuality:
    """Measure what a rectification does to ``pair``, at the samples of what both photographs see.

    It need not have been made from this pair: the epipolar geometry of ``pair`` says only what both see.
    """
    values, kept, midlines = [], [], []
    for side in (0, 1):
        samples = pair.regions[side]
        inside = np.isfinite(rectification.rectified_from_original(side, samples)).all(axis=1)
        J = jacobians(rectification, side, samples[inside])
        values.append(singular_values(J[np.isfinite(J).all(axis=(1, 2))]))
        kept.append(_share_inside(rectification, side, pair.sizes[side]))
        midlines.append(_midlines(rectification, side, pair.sizes[side]))
    found = np.concatenate(values)
    found = found if len(found) else np.full((1, 2), np.nan)
    logs = np.log(np.maximum(found, 1e-12))
    dy, slant, disparities = _matches(rectification, pair)
    width, height = rectification.size
    return RectificationQuality(
        rms_dy_px=dy,
        orthogonality_deg=(midlines[0][0], midlines[1][0]),
        aspect=(midlines[0][1], midlines[1][1]),
        kept=(kept[0], kept[1]),
        growth=width * height / max(w * h for w, h in pair.sizes),
        least_scale=float(found[:, 1].min()),
        greatest_scale=float(found[:, 0].max()),
        stretch=float(np.exp(np.std(logs))),
        slant=slant,
        disparities=disparities,
    )


def jacobians(rectification: Rectification, side: int, xy: F64) -> F64:
    """Derivatives (N, 2, 2) of the frame's coordinates by those of the photograph at pixels (N, 2), NaN
    where a polar frame begins and ends."""
    columns = []
    for axis in np.eye(2):
        ahead = rectification.rectified_from_original(side, xy + STEP_PX * axis, within=False)
        behind = rectification.rectified_from_original(side, xy - STEP_PX * axis, within=False)
        step = ahead - behind
        # A full circle of half-lines is cut somewhere, and neighbours across the cut are far apart.
        step[np.abs(step[:, 1]) > 0.5 * rectification.size[1]] = np.nan
        columns.append(step / (2.0 * STEP_PX))
    return np.stack(columns, axis=-1)


def _share_inside(rectification: Rectification, side: int, size: tuple[int, int]) -> float:
    x, y = ((np.arange(48) + 0.5) / 48 * length - 0.5 for length in size)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return float(np.isfinite(rectification.rectified_from_original(side, grid)).all(axis=1).mean())


def _midlines(rectification: Rectification, side: int, size: tuple[int, int]) -> tuple[float, float]:
    """Angle in degrees of the mapped midlines, and their ratio over that of the photograph."""
    w, h = size[0] - 1.0, size[1] - 1.0
    ends = np.array([[0.0, h / 2.0], [w, h / 2.0], [w / 2.0, 0.0], [w / 2.0, h]])
    a, b, c, d = rectification.rectified_from_original(side, ends, within=False)
    across, down = b - a, d - c
    lengths = float(np.hypot(*across)), float(np.hypot(*down))
    with np.errstate(invalid="ignore"):
        angle = float(np.degrees(np.arccos(np.clip(across @ down / (lengths[0] * lengths[1]), -1.0, 1.0))))
    return angle, lengths[0] / lengths[1] * h / w


def _matches(rectification: Rectification, pair: EpipolarPair) -> tuple[float, float, tuple[float, float]]:
    """RMS of y1 - y2, slant, and the range of disparities of the matches inside the frame."""
    left, right = (rectification.rectified_from_original(s, xy) for s, xy in enumerate(pair.matches))
    seen = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
    if int(seen.sum()) < 3:
        return float("nan"), float("nan"), (float("nan"), float("nan"))
    left, right = left[seen], right[seen]
    dy = float(np.sqrt(np.mean((left[:, 1] - right[:, 1]) ** 2)))
    slant = float(np.sqrt(np.mean(np.sum(disparity_gradients(left, right) ** 2, axis=1))))
    return dy, slant, disparity_bounds(left[:, 0] - right[:, 0], margin=0.0)
