"""Accuracy and completeness of surfaces of the courtyard; distances by Open3D."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.records import DepthMap, TexturedMesh
from thesisrecon.surface._mesh import face_areas
from thesisrecon.surface.linear import surface_from_depth
from validation.metrics.depth import true_depth
from validation.references.open3d_geometry import Nearest
from validation.scenes.real import Scene, load_fixture_depth, load_fixture_scene

SAMPLES = 200_000
"""Number of points sampled on a surface."""
BEHIND = 0.05
"""Relative depth tolerance of visibility."""
CAPPED = 5.0
"""Maximum distance in the mean, in percent of the scene depth."""


@dataclass(frozen=True)
class Truth:
    """The true ``surface``, true ``points`` (N, 3) that two images show, and the scene's depth in
    metres."""

    scene: Scene
    surface: Nearest
    points: F64
    depth_m: float


def load_truth() -> Truth:
    """Return the courtyard from its true depth maps, one triangle sheet per view."""
    scene = load_fixture_scene("courtyard")
    calibrations, R, C = scene.cameras
    sheets, points, depths = [], [], []
    for view in range(len(C)):
        depth, stride, seen = true_depth(scene, view)
        K = np.diag([1.0 / stride, 1.0 / stride, 1.0]) @ calibrations[view]
        P = K @ R[view] @ np.column_stack([np.eye(3), -C[view]])
        std = np.zeros(depth.shape, dtype=np.float32)
        sheet = DepthMap(view, P, depth.astype(np.float32), std, np.ones(depth.shape, np.uint8))
        sheets.append(surface_from_depth(sheet, grazing_deg=1.0))
        y, x = np.nonzero(seen & (np.indices(depth.shape).sum(axis=0) % 2 == 0))
        rays = np.stack([x, y, np.ones_like(x)], axis=1) @ np.linalg.inv(K).T
        points.append((rays * depth[y, x, None]) @ R[view] + C[view])
        depths.append(depth[np.isfinite(depth)])
    depth_m = float(np.median(np.concatenate(depths)))
    return Truth(scene, Nearest(_together(sheets)), np.concatenate(points), depth_m)


def _together(meshes: Sequence[TexturedMesh]) -> TexturedMesh:
    first = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    faces = [m.faces + n for m, n in zip(meshes, first, strict=True)]
    return TexturedMesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(faces))


def points_on(mesh: TexturedMesh, count: int = SAMPLES) -> F64:
    """Sample points (count, 3) uniformly over a surface, deterministically."""
    rng = np.random.default_rng(0)
    area = np.cumsum(face_areas(mesh.vertices, mesh.faces))
    face = np.searchsorted(area, (np.arange(count) + rng.random(count)) * (area[-1] / count))
    s, t = rng.random((2, count, 1))
    turned = s + t > 1.0
    s, t = np.where(turned, 1.0 - s, s), np.where(turned, 1.0 - t, t)
    a, b, c = (mesh.vertices[mesh.faces[np.minimum(face, len(area) - 1), k]] for k in range(3))
    return np.asarray(a + s * (b - a) + t * (c - a))


def asked_for(points: F64, scene: Scene) -> I64:
    """Return the number of images (N,) that truly show each point."""
    K, R, C = scene.cameras
    count = np.zeros(len(points), dtype=np.int64)
    for view in range(len(K)):
        depth, stride = load_fixture_depth(view)
        q = (points - C[view]) @ (K[view] @ R[view]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            at = q[:, :2] / q[:, 2:] / stride
            limit = np.array(depth.shape[::-1]) - 1
            inside = (q[:, 2] > 0.0) & ((at >= 0.0) & (at <= limit)).all(axis=1)
        x, y = np.rint(np.where(inside[:, None], at, 0.0)).astype(np.int64).T
        with np.errstate(invalid="ignore"):
            count += inside & (q[:, 2] <= (1.0 + BEHIND) * depth[y, x])
    return count


def judge_surface(mesh: TexturedMesh, truth: Truth, samples: int = SAMPLES) -> tuple[F64, F64]:
    """Accuracy and completeness of a surface in the true frame, as distances in percent of the scene's depth.

    Accuracy: from points spread evenly over the surface, where at least two images could show them, to
    the true one. Completeness: from true points that two images show to the surface.
    """
    points = points_on(mesh, samples)
    points = points[asked_for(points, truth.scene) >= 2]
    unit = 100.0 / truth.depth_m
    chosen = truth.points[:: max(1, len(truth.points) // samples)]
    return unit * truth.surface.distances(points), unit * Nearest(mesh).distances(chosen)
