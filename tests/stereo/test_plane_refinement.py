"""The search for slanted windows: its compiled loops against plain NumPy, and what it finds."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from tests.synthetic import texture
from thesisrecon.stereo import _plane_refinement as kernels

SHAPE = (13, 17)
PLANE = np.array([1.0, 6e-3, -4e-3])
"""Inverse depth at (0, 0) and its gradient."""


def arguments(gray, others, H, e):
    """What the compiled loops take of a reference and its neighbours, windows of 5 x 5 samples."""
    words, layout, start = [], [], 0
    for other in others:
        words.append(kernels.pack_squares(other))
        layout.append((start, *other.shape[::-1]))
        start += other.size
    packed = np.concatenate([word.ravel() for word in words])
    sample = np.stack(np.meshgrid(np.arange(-4, 5, 2), np.arange(-4, 5, 2))).reshape(2, -1)
    likeness = np.exp(-np.arange(256.0) / 15.0).astype(np.float32)
    offsets = sample.astype(np.float32)
    return kernels.PatchSearch(gray, packed, np.array(layout), H, e, offsets, likeness)


@pytest.fixture(scope="module")
def scene():
    """A plane in three views; the third shows something else, and corners of two are unknown."""
    gray = texture(60, 70, 3)
    H = np.eye(3) + np.array([0.0, 1e-3, -1e-3])[:, None, None] * np.ones((3, 3)) * [[1], [1], [1e-2]]
    e = np.array([[5.0, 1.0, 0.01], [-4.0, 2.0, -0.01], [1.0, -6.0, 0.0]])
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(float)
    others = []
    for k, shape in enumerate(((22, 30), (20, 27), (25, 24))):
        v, u = np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
        # Pixels of the other view come from (x, y) by the inverse of the plane's homography.
        G = H[k] + np.outer(e[k], [PLANE[1], PLANE[2], PLANE[0]])
        q = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(G).T
        at = [20.0 + q[..., 1] / q[..., 2], 20.0 + q[..., 0] / q[..., 2]]
        others.append(map_coordinates(gray if k < 2 else gray[::-1], at, order=1).astype(np.float32))
    one = map_coordinates(gray, [20.0 + y, 20.0 + x], order=1).astype(np.float32)
    one[:3, :2], others[0][:4, :5] = np.nan, np.nan
    return one, arguments(one, others, H, e), (x, y)


def planes_about(places, spread, seed=0):
    """The plane of the scene, disturbed by ``spread`` px at pixels at random, unknown at some."""
    rng = np.random.default_rng(seed)
    x, y = places
    planes = np.stack([PLANE[0] + x * PLANE[1] + y * PLANE[2], x * 0 + PLANE[1], x * 0 + PLANE[2]], axis=-1)
    planes[..., 0] += spread / 5.0 * rng.normal(size=x.shape)
    planes[rng.random(x.shape) < 0.2] = np.nan
    return planes.astype(np.float32)


def test_squares_are_the_four_levels_of_an_interpolation(scene):
    gray = scene[0].copy()
    gray[5, 7] = 300.0
    packed = kernels.pack_squares(gray)
    level = np.floor(np.clip(gray + np.float32(0.5), 1.0, 255.0))
    four = np.stack([level[:-1, :-1], level[:-1, 1:], level[1:, :-1], level[1:, 1:]], axis=-1)
    four = np.where(np.isfinite(four).all(axis=-1, keepdims=True), four, 0.0)
    for k in range(4):
        assert ((packed[:-1, :-1] >> (8 * k)) & 255 == four[..., k]).all()
    assert (packed[:3, :2] == 0).all()
    assert not packed[-1].any()
    assert not packed[:, -1].any()


def test_costs_vanish_at_the_true_plane_and_slopes_are_motions(scene):
    _, given, places = scene
    H, e, costs = given.H.swapaxes(1, 2)[:, None], given.e[:, None, None], []
    for spread in (0.0, 0.5, 20.0):
        planes = planes_about(places, spread)
        cost = kernels.begin_planes(given, planes)
        least, support, std = kernels.rate_planes(given, planes, 0.4)
        costs.append(np.median(least[least < kernels.UNKNOWN]))
        known = np.isfinite(planes[..., 0]) & np.isfinite(scene[0])
        assert (cost[~known] == kernels.UNKNOWN).all()
        assert not support[~known].any()
        # The second of the two best neighbours costs at most so much.
        assert (cost >= least - 1e-5).all()
        assert (cost <= least + 0.5 * kernels.MAX_EXCESS_COST + 1e-5).all()
        # Pixels that places move per unit of inverse depth, in the views that support the plane.
        q = np.stack([*places, np.ones(SHAPE)], axis=-1) @ H + planes[..., :1] * e
        squares = np.sum(((e[..., :2] - q[..., :2] / q[..., 2:] * e[..., 2:]) / q[..., 2:]) ** 2, axis=-1)
        for views, moved in ((1, squares), (2, squares.sum(axis=0) - squares)):
            assert (
                np.isclose((kernels.SIGMA_PX / std) ** 2, moved, rtol=1e-4)
                .any(axis=0)[support == views]
                .all()
            )
        if spread == 0.0:
            assert (support[known] >= 1).mean() > 0.5
            assert (support == 2).any()
    assert costs[0] < 0.05
    assert costs[0] < costs[1] < costs[2]
    assert costs[2] > 0.2


def test_converged_planes_rest_until_a_neighbour_changes(scene):
    _, given, places = scene
    planes = planes_about(places, 0.5)
    cost = kernels.begin_planes(given, planes)
    kept, kept_cost = planes.copy(), cost.copy()
    kernels.sweep_planes(given, 0.4, 0.02, False, planes, cost, np.zeros(SHAPE, np.uint8))
    np.testing.assert_array_equal(planes, kept)
    np.testing.assert_array_equal(cost, kept_cost)
    active = np.zeros(SHAPE, np.uint8)
    active[SHAPE[0] // 2, SHAPE[1] // 2] = 1
    kernels.sweep_planes(given, 0.4, 0.02, False, planes, cost, active)
    y, x = np.nonzero(cost != kept_cost)
    assert 0 < len(y) < cost.size / 2
    assert y.min() >= SHAPE[0] // 2
    assert x.min() >= SHAPE[1] // 2
