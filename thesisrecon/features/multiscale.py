"""Corners at two sizes for matches in number, and patches of several scales to start the matching from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.features.harris import find_corners, select_spread
from thesisrecon.features.kernels import sample_patches
from thesisrecon.geometry.raster import halve, resample, smooth
from thesisrecon.types import B8, F32, F64, Features, Image, Seeds


@dataclass(frozen=True)
class Level:
    """One size of the photograph: ``gray`` (h, w) and how many pixels of the photograph one of its pixels
    spans."""

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
    full_corners, half_corners : corners kept at full and at half size.
    pool_ratio : the corners are chosen among this many times as many of the strongest.
    seeds_per_level : seeds kept at the finest level; every further level keeps 1/sqrt(2) as many.
    levels : levels of 1/sqrt(2).
    upsample_below_px : long side under which the photograph is doubled.
    """

    full_corners: int = 3000
    half_corners: int = 1500
    pool_ratio: float = 1.7
    seeds_per_level: int = 1400
    levels: int = 5
    upsample_below_px: int = 1000

    def detect(self, image: Image) -> Features:
        """Corners, strongest first (scale 1 and 2, or 0.5 and 1 where doubled), and seeds."""
        levels = self._pyramid(image.gray)
        found = [find_corners(level.gray) for level in levels]
        parts = []
        for index, count in ((0, self.full_corners), (2, self.half_corners)):
            if index < len(levels):
                xy, response = found[index]
                kept = select_spread(xy, response, count, pool=int(self.pool_ratio * count))
                nominal = np.float32(round(2.0 * levels[index].scale_x) / 2.0)
                parts.append((levels[index].to_image(xy[kept]), np.full(len(kept), nominal), response[kept]))
        xy, scale, response = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.argsort(-response, kind="stable")
        seeds = self._seeds(levels, found)
        return Features(xy=xy[order], scale=scale[order], response=response[order], seeds=seeds)

    def _pyramid(self, gray: F32) -> list[Level]:
        height, width = gray.shape
        if max(width, height) < self.upsample_below_px:
            levels = [Level(resample(gray, 2 * width, 2 * height), 0.5, 0.5)]
        else:
            levels = [Level(gray, 1.0, 1.0)]
        for index in range(1, self.levels):
            finer = levels[max(index - 2, 0)]
            if min(finer.gray.shape) < 32:
                break
            if index == 1:
                # A step of sqrt(2) needs a weaker low-pass than halving: sigma 0.6 leaves little to alias.
                h, w = finer.gray.shape
                small = resample(smooth(finer.gray, 0.6), round(w / np.sqrt(2.0)), round(h / np.sqrt(2.0)))
                levels.append(
                    Level(small, finer.scale_x * w / small.shape[1], finer.scale_y * h / small.shape[0])
                )
            else:
                levels.append(Level(halve(finer.gray), 2.0 * finer.scale_x, 2.0 * finer.scale_y))
        return levels

    def _seeds(self, levels: list[Level], found: list[tuple[F64, F32]]) -> Seeds:
        xy, scale, angle, upright, turned = [], [], [], [], []
        for index, (level, (corners, response)) in enumerate(zip(levels, found, strict=True)):
            count = int(self.seeds_per_level / np.sqrt(2.0) ** index)
            kept = select_spread(corners, response, count, pool=int(self.pool_ratio * count))
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
