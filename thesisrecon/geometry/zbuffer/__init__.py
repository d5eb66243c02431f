"""Which face of a mesh each pixel of a camera sees: a z-buffer, exact in perspective."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from thesisrecon.geometry.pinhole import PinholeCamera
from thesisrecon.geometry.zbuffer.kernels import (
    interpolate_corners,
    interpolate_vertices,
    rasterize_rows,
    sample_texture,
)
from thesisrecon.types import F32, F64, I64

__all__ = ["Raster", "in_strips", "rasterize", "sample_texture"]

NEAR = 1e-6
"""Nearest depth that is drawn, in units of the distance from the camera to the farthest vertex."""


@dataclass(frozen=True)
class Raster:
    """What a camera sees of a mesh before it has colours: ``depth`` (H, W) float32, inf where nothing is;
    ``face`` (H, W) int64, -1 where none; ``weights`` (H, W, 2) float32, the barycentric coordinates of the
    face's corners 1 and 2."""

    depth: F32
    face: I64
    weights: F32

    def interpolate(self, values: F64 | F32) -> F32:
        """Values (M, 3, C) of the corners of all faces, at every pixel (H, W, C); 0 where no face is."""
        out = np.zeros((*self.face.shape, values.shape[2]), dtype=np.float32)
        interpolate_corners(self.face, self.weights, np.ascontiguousarray(values, dtype=np.float32), out)
        return out

    def interpolate_vertices(self, faces: I64, values: F32) -> F32:
        """Values (N, C) of the vertices of the faces (M, 3), at every pixel (H, W, C); 0 where no face is."""
        out = np.zeros((*self.face.shape, values.shape[1]), dtype=np.float32)
        interpolate_vertices(self.face, self.weights, faces, values, out)
        return out

    def rows(self, first: int, last: int) -> Raster:
        """Rows [first, last) alone."""
        return Raster(self.depth[first:last], self.face[first:last], self.weights[first:last])


def rasterize(vertices: F64, faces: I64, camera: PinholeCamera, *, threads: int = 1) -> Raster:
    """Which face is seen at the centre of each pixel.

    ``vertices`` (N, 3), ``faces`` (M, 3); both sides of a face are seen. ``threads`` draw strips of rows: the
    result is the same whatever their number.
    """
    width, height = camera.size
    seen = (vertices @ camera.R.T + camera.t) @ (camera.K / camera.K[2, 2]).T
    corners = np.ascontiguousarray(seen[faces])
    near = NEAR * max(float(np.abs(seen[:, 2]).max(initial=0.0)), 1e-300)
    depth = np.full((height, width), np.inf, dtype=np.float32)
    face = np.full((height, width), -1, dtype=np.int64)
    weights = np.zeros((height, width, 2), dtype=np.float32)

    def draw(rows: tuple[int, int]) -> None:
        rasterize_rows(corners, near, rows, depth, face, weights)

    in_strips(draw, height, threads)
    return Raster(depth, face, weights)


def in_strips(work: Callable[[tuple[int, int]], None], height: int, threads: int) -> None:
    """Call ``work`` with the first and last + 1 row of as many strips as there are threads, one in each."""
    edges = np.linspace(0, height, max(threads, 1) + 1).round().astype(int)
    strips = [(int(a), int(b)) for a, b in pairwise(edges)]
    if len(strips) == 1:
        work(strips[0])
        return
    with ThreadPoolExecutor(len(strips)) as pool:
        list(pool.map(work, strips))
