"""Compiled loops of volumetric fusion; the tests contain NumPy versions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thesisrecon._numba import empty, kernel
from thesisrecon.arrays import F32, F64, I32, I64, U8

SIDE = 8  #: voxels per side of a block


class FusionMap(NamedTuple):
    """A depth map prepared for fusion.

    ``P`` = K [R t] (3, 4) and ``focal`` length in pixels; depth, std and ``cosine`` (H, W), NaN = unknown.
    ``cosine``: distance across the surface per unit of depth; ``slope``: largest relative depth step between
    neighbours on one surface.
    """

    P: F64
    focal: float
    depth: F32
    std: F32
    cosine: F32
    slope: float


class VoxelGrid(NamedTuple):
    """Sparse voxel grid, and the values of its blocks from number ``first`` on.

    ``blocks`` (B, 3): grid positions of all blocks; ``place`` (X, Y, Z): block number at each position or -1.
    ``value``, ``weight``, ``vertex`` (W, 8, 8, 8): signed distance, its weight, and vertex number or -1.
    """

    origin: F64
    voxel: float
    blocks: I64
    place: I32
    first: int
    value: F32
    weight: F32
    vertex: I32


@kernel
def touched_blocks(surface: FusionMap, rays: F64, centre: F64, reach: float, edge: float, marked: U8) -> None:
    """Mark the blocks (X, Y, Z) of size ``edge`` that lie within ``reach`` of the surface.

    ``rays`` (3, 3): from (x, y, 1) to the point at depth 1 relative to the centre; ``centre`` (3,): of the
    camera, relative to the grid origin.
    """
    depth, cosine = surface.depth, surface.cosine
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            z = depth[y, x]
            if not z > 0.0:
                continue
            along = reach / cosine[y, x]
            steps = int(np.ceil(2.0 * along / (0.5 * edge))) + 1
            dx = rays[0, 0] * x + rays[0, 1] * y + rays[0, 2]
            dy = rays[1, 0] * x + rays[1, 1] * y + rays[1, 2]
            dz = rays[2, 0] * x + rays[2, 1] * y + rays[2, 2]
            for s in range(steps):
                r = z + along * (2.0 * s / (steps - 1) - 1.0)
                i = int(np.floor((centre[0] + r * dx) / edge))
                j = int(np.floor((centre[1] + r * dy) / edge))
                k = int(np.floor((centre[2] + r * dz) / edge))
                if 0 <= i < marked.shape[0] and 0 <= j < marked.shape[1] and 0 <= k < marked.shape[2]:
                    marked[i, j, k] = 1


@kernel
def integrate_view(
    blocks: I64, voxel: float, P: F64, surface: FusionMap, truncation: float, value: F32, weight: F32
) -> None:
    """Add one depth map to the signed distances of blocks (Curless and Levoy 1996).

    ``P``: camera K [R t] with the centre of the first voxel as origin. Distances are in units of the
    truncation and limited to 1; voxels farther behind the surface are not visible. The weight is cos^4 / (s^2
    + (truncation / 8)^2) with the standard deviation s across the surface: the surface is assumed to be plane
    near the ray, with an error that grows with 1 / cos^2.
    """
    depth, std, cosine, slope = surface.depth, surface.std, surface.cosine, surface.slope
    height, width = depth.shape
    base = (truncation / 8.0) ** 2
    for b in range(blocks.shape[0]):
        for i in range(SIDE):
            X = (blocks[b, 0] * SIDE + i) * voxel
            for j in range(SIDE):
                Y = (blocks[b, 1] * SIDE + j) * voxel
                for k in range(SIDE):
                    Z = (blocks[b, 2] * SIDE + k) * voxel
                    z = P[2, 0] * X + P[2, 1] * Y + P[2, 2] * Z + P[2, 3]
                    if z <= 0.0:
                        continue
                    u = (P[0, 0] * X + P[0, 1] * Y + P[0, 2] * Z + P[0, 3]) / z
                    v = (P[1, 0] * X + P[1, 1] * Y + P[1, 2] * Z + P[1, 3]) / z
                    if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
                        continue
                    seen, place, trust = _depth_at(depth, std, slope, u, v)
                    spread, incidence = std[place], cosine[place]
                    distance = incidence * (seen - z)
                    if not distance > -truncation:
                        continue
                    own = trust / (incidence * incidence * spread * spread + base)
                    if distance > truncation:
                        distance = truncation
                    else:
                        own *= incidence**4
                    total = weight[b, i, j, k] + own
                    mean = value[b, i, j, k]
                    value[b, i, j, k] = np.float32(mean + own / total * (distance / truncation - mean))
                    weight[b, i, j, k] = np.float32(total)


@kernel
def _depth_at(depth: F32, std: F32, slope: float, u: float, v: float) -> tuple[float, tuple[int, int], float]:
    """Depth at (u, v), the row and column it is taken from, and its weight.

    Bilinear in 1 / z if the four pixels lie on one surface, else that of the nearest pixel or, if unknown, of
    the next of the four, because a surface net ends half a voxel before the last depth. NaN if all are
    unknown.
    """
    weight_beyond = 0.1  # Weight of a depth extrapolated by half a pixel or more
    x, y = min(int(u), depth.shape[1] - 2), min(int(v), depth.shape[0] - 2)
    x, y = max(x, 0), max(y, 0)
    x1, y1 = min(x + 1, depth.shape[1] - 1), min(y + 1, depth.shape[0] - 1)
    a, b, c, d = depth[y, x], depth[y, x1], depth[y1, x], depth[y1, x1]
    low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    s, t = u - x, v - y
    row, column = (y1 if t > 0.5 else y), (x1 if s > 0.5 else x)
    # Comparisons with NaN are false.
    whole = a == a and b == b and c == c and d == d
    if whole and high - low <= max(3.0 * std[row, column], slope * low):
        upper = (1.0 - s) / a + s / b
        lower = (1.0 - s) / c + s / d
        return 1.0 / ((1.0 - t) * upper + t * lower), (row, column), 1.0
    if depth[row, column] == depth[row, column]:
        return depth[row, column], (row, column), 1.0
    other_row, other_column = y + y1 - row, x + x1 - column
    if depth[row, other_column] == depth[row, other_column]:
        column = other_column
    elif depth[other_row, column] == depth[other_row, column]:
        row = other_row
    else:
        row, column = other_row, other_column
    return depth[row, column], (row, column), weight_beyond


@kernel
def _find(window: VoxelGrid, i: int, j: int, k: int) -> int:
    """Row of the block at grid voxel (i, j, k) in the window, -1 if there is no block."""
    place = window.place
    if i < 0 or j < 0 or k < 0:
        return -1
    bi, bj, bk = i // SIDE, j // SIDE, k // SIDE
    if bi >= place.shape[0] or bj >= place.shape[1] or bk >= place.shape[2]:
        return -1
    return max(int(place[bi, bj, bk]) - window.first, -1)


@kernel
def place_vertices(rows: tuple[int, int], window: VoxelGrid, points: F64) -> int:
    """Place one vertex in each cell of eight voxels that the surface passes (surface nets, Gibson 1998).

    ``rows``: first and last + 1 block; their cells in ``window.vertex`` receive their vertex number or -1,
    counted from the first block; ``points`` (N, 3) receives the vertices in voxels, each the mean of the zero
    crossings of the cell edges. Returns the number of vertices.
    """
    count = 0
    corner = empty(8)
    blocks, value, weight = window.blocks, window.value, window.weight
    for b in range(rows[0], rows[1]):
        own = b - window.first
        for i in range(SIDE):
            for j in range(SIDE):
                for k in range(SIDE):
                    window.vertex[own, i, j, k] = -1
                    x, y, z = blocks[b, 0] * SIDE + i, blocks[b, 1] * SIDE + j, blocks[b, 2] * SIDE + k
                    inside, known = 0, True
                    for c in range(8):
                        X, Y, Z = x + (c & 1), y + ((c >> 1) & 1), z + (c >> 2)
                        n = _find(window, X, Y, Z)
                        if n < 0 or not weight[n, X % SIDE, Y % SIDE, Z % SIDE] > 0.0:
                            known = False
                            break
                        corner[c] = value[n, X % SIDE, Y % SIDE, Z % SIDE]
                        inside += corner[c] < 0.0
                    if not known or inside == 0 or inside == 8:
                        continue
                    _mean_crossing(corner, points[count])
                    points[count, 0] += x
                    points[count, 1] += y
                    points[count, 2] += z
                    window.vertex[own, i, j, k] = count
                    count += 1
    return count


@kernel
def _mean_crossing(corner: F64, point: F64) -> None:
    """Mean of the zeros on the twelve edges of a cell with values ``corner`` (8,) at x + 2 y + 4 z."""
    point[:] = 0.0
    crossed = 0
    for c in range(8):
        for axis in range(3):
            bit = 1 << axis
            if c & bit:
                continue
            a, b = corner[c], corner[c | bit]
            if (a < 0.0) == (b < 0.0):
                continue
            for d in range(3):
                point[d] += (a / (a - b)) if d == axis else ((c >> d) & 1)
            crossed += 1
    for d in range(3):
        point[d] /= crossed


@kernel
def join_vertices(rows: tuple[int, int], window: VoxelGrid, points: F64, known: int, faces: I32) -> int:
    """Create two triangles across each voxel edge that the surface crosses, anticlockwise from outside.

    ``rows``: first and last + 1 block; ``points`` of the vertices from number ``known`` on; ``faces`` (M, 3)
    receives the first M faces; the shorter diagonal is used. Returns the number of faces.
    """
    count = 0
    ring = empty(4, np.int64)
    blocks, value, weight = window.blocks, window.value, window.weight
    for b in range(rows[0], rows[1]):
        own = b - window.first
        for i in range(SIDE):
            for j in range(SIDE):
                for k in range(SIDE):
                    if not weight[own, i, j, k] > 0.0:
                        continue
                    start = value[own, i, j, k]
                    x, y, z = blocks[b, 0] * SIDE + i, blocks[b, 1] * SIDE + j, blocks[b, 2] * SIDE + k
                    for axis in range(3):
                        X, Y, Z = x + (axis == 0), y + (axis == 1), z + (axis == 2)
                        n = _find(window, X, Y, Z)
                        if n < 0 or not weight[n, X % SIDE, Y % SIDE, Z % SIDE] > 0.0:
                            continue
                        stop = value[n, X % SIDE, Y % SIDE, Z % SIDE]
                        if (start < 0.0) == (stop < 0.0):
                            continue
                        if not _ring(window, (x, y, z), axis, ring):
                            continue
                        if stop < 0.0:
                            ring[1], ring[3] = ring[3], ring[1]
                        first = _squared(points, ring[0] - known, ring[2] - known) <= _squared(
                            points, ring[1] - known, ring[3] - known
                        )
                        turn = 0 if first else 1
                        for t in range(3 if count + 2 <= faces.shape[0] else 0):
                            faces[count, t] = ring[(t + turn) % 4]
                            faces[count + 1, t] = ring[(t + turn + 2) % 4]
                        count += 2
    return count


@kernel
def _squared(points: F64, a: int, b: int) -> float:
    total = 0.0
    for d in range(3):
        total += (points[a, d] - points[b, d]) ** 2
    return total


@kernel
def _ring(window: VoxelGrid, at: tuple[int, int, int], axis: int, ring: I64) -> bool:
    """Vertices of the four cells around an edge from voxel ``at``; False if one is missing."""
    second, third = (axis + 1) % 3, (axis + 2) % 3
    for t in range(4):
        back_second = 1 if t == 0 or t == 3 else 0
        back_third = 1 if t < 2 else 0
        X = at[0] - (back_second if second == 0 else 0) - (back_third if third == 0 else 0)
        Y = at[1] - (back_second if second == 1 else 0) - (back_third if third == 1 else 0)
        Z = at[2] - (back_second if second == 2 else 0) - (back_third if third == 2 else 0)
        n = _find(window, X, Y, Z)
        if n < 0:
            return False
        ring[t] = window.vertex[n, X % SIDE, Y % SIDE, Z % SIDE]
        if ring[t] < 0:
            return False
    return True
