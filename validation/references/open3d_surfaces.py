"""Open3D's surfaces of depth maps with the interface of our stage: truncated distances and Poisson.

Its voxel grids take the pixel that the truncated coordinates name, so the centre of the top-left pixel is
(0.5, 0.5) there; its points of a depth image have it at (0, 0) as ours. (``ScalableTSDFVolume`` of 0.20.0
gives empty meshes; the grid of blocks is its successor.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thesisrecon.records import DepthMap, PinholeView, TexturedMesh
from validation.references.libraries import open3d as o3d
from validation.references.open3d_cameras import camera_of, median_footprint


@dataclass(frozen=True)
class OpenTsdf:
    """Truncated signed distances in a grid of blocks (``VoxelBlockGrid``), surface by marching cubes.

    ``voxel_px``: side of a voxel in pixels at the median depth, as ``VolumetricFusion`` has it.
    ``truncation_voxels``. ``least_views``: how many maps must have seen a voxel.
    """

    voxel_px: float = 1.5
    truncation_voxels: float = 4.0
    least_views: int = 1

    def fuse(self, depth_maps: Sequence[DepthMap], views: Sequence[PinholeView]) -> TexturedMesh:
        """The surface with colours of its vertices, means over the images ``views`` of the maps."""
        kinds = (o3d.core.float32,) * 3
        grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"),
            kinds,
            ((1,), (1,), (3,)),
            median_footprint(depth_maps) * self.voxel_px,
            8,
            50_000,
            o3d.core.Device("CPU:0"),
        )
        for depth_map, view in zip(depth_maps, views, strict=True):
            self._integrate(grid, depth_map, view)
        found = grid.extract_triangle_mesh(self.least_views - 0.5)
        colors = np.clip(np.rint(found.vertex.colors.numpy()), 0, 255).astype(np.uint8)
        faces = found.triangle.indices.numpy().astype(np.int64)
        return TexturedMesh(found.vertex.positions.numpy().astype(np.float64), faces, colors=colors)

    def _integrate(self, grid: Any, depth_map: DepthMap, view: PinholeView) -> None:
        if depth_map.depth.shape != view.rgb.shape[:2]:
            raise ValueError("each depth map needs its image at its own size")
        K, world = camera_of(depth_map.P, shift=0.5)
        depth = o3d.t.geometry.Image(o3d.core.Tensor(np.nan_to_num(depth_map.depth).astype(np.float32)))
        color = o3d.t.geometry.Image(o3d.core.Tensor(view.rgb.astype(np.float32)))
        intrinsic, extrinsic = o3d.core.Tensor(K), o3d.core.Tensor(world)
        far = 1.01 * float(np.nanmax(depth_map.depth, initial=0.0)) + 1e-9
        cut = (1.0, far, self.truncation_voxels)
        blocks = grid.compute_unique_block_coordinates(depth, intrinsic, extrinsic, *cut)
        grid.integrate(blocks, depth, color, intrinsic, intrinsic, extrinsic, *cut)


def poisson_mesh(
    depth_maps: Sequence[DepthMap], *, depth: int = 9, least_density: float = 0.05
) -> TexturedMesh:
    """Screened Poisson surface of the points of all maps, with normals of each map's own neighbourhoods.

    ``depth`` of the octree; ``least_density``: the share of vertices with the fewest points that is cut off,
    since the surface is closed where there is nothing.
    """
    cloud = o3d.geometry.PointCloud()
    for one in depth_maps:
        K, world = camera_of(one.P)
        height, width = one.depth.shape
        pinhole = o3d.camera.PinholeCameraIntrinsic(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        image = o3d.geometry.Image(np.nan_to_num(one.depth).astype(np.float32))
        part = o3d.geometry.PointCloud.create_from_depth_image(
            image, pinhole, world, depth_scale=1.0, depth_trunc=1e9, stride=2
        )
        part.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(16))
        part.orient_normals_towards_camera_location(-world[:3, :3].T @ world[:3, 3])
        cloud += part
    mesh, density = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    values = np.asarray(density)
    mesh.remove_vertices_by_mask(values < np.quantile(values, least_density))
    return TexturedMesh(
        np.asarray(mesh.vertices).copy(),
        # Faces are oriented like the normals, towards the cameras: anticlockwise outside, as ours.
        np.asarray(mesh.triangles).astype(np.int64),
    )
