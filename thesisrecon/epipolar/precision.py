"""Section 5.5: what the uncertainty of F means for epipolar lines and epipoles, and the least possible."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.epipolar.covariance import fundamental_covariance
from thesisrecon.epipolar.frame import PairFrame, check_matches
from thesisrecon.geometry.camera import project
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.multiview import epipoles, fundamental_from_cameras, unit_norm

F64 = NDArray[np.float64]

NORMAL_95 = 1.959963984540054
"""95 % of a normal variable lies within so many standard deviations."""


def epipolar_distance_std(F: F64, covariance: F64, xy1: F64, xy2: F64) -> F64:
    """Standard deviation (N,), px, of the distances of exact matches (N, 2) to their lines in image 2.

    To first order in the error of F alone: the interval of a distance d is d +- 1.96 std. The ``covariance``
    (9, 9) of vec(F) is for F (3, 3) of unit norm. A match with noise sigma of its own is off by
    sqrt(std^2 + sigma^2 (1 + g1 / g2)) instead, g1 and g2 the squared gradients of x2' F x1 by x1 and x2.
    Raises ``ValueError`` for other shapes.
    """
    _check(F, covariance)
    x1, x2 = homogenize(xy1), homogenize(xy2)
    lines = x1 @ F.T
    norm = np.sqrt(np.sum(lines[:, :2] ** 2, axis=1, keepdims=True)) + 1e-300
    # The point's distance is x2 . l / |l12|; where it is about 0 only the derivative of the numerator counts.
    foot = x2.copy()
    foot[:, :2] -= np.sum(x2 * lines, axis=1, keepdims=True) * lines[:, :2] / norm**2
    gradient = (foot[:, :, None] * x1[:, None, :]).reshape(-1, 9) / norm
    variance = np.einsum("na,ab,nb->n", gradient, covariance, gradient)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


@dataclass(frozen=True)
class Epipole:
    """``direction`` (3,) unit vector, ``covariance`` (3, 3) of it (rank 2), and in pixels where it is finite.

    ``xy`` (2,) px and ``xy_covariance`` (2, 2) px^2 are to first order: meaningless where the interval is not
    small against the distance of the epipole from the image, and NaN for an epipole at infinity.
    """

    direction: F64
    covariance: F64
    xy: F64
    xy_covariance: F64

    @property
    def interval_95(self) -> F64:
        """Lower and upper ends (2, 2), px, of the 95 % intervals of x and of y."""
        half = NORMAL_95 * np.sqrt(np.diag(self.xy_covariance))
        return np.stack([self.xy - half, self.xy + half])


def epipoles_with_covariance(F: F64, covariance: F64) -> tuple[Epipole, Epipole]:
    """The epipoles of image 1 and of image 2 of F (3, 3), unit norm, with ``covariance`` (9, 9) of vec(F).

    From F e1 = 0 the differential de1 = -F^+ dF e1, and likewise with F' for e2. Raises ``ValueError`` for
    other shapes.
    """
    _check(F, covariance)
    e1, e2 = epipoles(F)
    inverse = np.linalg.pinv(F, rcond=1e-12)
    D1 = -np.einsum("ia,b->iab", inverse, e1).reshape(3, 9)
    D2 = -np.einsum("ib,a->iab", inverse.T, e2).reshape(3, 9)
    return _epipole(e1, D1 @ covariance @ D1.T), _epipole(e2, D2 @ covariance @ D2.T)


def _epipole(e: F64, covariance: F64) -> Epipole:
    if not abs(e[2]) > 1e-12:
        return Epipole(e, covariance, np.full(2, np.nan), np.full((2, 2), np.nan))
    D = np.hstack([np.eye(2), -e[:2, None] / e[2]]) / e[2]
    return Epipole(e, covariance, e[:2] / e[2], D @ covariance @ D.T)


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
