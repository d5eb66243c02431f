"""Section 5.4: the two tests of the text and the one by Sampson's distance."""

import numpy as np
import pytest

from tests.epipolar.pairs import make_pair, spoil
from tests.geometry.properties import holds_for_every
from thesisrecon.epipolar.ransac import (
    BothLinesTest,
    SampsonTest,
    SumOfLinesTest,
    ThesisRansac,
    discard_outliers,
)
from thesisrecon.geometry.two_view import (
    algebraic_residuals,
    epipolar_distances,
    fundamental_from_cameras,
    sampson_residuals,
    symmetric_residuals,
)

TESTS = [SampsonTest(), BothLinesTest(), SumOfLinesTest()]


@holds_for_every()
def test_5_5_and_5_6_the_two_distances_are_multiples_of_one_residual(rng):
    F, xy1, xy2 = rng.normal(size=(3, 3)), rng.normal(size=(20, 2)), rng.normal(size=(20, 2))
    d = epipolar_distances(F, xy1, xy2)
    np.testing.assert_allclose(np.sqrt(np.sum(d**2, axis=1)), symmetric_residuals(F, xy1, xy2), rtol=1e-9)
    # 1 / s^2 = 1 / d1^2 + 1 / d2^2: the Sampson distance is the shorter of all three.
    s = np.abs(sampson_residuals(F, xy1, xy2))
    np.testing.assert_allclose(s * np.sqrt(np.sum(d**2, axis=1)), d[:, 0] * d[:, 1], rtol=1e-9)
    assert (2.0 * s <= symmetric_residuals(F, xy1, xy2) * (1.0 + 1e-9)).all()


def test_5_3_the_residual_over_its_gradient_has_the_noise_of_a_coordinate():
    rng, sigma = np.random.default_rng(0), 0.7
    pair = make_pair(300, rng)
    F = fundamental_from_cameras(pair.P1, pair.P2)
    found = []
    for _ in range(20):
        xy1, xy2 = (xy + rng.normal(0.0, sigma, xy.shape) for xy in (pair.xy1, pair.xy2))
        found.append(sampson_residuals(F, xy1, xy2))
        raw = algebraic_residuals(F, xy1, xy2)
        assert np.std(raw / found[-1]) > 0.0
    assert np.std(found) == pytest.approx(sigma, rel=0.03)


@pytest.mark.parametrize(("test", "share"), [(TESTS[0], 0.95), (TESTS[1], 0.95), (TESTS[2], 0.916)])
def test_the_share_of_right_matches_that_pass(test, share):
    rng = np.random.default_rng(1)
    pair = make_pair(4000, rng)
    F = fundamental_from_cameras(pair.P1, pair.P2)
    xy1, xy2 = (xy + rng.normal(0.0, 0.5, xy.shape) for xy in (pair.xy1, pair.xy2))
    sigma, inliers = discard_outliers(F, xy1, xy2, test=test)
    assert sigma == pytest.approx(0.5, rel=0.1)
    assert inliers.mean() == pytest.approx(share, abs=0.035)


@pytest.mark.parametrize("settings", [{"both_lines": True}, {"sum_of_lines": True}])
def test_algorithm_2_with_the_tests_of_the_text_finds_the_right_matches(settings):
    rng = np.random.default_rng(2)
    xy1, xy2, wrong = spoil(make_pair(150, rng), rng, sigma=0.3, outliers=0.3)
    fit = ThesisRansac(samples=300, **settings).estimate(xy1, xy2, rng)
    usual = ThesisRansac(samples=300).estimate(xy1, xy2, np.random.default_rng(2))
    assert np.mean(fit.inliers == usual.inliers) > 0.9
    assert fit.sigma_px == pytest.approx(usual.sigma_px, rel=0.2)
    assert wrong.any()


def test_one_test_at_a_time():
    with pytest.raises(ValueError, match="not by both"):
        ThesisRansac(both_lines=True, sum_of_lines=True)
