"""Simplification of a mesh: edges collapse within an error limit at each vertex (Garland and Heckbert 1997).

A vertex keeps the squared distances to the planes of the faces it replaces as a quadratic form; an edge
collapses to the point of least sum if its rms is below the limit. At last each vertex moves by the mean
distance of the original ones from the faces around it.
"""

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from thesisrecon._numba import ThreadPool, empty, kernel, zeros
from thesisrecon.arrays import F32, F64, I32, I64, U8
from thesisrecon.records import TexturedMesh
from thesisrecon.surface._mesh import connected_parts, face_areas, remove_unused_vertices, select_faces

BLOCK_FACES = 150_000
"""Faces that are simplified as one block; vertices between blocks stay for the next round."""
SHARES, LONGEST = (0.08, 0.32, 1.28, 5.12), 8.0
"""Limits tried for a number of faces, and longest new side; unit: side of a square of a face's mean area."""
MAX_FAN = 24  #: largest number of faces around a vertex


class MeshState(NamedTuple):
    """A mesh during its simplification."""

    points: F64  #: (N, 3)
    planes: (
        F64  #: (N, 11) weighted sums of n n' (upper triangle), n d, d^2 of the planes n x = d, and of areas
    )
    limit: F64  #: (N,) squared
    border: U8  #: (N,)
    faces: I32  #: (M, 3), -1 if removed
    first: I32  #: (N,) corner 3 m + k of each vertex
    following: I32  #: (3 M,) corner after each one of its vertex, or -1
    block: I32  #: (N,) block of all faces of a vertex, else -1
    into: I32  #: (N,) the vertex that replaced one, or itself


@kernel
def link_corners(mesh: MeshState) -> None:
    """Link the corners of each vertex, the last first."""
    for v in range(len(mesh.first)):
        mesh.first[v] = -1
    for m in range(mesh.faces.shape[0]):
        for k in range(3):
            v = mesh.faces[m, k]
            mesh.following[3 * m + k] = mesh.first[v]
            mesh.first[v] = 3 * m + k


@kernel
def _add_plane(mesh: MeshState, v: int, normal: F64, offset: float, weight: float) -> None:
    n = 0
    for i in range(3):
        for j in range(i, 3):
            mesh.planes[v, n] += weight * normal[i] * normal[j]
            n += 1
        mesh.planes[v, 6 + i] += weight * normal[i] * offset
    mesh.planes[v, 9] += weight * offset * offset


