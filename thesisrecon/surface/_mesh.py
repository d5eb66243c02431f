"""Triangle meshes: areas, connected parts, halves, and the piecewise linear surfaces of depth maps."""

from dataclasses import replace

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.camera import decompose_camera
from thesisrecon.records import DepthMap, TexturedMesh

RISING, FALLING = ((0, 2, 1), (1, 2, 3)), ((0, 2, 3), (0, 3, 1))
"""Corners (0 1 above, 2 3 below) of the triangles of a square by its diagonal, the left one first."""


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
    """(M,) part of each face: boxes cut across their longest side, with ``size`` up to ``largest``."""
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
    min_part_share = 0.0005  # Connected parts below this share of the area are removed
    if not len(mesh.faces):
        return mesh
    part = connected_parts(mesh.faces, len(mesh.vertices))
    area = np.bincount(part, face_areas(mesh.vertices, mesh.faces))
    return select_faces(mesh, area[part] >= min_part_share * area.sum())


GRAZING_DEG = 10.0  #: surfaces break where they are seen at a smaller angle


def max_depth_slope(P: F64, grazing_deg: float) -> float:
    """Largest relative depth step between adjacent pixels of a surface seen at ``grazing_deg`` or more."""
    K = decompose_camera(P)[0]
    return float(1.0 / (np.sqrt(K[0, 0] * K[1, 1]) * np.tan(np.radians(grazing_deg))))


def triangulate_grid(depth: F64, std: F64, slope: float) -> tuple[B8, B8]:
    """Divide the squares of depths (H, W) into triangles without surface break along a side."""
    # Whether the diagonal, that of the smaller depth step, rises to the right (H - 1, W - 1), and which of
    # the two triangles exist (H - 1, W - 1, 2).
    corner = [np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:]]
    z, spread = (np.stack([values[c] for c in corner], axis=-1) for values in (depth, std))
    falling_step = np.abs(z[..., 0] - z[..., 3])
    rising = (np.abs(z[..., 1] - z[..., 2]) < falling_step) | np.isnan(falling_step)
    whole = np.empty((*rising.shape, 2), dtype=bool)
    for k in range(2):
        triple = np.where(rising[..., None], RISING[k], FALLING[k])
        at, std_at = (np.take_along_axis(values, triple, axis=-1) for values in (z, spread))
        before, std_before = (np.roll(values, 1, axis=-1) for values in (at, std_at))
        whole[..., k] = same_surface(at, before, std_at, std_before, np.sqrt(2.0) * slope).all(axis=-1)
    return rising, whole


def same_surface(z1: F64, z2: F64, std1: F64, std2: F64, slope: float | F64) -> B8:
    """Whether two depths differ by at most ``slope`` of the smaller, or three standard deviations."""
    with np.errstate(invalid="ignore"):
        limit = np.maximum(slope * np.minimum(z1, z2), 3.0 * np.hypot(std1, std2))
        return np.asarray(np.abs(z1 - z2) <= limit)


def surface_from_depth(
    depth_map: DepthMap, *, step: int = 1, grazing_deg: float = GRAZING_DEG
) -> TexturedMesh:
    """Triangulate a depth map between neighbours seen at more than ``grazing_deg``, or within three std."""
    depth = depth_map.depth[::step, ::step].astype(np.float64)
    std = depth_map.std[::step, ::step].astype(np.float64)
    diagonal, whole = triangulate_grid(depth, std, step * max_depth_slope(depth_map.P, grazing_deg))
    index = np.arange(depth.size).reshape(depth.shape)
    corners = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]], axis=-1)
    faces = [
        corners[(diagonal == rising) & whole[..., k]][:, triple]
        for rising, triples in ((True, RISING), (False, FALLING))
        for k, triple in enumerate(triples)
    ]
    order = np.concatenate(faces)
    order = order[np.lexsort(order.T[::-1])]
    K, R, t = decompose_camera(depth_map.P)
    y, x = np.indices(depth.shape) * step
    rays = np.stack([x.ravel(), y.ravel(), np.ones(depth.size)], axis=1) @ np.linalg.inv(K).T
    X = np.asarray((rays * depth.reshape(-1, 1) - t) @ R)
    return remove_unused_vertices(TexturedMesh(X, order))
