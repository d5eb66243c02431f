"""The uncertainty of an estimated F: from the curvature of the gradient criterion at its minimum.

Section 5.5: what the uncertainty of F means for epipolar lines and epipoles, and the least possible.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from thesisrecon.arrays import F64
from thesisrecon.epipolar.frame import PairFrame, as_matches, check_matches
from thesisrecon.epipolar.refinement import (
    SAMPSON,
    normal_equations,
    orthonormal_from_fundamental,
    orthonormal_tangent,
)
from thesisrecon.geometry.camera_matrix import project
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.two_view import epipoles, fundamental_from_cameras, unit_norm
from thesisrecon.records import FundamentalFit

FLATTEST_REL = 1e-14
"""Curvatures below this share of the largest are raised to it: a plane's F is uncertain, not inf."""


def fundamental_covariance(frame: PairFrame, f: F64, points: F64, sigma: float) -> F64:
    """Covariance (9, 9) of vec(F), F in pixels with unit norm, to first order: sigma^2 B (J'J)^-1 B'.

    ``f`` (9,) and ``points`` (N, 4) (the inliers) in ``frame``, ``sigma`` of one image coordinate in its
    units. J are the derivatives of the Sampson distances by the seven parameters, B those of vec(F). Rank 7.
    """
    U, V, B = np.empty((3, 3)), np.empty((3, 3)), np.empty((9, 7))
    G, h = np.empty((9, 9)), np.empty(9)
    phi = orthonormal_from_fundamental(f, U, V)
    orthonormal_tangent(U, V, phi, B)
    normal_equations(f, points, SAMPSON, np.inf, 1e150, G, h)
    values, vectors = np.linalg.eigh(B.T @ G @ B)
    half = B @ (vectors / np.sqrt(np.maximum(values, FLATTEST_REL * max(values[-1], 1e-300))))
    to_pixels = frame.to_pixels
    pixels = to_pixels @ f
    norm = float(np.linalg.norm(pixels))
    moved = to_pixels @ half / norm
    moved -= np.outer(pixels, pixels @ moved) / norm**2
    covariance: F64 = sigma**2 * moved @ moved.T
    return covariance


PARAMETERS = 7


def degrees_of_freedom(fit: FundamentalFit) -> float:
    """What is left of the inliers after the seven parameters of F, for the noise to be estimated from: >= 1.

    With few of them sigma is uncertain itself, and intervals need the quantiles of Student and of Fisher: at
    30 matches those of the normal distribution hold the truth in 93.6 % (epipoles 92.7 %) instead of 95 %.
    """
    return max(float(np.sum(fit.inliers)) - PARAMETERS, 1.0)


def student_95(degrees_of_freedom: float) -> float:
    """95 % of a Student variable lie within it; 1.96 for infinite degrees of freedom."""
    if not degrees_of_freedom > 0.0:
        raise ValueError(f"degrees of freedom must be positive; got {degrees_of_freedom}")
    return float(scipy.special.stdtrit(min(degrees_of_freedom, 1e9), 0.975))


def ellipse_95(degrees_of_freedom: float) -> float:
    """95 % of squared Mahalanobis distances in two dimensions lie below, 2 F(2, nu); 5.99 for infinite nu."""
    if not degrees_of_freedom > 0.0:
        raise ValueError(f"degrees of freedom must be positive; got {degrees_of_freedom}")
    nu = min(degrees_of_freedom, 1e9)
    return float(nu * np.expm1(-2.0 / nu * np.log(0.05)))


