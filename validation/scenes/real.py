"""Images with ground truth by name: the fixtures and the public data sets."""

from __future__ import annotations

import io
import json
import os
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image as PillowImage

from thesisrecon import sample
from thesisrecon.api.models import paired_cameras
from thesisrecon.arrays import B8, F64, U8
from thesisrecon.errors import UsageError, shortened
from thesisrecon.io._files import write_atomically
from thesisrecon.io._models import read_calibration, read_model
from thesisrecon.results import SparseModel, SparseView

ROOT = Path(__file__).resolve().parents[2]
REAL_SCENES = {
    "fountain-P11": "strecha/fountain-P11",
    "Herz-Jesus-P8": "strecha/Herz-Jesus-P8",
    "kermit": "kermit",
}
TURNTABLE_SCENES = {"temple": "truth/temple", "lego": "truth/lego"}
"""Larger sets with truth, which only some studies use."""
FOLDERS = REAL_SCENES | TURNTABLE_SCENES
SUFFIXES = {".jpg", ".jpeg", ".png"}


@dataclass(frozen=True)
class Scene:
    """A set of images, sorted by name, and its truth where there is one: ``K``, ``R`` (world-to-camera)
    (V, 3, 3) and ``C`` (V, 3) camera centres in metres; poses without K are a truth, too. Rows of images
    whose camera is not known are NaN.
    """

    name: str
    image_paths: tuple[Path, ...]
    K: F64 | None = None
    R: F64 | None = None
    C: F64 | None = None

    @property
    def has_truth(self) -> bool:
        """Return whether all cameras are known, with K."""
        return self.K is not None and bool(self.known.all() and np.isfinite(self.K).all())

    @property
    def known(self) -> B8:
        """Whether the pose of each image is known (V,)."""
        if self.C is None:
            return np.zeros(len(self.image_paths), dtype=bool)
        return np.asarray(np.isfinite(self.C).all(axis=1))

    @property
    def truth(self) -> tuple[F64, F64, F64] | None:
        """Return K, R and C, None without poses; K is NaN if it is not known."""
        return None if self.R is None else self.cameras_of(range(len(self.image_paths)))

    def cameras_of(self, views: Sequence[int]) -> tuple[F64, F64, F64]:
        """K, R and C of some images, NaN where one is not known."""
        unknown, chosen = np.full((len(self.image_paths), 3, 3), np.nan), list(views)
        K, R = (unknown if part is None else part for part in (self.K, self.R))
        C = unknown[..., 0] if self.C is None else self.C
        return K[chosen], R[chosen], C[chosen]

    @property
    def cameras(self) -> tuple[F64, F64, F64]:
        """Return K, R and C; ``ValueError`` if one is not known."""
        if self.truth is None or not self.has_truth:
            raise ValueError(f"the cameras of {self.name} are not known")
        return self.truth


def cache_folder(name: str) -> Path:
    """A folder of the user's cache for rendered scenes and reference matches; THESISRECON_CACHE moves it.

    The system's temporary folder may be emptied while a study runs.
    """
    named = os.environ.get("THESISRECON_CACHE") or os.environ.get("XDG_CACHE_HOME")
    try:
        return Path(named or Path.home() / ".cache") / "thesisrecon" / name
    except RuntimeError:  # No home, as in a container
        return Path(tempfile.gettempdir()) / f"thesisrecon-{os.getuid()}" / name


def data_root() -> Path | None:
    """The folder of real images: THESISRECON_DATA, else ../shared/data; None when absent."""
    named = os.environ.get("THESISRECON_DATA")
    folder = Path(named) if named else ROOT.parent / "shared" / "data"
    return folder if folder.is_dir() else None


def read_scene(folder: Path, name: str) -> Scene:
    """A folder with images/ and perhaps cameras.json."""
    images = folder / "images"
    found = sorted(images.iterdir(), key=lambda p: p.name) if images.is_dir() else []
    paths = tuple(p for p in found if p.suffix.lower() in SUFFIXES)
    if not paths:
        raise ValueError(f"a scene needs images in images/; {folder} has none")
    return with_known_cameras(Scene(name, paths), folder)


def with_known_cameras(scene: Scene, folder: Path) -> Scene:
    """The scene with the truth that its folder holds: cameras of any format, or K.txt alone."""
    truth = truth_beside(folder)
    return with_calibration(scene, folder / "K.txt") if truth is None else with_truth(scene, truth)


