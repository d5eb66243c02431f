"""Photographs that are said to share a camera and do not are told so, and those that do are left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.metric.test_self_check import ANGLE, SIGMAS, true_model
from tests.synthetic import TrueScene, make_scene, projective_reconstruction
from thesisrecon.assumptions import IntrinsicsAssumption, assume
from thesisrecon.metric.adjustment import Adjustment
from thesisrecon.metric.model import MetricModel, retriangulate
from thesisrecon.metric.sharing_check import contradicted_sharing


def settled(scene: TrueScene, cameras: str = "shared") -> tuple[MetricModel, Adjustment]:
    """The model as the metric stage ends with it: adjusted and triangulated by turns."""
    wish = IntrinsicsAssumption(cameras="shared" if cameras == "shared" else "per-image")
    adjustment = Adjustment(assume(projective_reconstruction(scene), wish), 0.0, 0.02)
    model = true_model(scene, adjustment.assumed)
    model = replace(model, sigma_px=30.0)
    for _ in range(3):
        model = retriangulate(model, sigmas=SIGMAS, min_angle=ANGLE)
        model = adjustment.run(model, iterations=10)[0]
    return model, adjustment


def changed(scene: TrueScene, factors: np.ndarray, shift_px: np.ndarray) -> TrueScene:
    """Photographs zoomed about the principal point and moved."""
    view = scene.tracks.view_index
    centre = scene.K[view, :2, 2]
    xy = centre + factors[view, None] * (scene.tracks.xy - centre) + shift_px[view]
    return replace(scene, tracks=replace(scene.tracks, xy=xy))


def test_one_camera_is_not_doubted() -> None:
    for views in (3, 8):
        assert contradicted_sharing(*settled(make_scene(views=views, sigma_px=0.5, seed=5))) == []


@pytest.mark.parametrize("zoom", [1.04, 1.08])
def test_two_near_zooms_by_turns_are_told(zoom: float) -> None:
    scene = make_scene(sigma_px=0.3, seed=6)
    factors = np.where(np.arange(8) % 2 == 0, 1.0, zoom)
    doubts = contradicted_sharing(*settled(changed(scene, factors, np.zeros((8, 2)))))
    assert len(doubts) == 1
    assert "one focal length" in doubts[0]


def test_photographs_cropped_one_by_one_are_told() -> None:
    scene = make_scene(sigma_px=0.3, seed=7)
    shift = np.random.default_rng(1).uniform(-80.0, 80.0, (8, 2))
    doubts = contradicted_sharing(*settled(changed(scene, np.ones(8), shift)))
    assert len(doubts) == 1
    assert "principal point" in doubts[0] or "one focal length" in doubts[0]


def test_where_nothing_is_shared_nothing_is_contradicted() -> None:
    scene = make_scene(sigma_px=0.3, zoom=0.2, seed=8)
    assert contradicted_sharing(*settled(scene, "per-image")) == []
