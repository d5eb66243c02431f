"""Independent calibration of rendered images with known cameras."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import PIL.Image
from scipy.ndimage import map_coordinates

from thesisrecon.api.views import render
from thesisrecon.arrays import F32, F64, U8
from thesisrecon.camera import Camera, project_camera
from thesisrecon.lens import undistort
from thesisrecon.records import TexturedMesh
from validation.references.libraries import one_thread
from validation.references.opencv import board_corners, calibrate_from_corners
from validation.runs.records import Judgement, Outcome, Picture, ReportOptions, Stage, Task, read_arrays
from validation.runs.tables import OURS, Metric, Values, plot, row, scatter, slug
from validation.scenes.materials import Material
from validation.scenes.pose import Pose, look_at
from validation.scenes.raycast import Surface, build_world, trace
from validation.scenes.sensor import Sensor, expose, integrate_pixels

SIZE = (640, 480)
K = np.array([[612.4, 0.0, 327.3], [0.0, 612.4, 233.6], [0.0, 0.0, 1.0]])
K1 = -0.12
CORNERS = (9, 6)  # Inner corners along and across
SQUARE_M = 0.03
MARGIN = 2  # Squares of white around the board
TEXELS = 12  # Side of a square (m)
DARK, LIGHT = 0.05, 0.62
PER_PIXEL = 2
SENSOR = Sensor(vignetting=0.0)
RAYCAST, RENDERED, LENS = "ray caster", "renderer", "lens"
WAYS = (RAYCAST, RENDERED, LENS)


class Board(NamedTuple):
    """Inner corners ``X`` (N, 3) in metres, row by row; cameras R (V, 3, 3), t (V, 3); k1."""

    X: F64
    R: F64
    t: F64
    distortion: float = 0.0

    def projections(self) -> F64:
        """(V, N, 2) true pixels of the corners."""
        poses = zip(self.R, self.t, strict=True)
        return np.array([project_camera(K, R, t, self.X, distortion=self.distortion) for R, t in poses])


def make_board(way: str, views: int) -> Board:
    """The board before ``views`` cameras that look at it from all sides, tilted up to 45 degrees."""
    columns, rows = CORNERS
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    X = np.stack([SQUARE_M * x.ravel(), SQUARE_M * y.ravel(), np.zeros(x.size)], axis=1)
    middle = X.mean(axis=0)
    rng = np.random.default_rng(20)
    poses = []
    for n in range(views):
        turn, tilt = 2.0 * np.pi * n / views, np.radians(15.0 + 10.0 * (n % 4))
        away = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])
        centre = middle + (0.42 + 0.05 * (n % 3)) * away
        aim = middle + np.append(rng.uniform(-0.035, 0.035, 2), 0.0)
        # Cameras of this project's fixtures stand upright in a world whose z is up; here up is -y.
        world = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
        R = look_at(world @ centre, world @ aim, rng.uniform(-0.1, 0.1)) @ world
        poses.append((R, -R @ centre))
    R, t = (np.array(part) for part in zip(*poses, strict=True))
    return Board(X, R, t, K1 if way == LENS else 0.0)


def board_images(way: str, board: Board) -> list[U8]:
    """(480, 640, 3) images, each of a camera of the board; the noise is that of the courtyard's sensor."""
    views = {RAYCAST: _raycast, RENDERED: _rendered, LENS: _through_a_lens}[way](board)
    light = (integrate_pixels(samples, PER_PIXEL, SENSOR.blur_px) for samples in views)
    rng = np.random.default_rng(7)
    return [expose(one, SENSOR, gains=(1.0, 1.0, 1.0), rng=rng) for one in light]


def _pattern() -> F32:
    """(H, W) light of the board by texels: the first inner corner is ``_FIRST`` texels from its edge."""
    columns, rows = (n + 1 for n in CORNERS)
    black = np.indices((rows, columns)).sum(axis=0) % 2 == 0
    squares = np.pad(np.where(black, DARK, LIGHT), MARGIN, constant_values=LIGHT)
    return np.kron(squares, np.ones((TEXELS, TEXELS))).astype(np.float32)


FIRST = (MARGIN + 1) * TEXELS - 0.5
"""Texel at which the first inner corner lies, both ways: between two samples."""
TEXEL_M = SQUARE_M / TEXELS


