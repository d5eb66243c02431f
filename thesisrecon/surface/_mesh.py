"""Triangle meshes: areas, normals, connected parts, and simplification by vertex clustering."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.camera import decompose_camera
from thesisrecon.records import TexturedMesh

RISING, FALLING = ((0, 2, 1), (1, 2, 3)), ((0, 2, 3), (0, 3, 1))
"""Corners (0 1 above, 2 3 below) of the triangles of a square by its diagonal, the left one first."""
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


def halve_surface(mesh: TexturedMesh, size: I64, largest: int) -> I64:
    """(M,) part of each face: boxes are halved until the sum of ``size`` (M,) in each is at most ``largest``.

    They are cut across their longest side, so that parts are compact; one face is not cut.
    """
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    part, count, open_ = np.zeros(len(mesh.faces), dtype=np.int64), 0, [np.arange(len(mesh.faces))]
    while open_:
        faces = open_.pop()
        if len(faces) < 2 or size[faces].sum() <= largest:
            part[faces] = count
            count += 1
            continue
        along = middle[faces, int(np.argmax(np.ptp(middle[faces], axis=0)))]
        faces = faces[np.argsort(along, kind="stable")]
        total = np.cumsum(size[faces])
        half = int(np.clip(np.searchsorted(total, total[-1] / 2) + 1, 1, len(faces) - 1))
        # Within a part, faces stay in their order.
        open_ += [np.sort(faces[half:]), np.sort(faces[:half])]
    return part


def remove_small_parts(mesh: TexturedMesh) -> TexturedMesh:
    """Remove small connected parts, which come from wrong depths."""
    if not len(mesh.faces):
        return mesh
    part = connected_parts(mesh.faces, len(mesh.vertices))
    area = np.bincount(part, face_areas(mesh.vertices, mesh.faces))
    return select_faces(mesh, area[part] >= MIN_PART_SHARE * area.sum())


def simplify_mesh(mesh: TexturedMesh, max_faces: int) -> TexturedMesh:
    """Merge vertices in cells of a grid, enlarged until the faces are few enough, to ``max_faces``.

    Each cluster (Rossignac and Borrel 1993) becomes the point with the least squared distance to the planes
    of its faces (Lindstrom 2000), which preserves edges and corners.
    """
    if max_faces < 1:
        raise ValueError(f"max_faces must be at least 1; got {max_faces}")
    if len(mesh.faces) <= max_faces:
        return mesh
    mesh = remove_unused_vertices(replace(mesh, uv=None, texture=None, untextured=None))
    extent = float(np.ptp(mesh.vertices, axis=0).max()) or 1.0
    cell = max(float(np.sqrt(face_areas(mesh.vertices, mesh.faces).sum() / max_faces)), 1e-9 * extent)
    while True:
        cluster = _clusters(mesh, cell)
        faces = _distinct_faces(cluster[mesh.faces])
        if len(faces) <= max_faces:
            break
        cell *= max(1.02, float(np.sqrt(len(faces) / max_faces)))
    vertices = _cluster_places(mesh, cluster, cell)
    colors = None if mesh.colors is None else np.rint(_means(cluster, mesh.colors)).astype(np.uint8)
    return remove_unused_vertices(replace(mesh, vertices=vertices, faces=faces, colors=colors))


def _clusters(mesh: TexturedMesh, cell: float) -> I64:
    """(N,) cluster of each vertex: vertices that edges connect within a cell."""
    place = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(np.int64)
    start, stop = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    within = (place[start] == place[stop]).all(axis=1)
    return components(start[within], stop[within], len(place))


def _distinct_faces(faces: I64) -> I64:
    """Faces (M', 3) with three corners, in their first order; both sides of a sheet stay."""
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    first = np.argmin(faces, axis=1)
    turned = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    return faces[np.sort(np.unique(turned, axis=0, return_index=True)[1])]


def _cluster_places(mesh: TexturedMesh, cluster: I64, cell: float) -> F64:
    """(C, 3) point nearest to the planes of the faces of each cluster, undetermined: the mean vertex."""
    mean = _means(cluster, mesh.vertices)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    planes = np.zeros((len(mean), 3, 3))
    pull = np.zeros((len(mean), 3))
    for corner in range(3):
        which = cluster[mesh.faces[:, corner]]
        away = (normal * (a - mean[which])).sum(axis=1)
        for i in range(3):
            pull[:, i] += np.bincount(which, normal[:, i] * away, len(mean))
            for j in range(3):
                planes[:, i, j] += np.bincount(which, normal[:, i] * normal[:, j], len(mean))
    values, vectors = np.linalg.eigh(planes)
    determined = values > np.maximum(1e-2 * values[:, 2:], np.finfo(float).tiny)
    along = np.einsum("nij,ni->nj", vectors, pull) * determined / np.where(determined, values, 1.0)
    step = np.einsum("nij,nj->ni", vectors, along)
    return mean + np.where(np.linalg.norm(step, axis=1, keepdims=True) <= cell, step, 0.0)


def _means(cluster: I64, values: F64 | NDArray[np.uint8]) -> F64:
    """(C, 3) means of ``values`` (N, 3) over each cluster."""
    size = np.bincount(cluster)
    return np.stack([np.bincount(cluster, values[:, d]) / size for d in range(3)], axis=1)


def max_depth_slope(P: F64, grazing_deg: float) -> float:
    """Largest relative depth step between adjacent pixels of a surface seen at ``grazing_deg`` or more."""
    K = decompose_camera(P)[0]
    return float(1.0 / (np.sqrt(K[0, 0] * K[1, 1]) * np.tan(np.radians(grazing_deg))))


def triangulate_grid(depth: F64, std: F64, slope: float) -> tuple[B8, B8]:
    """Divide the squares of depths (H, W) into triangles without surface break along a side.

    Returns whether the diagonal, that of the smaller depth step, runs from the lower left to the upper right
    (H - 1, W - 1), and which of the two triangles exist (H - 1, W - 1, 2).
    """
    corner = [np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:]]
    z, spread = (np.stack([values[c] for c in corner], axis=-1) for values in (depth, std))
    falling_step = np.abs(z[..., 0] - z[..., 3])
    rising = (np.abs(z[..., 1] - z[..., 2]) < falling_step) | np.isnan(falling_step)
    whole = np.empty((*rising.shape, 2), dtype=bool)
    for k in range(2):
        triple = np.where(rising[..., None], RISING[k], FALLING[k])
        at, std_at = (np.take_along_axis(values, triple, axis=-1) for values in (z, spread))
        before, std_before = (np.roll(values, 1, axis=-1) for values in (at, std_at))
        with np.errstate(invalid="ignore"):
            whole[..., k] = same_surface(at, before, std_at, std_before, np.sqrt(2.0) * slope).all(axis=-1)
    return rising, whole


def same_surface(z1: F64, z2: F64, std1: F64, std2: F64, slope: float | F64) -> B8:
    """Whether two depths differ by at most ``slope`` of the smaller, or three standard deviations."""
    limit = np.maximum(slope * np.minimum(z1, z2), 3.0 * np.hypot(std1, std2))
    return np.asarray(np.abs(z1 - z2) <= limit)
