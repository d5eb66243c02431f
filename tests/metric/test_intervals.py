"""Stated intervals hold the truth as often as they say; a floor stands only where the model is not true."""

from dataclasses import replace

import numpy as np
import pytest

from tests.metric.test_population import refine
from tests.synthetic import make_scene
from thesisrecon.metric._adjustment import tail_width
from thesisrecon.metric._uncertainty import FocalShrinkage, lack_of_fit
from thesisrecon.optimize.bundle.scatter import BlockScatter


def test_deviations_are_of_the_stated_size_on_normal_noise():
    deviations = []
    for seed in range(8):
        scene = make_scene(sigma_px=0.5, points=300, seed=seed, principal_shift=(5.0, -3.0))
        found = refine(scene).intrinsics[0]
        deviations += [
            (found[name].value - truth) / found[name].std
            for name, truth in (
                ("focal_px", scene.K[0, 0, 0]),
                ("principal_x_px", scene.K[0, 0, 2]),
                ("principal_y_px", scene.K[0, 1, 2]),
            )
        ]
    assert 0.6 < np.sqrt(np.mean(np.square(deviations))) < 1.5


def test_less_noise_is_a_narrower_interval_without_a_floor():
    stds = [
        refine(make_scene(sigma_px=sigma, points=300, seed=1)).intrinsics[0]["focal_px"].std
        for sigma in (0.5, 0.05)
    ]
    assert stds[1] < 0.2 * stds[0]
    assert stds[1] < 5e-4 * 1500.0


def test_heavy_tails_bring_the_floor():
    scene = make_scene(sigma_px=0.05, points=300, seed=1)
    rng = np.random.default_rng(0)
    t = scene.tracks
    wide = rng.random(len(t.xy)) < 0.25
    xy = t.xy + np.where(wide[:, None], 0.25, 0.0) * rng.normal(size=t.xy.shape)
    focal = refine(replace(scene, tracks=replace(t, xy=xy))).intrinsics[0]["focal_px"]
    assert focal.std > 0.8e-3 * focal.value
    assert "error floor" in focal.source


def test_the_share_of_model_error_follows_its_signs():
    def scatter(contradiction, blocks=32):
        return BlockScatter(
            np.ones((1, 8)),
            np.ones(8),
            np.ones((1, 8)),
            np.ones((1, 8)),
            np.zeros((1, 8)),
            contradiction,
            blocks,
        )

    assert lack_of_fit(scatter(1.0), 1.0) == 0.0
    assert lack_of_fit(scatter(2.5), 1.0) == 1.0
    assert lack_of_fit(scatter(1.0), 2.5) == 1.0
    assert 0.0 < lack_of_fit(scatter(1.5), 1.0) < 1.0
    assert lack_of_fit(scatter(1.0, blocks=1), 1.0) == 1.0


def test_the_tail_of_normal_noise_is_one():
    lengths = np.linalg.norm(np.random.default_rng(0).normal(size=(4000, 2)), axis=1)
    assert tail_width(lengths, 1.0) == pytest.approx(1.0, abs=0.05)
    assert tail_width(10.0 * lengths, 1.0) == 3.0


def test_other_estimates_have_intervals_that_hold_the_truth():
    """Aspect, skew and the whole lens; priors are reported as assumed."""
    scene = make_scene(sigma_px=0.5, points=300, seed=2)
    found = refine(scene, aspect="constant", skew="constant", skew_std_px=50.0)
    for name, truth in (("aspect", 1.0), ("skew_px", 0.0), ("k2", 0.0), ("k3", 0.0)):
        interval = found.intrinsics[0][name]
        assert interval.std > 0.0
        assert abs(interval.value - truth) < 5.0 * interval.std
    assert found.intrinsics[0]["aspect"].std < 0.01
    assert 0.01 < found.intrinsics[0]["skew_px"].std < 50.0
    usual = refine(scene).intrinsics[0]
    assert [(usual[n].value, usual[n].std) for n in ("aspect", "skew_px")] == [(1.0, 0.0), (0.0, 0.0)]


def test_a_focal_is_shrunk_only_where_its_own_matches_say_less_than_is_stated():
    lent = FocalShrinkage(np.array([0.02, 0.001, 0.02]), np.array([0.1, 0.1, 0.9]))
    assert [lent.is_shrunk(view, 0.005) for view in range(3)] == [True, False, False]
    assert "8% (1 sigma)" in FocalShrinkage(np.array([0.08]), np.ones(1)).warnings([0], 0.05)[0]
