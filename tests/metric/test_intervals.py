"""Stated intervals hold the truth as often as they say; how cameras of one kind scatter, and who borrows."""

from dataclasses import replace

import numpy as np
import pytest

from tests.metric.metric_stage import refine, scatter, with_few_points, with_xy
from tests.synthetic import make_scene
from thesisrecon.metric import _adjustment, _uncertainty, refinement
from thesisrecon.metric._adjustment import tail_width
from thesisrecon.metric._model import FOCAL
from validation.metrics.cameras import pose_scores


def test_deviations_and_noise_are_of_the_stated_size_on_normal_noise():
    deviations, noise, poses = [], [], []
    for seed in range(16):
        scene = make_scene(sigma_px=0.5, points=300, seed=seed, principal_shift=(5.0, -3.0))
        result, K = refine(scene), scene.K[0]
        names = {"focal_px": K[0, 0], "principal_x_px": K[0, 2], "principal_y_px": K[1, 2]}
        found = result.intrinsics[0]
        deviations += [(found[name].value - truth) / found[name].std for name, truth in names.items()]
        # Three unknowns of each point and six of each pose take their share of the residuals.
        left = 1.0 - (3 * scene.tracks.n_points + 6 * scene.tracks.n_views) / (2 * len(scene.tracks.xy))
        noise.append(result.reconstruction.sigma_px / 0.5 / np.sqrt(left))
        poses.append(pose_scores(result, scene.R, scene.centres))
    # 48 squares of normal numbers: a standard error of 0.1.
    assert 0.7 < np.sqrt(np.mean(np.square(deviations))) < 1.32
    assert np.mean(noise) == pytest.approx(1.0, abs=0.04)
    assert 0.8 < np.sqrt(np.mean(np.square(poses))) < 1.2


