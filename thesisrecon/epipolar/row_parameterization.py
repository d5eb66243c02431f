"""Section 5.3: the thesis' parameters of F, one row a linear combination of the other two.

The left null vector (alpha, beta, -1) is the epipole of image 2 (the thesis calls it the other one), so an
epipole with a zero in the place of the dependent row has no such form. The dependent row and the entry fixed
at 1 are therefore chosen for each F: 18 maps that together reach every matrix of rank 2. Luong and Faugeras
(IJCV 1996) make a column dependent, too: 36 maps whose parameters are both epipoles and the homography of the
pencils of epipolar lines. These comparators reach the minimum of :mod:`thesisrecon.epipolar.refinement` more
slowly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar.frame import PairFrame, check_matches, check_start
from thesisrecon.epipolar.refinement import (
    SAMPSON,
    residuals_and_derivatives,
)
from thesisrecon.geometry.two_view import epipoles, unit_norm
from thesisrecon.numerics.levenberg_marquardt import minimize_residuals

# Number of times the map is chosen again after the estimate has left it.
MAPS_TRIED = 4


@dataclass(frozen=True)
class RowParameterization:
    """Row ``dependent`` of F is alpha times the first plus beta times the second of the other rows.

    Parameters
    ----------
    dependent : int
        The dependent row.
    fixed : int
        Entry (0 to 5, row by row) of the other two rows that is 1.
    """

    dependent: int
    fixed: int

    @classmethod
    def best_for(cls, F: F64) -> RowParameterization:
        """Return the map in which |alpha|, |beta| and all entries are at most 1.

        Parameters
        ----------
        F : ndarray (3, 3)
            Matrix of rank 2.

        Returns
        -------
        RowParameterization
            The map.
        """
        _, e2 = epipoles(F)
        dependent = int(np.argmax(np.abs(e2)))
        free = np.delete(F, dependent, axis=0).ravel()
        return cls(dependent, int(np.argmax(np.abs(free))))

    def parameters(self, F: F64) -> F64:
        """Compute the parameters of the nearest F of rank 2.

        Parameters
        ----------
        F : ndarray (3, 3)
            Fundamental matrix.

        Returns
        -------
        ndarray (7,)
            Five entries, alpha, beta.
        """
        _, e2 = epipoles(F)
        free = np.delete(F, self.dependent, axis=0).ravel()
        combination = -np.delete(e2, self.dependent) / e2[self.dependent]
        return np.concatenate([np.delete(free, self.fixed) / free[self.fixed], combination])

    def matrix(self, parameters: F64) -> F64:
        """Compute F from its parameters.

        Parameters
        ----------
        parameters : ndarray (7,)
            Five entries, alpha, beta.

        Returns
        -------
        ndarray (3, 3)
            F, rank 2, unit norm.
        """
        free = np.insert(parameters[:5], self.fixed, 1.0).reshape(2, 3)
        return unit_norm(np.insert(free, self.dependent, parameters[5:] @ free, axis=0))

    def tangent(self, parameters: F64) -> F64:
        """Compute the derivatives of the unit vec(F) by the parameters.

        Parameters
        ----------
        parameters : ndarray (7,)
            Five entries, alpha, beta.

        Returns
        -------
        ndarray (9, 7)
            Derivatives.
        """
        free = np.insert(parameters[:5], self.fixed, 1.0).reshape(2, 3)
        F = np.insert(free, self.dependent, parameters[5:] @ free, axis=0)
        moves = np.zeros((7, 2, 3))
        moves.reshape(7, 6)[np.arange(5), np.delete(np.arange(6), self.fixed)] = 1.0
        rows = parameters[5:] @ moves
        rows[5:] = free
        T = np.insert(moves, self.dependent, rows, axis=1).reshape(7, 9).T
        return _unit_tangent(F.ravel(), T)


@dataclass(frozen=True)
class RowColumnParameterization:
    """Row ``row`` and column ``column`` of F are combinations of the others: F = L B R, 9 times 4 maps.

    B (2, 2) holds the four remaining entries; L (3, 2) and R (2, 3) hold the identity and (alpha, beta),
    (gamma, delta) in the dependent place: e2 is (alpha, beta, -1) and e1 (gamma, delta, -1) in that order of
    coordinates.

    Parameters
    ----------
    row, column : int
        The dependent row and column.
    fixed : int
        Entry (0 to 3) of B that is 1.
    """

    row: int
    column: int
    fixed: int

    @classmethod
    def best_for(cls, F: F64) -> RowColumnParameterization:
        """Return the map in which all parameters are at most 1.

        Parameters
        ----------
        F : ndarray (3, 3)
            Matrix of rank 2.

        Returns
        -------
        RowColumnParameterization
            The map.
        """
        e1, e2 = epipoles(F)
        row, column = int(np.argmax(np.abs(e2))), int(np.argmax(np.abs(e1)))
        B = np.delete(np.delete(F, row, axis=0), column, axis=1)
        return cls(row, column, int(np.argmax(np.abs(B))))

    def parameters(self, F: F64) -> F64:
        """Compute the parameters of the nearest F of rank 2.

        Parameters
        ----------
        F : ndarray (3, 3)
            Fundamental matrix.

        Returns
        -------
        ndarray (7,)
            Three entries, alpha, beta, gamma, delta.
        """
        e1, e2 = epipoles(F)
        B = np.delete(np.delete(F, self.row, axis=0), self.column, axis=1).ravel()
        left = -np.delete(e2, self.row) / e2[self.row]
        right = -np.delete(e1, self.column) / e1[self.column]
        return np.concatenate([np.delete(B, self.fixed) / B[self.fixed], left, right])

    def matrix(self, parameters: F64) -> F64:
        """Compute F from its parameters.

        Parameters
        ----------
        parameters : ndarray (7,)
            Three entries, alpha, beta, gamma, delta.

        Returns
        -------
        ndarray (3, 3)
            F, rank 2, unit norm.
        """
        L, B, R = self._factors(parameters)
        return unit_norm(L @ B @ R)

    def tangent(self, parameters: F64) -> F64:
        """Compute the derivatives of the unit vec(F) by the parameters.

        Parameters
        ----------
        parameters : ndarray (7,)
            Three entries, alpha, beta, gamma, delta.

        Returns
        -------
        ndarray (9, 7)
            Derivatives.
        """
        L, B, R = self._factors(parameters)
        entries = np.delete(np.eye(4), self.fixed, axis=0).reshape(3, 2, 2)
        rows, columns = np.zeros((2, 3, 2)), np.zeros((2, 2, 3))
        rows[[0, 1], self.row, [0, 1]] = columns[[0, 1], [0, 1], self.column] = 1.0
        T = np.concatenate([L @ entries @ R, rows @ B @ R, L @ B @ columns]).reshape(7, 9).T
        return _unit_tangent((L @ B @ R).ravel(), T)

    def _factors(self, parameters: F64) -> tuple[F64, F64, F64]:
        B = np.insert(parameters[:3], self.fixed, 1.0).reshape(2, 2)
        L = np.insert(np.eye(2), self.row, parameters[3:5], axis=0)
        return L, B, np.insert(np.eye(2), self.column, parameters[5:], axis=1)


def _unit_tangent(f: F64, T: F64) -> F64:
    """Derivatives (9, 7) of f / |f| from those ``T`` of f (9,)."""
    norm = np.linalg.norm(f)
    return np.asarray((T - np.outer(f, f @ T) / norm**2) / norm)


def refine_by_rows(F: F64, xy1: F64, xy2: F64, *, criterion: int = SAMPSON, and_columns: bool = False) -> F64:
    """Minimise a criterion of section 5.3 in the thesis' parameters of F.

    Parameters
    ----------
    F : array_like (3, 3)
        Start, rank 2 or 3, px.
    xy1, xy2 : array_like (N, 2)
        Matched points, N >= 7, px.
    criterion : int
        SAMPSON, EPIPOLAR_DISTANCE or REPROJECTION of :mod:`thesisrecon.epipolar.refinement`.
    and_columns : bool
        Use the 36 maps of Luong and Faugeras instead of the 18 of rows.

    Returns
    -------
    ndarray (3, 3)
        Refined F, rank 2, unit norm.

    Raises
    ------
    ValueError
        As :func:`~thesisrecon.epipolar.refinement.refine_sampson`.

    Examples
    --------
    >>> import numpy as np
    >>> xy1 = np.array([[0, 0], [9, 1], [2, 8], [7, 7], [4, 3], [1, 5], [8, 4], [5, 9]], dtype=float)
    >>> xy2 = xy1 + np.array([[4.0, 2.0]]) / np.array([1, 2, 4, 2, 1, 4, 1, 2])[:, None]
    >>> start = np.array([[0.0, 0.0, 0.4], [0.0, 0.0, -0.9], [-0.4, 0.9, 0.0]])
    >>> F = refine_by_rows(start, xy1, xy2)
    >>> float(np.round(np.abs(F[0, 2] / F[1, 2]), 6))
    0.5
    """
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


def _minimize_in(
    chart: RowParameterization | RowColumnParameterization, start: F64, points: F64, criterion: int
) -> F64:
    def residuals(p: F64) -> F64:
        r: F64 = residuals_and_derivatives(chart.matrix(p).ravel(), points, criterion)[0]
        return r

    def jacobian(p: F64) -> F64:
        J: F64 = residuals_and_derivatives(chart.matrix(p).ravel(), points, criterion)[1]
        return J @ chart.tangent(p)

    return chart.matrix(minimize_residuals(residuals, chart.parameters(start), jacobian=jacobian).x)
