"""Differences between photographs taken out where their pieces meet (Lempitsky and Ivanov 2007).

To every vertex of every chart belongs a correction of its colour: along seams the corrections make up for
what the photographs differ by, within a chart they change as slowly as they can.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from thesisrecon.arrays import F32, F64, I64
from thesisrecon.geometry.raster import smooth
from thesisrecon.geometry.zbuffer import interpolate_corners, rasterize_rows
from thesisrecon.records import PinholeView, TexturedMesh
from thesisrecon.surface.texture_views import Charts, camera_of, project, sample_view

SMOOTHNESS = 0.1
"""Weight of a step between neighbours within a chart against one left over at a seam."""

ANCHOR = 1e-4
"""Weight of the correction itself: what nothing decides stays as it was photographed."""

BLUR_PX = 2.0
"""Photographs are compared smoothed by this, since pieces fit to about a pixel."""

BEYOND = 3
"""Texels beyond a chart that share its corrections: sampling reaches there."""


@dataclass(frozen=True)
class SingleView:
    """Each piece as its own photograph shows it; ``level``: differences between photographs are taken out."""

    level: bool = True

    def paint(
        self,
        mesh: TexturedMesh,
        views: Sequence[PinholeView],
        charts: Charts,
        *,
        threads: int = 1,  # noqa: ARG002 - one linear system for all
    ) -> NDArray[np.uint8]:
        """The texture (H, W, 3)."""
        if not self.level:
            return charts.cut_out
        return level_seams(mesh, views, charts.label, charts.chart, uv=charts.uv, texture=charts.cut_out)


def level_seams(
    mesh: TexturedMesh, views: Sequence[PinholeView], label: I64, chart: I64, *, uv: F64, texture: np.ndarray
) -> np.ndarray:
    """The texture (H, W, 3) uint8 with the corrections of all charts added."""
    seen = np.flatnonzero(label >= 0)
    # A node is a vertex of a chart.
    key = chart[seen][:, None] * len(mesh.vertices) + mesh.faces[seen]
    nodes, number = np.unique(key, return_inverse=True)
    number = number.reshape(key.shape)
    view = np.zeros(len(nodes), dtype=np.int64)
    view[number.ravel()] = np.repeat(label[seen], 3)
    vertex = nodes % len(mesh.vertices)
    color = _colors(mesh, views, view, vertex)
    first, second = _meeting(vertex)
    if not len(first):
        return texture
    correction = _solve(color, (first, second), _sides(number))
    values = np.zeros((len(mesh.faces), 3, 3), dtype=np.float32)
    values[seen] = correction[number]
    return _added(texture, uv, values, seen)


def _colors(mesh: TexturedMesh, views: Sequence[PinholeView], view: I64, vertex: I64) -> F64:
    """(N, 3) colour of every node in its own photograph."""
    color = np.zeros((len(view), 3))
    for v, one in enumerate(views):
        mine = view == v
        if mine.any():
            planes = [smooth(one.rgb[..., k].astype(np.float32), BLUR_PX) for k in range(3)]
            xy = project(camera_of(one), mesh.vertices[vertex[mine]])[0]
            color[mine] = sample_view(one, xy, np.stack(planes, axis=-1))
    return color


def _meeting(vertex: I64) -> tuple[I64, I64]:
    """Pairs of nodes at one vertex: each with the next of those that meet there."""
    order = np.argsort(vertex, kind="stable")
    same = vertex[order][1:] == vertex[order][:-1]
    return order[:-1][same], order[1:][same]


def _sides(number: I64) -> tuple[I64, I64]:
    """The sides of all faces as pairs of nodes, each once."""
    start, stop = number.ravel(), np.roll(number, -1, axis=1).ravel()
    pairs = np.unique(np.stack([np.minimum(start, stop), np.maximum(start, stop)], axis=1), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _solve(color: F64, seams: tuple[I64, I64], sides: tuple[I64, I64]) -> F32:
    """Corrections (N, 3) by least squares: a Laplacian over seams and sides."""
    count = len(color)
    row = np.concatenate([seams[0], sides[0]])
    column = np.concatenate([seams[1], sides[1]])
    weight = np.concatenate([np.ones(len(seams[0])), np.full(len(sides[0]), SMOOTHNESS)])
    W = scipy.sparse.coo_array((weight, (row, column)), shape=(count, count)).tocsr()
    W = W + W.T
    degree = np.asarray(W.sum(axis=1)).ravel() + ANCHOR
    A = (scipy.sparse.diags_array(degree) - W).tocsr()
    M = scipy.sparse.linalg.LinearOperator(A.shape, matvec=lambda x: x / degree)
    difference = color[seams[1]] - color[seams[0]]
    solution = np.zeros((count, 3), dtype=np.float32)
    for k in range(3):
        b = np.bincount(seams[0], difference[:, k], minlength=count)
        b -= np.bincount(seams[1], difference[:, k], minlength=count)
        solution[:, k] = scipy.sparse.linalg.cg(A, b, rtol=1e-4, maxiter=500, M=M)[0]
    return solution


def _added(texture: np.ndarray, uv: F64, values: F32, seen: I64) -> np.ndarray:
    """The texture with values (M, 3, 3) of the corners of the faces ``seen`` added over these faces."""
    height, width = texture.shape[:2]
    corners = np.concatenate([uv[seen], np.ones((len(seen), 3, 1))], axis=2)
    depth = np.full((height, width), np.inf, dtype=np.float32)
    face = np.full((height, width), -1, dtype=np.int64)
    weights = np.zeros((height, width, 2), dtype=np.float32)
    rasterize_rows(np.ascontiguousarray(corners), 1e-3, (0, height), depth, face, weights)
    offset = np.zeros((height, width, 3), dtype=np.float32)
    interpolate_corners(face, weights, np.ascontiguousarray(values[seen]), offset)
    distance, nearest = scipy.ndimage.distance_transform_edt(face < 0, return_indices=True)
    offset = offset[tuple(nearest)]
    offset[distance > BEYOND] = 0.0
    return np.asarray(np.clip(np.rint(texture + offset), 0, 255), dtype=np.uint8)
