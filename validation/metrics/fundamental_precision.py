"""Section 5.5: 95 % intervals of epipolar distances and epipoles, and the bound of the covariance of F."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from thesisrecon.arrays import F64
from thesisrecon.epipolar._frame import PairFrame, check_matches
from thesisrecon.epipolar._refinement import epipolar_distance_std, fundamental_covariance
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.two_view import epipoles, fundamental_from_cameras
from thesisrecon.records import FundamentalFit

PARAMETERS = 7


def _degrees_of_freedom(fit: FundamentalFit) -> float:
    """Number of inliers minus the seven parameters of F, at least 1.

    With few degrees of freedom intervals need Student's and Fisher's quantiles: for 30 matches normal
    quantiles contain the truth in 93.6 % (epipoles 92.7 %) instead of 95 %.
    """
    return max(float(np.sum(fit.inliers)) - PARAMETERS, 1.0)


def _student_95(nu: float) -> float:
    """95 % quantile of the absolute value of a Student variable; 1.96 for infinite degrees of freedom."""
    return float(scipy.special.stdtrit(min(nu, 1e9), 0.975))


def _ellipse_95(nu: float) -> float:
    """95 % quantile of squared Mahalanobis distances in two dimensions, 2 F(2, nu); 5.99 for infinite nu."""
    nu = min(nu, 1e9)
    return float(nu * np.expm1(-2.0 / nu * np.log(0.05)))


def epipolar_distance_interval(fit: FundamentalFit, xy1: F64, xy2: F64) -> F64:
    """Compute the 95 % intervals of the distances of exact matches to their epipolar lines in image 2.

    Parameters
    ----------
    fit : FundamentalFit
        The estimate; its inliers give Student's quantile.
    xy1, xy2 : array_like (N, 2)
        Matched points, px.

    Returns
    -------
    ndarray (N,)
        Half widths, px.
    """
    return _student_95(_degrees_of_freedom(fit)) * epipolar_distance_std(fit.F, fit.covariance, xy1, xy2)


@dataclass(frozen=True)
class Epipole:
    """An epipole with its covariance, first order.

    Parameters
    ----------
    direction : ndarray (3,)
        Homogeneous epipole, px, unit norm.
    covariance : ndarray (3, 3)
        Covariance of ``direction``, rank 2.
    degrees_of_freedom : float
        Degrees of freedom of the noise estimate.
    """

    direction: F64
    covariance: F64
    degrees_of_freedom: float = np.inf

    def contains(self, direction: F64) -> bool:
        """Return whether the 95 % region of the direction contains another direction.

        Parameters
        ----------
        direction : ndarray (3,)
            Homogeneous point, unit norm, either sign.

        Returns
        -------
        bool
            True inside the region.
        """
        values, vectors = np.linalg.eigh(self.covariance)
        z = (direction * np.copysign(1.0, direction @ self.direction) - self.direction) @ vectors[:, 1:]
        return bool(np.sum(z**2 / values[1:]) <= _ellipse_95(self.degrees_of_freedom))

    def contains_xy(self, xy: F64) -> NDArray[np.bool_]:
        """Return whether x and y lie in their 95 % intervals (Fieller, J. R. Stat. Soc. B 16, 1954).

        The interval of x holds all x for which e1 - x e3 is within Student's quantile of 0. It may run
        through infinity.

        Parameters
        ----------
        xy : ndarray (2,)
            Point, px.

        Returns
        -------
        ndarray (2,) of bool
            One flag per coordinate.
        """
        e, C = self.direction, self.covariance
        variance = np.diag(C)[:2] - 2.0 * xy * C[:2, 2] + xy**2 * C[2, 2]
        off = (e[:2] - xy * e[2]) ** 2
        return np.asarray(off <= _student_95(self.degrees_of_freedom) ** 2 * variance)


def epipoles_of(fit: FundamentalFit) -> tuple[Epipole, Epipole]:
    """Compute both epipoles of a fit with their covariances.

    F e1 = 0 gives de1 = -F^+ dF e1, and likewise e2 with F'.

    Parameters
    ----------
    fit : FundamentalFit
        The estimate.

    Returns
    -------
    tuple of Epipole
        Epipoles of image 1 and image 2.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon.records import FundamentalFit
    >>> F = np.array([[0, 0, 1], [0, 0, -2], [-1, 2, 0]]) / np.sqrt(10)
    >>> e1, e2 = epipoles_of(FundamentalFit(F, np.ones(27, bool), 0.5, 1e-8 * np.eye(9)))
    >>> np.abs(e1.direction).round(3)
    array([0.894, 0.447, 0.   ])
    """
    e1, e2 = epipoles(fit.F)
    inverse, nu = np.linalg.pinv(fit.F, rcond=1e-12), _degrees_of_freedom(fit)
    D1 = -np.einsum("ia,b->iab", inverse, e1).reshape(3, 9)
    D2 = -np.einsum("ib,a->iab", inverse.T, e2).reshape(3, 9)
    return Epipole(e1, D1 @ fit.covariance @ D1.T, nu), Epipole(e2, D2 @ fit.covariance @ D2.T, nu)


@dataclass(frozen=True)
class PrecisionBound:
    """Lower bound of the covariance of any unbiased estimator of F.

    Parameters
    ----------
    F : ndarray (3, 3)
        True fundamental matrix, unit norm.
    covariance : ndarray (9, 9)
        Bound of the covariance of vec(F).
    rms_distance_px : float
        Expected RMS distance of exact points to their epipolar lines over both images.
    """

    F: F64
    covariance: F64
    rms_distance_px: float


def fundamental_bound(P1: F64, P2: F64, X: F64, *, sigma_px: float) -> PrecisionBound:
    """Compute the KCR (Cramer-Rao) lower bound of the covariance of F for known cameras and points.

    sigma^2 B (J'J)^-1 B' with J the derivatives of the distances to the manifold of exact matches, at the
    truth.

    Parameters
    ----------
    P1, P2 : ndarray (3, 4)
        Cameras.
    X : ndarray (N, 3)
        Space points, N >= 8.
    sigma_px : float
        Standard deviation of the Gaussian noise of every coordinate, above 0.

    Returns
    -------
    PrecisionBound
        The bound.

    Raises
    ------
    ValueError
        If the camera centres coincide.

    References
    ----------
    K. Kanatani, Statistical Optimization for Geometric Computation, 1996.

    Examples
    --------
    >>> import numpy as np
    >>> X = np.random.default_rng(0).uniform(-1, 1, (40, 3)) + [0, 0, 5]
    >>> P1 = np.diag([800.0, 800.0, 1.0]) @ np.eye(3, 4)
    >>> P2 = P1 + np.array([[0, 0, 0, 400.0], [0, 0, 0, 0], [0, 0, 0, 0]])
    >>> 0.0 < fundamental_bound(P1, P2, X, sigma_px=0.5).rms_distance_px < 0.5
    True
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
