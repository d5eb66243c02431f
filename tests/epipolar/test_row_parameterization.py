"""The thesis' parameters reach every matrix of rank 2, and the minimum of the orthonormal ones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.epipolar.pairs import angle_between, make_pair, spoil
from thesisrecon.epipolar.linear import estimate_eight_point
from thesisrecon.epipolar.refinement import refine_epipolar_distance, refine_reprojection, refine_sampson
from thesisrecon.epipolar.row_parameterization import (
    RowParameterization,
    refine_epipolar_distance_by_rows,
    refine_reprojection_by_rows,
    refine_sampson_by_rows,
)
from thesisrecon.geometry.two_view import enforce_rank_two


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31))
def test_parameters_and_back(seed):
    F = enforce_rank_two(np.random.default_rng(seed).normal(size=(3, 3)))
    chart = RowParameterization.best_for(F)
    parameters = chart.parameters(F)
    assert parameters.shape == (7,)
    assert np.abs(parameters).max() <= 1.0 + 1e-9
    assert angle_between(chart.matrix(parameters), F) < 1e-12


@pytest.mark.parametrize("e2", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 0.0)])
def test_epipoles_the_fixed_third_row_cannot_reach(e2):
    e2 = np.array(e2) / np.linalg.norm(e2)
    M = np.random.default_rng(0).normal(size=(3, 3))
    F = M - np.outer(e2, e2 @ M)
    F /= np.linalg.norm(F)
    chart = RowParameterization.best_for(F)
    assert angle_between(chart.matrix(chart.parameters(F)), F) < 1e-12


@pytest.mark.parametrize(("dependent", "fixed"), [(d, f) for d in range(3) for f in range(6)])
def test_every_map_has_the_tangent_of_its_matrix(dependent, fixed):
    chart = RowParameterization(dependent, fixed)
    parameters = np.random.default_rng(fixed).normal(size=7)
    assert np.linalg.svd(chart.matrix(parameters), compute_uv=False)[2] < 1e-15
    for step, column in zip(1e-6 * np.eye(7), chart.tangent(parameters).T, strict=True):
        ends = chart.matrix(parameters + step) - chart.matrix(parameters - step)
        np.testing.assert_allclose(ends.ravel() / 2e-6, column, atol=1e-8)


@pytest.mark.parametrize(
    ("by_rows", "orthonormal"),
    [
        (refine_sampson_by_rows, refine_sampson),
        (refine_epipolar_distance_by_rows, refine_epipolar_distance),
        (refine_reprojection_by_rows, refine_reprojection),
    ],
)
def test_same_minimum_as_the_orthonormal_representation(by_rows, orthonormal):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        xy1, xy2, _ = spoil(make_pair(60, rng), rng, sigma=1.0, outliers=0.0)
        start = estimate_eight_point(xy1, xy2)
        assert angle_between(by_rows(start, xy1, xy2), orthonormal(start, xy1, xy2)) < 1e-6


def test_a_start_without_rank_is_refused():
    pair = make_pair(10, np.random.default_rng(0))
    with pytest.raises(ValueError, match="rank 2"):
        refine_sampson_by_rows(np.zeros((3, 3)), pair.xy1, pair.xy2)