TRUTHS = (
    *("cameras.json", "transforms.json", "par.txt", "*_par.txt", "camchain.yaml", "sparse/0", "sparse"),
    *("dslr_calibration_undistorted", "cams", "cameras", "cal18", "groundtruth.txt", "poses.txt"),
)


def truth_beside(folder: Path) -> Path | None:
    """The first model of true cameras in a folder of images, by its usual name, of any format."""
    found = (path for pattern in TRUTHS for path in sorted(folder.glob(pattern)))
    return next((path for path in found if path.is_file() or any(path.iterdir())), None)


def with_truth(scene: Scene, model: Path) -> Scene:
    """The scene with the cameras of a model as its truth, paired as :func:`thesisrecon.compare_models` does.

    A file K.txt (3 x 3) beside it gives K to poses. Raises ``ValueError`` if the model has no image of the
    scene.
    """
    found, paths = read_model(model), scene.image_paths
    # Images have K, so that only trajectories are paired by time or order.
    images = SparseModel([SparseView(path.name, np.eye(3), np.zeros(3), np.eye(3)) for path in paths])
    try:
        pairs = paired_cameras(images, found, [])
    except UsageError as error:
        few, other = (shortened(", ".join(m.names[:3])) for m in (images, found))
        text = f"{model} has a camera of no image of {scene.name}: {other} there, {few} here"
        raise ValueError(text) from error
    K, R = (np.full((len(paths), 3, 3), np.nan) for _ in range(2))
    C, common = R[..., 0].copy(), _calibration_beside(model)
    for n, k in pairs:
        view = found.views[k]
        R[n], C[n] = view.R, view.centre
        if (own := view.K if view.K is not None else common) is not None:
            K[n] = own
    return replace(scene, K=K if np.isfinite(K).any() else None, R=R, C=C)


def _calibration_beside(model: Path) -> F64 | None:
    """K of a file K.txt in the folder of a model."""
    file = model.parent / "K.txt"
    if (K := read_calibration(file)) is None and file.is_file():
        raise ValueError(f"{file} must hold the 3 x 3 numbers of K")
    return K


def with_calibration(scene: Scene, file: Path) -> Scene:
    """The scene with one K of all images as its truth, and no poses."""
    K = _calibration_beside(file)
    return scene if K is None else replace(scene, K=np.tile(K, (len(scene.image_paths), 1, 1)))


def real_folder(name: str) -> Path | None:
    """Return the folder of one of ``FOLDERS``, or None if missing."""
    root = data_root()
    folder = None if root is None else root / FOLDERS[name]
    return folder if folder is not None and folder.is_dir() else None


def load_fixture_scene(name: str = "courtyard") -> Scene:
    """A scene of fixtures/, always there. Raises ``ValueError`` for a name that does not exist."""
    return read_scene(sample(name), name)


def load_scene(name: str) -> Scene | None:
    """Load a fixture or a real scene; None if its images are not on this machine."""
    if name not in FOLDERS:
        return load_fixture_scene(name)
    folder = real_folder(name)
    return None if folder is None else read_scene(folder, name)


def scenes_here(names: Iterable[str]) -> list[Scene]:
    """Load the scenes that are on this machine; the others are named on the error stream."""
    found = []
    for name in names:
        scene = load_scene(name)
        if scene is None:
            print(f"{name}: its images are not on this machine, left out", file=sys.stderr)
        else:
            found.append(scene)
    return found


@cache
def load_fixture_depth(view: int, name: str = "courtyard") -> tuple[F64, int]:
    """True depth (H / stride, W / stride) of one view in metres, NaN where nothing was hit, and the stride.
    Sample (r, c) is the depth (z in the camera frame) at pixel (x, y) = (stride c, stride r).
    """
    folder = sample(name)
    record = json.loads((folder / "cameras.json").read_text(encoding="utf-8"))["depth"]
    with PillowImage.open(folder / "depth" / f"{view:04d}.png") as image:
        steps = np.asarray(image, dtype=np.float64)
    depth = np.where(steps == record["none"], np.nan, steps * record["unit_m"])
    # Every caller gets the same array.
    depth.flags.writeable = False
    return depth, int(record["stride"])


def read_rgb(path: Path) -> U8:
    """Read an image (H, W, 3)."""
    with PillowImage.open(path) as image:
        return np.asarray(image.convert("RGB"))


def write_png(path: Path, rgb: U8) -> None:
    """Write an image at once or not at all."""
    sink = io.BytesIO()
    PillowImage.fromarray(rgb).save(sink, "PNG", compress_level=1)
    write_atomically(path, sink.getvalue())
