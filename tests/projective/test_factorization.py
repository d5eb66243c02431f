"""Sturm and Triggs' factorisation, its iterated form, and the core of views that it begins with."""

from dataclasses import replace

import numpy as np
import pytest

from tests.conftest import refuses
from tests.constants import with_constants
from tests.projective.test_reconstruction import residuals
from tests.synthetic import make_scene, true_pairs
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.projective.factorization import (
    Factorization,
    _factorize_robustly,
    _grow_core,
    _is_planar,
    depths_from_fundamentals,
    factorize,
)
from thesisrecon.records import Tracks

STAR = [(0, k) for k in range(1, 6)]
CHAIN = [(k, k + 1) for k in range(5)]


def complete_tracks(seed, sigma_px=0.0, points=80):
    """A scene of six views and its images (6, N, 2) of every point."""
    scene = make_scene(views=6, points=points, seed=seed)
    xy = np.stack([project(P, scene.X) for P in scene.P])
    return scene, xy + sigma_px * np.random.default_rng(seed).normal(size=xy.shape)


def rms_px(factors):
    return np.sqrt(np.mean(factors[2] ** 2))


def fundamentals(scene):
    return {(p.i, p.j): -2.0 * p.F for p in true_pairs(scene)}


@pytest.mark.parametrize("tree", [STAR, CHAIN])
@pytest.mark.parametrize("seed", range(3))
def test_depths_from_fundamental_matrices_are_those_of_the_cameras_up_to_scales(tree, seed):
    scene, xy = complete_tracks(seed)
    depths = depths_from_fundamentals(xy, fundamentals(scene), tree)
    true = np.einsum("vb,nb->vn", scene.P[:, 2], homogenize(scene.X))
    ratio = depths / true
    # A rank of one: scales of views times scales of points.
    s = np.linalg.svd(ratio, compute_uv=False)
    assert s[1] < 1e-6 * s[0]


@pytest.mark.parametrize("tree", [STAR, CHAIN])
@pytest.mark.parametrize("seed", range(3))
def test_exact_matches_factorise_exactly(tree, seed):
    scene, xy = complete_tracks(seed)
    factors = factorize(xy, depths_from_fundamentals(xy, fundamentals(scene), tree))
    assert rms_px(factors) < 1e-3


def test_iterations_bring_the_factors_to_the_noise_and_any_depths_will_do_to_begin():
    for seed in range(3):
        scene, xy = complete_tracks(seed, sigma_px=1.0)
        depths = depths_from_fundamentals(xy, fundamentals(scene), STAR)
        once, often, affine = (
            rms_px(factorize(xy, d, iterations=n)) for d, n in ((depths, 0), (depths, 50), (None, 100))
        )
        # 6 x 80 x 2 coordinates; the model has 6 x 11 + 80 x 3 - 15 parameters.
        expected = np.sqrt(2.0 * (1.0 - (66 + 240 - 15) / 960))
        assert often < 1.1 * expected
        assert often <= once
        assert affine == pytest.approx(often, rel=0.01)


def test_a_negative_number_of_iterations_is_refused():
    refuses(ValueError, "iterations", Factorization, iterations=-1)


def test_points_that_disagree_are_left_out():
    scene, xy = complete_tracks(1, sigma_px=0.5)
    xy[3, :6] += 25.0
    depths = depths_from_fundamentals(xy, fundamentals(scene), STAR)
    factors = _factorize_robustly(xy, depths, 7.0, 50)
    assert 0.95 * 74 < len(factors[1]) <= 74
    assert rms_px(factors) < 0.8


def test_the_core_grows_by_the_view_that_shares_most_as_long_as_enough_is_shared():
    seen = np.zeros((4, 100), dtype=bool)
    seen[0], seen[1, :80], seen[2, :60], seen[3, :20] = True, True, True, True
    pairs = [replace(p, homography_inlier_ratio=0.2) for p in true_pairs(make_scene(views=4, points=30))]
    assert _grow_core(seen, pairs, pairs[0], min_tracks=50)[1][1] == 2
    assert len(_grow_core(seen, pairs, pairs[0], min_tracks=50)) == 2
    assert len(_grow_core(seen, pairs, pairs[0], min_tracks=10)) == 3
    # Views that no accepted pair ties to the core stay out.
    untied = [replace(p, accepted=2 not in (p.i, p.j)) for p in pairs]
    assert [j for _, j in _grow_core(seen, untied, pairs[0], min_tracks=10)] == [1, 3]


@pytest.mark.parametrize("iterations", [0, 50])
def test_a_scene_is_reconstructed_from_its_core_despite_bad_views(iterations):
    scene = make_scene(seed=4, sigma_px=0.5, points=600)
    t = scene.tracks
    wrong = np.random.default_rng(5).random(len(t.xy)) < 0.03
    xy = t.xy + np.where(wrong[:, None], 80.0, 0.0)
    found = with_constants(Factorization, core_points=60)(iterations).reconstruct(
        replace(t, xy=xy), true_pairs(scene), scene.sizes, rng=np.random.default_rng(0)
    )
    assert found.registered.all()
    assert found.sigma_px == pytest.approx(0.5, rel=0.25)
    assert found.inlier[wrong].mean() < 0.05
    assert np.sqrt(np.mean(residuals(found) ** 2)) < 0.5 * np.sqrt(2.0) * 1.1


def test_tracks_of_a_plane_that_all_of_a_core_share_do_not_begin_alone():
    scene = make_scene(views=4, points=300, seed=6, sigma_px=0.3)
    X = scene.X.copy()
    flat = np.arange(300) < 120
    X[flat, 2] = 0.3 * X[flat, 0] - 0.4
    # Views 0 and 1 see everything, 2 and 3 the plane and half of the rest each.
    sees = np.ones((4, 300), dtype=bool)
    sees[2, 120::2] = sees[3, 121::2] = False
    point, view = np.nonzero(sees.T)
    xy = np.stack([project(P, X) for P in scene.P])[view, point]
    tracks = Tracks(view, point, xy + np.random.default_rng(0).normal(0, 0.3, xy.shape), 4, 300)
    planar = replace(scene, X=X, tracks=tracks)
    images = np.stack([project(P, X) for P in scene.P])
    assert _is_planar(images[:, flat], STAR[:3], 1.0)
    assert not _is_planar(images, STAR[:3], 1.0)
    found = Factorization().reconstruct(tracks, true_pairs(planar), scene.sizes, rng=np.random.default_rng(0))
    assert found.registered.all()
    assert found.inlier.mean() > 0.98


def test_too_few_common_tracks_are_a_failure_in_words():
    scene = make_scene(points=12)
    with pytest.raises(StageFailure, match="too few tracks"):
        Factorization().reconstruct(
            scene.tracks, true_pairs(scene), scene.sizes, rng=np.random.default_rng(0)
        )
