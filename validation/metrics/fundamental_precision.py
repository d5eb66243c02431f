"""Section 5.5: 95 % intervals of epipolar distances and epipoles, and the bound of the covariance of F."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from thesisrecon.arrays import F64
from thesisrecon.epipolar._matches import PairFrame, as_matches, check_matches
from thesisrecon.epipolar.refinement import fundamental_covariance
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.two_view import (
    epipolar_distance_std,
    epipoles,
    fundamental_from_cameras,
    symmetric_residuals,
)
from thesisrecon.records import FundamentalFit


def _degrees_of_freedom(fit: FundamentalFit) -> float:
    """Number of inliers minus the seven parameters of F, at least 1: with few, intervals need the quantiles
    of Student and Fisher.
    """
    return max(float(np.sum(fit.inliers)) - 7, 1.0)


def _student_95(nu: float) -> float:
    """95 % quantile of the absolute value of a Student variable; 1.96 for infinite degrees of freedom."""
    return float(scipy.special.stdtrit(min(nu, 1e9), 0.975))


def _ellipse_95(nu: float) -> float:
    """95 % quantile of squared Mahalanobis distances in two dimensions, 2 F(2, nu); 5.99 for infinite nu."""
    nu = min(nu, 1e9)
    return float(nu * np.expm1(-2.0 / nu * np.log(0.05)))


def epipolar_distance_interval(fit: FundamentalFit, xy1: F64, xy2: F64) -> F64:
    """Half 95 % intervals (N,) px of the distances of exact matches (N, 2) to their lines in image 2."""
    std = epipolar_distance_std(fit.F, fit.covariance, *as_matches(xy1, xy2))
    return _student_95(_degrees_of_freedom(fit)) * std


class Epipole(NamedTuple):
    """Unit ``direction`` (3,) of an epipole and its ``covariance`` (3, 3) of rank 2, first order."""

    direction: F64
    covariance: F64
    degrees_of_freedom: float = np.inf

    def contains(self, direction: F64) -> bool:
        """Return whether the 95 % region contains a homogeneous point (3,) of unit norm and either sign."""
        values, vectors = np.linalg.eigh(self.covariance)
        z = (direction * np.copysign(1.0, direction @ self.direction) - self.direction) @ vectors[:, 1:]
        return bool(np.sum(z**2 / values[1:]) <= _ellipse_95(self.degrees_of_freedom))

    def contains_xy(self, xy: F64) -> NDArray[np.bool_]:
        """Return (2,) whether x and y, px, lie in their 95 % intervals, which may run through infinity: all x
        with e1 - x e3 within Student's quantile of 0 (Fieller, J. R. Stat. Soc. B 16, 1954).
        """
        e, C = self.direction, self.covariance
        variance = np.diag(C)[:2] - 2.0 * xy * C[:2, 2] + xy**2 * C[2, 2]
        off = (e[:2] - xy * e[2]) ** 2
        return np.asarray(off <= _student_95(self.degrees_of_freedom) ** 2 * variance)


def epipoles_of(fit: FundamentalFit) -> tuple[Epipole, Epipole]:
    """Return the epipoles of both images with their covariances. F e1 = 0 gives de1 = -F^+ dF e1, and
    likewise e2 with F'.
    """
    e1, e2 = epipoles(fit.F)
    inverse, nu = np.linalg.pinv(fit.F, rcond=1e-12), _degrees_of_freedom(fit)
    D1 = -np.einsum("ia,b->iab", inverse, e1).reshape(3, 9)
    D2 = -np.einsum("ib,a->iab", inverse.T, e2).reshape(3, 9)
    return Epipole(e1, D1 @ fit.covariance @ D1.T, nu), Epipole(e2, D2 @ fit.covariance @ D2.T, nu)


class PrecisionBound(NamedTuple):
    """Least ``covariance`` (9, 9) of the true unit ``F``, and the RMS epipolar distance it implies."""

    F: F64
    covariance: F64
    rms_distance_px: float


def fundamental_bound(P1: F64, P2: F64, X: F64, *, sigma_px: float) -> PrecisionBound:
    """Return the KCR (Cramer-Rao) lower bound of the covariance of F for known cameras and at least 8 points,
    coordinates with noise of ``sigma_px`` (Kanatani, Statistical Optimization for Geometric Computation,
    1996): sigma^2 B (J'J)^-1 B' with J the derivatives of the distances to the manifold of exact matches.
    """
    F = fundamental_from_cameras(P1, P2)
    xy1, xy2 = check_matches(project(P1, X), project(P2, X), needed=8)
    frame = PairFrame.of(xy1, xy2)
    covariance = fundamental_covariance(
        frame, frame.matrix_in_frame(F), frame.points(xy1, xy2), sigma_px * frame.scale
    )
    transposed = np.arange(9).reshape(3, 3).T.ravel()
    forth = epipolar_distance_std(F, covariance, xy1, xy2)
    back = epipolar_distance_std(F.T, covariance[np.ix_(transposed, transposed)], xy2, xy1)
    return PrecisionBound(F, covariance, float(np.sqrt(0.5 * np.mean(forth**2 + back**2))))


NONE_PX = 99.0  # Error of a missing F, and the maximum reported error
RIGHT_PX = 1.0  # An F with a smaller error is right


def rms_epipolar_distance(F: F64 | None, truth: F64) -> float:
    """RMS distance, px, of right correspondences (M, 4) to their epipolar lines over both images (5.6). At
    most ``NONE_PX``, which stands for no F too: None, zeros or numbers that are not finite.
    """
    if F is None or not (np.isfinite(F).all() and F.any()):
        return NONE_PX
    d = symmetric_residuals(F, truth[:, :2], truth[:, 2:])
    return float(min(np.sqrt(np.mean(d**2) / 2.0), NONE_PX))
