"""Fusion of depth maps to a surface, and its simplification, beside Open3D."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.conftest import Bench
from benchmarks.references import decimate_open3d
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.records import DepthMap, PinholeView
from thesisrecon.surface._simplification import simplify_surface
from thesisrecon.surface.fusion import VolumetricFusion
from validation.references.open3d_geometry import OpenTsdf
from validation.scenes.real import load_fixture_depth, load_fixture_scene, read_rgb

STEP = 2
# Errors and sides of simplified faces, m: those of the fusion by default.
LIMIT, LONGEST = 0.0035, 0.7


@pytest.fixture(scope="module")
def depths() -> tuple[list[DepthMap], list[PinholeView]]:
    """Every second pixel of four true depth maps of the courtyard, and the colours there."""
    scene = load_fixture_scene("courtyard")
    assert scene.K is not None
    assert scene.R is not None
    assert scene.C is not None
    small, colours = [], []
    for view in range(4, 8):
        depth, stride = load_fixture_depth(view)
        step = stride * STEP
        K = np.diag([1.0 / step, 1.0 / step, 1.0]) @ scene.K[view]
        P = camera_from_centre(K, scene.R[view], scene.C[view])
        part = depth[::STEP, ::STEP].astype(np.float32)
        std, seen = np.full(part.shape, 0.001, np.float32), np.full(part.shape, 3, np.uint8)
        small.append(DepthMap(view, P, part, std, seen))
        rgb = np.ascontiguousarray(read_rgb(scene.image_paths[view])[::step, ::step])
        colours.append(PinholeView(view, P, rgb, np.ones(rgb.shape[:2], dtype=bool)))
    return small, colours


@pytest.mark.parametrize("method", ["ours", "Open3D"])
def test_fusion(bench: Bench, method: str, depths: tuple[list[DepthMap], list[PinholeView]]) -> None:
    every_face = VolumetricFusion(tolerance=0.0)
    calls = {"ours": lambda: every_face.fuse(depths[0]), "Open3D": lambda: OpenTsdf().fuse(*depths)}
    bench("fusion of four depth maps, 256 x 192", method, calls[method])


@pytest.mark.parametrize("method", ["ours", "Open3D"])
def test_simplification(bench: Bench, method: str, depths: tuple[list[DepthMap], list[PinholeView]]) -> None:
    mesh = VolumetricFusion(tolerance=0.0).fuse(depths[0])
    limit = np.full(len(mesh.vertices), LIMIT)
    fewer = simplify_surface(mesh, limit, longest=LONGEST)
    calls = {
        "ours": lambda: simplify_surface(mesh, limit, longest=LONGEST),
        "Open3D": lambda: decimate_open3d(mesh, len(fewer.faces)),
    }
    bench("quadric simplification of the fused surface to the same number of faces", method, calls[method])
