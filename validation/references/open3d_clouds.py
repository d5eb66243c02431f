"""Clouds in Open3D: ICP after a similarity, and images without a screen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from thesisrecon.arrays import F64
from validation.references.libraries import open3d as o3d

SIZE = (900, 640)
ITERATIONS = 60


def cloud(X: F64, colors: F64 | None = None) -> Any:
    """Points (N, 3) and their colours (N, 3), 0 .. 1."""
    made = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(X, dtype=np.float64)))
    if colors is not None:
        made.colors = o3d.utility.Vector3dVector(np.asarray(colors, dtype=np.float64))
    return made


def refine_by_icp(moving: F64, fixed: F64, reach: float) -> F64:
    """The motion (4, 4) by which point-to-point ICP, without scale, brings (N, 3) onto (M, 3); pairs are no
    farther apart than ``reach``."""
    criteria = o3d.pipelines.registration.ICPConvergenceCriteria(1e-9, 1e-9, ITERATIONS)
    method = o3d.pipelines.registration.TransformationEstimationPointToPoint(False)
    found = o3d.pipelines.registration.registration_icp(
        cloud(moving), cloud(fixed), reach, np.eye(4), method, criteria
    )
    return np.array(found.transformation, dtype=np.float64)


def render_difference(path: Path, mine: F64, other: F64, reach: float) -> None:
    """A PNG of both clouds: ours from blue (no distance to the other) to red (``reach``), the other grey."""
    share = np.minimum(cKDTree(other).query(mine)[0] / reach, 1.0)
    colors = np.stack([share, 0.35 * (1.0 - share), 1.0 - share], axis=1)
    renderer = o3d.visualization.rendering.OffscreenRenderer(*SIZE)
    try:
        scene = renderer.scene
        scene.set_background([0.96, 0.97, 0.98, 1.0])
        material = o3d.visualization.rendering.MaterialRecord()
        material.shader, material.point_size = "defaultUnlit", 3.0
        grey = np.full((len(other), 3), 0.72)
        scene.add_geometry("other", cloud(other, grey), material)
        scene.add_geometry("mine", cloud(mine, colors), material)
        low, high = np.quantile(mine, [0.05, 0.95], axis=0)
        middle, extent = 0.5 * (low + high), float(np.linalg.norm(high - low))
        # Our cameras look along z with y down.
        eye = middle + extent * np.array([0.25, -0.3, -0.75])
        renderer.setup_camera(50.0, middle, eye, [0.0, -1.0, 0.0])
        o3d.io.write_image(path, renderer.render_to_image())
    finally:
        del renderer
