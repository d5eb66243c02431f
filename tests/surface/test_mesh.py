"""Mesh operations and kernels of fusion and texture against their plain twins."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tests.surface.sphere import ring_of
from thesisrecon.surface._mesh import halve_surface
from thesisrecon.surface.bspline import (
    Domain,
    _basis,
    _energies,
    _evaluate_pixels,
    _pieces_of,
    _sum_squares,
)
from thesisrecon.surface.fusion import VolumetricFusion


@pytest.fixture(scope="module")
def sphere():
    return VolumetricFusion(tolerance=0.0).fuse(ring_of())


CELL = 4


def labels(count, start, stop):
    graph = coo_array((np.ones(len(start)), (start, stop)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


@pytest.fixture
def domain():
    rng = np.random.default_rng(0)
    covered = rng.random((21, 26)) < 0.85
    right = (rng.random((21, 25)) < 0.7) & covered[:, :-1] & covered[:, 1:]
    down = (rng.random((20, 26)) < 0.7) & covered[:-1] & covered[1:]
    return Domain(covered, covered, (down, right))


@pytest.fixture
def pieces(domain):
    return _pieces_of(domain, CELL)


def edges(domain):
    number = np.arange(domain.covered.size).reshape(domain.covered.shape)
    start = np.concatenate([number[:, :-1][domain.joined[1]], number[:-1][domain.joined[0]]])
    stop = np.concatenate([number[:, 1:][domain.joined[1]], number[1:][domain.joined[0]]])
    return start, stop


def test_pieces_are_connected_within_a_cell(domain, pieces):
    y, x = np.indices(domain.covered.shape)
    cell = ((y // CELL) * pieces.shape[1] + x // CELL).ravel()
    start, stop = edges(domain)
    within = cell[start] == cell[stop]
    label = labels(cell.size, start[within], stop[within])
    covered = domain.covered.ravel()
    found = pieces.piece.ravel()
    assert (found[~covered] == -1).all()
    assert (
        len(set(zip(label[covered], found[covered], strict=True)))
        == len(set(label[covered]))
        == len(pieces.cell)
    )
    np.testing.assert_array_equal(pieces.cell[found[covered]], cell[covered])


def test_coefficients_are_shared_within_connected_parts(domain, pieces):
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
    assert owners == set(range(pieces.total))


def rows_of(pieces):
    """(pixels, coefficients) weights of the coefficients in each pixel of a piece."""
    y, x = np.nonzero(pieces.piece >= 0)
    tensor = _basis((y % CELL + 0.5) / CELL)[:, :, None] * _basis((x % CELL + 0.5) / CELL)[:, None, :]
    rows = np.zeros((len(y), pieces.total))
    np.add.at(
        rows, (np.arange(len(y))[:, None], pieces.coefficient[pieces.piece[y, x]]), tensor.reshape(-1, 16)
    )
    return rows


def test_values_and_sums_are_those_of_the_rows(pieces):
    rng = np.random.default_rng(1)
    rows, covered = rows_of(pieces), pieces.piece >= 0
    c, target = rng.normal(size=pieces.total), rng.normal(size=covered.shape)
    weight = rng.random(covered.shape) * (rng.random(covered.shape) < 0.9)
    along = _basis((np.arange(CELL) + 0.5) / CELL)
    value = np.empty(covered.shape)
    _evaluate_pixels(pieces.piece, pieces.coefficient, c, along, CELL, value)
    np.testing.assert_allclose(value[covered], rows @ c, atol=1e-12)
    assert np.isnan(value[~covered]).all()
    matrix, right = np.zeros((len(pieces.cell), 16, 16)), np.zeros((len(pieces.cell), 16))
    _sum_squares(pieces.piece, target, weight, along, CELL, matrix, right)
    full = np.zeros((pieces.total, pieces.total))
    upper = np.triu(np.ones((16, 16)), 1)[None] * matrix
    np.add.at(
        full, (pieces.coefficient[:, :, None], pieces.coefficient[:, None, :]), matrix + upper.swapaxes(1, 2)
    )
    w = weight[covered]
    np.testing.assert_allclose(full, rows.T @ (w[:, None] * rows), atol=1e-12)
    total = np.bincount(pieces.coefficient.ravel(), right.ravel(), pieces.total)
    np.testing.assert_allclose(total, rows.T @ (w * target[covered]), atol=1e-12)


def test_the_basis_is_that_of_cubic_splines():
    u = np.linspace(0.0, 0.999, 7)
    for derivative in (0, 1, 2):
        for k in range(4):
            spline = BSpline.basis_element(np.arange(-3.0, 2.0) + k, extrapolate=False)
            expected = (spline.derivative(derivative) if derivative else spline)(u)
            np.testing.assert_allclose(_basis(u, derivative)[:, k], np.nan_to_num(expected), atol=1e-12)


def test_energies_are_integrals():
    rng = np.random.default_rng(2)
    c = rng.normal(size=16)
    u = (np.arange(200) + 0.5) / 200
    f = {(i, j): _basis(u, i) @ c.reshape(4, 4) @ _basis(u, j).T for i in range(3) for j in range(3)}
    bending, gradient = _energies()
    assert c @ bending @ c == pytest.approx(np.mean(f[2, 0] ** 2 + 2 * f[1, 1] ** 2 + f[0, 2] ** 2), rel=1e-4)
    assert c @ gradient @ c == pytest.approx(np.mean(f[1, 0] ** 2 + f[0, 1] ** 2), rel=1e-4)
    plane = (2.0 + 0.3 * np.arange(4)[:, None] - 0.7 * np.arange(4)).ravel()
    assert abs(plane @ bending @ plane) < 1e-12


def test_the_surface_is_halved_into_compact_parts_of_bounded_size(sphere):
    size = np.random.default_rng(4).integers(0, 9, len(sphere.faces))
    size[7] = 5000  # one face is not cut
    part = halve_surface(sphere, size, 900)
    sums, middle = np.bincount(part, size), sphere.vertices[sphere.faces].mean(axis=1)
    assert (np.sort(sums)[:-1] <= 900).all()
    assert sums[part[7]] >= 5000
    assert len(sums) < 4 * size.sum() / 900
    spread = [np.ptp(middle[part == k], axis=0).max(initial=0.0) for k in range(len(sums))]
    assert np.median(spread) < 0.6 * np.ptp(middle, axis=0).max()
    assert halve_surface(sphere, size, 10**9).max() == 0
    together = replace(sphere, vertices=np.zeros_like(sphere.vertices))
    assert np.bincount(halve_surface(together, np.ones(len(size), int), 100)).max() <= 100