def test_the_last_model_is_at_the_minimum_of_its_inliers_which_have_no_wrong_pixel(monkeypatch):
    """The distance to the minimum is computed again, from what is returned."""
    ends, finish, accepted = [], refinement.finish_metric, []
    monkeypatch.setattr(refinement, "finish_metric", lambda *given: ends.append(finish(*given)) or ends[-1])

    def distance(scene, xy):
        inlier = refine(with_xy(scene, xy)).reconstruction.inlier
        model, adjustment = ends[-1][:2]
        return adjustment.run(model, iterations=0, keep_noise=True)[1].sigmas_to_minimum, inlier

    heavy = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        scene = make_scene(sigma_px=0.5, points=300, seed=seed)
        xy, wrong = scene.tracks.xy.copy(), rng.random(len(scene.tracks.xy)) < 0.02
        angle, off = rng.uniform(0.0, 2.0 * np.pi, wrong.sum()), 0.5 * rng.uniform(9.0, 13.0, wrong.sum())
        # With heavy tails many observations are near the limit, and inliers change until the end.
        heavy.append(distance(scene, xy + 0.5 * rng.standard_t(2.0, size=xy.shape))[0])
        xy[wrong] += off[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        far, inlier = distance(scene, xy)
        accepted.append(inlier[wrong].mean())
        assert inlier[~wrong].mean() > 0.998
        assert far < 0.01
    # Adjustments between which inliers are chosen again end at a tenth of a standard deviation.
    assert max(heavy) < 0.006
    assert np.mean(accepted) < 0.15


@pytest.mark.parametrize("views", [3, 6])
def test_one_adjustment_ends_where_its_predicted_gain_says(monkeypatch, views):
    """With heavy tails it converges linearly: the gain left is that at which it ends, and not a step less."""
    ends, finish, rng = [], refinement.finish_metric, np.random.default_rng(0)
    monkeypatch.setattr(refinement, "finish_metric", lambda *given: ends.append(finish(*given)) or ends[-1])
    scene = make_scene(sigma_px=0.5, points=150, views=views, seed=0)
    refine(with_xy(scene, scene.tracks.xy + 0.5 * rng.standard_t(2.0, size=scene.tracks.xy.shape)))
    model, adjustment = ends[-1][:2]

    def off(start):
        return adjustment.run(start, iterations=0, keep_noise=True)[1].sigmas_to_minimum

    for longer in (1.01, 1.1, 1.3):
        rows = model.cameras.intrinsics.copy()
        rows[:, FOCAL] *= longer
        start = replace(model, cameras=replace(model.cameras, intrinsics=rows))
        assert off(start) > 4.0
        # Half the square of the distance in standard deviations is 1e-4, between choices of inliers 5e-3.
        assert off(adjustment.run(start, settled=_adjustment.SETTLED, keep_noise=True)[0]) < 0.02
        assert off(adjustment.run(start, keep_noise=True)[0]) < 0.08


def test_less_noise_is_a_narrower_interval_and_heavy_tails_bring_the_floor():
    wide, narrow = (
        refine(make_scene(sigma_px=sigma, points=300, seed=1)).intrinsics[0]["focal_px"].std
        for sigma in (0.5, 0.05)
    )
    assert narrow < min(0.2 * wide, 5e-4 * 1500.0)
    scene, rng = make_scene(sigma_px=0.05, points=300, seed=1), np.random.default_rng(0)
    wide = rng.random(len(scene.tracks.xy)) < 0.25
    noise = np.where(wide[:, None], 0.25, 0.0) * rng.normal(size=scene.tracks.xy.shape)
    focal = refine(with_xy(scene, scene.tracks.xy + noise)).intrinsics[0]["focal_px"]
    assert focal.std > 0.8e-3 * focal.value
    assert "error floor" in focal.source


def test_model_error_and_tails_are_seen():
    for contradiction, misfit, blocks, share in (
        (1.0, 1.0, 32, 0.0), (2.5, 1.0, 32, 1.0), (1.0, 2.5, 32, 1.0), (1.0, 1.0, 1, 1.0),
    ):  # fmt: skip
        assert _uncertainty.lack_of_fit(scatter(contradiction, blocks), misfit) == share
    assert 0.0 < _uncertainty.lack_of_fit(scatter(1.5), 1.0) < 1.0
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


def test_the_spread_is_that_of_the_values_beyond_their_noise_and_the_error_of_the_model():
    rng = np.random.default_rng(1)
    std = rng.uniform(0.002, 0.01, 30)
    same = _uncertainty.estimate_spread(std * rng.normal(size=30), std, std)
    assert same < 0.004
    zoomed = _uncertainty.estimate_spread(rng.normal(0.0, 0.3, 30) + std * rng.normal(size=30), std, std)
    assert zoomed == pytest.approx(0.3, rel=0.5)
    rng = np.random.default_rng(2)
    std = np.full(12, 0.01)
    values = [0.02 * rng.normal(size=12) + std * rng.normal(size=12) for _ in range(200)]
    assert np.median([_uncertainty.estimate_spread(v, std, std) for v in values]) == pytest.approx(
        0.02, rel=0.15
    )
    assert np.median([_uncertainty.estimate_spread(v, std, 5.0 * std) for v in values]) < 0.005
    assert _uncertainty.estimate_spread(np.zeros(1), np.ones(1), np.ones(1)) == np.inf


def prior_of(value, kind, shared, std=1e-3):
    std = np.full(value.shape, std)
    return _uncertainty.estimate_hierarchical_prior(
        _uncertainty.PerCameraEstimates(value, std, 0.0 * std, np.array(kind)), shared
    )


def test_one_zoomed_camera_does_not_pull_the_rest_and_kinds_have_spreads_of_their_own():
    rng = np.random.default_rng(3)
    value = 0.001 * rng.normal(size=(9, 8))
    value[4, 0] += 0.4
    found = prior_of(value, [0] * 9, np.tile(np.arange(9)[:, None], (1, 8)))
    np.testing.assert_array_equal(found.kind, np.where(np.arange(9) == 4, -1, 0))
    assert found.spread[0, 0] < 0.005
    assert _uncertainty.find_outliers(value[:, 0], np.full(9, 0.001)).sum() == 1
    rng = np.random.default_rng(5)
    value = np.zeros((12, 8))
    value[:6, 0], value[6:, 0] = 0.001 * rng.normal(size=6), 0.2 * rng.normal(size=6)
    value[:6, 3], value[6:, 3] = 20.0 * rng.normal(size=6), 0.001 * rng.normal(size=6)
    own = np.tile(np.arange(12)[:, None], (1, 8))
    found = prior_of(value, np.repeat([0, 1], 6), own)
    assert found.spread[0, 0] < 0.005 < 0.05 < found.spread[6, 0]
    assert found.spread[6, 3] < 0.005 < 5.0 < found.spread[0, 3]


def test_shrinking_needs_several_of_one_kind_and_matches_that_say_less():
    value, own = np.zeros((4, 8)), np.tile(np.arange(4)[:, None], (1, 8))
    assert prior_of(value, [0] * 4, np.zeros_like(own), std=0.01) is None
    assert prior_of(value, [0, 0, 1, 2], own, std=0.01) is None
    assert prior_of(value, [0] * 4, own, std=0.01) is not None
    lent = _uncertainty.FocalShrinkage(np.array([0.02, 0.001, 0.02]), np.array([0.1, 0.1, 0.9]))
    assert [lent.is_shrunk(view, 0.005) for view in range(3)] == [True, False, False]
    assert "8% (1 sigma)" in _uncertainty.FocalShrinkage(np.array([0.08]), np.ones(1)).warnings([0], 0.05)[0]


def test_a_badly_determined_focal_is_shrunk_and_named():
    scene = with_few_points(make_scene(sigma_px=0.5, points=400, seed=11), 3, 30)
    alone, together = (refine(scene, cameras="per-image", common_prior=common) for common in (False, True))
    wide, narrow = alone.intrinsics[3]["focal_px"], together.intrinsics[3]["focal_px"]
    assert narrow.std < 0.7 * wide.std
    assert "shrunk towards the other cameras" in narrow.source
    assert "shrunk" not in wide.source
    stated = float(narrow.source.split("own matches alone: ")[1].split("%")[0]) / 100.0
    # As in the adjustment that has no other cameras of its kind to rest on.
    assert stated == pytest.approx(wide.std / wide.value, rel=0.15)
    for result in (alone, together):
        assert result.reconstruction.registered.all()
        for view, intervals in enumerate(result.intrinsics):
            focal = intervals["focal_px"]
            assert abs(focal.value - scene.K[view, 0, 0]) < 4.0 * focal.std
    if wide.std > 0.06 * wide.value:
        assert any("#3" in said for said in alone.warnings)
