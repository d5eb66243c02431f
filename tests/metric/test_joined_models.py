"""Two models of one row of images are joined by the points that they share, if chance does not explain it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.synthetic import reconstruction_of
from thesisrecon import Tracks
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.triangulation import triangulate_observations
from thesisrecon.metric import _joined_models
from thesisrecon.metric._joined_models import join_all, join_models, joinable
from thesisrecon.records import Similarity

SIZE, FOCAL, NOISE_PX = (640, 480), 600.0, 0.3
K = np.array([[FOCAL, 0, 319.5], [0, FOCAL, 239.5], [0, 0, 1]])
OWN = 60
WORLD = Similarity(3.0, Rotation.from_euler("xyz", [40, -70, 110], degrees=True).as_matrix(), np.ones(3))


def row(common=10, singles=0, noise_px=NOISE_PX, seed=0, parts=2, own=OWN, alike=False, before=0):
    """Models of parts of three cameras each in one row, which share points with the next part, and the truth.

    Each model but the first has a world of its own. Of ``singles`` more points the next part sees one image,
    of ``before`` more points the part before sees one.
    If the parts are ``alike``, they are rows before equal facades, and the common points are wrong.
    """
    rng, views = np.random.default_rng(seed), 3 * parts
    centres = np.column_stack([np.arange(views) % (3 if alike else views), rng.normal(0, 0.2, (views, 2))])
    R = Rotation.from_euler("xyz", rng.normal(0, 4, (views, 3)), degrees=True).as_matrix()
    seen, X, view = [], [], np.arange(views)
    for first in range(0, views, 3):
        for count, less, more in ((own, 0, 0), (common, 0, 3), (singles, 0, 1), (before, 1, 0)):
            left = 0 if alike else first
            X.append(rng.uniform([left - 1, -1, 5], [left + 3, 1, 9], (count, 3)))
            seen.append(np.tile((view >= first - less) & (view < first + 3 + more), (count, 1)))
    X, (point, view) = np.concatenate(X), np.nonzero(np.concatenate(seen))
    P = camera_from_centre(np.tile(K, (views, 1, 1)), R, centres)
    xy = dehomogenize(np.einsum("nij,nj->ni", P[view], homogenize(X)[point]))
    tracks = Tracks(view, point, xy + rng.normal(0, noise_px, xy.shape), views, len(X))
    return [model_of(tracks, P, part, max(noise_px, 1e-3)) for part in range(parts)], P


def model_of(tracks, P, part, sigma_px):
    registered = np.arange(len(P)) // 3 == part
    here = registered[tracks.view_index]
    view, point = tracks.view_index[here], tracks.point_index[here]
    X = triangulate_observations(P, view, point, tracks.xy[here], tracks.n_points)
    valid = np.bincount(point, minlength=tracks.n_points) >= 2
    X, Rt = X / np.where(X[:, 3:] == 0, 1, X[:, 3:]), np.linalg.solve(K, P)
    if part:
        R = Rt[:, :, :3] @ WORLD.R.T
        Rt = np.concatenate([R, WORLD.scale * Rt[:, :, 3:] - R @ WORLD.t[:, None]], axis=2)
        X = homogenize(WORLD.apply(X[:, :3]))
    own, Ks = (np.where(registered[:, None, None], a, 0.0) for a in (K @ Rt, K))
    fields = {"registered": registered, "valid": valid, "inlier": here & valid[tracks.point_index]}
    X = np.where(valid[:, None], X, 0)
    return reconstruction_of(own, SIZE, X=X, tracks=tracks, K=Ks, sigma_px=sigma_px, **fields)


def require_right(joined, P, within):
    """Every camera stands where it stood: depths of 7 from a baseline of 2 have a deviation of 0.02."""
    assert joined.registered.all()
    found, truth = (-np.linalg.solve(p[:, :, :3], p[:, :, 3:])[:, :, 0] for p in (joined.P, P))
    assert np.linalg.norm(found - truth, axis=1).max() < within


def join(models, seed=0):
    return join_models(*models, np.random.default_rng(seed))


def test_exact_points_give_the_exact_similarity():
    models, P = row(6, noise_px=0.0)
    joined = join(models)
    require_right(joined, P, 1e-6)
    assert joined.valid.all()
    assert joined.inlier.all()
    x = np.einsum("nij,nj->ni", joined.P[joined.tracks.view_index], joined.X[joined.tracks.point_index])
    np.testing.assert_allclose(dehomogenize(x), joined.tracks.xy, atol=1e-4)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("common", [6, 12])
def test_noisy_points_give_it_within_their_noise(common, seed):
    models, P = row(common, seed=seed)
    require_right(join(models), P, 0.15)


def with_wrong_points(models, count, seed=0, shift=None):
    """The second model with other positions for ``count`` of the common points: random, or shifted alike."""
    first, second = models
    common = np.flatnonzero(first.valid & second.valid)[:count]
    X, rng = second.X.copy(), np.random.default_rng(seed)
    others = rng.permutation(np.flatnonzero(second.valid))[:count]
    X[common, :3] = X[others, :3] if shift is None else X[common, :3] + shift
    return first, replace(second, X=X)


def test_wrong_points_are_outliers_of_the_joined_model():
    models, P = row(16)
    joined = join(with_wrong_points(models, 5))
    require_right(joined, P, 0.15)
    wrong = np.flatnonzero(models[0].valid & models[1].valid)[:5]
    seen = np.isin(joined.tracks.point_index, wrong)
    assert (joined.tracks.view_index[seen & joined.inlier] < 3).all()


@pytest.mark.parametrize("common", [6, 10, 30])
def test_wrong_points_alone_are_refused(common):
    for seed in range(10):
        models, _ = row(common, seed=seed)
        assert join(with_wrong_points(models, common, seed), seed) is None


def test_rows_before_equal_facades_are_not_joined(monkeypatch):
    """Many common points agree, but the images of a row see nothing else of the other facade."""
    models, _ = row(24, own=600, alike=True)
    assert join(models) is None
    monkeypatch.setattr(_joined_models, "MIN_SEEN", 0.0)
    assert join(models).registered.all()


def test_points_on_a_line_fewer_than_six_and_two_similarities_are_refused():
    models, _ = row(10)
    common = np.flatnonzero(models[0].valid & models[1].valid)
    lines = []
    for model in models:
        X, (a, b) = model.X.copy(), model.X[common[:2], :3]
        X[common, :3] = a + np.linspace(0, 1, 10)[:, None] * (b - a)
        lines.append(replace(model, X=X))
    two = with_wrong_points(row(16)[0], 8, shift=[0.0, 4.0, 0.0])
    for refused in (lines, row(5)[0], row(0)[0], two):
        assert join(refused) is None


def test_points_that_one_model_sees_in_a_single_image_count():
    models, P = row(4, singles=6)
    joined = join(models)
    require_right(joined, P, 0.15)
    assert joined.inlier[joined.tracks.view_index == 3].all()
    assert join(row(4)[0]) is None


def test_models_without_a_point_that_both_know_are_joined_by_images_that_see_the_other():
    models, P = row(0, singles=30, before=30)
    assert not (models[0].valid & models[1].valid).any()
    joined = join(models)
    require_right(joined, P, 0.15)
    assert joinable(models[0], [[3, 4, 5]]) == [[3, 4, 5]]
    # Points of one image give no scale.
    for few in ({"singles": 30}, {"before": 30}):
        one = row(0, **few)[0]
        assert join(one) is None
        assert joinable(one[0], [[3, 4, 5]]) == []


def test_models_are_joined_one_behind_another_if_they_share_points():
    models, P = row(12, parts=3)
    rng = np.random.default_rng(0)
    require_right(join_all(models[0], [models[2], models[1]], rng), P, 0.5)
    assert join_all(models[0], models[2:], rng) is models[0]
    first = row(12, parts=3)[0][0]
    assert joinable(first, [[3, 4, 5], [6, 7, 8]]) == [[3, 4, 5], [6, 7, 8]]
    assert joinable(first, [[6, 7, 8]]) == []
    assert joinable(row(5)[0][0], [[3, 4, 5]]) == []
