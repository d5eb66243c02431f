"""Searches of homographies, cameras and F: budgets, what chance explains, and units other than pixels."""

import tracemalloc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import refuses
from tests.synthetic import make_scene
from thesisrecon import StageFailure, estimate_fundamental, estimate_homography, resect
from thesisrecon.epipolar.homography import _add_equations, squared_plane_distances
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.triangulation import polynomial_roots
from thesisrecon.optimize.ransac import Budget, draw_samples, resect_calibrated

K = np.array([[900.0, 0.0, 639.5], [0.0, 900.0, 479.5], [0.0, 0.0, 1.0]])
H = np.array([[0.9, 0.12, 40.0], [-0.1, 0.95, 60.0], [1e-4, -5e-5, 1.0]])
SIZE = np.array([1280.0, 960.0])


def matches_of_plane(n, wrong, seed, sigma=0.5):
    rng = np.random.default_rng(seed)
    xy1 = rng.uniform(0.0, SIZE, (n, 2))
    xy2 = dehomogenize(homogenize(xy1) @ H.T) + sigma * rng.normal(size=(n, 2))
    some = rng.random(n) < wrong
    xy2[some] = rng.uniform(0.0, SIZE, (int(some.sum()), 2))
    return xy1, xy2


def points_of_camera(n, wrong, seed):
    """Points, pixels, and the rotation of the camera."""
    rng = np.random.default_rng(seed)
    R = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    true = rng.uniform(0.0, SIZE, (n, 2))
    rays = homogenize(true) @ np.linalg.inv(K).T
    X = (rays * rng.uniform(3.0, 12.0, (n, 1)) - [0.3, -0.2, 0.5]) @ R
    xy = true + 0.5 * rng.normal(size=(n, 2))
    some = rng.random(n) < wrong
    xy[some] = rng.uniform(0.0, SIZE, (int(some.sum()), 2))
    return X, xy, R


def pairs_of_scene(n, wrong, seed, sigma):
    """Matches of two views in pixels about the principal point, the first ``wrong`` of them random."""
    rng = np.random.default_rng(seed)
    X = np.column_stack([rng.uniform(-2.0, 2.0, (n, 2)), rng.uniform(4.0, 9.0, n)])
    R = Rotation.from_euler("yx", [0.1, -0.03]).as_matrix()
    xy1, xy2 = 900.0 * dehomogenize(X), 900.0 * dehomogenize(X @ R.T + [-0.8, 0.1, 0.1])
    xy1, xy2 = xy1 + sigma * rng.normal(size=(n, 2)), xy2 + sigma * rng.normal(size=(n, 2))
    xy2[:wrong] = rng.uniform(-450.0, 450.0, (wrong, 2))
    return xy1, xy2


@pytest.mark.parametrize("seed", range(4))
def test_searches_find_what_few_right_data_show(seed):
    n, wrong = (600, 0.9) if seed % 2 else (1200, 0.95)
    xy1, xy2 = matches_of_plane(n, wrong, seed)
    found = estimate_homography(xy1, xy2, threshold_px=1.5, seed=seed).H
    corners = np.array([[0.0, 0.0], [1279.0, 0.0], [1279.0, 959.0], [0.0, 959.0]])
    off = dehomogenize(homogenize(corners) @ found.T) - dehomogenize(homogenize(corners) @ H.T)
    assert np.abs(off).max() < 3.0
    for wrong, given in ((0.9, K), (0.7, None)):
        X, xy, R = points_of_camera(400, wrong, seed)
        assert np.abs(resect(X, xy, given, threshold_px=2.0, seed=seed).R - R).max() < 0.02


