"""Checks of matches, their coordinate frame, and section 5.4: the noise among wrong residuals.

Also how many matches agree with a wrong model by chance.
"""

import math
from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64, checked
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import unit_norm
from thesisrecon.optimize.least_squares import MAD_FACTOR

# Ratio of the spread across to the spread along the main direction below which points count as collinear.
COLLINEAR = 1e-9
# Above the first a double has no fraction of a pixel left; below the second fourth powers underflow.
MAX_PX, MIN_PX = 1e15, 1e-50


def as_matches(xy1: F64, xy2: F64) -> tuple[F64, F64]:
    """Matches as contiguous float64 arrays (N, 2); ValueError if shapes or coordinates are impossible."""
    xy1, xy2 = checked("a fundamental matrix", xy1=(xy1, ("N", 2)), xy2=(xy2, ("N", 2)))
    if max(np.abs(xy1).max(initial=0.0), np.abs(xy2).max(initial=0.0)) > MAX_PX:
        raise ValueError(
            f"a fundamental matrix needs pixel coordinates of images; some are beyond {MAX_PX:g}"
        )
    return xy1, xy2


def check_matches(xy1: F64, xy2: F64, *, needed: int) -> tuple[F64, F64]:
    """As :func:`as_matches`; StageFailure if the matches are too few, equal or collinear."""
    xy1, xy2 = as_matches(xy1, xy2)
    if len(xy1) < needed:
        raise StageFailure.of("few-matches", len(xy1), needed)
    for name, xy in (("first", xy1), ("second", xy2)):
        spread = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)
        length = max(float(spread[0]), 1e-3 * float(np.abs(xy).max()))
        if not spread[1] > max(COLLINEAR * length, MIN_PX):
            raise StageFailure.of("collinear-matches", name, len(xy), spread[1] / np.sqrt(len(xy)))
    return xy1, xy2


@dataclass(frozen=True)
class PairFrame:
    """Coordinates about the centroids; one common scale keeps Sampson distances proportional to pixels."""

    centroid1: F64
    centroid2: F64
    scale: float

    @classmethod
    def of(cls, xy1: F64, xy2: F64) -> "PairFrame":
        """The frame in which the mean squared coordinate over both images is 1."""
        c1, c2 = xy1.sum(axis=0) / len(xy1), xy2.sum(axis=0) / len(xy2)
        d1, d2 = (xy1 - c1).ravel(), (xy2 - c2).ravel()
        return cls(c1, c2, 1.0 / float(np.sqrt((d1 @ d1 + d2 @ d2) / (4.0 * len(xy1)))))

    def points(self, xy1: F64, xy2: F64) -> F64:
        """Matches in the frame: rows (x1, y1, x2, y2)."""
        points = np.empty((len(xy1), 4))
        points[:, :2] = xy1 - self.centroid1
        points[:, 2:] = xy2 - self.centroid2
        points *= self.scale
        return points

    @property
    def to_pixels(self) -> F64:
        """Matrix (9, 9) that converts vec(F) from the frame to pixels, up to scale."""
        T1, T2 = self.transforms
        return np.asarray(np.kron(T2.T, T1.T), dtype=np.float64)

    @property
    def homography_to_pixels(self) -> F64:
        """Matrix (9, 9) that converts vec(H) of a homography from the frame to pixels."""
        T1, T2 = self.transforms
        return np.asarray(np.kron(np.linalg.inv(T2), T1.T))

    def matrix_in_pixels(self, f: F64) -> F64:
        """F (3, 3) in pixels, unit norm, of F (9,) in the frame."""
        T1, T2 = self.transforms
        return unit_norm(T2.T @ f.reshape(3, 3) @ T1)

    def matrix_in_frame(self, F: F64) -> F64:
        """F (9,) in the frame, unit norm, of F (3, 3) in pixels."""
        T1, T2 = self.transforms
        return np.ascontiguousarray(unit_norm(np.linalg.inv(T2).T @ F @ np.linalg.inv(T1)).ravel())

    @property
    def transforms(self) -> tuple[F64, F64]:
        """Similarities (3, 3) of both images from pixels to the frame."""
        s, (x1, y1), (x2, y2) = self.scale, self.centroid1, self.centroid2
        first = np.array([[s, 0.0, -s * x1], [0.0, s, -s * y1], [0.0, 0.0, 1.0]])
        return first, np.array([[s, 0.0, -s * x2], [0.0, s, -s * y2], [0.0, 0.0, 1.0]])


def check_start(F: F64, frame: PairFrame) -> F64:
    """The start of a refinement in the frame (9,); a ValueError unless it has rank 2 or 3."""
    F = np.asarray(F, dtype=np.float64)
    if F.shape != (3, 3) or not np.isfinite(F).all():
        raise ValueError(f"the refinement starts from a finite (3, 3) matrix of rank 2 or 3; got {F.shape}")
    f = frame.matrix_in_frame(F)
    if np.linalg.matrix_rank(f.reshape(3, 3)) < 2:
        raise ValueError("the refinement starts from a finite (3, 3) matrix of rank 2 or 3; got a lower rank")
    return f


TAIL = 4.0  # standard deviation of the noise's tail relative to the noise


