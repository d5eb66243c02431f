"""Mesh simplification by vertex clustering."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F64, I64
from thesisrecon.records import TexturedMesh
from thesisrecon.surface._mesh import components, face_areas, remove_unused_vertices


def simplify_mesh(mesh: TexturedMesh, max_faces: int) -> TexturedMesh:
    """Simplify a mesh by vertex clustering.

    Vertices that are connected within a cell of a cubic grid are merged (Rossignac and Borrel 1993) at the
    point with the least squared distance to the planes of their faces (Lindstrom 2000), which preserves edges
    and corners. Cells are enlarged until the faces are few enough.

    Parameters
    ----------
    mesh, max_faces : TexturedMesh, int
        Any mesh, and the largest number of faces.

    Returns
    -------
    TexturedMesh
        The simplified mesh without texture; the mesh itself if it has no more faces.
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
    """Faces (M', 3) with three different corners, without duplicates, in their first order.

    Two faces on the same corners with opposite orientation are the sides of a sheet and both stay.
    """
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    first = np.argmin(faces, axis=1)
    turned = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    return faces[np.sort(np.unique(turned, axis=0, return_index=True)[1])]


def _cluster_places(mesh: TexturedMesh, cluster: I64, cell: float) -> F64:
    """(C, 3) point of each cluster that is nearest to the planes of its faces.

    Undetermined directions keep the mean of the vertices, as do points farther than a cell from it.
    """
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
