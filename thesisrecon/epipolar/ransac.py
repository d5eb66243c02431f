"""Sections 5.2 and 5.4: F from linear equations, and RANSAC (Algorithm 2)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import B8, F64
from thesisrecon.epipolar._matches import MIN_PX, PairFrame, as_matches, check_matches, noise_scale
from thesisrecon.epipolar._sampling import sampson_distances
from thesisrecon.epipolar.refinement import Criterion, fundamental_covariance, refine_fundamental
from thesisrecon.errors import StageFailure, require_range, unknown_word
from thesisrecon.geometry import two_view
from thesisrecon.geometry.homogeneous import homogenize, normalizing_transform, unit_norm
from thesisrecon.optimize.ransac import draw_samples, watched
from thesisrecon.records import FundamentalFit


def estimate_eight_point(xy1: F64, xy2: F64, *, normalized: bool = True, rank_two: bool = True) -> F64:
    """F of unit norm from at least eight matches (N, 2) by the eight-point algorithm (5.2).

    Minimises the algebraic residuals x2' F x1 over unit vectors. ``normalized``: with Hartley's normalisation
    (PAMI 19, 1997); the thesis uses raw pixels, which weight the entries of F unequally. ``rank_two``: the
    nearest singular matrix in the frame of the solution; the thesis does not enforce it.
    """
    xy1, xy2 = check_matches(xy1, xy2, needed=8)
    T1 = normalizing_transform(xy1) if normalized else np.eye(3)
    T2 = normalizing_transform(xy2) if normalized else np.eye(3)
    x1, x2 = homogenize(xy1) @ T1.T, homogenize(xy2) @ T2.T
    A = (x2[:, :, None] * x1[:, None, :]).reshape(len(x1), 9)
    # The triangular factor has the singular values and right vectors of all rows, and nine rows.
    _, s, Vt = np.linalg.svd(np.linalg.qr(A, mode="r"))
    if not s[7] > (1e-12 if normalized else 1e-16) * s[0]:
        raise StageFailure.of("undetermined-fundamental", len(xy1))
    F = Vt[8].reshape(3, 3)
    return unit_norm(T2.T @ (two_view.enforce_rank_two(F) if rank_two else F) @ T1)


def estimate_seven_point(xy1: F64, xy2: F64) -> F64:
    """All unit F (0 to 3, 3, 3) of exactly seven matches (HZ, section 11.1.2), also the thesis' F1 - F2."""
    xy1, xy2 = as_matches(xy1, xy2)
    if xy1.shape != (7, 2):
        raise ValueError(f"the seven-point algorithm needs two (7, 2) arrays; got {xy1.shape}, {xy2.shape}")
    if not min(np.ptp(xy1, axis=0).max(), np.ptp(xy2, axis=0).max()) > MIN_PX:
        return np.empty((0, 3, 3))
    frame = PairFrame.of(xy1, xy2)
    solutions = seven_point(frame.points(xy1, xy2)[None])[0]
    return np.array([frame.matrix_in_pixels(f) for f in solutions]).reshape(-1, 3, 3)


def seven_point(points: F64) -> list[F64]:
    """Unit F (0 to 3, 9) of each sample (B, 7, 4) in a frame; QR gives the null space of (5.1)."""
    x1, x2 = homogenize(points[..., :2]), homogenize(points[..., 2:])
    A = (x2[..., :, None] * x1[..., None, :]).reshape(-1, 7, 9)
    Q, R = np.linalg.qr(A.swapaxes(1, 2), mode="complete")
    found = singular_members(Q[:, :, 7:].swapaxes(1, 2))
    dependent = np.abs(np.diagonal(R, axis1=1, axis2=2)).min(axis=1) < 1e-9
    return [F[:0] if none else F for F, none in zip(found, dependent, strict=True)]


def singular_members(pencils: F64) -> list[F64]:
    """The unit members (0 to 3, 9) with determinant 0 of each of the pencils (B, 2, 9).

    The determinant is a cubic of the pencil coordinates. The direction of four with the largest one becomes
    the first basis vector: the leading coefficient is never small and no solution is lost at infinity.
    """
    half = np.sqrt(0.5)
    directions = np.array([[1.0, 0.0], [0.0, 1.0], [half, half], [half, -half]])
    sizes = np.abs(np.linalg.det((directions @ pencils).reshape(-1, 4, 3, 3)))
    c, s = directions[sizes.argmax(axis=1)].T[..., None]
    first, second = c * pencils[:, 0] + s * pencils[:, 1], c * pencils[:, 1] - s * pencils[:, 0]
    some = np.stack([first, second, second + first, second - first], axis=1)
    c3, c0, plus, minus = np.linalg.det(some.reshape(-1, 4, 3, 3)).T
    singular = sizes.max(axis=1) < 1e-14
    # det(x first + second) = c3 x^3 + c2 x^2 + c1 x + c0.
    cubic = np.stack([0.5 * (plus + minus) - c0, 0.5 * (plus - minus) - c3, c0], axis=1)
    companion = np.eye(3, k=-1) * np.ones((len(pencils), 1, 1))
    companion[:, 0] = -cubic / np.where(singular, 1.0, c3)[:, None]
    found = []
    for k, roots in enumerate(np.linalg.eigvals(companion)):
        x = distinct_real_roots(roots)[: 0 if singular[k] else 3, None]
        found.append((x * first[k] + second[k]) / np.sqrt(1.0 + x**2))
    return found


