"""The batched seven-point solver against the exact one and NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.epipolar.pairs import make_pair, oriented
from thesisrecon.epipolar import linear as minimal
from thesisrecon.epipolar import sampling as kernels
from thesisrecon.epipolar.frame import PairFrame
from thesisrecon.numerics.ransac import draw_sample

seeds = st.integers(0, 2**31)


def batch_of(points, rng):
    """The samples (LANES, 7) of one batch and the solved batch."""
    uniforms = rng.random((minimal.LANES, 7))
    X, Y = np.ones((28, minimal.LANES)), np.empty((minimal.ROWS, minimal.LANES))
    kernels._draw_batch(points, uniforms, X)
    minimal.solve_seven_point_batch(X, Y)
    samples = np.empty((minimal.LANES, 7), dtype=np.int64)
    for u, sample in zip(uniforms, samples, strict=True):
        draw_sample(u, len(points), sample)
    return samples, Y


def noisy_points(rng, outliers=0.3):
    pair = make_pair(80, rng)
    points = PairFrame.of(pair.xy1, pair.xy2).points(pair.xy1, pair.xy2)
    points += rng.normal(0.0, 1e-3, points.shape)
    wrong = rng.random(len(points)) < outliers
    points[wrong, 2:] = rng.uniform(-1.5, 1.5, (int(wrong.sum()), 2))
    return points


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_every_oriented_solution_of_the_exact_solver_is_found_and_no_other(seed):
    rng = np.random.default_rng(seed)
    points = noisy_points(rng)
    samples, Y = batch_of(points, rng)
    exact, found = np.empty((3, 9)), np.empty((3, 9))
    differences, counts = [], 0
    for lane, sample in enumerate(samples):
        expected = [
            f
            for f in exact[: minimal.seven_point(points, sample, exact)].copy()
            if oriented(f, points, sample)
        ]
        count = minimal.seven_point_batch_solutions(Y, lane, np.empty(9), found)
        counts += count != len(expected)
        for f in expected[: count if count == len(expected) else 0]:
            differences.append(min(min(np.linalg.norm(f - g), np.linalg.norm(f + g)) for g in found[:count]))
    # A double root may be seen by one solver and missed by the other.
    assert counts <= 1
    assert np.quantile(differences, 0.9) < 1e-7


def test_solutions_satisfy_the_seven_equations_and_are_singular():
    rng = np.random.default_rng(1)
    points = noisy_points(rng)
    samples, Y = batch_of(points, rng)
    F = np.empty((3, 9))
    for lane, sample in enumerate(samples):
        x1, x2 = np.c_[points[sample, :2], np.ones(7)], np.c_[points[sample, 2:], np.ones(7)]
        for f in F[: minimal.seven_point_batch_solutions(Y, lane, np.empty(9), F)]:
            M = f.reshape(3, 3)
            assert np.linalg.norm(f) == pytest.approx(1.0)
            assert np.abs(np.einsum("na,ab,nb->n", x2, M, x1)).max() < 1e-6
            assert abs(np.linalg.det(M)) < 1e-7


def test_degenerate_samples_never_give_numbers_that_are_not_finite():
    rng = np.random.default_rng(2)
    line = np.linspace(-1.0, 1.0, 30)[:, None] * [1.0, 0.5, 0.3, -1.0]
    one = np.ones((30, 4))
    for points in (line, one, np.zeros((30, 4)), np.r_[line[:15], noisy_points(rng)[:15]]):
        _, Y = batch_of(np.ascontiguousarray(points), rng)
        F = np.empty((3, 9))
        for lane in range(minimal.LANES):
            assert np.isfinite(F[: minimal.seven_point_batch_solutions(Y, lane, np.empty(9), F)]).all()


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(-5, 5), min_size=3, max_size=3))
def test_cubic_with_three_real_roots(expected):
    expected = np.sort(np.round(expected, 2))
    if np.diff(expected).min() < 0.05:
        return
    _, a, b, c = np.poly(expected)
    roots = np.empty(3)
    assert minimal._newton_cubic_roots(a, b, c, roots) == 3
    np.testing.assert_allclose(np.sort(roots), expected, atol=1e-8)


@settings(max_examples=200, deadline=None)
@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(0.1, 5))
def test_cubic_with_one_real_root(x, re, im):
    _, a, b, c = np.real(np.poly([x, re + 1j * im, re - 1j * im]))
    roots = np.empty(3)
    assert minimal._newton_cubic_roots(a, b, c, roots) == 1
    assert roots[0] == pytest.approx(x, abs=1e-8)


def test_cubic_without_numbers_has_no_root():
    for bad in (np.nan, np.inf):
        assert minimal._newton_cubic_roots(bad, 1.0, 1.0, np.empty(3)) == 0
        assert minimal._newton_cubic_roots(1.0, 1.0, bad, np.empty(3)) == 0
