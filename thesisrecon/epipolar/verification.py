"""Verification of a pair: the model that explains it, and the share of one homography.

A homography explains a plane or a rotating camera, [e]x one that does not rotate (the wolf of section 5.5). A
simpler model is rejected if its residuals exceed the noise, or if F explains more of the remaining matches
than chance would. A homography K R K^-1 with square pixels is a pure rotation (HZ 13.2, 19.6).
"""

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64
from thesisrecon.epipolar import _matches, homography
from thesisrecon.epipolar._matches import PairFrame
from thesisrecon.epipolar._sampling import sampson_distances
from thesisrecon.epipolar.degeneracy import assess_degeneracy
from thesisrecon.epipolar.refinement import SAMPSON, UNBOUNDED, normal_equations, refine
from thesisrecon.errors import Notice, StageFailure, counted, require_range
from thesisrecon.geometry.homogeneous import cross_matrix, dehomogenize, homogenize, unit_norm
from thesisrecon.geometry.small_matrices import solve_positive
from thesisrecon.geometry.strata import nearest_rotation
from thesisrecon.geometry.two_view import (
    epipoles,
    homography_linear,
    homography_residuals,
    homography_sampson_residuals,
)
from thesisrecon.optimize.least_squares import minimize_residuals, trimmed_noise_scale
from thesisrecon.optimize.ransac import log10_false_alarms
from thesisrecon.records import DegeneracyReport, FundamentalFit, Matches, TwoView

MINIMUM = 12
NEAR = 11.0  # squared distance in sigma^2 of the matches near a homography
# Squared distance in sigma^2 beyond which a match is off the homography; noise exceeds it once in 3000.
FAR = 16.0
MAX_CHANCE = -3.0  # maximum log10 of the false alarms of the matches off the simpler model
BAND = 2.5
EPIPOLE, BEYOND_TRANSLATION = 2, 5  # degrees of freedom of F beyond a homography and beyond [e]x
# Probability of rejecting a rotation by its eigenvalues (two-sided) and by the camera test.
ROTATION_RISK = 1e-3
CORRECTIONS = 10


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

    # Focal lengths in units of the point spread: fields of view of 150 to 10 degrees.
    starts = list[F64]()
    for f in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0):
        # The rotation nearest to K^-1 H K for a focal length and a central principal point.
        A = H * np.array([[1.0, 1.0, 1.0 / f], [1.0, 1.0, 1.0 / f], [f, f, 1.0]])
        R = scipy.spatial.transform.Rotation.from_matrix(nearest_rotation(A * np.sign(np.linalg.det(A))))
        starts.append(np.array([np.log(f), 0.0, 0.0, *R.as_rotvec()]))
    costs = [float(np.sum(residuals(start) ** 2)) for start in starts]
    rss = float(np.sum(homography_sampson_residuals(H, xy1, xy2) ** 2))
    constraints, degrees = 2, 2 * len(xy1) - 8
    quantile = float(scipy.special.fdtri(constraints, degrees, 1.0 - ROTATION_RISK))
    limit = constraints * quantile * max(rss, 1e-24) / degrees
    ratio = np.inf
    for k in np.argsort(costs, kind="stable")[:3]:
        if np.isfinite(costs[k]):
            found = minimize_residuals(residuals, starts[k], max_iterations=50, tolerance=1e-8)
            ratio = min(ratio, (2.0 * found.cost - rss) / limit)
        if ratio <= 1.0:
            break
    return ratio


class Configuration(Enum):
    """Model that explains the matches of a pair."""

    GENERAL = "general"
    PLANE = "plane"
    ROTATION = "pure rotation"
    TRANSLATION = "pure translation"


