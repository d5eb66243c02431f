"""The checks of surface and texture on scenes whose answer is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.model.sphere import photograph, ring_of
from thesisrecon.types import DepthMap, TexturedMesh
from validation.checks import held_out, surface
from validation.references.libraries import NoReference, load
from validation.scenes.real import load_fixture_scene

try:
    load("open3d")
except NoReference as missing:
    pytest.skip(str(missing), allow_module_level=True)


def test_points_are_spread_evenly() -> None:
    vertices = np.array([[0.0, 0, 0], [4, 0, 0], [4, 1, 0], [0, 1, 0], [0, 0, 5], [1, 0, 5], [1, 1, 5]])
    mesh = TexturedMesh(vertices, np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]]))
    points = surface.points_on(mesh, 9000)
    low = points[:, 2] < 1.0
    assert low.sum() == pytest.approx(8000, abs=20)
    np.testing.assert_allclose(points[low].mean(axis=0), [2.0, 0.5, 0.0], atol=0.05)
    assert points[low].min() >= 0.0
    np.testing.assert_array_equal(points, surface.points_on(mesh, 9000))


def test_what_two_photographs_could_show_is_asked_for() -> None:
    scene = load_fixture_scene("courtyard")
    assert scene.K is not None
    assert scene.R is not None
    assert scene.C is not None
    pixel = np.linalg.inv(scene.K[6]) @ [512.0, 384.0, 1.0]
    depth = surface.load_fixture_depth(6)[0][192, 256]
    along = np.array([0.5, 1.0, 1.02, 1.5])[:, None] * depth * (scene.R[6].T @ pixel) + scene.C[6]
    count = surface.asked_for(along, scene)
    assert count[0] >= 2  # in the air
    assert count[1] >= 2
    assert count[3] == 0  # behind the wall


def test_distances_of_the_truth_from_itself_are_none() -> None:
    scene = load_fixture_scene("courtyard")
    assert scene.C is not None
    views = [
        DepthMap(i, np.eye(3, 4), *(np.ones((1, 1), np.float32),) * 2, np.ones((1, 1), np.uint8))
        for i in (0, 5, 9)
    ]
    moved = {}
    for one in views:
        P = np.column_stack([np.eye(3), -(2.0 * scene.C[one.view] + [1.0, 2.0, 3.0])])
        moved[one.view] = DepthMap(one.view, P, one.depth, one.std, one.views)
    found = surface.true_from_ours(moved, scene)
    assert found.scale == pytest.approx(0.5)
    np.testing.assert_allclose(found.t, [-0.5, -1.0, -1.5], atol=1e-9)


def test_tables_hold_ours_against_theirs() -> None:
    near, far = np.full(10, 0.1), np.full(10, 0.7)
    rows = surface.table({"default": (near, far), "Open3D TSDF": (far, near)})
    verdicts = {row.name: row.verdict for row in rows}
    assert verdicts["accuracy, mean"] == "reached"
    assert verdicts["completeness, mean"] == "missed"


def test_a_photograph_is_left_out(tmp_path: Path) -> None:
    maps = {m.view: m for m in ring_of(12)}
    views = {i: photograph(m, 0.9 if i % 2 else 1.1) for i, m in maps.items()}
    found = held_out.hold_out(3, maps, views, pictures=tmp_path)
    assert found[held_out.OURS].psnr_db > 30.0
    for name, one in found.items():
        assert one.psnr_db > 22.0, name
        assert one.psnr_as_is_db < one.psnr_db + 1e-9
        assert 0.1 < one.covered < 0.5
    assert len(list(tmp_path.iterdir())) == len(found) + 1
    row = held_out.table("sphere", [found])[0]
    assert row.target == max(v.psnr_db for n, v in found.items() if n.startswith("Open3D"))
    level = held_out.equally_bright(maps, views)
    seen = views[3].rgb > 40
    assert np.median(level[3].rgb[seen] / views[3].rgb[seen]) == pytest.approx(np.sqrt(1.1 / 0.9), abs=0.03)


def test_photographs_to_leave_out_are_spread() -> None:
    assert held_out.spread_out(list(range(11)), 3) == [2, 5, 8]
    assert held_out.spread_out([4, 9], 3) == [4, 9]
