"""Nearest neighbours in the plane against a tree."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from thesisrecon.optimize.nearest_neighbours import _grid, nearest_neighbours


@pytest.mark.parametrize(("points", "count"), [(1, 1), (12, 10), (40, 40), (900, 7)])
@pytest.mark.parametrize("kind", ["even", "clusters", "line"])
def test_distances_are_those_of_a_tree(points: int, count: int, kind: str) -> None:
    rng = np.random.default_rng(points)
    xy = rng.uniform(0.0, [480.0, 360.0], (points, 2))
    if kind == "clusters":
        xy[: points // 2] = rng.normal([40.0, 300.0], 2.0, (points // 2, 2))
    if kind == "line":
        xy[:, 1] = 7.0
    of = rng.uniform(-200.0, 700.0, (500, 2))
    found = nearest_neighbours(xy, of, count)
    distances = np.linalg.norm(xy[found] - of[:, None], axis=2)
    expected = cKDTree(xy).query(of, np.arange(1, count + 1))[0]
    np.testing.assert_allclose(distances, expected, rtol=1e-12)
    assert all(len(set(row)) == count for row in found.tolist())


def test_equally_distant_points_come_in_the_order_of_their_numbers() -> None:
    xy = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    assert nearest_neighbours(xy, np.zeros((1, 2)), 5).tolist() == [[3, 4, 0, 1, 2]]
    assert nearest_neighbours(np.zeros((4, 2)), np.full((1, 2), 3.0), 3).tolist() == [[0, 1, 2]]


def test_cells_hold_about_two_points_wherever_the_points_are() -> None:
    xy = np.random.default_rng(0).uniform([-300.0, 5e4], [180.0, 5.036e4], (900, 2))
    low, cell, shape = _grid(xy)
    np.testing.assert_array_equal(low, xy.min(axis=0))
    assert 400 < shape[0] * shape[1] < 600
    assert (shape * cell > np.ptp(xy, axis=0)).all()