def classify_configuration(F: F64, xy1: F64, xy2: F64, *, inliers: B8 | None = None) -> Configuration:
    """Determine which model explains at least 12 inliers of F (GENERAL: relief and baseline exceed noise).

    Model selection by tests, not by penalties as in GRIC (Torr 1998). Both images are assumed to share their
    intrinsics (else a rotation is a plane and a translation general) and to have square pixels.
    """
    xy1, xy2 = _matches.check_matches(xy1, xy2, needed=MINIMUM)
    inliers = np.ones(len(xy1), dtype=bool) if inliers is None else inliers
    if inliers.shape != (len(xy1),):
        raise ValueError(f"classify_configuration got {inliers.shape} inlier flags for {len(xy1)} matches")
    _matches.check_matches(xy1[inliers], xy2[inliers], needed=MINIMUM)
    # One centre for both images keeps F of a translation skew-symmetric and the eigenvalues of a rotation.
    own = PairFrame.of(xy1[inliers], xy2[inliers])
    centre = 0.5 * (own.centroid1 + own.centroid2)
    frame = PairFrame(centre, centre, own.scale)
    points, f = frame.points(xy1, xy2), _matches.check_start(F, frame)
    refine(f, points[inliers], SAMPSON, np.inf, _scale(f, points[inliers]) * 3.0, 15, None)
    sigma = _scale(f, points[inliers])
    agree = np.asarray(sampson_distances(f, points)) < BAND * sigma
    chance = _matches.chance_of_agreement(xy1, xy2, BAND * sigma / frame.scale)
    return _classify(_InlierData(f, points, agree, _matches.multiplicity_weights(xy1, xy2), sigma, chance))


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
        # The F of a plane is also fitted to wrong matches, which therefore agree twice as often.
        chance = 2.0 * self.chance if free == EPIPOLE else self.chance
        return log10_false_alarms(float(agreeing), float(tried), chance=chance, free=free)


def _scale(f: F64, points: F64) -> float:
    r = np.asarray(sampson_distances(f, points))
    return max(trimmed_noise_scale(r, _matches.noise_scale(r)), 1e-12)


def _classify(case: _InlierData) -> Configuration:
    rng = np.random.default_rng(0)
    plane = homography.find_dominant_plane(case.f, case.points, case.agree, sigma=case.sigma, rng=rng)
    if plane is not None:
        H, squared = plane[0], plane[1] * case.sigma**2
        # Noise from the squared distances, chi-square(2), with outliers.
        variance = float(np.median(squared[case.agree])) / 1.386294
        for _ in range(3):
            inside = squared[case.agree & (squared < NEAR * variance)]
            if len(inside) < MINIMUM:
                break
            variance = float(inside.sum()) / (2.0 * 0.97743 * (len(inside) - 4))
        noise = float(np.sqrt(max(variance, 1e-24)))
        near, far = squared < NEAR * noise**2, squared > FAR * noise**2
        # Standard errors by which the squared parallax of the matches near the plane exceeds the noise: of
        # the residuals, 2 K - 8 of a homography and K - 7 of F, K - 1 lie along the epipolar lines.
        k, errors = int(near.sum()), np.inf
        if k >= MINIMUM - 4:
            across = _least_squares(case.f, case.points[near])
            ratio = max(float(squared[near].sum()) - across, 1e-24) / (k - 1) * (k - 7) / max(across, 1e-24)
            errors = float(np.log(ratio) / np.sqrt(2.0 / (k - 1) + 2.0 / (k - 7)))
        # For a plane F fits the epipole to the noise, which makes the excess 1.5 +- 1 standard errors.
        if errors < 4.0 and case.false_alarms(far, EPIPOLE) > MAX_CHANCE:
            inliers = case.points[near]
            # Least squares of all of them, for which the covariance holds.
            H = homography.refine_plane(H, inliers, 1e6 * noise, 4)
            # Student's limit, since the noise is estimated.
            limit = float(scipy.special.stdtrit(len(inliers) - 7, 1.0 - ROTATION_RISK))
            rotation = (
                _eigenvalue_errors(H, homography.plane_covariance(H, inliers, noise)) < limit
                and _rotation_test(H, inliers[:, :2], inliers[:, 2:]) <= 1.0
            )
            return Configuration.ROTATION if rotation else Configuration.PLANE
    return Configuration.TRANSLATION if _translation_ratio(case) <= 1.0 else Configuration.GENERAL


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
    near = case.points[simple < 3.3 * case.sigma]
    degrees = len(near) - 7
    if degrees < MINIMUM - 7:
        return float("inf")
    # Both models use the same matches: to take those that F fits best would favour F.
    _refine_translation(f, near, np.inf)
    rss_simple = float(np.sum(np.asarray(sampson_distances(f, near)) ** 2))
    rss = min(rss_simple, *(_least_squares(start, near) for start in (case.f, f)))
    # A pure translation is rejected with a probability of 2e-3 for normal residuals.
    quantile = float(scipy.special.fdtri(BEYOND_TRANSLATION, degrees, 1.0 - 2e-3))
    limit = BEYOND_TRANSLATION * quantile * max(rss / degrees, 1e-24)
    strays = case.chance * float(case.weights[~case.agree].sum())
    # Wrong matches in the band bias F.
    return (rss_simple - rss) / (limit * (1.0 + 0.4 * min(strays, 1.0)))


