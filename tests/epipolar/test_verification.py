"""Verification of pairs, and how planar they are."""

import os
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import refuses
from tests.epipolar.pairs import SIZE, Pair, make_pair, spoil
from thesisrecon.api.pairs import estimate_fundamental
from thesisrecon.epipolar.homography import induced_homographies
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.epipolar.ransac import ThesisRansac
from thesisrecon.epipolar.verification import (
    PairVerification,
    homography_inlier_ratio,
)
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.two_view import (
    epipoles,
    fundamental_from_cameras,
    homography_residuals,
    sampson_residuals,
)
from thesisrecon.records import FundamentalFit, Matches


def as_matches(xy1, xy2):
    n = len(xy1)
    affine = np.tile(np.eye(2), (n, 1, 1))
    return Matches(2, 5, np.arange(n), np.arange(n)[::-1].copy(), xy1, xy2, np.ones(n, np.float32), affine)


def verified(pair, *, outliers, seed=0, variant=None):
    xy1, xy2, wrong = spoil(pair, np.random.default_rng(seed), sigma=0.3, outliers=outliers)
    fit = estimate_fundamental(xy1, xy2)
    return (
        (variant or PairVerification()).verify(as_matches(xy1, xy2), fit, np.random.default_rng(0)),
        fit,
        wrong,
    )


def test_a_good_pair_keeps_its_inliers_and_is_accepted():
    pair, fit, _ = verified(make_pair(300, np.random.default_rng(0)), outliers=0.3)
    assert pair.accepted
    assert pair.reason == ""
    assert (pair.i, pair.j, pair.candidates) == (2, 5, 300)
    assert pair.inliers == fit.inliers.sum()
    np.testing.assert_array_equal(pair.index1, np.flatnonzero(fit.inliers))
    np.testing.assert_array_equal(pair.index2, 299 - np.flatnonzero(fit.inliers))
    assert len(pair.affine) == pair.inliers
    assert pair.homography_inlier_ratio < 0.5
    assert pair.configuration == "general"
    assert not pair.undetermined
    assert pair.degeneracy is not None


def test_a_plane_is_accepted_and_reported():
    pair, _, _ = verified(make_pair(300, np.random.default_rng(1), planar=True), outliers=0.2)
    assert pair.accepted
    assert pair.homography_inlier_ratio > 0.97
    assert pair.configuration == "plane"
    assert pair.undetermined
    assert pair.degeneracy is not None
    assert "one homography explains the matches (plane)" in pair.degeneracy.reasons


def test_a_turned_camera_is_a_homography_too():
    rng = np.random.default_rng(2)
    scene = make_pair(200, rng)
    H = np.array([[0.98, 0.05, 30.0], [-0.06, 0.99, 10.0], [2e-5, -1e-5, 1.0]])
    moved = np.c_[scene.xy1, np.ones(200)] @ H.T
    turned = Pair(scene.xy1, moved[:, :2] / moved[:, 2:], scene.F, scene.P1, scene.P2)
    pair, _, _ = verified(turned, outliers=0.1)
    assert pair.homography_inlier_ratio > 0.97
    assert pair.undetermined


def test_few_inliers_are_refused_with_numbers():
    pair, _, _ = verified(make_pair(40, np.random.default_rng(3)), outliers=0.0)
    assert not pair.accepted
    assert f"only {pair.inliers} of 40 matches" in pair.reason
    assert "60 are needed" in pair.reason


def test_a_small_share_is_refused_with_numbers():
    pair, _, _ = verified(make_pair(400, np.random.default_rng(4)), outliers=0.77)
    assert pair.inliers >= 60
    assert not pair.accepted
    assert "of 400 matches agree" in pair.reason
    assert "25 % are needed" in pair.reason


def test_unrelated_matches_are_refused():
    rng = np.random.default_rng(5)
    xy1, xy2 = rng.uniform((0, 0), SIZE, (300, 2)), rng.uniform((0, 0), SIZE, (300, 2))
    pair = PairVerification().verify(
        as_matches(xy1, xy2), estimate_fundamental(xy1, xy2), np.random.default_rng(0)
    )
    assert not pair.accepted
    assert pair.reason


