"""What is asked of all observations after every camera, beside plain NumPy."""

import numpy as np

from tests.synthetic import make_scene
from thesisrecon.projective._model import (
    ProjectiveModel,
    coverage_of_views,
    observation_cells,
    project_observations,
    update_inliers,
)


def test_projected_observations_equal_their_numpy_twin():
    scene, rng = make_scene(views=5, points=80, sigma_px=1.0, seed=2), np.random.default_rng(3)
    t = scene.tracks
    P, X = rng.normal(size=(t.n_views, 3, 4)), rng.normal(size=(t.n_points, 4))
    P[1, 2] = 0.0
    chosen = rng.random(len(t.xy)) < 0.8
    depth, distance = project_observations(P, X, t.view_index, t.point_index, t.xy, chosen)
    x = np.einsum("kij,kj->ki", P[t.view_index], X[t.point_index])
    finite = chosen & (t.view_index != 1)
    assert finite.any()
    assert not finite.all()
    expected = np.linalg.norm(x[finite, :2] / x[finite, 2:] - t.xy[finite], axis=1)
    np.testing.assert_allclose(distance[finite], expected, rtol=1e-9)
    np.testing.assert_allclose(depth[finite], x[finite, 2], rtol=1e-9)
    assert np.isinf(distance[~finite]).all()
    assert not depth[~finite].any()


def test_points_get_the_signs_of_their_cameras_and_far_observations_are_marked():
    scene = make_scene(views=5, points=80, sigma_px=0.0, seed=2)
    t = scene.tracks
    model = ProjectiveModel.empty(t, scene.sizes, sigma_px=0.5, noise_floor_px=0.3)
    rng = np.random.default_rng(4)
    signs = rng.choice([-1.0, 1.0], t.n_points)
    model.P, model.X = scene.P.copy(), signs[:, None] * np.column_stack([scene.X, np.ones(len(scene.X))])
    model.registered[:4] = True
    t.xy[::7] += 10.0
    update_inliers(model, 4.0)
    assert (model.X[:, 3] > 0.0)[np.bincount(t.point_index[t.view_index < 4], minlength=t.n_points) > 0].all()
    near = (np.arange(len(t.xy)) % 7 > 0) & (t.view_index < 4)
    twice = np.bincount(t.point_index[near], minlength=t.n_points) >= 2
    np.testing.assert_array_equal(model.inlier, near & twice[t.point_index])


def test_points_all_over_a_view_count_more_than_a_crowd_in_a_corner():
    t = make_scene(views=3, points=400, sigma_px=0.5, seed=5).tracks
    cell = observation_cells(t)
    assert (cell // 64 == t.view_index).all()
    everywhere = coverage_of_views(cell, np.ones(len(t.xy), bool), t.n_views)
    for view in range(t.n_views):
        own = t.view_index == view
        xy, extent = t.xy[own], np.ptp(t.xy[own], axis=0)
        place = np.minimum((xy - xy.min(axis=0)) / extent * 8, 7).astype(int)
        counts = np.bincount(place[:, 0] * 8 + place[:, 1])
        assert everywhere[view] == np.sqrt(counts).sum()
    few = np.flatnonzero(t.view_index == 0)[:100]
    corner = np.flatnonzero(t.view_index == 0)[np.argsort(t.xy[t.view_index == 0].sum(axis=1))[:100]]
    spread = [coverage_of_views(cell, np.isin(np.arange(len(t.xy)), k), t.n_views)[0] for k in (few, corner)]
    assert spread[0] > 1.3 * spread[1]
