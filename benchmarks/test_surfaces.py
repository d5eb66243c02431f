"""Fusion of depth maps beside Open3D."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.conftest import Bench
from thesisrecon.records import DepthMap, PinholeView
from thesisrecon.surface.fusion import VolumetricFusion
from validation.references.open3d_surfaces import OpenTsdf
from validation.studies.rendering import courtyard

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


@pytest.mark.parametrize("method", ["ours", "Open3D"])
def test_fusion(bench: Bench, method: str, depths: tuple[list[DepthMap], list[PinholeView]]) -> None:
    calls = {"ours": lambda: VolumetricFusion().fuse(depths[0]), "Open3D": lambda: OpenTsdf().fuse(*depths)}
    bench("fusion of four depth maps, 256 x 192", method, calls[method])
