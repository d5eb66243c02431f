"""The compiled parts of the spline fit against plain NumPy and SciPy."""

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from thesisrecon.surface.bspline import basis, energies
from thesisrecon.surface.bspline_pieces import Domain, evaluate_pixels, pieces_of, sum_squares

CELL = 4


def labels(count, start, stop):
    graph = coo_array((np.ones(len(start)), (start, stop)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


@pytest.fixture
def domain():
    rng = np.random.default_rng(0)
    held = rng.random((21, 26)) < 0.85
    right = (rng.random((21, 25)) < 0.7) & held[:, :-1] & held[:, 1:]
    down = (rng.random((20, 26)) < 0.7) & held[:-1] & held[1:]
    return Domain(held, held, right, down)


@pytest.fixture
def pieces(domain):
    return pieces_of(domain, CELL)


def edges(domain):
    number = np.arange(domain.held.size).reshape(domain.held.shape)
    start = np.concatenate([number[:, :-1][domain.right], number[:-1][domain.down]])
    stop = np.concatenate([number[:, 1:][domain.right], number[1:][domain.down]])
    return start, stop


def test_pieces_are_what_hangs_together_in_a_cell(domain, pieces):
    y, x = np.indices(domain.held.shape)
    cell = ((y // CELL) * pieces.shape[1] + x // CELL).ravel()
    start, stop = edges(domain)
    within = cell[start] == cell[stop]
    label = labels(cell.size, start[within], stop[within])
    held = domain.held.ravel()
    found = pieces.piece.ravel()
    assert (found[~held] == -1).all()
    assert len(set(zip(label[held], found[held], strict=True))) == len(set(label[held])) == len(pieces.cell)
    np.testing.assert_array_equal(pieces.cell[found[held]], cell[held])


def test_coefficients_are_shared_by_what_hangs_together_within_reach(domain, pieces):
    start, stop = (pieces.piece.ravel()[k] for k in edges(domain))
    row, column = np.divmod(pieces.cell, pieces.shape[1])
    owners = set()
    for a in range(pieces.shape[0] + 3):
        for b in range(pieces.shape[1] + 3):
            near = (row >= a - 3) & (row <= a) & (column >= b - 3) & (column <= b)
            both = near[start] & near[stop]
            label = labels(len(row), start[both], stop[both])[near]
            at = 4 * (a - row[near]) + b - column[near]
            own = pieces.coefficient[near, at]
            assert len(set(zip(label, own, strict=True))) == len(set(label)) == len(set(own))
            assert not owners & set(own.tolist())
            owners |= set(own.tolist())
    assert owners == set(range(pieces.count))


def rows_of(pieces):
    """(pixels, coefficients) weights of the coefficients in each pixel of a piece."""
    y, x = np.nonzero(pieces.piece >= 0)
    tensor = basis((y % CELL + 0.5) / CELL)[:, :, None] * basis((x % CELL + 0.5) / CELL)[:, None, :]
    rows = np.zeros((len(y), pieces.count))
    np.add.at(
        rows, (np.arange(len(y))[:, None], pieces.coefficient[pieces.piece[y, x]]), tensor.reshape(-1, 16)
    )
    return rows


def test_values_and_sums_are_those_of_the_rows(pieces):
    rng = np.random.default_rng(1)
    rows, held = rows_of(pieces), pieces.piece >= 0
    c, target = rng.normal(size=pieces.count), rng.normal(size=held.shape)
    weight = rng.random(held.shape) * (rng.random(held.shape) < 0.9)
    along = basis((np.arange(CELL) + 0.5) / CELL)
    value = np.empty(held.shape)
    evaluate_pixels(pieces.piece, pieces.coefficient, c, along, CELL, value)
    np.testing.assert_allclose(value[held], rows @ c, atol=1e-12)
    assert np.isnan(value[~held]).all()
    matrix, right = np.zeros((len(pieces.cell), 16, 16)), np.zeros((len(pieces.cell), 16))
    sum_squares(pieces.piece, target, weight, along, CELL, matrix, right)
    full = np.zeros((pieces.count, pieces.count))
    upper = np.triu(np.ones((16, 16)), 1)[None] * matrix
    np.add.at(
        full, (pieces.coefficient[:, :, None], pieces.coefficient[:, None, :]), matrix + upper.swapaxes(1, 2)
    )
    w = weight[held]
    np.testing.assert_allclose(full, rows.T @ (w[:, None] * rows), atol=1e-12)
    total = np.bincount(pieces.coefficient.ravel(), right.ravel(), pieces.count)
    np.testing.assert_allclose(total, rows.T @ (w * target[held]), atol=1e-12)


def test_the_basis_is_that_of_cubic_splines():
    u = np.linspace(0.0, 0.999, 7)
    for derivative in (0, 1, 2):
        for k in range(4):
            spline = BSpline.basis_element(np.arange(-3.0, 2.0) + k, extrapolate=False)
            expected = (spline.derivative(derivative) if derivative else spline)(u)
            np.testing.assert_allclose(basis(u, derivative)[:, k], np.nan_to_num(expected), atol=1e-12)


def test_energies_are_integrals():
    rng = np.random.default_rng(2)
    c = rng.normal(size=16)
    u = (np.arange(200) + 0.5) / 200
    f = {(i, j): basis(u, i) @ c.reshape(4, 4) @ basis(u, j).T for i in range(3) for j in range(3)}
    bending, gradient = energies()
    assert c @ bending @ c == pytest.approx(np.mean(f[2, 0] ** 2 + 2 * f[1, 1] ** 2 + f[0, 2] ** 2), rel=1e-4)
    assert c @ gradient @ c == pytest.approx(np.mean(f[1, 0] ** 2 + f[0, 1] ** 2), rel=1e-4)
    plane = (2.0 + 0.3 * np.arange(4)[:, None] - 0.7 * np.arange(4)).ravel()
    assert abs(plane @ bending @ plane) < 1e-12
