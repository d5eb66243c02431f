"""What both forms of COLMAP's files share: the refusal of a broken file and the columns of points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thesisrecon.errors import StageFailure
from thesisrecon.io.colmap_model import ColmapPoints

TRACK_ENTRY = np.dtype([("image", "<u4"), ("xy", "<u4")])


def broken_file(path: Path, what: str) -> StageFailure:
    """The refusal of a file with the reason."""
    return StageFailure(f"{path} is not a sound COLMAP file", what, "export the model again")


def points_of_records(
    heads: list[tuple[int | float, ...]], entries: NDArray[np.void], path: Path
) -> ColmapPoints:
    """Columns of points; ``heads`` hold (id, x, y, z, r, g, b, error, track length)."""
    if any(head[0] >= 2**63 for head in heads):
        raise broken_file(path, "a point has a number out of range")
    lengths = np.array([head[8] for head in heads], dtype=np.int64)
    return ColmapPoints(
        ids=np.array([head[0] for head in heads], dtype=np.int64),
        xyz=np.array([head[1:4] for head in heads], dtype=np.float64).reshape(-1, 3),
        rgb=np.array([head[4:7] for head in heads], dtype=np.uint8).reshape(-1, 3),
        error=np.array([head[7] for head in heads], dtype=np.float64),
        track_start=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        track_image=entries["image"].astype(np.int64),
        track_xy=entries["xy"].astype(np.int64),
    )
