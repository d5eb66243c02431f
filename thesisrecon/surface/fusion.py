"""Depth maps fused in a sparse grid of signed distances, and the surface in it.

Each voxel holds the weighted mean of the distances that the views measure (Curless and Levoy 1996), across
the surface and not along the rays, so that ground seen at a slant is as thick as a wall; views that look past
it count as well, and the surface is where the mean is 0. Only blocks of voxels that a depth
map comes near to exist. The surface is taken out as a net (Gibson 1998): one vertex a cell, which unlike
the corners of marching cubes makes no slivers.

Section 2.6 as it stands: the surfaces of the depth maps in triangles, put together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import scipy

from thesisrecon.arrays import B8, F32, F64, I64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import decompose_camera, project
from thesisrecon.records import DepthMap, TexturedMesh
from thesisrecon.surface.fusion_kernels import (
    SIDE,
    MapSamples,
    SignedDistances,
    integrate_view,
    join_vertices,
    place_vertices,
    touched_blocks,
)
from thesisrecon.surface.linear import max_depth_slope, surface_from_depth, triangulate_grid
from thesisrecon.surface.mesh import remove_small_parts, remove_unused_vertices, select_faces

MIN_COSINE = 0.1
"""Surfaces seen more flatly than this count as seen so: what they measure across themselves is little."""

VOXEL_GROWTH = 1.15
"""Factor by which voxels grow until their blocks fit into the memory that is allowed."""


@dataclass(frozen=True)
class _Grid:
    """Where the blocks are: ``origin`` (3,) of the first voxel's centre, ``voxel`` side, ``blocks`` (B, 3)
    grid places in their order, ``place`` (X, Y, Z) the number of the block at each place or -1."""

    origin: F64
    voxel: float
    blocks: I64
    place: I64


@dataclass(frozen=True)
class VolumetricFusion:
    """One surface from several depth maps.

    ``voxel_px``: side of a voxel in pixels of the depth maps, at the median over all their pixels.
    ``truncation_voxels``: distances are cut at this many voxels; depths that are less certain take no part.
    ``max_blocks``: of 8 x 8 x 8 voxels, 4 kB each; voxels grow until that is enough. ``grazing_deg``:
    surfaces seen more flatly break. ``least_part``: connected parts below this share of the area are dropped.
    """

    voxel_px: float = 1.5
    truncation_voxels: float = 3.0
    max_blocks: int = 250_000
    grazing_deg: float = 5.0
    min_part_share: float = 0.0005

    def __post_init__(self) -> None:
        if not (0.0 < self.voxel_px < np.inf and 0.0 < self.truncation_voxels < np.inf):
            raise ValueError(
                "voxel_px > 0 and truncation_voxels > 0 are needed; got "
                f"{self.voxel_px} and {self.truncation_voxels}"
            )
        # However large voxels are, so many blocks may be about a single depth.
        least = int(np.ceil(2.0 * self.truncation_voxels / SIDE) + 1) ** 3
        if self.max_blocks < least:
            raise ValueError(f"max_blocks >= {least} is needed; got {self.max_blocks}")
        if not 0.0 < self.grazing_deg < 90.0:
            raise ValueError(f"0 < grazing_deg < 90 is needed; got {self.grazing_deg}")

    def fuse(self, depth_maps: Sequence[DepthMap], *, threads: int = 1) -> TexturedMesh:
        """The surface, without colours; faces anticlockwise seen from where the views look at it.

        The result does not depend on ``threads``. Raises :class:`StageFailure` where the maps have no depth.
        """
        with ThreadPoolExecutor(max(threads, 1)) as pool:
            measured = list(pool.map(lambda m: _measured(m, self.grazing_deg), depth_maps))
            grid, truncation, measured = self._lay_out(measured)
            value = np.zeros((len(grid.blocks), SIDE, SIDE, SIDE), dtype=np.float32)
            weight = np.zeros_like(value)
            parts = np.array_split(np.arange(len(grid.blocks)), 4 * max(threads, 1))

            def integrate(part: I64) -> None:
                if len(part):
                    some = slice(int(part[0]), int(part[-1]) + 1)
                    for one in measured:
                        _integrate(grid, truncation, one, some, value, weight)

            list(pool.map(integrate, parts))
        mesh = _extract_surface(grid, value, weight)
        if not len(mesh.faces):
            raise _nothing_to_fuse()
        return remove_small_parts(mesh, self.min_part_share)

    def _lay_out(self, measured: list[_FusionMap]) -> tuple[_Grid, float, list[_FusionMap]]:
        """The blocks that the surface may pass, where distances are cut, and the depths that are sure enough
        for that."""
        footprints = [(m.samples.depth / np.float32(m.focal))[np.isfinite(m.samples.depth)] for m in measured]
        if not sum(map(len, footprints)):
            raise _nothing_to_fuse()
        voxel = self.voxel_px * float(np.median(np.concatenate(footprints)))
        while True:
            truncation = self.truncation_voxels * voxel
            sure = [m.sure(truncation) for m in measured]
            grid = _grid(sure, voxel, truncation)
            if grid is not None and len(grid.blocks) <= self.max_blocks:
                return grid, truncation, sure
            voxel *= VOXEL_GROWTH


@dataclass(frozen=True)
class _FusionMap:
    """A depth map as the grid takes it: ``P`` (3, 4), ``focal`` in pixels, ``depth`` and ``std`` (H, W),
    ``lean`` (H, W) how far a ray comes off the surface for a unit of depth, ``slope`` the largest step in
    depth from one pixel to the next on one surface, in units of the depth."""

    P: F64
    focal: float
    samples: MapSamples

    def sure(self, truncation: float) -> _FusionMap:
        """Without depths whose deviation across the surface a grid of this resolution cannot hold."""
        with np.errstate(invalid="ignore"):
            certain = self.samples.std * self.samples.cosine <= truncation
        depth = np.where(certain, self.samples.depth, np.float32(np.nan))
        return replace(self, samples=self.samples._replace(depth=depth))

    @property
    def rays(self) -> tuple[F64, F64]:
        """What takes (x, y, 1) to the point at depth 1 less the centre (3, 3), and the centre (3,)."""
        K, R, t = decompose_camera(self.P)
        return np.ascontiguousarray(R.T @ np.linalg.inv(K)), -R.T @ t


def _measured(depth_map: DepthMap, grazing_deg: float) -> _FusionMap:
    K = decompose_camera(depth_map.P)[0]
    focal = float(np.sqrt(K[0, 0] * K[1, 1]))
    slope = float(1.0 / (focal * np.tan(np.radians(grazing_deg))))
    facing = _facing(depth_map, slope)
    return _FusionMap(
        facing.P, focal, MapSamples(facing.depth, facing.std, incidence_cosines(facing.depth, K), slope)
    )


def _integrate(grid: _Grid, truncation: float, one: _FusionMap, some: slice, value: F32, weight: F32) -> None:
    K, R, t = decompose_camera(one.P)
    P = K @ np.column_stack([R, t + R @ grid.origin])
    sums = SignedDistances(value[some], weight[some])
    integrate_view(grid.blocks[some], grid.voxel, P, one.samples, truncation, sums)


def _nothing_to_fuse() -> StageFailure:
    """The refusal of depth maps without depths."""
    return StageFailure(
        "no surface could be made",
        "the depth maps have no depths that agree",
        "take photographs of a scene with texture, from places nearer to each other",
    )


def incidence_cosines(depth: F32, K: F64) -> F32:
    """(H, W) how far a ray comes off its surface for a unit of depth: 1 seen straight on, towards 0 along it.

    Inverse depth is linear in the pixel on a plane, and its gradient with the ray gives the plane. Of the
    steps to the two neighbours the gentler counts, meaned over 3 x 3 pixels; at least ``FLATTEST``.
    """
    with np.errstate(divide="ignore"):
        inverse = np.float32(1.0) / depth
    known = np.isfinite(inverse)
    share = np.maximum(scipy.ndimage.uniform_filter(known.astype(np.float32), 3), np.float32(1e-6))
    a, b = (
        scipy.ndimage.uniform_filter(np.nan_to_num(_gentler(inverse, axis)), 3) / share for axis in (1, 0)
    )
    y, x = np.indices(inverse.shape, dtype=np.float32)
    # Pixels (x, y, 1) of inverse depth (a, b, c) . (x, y, 1) are of the plane with the normal K' (a, b, c).
    c = inverse - a * x - b * y
    normal = np.einsum("ji,j...->i...", K.astype(np.float32), np.stack([a, b, c]))
    cosine = inverse / np.sqrt((normal**2).sum(axis=0))
    return np.where(known, np.maximum(cosine, np.float32(MIN_COSINE)), np.float32(1.0))


def _gentler(values: F32, axis: int) -> F32:
    """(H, W) the smaller of the steps from the neighbour before and to the one after, NaN without either."""
    step = np.diff(values, axis=axis)
    before = np.insert(step, 0, np.nan, axis=axis)
    after = np.insert(step, step.shape[axis], np.nan, axis=axis)
    with np.errstate(invalid="ignore"):
        return np.where((np.abs(after) < np.abs(before)) | np.isnan(before), after, before)


def _facing(depth_map: DepthMap, slope: float) -> DepthMap:
    """The map without pixels whose surface is seen too flatly: their depths blend into what lies behind.

    The gentler of the steps to the two neighbours counts, so that the border of something in front stays.
    """
    depth = depth_map.depth
    steepest = np.zeros_like(depth)
    for axis in (0, 1):
        steepest = np.hypot(steepest, np.nan_to_num(_gentler(depth, axis)))
    with np.errstate(invalid="ignore"):
        flat = steepest > np.maximum(slope * depth, 3.0 * depth_map.std)
    return replace(depth_map, depth=np.where(flat, np.float32(np.nan), depth))


def _grid(measured: Sequence[_FusionMap], voxel: float, reach: float) -> _Grid | None:
    """The blocks within ``reach`` of any depth; None where the box about them is too large to be listed."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for one in measured:
        directions, centre = one.rays
        depth = one.samples.depth
        y, x = np.nonzero(np.isfinite(depth))
        xyz = centre + depth[y, x, None] * (np.stack([x, y, np.ones_like(x)], axis=1) @ directions.T)
        if len(xyz):
            low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
    if not np.isfinite(low).all():
        raise _nothing_to_fuse()
    edge = SIDE * voxel
    origin = low - 2.0 * reach
    shape = np.ceil((high - low + 4.0 * reach) / edge).astype(int) + 1
    if np.prod(shape.astype(float)) > 2e8:
        return None
    marked = np.zeros(tuple(shape), dtype=np.uint8)
    for one in measured:
        directions, centre = one.rays
        touched_blocks(one.samples, directions, centre - origin, reach, edge, marked)
    blocks = np.argwhere(marked).astype(np.int64)
    place = np.full(marked.shape, -1, dtype=np.int64)
    place[tuple(blocks.T)] = np.arange(len(blocks))
    return _Grid(origin, voxel, blocks, place)


