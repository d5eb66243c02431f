"""Solvers for F and the division model together, on exact matches."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from validation.studies import lens_solvers


def exact_matches(seed, k1, k2):
    """Places of matches of two images with division lenses, in half diagonals, and F of straight places."""
    rng = np.random.default_rng(seed)
    X, found = rng.uniform([-3, -2, 3], [3, 2, 6], (30, 3)), []
    R, t = Rotation.from_rotvec(rng.normal(0, 0.2, 3)).as_matrix(), rng.normal(0, 0.5, 3)
    for k, Y in ((k1, X), (k2, X @ R.T + t)):
        u = Y[:, :2] / Y[:, 2:]
        found.append(2.0 * u / (1.0 + np.sqrt(1.0 - 4.0 * k * np.sum(u**2, axis=1, keepdims=True))))
    F = np.cross(np.eye(3), t) @ R
    return *found, F / np.linalg.norm(F)


@pytest.mark.parametrize("k1", [-0.8, -0.3, 0.1])
@pytest.mark.parametrize(("solver", "size"), [("nine_point", 9), ("eight_point", 8)])
def test_exact_matches_give_the_lens_and_f(solver, size, k1):
    p1, p2, F = exact_matches(3, k1, k1)
    k, found = getattr(lens_solvers, solver)(p1[:size], p2[:size])
    best = int(np.abs(k - k1).argmin())
    assert abs(k[best] - k1) < 1e-8
    assert min(np.abs(found[best] - F).max(), np.abs(found[best] + F).max()) < 1e-6
    if solver == "eight_point":
        # Every candidate satisfies all matches and has rank 2.
        for one, matrix in zip(k, found, strict=True):
            x1, x2 = (np.column_stack([p, 1.0 + one * np.sum(p**2, axis=1)]) for p in (p1[:8], p2[:8]))
            assert np.abs(np.einsum("ni,ij,nj->n", x2, matrix, x1)).max() < 1e-7
            assert abs(np.linalg.det(matrix)) < 1e-9


def test_fifteen_exact_matches_give_two_lenses_and_f():
    p1, p2, F = exact_matches(5, -0.4, -0.15)
    k, found = lens_solvers.fifteen_point(p1[:15], p2[:15])
    np.testing.assert_allclose(k, [-0.4, -0.15], atol=1e-8)
    assert min(np.abs(found - F).max(), np.abs(found + F).max()) < 1e-6


def test_the_study_compares_each_solver_with_the_default():
    (table,) = lens_solvers.lens_solvers_study(noise=(0.2,), wrong=0.0, trials=10, seeds=1)
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]
    assert [row[1] for row in rows] == ["sampling of k1 (default)", "nine-point", "eight-point", "15-point"]
    assert max(float(row[3]) for row in rows) < 0.02
