"""Cameras of one kind: how their scatter is measured, who borrows, and what is said of it."""

from dataclasses import replace

import numpy as np
import pytest

from tests.synthetic import make_scene, projective_reconstruction
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.metric._uncertainty import (
    PerCameraEstimates,
    estimate_hierarchical_prior,
    estimate_spread,
    find_outliers,
)
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.records import SelfCalibration, Upgrade


def true_calibration(scene):
    """The truth as an upgrade of ``projective_reconstruction``, focals 2 % off."""
    G = np.eye(4) + 0.3 * np.random.default_rng(0).normal(size=(4, 4))
    K = scene.K * np.array([1.02, 1.02, 1.0])[:, None]
    K[:, :2, 2] = (scene.sizes - 1) / 2
    upgrade = Upgrade(np.linalg.inv(G), K, 0.0, "truth")
    return SelfCalibration(upgrade.metric_from_projective, K, np.zeros_like(K), True, (), (upgrade,))


def refine(scene, *, start=None, **options):
    start = projective_reconstruction(scene) if start is None else start
    rng, prior = np.random.default_rng(0), prior_for(start, IntrinsicsOptions(**options))
    return MetricRefinement().refine(start, true_calibration(scene), prior=prior, rng=rng)


def with_few_points(scene, view, count):
    """The scene with ``count`` observations left in one view."""
    t = scene.tracks
    here = np.flatnonzero(t.view_index == view)
    keep = np.ones(len(t.xy), dtype=bool)
    keep[here[count:]] = False
    return replace(
        scene,
        tracks=replace(t, view_index=t.view_index[keep], point_index=t.point_index[keep], xy=t.xy[keep]),
    )


def test_the_spread_of_values_that_agree_is_small_and_of_zoomed_ones_large():
    rng = np.random.default_rng(1)
    std = rng.uniform(0.002, 0.01, 30)
    same = estimate_spread(std * rng.normal(size=30), std, std)
    assert same < 0.004
    zoomed = estimate_spread(rng.normal(0.0, 0.3, 30) + std * rng.normal(size=30), std, std)
    assert zoomed == pytest.approx(0.3, rel=0.5)


def test_the_spread_is_that_of_the_values_beyond_their_noise_and_the_error_of_the_model():
    rng = np.random.default_rng(2)
    std = np.full(12, 0.01)
    values = [0.02 * rng.normal(size=12) + std * rng.normal(size=12) for _ in range(200)]
    assert np.median([estimate_spread(v, std, std) for v in values]) == pytest.approx(0.02, rel=0.15)
    assert np.median([estimate_spread(v, std, 5.0 * std) for v in values]) < 0.005
    assert estimate_spread(np.zeros(1), np.ones(1), np.ones(1)) == np.inf


def prior_of(value, kind, shared, std=1e-3):
    std = np.full(value.shape, std)
    return estimate_hierarchical_prior(PerCameraEstimates(value, std, 0.0 * std, np.array(kind)), shared)


def test_one_zoomed_camera_does_not_pull_the_rest():
    rng = np.random.default_rng(3)
    value = 0.001 * rng.normal(size=(9, 8))
    value[4, 0] += 0.4
    found = prior_of(value, [0] * 9, np.tile(np.arange(9)[:, None], (1, 8)))
    np.testing.assert_array_equal(found.kind, np.where(np.arange(9) == 4, -1, 0))
    assert found.spread[0, 0] < 0.005
    assert find_outliers(value[:, 0], np.full(9, 0.001)).sum() == 1


def test_nothing_is_shrunk_if_all_is_shared_or_too_few_are_of_one_kind():
    value, own = np.zeros((4, 8)), np.tile(np.arange(4)[:, None], (1, 8))
    assert prior_of(value, [0] * 4, np.zeros_like(own), std=0.01) is None
    assert prior_of(value, [0, 0, 1, 2], own, std=0.01) is None
    assert prior_of(value, [0] * 4, own, std=0.01) is not None


def test_a_badly_determined_focal_is_shrunk_and_named():
    scene = with_few_points(make_scene(sigma_px=0.5, points=400, seed=11), 3, 30)
    alone, together = (refine(scene, cameras="per-image", common_prior=common) for common in (False, True))
    assert alone.reconstruction.registered.all()
    assert together.reconstruction.registered.all()
    wide, narrow = alone.intrinsics[3]["focal_px"], together.intrinsics[3]["focal_px"]
    assert narrow.std < 0.7 * wide.std
    assert "shrunk towards the other cameras" in narrow.source
    assert "shrunk" not in wide.source
    stated = float(narrow.source.split("own matches alone: ")[1].split("%")[0]) / 100.0
    # As in the adjustment that has no other cameras of its kind to rest on.
    assert stated == pytest.approx(wide.std / wide.value, rel=0.15)
    for result in (alone, together):
        for view, intervals in enumerate(result.intrinsics):
            focal = intervals["focal_px"]
            assert abs(focal.value - scene.K[view, 0, 0]) < 4.0 * focal.std
    if wide.std > 0.06 * wide.value:
        assert any("#3" in said for said in alone.warnings)


def test_zoomed_photographs_keep_their_own_focals():
    scene = make_scene(sigma_px=0.3, points=400, zoom=0.4, seed=12)
    result = refine(scene, cameras="per-image")
    K = result.reconstruction.K
    np.testing.assert_allclose(K[:, 0, 0] / scene.K[:, 0, 0], 1.0, atol=0.01)
    assert not any("shrunk" in intervals["focal_px"].source for intervals in result.intrinsics)


def test_kinds_of_different_sizes_have_spreads_of_their_own():
    rng = np.random.default_rng(5)
    value = np.zeros((12, 8))
    value[:6, 0], value[6:, 0] = 0.001 * rng.normal(size=6), 0.2 * rng.normal(size=6)
    value[:6, 3], value[6:, 3] = 20.0 * rng.normal(size=6), 0.001 * rng.normal(size=6)
    own = np.tile(np.arange(12)[:, None], (1, 8))
    found = prior_of(value, np.repeat([0, 1], 6), own)
    assert found.spread[0, 0] < 0.005 < 0.05 < found.spread[6, 0]
    assert found.spread[6, 3] < 0.005 < 5.0 < found.spread[0, 3]
