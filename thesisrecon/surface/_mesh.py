"""Operations on triangle meshes: selection, areas, normals, connectivity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.records import TexturedMesh

MIN_PART_SHARE = 0.0005
"""Connected parts below this share of the area are removed."""


def remove_unused_vertices(mesh: TexturedMesh) -> TexturedMesh:
    """The same surface without vertices that no face uses, in their previous order."""
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.faces] = True
    number = np.cumsum(used) - 1
    colors = None if mesh.colors is None else mesh.colors[used]
    return replace(mesh, vertices=mesh.vertices[used], faces=number[mesh.faces], colors=colors)


def select_faces(mesh: TexturedMesh, keep: B8) -> TexturedMesh:
    """The mesh of the faces ``keep`` (M,)."""
    uv = None if mesh.uv is None else mesh.uv[keep]
    untextured = None if mesh.untextured is None else mesh.untextured[keep]
    return remove_unused_vertices(replace(mesh, faces=mesh.faces[keep], uv=uv, untextured=untextured))


def face_areas(vertices: F64, faces: I64) -> F64:
    """Areas (M,) of triangles."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def vertex_normals(mesh: TexturedMesh) -> F64:
    """Unit vertex normals (N, 3), the area-weighted mean of the face normals."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    total = np.zeros_like(mesh.vertices)
    for k in range(3):
        for d in range(3):
            total[:, d] += np.bincount(mesh.faces[:, k], normal[:, d], len(total))
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300))


def connected_parts(faces: I64, vertices: int) -> I64:
    """(M,) connected part of each face; faces are connected by common vertices."""
    if not len(faces):
        return np.zeros(0, dtype=np.int64)
    label = components(faces.ravel(), np.roll(faces, 1, axis=1).ravel(), vertices)
    return np.asarray(label[faces[:, 0]])


def components(start: I64, stop: I64, count: int) -> I64:
    """(count,) connected component of each node of a graph with edges from ``start`` to ``stop``."""
    graph = scipy.sparse.coo_array((np.ones(len(start), dtype=np.int8), (start, stop)), shape=(count, count))
    return np.asarray(scipy.sparse.csgraph.connected_components(graph, directed=False)[1], dtype=np.int64)


def face_neighbours(faces: I64) -> I64:
    """Face (M, 3) across the side from corner k to k + 1, -1 for none; any if more than two faces meet."""
    start, stop = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(start, stop), np.maximum(start, stop)
    order = np.lexsort((np.arange(len(low)), high, low))
    same = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    neighbour = np.full(len(order), -1, dtype=np.int64)
    first, second = order[:-1][same], order[1:][same]
    neighbour[second] = first // 3
    neighbour[first] = second // 3
    return neighbour.reshape(-1, 3)


def remove_small_parts(mesh: TexturedMesh) -> TexturedMesh:
    """Remove small connected parts, which come from wrong depths."""
    if not len(mesh.faces):
        return mesh
    part = connected_parts(mesh.faces, len(mesh.vertices))
    area = np.bincount(part, face_areas(mesh.vertices, mesh.faces))
    return select_faces(mesh, area[part] >= MIN_PART_SHARE * area.sum())
