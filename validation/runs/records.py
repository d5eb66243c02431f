"""Records of a report: options, tasks, outcomes and judgements; its scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from validation.runs.tables import Metric, Plot, slug
from validation.scenes.real import (
    SUFFIXES,
    Scene,
    data_root,
    load_scene,
    read_scene,
    real_folder,
    with_known_cameras,
)
from validation.scenes.stereo import STEREO_PAIRS, stereo_folder


@dataclass(frozen=True)
class ReportOptions:
    """Options of a report: folders of user scenes; ``gates_only`` skips slow references and pictures that no
    gate needs; ``limit_s`` of a task; ``resume``: folder of an earlier run whose references are reused, or
    empty; ``side_px``: long side of depth maps, 0 for the default; ``stages_from``: module of ``STAGES``.
    """

    out: Path
    scenes: tuple[str, ...]
    stages: tuple[str, ...]
    folders: Mapping[str, str] = field(default_factory=dict)
    quick: bool = False
    gates_only: bool = False
    seed: int = 0
    threads: int = 2
    limit_s: float = 300.0
    resume: str = ""
    side_px: int = 0
    stages_from: str = "validation.stages"

    def folder(self, stage: str, scene: str, method: str = "") -> Path:
        """Return the folder of a task, or of all tasks of a stage on a scene."""
        folder = self.out / "data" / stage / scene
        return folder / slug(method) if method else folder

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"out": str(self.out)}

    @classmethod
    def from_json(cls, record: Mapping[str, Any]) -> ReportOptions:
        tuples = {name: tuple(record.get(name, ())) for name in ("scenes", "stages")}
        return cls(**{**record, **tuples, "out": Path(record["out"])})


@dataclass(frozen=True)
class Task:
    """One method of one stage on one scene."""

    stage: str
    scene: str
    method: str


@dataclass(frozen=True)
class Outcome:
    """Outcome of a task: its result folder and resources; ``failure`` is empty or the error message."""

    folder: Path
    failure: str = ""
    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_mb: float = 0.0

    @property
    def ok(self) -> bool:
        return not self.failure


@dataclass(frozen=True)
class Picture:
    """A figure on the page of a scene: a PNG or JPEG ``file`` in the folder of the judgement."""

    file: str
    title: str
    caption: str = ""


@dataclass(frozen=True)
class Judgement:
    """Evaluation of a stage on a scene: numbers first, then plots and figures."""

    metrics: Sequence[Metric]
    notes: Sequence[str] = ()
    plots: Sequence[Plot] = ()
    pictures: Sequence[Picture] = ()


class Stage(Protocol):
    """A stage of the library and its references. ``definition`` states the comparison in one sentence.
    ``takes`` returns whether the stage works on a scene: one of ``scenes``, or with ``own`` a folder of the
    user; ``methods`` the methods there; ``needs`` the (stage, method) results that a method, or the judgement
    (empty ``method``), reads; by default ``always`` and ``required``. ``run`` computes a task and saves its
    result in its ``folder``; ``judge`` reads all results and recomputes every number.
    """

    name: str
    title: str = ""
    definition: str = ""
    scenes: tuple[str, ...] = ()
    own: bool = False
    always: tuple[str, ...] = ()
    required: tuple[tuple[str, str], ...] = ()

    def takes(self, scene: str, options: ReportOptions) -> bool:
        return scene in self.scenes or (self.own and scene in options.folders)

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        return self.always

    def needs(self, method: str) -> tuple[tuple[str, str], ...]:
        return self.required

    def run(self, task: Task, folder: Path, options: ReportOptions) -> None: ...

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement: ...


def read_arrays(outcome: Outcome | None, file: str) -> dict[str, Any] | None:
    """Return the arrays that a task saved, None if it failed."""
    if outcome is None or not outcome.ok:
        return None
    with np.load(Path(outcome.folder) / file) as stored:
        return dict(stored)


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


def load_images(name: str, options: ReportOptions) -> Scene:
    """Return the images of a scene with their truth, if known. A folder of the user holds images, or images/
    with them; its truth are cameras there, of any format, or K alone (:func:`with_known_cameras`).
    Raises ``ValueError`` if a scene has no images.
    """
    if name in options.folders:
        return _own_scene(Path(options.folders[name]), name)
    scene = load_scene(name)
    if scene is None:
        raise ValueError(f"the images of {name} are not on this machine")
    return scene


def _own_scene(folder: Path, name: str) -> Scene:
    if (folder / "images").is_dir():
        scene = read_scene(folder, name)
    else:
        paths = tuple(sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES))
        if not paths:
            raise ValueError(f"there are no images in {folder}")
        scene = with_known_cameras(Scene(name, paths), folder)
    return scene
