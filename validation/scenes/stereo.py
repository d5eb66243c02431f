"""Rectified pairs with dense truth, and which of their pixels both cameras see."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from thesisrecon.arrays import B8, F32, U8
from validation.scenes.many_views import stereo_yard_folder, yard_number
from validation.scenes.real import data_root, read_rgb

STEREO_PAIRS = ("Tsukuba", "Teddy", "Cones", "Motorcycle")


@dataclass(frozen=True)
class StereoPair:
    """``left, right`` (H, W, 3), ``truth`` (H, W) disparity of the left image, NaN where there is none,
    ``judged`` (H, W) pixels that have truth and are seen by both cameras; the range is
    0 .. ``disparities`` - 1.
    """

    name: str
    left: U8
    right: U8
    truth: F32
    judged: B8
    disparities: int


def stereo_folder(name: str) -> Path | None:
    """Return the folder of one of ``STEREO_PAIRS``, or None if missing."""
    if name == "Motorcycle":
        found = importlib.util.find_spec("skimage")
        place = None if found is None or found.origin is None else Path(found.origin).parent / "data"
        return place if place is not None and (place / "motorcycle_disp.npz").is_file() else None
    root = data_root()
    folder = None if root is None else root / "stereo" / ("Cones9" if name == "Cones" else name)
    return folder if folder is not None and folder.is_dir() else None


def load_stereo_pair(name: str) -> StereoPair | None:
    """One of ``STEREO_PAIRS``, None if its files are not on this machine; or a rendered yard, "yard-N"."""
    yard = yard_number(name)
    if yard is not None:
        return _yard(stereo_yard_folder(yard), name)
    folder = stereo_folder(name)
    if folder is None:
        return None
    if name == "Motorcycle":
        return _motorcycle(folder)
    if name == "Cones":
        truth, other = (read_disparity(folder / f"disp{k}.png", 4.0) for k in (2, 6))
        judged = seen_by_both(truth, other)
        return StereoPair(name, read_rgb(folder / "im2.png"), read_rgb(folder / "im6.png"), truth, judged, 64)
    truth = read_disparity(folder / "disparity.png", 16.0 if name == "Tsukuba" else 4.0)
    left, right = read_rgb(folder / "left.png"), read_rgb(folder / "right.png")
    return StereoPair(name, left, right, truth, seen_by_both(truth, None), 16 if name == "Tsukuba" else 64)


def seen_by_both(truth: F32, other: F32 | None) -> B8:
    """(H, W) pixels whose partner has the same disparity, to a pixel."""
    height, width = truth.shape
    rows, columns = np.mgrid[0:height, 0:width]
    known = np.isfinite(truth)
    partner = np.rint(columns - np.where(known, truth, 0.0)).astype(np.int64)
    inside = known & (partner >= 0)
    if other is None:
        other = np.full(truth.shape, -np.inf, np.float32)
        np.maximum.at(other, (rows[inside], partner[inside]), truth[inside])
    with np.errstate(invalid="ignore"):
        same = np.abs(other[rows, np.maximum(partner, 0)] - truth) <= 1.0
    judged: B8 = inside & same
    return judged


def _motorcycle(folder: Path) -> StereoPair:
    stored = np.load(folder / "motorcycle_disp.npz")["arr_0"].astype(np.float32)
    truth = np.where(np.isfinite(stored), stored, np.float32(np.nan)).astype(np.float32)
    left, right = (read_rgb(folder / f"motorcycle_{side}.png") for side in ("left", "right"))
    return StereoPair("Motorcycle", left, right, truth, seen_by_both(truth, None), 64)


def _yard(folder: Path, name: str) -> StereoPair:
    left, right = (read_rgb(folder / f"{side}.png") for side in ("left", "right"))
    truth, other = np.load(folder / "disparity.npy")
    return StereoPair(
        name, left, right, truth, seen_by_both(truth, other), int(np.ceil(np.nanmax(truth))) + 2
    )


def read_disparity(path: Path, scale: float) -> F32:
    """Disparities (H, W) of a grey image that holds them times ``scale``; 0 is unknown."""
    values = np.asarray(Image.open(path).convert("L")).astype(np.float32)
    return np.where(values > 0.0, values / np.float32(scale), np.float32(np.nan)).astype(np.float32)
