"""Fusion of depth maps to one surface (thesis, 2.6): volumetric (TSDF), or as a union of sheets.

:class:`VolumetricFusion` averages signed distances across the surface in a sparse voxel grid (Curless and
Levoy 1996) and extracts the zero level as a surface net (Gibson 1998): one vertex per cell, no slivers.
:class:`DepthSheets` follows the thesis.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, pairwise
from typing import NamedTuple

import numpy as np
import scipy

from thesisrecon._numba import ThreadPool, empty, kernel
from thesisrecon.arrays import B8, F32, F64, I32, I64
from thesisrecon.camera import compose_camera, decompose_camera
from thesisrecon.errors import StageFailure, require_range
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.imaging.on_demand import OnDemand
from thesisrecon.imaging.resampling import bilinear_samples
from thesisrecon.records import DepthMap, TexturedMesh
from thesisrecon.surface import _mesh
from thesisrecon.surface._simplification import simplify_surface

GROUP_BYTES, MEDIAN_PIXELS = 2**30, 2**26
"""Prepared depth maps in memory at a time, and pixels from which the voxel size is computed."""
TRUNCATION_VOXELS = 3.0  #: truncation of the signed distances; less certain depths are ignored
SLAB_BLOCKS, TASK_BLOCKS = 8192, 512
"""Blocks in memory at a time, besides a layer before and after them, and blocks of one task."""


SIDE = 8  #: voxels per side of a block


class FusionMap(NamedTuple):
    """A depth map prepared for fusion."""

    P: F64  #: (3, 4) K [R t]
    focal: float  #: px
    depth: F32  #: (H, W) NaN = unknown
    std: F32  #: (H, W)
    cosine: F32  #: (H, W) distance across the surface per unit of depth
    slope: float  #: largest relative depth step between neighbours on one surface


class VoxelGrid(NamedTuple):
    """Sparse voxel grid, and the values of its blocks from number ``first`` on."""

    origin: F64
    voxel: float
    blocks: I64  #: (B, 3) grid positions of all blocks
    place: I32  #: (X, Y, Z) block number at each position or -1
    first: int
    value: F32  #: (W, 8, 8, 8) signed distance
    weight: F32  #: (W, 8, 8, 8) its weight
    vertex: I32  #: (W, 8, 8, 8) vertex number or -1


@kernel
def integrate_view(
    blocks: I64, voxel: float, P: F64, surface: FusionMap, truncation: float, value: F32, weight: F32
) -> None:
    """Add one depth map to the signed distances of blocks, in truncations (Curless and Levoy 1996).

    ``P``: camera K [R t] about the first voxel. Voxels farther behind the surface are not visible. The weight
    is cos^4 / (s^2 + (truncation / 8)^2) with the standard deviation s across the surface: it is assumed
    plane near the ray, with an error that grows with 1 / cos^2.
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
    """Depth at (u, v), the row and column it is taken from, and its weight; NaN if all four are unknown."""
    # Bilinear in 1 / z on one surface, else of the nearest pixel or, if unknown, of the next of the four,
    # because a surface net ends half a voxel before the last depth.
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
    other_row, other_column, trust = y + y1 - row, x + x1 - column, 1.0
    j, i = row, column
    for k in range(1, 4):
        if depth[j, i] == depth[j, i]:
            break
        j, i, trust = other_row if k > 1 else row, other_column if k != 2 else column, weight_beyond
    return depth[j, i], (j, i), trust


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

    ``rows``: first and last + 1 block; ``window.vertex`` receives numbers from the first block on, or -1,
    ``points`` (N, 3) the mean zero crossings of the cell edges in voxels. Returns the number of vertices.
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
    """Two triangles across each voxel edge that the surface crosses, anticlockwise from outside.

    ``rows``: first and last + 1 block; ``points`` from number ``known`` on; ``faces`` (M, 3) receives the
    first M. Returns their number; the shorter diagonal is used.
    """
    count = 0
    ring, cell = empty(4, np.int64), empty(3, np.int64)
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
                        if not _ring(window, (x, y, z), axis, cell, ring):
                            continue
                        if stop < 0.0:
                            ring[1], ring[3] = ring[3], ring[1]
                        rising = _squared(points, ring[0] - known, ring[2] - known)
                        turn = 0 if rising <= _squared(points, ring[1] - known, ring[3] - known) else 1
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
def _ring(window: VoxelGrid, at: tuple[int, int, int], axis: int, cell: I64, ring: I64) -> bool:
    """Vertices of the four cells around an edge from voxel ``at``; False if one is missing."""
    second, third = (axis + 1) % 3, (axis + 2) % 3
    cell[axis] = at[axis]
    for t in range(4):
        cell[second], cell[third] = at[second] - (t == 0 or t == 3), at[third] - (t < 2)
        n = _find(window, cell[0], cell[1], cell[2])
        ring[t] = window.vertex[n, cell[0] % SIDE, cell[1] % SIDE, cell[2] % SIDE] if n >= 0 else -1
        if ring[t] < 0:
            return False
    return True