def test_share_of_a_dominant_plane_is_measured():
    rng = np.random.default_rng(6)
    flat = make_pair(140, rng, planar=True)
    X = rng.uniform((-1.2, -1.2, 3.8), (1.2, 1.2, 6.2), (60, 3))
    xy1 = np.r_[flat.xy1, project(flat.P1, X)]
    xy2 = np.r_[flat.xy2, project(flat.P2, X)]
    share = homography_inlier_ratio(flat.F, xy1, xy2, tolerance_px=2.0, rng=np.random.default_rng(0))
    assert 0.69 < share < 0.8


def test_homographies_of_a_plane_from_three_matches():
    pair = make_pair(12, np.random.default_rng(7), planar=True)
    triples = np.array([[0, 1, 2], [3, 4, 5], [6, 6, 7]])
    points = np.hstack([pair.xy1, pair.xy2])
    H = induced_homographies(pair.F, epipoles(pair.F)[1], points, triples, 1e-2)
    assert len(H) == 2
    for one in H:
        assert homography_residuals(one, pair.xy1, pair.xy2).max() < 1e-3


def test_verification_is_the_same_every_time_and_safe_on_nothing():
    xy = np.random.default_rng(0).uniform(0, 100, (12, 2))
    for inliers in (np.zeros(12, bool), np.arange(12) < 4, np.ones(12, bool)):
        fit = FundamentalFit(np.diag([1.0, 1.0, 0.0]) / np.sqrt(2), inliers, 0.1, np.zeros((9, 9)))
        first, second = (
            PairVerification().verify(as_matches(xy, xy), fit, np.random.default_rng(0)) for _ in range(2)
        )
        assert first.homography_inlier_ratio == second.homography_inlier_ratio
        assert first.configuration == second.configuration
        assert np.isfinite(first.homography_inlier_ratio)
        assert not first.accepted


def test_wrong_calls():
    xy = np.random.default_rng(0).uniform(0, 100, (12, 2))
    fit = FundamentalFit(np.eye(3), np.ones(11, bool), 0.1, np.zeros((9, 9)))
    refuses(ValueError, "11", PairVerification().verify, as_matches(xy, xy), fit, np.random.default_rng(0))
    refuses(ValueError, "min_inliers", PairVerification, min_inliers=3)
    refuses(ValueError, "min_inlier_ratio", PairVerification, min_inlier_ratio=1.5)


DATA = Path(os.environ.get("THESISRECON_DATA", Path(__file__).resolve().parents[2] / "../shared/data"))


def load(name):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"the real data are not on this machine ({name})")
    return np.loadtxt(path)


@pytest.mark.real
@pytest.mark.parametrize("estimator", [LocallyOptimisedRansac(), ThesisRansac()])
@pytest.mark.parametrize("view", [0, 9, 20])
def test_turntable_tracks(estimator, view):
    tracks = load("dinosaur/tracks.txt")
    P = load("dinosaur/projections.txt").reshape(-1, 3, 4)
    seen = tracks.reshape(len(tracks), -1, 2)[:, view : view + 2]
    seen = seen[(seen != -1).all(axis=(1, 2))]
    xy1, xy2 = seen[:, 0].copy(), seen[:, 1].copy()
    good = np.abs(sampson_residuals(fundamental_from_cameras(P[view], P[view + 1]), xy1, xy2)) < 1.0
    rng = np.random.default_rng(view)
    wrong = rng.random(len(xy1)) < 0.2
    xy2[wrong] = rng.uniform(xy2.min(axis=0), xy2.max(axis=0), (int(wrong.sum()), 2))
    fit = estimator.estimate(xy1, xy2, rng)
    assert fit.sigma_px < 0.5
    assert fit.inliers[good & ~wrong].mean() > 0.8
    assert fit.inliers[wrong].mean() < 0.1


@pytest.mark.real
@pytest.mark.parametrize("name", ["biscuit", "book"])
def test_hand_labelled_matches(name):
    rows = load(f"adelaide/{name}/matches.txt")
    right = rows[:, 4] > 0
    fit = estimate_fundamental(rows[:, :2], rows[:, 2:4], threshold_px=2.0)
    assert fit.inliers[right].mean() > 0.7
    assert fit.inliers[~right].mean() < 0.15