def distinct_real_roots(roots: F64) -> F64:
    """The real roots of a cubic, the middle one first, a double one (split by rounding) once and last."""
    real = np.sort(roots.real[np.abs(roots.imag) <= 1e-6 * (1.0 + np.abs(roots))])
    if len(real) < 3:
        return real[:1]
    equal = np.diff(real) <= 2e-6 * (1.0 + np.abs(real[:2]))
    if equal.all():
        return real[1:2]
    if equal.any():
        k = int(equal.argmax())
        return np.array([real[2 - 2 * k], real[k : k + 2].mean()])
    return real[[1, 0, 2]]


# 95 % quantiles of the chi-square distribution with one and two degrees of freedom.
CHI2_1_95, CHI2_2_95 = 3.841458820694124, 5.991464547107979
MINIMUM = 8
_BATCH = 50  # samples solved at once


class _InlierTest(NamedTuple):
    """Distances (N,), their ratio to Sampson's for images of equal weight, squared limit in variances."""

    distances: Callable[[F64, F64, F64], F64]
    ratio: float
    limit: float


InlierTest = Literal["sampson", "epipolar-distance", "symmetric-distance"]
INLIER_TESTS = {
    # Chi-square with one degree of freedom: 95 % of the right matches pass.
    "sampson": _InlierTest(two_view.sampson_residuals, 1.0, CHI2_1_95),
    # First test of section 5.4: both points within 1.96 sigma_d of their epipolar lines, sigma_d = sqrt(2)
    # sigma. If the images have equal weight the distances are equal: the test by the Sampson distance.
    "epipolar-distance": _InlierTest(
        lambda *args: np.asarray(two_view.epipolar_distances(*args).max(axis=1)), 2.0**0.5, 2.0 * CHI2_1_95
    ),
    # Second test of section 5.4: sum of both squared epipolar distances below 5.99 sigma_d^2. Both are
    # multiples of one residual, so the sum is 2 sigma_d^2 times a chi-square of one degree of freedom, not of
    # two: 92 % of the right matches pass, not the 95 % of the thesis.
    "symmetric-distance": _InlierTest(two_view.symmetric_residuals, 2.0, 2.0 * CHI2_2_95),
}


def discard_outliers(
    F: F64, xy1: F64, xy2: F64, *, limit_px: float = np.inf, test: InlierTest = "sampson"
) -> tuple[float, B8]:
    """Return the noise, from the median distance within ``limit_px``, and the matches (N,) that pass.

    sigma = 1.4826 (1 + 5 / (n - 7)) median |d| over at least 8 matches; the thesis divides by Phi(0.75) where
    Phi^-1(0.75) is meant. Without a limit sigma is too large if more than half of the matches are wrong.
    """
    distances, ratio, most = INLIER_TESTS[test]
    residuals = np.abs(distances(F, xy1, xy2))
    limit = max(ratio * limit_px, float(np.partition(residuals, MINIMUM - 1)[MINIMUM - 1]))
    sigma = noise_scale(residuals[residuals <= limit]) / ratio
    # Residuals below 1e-6 px are rounding errors, not noise.
    inliers = residuals**2 <= max(most * sigma**2, 1e-12)
    return sigma, inliers if inliers.sum() >= MINIMUM else residuals <= limit