def _least_squares(f: F64, points: F64) -> float:
    f = f.copy()
    refine(f, points, SAMPSON, np.inf, UNBOUNDED, CORRECTIONS, None)
    return float(np.sum(np.asarray(sampson_distances(f, points)) ** 2))


def _fit_translation(points: F64, sigma: float) -> F64:
    """[e]x (9,) of most points: from pairs of them, then from all within a shrinking gate."""
    rng = np.random.default_rng(len(points))
    some = points[rng.permutation(len(points))[:200]]
    pairs = rng.integers(0, len(some), (100, 2))
    weights = np.ones((1, len(some)))
    F, _, found = homography.fundamentals_of_plane(np.eye(3), some, weights, pairs, 4.0 * BAND * sigma)
    f: F64 = F[int(np.argmax(found[:, 0]))].copy()
    for gate in (4.0, 2.0, 1.5):
        _refine_translation(f, points, gate * 4.0 * sigma)
    return f


def _refine_translation(f: F64, points: F64, gate: float) -> None:
    """Minimise the Sampson distances of [e]x (9,) within the gate, in place, by Gauss-Newton."""
    e = np.array([f[7], f[2], f[3]])
    kept = points[np.asarray(sampson_distances(f, points)) < gate]
    if len(kept) < 5 or not np.linalg.norm(e) > 1e-12:
        return
    G, h = np.empty((9, 9)), np.empty(9)
    by_e = cross_matrix(np.eye(3)).reshape(3, 9) / np.sqrt(2.0)
    for _ in range(CORRECTIONS):
        e /= np.linalg.norm(e)
        normal_equations(e @ by_e, kept, SAMPSON, np.inf, UNBOUNDED, G, h)
        # The length of e has no effect on the distances: e e' fixes it.
        normal = by_e @ G @ by_e.T
        step = solve_positive(normal + np.trace(normal) * np.outer(e, e), -by_e @ h)
        if step is None:
            break
        e += step
        if step @ step < 1e-20:
            break
    f[:] = e / np.linalg.norm(e) @ by_e


