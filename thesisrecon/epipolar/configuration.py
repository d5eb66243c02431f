"""Section 5.5: which model explains a pair: general F, plane, pure rotation or pure translation.

A homography explains a plane or a rotating camera, [e]x one that does not rotate. A simpler model is rejected
if its residuals exceed the noise, or if F explains more of the remaining matches than chance would. A
homography K R K^-1 with square pixels is a pure rotation (HZ 13.2, 19.6).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64
from thesisrecon.epipolar._matches import (
    PairFrame,
    chance_of_agreement,
    check_matches,
    check_start,
    log10_false_alarms,
    multiplicity_weights,
    noise_scale,
    trimmed_noise_scale,
)
from thesisrecon.epipolar._sampling import sampson_distances
from thesisrecon.epipolar.homography import (
    find_dominant_plane,
    fundamentals_of_plane,
    plane_covariance,
    refine_plane,
)
from thesisrecon.epipolar.refinement import SAMPSON, UNBOUNDED, refine
from thesisrecon.geometry.homogeneous import cross_matrix, homogenize
from thesisrecon.geometry.strata import nearest_rotation
from thesisrecon.geometry.two_view import homography_sampson_residuals
from thesisrecon.optimize.least_squares import minimize_residuals

# Initial focal lengths in units of the point spread: fields of view of 150 to 10 degrees.
FOCALS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
REFINED = 3
CONSTRAINTS = 2
ITERATIONS = 50
MINIMUM = 12
# Squared distances from a homography in sigma^2 are chi-square(2) with this median; below 11 their halves
# across and along the epipolar lines have this mean.
NEAR = 11.0
NEAR_MEAN, CHI2_MEDIAN = 0.97743, 1.386294
TRIMMINGS = 3
# For a plane F fits the epipole to the noise, which makes the excess 1.5 +- 1 standard errors.
STANDARD_ERRORS = 4.0
# Squared distance in sigma^2 beyond which a match is off the homography; noise exceeds it once in 3000.
FAR = 16.0
# Maximum log10 of the false alarms of the matches off the simpler model.
MAX_CHANCE = -3.0
BAND = 2.5
# The F of a plane is also fitted to wrong matches, which therefore agree this much more often.
FLEXIBLE = 2.0
# Degrees of freedom of F beyond a homography and beyond [e]x.
EPIPOLE, BEYOND_TRANSLATION = 2, 5
# Probability of rejecting a pure translation for normal residuals, and tolerance added if wrong matches are
# expected in the band, which bias F.
RISK, ALLOWANCE = 2e-3, 0.4
# Probability of rejecting a rotation by its eigenvalues (two-sided) and by the camera test.
ROTATION_RISK = 1e-3
# Matches within this many sigma of a translation are compared with F.
TRANSLATED = 3.3
CORRECTIONS, EXACT = 10, 1e-12


def _rotation_homography(parameters: F64) -> F64:
    """K R K^-1 of a camera with square pixels: log f, principal point (2), rotation vector (3)."""
    f, (x, y) = float(np.exp(np.clip(parameters[0], -20.0, 20.0))), parameters[1:3]
    K = np.array([[f, 0.0, x], [0.0, f, y], [0.0, 0.0, 1.0]])
    back = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, f]]) / f
    H: F64 = K @ scipy.spatial.transform.Rotation.from_rotvec(parameters[3:]).as_matrix() @ back
    return H


def _rotation_test(H: F64, xy1: F64, xy2: F64) -> float:
    """Squared residuals of the best K R K^-1 minus those of H over their limit; at most 1 for a rotation."""

    def residuals(parameters: F64) -> F64:
        return homography_sampson_residuals(_rotation_homography(parameters), xy1, xy2).ravel()

    starts = [_start(H, f) for f in FOCALS]
    costs = [float(np.sum(residuals(start) ** 2)) for start in starts]
    rss = float(np.sum(homography_sampson_residuals(H, xy1, xy2) ** 2))
    degrees = 2 * len(xy1) - 8
    quantile = float(scipy.special.fdtri(CONSTRAINTS, degrees, 1.0 - ROTATION_RISK))
    limit = CONSTRAINTS * quantile * max(rss, 1e-24) / degrees
    ratio = np.inf
    for k in np.argsort(costs, kind="stable")[:REFINED]:
        if np.isfinite(costs[k]):
            found = minimize_residuals(residuals, starts[k], max_iterations=ITERATIONS, tolerance=1e-8)
            ratio = min(ratio, (2.0 * found.cost - rss) / limit)
        if ratio <= 1.0:
            break
    return ratio


def _start(H: F64, f: float) -> F64:
    """Parameters of the rotation nearest to K^-1 H K for a focal length and a central principal point."""
    A = H * np.array([[1.0, 1.0, 1.0 / f], [1.0, 1.0, 1.0 / f], [f, f, 1.0]])
    R = nearest_rotation(A * np.sign(np.linalg.det(A)))
    return np.array([np.log(f), 0.0, 0.0, *scipy.spatial.transform.Rotation.from_matrix(R).as_rotvec()])


class Configuration(Enum):
    """Model that explains the matches of a pair."""

    GENERAL = "general"
    PLANE = "plane"
    ROTATION = "pure rotation"
    TRANSLATION = "pure translation"


def classify_configuration(F: F64, xy1: F64, xy2: F64, *, inliers: B8 | None = None) -> Configuration:
    """Determine which model explains at least 12 inliers of F.

    GENERAL if relief and baseline exceed the noise.

    The matches with their outliers show how many agree by chance. Both images are assumed to share their
    intrinsics (otherwise a rotation is classified as a plane and a translation as general) and to have square
    pixels.
    """
    xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
    inliers = np.ones(len(xy1), dtype=bool) if inliers is None else inliers
    if inliers.shape != (len(xy1),):
        raise ValueError(f"classify_configuration got {inliers.shape} inlier flags for {len(xy1)} matches")
    check_matches(xy1[inliers], xy2[inliers], needed=MINIMUM)
    # One centre for both images keeps F of a translation skew-symmetric and the eigenvalues of a rotation.
    own = PairFrame.of(xy1[inliers], xy2[inliers])
    centre = 0.5 * (own.centroid1 + own.centroid2)
    frame = PairFrame(centre, centre, own.scale)
    points, f = frame.points(xy1, xy2), check_start(F, frame)
    refine(f, points[inliers], SAMPSON, np.inf, _scale(f, points[inliers]) * 3.0, 15)
    sigma = _scale(f, points[inliers])
    agree = np.asarray(sampson_distances(f, points)) < BAND * sigma
    chance = chance_of_agreement(xy1, xy2, BAND * sigma / frame.scale)
    return _classify(_InlierData(f, points, agree, multiplicity_weights(xy1, xy2), sigma, chance))


@dataclass(frozen=True)
class _InlierData:
    """Matches (N, 4), F and noise in one frame, inliers, weights, and the probability to agree by chance."""

    f: F64
    points: F64
    agree: B8
    weights: F64
    sigma: float
    chance: float

    def false_alarms(self, off: B8, free: int) -> float:
        """log10 of the false alarms of the matches ``off`` a simpler model."""
        agreeing, tried = self.weights[off & self.agree].sum(), self.weights[off].sum()
        # The free parameters of F adapt to wrong matches.
        chance = FLEXIBLE * self.chance if free == EPIPOLE else self.chance
        return log10_false_alarms(float(agreeing), float(tried), chance=chance, free=free)


def _scale(f: F64, points: F64) -> float:
    r = np.asarray(sampson_distances(f, points))
    return max(trimmed_noise_scale(r, noise_scale(r)), 1e-12)


def _classify(case: _InlierData) -> Configuration:
    rng = np.random.default_rng(0)
    plane = find_dominant_plane(case.f, case.points, case.agree, sigma=case.sigma, rng=rng)
    if plane is not None:
        H, squared = plane[0], plane[1] * case.sigma**2
        noise = _plane_noise(squared[case.agree])
        near, far = squared < NEAR * noise**2, squared > FAR * noise**2
        errors = _excess_errors(case, near, float(squared[near].sum()))
        if errors < STANDARD_ERRORS and case.false_alarms(far, EPIPOLE) > MAX_CHANCE:
            inliers = case.points[near]
            # Least squares of all of them, for which the covariance holds.
            H = refine_plane(H, inliers, 1e6 * noise, 4)
            # Student's limit, since the noise is estimated.
            limit = float(scipy.special.stdtrit(len(inliers) - 7, 1.0 - ROTATION_RISK))
            rotation = (
                _eigenvalue_errors(H, plane_covariance(H, inliers, noise)) < limit
                and _rotation_test(H, inliers[:, :2], inliers[:, 2:]) <= 1.0
            )
            return Configuration.ROTATION if rotation else Configuration.PLANE
    return Configuration.TRANSLATION if _translation_ratio(case) <= 1.0 else Configuration.GENERAL


def _plane_noise(squared: F64) -> float:
    """Standard deviation of one coordinate from squared distances (N,) to a homography with outliers."""
    variance = float(np.median(squared)) / CHI2_MEDIAN
    for _ in range(TRIMMINGS):
        near = squared[squared < NEAR * variance]
        if len(near) < MINIMUM:
            break
        variance = float(near.sum()) / (2.0 * NEAR_MEAN * (len(near) - 4))
    return float(np.sqrt(max(variance, 1e-24)))


def _excess_errors(case: _InlierData, near: B8, rss_plane: float) -> float:
    """Standard errors by which the squared parallax of the matches near the plane exceeds the noise.

    A homography has 8 parameters for 2 K residuals and F takes 7 of the K across the epipolar lines: K - 1
    remain along the lines, with the same variance if they are noise. The F of these matches alone is
    compared.
    """
    k = int(near.sum())
    if k < MINIMUM - 4:
        return float("inf")
    across = _least_squares(case.f, case.points[near])
    ratio = max(rss_plane - across, 1e-24) / (k - 1) * (k - 7) / max(across, 1e-24)
    return float(np.log(ratio) / np.sqrt(2.0 / (k - 1) + 2.0 / (k - 7)))


def _eigenvalue_errors(H: F64, covariance: F64) -> float:
    """abs(trace H - trace H^-1) in standard errors, 0 for a rotation (HZ 13.2; Hartley 1994); inf if none."""
    determinant = float(np.cbrt(np.linalg.det(H)))
    if not abs(determinant) > 1e-4 * float(np.linalg.norm(H)):
        return float("inf")
    # Unit determinant; the covariance along H itself is 0.
    M, back = H / determinant, np.linalg.inv(H / determinant)
    covariance = covariance / determinant**2
    t, t_back = float(np.trace(M)), float(np.trace(back))
    # d trace M = <I, dM>, d trace M^-1 = -<M^-2', dM>, for dM that keeps the determinant.
    project = back.T / 3.0
    slope: F64 = (np.eye(3) - project * t).ravel()
    difference: F64 = slope - (project * t_back - (back @ back).T).ravel()
    gap = float(np.sqrt(max(float(difference @ covariance @ difference), 1e-300)))
    mean, error = 0.5 * (t + t_back), float(np.sqrt(max(float(slope @ covariance @ slope), 1e-300)))
    still = bool(np.linalg.norm(M - np.eye(3)) ** 2 < 16.0 * np.trace(covariance) + 1e-18)
    turned = -1.0 <= mean < 3.0 - 3.0 * error
    return abs(t - t_back) / gap if turned or still else float("inf")


def _translation_ratio(case: _InlierData) -> float:
    """(RSS of [e]x - RSS of F) relative to its limit, an F-test with 5 and n - 7 degrees of freedom."""
    inliers = case.points[case.agree]
    f = _fit_translation(inliers, case.sigma)
    simple = np.asarray(sampson_distances(f, case.points))
    off = simple > np.sqrt(FAR) * case.sigma
    if case.false_alarms(off, BEYOND_TRANSLATION) < MAX_CHANCE:
        return float("inf")
    near = case.points[simple < TRANSLATED * case.sigma]
    degrees = len(near) - 7
    if degrees < MINIMUM - 7:
        return float("inf")
    # Both models use the same matches: to take those that F fits best would favour F.
    _refine_translation(f, near, np.inf)
    rss_simple = float(np.sum(np.asarray(sampson_distances(f, near)) ** 2))
    rss = min(rss_simple, *(_least_squares(start, near) for start in (case.f, f)))
    quantile = float(scipy.special.fdtri(BEYOND_TRANSLATION, degrees, 1.0 - RISK))
    limit = BEYOND_TRANSLATION * quantile * max(rss / degrees, 1e-24)
    strays = case.chance * float(case.weights[~case.agree].sum())
    return (rss_simple - rss) / (limit * (1.0 + ALLOWANCE * min(strays, 1.0)))


def _least_squares(f: F64, points: F64) -> float:
    f = f.copy()
    refine(f, points, SAMPSON, np.inf, UNBOUNDED, CORRECTIONS)
    return float(np.sum(np.asarray(sampson_distances(f, points)) ** 2))


def _fit_translation(points: F64, sigma: float) -> F64:
    """[e]x (9,) of most points: from pairs of them, then from all within a shrinking gate."""
    rng = np.random.default_rng(len(points))
    some = points[rng.permutation(len(points))[:200]]
    pairs = rng.integers(0, len(some), (100, 2))
    weights = np.ones((1, len(some)))
    F, _, found = fundamentals_of_plane(np.eye(3), some, weights, pairs, 4.0 * BAND * sigma)
    f: F64 = F[int(np.argmax(found[:, 0]))].copy()
    for gate in (4.0, 2.0, 1.5):
        _refine_translation(f, points, gate * 4.0 * sigma)
    return f


def _refine_translation(f: F64, points: F64, gate: float) -> None:
    """Minimise the Sampson distances of [e]x (9,) within the gate, in place, by Gauss-Newton."""
    e = np.array([f[7], f[2], f[3]])
    if not np.linalg.norm(e) > EXACT:
        return
    e /= np.linalg.norm(e)
    kept = points[np.asarray(sampson_distances(f, points)) < gate]
    if len(kept) < 5:
        return
    x1, x2 = homogenize(kept[:, :2]), homogenize(kept[:, 2:])
    normals = np.cross(x1, x2)
    for _ in range(CORRECTIONS):
        # x2 . (e x x1) = e . (x1 x x2); its gradients are the first two entries of e x x1 by x2 and of
        # x2 x e by x1.
        (a0, a1, _), (b0, b1, _) = np.cross(e, x1).T, np.cross(x2, e).T
        size = 1.0 / np.sqrt(a0**2 + a1**2 + b0**2 + b1**2 + EXACT**2)
        r = normals @ e * size
        by_g = np.stack([b1 - a1, a0 - b0, a1 * x1[:, 0] - a0 * x1[:, 1] + b0 * x2[:, 1] - b1 * x2[:, 0]])
        J = (normals * size[:, None]).T - r * size**2 * by_g
        # The length of e has no effect on the distances: e e' fixes it.
        normal = J @ J.T
        step = np.linalg.lstsq(normal + np.trace(normal) * np.outer(e, e), -J @ r, rcond=None)[0]
        e = (e + step) / np.linalg.norm(e + step)
        if step @ step < 1e-20:
            break
    f[:] = (cross_matrix(e) / np.sqrt(2.0)).ravel()
