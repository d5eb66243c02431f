"""Independent calibration of rendered images with known cameras."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image

from thesisrecon.arrays import F64
from validation.harness.records import Judgement, Outcome, Picture, Plot, ReportOptions, Stage, Task
from validation.metrics.record import Metric
from validation.references.chessboard import board_corners, calibrate_from_corners
from validation.references.libraries import one_thread
from validation.scenes.boards import CORNERS, SIZE, WAYS, Board, K, make_board, photographs

OURS, OWN = "ours", "cv2, stated standard deviation"
BOARDS = "boards"
VIEWS, QUICK_VIEWS = 16, 12
SHOWN = 4
"""Images of each kind on the page."""


class BoardsStage(Stage):
    """``cv2.calibrateCamera`` on rendered boards."""

    name = "boards"
    title = "Calibration of rendered boards"
    definition = (
        "A chessboard rendered with known cameras by the ray caster of the courtyard, by the library's "
        "renderer, and through the library's camera with radial distortion; "
        "lens blur, noise and tone curve are the courtyard's. cv2.findChessboardCorners, cornerSubPix and "
        "calibrateCamera are independent of them. Differences are OpenCV's result minus truth, beside the "
        "standard deviation stated by OpenCV."
    )

    def takes(self, scene: str, options: ReportOptions) -> bool:  # noqa: ARG002 (the same for all)
        return scene == BOARDS

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:  # noqa: ARG002 (the same everywhere)
        return WAYS

    def run(self, task: Task, options: ReportOptions) -> None:
        one_thread()
        board = _board(task.method, options)
        pictures = photographs(task.method, board)
        place = options.place(task.stage, task.scene, task.method)
        for n, picture in enumerate(pictures):
            PIL.Image.fromarray(picture).save(place / f"{n:02d}.png")
        corners = [board_corners(picture, CORNERS) for picture in pictures]
        found = calibrate_from_corners(board.X, corners, SIZE)
        np.savez(place / "found.npz", corners=np.array(corners), K=found.K, k1=found.k1, std=found.std)

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        metrics: list[Metric] = []
        traces: list[dict[str, Any]] = []
        for way, outcome in outcomes.items():
            board = _board(way, options)
            found = _read(outcome) if outcome.ok else None
            metrics += _metrics(scene, way, board, found)
            if found is not None:
                off = (found["corners"] - board.projections()).reshape(-1, 2)
                traces.append(_trace(way, off))
        place, pictures = options.place(self.name, scene), list[Picture]()
        for way, outcome in outcomes.items():
            if outcome.ok:
                file = f"{way.replace(' ', '-')}.png"
                PIL.Image.fromarray(_row(outcome.place)).save(place / file)
                pictures.append(Picture(file, f"By the {way}", "Four of the images."))
        axes = {
            "xaxis": {"title": {"text": "x (px)"}},
            "yaxis": {"title": {"text": "y (px)"}, "scaleanchor": "x"},
        }
        layout = {**axes, "margin": {"l": 60, "r": 10, "t": 10, "b": 50}}
        words = "Each point is a corner: OpenCV's position minus its true projection."
        plots = [Plot("Corner errors", {"data": traces, "layout": layout}, words)] if traces else []
        notes = [f"{name}: {o.failure}." for name, o in outcomes.items() if not o.ok]
        return Judgement(metrics, plots, pictures, notes)


def _board(way: str, options: ReportOptions) -> Board:
    return make_board(way, QUICK_VIEWS if options.quick else VIEWS)


def _read(outcome: Outcome) -> dict[str, F64]:
    with np.load(Path(outcome.place) / "found.npz") as kept:
        return {name: kept[name] for name in kept.files}


def _metrics(scene: str, way: str, board: Board, found: Mapping[str, F64] | None) -> list[Metric]:
    """Return the rows of one renderer: corners, focal length, principal point, distortion."""

    def row(name: str, unit: str, ours: float | None, own: float | None, words: str) -> Metric:
        values = {OURS: ours, OWN: own}
        return Metric(scene, f"{way}: {name}", unit, values, OURS, definition=words)

    if found is None:
        names = (("corners", "px"), ("focal length", "%"), ("principal point", "px"), ("distortion", ""))
        return [row(name, unit, None, None, "") for name, unit in names]
    off = (found["corners"] - board.projections()).reshape(-1, 2)
    focal = np.sqrt(found["K"][0, 0] * found["K"][1, 1])
    std = found["std"]
    scatter = float(np.sqrt(np.mean(np.sum((off - off.mean(axis=0)) ** 2, axis=1)) / len(off)))
    return [
        row(
            "corners",
            "px",
            float(np.linalg.norm(off.mean(axis=0))),
            scatter,
            "length of the mean of (OpenCV corner - true projection); "
            "beside it the standard deviation of that mean",
        ),
        row(
            "focal length",
            "%",
            float(100.0 * abs(focal / K[0, 0] - 1.0)),
            float(100.0 * np.mean(std[:2]) / K[0, 0]),
            "|f / f_true - 1|, f = sqrt(fx fy)",
        ),
        row(
            "principal point",
            "px",
            float(np.linalg.norm(found["K"][:2, 2] - K[:2, 2])),
            float(np.hypot(*std[2:4])),
            "distance from the true one",
        ),
        row(
            "distortion",
            "",
            abs(float(found["k1"]) - board.distortion),
            float(std[4]),
            f"|k1 - true k1|; the true one is {board.distortion:g}",
        ),
    ]


def _row(place: Path) -> np.ndarray[Any, np.dtype[np.uint8]]:
    files = sorted(Path(place).glob("[0-9][0-9].png"))[:SHOWN]
    return np.concatenate([np.asarray(PIL.Image.open(file))[::2, ::2] for file in files], axis=1)


def _trace(way: str, off: F64) -> dict[str, Any]:
    xy = np.round(off, 4)
    marker = {"size": 4, "opacity": 0.6}
    return {
        "type": "scatter",
        "mode": "markers",
        "name": way,
        "x": xy[:, 0].tolist(),
        "y": xy[:, 1].tolist(),
        "marker": marker,
    }