@kernel
def _cross(a: F64, b: F64, out: F64) -> float:
    """Unit vector of the cross product; returns the length of the product."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] = a[j] * b[k] - a[k] * b[j]
    length = np.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    if length > 0.0:
        for i in range(3):
            out[i] /= length
    return float(length)


@kernel
def sum_planes(mesh: MeshState) -> None:
    """Sum the planes of the faces at their vertices; mark borders and add planes across them."""
    border_weight = 0.3  # Weight of the planes that keep the borders in place, relative to that of the faces
    points, faces = mesh.points, mesh.faces
    normal, across, side, other = empty(3), empty(3), empty(3), empty(3)
    for m in range(faces.shape[0]):
        for d in range(3):
            side[d] = points[faces[m, 1], d] - points[faces[m, 0], d]
            other[d] = points[faces[m, 2], d] - points[faces[m, 0], d]
        area = 0.5 * _cross(side, other, normal)
        for k in range(3):
            v, w = faces[m, k], faces[m, (k + 1) % 3]
            _add_plane(mesh, v, normal, _offset(normal, points, v), area)
            mesh.planes[v, 10] += area
            shared, corner = 0, mesh.first[v]
            while corner >= 0:
                n, c = corner // 3, corner % 3
                shared += faces[n, (c + 1) % 3] == w or faces[n, (c + 2) % 3] == w
                corner = mesh.following[corner]
            if shared > 1:
                continue
            for d in range(3):
                side[d] = points[w, d] - points[v, d]
            length = _cross(side, normal, across)
            for end in (v, w):
                mesh.border[end] = 1
                _add_plane(mesh, end, across, _offset(across, points, v), border_weight * length * length)


@kernel
def _offset(normal: F64, points: F64, v: int) -> float:
    return float(normal[0] * points[v, 0] + normal[1] * points[v, 1] + normal[2] * points[v, 2])


@kernel
def collapse_edges(mesh: MeshState, rows: tuple[int, int], block: int, longest: float) -> None:
    """Collapse the edges of one block, the faces of some rows; no new side is longer than ``longest``."""
    # Passes over the faces, the limit rising evenly; one vertex takes part in one collapse of a pass.
    passes = 10
    planes, point, ring = empty(11), empty(3), empty(2 * MAX_FAN, np.int64)
    touched = zeros(rows[1] - rows[0], np.uint8)
    for turn in range(passes):
        share = ((turn + 1.0) / passes) ** 2
        touched[:] = 0
        for m in range(rows[0], rows[1]):
            if mesh.faces[m, 0] < 0 or touched[m - rows[0]]:
                continue
            for k in range(3):
                v, w = mesh.faces[m, k], mesh.faces[m, (k + 1) % 3]
                if mesh.block[v] != block or mesh.block[w] != block:
                    continue
                # The neighbouring face has an inner edge in the other direction.
                if v > w and not (mesh.border[v] and mesh.border[w]):
                    continue
                most = share * min(mesh.limit[v], mesh.limit[w])
                if (
                    _best_point(mesh, v, w, most, planes, point)
                    and _is_simple(mesh, v, w, ring)
                    and _keeps_shape(mesh, v, w, point, longest)
                    and _keeps_shape(mesh, w, v, point, longest)
                ):
                    _merge(mesh, v, w, planes, point)
                    corner = mesh.first[v]
                    while corner >= 0:
                        touched[corner // 3 - rows[0]] = 1
                        corner = mesh.following[corner]
                    break


@kernel
def _best_point(mesh: MeshState, v: int, w: int, most: float, planes: F64, point: F64) -> bool:
    """Sum the ``planes`` of an edge, find the ``point`` near them; False if its mean square is too large."""
    towards_middle = 1e-3  # Weight of the middle of the edge where planes leave directions undetermined
    for n in range(11):
        planes[n] = mesh.planes[v, n] + mesh.planes[w, n]
    x = 0.5 * (mesh.points[v, 0] + mesh.points[w, 0])
    y = 0.5 * (mesh.points[v, 1] + mesh.points[w, 1])
    z = 0.5 * (mesh.points[v, 2] + mesh.points[w, 2])
    xx, xy, xz, yy, yz, zz = planes[0], planes[1], planes[2], planes[3], planes[4], planes[5]
    # The sum of squares around the middle: constant - 2 right s + s' A s.
    ax, ay, az = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z
    rx, ry, rz = planes[6] - ax, planes[7] - ay, planes[8] - az
    constant = planes[9] - 2.0 * (planes[6] * x + planes[7] * y + planes[8] * z) + ax * x + ay * y + az * z
    more = towards_middle * (xx + yy + zz)
    a, b, c = xx + more, yy + more, zz + more
    p, q, r = b * c - yz * yz, xz * yz - xy * c, xy * yz - xz * b
    det = a * p + xy * q + xz * r
    if not det > 0.0:
        return False
    s = (p * rx + q * ry + r * rz) / det
    t = (q * rx + (a * c - xz * xz) * ry + (xy * xz - a * yz) * rz) / det
    u = (r * rx + (xy * xz - a * yz) * ry + (a * b - xy * xy) * rz) / det
    bent = s * (xx * s + xy * t + xz * u) + t * (xy * s + yy * t + yz * u) + u * (xz * s + yz * t + zz * u)
    point[0], point[1], point[2] = x + s, y + t, z + u
    return bool(constant - 2.0 * (rx * s + ry * t + rz * u) + bent <= most * planes[10])


@kernel
def _is_simple(mesh: MeshState, v: int, w: int, ring: I64) -> bool:
    """Whether a collapse keeps the topology: common neighbours of its ends are corners of common faces."""
    size, corner = 0, mesh.first[v]
    while corner >= 0:
        m, k = corner // 3, corner % 3
        corner = mesh.following[corner]
        if mesh.faces[m, 0] < 0:
            continue
        for turn in range(1, 3):
            other, n = mesh.faces[m, (k + turn) % 3], 0
            while n < size and ring[n] != other:
                n += 1
            ring[n], size = other, max(size, n + 1)
            if size == len(ring):
                return False
    around, shared, common, corner = size, 0, 0, mesh.first[w]
    while corner >= 0:
        m, k = corner // 3, corner % 3
        corner = mesh.following[corner]
        if mesh.faces[m, 0] < 0:
            continue
        around += 1
        for turn in range(1, 3):
            other = mesh.faces[m, (k + turn) % 3]
            shared += other == v
            for n in range(size):
                if ring[n] == other:
                    common += 1
                    ring[n] = -1
    # An inner edge between two borders does not collapse: it would join the borders.
    apart = shared == 2 and mesh.border[v] and mesh.border[w]
    return 1 <= shared <= 2 and common == shared and around <= MAX_FAN and not apart


@kernel
def _keeps_shape(mesh: MeshState, v: int, w: int, point: F64, longest: float) -> bool:
    """Whether the faces of v without w keep their orientation and roundness if v moves to a point."""
    max_turn = 0.5  # Cosine of the largest change of a face's normal in one collapse
    min_roundness = 0.05  # Smallest height of a face over its longest side, unless it was flatter before
    points, faces = mesh.points, mesh.faces
    corner = mesh.first[v]
    while corner >= 0:
        m, k = corner // 3, corner % 3
        corner = mesh.following[corner]
        b, c = faces[m, (k + 1) % 3], faces[m, (k + 2) % 3]
        if faces[m, 0] < 0 or b == w or c == w:
            continue
        # Vectors from b: to c, to v and to the point.
        cx, cy, cz = points[c, 0] - points[b, 0], points[c, 1] - points[b, 1], points[c, 2] - points[b, 2]
        vx, vy, vz = points[v, 0] - points[b, 0], points[v, 1] - points[b, 1], points[v, 2] - points[b, 2]
        px, py, pz = point[0] - points[b, 0], point[1] - points[b, 1], point[2] - points[b, 2]
        ox, oy, oz = cy * vz - cz * vy, cz * vx - cx * vz, cx * vy - cy * vx
        nx, ny, nz = cy * pz - cz * py, cz * px - cx * pz, cx * py - cy * px
        old, new = ox * ox + oy * oy + oz * oz, nx * nx + ny * ny + nz * nz
        cosine = ox * nx + oy * ny + oz * nz
        if cosine <= 0.0 or cosine * cosine < max_turn * max_turn * old * new:
            return False
        base = cx * cx + cy * cy + cz * cz
        own, second = px * px + py * py + pz * pz, (px - cx) ** 2 + (py - cy) ** 2 + (pz - cz) ** 2
        before = max(base, vx * vx + vy * vy + vz * vz, (vx - cx) ** 2 + (vy - cy) ** 2 + (vz - cz) ** 2)
        side = max(base, own, second)
        flat = new < (min_roundness * side) ** 2 and new * before * before < old * side * side
        if flat or max(own, second) > longest * longest:
            return False
    return True


@kernel
def _merge(mesh: MeshState, v: int, w: int, planes: F64, point: F64) -> None:
    """Replace w by v at a new point with the sum of their planes; their common faces are removed."""
    faces = mesh.faces
    for d in range(3):
        mesh.points[v, d] = point[d]
    for n in range(11):
        mesh.planes[v, n] = planes[n]
    mesh.into[w] = v
    mesh.limit[v] = min(mesh.limit[v], mesh.limit[w])
    mesh.border[v] = max(mesh.border[v], mesh.border[w])
    last = -1
    for end in (v, w):
        other = w if end == v else v
        corner = mesh.first[end]
        while corner >= 0:
            m, k = corner // 3, corner % 3
            if faces[m, (k + 1) % 3] == other or faces[m, (k + 2) % 3] == other:
                faces[m, 0] = -1
            if faces[m, 0] >= 0:
                faces[m, k] = v
                if last < 0:
                    mesh.first[v] = corner
                else:
                    mesh.following[last] = corner
                last = corner
            corner = mesh.following[corner]
    if last < 0:
        mesh.first[v] = -1
    else:
        mesh.following[last] = -1


@kernel
def sum_distances(mesh: MeshState, original: F32, total: F64) -> None:
    """Sum the distances of the ``original`` vertices (N, 3) from the faces around those that replaced them.

    ``total`` (N, 4): sums of distance times normal and of the weights, barycentric coordinates of points over
    a face.
    """
    points, faces = mesh.points, mesh.faces
    side, other, away, normal, across = empty(3), empty(3), empty(3), empty(3), empty(3)
    for p in range(original.shape[0]):
        v = p
        while mesh.into[v] != v:
            v = mesh.into[v]
        corner = mesh.first[v]
        while corner >= 0:
            m = corner // 3
            corner = mesh.following[corner]
            for d in range(3):
                side[d] = points[faces[m, 1], d] - points[faces[m, 0], d]
                other[d] = points[faces[m, 2], d] - points[faces[m, 0], d]
                away[d] = original[p, d] - points[faces[m, 0], d]
            area = _cross(side, other, normal)
            if not area > 0.0:
                continue
            second = _cross(away, other, across) * _dot(across, normal) / area
            third = _cross(side, away, across) * _dot(across, normal) / area
            if min(second, third, 1.0 - second - third) < 0.0:
                continue
            distance = _dot(away, normal)
            for k in range(3):
                share = 1.0 - second - third if k == 0 else (second if k == 1 else third)
                for d in range(3):
                    total[faces[m, k], d] += share * distance * normal[d]
                total[faces[m, k], 3] += share
            break


@kernel
def _dot(a: F64, b: F64) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def simplify_surface(
    mesh: TexturedMesh, limit: F64, *, longest: float, threads: int = 1, overwrite: bool = False
) -> TexturedMesh:
    """Collapse edges while the rms distance to the planes of the original faces is within ``limit`` (N,)."""
    rounds = 2  # Rounds, each with blocks across another axis
    fitted_points = 0.3  # Minimum weight of the original vertices around a new vertex for it to be moved
    size, centre = len(mesh.vertices), mesh.vertices.mean(axis=0)
    points = np.subtract(mesh.vertices, centre, out=mesh.vertices if overwrite else None)
    original = points.astype(np.float32)
    state = _linked(MeshState(
        points, np.zeros((size, 11)), limit**2, np.zeros(size, np.uint8),
        mesh.faces.astype(np.int32, copy=not overwrite), np.empty(size, np.int32), np.empty(0, np.int32),
        np.full(size, -1, np.int32), np.arange(size, dtype=np.int32),
    ))  # fmt: skip
    sum_planes(state)
    with ThreadPool(threads) as pool:
        for axis in np.argsort(-np.ptp(points, axis=0), kind="stable")[:rounds]:
            starts = _sort_into_blocks(state, int(axis))
            state = _linked(state)
            blocks = enumerate(pairwise(starts.tolist()))
            list(pool.map(lambda one: collapse_edges(state, one[1], one[0], longest), blocks))  # noqa: B023
            state = state._replace(faces=state.faces[state.faces[:, 0] >= 0])
            if len(starts) == 2:
                break
    state = _linked(state._replace(planes=np.zeros((0, 11))))
    total = np.zeros((size, 4))
    sum_distances(state, original, total)
    moved = total[:, 3] >= fitted_points
    points[moved] += total[moved, :3] / total[moved, 3:]
    made = remove_unused_vertices(replace(mesh, vertices=points, faces=state.faces.astype(np.int64)))
    return replace(made, vertices=made.vertices + centre)


def _linked(state: MeshState) -> MeshState:
    state = state._replace(following=np.empty(state.faces.size, np.int32))
    link_corners(state)
    return state


def _sort_into_blocks(state: MeshState, axis: int) -> I64:
    """Sort the faces into slabs across an axis; returns the first face of each, and the number of faces."""
    faces, block = state.faces, state.block
    count = max(1, -(-len(faces) // BLOCK_FACES))
    starts = np.linspace(0, len(faces), count + 1).astype(np.int64)
    slab = np.zeros(len(faces), np.int16)
    if count > 1:
        place = state.points[faces[:, 0], axis]
        ends = np.partition(place, starts[1:-1])[starts[1:-1]]
        slab[:] = np.searchsorted(ends, place, side="right")
        order = np.argsort(slab, kind="stable")
        faces[:], slab = faces[order], slab[order]
        starts = np.searchsorted(slab, np.arange(count + 1))
    block[:] = -1
    for corner in faces.T:
        block[corner] = slab
    for corner in faces.T:
        block[corner[block[corner] != slab]] = -1
    return starts


def reduce_faces(mesh: TexturedMesh, max_faces: int, *, threads: int = 1) -> TexturedMesh:
    """Simplify a mesh to a number of faces; if so many cannot be joined, the largest parts stay."""
    if len(mesh.faces) <= max_faces:
        return mesh
    mesh = replace(mesh, colors=None, uv=None, texture=None, untextured=None)
    cell = float(np.sqrt(face_areas(mesh.vertices, mesh.faces).sum() / max_faces))
    for share in SHARES:
        limit = np.full(len(mesh.vertices), share * cell)
        mesh = simplify_surface(mesh, limit, longest=LONGEST * cell, threads=threads)
        if len(mesh.faces) <= max_faces:
            return mesh
    part = connected_parts(mesh.faces, len(mesh.vertices))
    area, keep = np.bincount(part, face_areas(mesh.vertices, mesh.faces)), np.zeros(len(part), dtype=bool)
    keep[np.argsort(-area[part], kind="stable")[:max_faces]] = True
    return select_faces(mesh, keep)
