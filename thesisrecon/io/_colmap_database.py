"""Keypoints and matches of a COLMAP database (SQLite)."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import UsageError

_MAX_IMAGES = 2**31 - 1
"""COLMAP numbers the pair of images a < b as a times this plus b."""


@dataclass(frozen=True)
class Database:
    """V images by name: sizes (V, 2), keypoints (N_i, 2) in our pixels, and matches (i, j) -> rows (M, 2)."""

    names: list[str]
    sizes: I64
    keypoints: Sequence[F64]
    matches: dict[tuple[int, int], I64]


def read_database(path: Path) -> Database:
    """Read the keypoints and the verified matches, or the raw matches if none are verified."""
    if not path.is_file():
        raise UsageError(f"there is no COLMAP database or model at {path}")
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as base:
            return _read(base, path)
    except (sqlite3.Error, ValueError, TypeError, KeyError) as error:
        raise UsageError(f"{path} is not a COLMAP database: {error}") from None


def _read(base: sqlite3.Connection, path: Path) -> Database:
    columns = "SELECT image_id, name, width, height FROM images JOIN cameras USING (camera_id) ORDER BY name"
    images = base.execute(columns).fetchall()
    number = {row[0]: i for i, row in enumerate(images)}
    keypoints = [np.zeros((0, 2)) for _ in images]
    for image, rows, cols, data in base.execute("SELECT image_id, rows, cols, data FROM keypoints"):
        if rows and image in number:
            # The centre of COLMAP's top-left pixel is (0.5, 0.5).
            values = np.frombuffer(data, dtype="<f4").reshape(rows, cols)[:, :2]
            keypoints[number[image]] = values.astype(np.float64) - 0.5
    for table in ("two_view_geometries", "matches"):
        found: dict[tuple[int, int], I64] = {}
        for pair, rows, data in base.execute(f"SELECT pair_id, rows, data FROM {table} WHERE rows > 0"):
            i, j = (number[image] for image in divmod(pair, _MAX_IMAGES))
            found[i, j] = np.frombuffer(data, dtype="<u4").reshape(rows, 2).astype(np.int64)
        if found:
            sizes = np.array([row[2:] for row in images], dtype=np.int64)
            return Database([row[1] for row in images], sizes, keypoints, found)
    raise UsageError(f"{path} holds no matches; run COLMAP's matcher first")