def epipolar_distance_std(F: F64, covariance: F64, xy1: F64, xy2: F64) -> F64:
    """Standard deviation (N,), px, of the distances of exact matches (N, 2) to their lines in image 2.

    To first order in the error of F alone: the interval of a distance d is d +- 1.96 std where sigma is known
    (else :func:`epipolar_distance_interval`). The ``covariance`` (9, 9) of vec(F) is for F (3, 3) of unit
    norm. A match with noise sigma of its own is off by sqrt(std^2 + sigma^2 (1 + g1 / g2)) instead, g1 and g2
    the squared gradients of x2' F x1 by x1 and x2.
    Raises ``ValueError`` for other shapes and as :func:`~thesisrecon.epipolar.frame.as_matches`.
    """
    _check(F, covariance)
    xy1, xy2 = as_matches(xy1, xy2)
    x1, x2 = homogenize(xy1), homogenize(xy2)
    lines = x1 @ F.T
    norm = np.sqrt(np.sum(lines[:, :2] ** 2, axis=1, keepdims=True)) + 1e-300
    # The point's distance is x2 . l / |l12|; where it is about 0 only the derivative of the numerator counts.
    foot = x2.copy()
    foot[:, :2] -= np.sum(x2 * lines, axis=1, keepdims=True) * lines[:, :2] / norm**2
    gradient = (foot[:, :, None] * x1[:, None, :]).reshape(-1, 9) / norm
    variance = np.einsum("na,ab,nb->n", gradient, covariance, gradient)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def epipolar_distance_interval(fit: FundamentalFit, xy1: F64, xy2: F64) -> F64:
    """Half widths (N,), px, of the 95 % intervals of the distances of exact matches (N, 2) to their lines.

    As :func:`epipolar_distance_std`, with Student's quantile for the inliers that sigma was estimated from.
    """
    return student_95(degrees_of_freedom(fit)) * epipolar_distance_std(fit.F, fit.covariance, xy1, xy2)


@dataclass(frozen=True)
class Epipole:
    """``direction`` (3,) unit vector, ``covariance`` (3, 3) of it (rank 2), and in pixels where it is finite.

    ``xy`` (2,) px and ``xy_covariance`` (2, 2) px^2 are to first order: meaningless where the interval is not
    small against the distance of the epipole from the image, and NaN for an epipole at infinity. The region
    and the intervals do without them and hold for every epipole.
    """

    direction: F64
    covariance: F64
    xy: F64
    xy_covariance: F64
    degrees_of_freedom: float = np.inf

    def contains(self, direction: F64) -> bool:
        """Whether the 95 % region of the direction holds this one (3,), a unit vector of either sign."""
        values, vectors = np.linalg.eigh(self.covariance)
        z = (direction * np.copysign(1.0, direction @ self.direction) - self.direction) @ vectors[:, 1:]
        return bool(np.sum(z**2 / values[1:]) <= ellipse_95(self.degrees_of_freedom))

    @property
    def interval_95(self) -> F64:
        """Lower and upper ends (2, 2), px, of the 95 % intervals of x and of y, after Fieller.

        All x whose e1 - x e3 is within 1.96 (or Student's) standard deviations of 0, which holds where the
        first-order xy +- 1.96 std does not (Fieller, J. R. Stat. Soc. B 16, 1954). Where e3 may be 0 the
        epipole may lie at infinity: a lower end above the upper one says that the interval runs from it
        through infinity to the upper one, -inf and inf that every place is possible.
        """
        return np.stack([self._fieller(0), self._fieller(1)], axis=1)

    def contains_xy(self, xy: F64) -> NDArray[np.bool_]:
        """Whether x and y (2,) lie in their intervals, those through infinity included; (2,)."""
        low, high = self.interval_95
        through = low > high
        return np.asarray(np.where(through, (xy >= low) | (xy <= high), (xy >= low) & (xy <= high)))

    def _fieller(self, k: int) -> F64:
        e, C, q2 = self.direction, self.covariance, student_95(self.degrees_of_freedom) ** 2
        a, b, c = e[2] ** 2 - q2 * C[2, 2], e[k] * e[2] - q2 * C[k, 2], e[k] ** 2 - q2 * C[k, k]
        inside = b * b - a * c
        if a == 0.0 or (a < 0.0 and inside <= 0.0):
            return np.array([-np.inf, np.inf])
        # Both roots of a x^2 - 2 b x + c without cancellation; the set lies between them for a > 0.
        half = b + np.copysign(np.sqrt(max(inside, 0.0)), b)
        roots = np.sort([half / a, c / half]) if half != 0.0 else np.zeros(2)
        return np.asarray(roots if a > 0.0 else roots[::-1])