@dataclass(frozen=True)
class PairVerification:
    """Keep the matches that agree with F; accept the pair if their number and their ratio are large enough.

    A wrong F on a repetitive facade has about 30 inliers and a small inlier ratio; a right one has more. A
    plane or a pure rotation gives good tracks and an undetermined F: the pair is accepted, and its
    ``configuration``, ``degeneracy`` and ``homography_inlier_ratio`` report it.
    """

    min_inliers: int = 60  #: minimum number of verified matches, at least 8

    min_inlier_ratio = 0.25  # minimum fraction of the matches that are verified
    homography_px = 2.0  # distance within which a homography explains a match, or 4.3 sigma if that is more

    def __post_init__(self) -> None:
        require_range(self, min_inliers="[8, inf)")

    def verify(self, matches: Matches, fit: FundamentalFit, rng: np.random.Generator) -> TwoView:
        """See `thesisrecon.config.Verifier.verify`."""
        inliers = fit.inliers
        if inliers.shape != (len(matches.xy1),):
            raise ValueError(f"the fit has {inliers.shape} inlier flags for {len(matches.xy1)} matches")
        xy1, xy2 = matches.xy1[inliers], matches.xy2[inliers]
        # 99 % of a plane's matches: sqrt(chi-square(2)) = 3.03, times sqrt(2) for noise in both images.
        tolerance = max(self.homography_px, 4.3 * fit.sigma_px)
        ratio = homography_inlier_ratio(fit.F, xy1, xy2, tolerance_px=tolerance, rng=rng)
        reason, of_all = "", counted(len(inliers), "match")
        if len(xy1) < self.min_inliers:
            reason = Notice("few-inliers", len(xy1), of_all, self.min_inliers)
        elif len(xy1) < self.min_inlier_ratio * len(inliers):
            found, least = 100.0 * len(xy1) / len(inliers), 100.0 * self.min_inlier_ratio
            reason = Notice("low-inlier-ratio", found, of_all, least)
        configuration, degeneracy = _assess_pair(matches, fit, rng)
        return TwoView(
            i=matches.i, j=matches.j, F=fit.F, sigma_px=fit.sigma_px, index1=matches.index1[inliers],
            index2=matches.index2[inliers], xy1=xy1, xy2=xy2, affine=matches.affine[inliers],
            candidates=len(inliers), homography_inlier_ratio=ratio, accepted=not reason, reason=reason,
            configuration=configuration, degeneracy=degeneracy,
        )  # fmt: skip


def _assess_pair(
    matches: Matches, fit: FundamentalFit, rng: np.random.Generator
) -> tuple[str, DegeneracyReport | None]:
    """Configuration and degeneracy report of a pair; ("", None) below 12 inliers."""
    if fit.inliers.sum() < MINIMUM:
        return "", None
    try:
        kind = classify_configuration(fit.F, matches.xy1, matches.xy2, inliers=fit.inliers)
        degeneracy = assess_degeneracy(fit, matches.xy1, matches.xy2, rng=rng)
    except StageFailure:
        return "", None
    if kind in (Configuration.PLANE, Configuration.ROTATION):
        reason = Notice("one-homography", kind.value)
        degeneracy = replace(degeneracy, determined=False, reasons=(reason, *degeneracy.reasons))
    return kind.value, degeneracy


def homography_inlier_ratio(
    F: F64, xy1: F64, xy2: F64, *, tolerance_px: float, rng: np.random.Generator
) -> float:
    """The largest fraction of the matches (N, 2) of F that one homography maps to within ``tolerance_px``."""
    # The best of 200 planes through three matches, fitted again to its inliers; 1 for fewer than 5 matches.
    n = len(xy1)
    if n < 5:
        return 1.0
    chosen = rng.permutation(n)[: homography.SUBSET]
    # A plane with a quarter of the matches is found with 96 %.
    triples = np.argsort(rng.random((200, min(len(chosen), 50))), axis=1)[:, :3]
    offsets = rng.integers(0, len(chosen), (200, 1))
    triples = chosen[(triples + offsets) % len(chosen)]
    smallest_area = 1e-4 * float(np.ptp(xy1, axis=0).max()) ** 2
    planes = homography.induced_homographies(
        unit_norm(F), epipoles(F)[1], np.hstack([xy1, xy2]), triples, smallest_area
    )
    moved = dehomogenize(homogenize(xy1[chosen]) @ planes.swapaxes(1, 2))
    counts = (np.sum((moved - xy2[chosen]) ** 2, axis=2) < tolerance_px**2).sum(axis=1)
    H = planes[counts.argmax()] if len(planes) else np.eye(3)
    inside = homography_residuals(H, xy1, xy2) < tolerance_px
    for _ in range(5):
        points1, points2 = xy1[inside], xy2[inside]
        if len(points1) < 5 or not (np.ptp(points1, axis=0).any() and np.ptp(points2, axis=0).any()):
            break
        again = homography_residuals(homography_linear(points1, points2), xy1, xy2) < tolerance_px
        if again.sum() <= inside.sum():
            break
        inside = again
    return float(inside.mean())
