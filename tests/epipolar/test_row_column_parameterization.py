"""Section 5.3: the 36 maps of matrices of rank 2 by a dependent row and column."""

import itertools

import numpy as np
import pytest

from tests.epipolar.pairs import angle_between, make_pair, spoil
from tests.geometry.properties import holds_for_every
from thesisrecon.epipolar.linear import estimate_eight_point
from thesisrecon.epipolar.refinement import refine_epipolar_distance, refine_reprojection, refine_sampson
from thesisrecon.epipolar.row_parameterization import (
    RowColumnParameterization,
    refine_epipolar_distance_by_rows,
    refine_reprojection_by_rows,
    refine_sampson_by_rows,
)
from thesisrecon.geometry.two_view import enforce_rank_two, epipoles


@holds_for_every()
def test_parameters_and_back_and_the_epipoles_in_them(rng):
    F = enforce_rank_two(rng.normal(size=(3, 3)))
    chart = RowColumnParameterization.best_for(F)
    parameters = chart.parameters(F)
    assert np.abs(parameters).max() <= 1.0 + 1e-9
    assert angle_between(chart.matrix(parameters), F) < 1e-12
    e1, e2 = epipoles(chart.matrix(parameters))
    left, right = np.insert(parameters[3:5], chart.row, -1.0), np.insert(parameters[5:], chart.column, -1.0)
    np.testing.assert_allclose(np.cross(left, e2), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cross(right, e1), 0.0, atol=1e-12)


@pytest.mark.parametrize(("row", "column", "fixed"), list(itertools.product(range(3), range(3), range(4))))
def test_every_map_has_the_tangent_of_its_matrix(row, column, fixed):
    chart = RowColumnParameterization(row, column, fixed)
    parameters = np.random.default_rng(fixed).normal(size=7)
    assert np.linalg.svd(chart.matrix(parameters), compute_uv=False)[2] < 1e-15
    for step, tangent in zip(1e-6 * np.eye(7), chart.tangent(parameters).T, strict=True):
        ends = chart.matrix(parameters + step) - chart.matrix(parameters - step)
        np.testing.assert_allclose(ends.ravel() / 2e-6, tangent, atol=1e-8)


@pytest.mark.parametrize("where", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 0.0)])
def test_epipoles_at_infinity_and_on_axes_are_reached(where):
    e = np.array(where) / np.linalg.norm(where)
    across = np.eye(3) - np.outer(e, e)
    F = across @ np.random.default_rng(0).normal(size=(3, 3)) @ across
    F /= np.linalg.norm(F)
    chart = RowColumnParameterization.best_for(F)
    assert angle_between(chart.matrix(chart.parameters(F)), F) < 1e-12


@pytest.mark.parametrize(
    ("by_rows", "orthonormal"),
    [
        (refine_sampson_by_rows, refine_sampson),
        (refine_epipolar_distance_by_rows, refine_epipolar_distance),
        (refine_reprojection_by_rows, refine_reprojection),
    ],
)
def test_same_minimum_as_the_orthonormal_representation(by_rows, orthonormal):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        xy1, xy2, _ = spoil(make_pair(60, rng), rng, sigma=1.0, outliers=0.0)
        start = estimate_eight_point(xy1, xy2)
        found = by_rows(start, xy1, xy2, and_columns=True)
        assert angle_between(found, orthonormal(start, xy1, xy2)) < 1e-6
