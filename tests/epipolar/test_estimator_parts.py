"""Each part of the judgement and of the estimators does what it is there for: none can be left out unseen."""

import numpy as np

from tests.epipolar.pairs import angle_between, make_pair, spoil
from thesisrecon.epipolar.configuration import Configuration, _refine_translation, classify_configuration
from thesisrecon.epipolar.degeneracy import assess_degeneracy
from thesisrecon.epipolar.linear import estimate_eight_point
from thesisrecon.epipolar.ransac import ThesisRansac
from thesisrecon.epipolar.refinement import refine_epipolar_distance, refine_sampson
from thesisrecon.epipolar.sampling import sampson_distances
from thesisrecon.epipolar.verification import PairVerification
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.geometry.two_view import sampson_residuals, unit_norm
from thesisrecon.records import FundamentalFit, Matches
from validation.scenes.two_views import make_two_views

H = np.array([[1.02, 0.03, 12.0], [-0.02, 0.99, -7.0], [1e-5, -2e-5, 1.0]])
POLES = np.array([[4000.0, 300.0, 1.0], [500.0, -5000.0, 1.0]])


def plane_with_parallax(counts, *, sigma=0.2, flat=300):
    """Matches of a plane, then some moved along lines through each of the epipoles; F of the first."""
    rng = np.random.default_rng(1)
    xy1 = rng.uniform((0.0, 0.0), (1000.0, 800.0), (flat + sum(counts), 2))
    x2 = np.c_[xy1, np.ones(len(xy1))] @ H.T
    xy2 = x2[:, :2] / x2[:, 2:]
    for pole, first, count in zip(POLES, (flat, flat + counts[0]), counts, strict=True):
        some = slice(first, first + count)
        along = pole[:2] / pole[2] - xy2[some]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        xy2[some] += rng.uniform(60.0, 200.0, (count, 1)) * along
    xy1, xy2 = (xy + rng.normal(0.0, sigma, xy.shape) for xy in (xy1, xy2))
    F = unit_norm(cross_matrix(POLES[0]) @ H)
    inliers = np.abs(sampson_residuals(F, xy1, xy2)) < 1.0
    return FundamentalFit(F, inliers, sigma, 1e-16 * np.eye(9)), xy1, xy2


def test_an_epipole_that_explains_as_many_is_a_reason():
    fit, xy1, xy2 = plane_with_parallax((30, 30), flat=100)
    found = assess_degeneracy(fit, xy1, xy2, rng=np.random.default_rng(0))
    assert any("another geometry explains" in reason for reason in found.reasons)
    assert found.competing_model is not None
    of_rival = np.abs(sampson_residuals(found.competing_model, xy1, xy2))
    assert (of_rival[-30:] < 1.0).mean() > 0.9
    assert (of_rival[:100] < 1.0).mean() > 0.9


def test_matches_amid_those_of_the_plane_are_a_reason():
    fit, xy1, xy2 = plane_with_parallax((40, 0))
    found = assess_degeneracy(fit, xy1, xy2, rng=np.random.default_rng(0))
    assert any("lie amid matches of the plane" in reason for reason in found.reasons)
    assert found.contradicted > 0.8 * found.off_plane


def test_relief_of_a_plane_of_few_matches_is_that_of_noise():
    """The parameters that F and the homography take from the residuals are allowed for."""
    errors = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        scene = make_two_views(Configuration.PLANE, 24, rng)
        xy1, xy2 = (xy + rng.normal(0.0, 0.5, xy.shape) for xy in (scene.xy1, scene.xy2))
        errors.append(classify_configuration(estimate_eight_point(xy1, xy2), xy1, xy2).homography_errors)
    assert 0.0 < np.median(errors) < 2.1


def test_the_translation_is_where_no_other_epipole_has_less_error():
    rng = np.random.default_rng(2)
    e = np.array([0.6, -0.5, 0.62])
    f = (cross_matrix(e / np.linalg.norm(e)) / np.sqrt(2.0)).ravel()
    x1 = rng.normal(size=(60, 2))
    towards = e[:2] / e[2] - x1
    points = np.c_[x1, x1 + rng.uniform(0.05, 0.3, (60, 1)) * towards] + rng.normal(0.0, 0.05, (60, 4))
    _refine_translation(f, points, np.inf)

    def cost(e):
        g = (cross_matrix(e) / (np.sqrt(2.0) * np.linalg.norm(e))).ravel()
        return float(np.sum(np.asarray(sampson_distances(g, points)) ** 2))

    best = np.array([f[7], f[2], f[3]])
    slopes = [(cost(best + 1e-5 * d) - cost(best - 1e-5 * d)) / 2e-5 for d in np.eye(3)]
    away = [(cost(best + 1e-2 * d) - cost(best)) / 1e-2 for d in np.eye(3)]
    assert np.abs(slopes).max() < 0.02 * np.abs(away).max()


def test_both_images_are_conditioned():
    """The units and the origin of either image do not matter to the normalised eight-point method."""
    pair = make_pair(40, np.random.default_rng(3))
    xy1, xy2, _ = spoil(pair, np.random.default_rng(3), sigma=0.5, outliers=0.0)
    F = estimate_eight_point(xy1, xy2)
    for s, t in ((1e-3, 1.0), (1.0, 1e-3)):
        S, T = (
            np.array([[s, 0, 5.0], [0, s, 3.0], [0, 0, 1]]),
            np.array([[t, 0, -2.0], [0, t, 7.0], [0, 0, 1]]),
        )
        moved = estimate_eight_point(s * xy1 + [5.0, 3.0], t * xy2 + [-2.0, 7.0])
        assert angle_between(unit_norm(T.T @ moved @ S), F) < 1e-9


def test_a_plane_of_much_noise_is_still_explained_by_a_homography():
    rng = np.random.default_rng(4)
    pair = make_pair(300, rng, planar=True)
    xy1, xy2, _ = spoil(pair, rng, sigma=2.0, outliers=0.0)
    fit = FundamentalFit(pair.F, np.ones(300, dtype=bool), 2.0, 1e-12 * np.eye(9))
    n = np.arange(300)
    matches = Matches(0, 1, n, n, xy1, xy2, np.ones(300, np.float32), np.tile(np.eye(2), (300, 1, 1)))
    found = PairVerification().verify(matches, fit, np.random.default_rng(0))
    assert found.homography_inlier_ratio > 0.95


def test_algorithm_2_minimises_the_criterion_it_is_told():
    pair = make_pair(60, np.random.default_rng(5))
    # One image smaller: there the two criteria differ. After ten rounds the inliers stay the same.
    xy1, xy2, _ = spoil(pair, np.random.default_rng(5), sigma=0.5, outliers=0.0)
    xy2 = 0.25 * xy2
    algorithm = ThesisRansac(threshold_px=3.0, epipolar_distance=True, rounds=10)
    fit = algorithm.estimate(xy1, xy2, np.random.default_rng(0))
    kept = fit.inliers
    again = refine_epipolar_distance(fit.F, xy1[kept], xy2[kept])
    other = refine_sampson(fit.F, xy1[kept], xy2[kept])
    assert angle_between(fit.F, again) < 0.1 * angle_between(other, again)
