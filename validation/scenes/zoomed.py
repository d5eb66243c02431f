"""Zoomed, cropped and masked images derived from images, with exact ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image as PillowImage

from thesisrecon.arrays import F64, U8
from validation.scenes.image_files import read_rgb, write_png
from validation.scenes.real import Scene

FEATHER_PX = 24.0


@dataclass(frozen=True)
class Frame:
    """The part of an image that becomes one of its own: ``size`` (width, height) px, its corner at
    ``(left, top)`` of the image enlarged ``zoom`` times."""

    zoom: float
    left: float
    top: float
    size: tuple[int, int]

    def calibration(self, K: F64) -> F64:
        """K (3, 3) of the new image, from that of the old one."""
        move = 0.5 * self.zoom - 0.5 - np.array([self.left, self.top])
        return np.array([[self.zoom, 0, move[0]], [0, self.zoom, move[1]], [0, 0, 1]]) @ K

    def cut(self, rgb: U8) -> U8:
        """The new image (H, W, 3), resampled once."""
        box = np.array([self.left, self.top, self.left + self.size[0], self.top + self.size[1]]) / self.zoom
        low, high = np.zeros(4), np.tile(rgb.shape[1::-1], 2)
        left, top, right, bottom = (float(v) for v in np.clip(box, low, high))
        picture = PillowImage.fromarray(rgb)
        part = picture.resize(self.size, PillowImage.Resampling.LANCZOS, box=(left, top, right, bottom))
        return np.asarray(part)


@dataclass(frozen=True)
class Rezoom:
    """Every image zoomed and cropped for itself.

    ``zoom``: the logarithm of the factor lies within +- this; ``shift``: the principal point moves from the
    middle by up to this share of the new width and height. A frame is never larger than the image was.
    """

    zoom: float = 0.4
    shift: float = 0.1

    def frame(self, K: F64, size: tuple[int, int], rng: np.random.Generator) -> Frame:
        """A frame of an image of this ``size`` (width, height) with the calibration K (3, 3)."""
        factor = float(np.exp(rng.uniform(-self.zoom, self.zoom)))
        off = rng.uniform(-self.shift, self.shift, 2)
        centre, whole = factor * (K[:2, 2] + 0.5), factor * np.array(size)
        room = np.minimum(centre, whole - centre) / (0.5 + np.abs(off))
        width, height = (int(v) for v in np.minimum(room, size))
        left, top = centre - (0.5 + off) * [width, height]
        return Frame(factor, float(left), float(top), (width, height))


def rezoom_scene(scene: Scene, folder: Path, *, seed: int, how: Rezoom | None = None) -> Scene:
    """The scene with every image in a :class:`Rezoom` frame of its own, written to ``folder``."""
    calibrations, R, C = scene.cameras
    how, rng = how or Rezoom(), np.random.default_rng(seed)
    paths, K = [], []
    for path, calibration in zip(scene.image_paths, calibrations, strict=True):
        rgb = read_rgb(path)
        part = how.frame(calibration, (rgb.shape[1], rgb.shape[0]), rng)
        paths.append(_write(folder, path.stem, part.cut(rgb)))
        K.append(part.calibration(calibration))
    return Scene(f"{scene.name} zoom-{seed}", tuple(paths), np.array(K), R, C)


def windowed_scene(scene: Scene, folder: Path, boxes: dict[int, F64]) -> Scene:
    """The scene with only a part left of some images: ``boxes`` maps the number of an image to the
    part (left, top, right, bottom) as shares of width and height. The rest is grey, with a soft edge that
    gives no corners; the camera stays what it was."""
    paths = []
    for number, path in enumerate(scene.image_paths):
        rgb = read_rgb(path)
        if number in boxes:
            height, width = rgb.shape[:2]
            left, top, right, bottom = boxes[number]
            weight = np.outer(_ramp(height, top, bottom), _ramp(width, left, right))[..., None]
            rgb = (weight * rgb + (1.0 - weight) * rgb.mean(axis=(0, 1))).astype(np.uint8)
        paths.append(_write(folder, path.stem, rgb))
    return Scene(f"{scene.name} windows", tuple(paths), scene.K, scene.R, scene.C)


def _ramp(length: int, low: float, high: float) -> F64:
    """1 between two shares of a length, and softly 0 outside."""
    x = np.arange(length) + 0.5
    inside = np.minimum(x - low * length, high * length - x)
    return np.asarray(np.clip(inside / FEATHER_PX, 0.0, 1.0))


def _write(folder: Path, stem: str, rgb: U8) -> Path:
    """Write an image unless it is there: its pixels follow from the folder's name."""
    path = folder / f"{stem}.png"
    if not path.is_file():
        write_png(path, rgb)
    return path
