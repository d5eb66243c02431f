import numpy as np
import pytest

from thesisrecon.numerics.levenberg_marquardt import invert_information, minimize_residuals, solve_positive
from thesisrecon.numerics.losses import LOSSES, loss_code


@pytest.mark.parametrize("name", sorted(LOSSES))
def test_weight_is_the_derivative_of_the_loss(name):
    s = np.array([0.01, 0.5, 1.9, 2.3, 9.0, 400.0])
    h = 1e-6 * s
    rho = LOSSES[name]
    slope = (rho(s + h, 1.5)[0] - rho(s - h, 1.5)[0]) / (2 * h)
    np.testing.assert_allclose(rho(s, 1.5)[1], slope, rtol=1e-5, atol=1e-8)
    assert np.all(np.diff(rho(s, 1.5)[0]) >= 0.0)
    np.testing.assert_allclose(rho(np.array([1e-8]), 1.5)[0], 1e-8, rtol=1e-6)


def test_unknown_loss_and_scale_are_refused():
    with pytest.raises(ValueError, match="loss must be one of"):
        loss_code("tukey", 1.0)
    with pytest.raises(ValueError, match="positive"):
        loss_code("huber", 0.0)


def test_rosenbrock_from_the_classical_start():
    answer = minimize_residuals(
        lambda x: np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]), np.array([-1.2, 1.0]), max_iterations=100
    )
    assert answer.converged
    np.testing.assert_allclose(answer.x, [1.0, 1.0], atol=1e-6)


def test_covariance_of_a_line_is_the_textbook_one():
    rng = np.random.default_rng(1)
    u = np.linspace(0.0, 1.0, 400)
    y = 2.0 - 3.0 * u + 0.1 * rng.normal(size=400)
    A = np.column_stack([np.ones_like(u), u])
    answer = minimize_residuals(lambda x: A @ x - y, np.zeros(2), jacobian=lambda _: A)
    expected = np.sum((A @ answer.x - y) ** 2) / 398 * np.linalg.inv(A.T @ A)
    np.testing.assert_allclose(answer.covariance, expected, rtol=1e-6)


def test_cauchy_ignores_outliers_that_bend_least_squares():
    u = np.linspace(0.0, 1.0, 100)
    y = 1.0 + 2.0 * u
    y[::5] += 50.0
    plain = minimize_residuals(lambda x: x[0] + x[1] * u - y, np.zeros(2))
    robust = minimize_residuals(lambda x: x[0] + x[1] * u - y, plain.x, loss="cauchy", loss_scale=0.1)
    assert abs(plain.x[0] - 1.0) > 5.0
    np.testing.assert_allclose(robust.x, [1.0, 2.0], atol=0.02)


def test_rank_deficient_and_useless_parameters_are_harmless():
    answer = minimize_residuals(lambda x: np.array([x[0] + x[1] - 3.0, 0.0]), np.zeros(3))
    assert answer.cost < 1e-12
    assert answer.x[2] == 0.0
    assert np.isfinite(answer.covariance).all()


def test_states_outside_the_domain_are_refused_not_raised():
    def residual(x):
        return np.where(x > 0.0, np.log(np.maximum(x, 1e-300)) - 2.0, np.nan)

    answer = minimize_residuals(residual, np.array([0.01]), max_iterations=100)
    np.testing.assert_allclose(answer.x, np.exp(2.0), rtol=1e-6)
    with pytest.raises(ValueError, match="finite"):
        minimize_residuals(residual, np.array([-1.0]))


def test_guards_of_the_linear_algebra():
    assert solve_positive(-np.eye(2), np.ones(2)) is None
    assert solve_positive(np.array([[np.nan]]), np.ones(1)) is None
    assert np.isinf(invert_information(np.array([[np.nan]]))).all()
    covariance = invert_information(np.diag([4.0, 0.0]))
    assert covariance[0, 0] == pytest.approx(0.25)
    assert np.isfinite(covariance).all()
