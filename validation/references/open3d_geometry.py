"""Open3D with our types: motions by ICP, distances to meshes, images of them, and surfaces of depth maps.

Its voxel grids have the centre of the top-left pixel at (0.5, 0.5), its points of a depth image at (0, 0) as
ours. (``ScalableTSDFVolume`` of 0.20.0 gives empty meshes; the grid of blocks is its successor.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from thesisrecon.arrays import F64, U8
from thesisrecon.camera import Camera, decompose_camera
from thesisrecon.records import DepthMap, PinholeView, TexturedMesh
from validation.references.libraries import open3d as o3d


def camera_of(P: F64, *, shift: float = 0.0) -> tuple[F64, F64]:
    """K (3, 3) with its principal point moved by ``shift`` px, and the world-to-camera matrix (4, 4)."""
    K, R, t = decompose_camera(P)
    if abs(K[0, 1]) > 1e-6 * K[0, 0]:
        raise ValueError(f"Open3D does not support skew; got {K[0, 1]:.3g} px")
    K = np.array([[K[0, 0], 0.0, K[0, 2] + shift], [0.0, K[1, 1], K[1, 2] + shift], [0.0, 0.0, 1.0]])
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = R, t
    return K, world


def median_footprint(depth_maps: Sequence[DepthMap]) -> float:
    """Width of a pixel at its depth, the median over all pixels of all maps."""
    widths = []
    for one in depth_maps:
        K = decompose_camera(one.P)[0]
        widths.append(one.depth[np.isfinite(one.depth)] / np.sqrt(K[0, 0] * K[1, 1]))
    return float(np.median(np.concatenate(widths)))


def refine_by_icp(moving: F64, fixed: F64, reach: float) -> F64:
    """The motion (4, 4) by which point-to-point ICP, without scale, brings (N, 3) onto (M, 3). Pairs are no
    farther apart than ``reach``.
    """
    clouds = [
        o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(X, dtype=np.float64)))
        for X in (moving, fixed)
    ]
    criteria = o3d.pipelines.registration.ICPConvergenceCriteria(1e-9, 1e-9, 60)
    method = o3d.pipelines.registration.TransformationEstimationPointToPoint(False)
    found = o3d.pipelines.registration.registration_icp(*clouds, reach, np.eye(4), method, criteria)
    return np.array(found.transformation, dtype=np.float64)


class Nearest:
    """A surface prepared for distance queries."""

    def __init__(self, mesh: TexturedMesh) -> None:
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(
            o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32))
        )

    def distances(self, points: F64) -> F64:
        """(N,) distances of points (N, 3) to its nearest place."""
        found = self._scene.compute_distance(o3d.core.Tensor(points.astype(np.float32)), nthreads=1)
        return np.asarray(found.numpy(), dtype=np.float64)


def _triangles(mesh: TexturedMesh) -> Any:
    return o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.faces.astype(np.int32))
    )


def render_open3d(mesh: TexturedMesh, camera: Camera) -> U8:
    """(H, W, 3): the colours of the vertices as Open3D's own off-screen renderer draws them, unlit. Raises
    ``RuntimeError`` if the machine has no graphics that it can use.
    """
    width, height = camera.size
    renderer = o3d.visualization.rendering.OffscreenRenderer(width, height)
    material = o3d.visualization.rendering.MaterialRecord()
    material.shader = "defaultUnlit"
    drawn = _triangles(mesh)
    if mesh.colors is not None:
        drawn.vertex_colors = o3d.utility.Vector3dVector(mesh.colors / 255.0)
    renderer.scene.set_background([0.0, 0.0, 0.0, 1.0])
    renderer.scene.view.set_post_processing(False)
    renderer.scene.add_geometry("model", drawn, material)
    K, world = camera_of(camera.P, shift=0.5)
    renderer.setup_camera(K, world, width, height)
    return np.asarray(renderer.render_to_image()).copy()


class OpenTsdf(NamedTuple):
    """Truncated signed distances in a grid of blocks (``VoxelBlockGrid``), surface by marching cubes.
    ``voxel_px``: side of a voxel in pixels at the median depth, as ``VolumetricFusion`` has it.
    """

    voxel_px: float = 1.5

    def fuse(self, depth_maps: Sequence[DepthMap], views: Sequence[PinholeView]) -> TexturedMesh:
        """The surface with colours of its vertices, means over the images ``views`` of the maps."""
        kinds, channels = (o3d.core.float32,) * 3, ((1,), (1,), (3,))
        side = median_footprint(depth_maps) * self.voxel_px
        where = (8, 50_000, o3d.core.Device("CPU:0"))
        grid = o3d.t.geometry.VoxelBlockGrid(("tsdf", "weight", "color"), kinds, channels, side, *where)
        for depth_map, view in zip(depth_maps, views, strict=True):
            self._integrate(grid, depth_map, view)
        found = grid.extract_triangle_mesh(0.5)
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
        cut = (1.0, far, 4.0)
        blocks = grid.compute_unique_block_coordinates(depth, intrinsic, extrinsic, *cut)
        grid.integrate(blocks, depth, color, intrinsic, intrinsic, extrinsic, *cut)


def poisson_mesh(
    depth_maps: Sequence[DepthMap], *, depth: int = 9, least_density: float = 0.05
) -> TexturedMesh:
    """Screened Poisson surface of the points of all maps, with normals of each map's own neighbourhoods;
    ``least_density``: the share of vertices with the fewest points that is cut off.
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
    # Faces are oriented like the normals, towards the cameras: anticlockwise outside, as ours.
    return TexturedMesh(np.asarray(mesh.vertices).copy(), np.asarray(mesh.triangles).astype(np.int64))
