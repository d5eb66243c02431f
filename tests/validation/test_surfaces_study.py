"""Measures of depth maps, surfaces and views of the model on scenes with known truth."""

from dataclasses import replace

import numpy as np
import pytest

from tests.surface.sphere import photograph, ring_of
from tests.validation.references.conftest import skip_without
from thesisrecon.records import DepthMap, Reconstruction, Tracks
from validation.metrics import depth
from validation.scenes.real import load_fixture_scene
from validation.stages import views as views_stage

skip_without("open3d")


def courtyard_map(view, factor, std):
    """The true depth of a view, ``factor`` times too far, in a world of half the size."""
    scene = load_fixture_scene("courtyard")
    true, stride, _ = depth.true_depth(scene, view)
    K = np.diag([1.0 / stride, 1.0 / stride, 1.0]) @ scene.K[view]
    P = K @ scene.R[view] @ np.column_stack([np.eye(3), -0.5 * scene.C[view]])
    wrong = (0.5 * factor * true).astype(np.float32)
    return DepthMap(view, P, wrong, np.full_like(wrong, std), np.ones(wrong.shape, np.uint8))


def test_a_depth_that_is_too_far_is_measured():
    scene = load_fixture_scene("courtyard")
    maps = {view: courtyard_map(view, 1.002, 0.01) for view in (0, 5, 9)}
    align = depth.true_from_maps(maps, scene)
    assert align.scale == pytest.approx(2.0)
    truth = depth.true_depth(scene, 5)
    one = depth.judge_against_truth(maps[5], truth, align.scale)
    measured = depth.together([one])
    assert measured["depth error, median"] == pytest.approx(0.2, rel=0.05)
    assert measured["depth error, bias"] == pytest.approx(0.2, rel=0.05)
    assert measured["within 1 %"] == pytest.approx(measured["known"])
    assert measured["known"] > 99.0
    expected = 0.002 * np.nanmedian(truth[0]) / 0.02 / 0.6745
    assert measured["error in deviations"] == pytest.approx(expected, rel=0.2)
    far = depth.judge_against_truth(replace(maps[5], depth=maps[5].depth * 1.02), truth, align.scale)
    assert far.right == pytest.approx(0.0, abs=0.01)
    with pytest.raises(ValueError, match="no depth map"):
        depth.together([])


def test_depth_is_read_where_sparse_points_are_seen():
    z = np.full((20, 30), 4.0, np.float32)
    z[:, 15:] = np.nan
    P = np.array([[10.0, 0.0, 15.0, 0.0], [0.0, 10.0, 10.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    found = DepthMap(0, P, z, np.full_like(z, 0.1), np.ones(z.shape, np.uint8))
    X = np.array([[-2.0, 0.0, 4.0, 1.0], [-2.0, 1.0, 4.2, 1.0], [2.0, 0.0, 4.0, 1.0], [0.0, 0.0, 9.0, 1.0]])
    # The last is another view's.
    tracks = Tracks(np.array([0, 0, 0, 1]), np.arange(4), np.zeros((4, 2)), 2, 4)
    seen = np.ones(4, dtype=bool)
    cameras, sizes = np.stack([P, P]), np.full((2, 2), 20)
    model = Reconstruction("metric", cameras, X, seen[:2], seen, seen, tracks, sizes, 1.0, ("", ""))
    one = depth.judge_against_points(found, model)
    np.testing.assert_allclose(one.error, [0.0, 4.0 / 4.2 - 1.0], atol=1e-6)
    np.testing.assert_allclose(one.deviations, [0.0, 2.0], atol=1e-4)
    assert one.known == pytest.approx(2 / 3)
    assert one.right == pytest.approx(1 / 3)


def test_an_image_is_left_out(tmp_path):
    maps = {m.view: m for m in ring_of(12)}
    views = {i: photograph(m, 0.9 if i % 2 else 1.1) for i, m in maps.items()}
    others = [i for i in maps if i != 3]
    given = [maps[i] for i in others], [views[i] for i in others]
    camera = views_stage.Camera.from_matrix(views[3].P, (160, 120))
    drawn = {}
    for method in (views_stage.OURS, views_stage.FINE, views_stage.LEVELLED):
        mesh = views_stage._model(method, *given, tmp_path / "surface.npz")
        drawn[method] = views_stage.render(mesh, camera)
    found, compared = views_stage.compare(views[3], drawn)
    assert compared.any()
    assert found[views_stage.OURS]["PSNR"] > 30.0
    for name, one in found.items():
        assert one["PSNR"] > 22.0, name
        assert one["PSNR as it is"] < one["PSNR"] + 1e-9
        assert 10.0 < one["covered"] < 50.0
    level = views_stage._equally_bright(views_stage._read_surface(tmp_path / "surface.npz"), given[1])
    bright = level[2].rgb, views[2].rgb
    seen = bright[1] > 40
    assert np.median(bright[0][seen] / bright[1][seen]) == pytest.approx(np.sqrt(0.9 / 1.1), abs=0.03)