def test_a_small_budget_ends_the_search_and_is_named():
    xy1, xy2 = matches_of_plane(400, 0.95, 0)
    refuses(StageFailure, "best of 100 samples", estimate_homography, xy1, xy2, max_samples=100)
    X, xy, _ = points_of_camera(400, 0.9, 0)
    refuses(StageFailure, "best of 64 samples", resect, X, xy, max_samples=64)
    for call, data in ((estimate_homography, (xy1, xy2)), (resect, (X, xy))):
        refuses(ValueError, "confidence must lie between 0 and 1; got 1", call, *data, confidence=1.0)
        refuses(ValueError, "a whole number of at least 1 as max_samples", call, *data, max_samples=0)


@pytest.mark.parametrize("n", [20, 200])
@pytest.mark.parametrize("call", ["homography", "camera", "pose"])
def test_random_data_are_refused(n, call):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        xy1, xy2 = rng.uniform(0.0, 640.0, (2, n, 2))
        X = rng.uniform([-1.0, -1.0, 4.0], [1.0, 1.0, 6.0], (n, 3))
        search, data = {
            "homography": (estimate_homography, (xy1, xy2)),
            "camera": (resect, (X, xy1)),
            "pose": (resect, (X, xy1, K)),
        }[call]
        refuses(StageFailure, "chance explains|samples", search, *data, max_samples=10_000, seed=seed)


def test_equal_matches_are_one_piece_of_evidence():
    rng = np.random.default_rng(0)
    xy1, xy2 = rng.uniform(0.0, 640.0, (2, 40, 2))
    xy1[:20], xy2[:20] = xy1[0], xy2[0]
    refuses(StageFailure, "chance explains", estimate_homography, xy1, xy2, max_samples=2000)


def test_results_do_not_depend_on_the_unit():
    """Coordinates in focal lengths with a threshold in focal lengths: the same inliers, the same verdict."""
    xy1, xy2 = pairs_of_scene(280, 80, 0, 0.4)
    pixels = estimate_fundamental(xy1, xy2, threshold_px=1.0)
    normalised = estimate_fundamental(xy1 / 900.0, xy2 / 900.0, threshold_px=1.0 / 900.0)
    assert pixels.determined
    assert normalised.determined
    assert np.count_nonzero(normalised.inliers != pixels.inliers) <= 2
    assert normalised.inliers[80:].mean() > 0.9
    plane1, plane2 = matches_of_plane(200, 0.3, 0)
    fits = [estimate_homography(plane1 / u, plane2 / u, threshold_px=1.5 / u) for u in (1.0, 900.0)]
    assert np.count_nonzero(fits[0].inliers != fits[1].inliers) <= 2


def test_small_thresholds_leave_out_what_is_wrong_by_little():
    xy1, xy2 = pairs_of_scene(400, 0, 0, 0.02)
    F = estimate_fundamental(xy1, xy2).F
    lines = homogenize(xy1[:60]) @ F.T
    across = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    xy2[:60] += np.random.default_rng(1).choice([-0.35, 0.35], (60, 1)) * across
    fit = estimate_fundamental(xy1, xy2, threshold_px=0.1)
    assert fit.inliers[:60].sum() <= 10
    assert fit.inliers[60:].mean() > 0.95


def test_a_threshold_beyond_the_points_is_refused():
    xy1, xy2 = matches_of_plane(50, 0.0, 0)
    X, xy, _ = points_of_camera(50, 0.0, 0)
    for call, data in (
        (estimate_homography, (xy1, xy2)),
        (estimate_fundamental, (xy1, xy2)),
        (resect, (X, xy)),
    ):
        refuses(ValueError, "smaller than the extent of the points", call, *data, threshold_px=1e5)
        refuses(ValueError, "positive and finite", call, *data, threshold_px=np.inf)


def test_memory_grows_slower_than_a_multiple_of_the_data():
    X, xy, _ = points_of_camera(50_000, 0.0, 0)
    xy1, xy2 = matches_of_plane(50_000, 0.0, 0)
    for call, data, most in ((resect, (X, xy, K), 200), (estimate_homography, (xy1, xy2), 600)):
        call(*data)
        tracemalloc.start()
        call(*data)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < most * len(X)


