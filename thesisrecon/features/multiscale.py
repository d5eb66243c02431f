"""Corners at two sizes for matches in number, and patches of several scales to start the matching from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from thesisrecon.arrays import B8, F32, F64, I64
from thesisrecon.features.harris import CornerMeasure, find_corners, select_spread
from thesisrecon.features.kernels import sample_patches
from thesisrecon.geometry.raster import halve, resample, smooth
from thesisrecon.records import Features, Image, Seeds


@dataclass(frozen=True)
class Level:
    """One size of the photograph: ``channels`` (C, h, w), in which corners are found, ``gray`` (h, w), and
    how many pixels of the photograph one of its pixels spans."""

    channels: F32
    gray: F32
    scale_x: float
    scale_y: float

    def to_image(self, xy: F64) -> F64:
        """Pixels of this level -> pixels of the photograph."""
        scale = np.array([self.scale_x, self.scale_y])
        inside: F64 = (xy + 0.5) * scale - 0.5
        return inside


@dataclass(frozen=True)
class MultiScaleCorners:
    """Harris corners at full and half size, spread over the image, with seed patches at five levels of
    1/sqrt(2).

    Seeds are the multi-scale oriented patches of Brown, Szeliski and Winder (CVPR 2005), each twice: upright
    and turned to the dominant gradient. Photographs whose long side is under ``upsample_below_px`` are
    doubled first; all coordinates are in the pixels of the photograph that was given.

    Parameters
    ----------
    full_corners, half_corners : corners kept at full and at half size; 0 for none of a size.
    spread : corners and seeds are chosen to cover the image (:func:`select_spread`), else the strongest.
    pool_ratio : where spread, they are chosen among this many times as many of the strongest.
    seeds_per_level : seeds kept at the finest level; every further level keeps 1/sqrt(2) as many.
    levels : levels of 1/sqrt(2).
    upsample_below_px : long side under which the photograph is doubled; 0 for never.
    measure : the R-matrix and its parameters, the same at every size.
    """

    full_corners: int = 3000
    half_corners: int = 1500
    spread: bool = True
    pool_ratio: float = 1.7
    seeds_per_level: int = 1400
    levels: int = 5
    upsample_below_px: int = 1000
    measure: CornerMeasure = field(default_factory=CornerMeasure)

    def __post_init__(self) -> None:
        if self.levels < 1:
            raise ValueError(f"levels must be at least 1; got {self.levels}")
        if self.full_corners < 0 or self.half_corners < 0 or self.full_corners + self.half_corners == 0:
            raise ValueError(
                "full_corners and half_corners must be at least 0, and one of them above; "
                f"got {self.full_corners} and {self.half_corners}"
            )
        if not (self.seeds_per_level >= 0 and self.pool_ratio >= 1.0):
            raise ValueError(
                "seeds_per_level must be at least 0 and pool_ratio at least 1; "
                f"got {self.seeds_per_level} and {self.pool_ratio}"
            )

    def detect(self, image: Image) -> Features:
        """Corners, strongest first (scale 1 and 2, or 0.5 and 1 where doubled), and seeds."""
        levels = self._pyramid(image)
        found = [find_corners(level.channels, self.measure) for level in levels]
        parts = []
        for index, count in ((0, self.full_corners), (2, self.half_corners)):
            if index < len(levels):
                xy, response = found[index]
                kept = self._select(xy, response, count)
                nominal = np.float32(round(2.0 * levels[index].scale_x) / 2.0)
                parts.append((levels[index].to_image(xy[kept]), np.full(len(kept), nominal), response[kept]))
        xy, scale, response = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.argsort(-response, kind="stable")
        seeds = self._seeds(levels, found)
        return Features(xy=xy[order], scale=scale[order], response=response[order], seeds=seeds)

    def _select(self, xy: F64, response: F32, count: int) -> I64:
        if self.spread:
            return select_spread(xy, response, count, pool=int(self.pool_ratio * count))
        return np.arange(min(count, len(xy)), dtype=np.int64)

    def _pyramid(self, image: Image) -> list[Level]:
        doubled = max(image.size) < self.upsample_below_px
        grays = shrink(image.gray, self.levels, doubled=doubled)
        channels = [gray[None] for gray in grays]
        if self.measure.colour:
            sizes = zip(
                *(shrink(c, self.levels, doubled=doubled) for c in self.measure.channels(image)), strict=True
            )
            channels = [np.stack(size) for size in sizes]
        width, height = image.size
        return [
            Level(c, gray, *scale)
            for c, gray, scale in zip(channels, grays, _scales(grays, width, height), strict=True)
        ]

    def _seeds(self, levels: list[Level], found: list[tuple[F64, F32]]) -> Seeds:
        xy, scale, angle, upright, turned = [], [], [], [], []
        for index, (level, (corners, response)) in enumerate(zip(levels, found, strict=True)):
            count = int(self.seeds_per_level / np.sqrt(2.0) ** index)
            kept = self._select(corners, response, count)
            blurred = smooth(level.gray, 2.0)
            direction = dominant_direction(blurred, corners[kept])
            xy.append(level.to_image(corners[kept]))
            scale.append(np.full(len(kept), np.sqrt(level.scale_x * level.scale_y), np.float32))
            angle.append(direction)
            upright.append(sample_patches(blurred, corners[kept], np.zeros_like(direction), 8, 4.0))
            turned.append(sample_patches(blurred, corners[kept], direction, 8, 4.0))
        patches, structured = normalize_patches(np.concatenate(upright + turned))
        zeros = np.zeros(sum(len(a) for a in angle), np.float32)
        return Seeds(
            xy=np.concatenate(xy + xy)[structured],
            scale=np.concatenate(scale + scale)[structured],
            angle=np.concatenate([zeros, *angle])[structured],
            patches=patches[structured],
        )


def shrink(plane: F32, levels: int, *, doubled: bool) -> list[F32]:
    """(H, W), or twice that where ``doubled``, and its sizes smaller by 1/sqrt(2) each; no side under 16."""
    height, width = plane.shape
    sizes = [resample(plane, 2 * width, 2 * height) if doubled else plane]
    for index in range(1, levels):
        finer = sizes[max(index - 2, 0)]
        if min(finer.shape) < 32:
            break
        if index == 1:
            # A step of sqrt(2) needs a weaker low-pass than halving: sigma 0.6 leaves little to alias.
            h, w = finer.shape
            sizes.append(resample(smooth(finer, 0.6), round(w / np.sqrt(2.0)), round(h / np.sqrt(2.0))))
        else:
            sizes.append(halve(finer))
    return sizes


def _scales(grays: list[F32], width: int, height: int) -> list[tuple[float, float]]:
    """Pixels of the photograph that a pixel of each size spans along x and y; halving drops an odd row, so
    that two there are exactly one."""
    first = (width / grays[0].shape[1], height / grays[0].shape[0])
    scales = [first]
    for index, gray in enumerate(grays[1:], 1):
        if index == 1:
            h, w = grays[0].shape
            scales.append((first[0] * w / gray.shape[1], first[1] * h / gray.shape[0]))
        else:
            scales.append((2.0 * scales[index - 2][0], 2.0 * scales[index - 2][1]))
    return scales


def dominant_direction(blurred: F32, xy: F64) -> F32:
    """Direction (N,) rad of the gradient at ``xy``, averaged over about nine pixels; never exactly 0.

    The image is already smooth by sigma 2; the mean over a 5 x 5 grid of spacing 2 brings it to about sigma
    4.
    """
    around = sample_patches(blurred, xy, np.zeros(len(xy), np.float32), 7, 2.0).reshape(-1, 7, 7)
    gx = (around[:, 1:-1, 2:] - around[:, 1:-1, :-2]).sum(axis=(1, 2))
    gy = (around[:, 2:, 1:-1] - around[:, :-2, 1:-1]).sum(axis=(1, 2))
    angle = np.arctan2(gy, gx).astype(np.float32)
    return np.where(angle == 0.0, np.float32(1e-6), angle)


def normalize_patches(patches: F32) -> tuple[F32, B8]:
    """Rows of zero mean and unit norm, and whether each had structure (over a grey level)."""
    centred = patches - patches.mean(axis=1, keepdims=True)
    norm = np.linalg.norm(centred, axis=1, keepdims=True)
    structured = norm[:, 0] > np.sqrt(patches.shape[1])
    return (centred / np.maximum(norm, 1e-6)).astype(np.float32), structured
