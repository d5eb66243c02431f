"""Section 5.3: the maps of rank-2 matrices by a dependent row, and by a dependent row and column."""

import itertools

import numpy as np
import pytest

from tests.conftest import refuses
from tests.epipolar.pairs import angle_between, make_pair, spoil
from tests.geometry.properties import holds_for_every
from thesisrecon.epipolar.linear import estimate_eight_point
from thesisrecon.epipolar.refinement import _RowMap, refine_fundamental
from thesisrecon.geometry.two_view import enforce_rank_two, epipoles

BOTH = pytest.mark.parametrize("and_columns", [False, True])


@BOTH
@holds_for_every(examples=50)
def test_parameters_and_back(and_columns, rng):
    F = enforce_rank_two(rng.normal(size=(3, 3)))
    chart = _RowMap.best_for(F, and_columns=and_columns)
    parameters = chart.parameters(F)
    assert parameters.shape == (7,)
    assert np.abs(parameters).max() <= 1.0 + 1e-9
    assert angle_between(chart.matrix(parameters), F) < 1e-12
    if and_columns:
        e1, e2 = epipoles(chart.matrix(parameters))
        left = np.insert(parameters[3:5], chart.row, -1.0)
        right = np.insert(parameters[5:], chart.column, -1.0)
        np.testing.assert_allclose(np.cross(left, e2), 0.0, atol=1e-12)
        np.testing.assert_allclose(np.cross(right, e1), 0.0, atol=1e-12)


@BOTH
@pytest.mark.parametrize("epipole", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 0.0)])
def test_epipoles_at_infinity_and_on_axes_are_reached(and_columns, epipole):
    """A fixed third row could not reach them."""
    e = np.array(epipole) / np.linalg.norm(epipole)
    across, M = np.eye(3) - np.outer(e, e), np.random.default_rng(0).normal(size=(3, 3))
    F = across @ M @ (across if and_columns else np.eye(3))
    F /= np.linalg.norm(F)
    chart = _RowMap.best_for(F, and_columns=and_columns)
    assert angle_between(chart.matrix(chart.parameters(F)), F) < 1e-12


def test_every_map_gives_rank_two_and_its_parameters_back():
    rows = [_RowMap(*key) for key in itertools.product(range(3), range(6))]
    both = [_RowMap(*key) for key in itertools.product(range(3), range(4), range(3))]
    for chart in [*rows, *both]:
        parameters = np.random.default_rng(chart.fixed).normal(size=7)
        F = chart.matrix(parameters)
        assert np.linalg.svd(F, compute_uv=False)[2] < 1e-15, chart
        np.testing.assert_allclose(chart.parameters(F), parameters, atol=1e-9, err_msg=str(chart))


@pytest.mark.parametrize("parameters", ["row", "row-and-column"])
@pytest.mark.parametrize("criterion", ["sampson", "epipolar-distance", "reprojection"])
def test_same_minimum_as_the_orthonormal_representation(criterion, parameters):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        xy1, xy2, _ = spoil(make_pair(60, rng), rng, sigma=1.0, outliers=0.0)
        start = estimate_eight_point(xy1, xy2)
        found = refine_fundamental(start, xy1, xy2, criterion, parameters=parameters)
        assert angle_between(found, refine_fundamental(start, xy1, xy2, criterion)) < 1e-6


def test_unknown_words_are_named():
    pair = make_pair(20, np.random.default_rng(0))
    xy1, xy2 = pair.xy1, pair.xy2
    start = estimate_eight_point(xy1, xy2)
    refuses(ValueError, "unknown criterion .*mean sampson", refine_fundamental, start, xy1, xy2, "samson")
    refuses(ValueError, "mean row", refine_fundamental, start, xy1, xy2, parameters="rows")