@pytest.mark.parametrize(("n", "size"), [(4, 4), (9, 4), (1000, 6)])
def test_samples_are_distinct_and_cover_all_data(n, size):
    drawn = draw_samples(np.random.default_rng(0), 2000, n, size)
    assert drawn.shape == (2000, size)
    assert (np.diff(np.sort(drawn, axis=1), axis=1) > 0).all()
    counts = np.bincount(drawn.ravel(), minlength=n)
    assert np.abs(counts - 2000 * size / n).max() < 6.0 * np.sqrt(2000 * size / n) + 1


def test_roots_of_quartics():
    rng = np.random.default_rng(0)
    c = np.concatenate([rng.normal(size=(300, 5)), [np.poly(r) for r in rng.uniform(0.1, 3.0, (50, 4))]])
    true = [np.sort_complex(np.roots(quartic)) for quartic in c]
    np.testing.assert_allclose(np.sort_complex(polynomial_roots(c)), true, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(
        np.sort(polynomial_roots(np.array([[1.0, 0, -5, 0, 4]])).real), [[-2, -1, 1, 2]]
    )


@pytest.mark.parametrize("n", [6, 8, 12])
def test_few_right_data_are_accepted(n):
    for seed in range(10):
        xy1, xy2 = matches_of_plane(n, 0.0, seed, sigma=1.0)
        assert estimate_homography(xy1, xy2, threshold_px=3.0, seed=seed).inliers.sum() >= 0.7 * n
        X, xy, R = points_of_camera(n, 0.0, seed)
        assert np.abs(resect(X, xy, K, threshold_px=1.5, seed=seed).R - R).max() < 0.1


def test_matches_on_a_line_along_an_axis_are_refused():
    line = np.column_stack([np.full(10, 5.0), np.linspace(0.0, 100.0, 10)])
    for xy1, xy2 in ((line, line[:, ::-1]), (line, np.random.default_rng(0).uniform(0.0, 99.0, (10, 2)))):
        for threshold in (None, 1.0):
            words = "do not determine a homography"
            refuses(StageFailure, words, estimate_homography, xy1, xy2, threshold_px=threshold)


def test_the_gradient_of_the_sampson_distance_is_that_of_differences():
    rng = np.random.default_rng(0)
    points, h, step = rng.normal(size=(30, 4)), rng.normal(size=9), 1e-6
    G, g = np.zeros((9, 9)), np.zeros(9)
    total = _add_equations(h.reshape(3, 3), points, np.ones(30), True, G, g)
    cost = [
        squared_plane_distances(h.reshape(3, 3) + d.reshape(3, 3), points).sum() for d in step * np.eye(9)
    ]
    less = [
        squared_plane_distances(h.reshape(3, 3) - d.reshape(3, 3), points).sum() for d in step * np.eye(9)
    ]
    assert total == pytest.approx(squared_plane_distances(h.reshape(3, 3), points).sum(), rel=1e-12)
    np.testing.assert_allclose(
        2.0 * g, (np.array(cost) - less) / (2.0 * step), rtol=1e-5, atol=1e-5 * np.abs(g).max()
    )


def test_calibrated_resection_survives_half_wrong_points():
    scene, rng = make_scene(), np.random.default_rng(0)
    xy = dehomogenize(scene.X @ scene.R[0].T + scene.t[0])
    wrong = np.arange(len(xy)) % 2 == 0
    xy[wrong] += rng.uniform(0.002, 0.1, (int(wrong.sum()), 2))
    pose, inliers, _ = resect_calibrated(scene.X, xy, threshold=1e-3, budget=Budget(), rng=rng)
    np.testing.assert_allclose(pose[:, :3], scene.R[0], atol=1e-6)
    np.testing.assert_allclose(pose[:, 3], scene.t[0], atol=1e-5)
    np.testing.assert_array_equal(inliers, ~wrong)
