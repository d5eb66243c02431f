"""Minimal and linear solvers, projection and alignment beside OpenCV, COLMAP and PoseLib."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from benchmarks.conftest import Bench
from benchmarks.references import (
    colmap_similarity,
    opencv_homography,
    opencv_projection,
    opencv_seven_point,
    opencv_undistortion,
    poselib_three_points,
)
from thesisrecon.api.cameras import triangulate
from thesisrecon.camera import project_camera
from thesisrecon.epipolar.ransac import estimate_eight_point, estimate_seven_point
from thesisrecon.epipolar.verification import Configuration
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.geometry.triangulation import pose_from_three_points
from thesisrecon.geometry.two_view import homography_linear
from thesisrecon.lens import distort, undistort
from validation.references.fundamental import colmap_points, opencv_eight_point
from validation.scenes.rigs import beside
from validation.scenes.two_views import make_two_views

Call = Callable[..., Any]
RADIAL = np.array([-0.1, 0.02, 0.001])


@pytest.mark.parametrize(
    ("group", "method", "solve", "count"),
    [
        ("eight-point method, 1000 matches", "ours", estimate_eight_point, 1000),
        ("eight-point method, 1000 matches", "OpenCV", opencv_eight_point, 1000),
        ("seven-point method", "ours", estimate_seven_point, 7),
        ("seven-point method", "OpenCV", opencv_seven_point, 7),
        ("homography, 1000 matches", "ours", homography_linear, 1000),
        ("homography, 1000 matches", "OpenCV", opencv_homography, 1000),
    ],
)
def test_matrices_of_matches(bench: Bench, group: str, method: str, solve: Call, count: int) -> None:
    scene = make_two_views(Configuration.GENERAL, count, np.random.default_rng(1))
    bench(group, method, lambda: solve(scene.xy1, scene.xy2))


@pytest.mark.parametrize("method", ["ours", "COLMAP"])
def test_triangulation_of_five_views(bench: Bench, method: str) -> None:
    solve: Call = partial(triangulate, method="linear") if method == "ours" else colmap_points
    rig = beside(np.random.default_rng(2), 5, 2000)
    P, xy = camera_from_centre(rig.K, rig.R, rig.C), rig.pixels()
    xy = xy[:, np.isfinite(xy).all(axis=(0, 2))]
    bench("linear triangulation, five views", method, lambda: solve(P, xy))


@pytest.mark.parametrize("method", ["ours", "OpenCV"])
def test_projection(bench: Bench, method: str) -> None:
    X = np.random.default_rng(3).uniform([-2.0, -2.0, 4.0], [2.0, 2.0, 8.0], (10000, 3))
    K, R, t = np.diag([700.0, 700.0, 1.0]), np.eye(3), np.zeros(3)
    solve = project_camera if method == "ours" else opencv_projection
    bench("projection of 10000 points", method, lambda: solve(K, R, t, X, distortion=RADIAL))


@pytest.mark.parametrize("method", ["ours", "OpenCV"])
def test_undistortion(bench: Bench, method: str) -> None:
    xy = distort(np.random.default_rng(3).uniform(-0.5, 0.5, (10000, 2)), RADIAL)
    calls = {
        "ours": lambda: undistort(xy, RADIAL),
        "OpenCV": lambda: opencv_undistortion(xy, distortion=RADIAL),
    }
    bench("undistortion of 10000 points", method, calls[method])


@pytest.mark.parametrize("method", ["ours", "COLMAP"])
def test_similarity(bench: Bench, method: str) -> None:
    source = np.random.default_rng(4).normal(size=(10000, 3))
    target = 2.0 * source[:, [1, 2, 0]] + 1.0
    solve = estimate_similarity if method == "ours" else colmap_similarity
    bench("similarity of 10000 points", method, lambda: solve(source, target))


@pytest.mark.parametrize("method", ["ours", "PoseLib"])
def test_poses_from_three_points(bench: Bench, method: str) -> None:
    rng = np.random.default_rng(5)
    X = rng.uniform([-2.0, -2.0, 4.0], [2.0, 2.0, 8.0], (500, 3, 3))
    rays = X / np.linalg.norm(X, axis=2, keepdims=True)

    def theirs() -> object:
        return [poselib_three_points(*sample) for sample in zip(X, rays, strict=True)]

    calls: dict[str, Callable[[], object]] = {
        "ours": lambda: pose_from_three_points(X, rays),
        "PoseLib": theirs,
    }
    bench("poses from three points, 500 samples", method, calls[method])
