"""Upkeep of triangle meshes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from thesisrecon.types import B8, F64, I64, TexturedMesh


def without_unused_vertices(mesh: TexturedMesh) -> TexturedMesh:
    """The same surface with only the vertices that its faces name, in their order."""
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.faces] = True
    number = np.cumsum(used) - 1
    colors = None if mesh.colors is None else mesh.colors[used]
    return replace(mesh, vertices=mesh.vertices[used], faces=number[mesh.faces], colors=colors)


def with_faces(mesh: TexturedMesh, keep: B8) -> TexturedMesh:
    """The surface of the faces that ``keep`` (M,) marks."""
    uv = None if mesh.uv is None else mesh.uv[keep]
    untextured = None if mesh.untextured is None else mesh.untextured[keep]
    return without_unused_vertices(replace(mesh, faces=mesh.faces[keep], uv=uv, untextured=untextured))


def face_areas(vertices: F64, faces: I64) -> F64:
    """(M,) areas of triangles."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def parts_of(faces: I64, vertices: int) -> I64:
    """(M,) number of the connected part that each face belongs to; faces connect by common vertices."""
    if not len(faces):
        return np.zeros(0, dtype=np.int64)
    row, column = faces.ravel(), np.roll(faces, 1, axis=1).ravel()
    graph = coo_array((np.ones(len(row), dtype=np.int8), (row, column)), shape=(vertices, vertices))
    label = connected_components(graph, directed=False)[1]
    return np.asarray(label[faces[:, 0]], dtype=np.int64)


def face_neighbours(faces: I64) -> I64:
    """(M, 3) number of the face across the side from corner k to corner k + 1, -1 where there is none.

    Where more than two faces meet in a side, each has one of the others.
    """
    start, stop = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(start, stop), np.maximum(start, stop)
    order = np.lexsort((np.arange(len(low)), high, low))
    same = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    neighbour = np.full(len(order), -1, dtype=np.int64)
    first, second = order[:-1][same], order[1:][same]
    neighbour[second] = first // 3
    neighbour[first] = second // 3
    return neighbour.reshape(-1, 3)


def keep_large_parts(mesh: TexturedMesh, least_share: float = 0.002) -> TexturedMesh:
    """Without connected parts of less than ``least_share`` of the whole area: crumbs of wrong depths."""
    if not len(mesh.faces):
        return mesh
    part = parts_of(mesh.faces, len(mesh.vertices))
    area = np.bincount(part, face_areas(mesh.vertices, mesh.faces))
    return with_faces(mesh, area[part] >= least_share * area.sum())
