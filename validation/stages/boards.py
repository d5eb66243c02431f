"""Independent calibration of rendered images with known cameras."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image

from thesisrecon.arrays import F64, U8
from validation.references.libraries import one_thread
from validation.references.opencv import board_corners, calibrate_from_corners
from validation.runs.records import Judgement, Outcome, Picture, ReportOptions, Stage, Task
from validation.runs.rows import OURS, plot, read_arrays, row, scatter
from validation.runs.tables import Metric
from validation.scenes.boards import CORNERS, SIZE, WAYS, Board, K, board_images, make_board

OWN = "cv2, stated standard deviation"
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

    scenes = ("boards",)

    def methods(self, scene: str, options: ReportOptions) -> tuple[str, ...]:
        return WAYS

    def run(self, task: Task, options: ReportOptions) -> None:
        one_thread()
        board = _board(task.method, options)
        pictures = board_images(task.method, board)
        folder = options.folder(task.stage, task.scene, task.method)
        for n, picture in enumerate(pictures):
            PIL.Image.fromarray(picture).save(folder / f"{n:02d}.png")
        corners = [board_corners(picture, CORNERS) for picture in pictures]
        found = calibrate_from_corners(board.X, corners, SIZE)
        np.savez(folder / "found.npz", corners=np.array(corners), K=found.K, k1=found.k1, std=found.std)

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        folder = options.folder(self.name, scene)
        metrics, traces, pictures = list[Metric](), list[dict[str, Any]](), list[Picture]()
        for way, outcome in outcomes.items():
            board, found = _board(way, options), read_arrays(outcome, "found.npz")
            metrics += _metrics(scene, way, board, found)
            if found is not None:
                off = np.round((found["corners"] - board.projections()).reshape(-1, 2), 4)
                traces.append(scatter(way, *off.T.tolist(), marker={"size": 4, "opacity": 0.6}))
                file = f"{way.replace(' ', '-')}.png"
                PIL.Image.fromarray(_side_by_side(outcome.folder)).save(folder / file)
                pictures.append(Picture(file, f"By the {way}", "Four of the images."))
        text = "Each point is a corner: OpenCV's position minus its true projection."
        equal = {"scaleanchor": "x"}
        plots = [plot("Corner errors", traces, "x (px)", "y (px)", text, yaxis=equal)] if traces else []
        return Judgement(metrics, plots, pictures)


def _board(way: str, options: ReportOptions) -> Board:
    return make_board(way, QUICK_VIEWS if options.quick else VIEWS)


def _metrics(scene: str, way: str, board: Board, found: Mapping[str, F64] | None) -> list[Metric]:
    """Return the rows of one renderer: corners, focal length, principal point, distortion."""

    def number(name: str, unit: str, ours: Any, own: Any, text: str) -> Metric:
        values = {OURS: None if found is None else float(ours), OWN: None if found is None else float(own)}
        # An error and a standard deviation, both of OpenCV: neither is ours or better.
        return row(scene, f"{way}: {name}", unit, values, text, ranked=False)

    if found is None:
        names = (("corners", "px"), ("focal length", "%"), ("principal point", "px"), ("distortion", ""))
        return [number(name, unit, None, None, "") for name, unit in names]
    off = (found["corners"] - board.projections()).reshape(-1, 2)
    focal = np.sqrt(found["K"][0, 0] * found["K"][1, 1])
    std, centre = found["std"], np.linalg.norm(found["K"][:2, 2] - K[:2, 2])
    spread = np.sqrt(np.mean(np.sum((off - off.mean(axis=0)) ** 2, axis=1)) / len(off))
    text = "length of the mean of (OpenCV corner - true projection); beside it the std of that mean"
    off_focal, std_focal = 100.0 * abs(focal / K[0, 0] - 1.0), 100.0 * np.mean(std[:2]) / K[0, 0]
    k1 = f"|k1 - true k1|; the true one is {board.distortion:g}"
    return [
        number("corners", "px", np.linalg.norm(off.mean(axis=0)), spread, text),
        number("focal length", "%", off_focal, std_focal, "|f / f_true - 1|, f = sqrt(fx fy)"),
        number("principal point", "px", centre, np.hypot(*std[2:4]), "distance from the true one"),
        number("distortion", "", abs(float(found["k1"]) - board.distortion), std[4], k1),
    ]


def _side_by_side(folder: Path) -> U8:
    files = sorted(Path(folder).glob("[0-9][0-9].png"))[:SHOWN]
    return np.concatenate([np.asarray(PIL.Image.open(file))[::2, ::2] for file in files], axis=1)
