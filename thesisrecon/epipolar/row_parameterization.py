"""Section 5.3: the thesis' own matrices of rank 2, one row a combination of the other two.

Its left null vector [alpha beta -1] is the epipole of image 2 (the text calls it the other one), so an
epipole with 0 in the dependent row's place has no such form. Which row depends, and which entry is fixed at 1
to make the eight parameters seven, is therefore chosen for each F: 18 maps that together reach every matrix
of rank 2 (Luong and Faugeras, IJCV 1996, have 36 with the columns).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.epipolar.frame import PairFrame, check_matches, check_start
from thesisrecon.epipolar.rank2.kernels import (
    DISTANCE,
    GRADIENT,
    REPROJECTION,
    residuals_and_derivatives,
)
from thesisrecon.geometry.multiview import epipoles, unit_norm
from thesisrecon.optimize.levenberg_marquardt import minimize_residuals

F64 = NDArray[np.float64]

MAPS_TRIED = 4


@dataclass(frozen=True)
class RowParameterization:
    """Row ``dependent`` is alpha times the first plus beta times the second of the others.

    ``fixed`` (0 to 5) is the entry of those two, row by row, that is 1.
    """

    dependent: int
    fixed: int

    @classmethod
    def best_for(cls, F: F64) -> RowParameterization:
        """The map in which |alpha|, |beta| and all entries are at most 1 at F (3, 3), rank 2."""
        _, e2 = epipoles(F)
        dependent = int(np.argmax(np.abs(e2)))
        free = np.delete(F, dependent, axis=0).ravel()
        return cls(dependent, int(np.argmax(np.abs(free))))

    def parameters(self, F: F64) -> F64:
        """The seven parameters (7,) of the nearest F of rank 2: five entries, alpha, beta."""
        _, e2 = epipoles(F)
        free = np.delete(F, self.dependent, axis=0).ravel()
        combination = -np.delete(e2, self.dependent) / e2[self.dependent]
        return np.concatenate([np.delete(free, self.fixed) / free[self.fixed], combination])

    def matrix(self, parameters: F64) -> F64:
        """F (3, 3), unit norm and rank 2, of seven parameters (7,)."""
        free = np.insert(parameters[:5], self.fixed, 1.0).reshape(2, 3)
        return unit_norm(np.insert(free, self.dependent, parameters[5:] @ free, axis=0))

    def tangent(self, parameters: F64) -> F64:
        """Derivatives (9, 7) of the unit vec(F) by the parameters (7,)."""
        free = np.insert(parameters[:5], self.fixed, 1.0).reshape(2, 3)
        F = np.insert(free, self.dependent, parameters[5:] @ free, axis=0)
        moves = np.zeros((7, 2, 3))
        moves.reshape(7, 6)[np.arange(5), np.delete(np.arange(6), self.fixed)] = 1.0
        rows = parameters[5:] @ moves
        rows[5:] = free
        T = np.insert(moves, self.dependent, rows, axis=1).reshape(7, 9).T
        unit, norm = F.ravel() / np.linalg.norm(F), np.linalg.norm(F)
        return np.asarray((T - np.outer(unit, unit @ T)) / norm)


def refine_gradient_by_rows(F: F64, xy1: F64, xy2: F64) -> F64:
    """Least squares of :func:`~thesisrecon.epipolar.refinement.refine_gradient` in the thesis' parameters.

    Reaches the same minimum, more slowly; the map is chosen again where the estimate has left it. Raises as
    the other.
    """
    return _refine_by_rows(F, xy1, xy2, GRADIENT)


def refine_epipolar_distance_by_rows(F: F64, xy1: F64, xy2: F64) -> F64:
    """As :func:`refine_gradient_by_rows`, for the squared distances to both epipolar lines (5.6)."""
    return _refine_by_rows(F, xy1, xy2, DISTANCE)


def refine_reprojection_by_rows(F: F64, xy1: F64, xy2: F64) -> F64:
    """As :func:`refine_gradient_by_rows`, for the distances to the nearest exact matches."""
    return _refine_by_rows(F, xy1, xy2, REPROJECTION)


def _refine_by_rows(F: F64, xy1: F64, xy2: F64, criterion: int) -> F64:
    xy1, xy2 = check_matches(xy1, xy2, needed=7)
    frame = PairFrame.of(xy1, xy2)
    points = frame.points(xy1, xy2)
    current = check_start(F, frame).reshape(3, 3)
    for _ in range(MAPS_TRIED):
        chart = RowParameterization.best_for(current)
        current = _minimize_in(chart, current, points, criterion)
        if RowParameterization.best_for(current) == chart:
            break
    return frame.matrix_in_pixels(current.ravel())


def _minimize_in(chart: RowParameterization, start: F64, points: F64, criterion: int) -> F64:
    def residuals(p: F64) -> F64:
        r: F64 = residuals_and_derivatives(chart.matrix(p).ravel(), points, criterion)[0]
        return r

    def jacobian(p: F64) -> F64:
        J: F64 = residuals_and_derivatives(chart.matrix(p).ravel(), points, criterion)[1]
        return J @ chart.tangent(p)

    return chart.matrix(minimize_residuals(residuals, chart.parameters(start), jacobian=jacobian).x)
