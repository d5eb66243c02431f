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
    """Images (H, W, 3), ``truth`` (H, W) disparity of the left one, NaN where there is none, ``judged``
    pixels that have truth and are seen by both cameras; the range is 0 .. ``disparities`` - 1.
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
    folder = stereo_folder(name) if yard is None else stereo_yard_folder(yard)
    if folder is None:
        return None
    files, other, disparities = ("left.png", "right.png"), None, 64
    if yard is not None:
        truth, other = np.load(folder / "disparity.npy")
        disparities = int(np.ceil(np.nanmax(truth))) + 2
    elif name == "Motorcycle":
        files = ("motorcycle_left.png", "motorcycle_right.png")
        truth = np.load(folder / "motorcycle_disp.npz")["arr_0"].astype(np.float32)
        truth = np.where(np.isfinite(truth), truth, np.float32(np.nan))
    elif name == "Cones":
        files = ("im2.png", "im6.png")
        truth, other = (read_disparity(folder / f"disp{k}.png", 4.0) for k in (2, 6))
    else:
        scale, disparities = (16.0, 16) if name == "Tsukuba" else (4.0, 64)
        truth = read_disparity(folder / "disparity.png", scale)
    left, right = (read_rgb(folder / file) for file in files)
    return StereoPair(name, left, right, truth, seen_by_both(truth, other), disparities)


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


def read_disparity(path: Path, scale: float) -> F32:
    """Disparities (H, W) of a grey image that holds them times ``scale``; 0 is unknown."""
    values = np.asarray(Image.open(path).convert("L")).astype(np.float32)
    return np.where(values > 0.0, values / np.float32(scale), np.float32(np.nan)).astype(np.float32)
