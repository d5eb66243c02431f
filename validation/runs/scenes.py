"""Names and kinds of the scenes of a report."""

from __future__ import annotations

from pathlib import Path

from validation.metrics.cameras import TrueCameras
from validation.runs.records import ReportOptions
from validation.scenes.real import (
    SUFFIXES,
    Scene,
    data_root,
    load_scene,
    read_scene,
    real_folder,
    with_truth,
)
from validation.scenes.stereo import STEREO_PAIRS, stereo_folder

IMAGE_SCENES = ("courtyard", "fountain-P11", "Herz-Jesus-P8", "kermit")
QUICK = ("courtyard", "boards", "cloud", "street", "Tsukuba")
SYNTHETIC = ("boards", "cloud", "street")
"""Synthetic scenes: images of a chessboard, points seen by a few cameras, a walk of cameras."""


def available_scenes(*, quick: bool) -> tuple[str, ...]:
    """Return the scenes whose files are on this machine."""
    root = data_root()
    found = [name for name in IMAGE_SCENES if name == "courtyard" or real_folder(name) is not None]
    found += [name for name in STEREO_PAIRS if stereo_folder(name) is not None]
    found += SYNTHETIC
    if root is not None and (root / "kusvod2").is_dir():
        found.append("kusvod2")
    return tuple(name for name in found if not quick or name in QUICK)


def has_images(name: str, options: ReportOptions) -> bool:
    """Return whether a scene is a set of images of one scene."""
    return name in IMAGE_SCENES or name in options.folders


def load_images(name: str, options: ReportOptions) -> Scene:
    """Return the images of a scene with their truth, if known.

    A folder of the user holds images, or images/ with them; its truth is ``cameras.json`` in the folder
    (as in fixtures) or a COLMAP model in ``sparse/0``. Raises ``ValueError`` if a scene has no images.
    """
    if name in options.folders:
        return _own_scene(Path(options.folders[name]), name)
    scene = load_scene(name)
    if scene is None:
        raise ValueError(f"the images of {name} are not on this machine")
    return scene


def truth_of(scene: Scene) -> TrueCameras | None:
    """Return the true cameras of a scene, or None."""
    return TrueCameras(*scene.cameras) if scene.has_truth else None


def _own_scene(folder: Path, name: str) -> Scene:
    if (folder / "images").is_dir():
        scene = read_scene(folder, name)
    else:
        paths = tuple(sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES))
        if not paths:
            raise ValueError(f"there are no images in {folder}")
        scene = Scene(name, paths)
        if (folder / "cameras.json").is_file():
            scene = with_truth(scene, folder / "cameras.json")
    model = folder / "sparse" / "0"
    return scene if scene.has_truth or not model.is_dir() else with_truth(scene, model, complete=False)