def epipoles_with_covariance(
    F: F64, covariance: F64, *, degrees_of_freedom: float = np.inf
) -> tuple[Epipole, Epipole]:
    """The epipoles of image 1 and of image 2 of F (3, 3), unit norm, with ``covariance`` (9, 9) of vec(F).

    From F e1 = 0 the differential de1 = -F^+ dF e1, and likewise with F' for e2. ``degrees_of_freedom`` are
    those that the noise in the covariance was estimated with. Raises ``ValueError`` for other shapes.
    """
    _check(F, covariance)
    e1, e2 = epipoles(F)
    inverse = np.linalg.pinv(F, rcond=1e-12)
    D1 = -np.einsum("ia,b->iab", inverse, e1).reshape(3, 9)
    D2 = -np.einsum("ib,a->iab", inverse.T, e2).reshape(3, 9)
    return (
        _epipole(e1, D1 @ covariance @ D1.T, degrees_of_freedom),
        _epipole(e2, D2 @ covariance @ D2.T, degrees_of_freedom),
    )


def epipoles_of(fit: FundamentalFit) -> tuple[Epipole, Epipole]:
    """The epipoles of image 1 and of image 2 of a fit, with its covariance and degrees of freedom."""
    return epipoles_with_covariance(fit.F, fit.covariance, degrees_of_freedom=degrees_of_freedom(fit))


def _epipole(e: F64, covariance: F64, nu: float) -> Epipole:
    if not abs(e[2]) > 1e-12:
        return Epipole(e, covariance, np.full(2, np.nan), np.full((2, 2), np.nan), nu)
    D = np.hstack([np.eye(2), -e[:2, None] / e[2]]) / e[2]
    return Epipole(e, covariance, e[:2] / e[2], D @ covariance @ D.T, nu)


@dataclass(frozen=True)
class PrecisionBound:
    """The least covariance (9, 9) of vec(F), unit norm, that any unbiased estimator can have.

    ``rms_distance_px`` is the root of the expected mean squared distance of the exact points to their
    epipolar lines, over both images.
    """

    F: F64
    covariance: F64
    rms_distance_px: float


def fundamental_bound(P1: F64, P2: F64, X: F64, *, sigma_px: float) -> PrecisionBound:
    """The KCR (Cramer-Rao) lower bound for F from points X (N >= 8, 3) seen by cameras P1, P2 (3, 4).

    Gaussian noise of ``sigma_px`` on every coordinate: covariance sigma^2 B (J'J)^-1 B' with J the
    derivatives of the distances from the manifold of exact matches, at the truth (Kanatani, 1996;
    Chernov and Lesort, 2004). Raises ``ValueError`` for equal centres or a sigma that is not positive, and as
    :func:`~thesisrecon.epipolar.frame.check_matches`.
    """
    if not (np.isfinite(sigma_px) and sigma_px > 0.0):
        raise ValueError(f"sigma_px must be positive; got {sigma_px}")
    F = fundamental_from_cameras(P1, P2)
    xy1, xy2 = check_matches(project(P1, X), project(P2, X), needed=8)
    frame = PairFrame.of(xy1, xy2)
    covariance = fundamental_covariance(
        frame, frame.matrix_in_frame(F), frame.points(xy1, xy2), sigma_px * frame.scale
    )
    forth = epipolar_distance_std(F, covariance, xy1, xy2)
    back = epipolar_distance_std(F.T, _transposed(covariance), xy2, xy1)
    return PrecisionBound(F, covariance, float(np.sqrt(0.5 * np.mean(forth**2 + back**2))))


def _transposed(covariance: F64) -> F64:
    order = np.arange(9).reshape(3, 3).T.ravel()
    return covariance[np.ix_(order, order)]


def _check(F: F64, covariance: F64) -> None:
    if F.shape != (3, 3) or covariance.shape != (9, 9):
        raise ValueError(
            f"precision needs F (3, 3) and its covariance (9, 9); got {F.shape}, {covariance.shape}"
        )
    if not np.allclose(F, unit_norm(F), atol=1e-9):
        raise ValueError("precision needs F of unit norm, as its covariance is for")
