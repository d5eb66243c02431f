"""Photographs that are said to share a camera and do not are told so, and those that do are left alone."""

from dataclasses import replace

import numpy as np
import pytest

from tests.metric.test_self_check import ANGLE, SIGMAS, true_model
from tests.synthetic import make_scene, projective_reconstruction
from thesisrecon.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.metric.adjustment import Adjustment
from thesisrecon.metric.model import retriangulate
from thesisrecon.metric.shared_camera import check_shared_cameras
from thesisrecon.metric.uncertainty import with_open_sharing
from thesisrecon.records import IntrinsicInterval


def settled(scene, **wish):
    """The model as the metric stage ends with it: adjusted and triangulated by turns."""
    prior = prior_for(projective_reconstruction(scene), IntrinsicsOptions(**wish))
    adjustment = Adjustment(prior, 0.0, 0.02)
    model = true_model(scene, adjustment.prior)
    model = replace(model, sigma_px=30.0)
    for _ in range(3):
        model = retriangulate(model, sigmas=SIGMAS, min_angle=ANGLE)
        model = adjustment.run(model, iterations=10)[0]
    return model, adjustment


def changed(scene, factors, shift_px):
    """Photographs zoomed about the principal point and moved."""
    view = scene.tracks.view_index
    centre = scene.K[view, :2, 2]
    xy = centre + factors[view, None] * (scene.tracks.xy - centre) + shift_px[view]
    return replace(scene, tracks=replace(scene.tracks, xy=xy))


def test_one_camera_is_not_doubted():
    for views in (3, 8):
        assert (
            check_shared_cameras(*settled(make_scene(views=views, sigma_px=0.5, seed=5))).failed_checks == ()
        )


@pytest.mark.parametrize("zoom", [1.04, 1.08])
def test_two_near_zooms_by_turns_are_told(zoom):
    scene = make_scene(sigma_px=0.3, seed=6)
    factors = np.where(np.arange(8) % 2 == 0, 1.0, zoom)
    failed_checks = check_shared_cameras(*settled(changed(scene, factors, np.zeros((8, 2))))).failed_checks
    assert len(failed_checks) == 1
    assert "one focal length" in failed_checks[0]


def test_photographs_cropped_one_by_one_are_told():
    scene = make_scene(sigma_px=0.3, seed=7)
    shift = np.random.default_rng(1).uniform(-80.0, 80.0, (8, 2))
    failed_checks = check_shared_cameras(*settled(changed(scene, np.ones(8), shift))).failed_checks
    assert len(failed_checks) == 1
    assert "principal point" in failed_checks[0] or "one focal length" in failed_checks[0]


def test_where_nothing_is_shared_nothing_is_contradicted():
    scene = make_scene(sigma_px=0.3, zoom=0.2, seed=8)
    assert check_shared_cameras(*settled(scene, cameras="per-image")).failed_checks == ()


@pytest.mark.parametrize("zoom", [1.03, 1.06])
def test_one_zoomed_photograph_of_three_is_told(zoom):
    scene = make_scene(views=3, sigma_px=0.1, seed=9)
    factors = np.array([1.0, zoom, 1.0])
    found = check_shared_cameras(*settled(changed(scene, factors, np.zeros((3, 2)))))
    assert len(found.failed_checks) + len(found.warnings) == 1


def test_photographs_that_cannot_tell_widen_the_interval_and_say_so():
    found = check_shared_cameras(*settled(make_scene(views=3, points=60, sigma_px=0.5, seed=2)))
    assert found.failed_checks == ()
    assert len(found.warnings) == 1
    assert "cannot be checked" in found.warnings[0]
    assert (found.focal_std > 0.01).all()
    narrow = {"focal_px": IntrinsicInterval(1000.0, 1.0, "")}
    wide = with_open_sharing([narrow, narrow, {}], found.focal_std)
    assert wide[0]["focal_px"].std == pytest.approx(1000.0 * found.focal_std[0])
    assert wide[2] == {}


@pytest.mark.parametrize(
    "wish", [{"focal": "free"}, {"focal": "free", "principal_point": "known"}, {"principal_point": "known"}]
)
def test_crops_are_told_whatever_is_assumed_of_focal_and_principal_point(wish):
    scene = make_scene(sigma_px=0.3, seed=7)
    shift = np.random.default_rng(1).uniform(-80.0, 80.0, (8, 2))
    failed_checks = check_shared_cameras(*settled(changed(scene, np.ones(8), shift), **wish)).failed_checks
    assert len(failed_checks) == 1
    right = settled(scene, **wish)
    assert check_shared_cameras(*right).failed_checks == ()


def test_sentences_hold_at_any_size_of_the_photographs():
    scene = make_scene(sigma_px=0.3, seed=6)
    factors = np.where(np.arange(8) % 2 == 0, 1.0, 1.06)
    found = check_shared_cameras(*settled(changed(scene, factors, np.zeros((8, 2)))))
    assert "px" not in found.failed_checks[0]
    assert "5." in found.failed_checks[0] or "6." in found.failed_checks[0]