def _fit_mixture(residuals: F64, parameters: float, spread: float, rounds: int, mixture: F64) -> float:
    """Fit three zero-mean normals by expectation-maximisation; return the mean log-likelihood."""
    # `mixture` (5,), updated: sigma, standard deviation of wrong residuals (prior `spread`), fractions of
    # noise, its tail and wrong residuals. The prior counts one residual of either and half a one of the tail.
    squares, prior, likelihood = residuals**2, np.array([1.0, 0.5, 1.0]), 0.0
    for _ in range(rounds):
        sigma, wide, *fractions = mixture
        std = np.array([sigma, TAIL * sigma, wide])
        p = (fractions / std)[:, None] * np.exp(squares * (-0.5 / std**2)[:, None])
        total = p.sum(axis=0) + 1e-300
        likelihood = float(np.log(total).mean())
        p /= total
        counts, sums = p.sum(axis=1), p @ squares
        noise = (sums[0] + sums[1] / TAIL**2) / max(counts[0] + counts[1] - parameters, 1.0)
        mixture[0] = np.sqrt(noise) + 1e-12 * spread
        wide = np.sqrt((sums[2] + prior[2] * spread**2) / (counts[2] + prior[2]))
        # Wrong residuals are at least twelve times as wide as the noise.
        mixture[1] = max(wide, 12.0 * mixture[0])
        mixture[2:] = (counts + prior) / (len(residuals) + prior.sum())
    return likelihood


def _middle(ordered: F64) -> float:
    """Median of ascending values."""
    n = len(ordered)
    return float(0.5 * (ordered[(n - 1) // 2] + ordered[n // 2]))


def noise_scale(residuals: F64, *, parameters: int = 7) -> float:
    """1.4826 (1 + 5 / (n - p)) median |r|, for less than half wrong residuals (Rousseeuw and Leroy 1987)."""
    n, ordered = len(residuals), np.sort(np.abs(residuals))
    if n <= parameters or not np.isfinite(ordered[-1]):
        raise ValueError(f"noise_scale needs more than {parameters} finite residuals; got {n}")
    return float(MAD_FACTOR * (1.0 + 5.0 / (n - parameters)) * _middle(ordered))


def noise_width(residuals: F64, threshold: float, *, parameters: int = 7) -> float:
    """Width of the noise: ``threshold``, or more until the median is 0.22 of it, as within 3 sigma."""
    width, ordered = threshold, np.sort(residuals)
    for _ in range(7):
        n = int(np.searchsorted(ordered, width))
        if n <= parameters:
            return threshold
        if _middle(ordered[:n]) <= 0.22 * width * np.sqrt(1.0 - parameters / n):
            return width
        width *= 1.5
    return threshold


@dataclass(frozen=True)
class NoiseMixture:
    """Normal noise (``sigma``), its tail, four times as wide, wrong matches (``spread``), their fractions."""

    sigma: float
    spread: float
    core: float
    tail: float
    wrong: float
    log_likelihood: float

    @classmethod
    def fit(cls, residuals: F64, sigma: float, *, spread: float, parameters: int = 7) -> "NoiseMixture":
        """Fit to ascending residuals by expectation-maximisation; ``spread`` is the prior of wrong ones."""
        # At most 600 of them, evenly spaced in order.
        step = max(len(residuals) // 300, 1)
        some = np.ascontiguousarray(residuals[step // 2 :: step])
        share = float(np.count_nonzero(some < 3.0 * sigma)) / len(some)
        mixture = np.array([sigma, spread, 0.9 * share, 0.1 * share, 1.0 - share])
        likelihood = _fit_mixture(some, parameters / step, spread, 6, mixture)
        sigma, spread, core, tail, wrong = mixture.tolist()
        return cls(sigma, spread, core, tail, wrong, float(likelihood))

    @property
    def limit(self) -> float:
        """Residual at which noise, with its tail, and wrong matches are equally likely."""
        low, high = self.sigma, self.spread
        for _ in range(20):
            # Functions of single numbers: those of NumPy take ten times as long.
            middle = math.sqrt(low * high)
            noise = self.core * math.exp(-0.5 * (middle / self.sigma) ** 2)
            noise += self.tail / TAIL * math.exp(-0.5 * (middle / (TAIL * self.sigma)) ** 2)
            wrong = self.wrong / self.spread * math.exp(-0.5 * (middle / self.spread) ** 2)
            low, high = (middle, high) if noise > self.sigma * wrong else (low, middle)
        return low

    @property
    def core_limit(self) -> float:
        """Residual at which noise and its tail are equally likely."""
        odds = max(TAIL * self.core / self.tail, 1.5)
        return self.sigma * float(np.sqrt(2.0 * np.log(odds) / (1.0 - TAIL**-2)))


def multiplicity_weights(xy1: F64, xy2: F64) -> F64:
    """Weights (N,): one over the matches within 2 px in an image, of which at most one is right."""
    numbers = np.zeros(len(xy1), dtype=np.int64)
    for xy in (xy1, xy2):
        x, y = np.floor(xy / 2.0).astype(np.int64).T
        cell = x * 1_000_003 + y
        ordered = np.sort(cell)
        count = np.searchsorted(ordered, cell, "right") - np.searchsorted(ordered, cell, "left")
        numbers = np.maximum(numbers, count)
    return np.asarray(1.0 / numbers)


def chance_of_agreement(xy1: F64, xy2: F64, band_px: float) -> float:
    """Bound of the probability that a wrong match lies in the band of an F, of width 2 sqrt(2) band_px."""
    narrow = min(float(np.ptp(xy)) for xy in (*xy1.T, *xy2.T))
    return min(1.0, float(2.0 * np.sqrt(2.0) * band_px / max(narrow, 1e-300)))