def _extract_surface(grid: _Grid, value: F32, weight: F32) -> TexturedMesh:
    """The zero of ``value`` (B, 8, 8, 8) where ``weight`` is positive, as a net of triangles."""
    vertex = np.empty(value.shape, dtype=np.int64)
    count = place_vertices(grid.blocks, grid.place, value, weight, vertex, np.zeros((0, 3)))
    points = np.zeros((count, 3))
    place_vertices(grid.blocks, grid.place, value, weight, vertex, points)
    nothing = np.zeros((0, 3), dtype=np.int64)
    faces = np.zeros(
        (join_vertices(grid.blocks, grid.place, value, weight, vertex, points, nothing), 3), np.int64
    )
    join_vertices(grid.blocks, grid.place, value, weight, vertex, points, faces)
    return remove_unused_vertices(TexturedMesh(grid.origin + grid.voxel * points, faces))


@dataclass(frozen=True)
class DepthSheets:
    """Every depth map is a sheet of triangles; what an earlier sheet shows too is left out of a later one.

    The map with most depths comes first. Nothing is averaged: sheets overlap at their rims, a little apart.
    ``step``: every so many rows and columns. ``same``: relative difference of depths up to which a place is
    the same, beside three deviations. ``grazing_deg``: what is seen more flatly breaks. ``least_part``:
    connected parts of a map below this share of its area are dropped.
    """

    step: int = 2
    same: float = 0.02
    grazing_deg: float = 10.0
    min_part_share: float = 0.0005

    def __post_init__(self) -> None:
        if self.step < 1 or not self.same >= 0.0 or not 0.0 < self.grazing_deg < 90.0:
            raise ValueError(
                "step >= 1, same >= 0 and 0 < grazing_deg < 90 are needed; got "
                f"{self.step}, {self.same} and {self.grazing_deg}"
            )

    def fuse(self, depth_maps: Sequence[DepthMap], *, threads: int = 1) -> TexturedMesh:  # noqa: ARG002
        """The sheets as one mesh, without colours; :class:`StageFailure` where the maps have no depth."""
        order = sorted(depth_maps, key=lambda m: (-int(np.isfinite(m.depth).sum()), m.view))
        sheets: list[TexturedMesh] = []
        shows: list[Callable[[F64], B8]] = []
        for depth_map in order:
            sheet = remove_small_parts(
                surface_from_depth(depth_map, step=self.step, grazing_deg=self.grazing_deg),
                self.min_part_share,
            )
            shown = np.zeros(len(sheet.vertices), dtype=bool)
            for earlier in shows:
                shown |= earlier(sheet.vertices)
            shows.append(self._shown_by(depth_map))
            sheets.append(select_faces(sheet, np.asarray(~shown[sheet.faces].all(axis=1))))
        if not sum(len(sheet.faces) for sheet in sheets):
            raise _nothing_to_fuse()
        starts = np.cumsum([0, *(len(sheet.vertices) for sheet in sheets[:-1])])
        faces = [sheet.faces + start for sheet, start in zip(sheets, starts, strict=True)]
        vertices = np.concatenate([sheet.vertices for sheet in sheets])
        return TexturedMesh(vertices, np.concatenate(faces))

    def _shown_by(self, depth_map: DepthMap) -> Callable[[F64], B8]:
        """Which of points (N, 3) lie on the sheet of a map: in a whole square of it, at its depth."""
        depth = depth_map.depth[:: self.step, :: self.step].astype(np.float64)
        std = depth_map.std[:: self.step, :: self.step].astype(np.float64)
        slope = self.step * max_depth_slope(depth_map.P, self.grazing_deg)
        whole: B8 = np.asarray(triangulate_grid(depth, std, slope).whole.all(axis=-1))

        def shown(X: F64) -> B8:
            z = X @ depth_map.P[2, :3] + depth_map.P[2, 3]
            with np.errstate(divide="ignore", invalid="ignore"):
                at = project(depth_map.P, X) / self.step
            inside: B8 = np.asarray((z > 0.0) & np.all((at >= 0.0) & (at < whole.shape[::-1]), axis=1))
            place = np.where(inside[:, None], at, 0.0)
            x, y = place.astype(np.int64).T
            inside = inside & whole[y, x]
            n = np.flatnonzero(inside)
            (x, y), (u, v) = np.stack([x, y])[:, n], place[n].T % 1.0
            a, b, c, d = (1.0 / depth[y + k, x + m] for k in (0, 1) for m in (0, 1))
            there = 1.0 / ((1.0 - v) * ((1.0 - u) * a + u * b) + v * ((1.0 - u) * c + u * d))
            inside[n] = np.abs(there - z[n]) <= np.maximum(self.same * z[n], 3.0 * std[y, x])
            return np.asarray(inside)

        return shown
