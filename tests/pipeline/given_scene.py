"""Five views of a cloud of points with noise: matches as another program would give them."""

import sqlite3
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon import Camera, Tracks

SIZE = (640, 480)
ANGLES = [[0, -30, 5], [25, -15, 0], [-5, 0, 20], [15, 15, 0], [-20, 25, 5]]


class GivenScene(NamedTuple):
    cameras: list
    X: np.ndarray
    keypoints: list
    matches: dict
    sizes: list
    noise_px: float

    @property
    def tracks(self):
        views, points = len(self.cameras), len(self.X)
        xy = np.concatenate(self.keypoints)
        return Tracks(
            np.repeat(np.arange(views), points), np.tile(np.arange(points), views), xy, views, points
        )


def given_scene(points=200, noise_px=0.3, focal=900.0):
    rng = np.random.default_rng(0)
    K = np.array([[focal, 0, 319.5], [0, focal, 239.5], [0, 0, 1]])
    X = rng.uniform(-1, 1, (points, 3))
    rotations = Rotation.from_euler("xyz", np.radians(ANGLES)).as_matrix()
    cameras = [Camera(K, R, np.array([0, 0, 6.0]), SIZE) for R in rotations]
    keypoints = [camera.project(X) + rng.normal(0, noise_px, (points, 2)) for camera in cameras]
    same = np.repeat(np.arange(points)[:, None], 2, axis=1)
    pairs = {(i, j): same for i in range(5) for j in range(i + 1, 5)}
    return GivenScene(cameras, X, keypoints, pairs, [SIZE] * 5, noise_px)


def write_database(path, keypoints, matches, *, verified):
    """The tables of COLMAP's database that hold keypoints and matches."""
    used, other = ("two_view_geometries", "matches") if verified else ("matches", "two_view_geometries")
    blob = "rows INTEGER, cols INTEGER, data BLOB"
    base = sqlite3.connect(path)
    for table in (
        "cameras (camera_id INTEGER, model INTEGER, width INTEGER, height INTEGER)",
        "images (image_id INTEGER, name TEXT, camera_id INTEGER)", f"keypoints (image_id INTEGER, {blob})",
        f"{used} (pair_id INTEGER PRIMARY KEY, {blob})", f"{other} (pair_id INTEGER PRIMARY KEY, {blob})",
    ):  # fmt: skip
        base.execute(f"CREATE TABLE {table}")
    base.execute("INSERT INTO cameras VALUES (7, 2, 640, 480)")
    for i, xy in enumerate(keypoints):
        # Names in the opposite order of the numbers.
        base.execute("INSERT INTO images VALUES (?, ?, 7)", (i + 1, f"{len(keypoints) + 4 - i}.jpg"))
        data = np.column_stack([xy + 0.5, np.ones((len(xy), 2))]).astype("<f4").tobytes()
        base.execute("INSERT INTO keypoints VALUES (?, ?, 4, ?)", (i + 1, len(xy), data))
    for (i, j), rows in matches.items():
        row = ((i + 1) * (2**31 - 1) + j + 1, len(rows), 2, rows.astype("<u4").tobytes())
        base.execute(f"INSERT INTO {used} VALUES (?, ?, ?, ?)", row)
    base.commit()
    base.close()
    return path
