"""Richer camera models: adopted where they explain the images, named where nothing does."""

from dataclasses import replace

import numpy as np
import pytest

from tests.metric.test_metric_refinement import centre_error, run
from tests.metric.test_self_check import changed, setting, settled
from tests.synthetic import make_scene
from thesisrecon.metric._adjustment import (
    camera_differences,
    held_out_observations,
    remaining_cost,
    richer_models,
    with_own_values,
)
from thesisrecon.metric._model import CENTRE, FOCAL
from thesisrecon.metric.refinement import MAX_REMAINING


@pytest.mark.parametrize("kind", ["crops", "zooms"])
def test_images_cropped_or_zoomed_one_by_one_get_own_values_and_are_right(kind):
    rng = np.random.default_rng(1)
    scene = make_scene(sigma_px=0.3, points=500, seed=7)
    crops, zooms = np.zeros((8, 2)), np.ones(8)
    if kind == "crops":
        crops = rng.uniform(-80.0, 80.0, (8, 2))
    else:
        zooms = np.where(np.arange(8) % 2 == 0, 1.0, 1.08)
    result = run(changed(scene, zooms, crops))
    assert result.trusted, result.failed_checks
    assert len(result.limitations) == 1
    assert result.limitations[0].startswith("Each image has its own")
    focal = [intervals["focal_px"] for intervals in result.intrinsics]
    error = np.array([f.value for f in focal]) / (1500.0 * zooms) - 1.0
    assert np.abs(error).max() < 0.01
    assert (np.abs(error) < 3.0 * np.array([f.std / f.value for f in focal])).all()
    assert centre_error(result, scene) < 0.01


def bent(scene, size):
    """Images bent in a way that no intrinsic describes, each differently: a stabiliser or rolling shutter."""
    view = scene.tracks.view_index
    shear = np.random.default_rng(2).normal(0.0, size, len(scene.K))
    xy = scene.tracks.xy - scene.K[view, :2, 2]
    xy = xy + np.column_stack([shear[view] * xy[:, 1], np.zeros(len(xy))])
    return replace(scene, tracks=replace(scene.tracks, xy=xy + scene.K[view, :2, 2]))


def test_what_no_intrinsic_explains_is_named_and_widens_the_interval():
    scene = make_scene(sigma_px=0.1, points=500, seed=7)
    result = run(bent(scene, 0.002))
    assert result.trusted, result.failed_checks
    assert any("contradict a shared" in text for text in result.limitations)
    focal = result.intrinsics[0]["focal_px"]
    assert "camera model" in focal.source
    assert abs(focal.value - 1500.0) < 2.0 * focal.std
    assert focal.std < 0.05 * focal.value
    x = result.intrinsics[0]["principal_x_px"]
    assert "camera model" in x.source
    assert abs(x.value - scene.K[0, 0, 2]) < 2.0 * x.std
    assert centre_error(result, scene) < 0.02


def test_one_camera_keeps_shared_values_without_remark():
    assert run(make_scene(sigma_px=0.3, points=500, seed=7)).limitations == ()


def test_held_out_observations_leave_two_of_each_point_and_are_blocks_of_each_view():
    _, _, model = setting()
    held = held_out_observations(model)
    t = model.tracks
    assert 0.1 < len(held) / model.inlier.sum() < 0.3
    left = model.inlier.copy()
    left[held] = False
    seen = np.bincount(t.point_index[left], minlength=t.n_points)
    assert (seen[t.point_index[held]] >= 2).all()
    # Neighbouring points are held out together.
    view = t.view_index == 0
    mine = np.isin(np.flatnonzero(view), held)
    X = model.X[t.point_index[view]]
    nearest = np.argsort(np.linalg.norm(X[:, None] - X[None], axis=2), axis=1)[:, 1]
    assert mine[nearest[mine]].mean() > 2 * mine.mean()


def test_a_richer_model_of_one_camera_predicts_no_better_and_one_of_crops_far_better():
    scene = make_scene(sigma_px=0.3, seed=7)
    shift = np.random.default_rng(1).uniform(-80.0, 80.0, (8, 2))
    for images, low, high in ((scene, 0.9, 1.3), (changed(scene, np.ones(8), shift), 0.0, MAX_REMAINING)):
        simple = settled(images)
        model, adjustment = with_own_values(*simple, (FOCAL, *CENTRE))
        model = adjustment.run(model, iterations=25)[0]
        assert low < remaining_cost(simple, (model, adjustment)) < high


def test_differences_are_relative_to_the_path_and_free_of_the_frame():
    _, _, model = setting()
    cameras = model.cameras
    same = replace(model, cameras=replace(cameras, t=3.0 * cameras.t))
    assert camera_differences(model, same).centre < 1e-9
    longer = cameras.intrinsics * np.where(np.arange(8) == FOCAL, 1.02, 1.0)
    zoomed = replace(model, cameras=replace(cameras, intrinsics=longer))
    assert camera_differences(model, zoomed).focal == pytest.approx(np.log(1.02))
    assert camera_differences(model, zoomed).harmless


def test_each_model_is_tried_once_and_known_intrinsics_stay_known():
    free = setting()[1]
    known = setting(principal_point="known")[1]
    focal = np.arange(8) == FOCAL
    assert list(richer_models(focal, free)) == [(FOCAL,), (FOCAL, *CENTRE)]
    assert list(richer_models(focal, known)) == [(FOCAL,)]
    assert list(richer_models(np.zeros(8, bool), free)) == []
    # Known in some images only: the others may have been zoomed.
    some = replace(free, std=np.where((np.arange(8) < 4)[:, None] & (np.arange(6) == FOCAL), 0.0, free.std))
    assert list(richer_models(focal, some)) == [(FOCAL,), (FOCAL, *CENTRE)]
    assert list(richer_models(focal, setting(focal="known", focal_px=1500.0)[1])) == []
