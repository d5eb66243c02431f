"""Section 5.3: minimise a geometric criterion over the seven degrees of freedom of F.

The criteria are the Sampson distance (5.4), which the thesis calls the gradient criterion, the distances to
the epipolar lines (5.6) and the reprojection error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar._frame import PairFrame, check_matches, check_start
from thesisrecon.epipolar.criteria import (
    EPIPOLAR_DISTANCE,
    REPROJECTION,
    SAMPSON,
    UNBOUNDED,
    refine,
    residuals_and_derivatives,
)
from thesisrecon.errors import unknown_word
from thesisrecon.geometry.conditioning import unit_norm
from thesisrecon.geometry.two_view import epipoles
from thesisrecon.optimize.least_squares import minimize_residuals

Criterion = Literal["sampson", "epipolar-distance", "reprojection"]
Parameters = Literal["orthonormal", "row", "row-and-column"]
_CRITERIA = {"sampson": SAMPSON, "epipolar-distance": EPIPOLAR_DISTANCE, "reprojection": REPROJECTION}
MAX_ITERATIONS = 50
MAPS_TRIED = 4


def refine_fundamental(
    F: F64, xy1: F64, xy2: F64, criterion: Criterion = "sampson", *, parameters: Parameters = "orthonormal"
) -> F64:
    """Minimise a criterion of section 5.3 over matrices of rank 2 by Levenberg-Marquardt, from a start F.

    F = U diag(cos phi, sin phi, 0) V' (Bartoli and Sturm, PAMI 26, 2004) has rank 2 without the thesis'
    exception of an epipole at infinity. The reprojection error gives the maximum likelihood for Gaussian
    noise (HZ, algorithm 11.3); the Sampson distance is optimal to first order in the noise. With the
    ``parameters`` "row" and "row-and-column" one row (and one column) of F is a combination of the others, as
    in the thesis; its 18 (36) maps reach the same minimum more slowly.
    """
    if criterion not in _CRITERIA:
        raise ValueError(unknown_word("criterion", criterion, _CRITERIA))
    if parameters not in get_args(Parameters):
        raise ValueError(unknown_word("value of parameters", parameters, get_args(Parameters)))
    xy1, xy2 = check_matches(xy1, xy2, needed=7)
    frame = PairFrame.of(xy1, xy2)
    f, points = check_start(F, frame), frame.points(xy1, xy2)
    if parameters == "orthonormal":
        refine(f, points, _CRITERIA[criterion], np.inf, UNBOUNDED, MAX_ITERATIONS)
    else:
        f = _refine_by_rows(f, points, _CRITERIA[criterion], and_columns=parameters == "row-and-column")
    return frame.matrix_in_pixels(f)


@dataclass(frozen=True)
class _RowMap:
    """F = L B R: row ``row`` of F, and optionally column ``column``, are combinations of the others.

    L (3, 2) holds the identity and (alpha, beta) in the dependent row: the epipole e2 is (alpha, beta, -1) in
    that order of coordinates (the thesis has e1 here). With a dependent column (Luong and Faugeras, IJCV
    1996) R (2, 3) does the same for e1, else it is the identity. No map represents an epipole whose
    coordinate of the dependent row is zero: 18 maps (36 with columns) are needed for all matrices of rank 2.
    ``fixed`` is the entry of B, row by row, that is 1.
    """

    row: int
    fixed: int
    column: int | None = None

    @classmethod
    def best_for(cls, F: F64, *, and_columns: bool = False) -> _RowMap:
        """The map in which all parameters of F are at most 1."""
        e1, e2 = epipoles(F)
        row, column = int(np.argmax(np.abs(e2))), int(np.argmax(np.abs(e1))) if and_columns else None
        return cls(row, int(np.argmax(np.abs(cls(row, 0, column)._independent(F)))), column)

    def parameters(self, F: F64) -> F64:
        """Entries of B but one, alpha, beta (and gamma, delta): (7,), for the nearest F of rank 2."""
        e1, e2 = epipoles(F)
        B = self._independent(F)
        parts = [np.delete(B, self.fixed) / B[self.fixed], -np.delete(e2, self.row) / e2[self.row]]
        if self.column is not None:
            parts.append(-np.delete(e1, self.column) / e1[self.column])
        return np.concatenate(parts)

    def matrix(self, parameters: F64) -> F64:
        """F of its parameters (7,), rank 2, unit norm."""
        n = 5 if self.column is None else 3
        B = np.insert(parameters[:n], self.fixed, 1.0).reshape(2, -1)
        L = np.insert(np.eye(2), self.row, parameters[n : n + 2], axis=0)
        R = np.eye(3) if self.column is None else np.insert(np.eye(2), self.column, parameters[5:], axis=1)
        return unit_norm(L @ B @ R)

    def _independent(self, F: F64) -> F64:
        rows = np.delete(F, self.row, axis=0)
        return (rows if self.column is None else np.delete(rows, self.column, axis=1)).ravel()


def _refine_by_rows(f: F64, points: F64, criterion: int, *, and_columns: bool) -> F64:
    """Minimise a criterion in the thesis' parameters; the map is chosen again when the estimate leaves it."""
    current = f.reshape(3, 3)
    for _ in range(MAPS_TRIED):
        chart = _RowMap.best_for(current, and_columns=and_columns)

        def residuals(p: F64, chart: _RowMap = chart) -> F64:
            return np.asarray(residuals_and_derivatives(chart.matrix(p).ravel(), points, criterion)[0])

        current = chart.matrix(minimize_residuals(residuals, chart.parameters(current)).x)
        if _RowMap.best_for(current, and_columns=and_columns) == chart:
            break
    return current.ravel()