@dataclass(frozen=True)
class VolumetricFusion:
    """Fusion of depth maps in a truncated signed distance field."""

    voxel_px: float = 1.5
    """Voxel size in pixels of the depth maps at their median depth; larger if the model is too large."""
    tolerance: float = 0.25
    """RMS distance by which the simplified surface may deviate from the faces it replaces, in standard
    deviations of the fused depths there (of at most a voxel); 0: no simplification."""

    # Largest number of blocks of 8 x 8 x 8 voxels (4 kB each); voxels are enlarged to fit.
    max_blocks = 250_000

    def __post_init__(self) -> None:
        require_range(self, voxel_px="(0, inf)", tolerance="[0, inf)")

    def fuse(self, depth_maps: Sequence[DepthMap], *, threads: int = 1) -> TexturedMesh:
        """Fuse depth maps to one surface."""
        max_std_voxels = 1.0  # Upper limit of the standard deviations in the tolerance of the simplification
        # Longest side of a simplified face: a texture needs images that show a face completely.
        longest_voxels = 16.0
        surface, std, voxel = self._fused(depth_maps, threads)
        if not len(surface.faces):
            raise StageFailure.of("no-surface-of-depths", "the depth maps contain no depths that agree")
        if self.tolerance:
            limit, longest = self.tolerance * np.minimum(std, max_std_voxels * voxel), longest_voxels * voxel
            surface = simplify_surface(surface, limit, longest=longest, threads=threads, overwrite=True)
        return _mesh.remove_small_parts(surface)

    def _fused(self, depth_maps: Sequence[DepthMap], threads: int) -> tuple[TexturedMesh, F64, float]:
        """The surface of all voxels, the standard deviation at its vertices, and the voxel size."""
        maps = OnDemand(len(depth_maps), lambda n: _measured(depth_maps[n]), GROUP_BYTES)
        with ThreadPool(threads) as pool:
            grid = self._lay_out(maps, sum(one.depth.size for one in depth_maps), pool)
            return *_zero_level(grid, maps, pool), grid.voxel

    def _lay_out(self, maps: Sequence[FusionMap], pixels: int, pool: ThreadPool) -> VoxelGrid:
        """Empty grid of the smallest voxels whose blocks fit into memory."""
        voxel_growth = 1.15  # Factor by which voxels are enlarged until the blocks fit into memory
        step = max(1, -(-pixels // MEDIAN_PIXELS))
        footprints = [
            (m.depth / np.float32(m.focal))[np.isfinite(m.depth)][::step]
            for m in chain.from_iterable(_certain_maps(maps, np.inf, pool))
        ]
        if not sum(map(len, footprints)):
            raise StageFailure.of("no-surface-of-depths", "the depth maps contain no depths that agree")
        voxel = self.voxel_px * float(np.median(np.concatenate(footprints)))
        while True:
            grid = _empty_grid(maps, voxel, pool)
            if grid is not None and len(grid.blocks) <= self.max_blocks:
                return grid
            voxel *= voxel_growth


def _certain_maps(
    maps: Sequence[FusionMap], truncation: float, pool: ThreadPool
) -> Iterator[list[FusionMap]]:
    """Groups of maps without depths whose standard deviation across the surface exceeds the truncation."""
    group = 8  # Maps that are in memory at a time, besides those kept in ``GROUP_BYTES``

    def certain(n: int) -> FusionMap:
        one = maps[n]
        with np.errstate(invalid="ignore"):
            depth = np.where(one.std * one.cosine <= truncation, one.depth, np.float32(np.nan))
        return one._replace(depth=depth)

    for first in range(0, len(maps), group):
        yield list(pool.map(certain, range(first, min(first + group, len(maps)))))


def _surface_points(one: FusionMap) -> tuple[F64, F64, F64]:
    """Points (N, 3) of a map, the steps of their rays (N, 3) per unit of depth, and their cosines (N,)."""
    inverse = np.asarray(np.linalg.inv(one.P[:, :3]), dtype=np.float64)
    y, x = np.nonzero(one.depth > 0.0)
    rays = np.stack([x, y, np.ones_like(x)], axis=1) @ inverse.T
    return one.depth[y, x, None] * rays - inverse @ one.P[:, 3], rays, one.cosine[y, x].astype(np.float64)


def _measured(depth_map: DepthMap) -> FusionMap:
    fused_grazing_deg = 5.0  # Surfaces break where they are seen at a smaller angle
    K, R, t = decompose_camera(depth_map.P)
    slope = _mesh.max_depth_slope(depth_map.P, fused_grazing_deg)
    # Pixels at grazing incidence blend into the background; borders stay.
    depth, steepest = depth_map.depth, np.zeros_like(depth_map.depth)
    for axis in (0, 1):
        steepest = np.hypot(steepest, np.nan_to_num(_smaller_difference(depth, axis)))
    with np.errstate(invalid="ignore"):
        flat = steepest > np.maximum(slope * depth, 3.0 * depth_map.std)
    depth, focal = np.where(flat, np.float32(np.nan), depth), float(np.sqrt(K[0, 0] * K[1, 1]))
    cosines = _incidence_cosines(depth, K)
    return FusionMap(compose_camera(K, R, t), focal, depth, depth_map.std, cosines, slope)


def _incidence_cosines(depth: F32, K: F64) -> F32:
    """n . r (H, W) of the unit surface normal n and the ray r of unit depth: distance across per depth."""
    # The inverse depth of a plane is linear in the pixel, and its gradient determines the normal: the smaller
    # of the differences to both neighbours, averaged over 3 x 3 pixels.
    min_cosine = 0.1  # Lower limit of the incidence cosine
    with np.errstate(divide="ignore"):
        inverse = np.float32(1.0) / depth
    known = np.isfinite(inverse)
    share = np.maximum(scipy.ndimage.uniform_filter(known.astype(np.float32), 3), np.float32(1e-6))
    a, b = (
        scipy.ndimage.uniform_filter(np.nan_to_num(_smaller_difference(inverse, axis)), 3) / share
        for axis in (1, 0)
    )
    y, x = np.indices(inverse.shape, dtype=np.float32)
    # The plane with inverse depth (a, b, c) . (x, y, 1) has the normal K' (a, b, c).
    c = inverse - a * x - b * y
    normal = np.einsum("ji,j...->i...", K.astype(np.float32), np.stack([a, b, c]))
    cosine = inverse / np.sqrt((normal**2).sum(axis=0))
    return np.where(known, np.maximum(cosine, np.float32(min_cosine)), np.float32(1.0))


def _smaller_difference(values: F32, axis: int) -> F32:
    """The smaller of the differences to the previous and the next neighbour, NaN without either."""
    step = np.diff(values, axis=axis)
    before = np.insert(step, 0, np.nan, axis=axis)
    after = np.insert(step, step.shape[axis], np.nan, axis=axis)
    with np.errstate(invalid="ignore"):
        return np.where((np.abs(after) < np.abs(before)) | np.isnan(before), after, before)


def _empty_grid(maps: Sequence[FusionMap], voxel: float, pool: ThreadPool) -> VoxelGrid | None:
    """Blocks within the truncation of any depth; None if their bounding box is too large."""
    low, high, reach = np.full(3, np.inf), np.full(3, -np.inf), TRUNCATION_VOXELS * voxel
    for one in chain.from_iterable(_certain_maps(maps, reach, pool)):
        xyz = _surface_points(one)[0]
        if len(xyz):
            low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
    if not np.isfinite(low).all():
        raise StageFailure.of("no-surface-of-depths", "the depth maps contain no depths that agree")
    edge = SIDE * voxel
    origin = low - 2.0 * reach
    shape = np.ceil((high - low + 4.0 * reach) / edge).astype(int) + 1
    if np.prod(shape.astype(float)) > 2e8:
        return None
    marked = np.zeros(shape, dtype=bool)
    for one in chain.from_iterable(_certain_maps(maps, reach, pool)):
        xyz, rays, cosine = _surface_points(one)
        along = reach / cosine
        # Steps of half a block reach every block within the truncation.
        steps = np.ceil(4.0 * along / edge).astype(int)
        for s in range(int(steps.max(initial=-1)) + 1):
            some = s <= steps
            ahead = along[some] * (2.0 * s / steps[some] - 1.0)
            place = np.floor((xyz[some] + ahead[:, None] * rays[some] - origin) / edge).astype(int)
            marked[tuple(place[((place >= 0) & (place < shape)).all(axis=1)].T)] = True
    blocks = np.argwhere(marked).astype(np.int64)
    place = np.full(marked.shape, -1, dtype=np.int32)
    place[tuple(blocks.T)] = np.arange(len(blocks))
    none = np.empty((0, SIDE, SIDE, SIDE), np.float32)
    return VoxelGrid(origin, voxel, blocks, place, 0, none, none, none.astype(np.int32))


def _zero_level(grid: VoxelGrid, maps: Sequence[FusionMap], pool: ThreadPool) -> tuple[TexturedMesh, F64]:
    """Zero level of the fused distances as a surface net, and the standard deviation at each vertex."""
    # Computed slab by slab of layers of blocks, with the layers before (faces use their vertices) and after
    # (cells use their voxels). Weights are inverse variances.
    # The first block of each layer, with an empty layer before the first and after the last one.
    layers = np.searchsorted(grid.blocks[:, 0], np.arange(-1, grid.place.shape[0] + 2)).tolist()
    points, faces, weights = [np.zeros((0, 3))], [np.zeros((0, 3), np.int32)], [np.zeros(0, np.float32)]
    first, known = 1, 0
    while first < len(layers) - 2:
        last = max(first + 1, min(bisect_right(layers, layers[first] + SLAB_BLOCKS), len(layers) - 1) - 1)
        grid = _moved(grid, layers[first - 1], layers[last + 1], maps, pool)
        rows = [*range(layers[first], layers[last], TASK_BLOCKS), layers[last]]
        found = list(pool.map(partial(_placed, grid), pairwise(rows)))
        starts = np.cumsum([known + len(points[-1]), *map(len, found)]).tolist()
        near = np.concatenate([points[-1], *found])
        for start, (begin, end) in zip(starts[:-1], pairwise(rows), strict=True):
            own = grid.vertex[begin - grid.first : end - grid.first]
            own[own >= 0] += start
            weights.append(grid.weight[begin - grid.first : end - grid.first][own >= 0])
        faces += pool.map(partial(_joined, grid, near, known), pairwise(rows), map(len, found))
        known += len(points[-1])
        points.append(near[len(points[-1]) :])
        first = last
    vertices = np.concatenate(points)
    vertices *= grid.voxel
    vertices += grid.origin
    std = 1.0 / np.sqrt(np.concatenate(weights, dtype=float))
    return TexturedMesh(vertices, np.concatenate(faces)), std


def _moved(grid: VoxelGrid, begin: int, end: int, maps: Sequence[FusionMap], pool: ThreadPool) -> VoxelGrid:
    """The grid with the values of blocks ``begin`` to ``end``; those after the previous ones are computed."""
    kept, truncation = slice(begin - grid.first, None), TRUNCATION_VOXELS * grid.voxel
    done, size = len(grid.value) - kept.start, end - begin
    value, weight, vertex = (
        np.concatenate([array[kept], np.zeros((size - done, *array.shape[1:]), array.dtype)])
        for array in (grid.value, grid.weight, grid.vertex)
    )

    def integrate(group: Sequence[FusionMap], part: tuple[int, int]) -> None:
        rows, blocks = slice(*part), grid.blocks[begin + part[0] : begin + part[1]]
        for one in group:
            P = np.column_stack([one.P[:, :3], one.P[:, 3] + one.P[:, :3] @ grid.origin])
            integrate_view(blocks, grid.voxel, P, one, truncation, value[rows], weight[rows])

    parts = [*pairwise([*range(done, size, TASK_BLOCKS), size])]
    for group in _certain_maps(maps, truncation, pool):
        list(pool.map(partial(integrate, group), parts))
    return grid._replace(first=begin, value=value, weight=weight, vertex=vertex)


def _placed(grid: VoxelGrid, rows: tuple[int, int]) -> F64:
    """The vertices (N, 3) of some blocks, at most one per voxel."""
    points = np.empty((SIDE**3 * (rows[1] - rows[0]), 3))
    return points[: place_vertices(rows, grid, points)].copy()


def _joined(grid: VoxelGrid, points: F64, known: int, rows: tuple[int, int], vertices: int) -> I32:
    """The faces (M, 3) of some blocks; they are joined again if there are more than usual per vertex."""
    join, faces = partial(join_vertices, rows, grid, points, known), np.empty((3 * vertices, 3), np.int32)
    if (count := join(faces)) > len(faces):
        faces = np.empty((count, 3), np.int32)
        join(faces)
    return faces[:count]


@dataclass(frozen=True)
class DepthSheets:
    """Union of the triangulated depth maps; regions that an earlier map shows are omitted.

    The map with the most depths comes first. Nothing is averaged, so sheets overlap slightly at their
    borders.
    """

    step: int = 2  #: row and column step of the triangulation

    def __post_init__(self) -> None:
        require_range(self, step="[1, inf)")

    def fuse(self, depth_maps: Sequence[DepthMap], *, threads: int = 1) -> TexturedMesh:  # noqa: ARG002
        """See `thesisrecon.surface.fusion.VolumetricFusion.fuse`; one thread is used."""
        order = sorted(depth_maps, key=lambda m: (-int(np.isfinite(m.depth).sum()), m.view))
        sheets: list[TexturedMesh] = []
        shows: list[Callable[[F64], B8]] = []
        for depth_map in order:
            sheet = _mesh.remove_small_parts(_mesh.surface_from_depth(depth_map, step=self.step))
            shown = np.zeros(len(sheet.vertices), dtype=bool)
            for earlier in shows:
                shown |= earlier(sheet.vertices)
            shows.append(self._coverage_test(depth_map))
            sheets.append(_mesh.select_faces(sheet, np.asarray(~shown[sheet.faces].all(axis=1))))
        if not sum(len(sheet.faces) for sheet in sheets):
            raise StageFailure.of("no-surface-of-depths", "the depth maps contain no depths that agree")
        starts = np.cumsum([0, *(len(sheet.vertices) for sheet in sheets[:-1])])
        faces = [sheet.faces + start for sheet, start in zip(sheets, starts, strict=True)]
        vertices = np.concatenate([sheet.vertices for sheet in sheets])
        return TexturedMesh(vertices, np.concatenate(faces))

    def _coverage_test(self, depth_map: DepthMap) -> Callable[[F64], B8]:
        """Function that tests whether points (N, 3) lie on the sheet of a map."""
        # Relative depth difference, or three standard deviations, up to which a sheet already shows a point.
        max_relative = 0.02
        depth = depth_map.depth[:: self.step, :: self.step].astype(np.float64)
        std = depth_map.std[:: self.step, :: self.step].astype(np.float64)
        slope = self.step * _mesh.max_depth_slope(depth_map.P, _mesh.GRAZING_DEG)
        whole: B8 = np.asarray(_mesh.triangulate_grid(depth, std, slope)[1].all(axis=-1))

        def shown(X: F64) -> B8:
            z = X @ depth_map.P[2, :3] + depth_map.P[2, 3]
            with np.errstate(divide="ignore", invalid="ignore"):
                at = project(depth_map.P, X) / self.step
            inside: B8 = np.asarray((z > 0.0) & np.all((at >= 0.0) & (at < whole.shape[::-1]), axis=1))
            place = np.where(inside[:, None], at, 0.0)
            x, y = place.astype(np.int64).T
            there = 1.0 / bilinear_samples(1.0 / depth[..., None], *place.T)[0][:, 0]
            near = np.abs(there - z) <= np.maximum(max_relative * z, 3.0 * std[y, x])
            return np.asarray(inside & whole[y, x] & near)

        return shown
