"""Images with ground truth by name: the fixtures and the public data sets."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.io._files import read_json

ROOT = Path(__file__).resolve().parents[2]
REAL_SCENES = {
    "fountain-P11": "strecha/fountain-P11",
    "Herz-Jesus-P8": "strecha/Herz-Jesus-P8",
    "kermit": "kermit",
}
SUFFIXES = {".jpg", ".jpeg", ".png"}


@dataclass(frozen=True)
class Scene:
    """A set of images, sorted by name, and its truth where there is one.

    ``K``, ``R`` (world-to-camera) (V, 3, 3) and ``C`` (V, 3) camera centres in metres, all None without
    truth.
    """

    name: str
    image_paths: tuple[Path, ...]
    K: F64 | None = None
    R: F64 | None = None
    C: F64 | None = None

    @property
    def has_truth(self) -> bool:
        """Return whether the cameras are known."""
        return self.C is not None

    @property
    def cameras(self) -> tuple[F64, F64, F64]:
        """Return K, R and C; ``ValueError`` if they are not known."""
        if self.K is None or self.R is None or self.C is None:
            raise ValueError(f"the cameras of {self.name} are not known")
        return self.K, self.R, self.C


def data_root() -> Path | None:
    """The folder of real images: THESISRECON_DATA, else ../shared/data beside the repository, None when
    absent."""
    named = os.environ.get("THESISRECON_DATA")
    folder = Path(named) if named else ROOT.parent / "shared" / "data"
    return folder if folder.is_dir() else None


def read_scene(folder: Path, name: str) -> Scene:
    """A folder with images/ and perhaps cameras.json.

    Raises ``ValueError`` if there are no images, or cameras.json lacks one of them or is damaged.
    """
    images = folder / "images"
    found = sorted(images.iterdir(), key=lambda p: p.name) if images.is_dir() else []
    paths = tuple(p for p in found if p.suffix.lower() in SUFFIXES)
    if not paths:
        raise ValueError(f"a scene needs images in images/; {folder} has none")
    truth = folder / "cameras.json"
    if not truth.is_file():
        return Scene(name, paths)
    record = read_json(truth)
    cameras = record.get("cameras") if isinstance(record, dict) else None
    if not isinstance(cameras, dict):
        raise ValueError(f"{truth} must hold cameras, a table of images by their names")
    missing = [p.name for p in paths if p.name not in cameras]
    if missing:
        raise ValueError(f"cameras.json must name every image; it lacks {missing} of {folder}")
    return Scene(name, paths, *(_numbers(truth, cameras, paths, key) for key in ("K", "R", "C")))


def _numbers(truth: Path, cameras: dict[str, Any], paths: Sequence[Path], key: str) -> F64:
    """K, R (V, 3, 3) or C (V, 3) of the images."""
    shape = (len(paths), 3) if key == "C" else (len(paths), 3, 3)
    try:
        numbers = np.array([cameras[path.name][key] for path in paths], dtype=np.float64)
    except (TypeError, KeyError, ValueError, OverflowError):
        numbers = np.zeros(0)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise ValueError(f"{truth} must give every image a finite {key} {shape[1:]}")
    return numbers


def real_folder(name: str) -> Path | None:
    """Return the folder of one of ``REAL_SCENES``, or None if missing.

    Raises ``ValueError`` for a name that is none of them.
    """
    if name not in REAL_SCENES:
        raise ValueError(f"a real scene is one of {sorted(REAL_SCENES)}; got {name!r}")
    root = data_root()
    folder = None if root is None else root / REAL_SCENES[name]
    return folder if folder is not None and folder.is_dir() else None


def load_real_scene(name: str) -> Scene | None:
    """One of ``REAL_SCENES``, or None; as :func:`real_folder`."""
    folder = real_folder(name)
    return None if folder is None else read_scene(folder, name)


def load_fixture_scene(name: str = "courtyard") -> Scene:
    """A scene of fixtures/, always there. Raises ``ValueError`` for a name that does not exist."""
    return read_scene(ROOT / "fixtures" / name, name)


@cache
def load_fixture_depth(view: int, name: str = "courtyard") -> tuple[F64, int]:
    """True depth (H / stride, W / stride) of one view in metres, NaN where nothing was hit, and the stride.

    Sample (r, c) is the depth (z in the camera frame) at pixel (x, y) = (stride c, stride r).
    """
    from PIL import Image as PillowImage

    folder = ROOT / "fixtures" / name
    record = json.loads((folder / "cameras.json").read_text(encoding="utf-8"))["depth"]
    with PillowImage.open(folder / "depth" / f"{view:04d}.png") as image:
        steps = np.asarray(image, dtype=np.float64)
    depth = np.where(steps == record["none"], np.nan, steps * record["unit_m"])
    # Every caller gets the same array.
    depth.flags.writeable = False
    return depth, int(record["stride"])