def _raycast(board: Board) -> Iterator[F32]:
    pattern = _pattern()
    # u x v is the normal, which looks at the cameras, along -z: u runs along y, v along x.
    rgb = np.repeat(np.ascontiguousarray(pattern.T)[..., None], 3, axis=2)
    material = Material(rgb, np.zeros(rgb.shape[:2], np.float32), TEXEL_M)
    corner = -FIRST * TEXEL_M * np.array([1.0, 1.0, 0.0])
    size = ((pattern.shape[0] - 1) * TEXEL_M, (pattern.shape[1] - 1) * TEXEL_M)
    plane = Surface(corner, np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]), size, 0, flat=True)
    world = build_world([[plane]], [material], np.array([0.0, 0.0, -1.0]))
    for R, t in zip(board.R, board.t, strict=True):
        yield trace(world, Pose(K, R, -R.T @ t), SIZE, per_pixel=PER_PIXEL)[0]


def _rendered(board: Board) -> Iterator[F32]:
    pattern = _pattern()
    height, width = pattern.shape
    u, v = np.array([0.0, width - 1.0, width - 1.0, 0.0]), np.array([0.0, 0.0, height - 1.0, height - 1.0])
    vertices = np.stack([(u - FIRST) * TEXEL_M, (v - FIRST) * TEXEL_M, np.zeros(4)], axis=1)
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    texture = np.repeat(np.rint(255.0 * pattern).astype(np.uint8)[..., None], 3, axis=2)
    mesh = TexturedMesh(vertices, faces, uv=np.stack([u, v], axis=1)[faces], texture=texture)
    for R, t in zip(board.R, board.t, strict=True):
        camera = Camera(K, R, t, SIZE).scaled(PER_PIXEL)
        yield render(mesh, camera, samples=1).color.astype(np.float32) / np.float32(255.0)


def _through_a_lens(board: Board) -> Iterator[F32]:
    y, x = (np.indices((SIZE[1] * PER_PIXEL, SIZE[0] * PER_PIXEL)) + 0.5) / PER_PIXEL - 0.5
    bent = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]], axis=-1).reshape(-1, 2)
    rays = np.column_stack([undistort(bent, board.distortion), np.ones(len(bent))])
    pattern = _pattern()
    for R, t in zip(board.R, board.t, strict=True):
        centre, direction = -R.T @ t, rays @ R
        place = centre[:2] - direction[:, :2] * (centre[2] / direction[:, 2:])
        at = (place / TEXEL_M + FIRST).T[::-1]
        grey = map_coordinates(pattern, at, order=1, cval=0.0).astype(np.float32).reshape(x.shape)
        yield np.repeat(grey[..., None], 3, axis=2)


VIEWS, QUICK_VIEWS = 16, 12


class BoardsStage(Stage):
    """``cv2.calibrateCamera`` on rendered boards."""

    name = "boards"
    always = WAYS

    scenes = ("boards",)

    def run(self, task: Task, folder: Path, options: ReportOptions) -> None:
        one_thread()
        board = _board(task.method, options)
        pictures = board_images(task.method, board)
        beside = np.concatenate([picture[::2, ::2] for picture in pictures[:4]], axis=1)
        PIL.Image.fromarray(beside).save(folder / "boards.png")
        corners = [board_corners(picture, CORNERS) for picture in pictures]
        K, k1, std = calibrate_from_corners(board.X, corners, SIZE)
        np.savez(folder / "found.npz", corners=np.array(corners), K=K, k1=k1, std=std)

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        metrics, traces, pictures = list[Metric](), list[dict[str, Any]](), list[Picture]()
        for way, outcome in outcomes.items():
            board, found = _board(way, options), read_arrays(outcome, "found.npz")
            if found is not None:
                metrics += _metrics(scene, way, board, found)
                off = np.round((found["corners"] - board.projections()).reshape(-1, 2), 4)
                traces.append(scatter(way, *off.T.tolist(), marker={"size": 4, "opacity": 0.6}))
                pictures.append(Picture(f"{slug(way)}/boards.png", f"By the {way}", "Four of the images."))
        text = "Each point is a corner: OpenCV's position minus its true projection."
        equal = {"scaleanchor": "x"}
        plots = [plot("Corner errors", traces, "x (px)", "y (px)", text, yaxis=equal)] if traces else []
        return Judgement(metrics, plots=plots, pictures=pictures)


def _board(way: str, options: ReportOptions) -> Board:
    return make_board(way, QUICK_VIEWS if options.quick else VIEWS)


def _metrics(scene: str, way: str, board: Board, found: Mapping[str, F64]) -> list[Metric]:
    """Return the rows of one renderer: corners, focal length, principal point, distortion."""

    def number(name: str, unit: str, ours: Any, own: Any, text: str) -> Metric:
        # An error and a standard deviation, both of OpenCV: neither is ours or better.
        values: Values = {OURS: float(ours), "cv2, stated standard deviation": float(own)}
        return row(scene, f"{way}: {name}", unit, values, text, ranked=False)

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
