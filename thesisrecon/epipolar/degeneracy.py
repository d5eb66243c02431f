"""Section 5.5: is F determined at all, and what else would explain the matches: evidence, then a name.

Matches of one plane, and of a camera that only turned, are explained by a homography and leave the epipoles
free; of a camera that moved without turning F is [e]x with two degrees of freedom in place of seven. Every
test is against the noise: a simpler model is believed unless its residuals are larger than the noise allows.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from thesisrecon.epipolar.frame import check_matches
from thesisrecon.epipolar.refinement import refine_gradient
from thesisrecon.geometry.homogeneous import cross_matrix, homogenize
from thesisrecon.geometry.multiview import estimate_homography, sampson_residuals
from thesisrecon.optimize.levenberg_marquardt import minimize_residuals

F64 = NDArray[np.float64]

MINIMUM = 12
TRUNCATION, TRUNCATED_MEAN, TRUNCATED_VARIANCE = 11.0, 1.99183, 3.82
"""Squared distances from a homography, in sigma^2, count to 11 at most; chi-square(2) so truncated has this
mean and variance."""
STANDARD_ERRORS = 4.0
STRAY_SHARE, STRAY_COUNT = 0.03, 3
"""Matches this many and few may lie off the homography: wrong ones that F happens to fit."""
RISK = 2e-3
"""Chance to take a pure translation or rotation for more than that, each."""
TURN_ERRORS = 3.0


class Configuration(Enum):
    """What the matches of a pair show."""

    GENERAL = "general"
    PLANE = "plane"
    ROTATION = "pure rotation"
    TRANSLATION = "pure translation"


@dataclass(frozen=True)
class Degeneracy:
    """The name and the evidence that it rests on.

    Attributes
    ----------
    kind : what was found.
    sigma_px : standard deviation of one coordinate, from the residuals of the general F.
    homography_errors : excess of the squared distances from the best homography over those of noise, in
        standard errors; above 4 no homography explains the matches.
    off_homography : share of the matches more than 3.3 sigma off it.
    turning_errors : |trace H - trace H^-1| (det H = 1), 0 for a rotation, in its standard errors.
    turn_deg : the angle of that rotation, NaN where the eigenvalues are not those of one.
    translation_ratio : increase of the squared residuals from F to [e]x, over its limit; at most 1 where F is
        that of a translation.
    """

    kind: Configuration
    sigma_px: float
    homography_errors: float
    off_homography: float
    turning_errors: float
    turn_deg: float
    translation_ratio: float

    def __str__(self) -> str:
        return (
            f"{self.kind.value}: noise {self.sigma_px:.2g} px, homography off by "
            f"{self.homography_errors:.1f} standard errors with {100.0 * self.off_homography:.0f} % of the "
            f"matches beyond it, rotation "
            f"off by {self.turning_errors:.1f}, translation at {self.translation_ratio:.2g} of its limit"
        )


def classify_configuration(F: F64, xy1: F64, xy2: F64) -> Degeneracy:
    """Name what the inlier matches (N >= 12, 2) px of F (3, 3) show.

    Both images are taken to share their intrinsics (else a rotation is named a plane, a translation general);
    a plane of a camera that moved by it sideways is told from a rotation by its eigenvalues alone. GENERAL
    where relief and baseline stand out of the noise. Raises as
    :func:`~thesisrecon.epipolar.frame.check_matches`, and ``ValueError`` for an F below rank 2.
    """
    xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
    centre = 0.5 * (xy1.mean(axis=0) + xy2.mean(axis=0))
    scale = float(np.sqrt(0.5 * (np.mean((xy1 - centre) ** 2) + np.mean((xy2 - centre) ** 2))))
    x1, x2 = (xy1 - centre) / scale, (xy2 - centre) / scale
    residuals = sampson_residuals(refine_gradient(F, xy1, xy2), xy1, xy2) / scale
    rss = float(residuals @ residuals)
    sigma = max(float(np.sqrt(rss / (len(x1) - 7))), 1e-12)
    H, covariance, squared = _fit_homography(x1, x2, sigma)
    errors = _excess_errors(squared / sigma**2)
    off = float(np.mean(squared > TRUNCATION * sigma**2))
    turning, angle = _turning(H, covariance)
    ratio = _translation_ratio(x1, x2, rss)
    kind = Configuration.GENERAL
    if errors < STANDARD_ERRORS and off * len(x1) <= STRAY_COUNT + STRAY_SHARE * len(x1):
        kind = Configuration.ROTATION if turning < TURN_ERRORS and np.isfinite(angle) else Configuration.PLANE
    elif ratio <= 1.0:
        kind = Configuration.TRANSLATION
    return Degeneracy(kind, sigma * scale, errors, off, turning, angle, ratio)


def homography_distances(H: F64, xy1: F64, xy2: F64) -> F64:
    """Whitened residuals (N, 2) of x2 ~ H x1: to first order the two parts of the distance to the nearest
    exact match, each with the standard deviation of one coordinate (Sampson; Chum, Pajdla and Sturm 2005)."""
    x1 = homogenize(xy1)
    u, v, w = (x1 @ H.T).T
    c = np.stack([u - w * xy2[:, 0], v - w * xy2[:, 1]], axis=1)
    J = np.zeros((len(x1), 2, 4))
    J[:, :, :2] = H[None, :2, :2] - xy2[:, :, None] * H[2, :2]
    J[:, 0, 2] = J[:, 1, 3] = -w
    # Cholesky of J J' by hand: two by two.
    a, b, d = (np.sum(J[:, i] * J[:, j], axis=1) for i, j in ((0, 0), (0, 1), (1, 1)))
    l11 = np.sqrt(a + 1e-300)
    l21 = b / l11
    l22 = np.sqrt(np.maximum(d - l21**2, 1e-300))
    first = c[:, 0] / l11
    return np.stack([first, (c[:, 1] - l21 * first) / l22], axis=1)


def _fit_homography(x1: F64, x2: F64, sigma: float) -> tuple[F64, F64, F64]:
    """H of unit determinant, its covariance (9, 9), and the squared distances (N,)."""
    start = estimate_homography(x1, x2)
    found = minimize_residuals(
        lambda h: homography_distances(h.reshape(3, 3), x1, x2).ravel(),
        start.ravel(),
        loss="huber",
        loss_scale=3.0 * sigma,
        max_iterations=20,
    )
    H = found.x.reshape(3, 3)
    squared = np.sum(homography_distances(H, x1, x2) ** 2, axis=1)
    determinant = float(np.cbrt(np.linalg.det(H)))
    size = float(np.linalg.norm(H))
    if not abs(determinant) > 1e-6 * size:
        return H / size, np.zeros((9, 9)), squared
    return H / determinant, _homography_covariance(H / determinant, x1, x2, sigma), squared


def _homography_covariance(H: F64, x1: F64, x2: F64, sigma: float) -> F64:
    h, J = H.ravel(), np.empty((2 * len(x1), 9))
    for m, step in enumerate(1e-6 * np.eye(9)):
        ends = [homography_distances((h + s * step).reshape(3, 3), x1, x2).ravel() for s in (1.0, -1.0)]
        J[:, m] = (ends[0] - ends[1]) / 2e-6
    values, vectors = np.linalg.eigh(J.T @ J)
    # The least eigenvalue is the scale of H, which no residual sees.
    half = vectors[:, 1:] / np.sqrt(np.maximum(values[1:], 1e-14 * values[-1]))
    return np.asarray(sigma**2 * half @ half.T)


def _excess_errors(squared: F64) -> float:
    n = len(squared)
    total = float(np.minimum(squared, TRUNCATION).sum())
    # The noise itself is known from n - 7 residuals: its error is part of the error of the sum.
    spread = np.sqrt(TRUNCATED_VARIANCE * n + (TRUNCATED_MEAN * n) ** 2 * 2.0 / (n - 7))
    return float((total - TRUNCATED_MEAN * (n - 4)) / spread)


def _turning(H: F64, covariance: F64) -> tuple[float, float]:
    """|trace H - trace H^-1| in standard errors and the angle, deg: H of a rotation has eigenvalues
    1, exp(+-i angle) whatever the camera (HZ 13.2; Hartley 1994)."""

    def traces(h: F64) -> F64:
        M = h.reshape(3, 3) / np.cbrt(np.linalg.det(h.reshape(3, 3)))
        return np.array([np.trace(M), np.trace(np.linalg.inv(M))])

    if not abs(np.linalg.det(H)) > 1e-12:
        return np.inf, np.nan
    h = H.ravel()
    t, back = traces(h)
    slopes = np.stack([(traces(h + step) - traces(h - step)) / 2e-6 for step in 1e-6 * np.eye(9)], axis=1)
    spread = slopes @ covariance @ slopes.T
    gap = float(np.sqrt(max(spread[0, 0] - 2.0 * spread[0, 1] + spread[1, 1], 1e-300)))
    mean, error = 0.5 * (t + back), float(np.sqrt(max(spread[0, 0], 1e-300)))
    still = bool(np.linalg.norm(H - np.eye(3)) ** 2 < 16.0 * np.trace(covariance) + 1e-18)
    turned = -1.0 <= mean < 3.0 - TURN_ERRORS * error
    angle = (
        float(np.degrees(np.arccos(np.clip(0.5 * (mean - 1.0), -1.0, 1.0)))) if turned or still else np.nan
    )
    return abs(float(t - back)) / gap, angle


def _translation_ratio(x1: F64, x2: F64, rss: float) -> float:
    """(RSS of [e]x - RSS of F) over the limit that noise keeps to, an F-test with 5 and n - 7 degrees."""
    start = np.linalg.svd(np.cross(homogenize(x1), homogenize(x2)), full_matrices=False)[2][2]
    found = minimize_residuals(lambda e: sampson_residuals(cross_matrix(e), x1, x2), start, max_iterations=20)
    degrees = len(x1) - 7
    limit = 5.0 * float(f_distribution.ppf(1.0 - RISK, 5, degrees)) * max(rss / degrees, 1e-24)
    return float((2.0 * found.cost - rss) / limit)
