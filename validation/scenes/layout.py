"""Lay out public data sets as they are downloaded: images and true cameras in one folder, for every command.

What is read as it is, is linked; other truth becomes ``cameras.json``.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.errors import UsageError, counted, unknown_word
from thesisrecon.io._files import read_text, write_text
from validation.scenes.real import SUFFIXES, Scene, read_scene

Read = Callable[[Path, Sequence[Path]], str]


class Layout(NamedTuple):
    """Where a download has its images and its truth: patterns, the first that is there. ``truth`` maps a
    pattern, in the folder or the two above it, to its place in the output, and how its text is made if it is
    not linked.
    """

    about: str
    images: tuple[str, ...]
    truth: dict[str, tuple[str, Read | None]]


def _strecha(folder: Path, images: Sequence[Path]) -> str:
    """NAME.camera: K, a row of zeros, R camera-to-world, centre, width and height."""
    cameras = []
    for image in images:
        rows = _rows(folder / f"{image.name}.camera")
        K, R = (np.array(rows[k : k + 3], dtype=np.float64) for k in (0, 4))
        width, height = (int(word) for word in rows[8][:2])
        camera = {"K": K.tolist(), "R": R.T.tolist(), "C": [float(word) for word in rows[7]]}
        cameras.append({"name": image.name, "width": width, "height": height, **camera})
    return json.dumps({"cameras": cameras}, indent=1)


def _log(file: Path, images: Sequence[Path]) -> str:
    """Trajectory of Tanks and Temples, a line "i i 0" and a 4 x 4 camera-to-world matrix for each image in
    order, as that of TUM with the names of the images.
    """
    poses = np.array([row for row in _rows(file) if len(row) == 4], dtype=np.float64).reshape(-1, 4, 4)
    if len(poses) != len(images):
        raise UsageError(f"{file} has {len(poses)} poses for {counted(len(images), 'image')}")
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    lines = zip(images, poses[:, :3, 3], turns, strict=True)
    return "".join(f"{i.stem} {' '.join(map(repr, [*c.tolist(), *q.tolist()]))}\n" for i, c, q in lines)


def _rows(file: Path) -> list[list[str]]:
    """The words of the lines of a file that are not empty."""
    return [line.split() for line in read_text(file).splitlines() if line.split()]


COLMAP = "sparse/0"
SETS = {
    "strecha": Layout(
        "fountain-P11, Herz-Jesus-P8 and others: images, NAME.camera (Strecha et al. 2008)",
        ("images", "*_dense_images", "*_images", "."),
        {
            "gt_dense_cameras": ("cameras.json", _strecha),
            "*_dense_cameras": ("cameras.json", _strecha),
            "*_cameras": ("cameras.json", _strecha),
            ".": ("cameras.json", _strecha),
        },
    ),
    "eth3d": Layout(
        "a scene with dslr_images_undistorted and dslr_calibration_undistorted (Schöps et al. 2017)",
        ("images/dslr_images_undistorted", "dslr_images_undistorted"),
        {"dslr_calibration_undistorted": (COLMAP, None)},
    ),
    "dtu": Layout(
        "Rectified/scanN under the folder with Calibration/cal18, fourth light (Jensen et al. 2014)",
        ("rect_*_3_r5000.png", "rect_*_max.png"),
        {"Calibration/cal18": ("cal18", None), "cal18": ("cal18", None)},
    ),
    "middlebury-mvs": Layout(
        "temple, templeRing, dino and others: images and NAME_par.txt (Seitz et al. 2006)",
        (".",),
        {"*_par.txt": ("par.txt", None)},
    ),
    "tanks-and-temples": Layout(
        "images and cams/NAME_cam.txt (MVSNet), or NAME_COLMAP_SfM.log and a K.txt of yours beside it, as "
        "the download states no K (Knapitsch et al. 2017)",
        ("images", "images_hr", "."),
        {"cams": ("cams", None), "*_COLMAP_SfM.log": ("groundtruth.txt", _log)},
    ),
    "phototourism": Layout(
        "a scene with dense/images and dense/sparse (Jin et al. 2021)",
        ("dense/images", "images"),
        {"dense/sparse": (COLMAP, None), "sparse": (COLMAP, None)},
    ),
}


def lay_out(name: str, folder: Path, out: Path) -> Scene:
    """Link the images of a download into ``OUT/images`` and place its true cameras beside them.

    Returns the scene as every command reads it. Raises ``UsageError`` if the download lacks a part, or if
    ``out`` holds something.
    """
    if name not in SETS:
        raise UsageError(unknown_word("data set", name, SETS))
    known, folder = SETS[name], folder.resolve()
    images = next((found for pattern in known.images if (found := _images(folder, pattern))), [])
    if not images:
        raise UsageError(f"{folder} has no images in {' or '.join(known.images)}; {name} is {known.about}")
    truth = _truth(folder, known)
    if truth is None:
        raise UsageError(f"{folder} has no truth in {' or '.join(known.truth)}; {name} is {known.about}")
    if out.exists() and any(out.iterdir()):
        raise UsageError(f"{out} is not empty; give a new folder")
    source, (place, made) = truth
    (out / place).parent.mkdir(parents=True, exist_ok=True)
    if made is None:
        _link(source, out / place)
    else:
        try:
            text = made(source, images)
        except (ValueError, IndexError) as error:
            raise UsageError(f"the truth {source} cannot be read: {error}") from None
        write_text(out / place, text)
    (out / "images").mkdir()
    for image in images:
        _link(image, out / "images" / image.name)
    if (K := source.parent / "K.txt").is_file():
        _link(K, out / "K.txt")
    return read_scene(out, out.name)


def _images(folder: Path, pattern: str) -> list[Path]:
    """Images that match a pattern, or that are in the folders that do."""
    found = [folder] if pattern == "." else sorted(folder.glob(pattern))
    every = [file for path in found for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
    return [file for file in every if file.suffix.lower() in SUFFIXES]


def _truth(folder: Path, known: Layout) -> tuple[Path, tuple[str, Read | None]] | None:
    for place in (folder, folder.parent, folder.parent.parent):
        for pattern, how in known.truth.items():
            found = [folder] if pattern == "." else sorted(place.glob(pattern))
            if pattern == "." and not any(folder.glob("*.camera")):
                continue
            if found:
                return found[0], how
    return None


def _link(source: Path, place: Path) -> None:
    """A link, or a copy where the system has none."""
    try:
        place.symlink_to(source.resolve())
    except OSError:
        copy: Any = shutil.copytree if source.is_dir() else shutil.copy2
        copy(source, place)
