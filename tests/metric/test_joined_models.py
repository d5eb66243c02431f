"""Two models of one row of images are joined by the points that they share, if chance does not explain it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thesisrecon import Tracks
from thesisrecon.geometry.triangulation import triangulate_observations
from thesisrecon.metric._joined_models import join_all, join_models, joinable
from thesisrecon.records import Reconstruction, Similarity

SIZE, FOCAL, NOISE_PX = (640, 480), 600.0, 0.3
K = np.array([[FOCAL, 0, 319.5], [0, FOCAL, 239.5], [0, 0, 1]])
OWN = 60
WORLD = Similarity(3.0, Rotation.from_euler("xyz", [40, -70, 110], degrees=True).as_matrix(), np.ones(3))


def row(common=10, singles=0, noise_px=NOISE_PX, seed=0, parts=2):
    """Models of parts of three cameras each in one row, which share points with the next part, and the truth.

    Each model but the first has a world of its own. Of ``singles`` more points the next part sees one image.
    """
    rng, views = np.random.default_rng(seed), 3 * parts
    centres = np.column_stack([np.arange(views), rng.normal(0, 0.2, (views, 2))])
    R = Rotation.from_euler("xyz", rng.normal(0, 4, (views, 3)), degrees=True).as_matrix()
    seen, X = [], []
    for part in range(parts):
        for kind, count in (("own", OWN), ("common", common), ("single", singles)):
            there = np.zeros(views, dtype=bool)
            there[3 * part : 3 * part + 3] = True
            if kind != "own":
                there[3 * part + 3 : 3 * part + (6 if kind == "common" else 4)] = True
            X.append(rng.uniform([3 * part - 1, -1, 5], [3 * part + 3, 1, 9], (count, 3)))
            seen.append(np.tile(there, (count, 1)))
    X, seen = np.concatenate(X), np.concatenate(seen)
    point, view = np.nonzero(seen)
    P = K @ np.concatenate([R, -(R @ centres[:, :, None])], axis=2)
    x = np.einsum("nij,nj->ni", P[view], np.column_stack([X, np.ones(len(X))])[point])
    xy = x[:, :2] / x[:, 2:] + rng.normal(0, noise_px, (len(view), 2))
    tracks = Tracks(view, point, xy, views, len(X))
    return [model_of(tracks, P, part, max(noise_px, 1e-3)) for part in range(parts)], P


def model_of(tracks, P, part, sigma_px):
    registered = np.arange(len(P)) // 3 == part
    here = registered[tracks.view_index]
    view, point = tracks.view_index[here], tracks.point_index[here]
    X = triangulate_observations(P, view, point, tracks.xy[here], tracks.n_points)
    valid = np.bincount(point, minlength=tracks.n_points) >= 2
    X = np.where(valid[:, None], X / np.where(X[:, 3:] == 0, 1, X[:, 3:]), 0)
    Rt = np.linalg.solve(K, P)
    if part:
        R = Rt[:, :, :3] @ WORLD.R.T
        Rt = np.concatenate([R, WORLD.scale * Rt[:, :, 3:] - R @ WORLD.t[:, None]], axis=2)
        X = np.where(valid[:, None], np.column_stack([WORLD.apply(X[:, :3]), np.ones(len(X))]), 0)
    own = np.where(registered[:, None, None], K @ Rt, 0)
    inlier = here & valid[tracks.point_index]
    sizes, reasons = np.tile(SIZE, (len(P), 1)), ("",) * len(P)
    seen = (registered, valid, inlier, tracks, sizes, sigma_px, reasons)
    Ks = np.where(registered[:, None, None], K, 0.0)
    return Reconstruction("metric", own, X, *seen, Ks, np.zeros((len(P), 3)))


def join(models, seed=0):
    return join_models(*models, np.random.default_rng(seed))


def centres_of(P):
    return -np.linalg.solve(P[:, :, :3], P[:, :, 3:])[:, :, 0]


def test_exact_points_give_the_exact_similarity():
    models, P = row(6, noise_px=0.0)
    joined = join(models)
    assert joined.registered.all()
    np.testing.assert_allclose(centres_of(joined.P), centres_of(P), atol=1e-6)
    assert joined.valid.all()
    assert joined.inlier.all()
    x = np.einsum("nij,nj->ni", joined.P[joined.tracks.view_index], joined.X[joined.tracks.point_index])
    np.testing.assert_allclose(x[:, :2] / x[:, 2:], joined.tracks.xy, atol=1e-4)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("common", [6, 12])
def test_noisy_points_give_it_within_their_noise(common, seed):
    models, P = row(common, seed=seed)
    joined = join(models)
    assert joined.registered.all()
    # Depths of 7 units from a baseline of 2 have a standard deviation of 0.02.
    assert np.linalg.norm(centres_of(joined.P) - centres_of(P), axis=1).max() < 0.15


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
    assert np.linalg.norm(centres_of(joined.P) - centres_of(P), axis=1).max() < 0.15
    wrong = np.flatnonzero(models[0].valid & models[1].valid)[:5]
    seen = np.isin(joined.tracks.point_index, wrong)
    assert (joined.tracks.view_index[seen & joined.inlier] < 3).all()


@pytest.mark.parametrize("common", [6, 10, 30])
def test_wrong_points_alone_are_refused(common):
    for seed in range(10):
        models, _ = row(common, seed=seed)
        assert join(with_wrong_points(models, common, seed), seed) is None


def test_two_similarities_with_equal_support_are_refused():
    models, _ = row(16)
    assert join(with_wrong_points(models, 8, shift=[0.0, 4.0, 0.0])) is None


def test_fewer_than_six_points_are_refused():
    assert join(row(5)[0]) is None
    assert join(row(0)[0]) is None


def test_points_on_a_line_do_not_determine_the_rotation_about_it():
    models, _ = row(10)
    common = np.flatnonzero(models[0].valid & models[1].valid)
    lines = []
    for model in models:
        X = model.X.copy()
        X[common, :3] = X[common[0], :3] + np.linspace(0, 1, 10)[:, None] * (
            X[common[1], :3] - X[common[0], :3]
        )
        lines.append(replace(model, X=X))
    assert join(lines) is None


def test_points_that_one_model_sees_in_a_single_image_count():
    models, P = row(4, singles=6)
    joined = join(models)
    assert np.linalg.norm(centres_of(joined.P) - centres_of(P), axis=1).max() < 0.15
    single = np.flatnonzero(joined.tracks.view_index == 3)
    assert joined.inlier[single].all()
    assert join(row(4)[0]) is None


def test_models_are_joined_one_behind_another():
    models, P = row(12, parts=3)
    rng = np.random.default_rng(0)
    joined = join_all(models[0], [models[2], models[1]], rng)
    assert joined.registered.all()
    assert np.linalg.norm(centres_of(joined.P) - centres_of(P), axis=1).max() < 0.5
    assert join_all(models[0], models[2:], rng) is models[0]


def test_only_groups_that_share_points_are_reconstructed_for_a_join():
    first = row(12, parts=3)[0][0]
    assert joinable(first, [[3, 4, 5], [6, 7, 8]]) == [[3, 4, 5], [6, 7, 8]]
    assert joinable(first, [[6, 7, 8]]) == []
    assert joinable(row(5)[0][0], [[3, 4, 5]]) == []
