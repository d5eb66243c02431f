"""Fusion of depth maps, distances to a mesh and pictures of it beside Open3D."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.conftest import Bench
from thesisrecon.geometry.pinhole import PinholeCamera
from thesisrecon.model import VolumetricFusion
from thesisrecon.types import DepthMap, PinholeView, TexturedMesh
from thesisrecon.views import render
from validation.checks.rendering import courtyard
from validation.references.open3d_meshes import render_open3d
from validation.references.open3d_surfaces import OpenTsdf

STEP = 2


@pytest.fixture(scope="module")
def depths() -> tuple[list[DepthMap], list[PinholeView]]:
    """Every second pixel of four true depth maps of the courtyard, and the colours there."""
    maps, views = courtyard()
    small, colours = [], []
    for one, view in zip(maps[4:8], views[4:8], strict=True):
        P = np.diag([1.0 / STEP, 1.0 / STEP, 1.0]) @ one.P
        part = np.s_[::STEP, ::STEP]
        small.append(DepthMap(one.view, P, one.depth[part], one.std[part], one.views[part]))
        stride = view.rgb.shape[0] // small[-1].depth.shape[0]
        rgb = np.ascontiguousarray(view.rgb[::stride, ::stride])
        colours.append(PinholeView(one.view, P, rgb, np.ones(rgb.shape[:2], dtype=bool)))
    return small, colours


@pytest.fixture(scope="module")
def mesh(depths: tuple[list[DepthMap], list[PinholeView]]) -> TexturedMesh:
    return OpenTsdf().fuse(*depths)


@pytest.mark.parametrize("method", ["ours", "Open3D"])
def test_fusion(bench: Bench, method: str, depths: tuple[list[DepthMap], list[PinholeView]]) -> None:
    calls = {"ours": lambda: VolumetricFusion().fuse(depths[0]), "Open3D": lambda: OpenTsdf().fuse(*depths)}
    bench("fusion of four depth maps, 256 x 192", method, calls[method])


@pytest.mark.parametrize("method", ["ours", "Open3D"])
def test_pictures(
    bench: Bench, method: str, mesh: TexturedMesh, depths: tuple[list[DepthMap], list[PinholeView]]
) -> None:
    height, width = depths[0][0].depth.shape
    camera = PinholeCamera.from_matrix(depths[0][0].P, (width, height)).resized(4)
    calls = {"ours": lambda: render(mesh, camera).color, "Open3D": lambda: render_open3d(mesh, camera)}
    bench("picture of a mesh, 1024 x 768", method, calls[method])
