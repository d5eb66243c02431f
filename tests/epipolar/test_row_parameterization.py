"""The thesis' parameters reach every matrix of rank 2, and the minimum of the orthonormal ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.epipolar.pairs import angle_between, make_pair, spoil
from thesisrecon.epipolar import estimate_eight_point, refine_gradient
from thesisrecon.epipolar.row_parameterization import RowParameterization, refine_gradient_by_rows
from thesisrecon.geometry.multiview import enforce_rank_two, sampson_residuals


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


def test_same_minimum_as_the_orthonormal_representation():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        pair = make_pair(60, rng)
        xy1, xy2, _ = spoil(pair, rng, sigma=0.4, outliers=0.0)
        start = estimate_eight_point(xy1, xy2)
        rows, orthonormal = refine_gradient_by_rows(start, xy1, xy2), refine_gradient(start, xy1, xy2)
        costs = [np.sum(sampson_residuals(F, xy1, xy2) ** 2) for F in (rows, orthonormal)]
        assert costs[0] == pytest.approx(costs[1], rel=1e-4)


def test_a_start_without_rank_is_refused():
    pair = make_pair(10, np.random.default_rng(0))
    with pytest.raises(ValueError, match="rank 2"):
        refine_gradient_by_rows(np.zeros((3, 3)), pair.xy1, pair.xy2)
