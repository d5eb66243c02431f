"""Section 5.3: the thesis' own matrices of rank 2, one row a combination of the other two.

Its left null vector [alpha beta -1] is the epipole of image 2 (the text calls it the other one), so an
epipole with 0 in the dependent row's place has no such form. Which row depends, and which entry is fixed at 1
to make the eight parameters seven, is therefore chosen for each F: 18 maps that together reach every matrix
of rank 2. Luong and Faugeras (IJCV 1996) have a column depend, too: :class:`RowColumnParameterization`, whose
parameters are both epipoles and the homography of the pencils of lines, has 36 maps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar.frame import PairFrame, check_matches, check_start
from thesisrecon.epipolar.refinement import DISTANCE, REPROJECTION, SAMPSON, residuals_and_derivatives
from thesisrecon.geometry.two_view import epipoles, unit_norm
from thesisrecon.numerics.levenberg_marquardt import minimize_residuals

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


@dataclass(frozen=True)
class RowColumnParameterization:
    """Row ``row`` and column ``column`` are combinations of the other two: F = L B R, of 9 times 4 maps.

    B (2, 2) are the four entries left, of which ``fixed`` (0 to 3) is 1; L (3, 2) and R (2, 3) hold the
    identity and (alpha, beta), (gamma, delta) in the dependent place: e2 is (alpha, beta, -1) and e1 (gamma,
    delta, -1), in that order of the coordinates.
    """

    row: int
    column: int
    fixed: int

    @classmethod
    def best_for(cls, F: F64) -> RowColumnParameterization:
        """The map in which all parameters are at most 1 at F (3, 3), rank 2."""
        e1, e2 = epipoles(F)
        row, column = int(np.argmax(np.abs(e2))), int(np.argmax(np.abs(e1)))
        B = np.delete(np.delete(F, row, axis=0), column, axis=1)
        return cls(row, column, int(np.argmax(np.abs(B))))

    def parameters(self, F: F64) -> F64:
        """The seven parameters (7,) of the nearest F of rank 2: three entries, alpha, beta, gamma, delta."""
        e1, e2 = epipoles(F)
        B = np.delete(np.delete(F, self.row, axis=0), self.column, axis=1).ravel()
        left = -np.delete(e2, self.row) / e2[self.row]
        right = -np.delete(e1, self.column) / e1[self.column]
        return np.concatenate([np.delete(B, self.fixed) / B[self.fixed], left, right])

    def matrix(self, parameters: F64) -> F64:
        """F (3, 3), unit norm and rank 2, of seven parameters (7,)."""
        L, B, R = self._factors(parameters)
        return unit_norm(L @ B @ R)

    def tangent(self, parameters: F64) -> F64:
        """Derivatives (9, 7) of the unit vec(F) by the parameters (7,)."""
        L, B, R = self._factors(parameters)
        entries = np.delete(np.eye(4), self.fixed, axis=0).reshape(3, 2, 2)
        rows, columns = np.zeros((2, 3, 2)), np.zeros((2, 2, 3))
        rows[[0, 1], self.row, [0, 1]] = columns[[0, 1], [0, 1], self.column] = 1.0
        T = np.concatenate([L @ entries @ R, rows @ B @ R, L @ B @ columns]).reshape(7, 9).T
        F = (L @ B @ R).ravel()
        norm = np.linalg.norm(F)
        return np.asarray((T - np.outer(F, F @ T) / norm**2) / norm)

    def _factors(self, parameters: F64) -> tuple[F64, F64, F64]:
        B = np.insert(parameters[:3], self.fixed, 1.0).reshape(2, 2)
        L = np.insert(np.eye(2), self.row, parameters[3:5], axis=0)
        return L, B, np.insert(np.eye(2), self.column, parameters[5:], axis=1)


class RankTwoMap(Protocol):
    """One map of matrices of rank 2, seven parameters (7,) each."""

    def parameters(self, F: F64) -> F64:
        """Of the nearest F of rank 2."""

    def matrix(self, parameters: F64) -> F64:
        """F (3, 3), unit norm."""

    def tangent(self, parameters: F64) -> F64:
        """Derivatives (9, 7) of F."""


def refine_sampson_by_rows(F: F64, xy1: F64, xy2: F64, *, and_columns: bool = False) -> F64:
    """Least squares of :func:`~thesisrecon.epipolar.refinement.refine_sampson` in the thesis' parameters.

    Reaches the same minimum, more slowly; the map is chosen again where the estimate has left it.
    ``and_columns`` takes the 36 maps of Luong and Faugeras in place of the 18 of rows. Raises as the other.
    """
    return _refine_by_rows(F, xy1, xy2, SAMPSON, and_columns)


def refine_epipolar_distance_by_rows(F: F64, xy1: F64, xy2: F64, *, and_columns: bool = False) -> F64:
    """As :func:`refine_sampson_by_rows`, for the squared distances to both epipolar lines (5.6)."""
    return _refine_by_rows(F, xy1, xy2, DISTANCE, and_columns)


def refine_reprojection_by_rows(F: F64, xy1: F64, xy2: F64, *, and_columns: bool = False) -> F64:
    """As :func:`refine_sampson_by_rows`, for the distances to the nearest exact matches."""
    return _refine_by_rows(F, xy1, xy2, REPROJECTION, and_columns)


def _refine_by_rows(F: F64, xy1: F64, xy2: F64, criterion: int, and_columns: bool) -> F64:
    xy1, xy2 = check_matches(xy1, xy2, needed=7)
    frame = PairFrame.of(xy1, xy2)
    points = frame.points(xy1, xy2)
    current = check_start(F, frame).reshape(3, 3)
    best_for = RowColumnParameterization.best_for if and_columns else RowParameterization.best_for
    for _ in range(MAPS_TRIED):
        chart = best_for(current)
        current = _minimize_in(chart, current, points, criterion)
        if best_for(current) == chart:
            break
    return frame.matrix_in_pixels(current.ravel())


def _minimize_in(chart: RankTwoMap, start: F64, points: F64, criterion: int) -> F64:
    def residuals(p: F64) -> F64:
        r: F64 = residuals_and_derivatives(chart.matrix(p).ravel(), points, criterion)[0]
        return r

    def jacobian(p: F64) -> F64:
        J: F64 = residuals_and_derivatives(chart.matrix(p).ravel(), points, criterion)[1]
        return J @ chart.tangent(p)

    return chart.matrix(minimize_residuals(residuals, chart.parameters(start), jacobian=jacobian).x)
