"""Meshes in Open3D: distances to them, images of them, files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from thesisrecon.arrays import F64, I64, U8
from thesisrecon.camera import Camera
from thesisrecon.records import TexturedMesh
from validation.references.libraries import open3d as o3d
from validation.references.open3d_cameras import camera_of


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


def render_open3d(mesh: TexturedMesh, camera: Camera) -> U8:
    """(H, W, 3): the colours of the vertices as Open3D's own off-screen renderer draws them, unlit.

    Raises ``RuntimeError`` if the machine has no graphics that it can use.
    """
    width, height = camera.size
    renderer = o3d.visualization.rendering.OffscreenRenderer(width, height)
    material = o3d.visualization.rendering.MaterialRecord()
    material.shader = "defaultUnlit"
    drawn = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.faces.astype(np.int32))
    )
    if mesh.colors is not None:
        drawn.vertex_colors = o3d.utility.Vector3dVector(mesh.colors / 255.0)
    renderer.scene.set_background([0.0, 0.0, 0.0, 1.0])
    renderer.scene.view.set_post_processing(False)
    renderer.scene.add_geometry("model", drawn, material)
    K, world = camera_of(camera.P, shift=0.5)
    renderer.setup_camera(K, world, width, height)
    return np.asarray(renderer.render_to_image()).copy()


def read_glb(path: Path) -> tuple[F64, I64, F64, U8]:
    """Vertices (N, 3) in glTF's axes, faces (M, 3), texture coordinates (M, 3, 2), v up, and the texture of a
    GLB as Open3D reads it."""
    model = o3d.io.read_triangle_model(str(path))
    mesh = model.meshes[0].mesh
    albedo = np.asarray(model.materials[model.meshes[0].material_idx].albedo_img)
    uv = np.asarray(mesh.triangle_uvs).reshape(-1, 3, 2)
    faces = np.asarray(mesh.triangles).astype(np.int64)
    return np.asarray(mesh.vertices).copy(), faces, uv.copy(), albedo[..., :3].copy()