@dataclass(frozen=True)
class ThesisRansac:
    """RANSAC as in section 5.4 of the thesis, with its errors corrected.

    Draw samples of seven, keep the F with the most inliers, estimate sigma from the median distance, discard
    outliers, then refine and discard again ``rounds`` times.

    Differences from the thesis: the search counts inliers within a fixed threshold, since the fraction within
    a multiple of the median is the same for every F; the refinement uses the orthonormal representation,
    which reaches every epipole.
    """

    threshold_px: float = 1.0  #: Sampson distance of an inlier during the search
    samples: int = 1000  #: maximum number of samples
    epipolar_distance: bool = False
    """Minimise the distances to epipolar lines (5.6) in the refinement instead of Sampson's (5.4)."""
    rounds: int = 2  #: rounds of refinement
    inlier_test: InlierTest = "sampson"  #: the default, or the first or second test of section 5.4

    stop_inlier_ratio = 0.95  # inlier ratio at which sampling stops

    def __post_init__(self) -> None:
        require_range(self, threshold_px="(0, inf)", samples="[1, inf)", rounds="[0, inf)")
        if self.inlier_test not in INLIER_TESTS:
            raise ValueError(unknown_word("inlier_test", self.inlier_test, INLIER_TESTS))

    def estimate(self, xy1: F64, xy2: F64, rng: Generator) -> FundamentalFit:
        """See `thesisrecon.config.FundamentalEstimator.estimate`."""
        xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
        frame, test = PairFrame.of(xy1, xy2), INLIER_TESTS[self.inlier_test]
        points = frame.points(xy1, xy2)

        def distances(model: F64) -> F64:
            if self.inlier_test == "sampson":
                return np.asarray(sampson_distances(np.ascontiguousarray(model), points))
            return test.distances(model.reshape(3, 3), points[:, :2], points[:, 2:])

        gate, enough = test.ratio * self.threshold_px * frame.scale, self.stop_inlier_ratio * len(points)
        f, inliers, drawn = _search(points, distances, gate, self.samples, enough, rng)
        if f is None or inliers.sum() < MINIMUM:
            found = f"none of {self.samples} samples has {MINIMUM} inliers among {len(xy1)} matches"
            raise StageFailure.of("no-epipolar-geometry", found)
        discard = partial(discard_outliers, limit_px=self.threshold_px, test=self.inlier_test)
        F = frame.matrix_in_pixels(f)
        sigma, inliers = discard(F, xy1, xy2)
        criterion: Criterion = "epipolar-distance" if self.epipolar_distance else "sampson"
        for _ in range(self.rounds):
            F = refine_fundamental(F, xy1[inliers], xy2[inliers], criterion)
            sigma, inliers = discard(F, xy1, xy2)
        of_frame, noise = frame.matrix_in_frame(F), sigma * frame.scale
        covariance = fundamental_covariance(frame, of_frame, points[inliers], noise)
        return FundamentalFit(F, inliers, sigma, covariance, drawn)


def _search(
    points: F64, distances: Callable[[F64], F64], gate: float, samples: int, enough: float, rng: Generator
) -> tuple[F64 | None, B8, int]:
    """Algorithm 2: F (9,) of seven points with the most of them within the gate, these, and the samples."""
    # Of equal numbers the lower standard deviation decides (Fischler and Bolles, 1981). More than `enough`
    # inliers end the search. The thesis' text has n! / s! samples of size s where n! / (s! (n - s)!) is
    # meant.
    best, inliers, best_rank, drawn = None, np.zeros(len(points), dtype=bool), (-np.inf, 0.0), 0
    while drawn < samples and best_rank[0] <= enough:
        if drawn % _BATCH == 0:
            solved = seven_point(points[draw_samples(rng, _BATCH, len(points), 7)])
        for model in solved[drawn % _BATCH]:
            r = np.abs(distances(model))
            inside = r < gate
            rms = float(np.sqrt(np.mean(r[inside] ** 2))) if inside.any() else 0.0
            rank = (float(inside.sum()), -rms)
            if rank > best_rank:
                best, inliers, best_rank = model, inside, rank
                watched(drawn + 1, 1.0 - inside.mean(), inside.mean(), model)
        drawn += 1
    watched(drawn, 0.0, 0.0, best, ends=True)
    return best, inliers, drawn


def fit_all(xy1: F64, xy2: F64, *, refined: bool) -> FundamentalFit:
    """Estimate F from all matches; arguments as for :func:`thesisrecon.estimate_fundamental`."""
    xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
    F = estimate_eight_point(xy1, xy2)
    F = refine_fundamental(F, xy1, xy2, "reprojection") if refined else F
    sigma, inliers = discard_outliers(F, xy1, xy2)
    frame = PairFrame.of(xy1, xy2)
    points = frame.points(xy1[inliers], xy2[inliers])
    covariance = fundamental_covariance(frame, frame.matrix_in_frame(F), points, sigma * frame.scale)
    return FundamentalFit(F, inliers, sigma, covariance)


def fit_seven(xy1: F64, xy2: F64) -> FundamentalFit:
    """Estimate F of seven matches; see :func:`thesisrecon.estimate_fundamental`."""
    solutions = estimate_seven_point(xy1, xy2)
    if not len(solutions):
        raise StageFailure.of("dependent-seven-matches")
    every = np.ones(len(xy1), dtype=bool)
    return FundamentalFit(solutions[0], every, np.nan, np.full((9, 9), np.nan), 0, solutions[1:])
