"""Section 5.5: do the matches determine F, or does another F explain them as well?

If most matches lie on one plane with homography H, every [e]x H explains them, and the epipole depends on the
few matches off the plane. A wrong F then has as many inliers as the right one. Four indicators are tested:
matches off the plane agree with F no more often than by chance; another epipole explains about as many; the
covariance of F is large; or the inliers off the plane lie among matches of the plane where no surface can be,
as matches between repeated windows of a facade do.

:mod:`thesisrecon.epipolar.configuration` answers a different question: which simpler model (plane, pure
rotation, pure translation) explains the matches within their noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numba import njit
from numpy.random import Generator
from numpy.typing import NDArray

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.epipolar.frame import PairFrame, check_matches
from thesisrecon.epipolar.planes import DominantPlane, find_dominant_plane, fundamentals_of_plane
from thesisrecon.epipolar.precision import epipolar_distance_std
from thesisrecon.epipolar.refinement import SAMPSON, refine
from thesisrecon.epipolar.sampling import sampson_distances
from thesisrecon.records import DegeneracyReport, FundamentalFit

# Matches within a cell of this size count as one place.
SAME_PX = 2.0
NEIGHBOURS = 5
# Epipoles tried and matches off the plane that each is scored on.
PAIRS, COMPETING_SUBSET = 300, 400
# Distinct models refined per ranking, chosen among the first of the ranking.
COMPETING, EXAMINED = 3, 100
# Quantile of the tried epipoles that gives the agreement by chance: most epipoles are wrong.
TYPICAL = 0.3
# Fraction of common matches above which two models count as one.
SAME_MODEL = 0.8
GATES, KNEE, STEPS = (2.4, 1.8, 1.2), 0.4, 5
# Bands of the first scoring: an F of two noisy matches and a local plane is inaccurate.
WIDE = 2.0
# Distances are truncated at this many bands, so that a single wrong match cannot dominate a comparison.
FAR = 20.0
MINIMUM = 8
BAND_SIGMAS, BAND_FLOOR_PX, SIGMA_FLOOR_PX = 2.5, 0.3, 0.1
# Maximum log10 of the false alarms of the matches off the plane.
MAX_CHANCE = -2.0
# Standard errors by which a competing model must be worse: right models of facades reach 7, wrong ones 2.
# Not a probability, since matches of repeated structure are dependent.
MIN_MARGIN = 3.0
# Smallest change, relative to the matches off the plane, that makes another model a competing one.
MIN_GAIN = 0.05
# Distance from epipolar lines that is relevant, px, or 2 sigma if that is larger.
MAX_ERROR_PX = 1.0
# Fraction of neighbours that contradict a match, maximum fraction of contradicted matches, and sample size.
CONTRADICTED, MAX_CONTRADICTED, SAMPLED = 0.3, 0.2, 60


@njit(cache=True, nogil=True)
def _select_distinct(
    order: I64, agree: F64, weights: F64, overlap: float, chosen: I64, count: int, most: int
) -> int:
    """Add models of ``order`` that share at most ``overlap`` of their weight with one chosen before.

    Starts with ``count`` chosen models, stops at ``most`` and returns their number.
    """
    for s in order:
        own = 0.0
        for k in range(len(weights)):
            own += weights[k] * agree[s, k]
        fresh = True
        for c in range(count):
            common = 0.0
            for k in range(len(weights)):
                common += weights[k] * agree[s, k] * agree[chosen[c], k]
            if common > overlap * own:
                fresh = False
                break
        if fresh:
            chosen[count] = s
            count += 1
            if count >= most:
                break
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _contradicted_ratios(h: F64, points: F64, on_plane: B8, chosen: I64, near: float) -> F64:
    """Fraction of the nearest neighbours of each chosen point that lie on the plane and contradict it.

    A neighbour contradicts if the parallax differs by more than the distance in image 1: two points of an
    opaque surface would change order. Points nearer than ``near`` are the same feature and do not count.
    """
    parallax = np.empty((len(points), 2))
    for k in range(len(points)):
        x1, y1 = points[k, 0], points[k, 1]
        w = h[6] * x1 + h[7] * y1 + h[8]
        parallax[k, 0] = points[k, 2] - (h[0] * x1 + h[1] * y1 + h[2]) / w
        parallax[k, 1] = points[k, 3] - (h[3] * x1 + h[4] * y1 + h[5]) / w
    ratios, nearest, which = np.zeros(len(chosen)), np.empty(NEIGHBOURS), np.empty(NEIGHBOURS, np.int64)
    for c in range(len(chosen)):
        k, found = chosen[c], 0
        for m in range(len(points)):
            squared = (points[m, 0] - points[k, 0]) ** 2 + (points[m, 1] - points[k, 1]) ** 2
            if squared < near * near or (found == NEIGHBOURS and squared >= nearest[found - 1]):
                continue
            place = min(found, NEIGHBOURS - 1)
            while place > 0 and nearest[place - 1] > squared:
                nearest[place], which[place] = nearest[place - 1], which[place - 1]
                place -= 1
            nearest[place], which[place] = squared, m
            found = min(found + 1, NEIGHBOURS)
        for n in range(found):
            m = which[n]
            apart = (parallax[m, 0] - parallax[k, 0]) ** 2 + (parallax[m, 1] - parallax[k, 1]) ** 2
            ratios[c] += 1.0 if on_plane[m] and apart > nearest[n] else 0.0
        ratios[c] /= max(found, 1)
    return ratios


def multiplicity_weights(xy1: F64, xy2: F64) -> F64:
    """Compute the weight of each match, one over the number of matches at its position.

    At most one of the matches at one position (within 2 px in either image) is right, and all of them agree
    with every F whose epipole lies there: together they count once.

    Parameters
    ----------
    xy1, xy2 : ndarray (N, 2)
        Matched points, px.

    Returns
    -------
    ndarray (N,)
        Weights in (0, 1].
    """
    return 1.0 / np.maximum(_matches_per_cell(xy1), _matches_per_cell(xy2))


def _matches_per_cell(xy: F64) -> F64:
    cell = np.floor(xy / SAME_PX).astype(np.int64)
    _, place, count = np.unique(cell[:, 0] * 1_000_003 + cell[:, 1], return_inverse=True, return_counts=True)
    return np.asarray(count[place], dtype=np.float64)


def log10_false_alarms(agreeing: float, tried: float, *, chance: float, free: int) -> float:
    """Compute log10 of the expected number of models with as many inliers among wrong matches.

    A-contrario bound (tried - free) C(tried, free) P(Binomial >= agreeing - free): the model passes through
    ``free`` matches and each of the rest agrees with probability ``chance``.

    Parameters
    ----------
    agreeing : float
        Weight of the matches that agree with the model.
    tried : float
        Weight of all matches.
    chance : float
        Probability that a wrong match agrees.
    free : int
        Number of matches that define the model.

    Returns
    -------
    float
        0 or more if that many are expected by chance.

    References
    ----------
    L. Moisan and B. Stival, "A probabilistic criterion to detect rigid point matches", IJCV 57, 2004.
    """
    rest, hits = tried - free, agreeing - free
    if hits <= 0.0 or rest <= 0.0:
        return 0.0
    tail = float(scipy.special.betainc(hits, max(rest - hits, 0.0) + 1.0, min(chance, 1.0)))
    ways = (
        scipy.special.gammaln(tried + 1.0)
        - scipy.special.gammaln(free + 1.0)
        - scipy.special.gammaln(rest + 1.0)
        + np.log(max(rest, 1.0))
    )
    return float((ways + np.log(max(tail, 1e-300))) / np.log(10.0))


def chance_of_agreement(xy1: F64, xy2: F64, band_px: float) -> float:
    """Compute the probability that a wrong match lies within a Sampson distance of any F.

    Area of a band of width 2 sqrt(2) band_px across the bounding box of the matches, relative to the box.

    Parameters
    ----------
    xy1, xy2 : ndarray (N, 2)
        Matched points, px.
    band_px : float
        Sampson distance.

    Returns
    -------
    float
        Probability in (0, 1].
    """
    narrow = min(float(np.ptp(xy)) for xy in (*xy1.T, *xy2.T))
    return min(1.0, float(2.0 * np.sqrt(2.0) * band_px / max(narrow, 1e-300)))


@dataclass(frozen=True)
class _CompetingModel:
    """Another F ``f`` (9,) and how it differs from the estimate.

    ``lost`` and ``gained`` are the weights of matches that only the estimate or only this F explains.
    ``error`` is the RMS distance of its inliers to the estimate, ``apart`` the smaller of that and the
    reverse, in frame units.
    """

    f: F64
    lost: float
    gained: float
    error: float
    apart: float

    @property
    def margin(self) -> float:
        """Standard errors by which the estimate explains more (McNemar's test)."""
        return (self.lost - self.gained) / float(np.sqrt(max(self.lost + self.gained, 1.0)))


def _find_competing_models(
    f: F64, points: F64, weights: F64, plane: DominantPlane, *, band: float, rng: Generator
) -> tuple[list[_CompetingModel], float]:
    """Competing models of ``f`` and the fraction of matches off the plane that a model explains by chance.

    [e]x H of the plane and two matches off it (Chum, Werner and Matas, CVPR 2005), right or wrong, is scored
    on all matches off the plane; the best distinct ones are refined on all ``points`` (N, 4). In half of the
    pairs one match agrees with ``f`` and the other does not, since a wrong F often shares most of its inliers
    with the right one. Matches have ``weights`` (N,) and agree within ``band``.
    """
    distances = np.asarray(sampson_distances(f, points))
    inside = distances < band
    off = np.flatnonzero(plane.off)
    if len(off) < 3:
        return [], 0.0
    off = off[rng.permutation(len(off))[:COMPETING_SUBSET]]
    w, own = weights[off], inside[off]
    F, agree, sums = fundamentals_of_plane(
        plane.h, points[off], np.stack([w, w * ~own]), _pairs(own, rng), WIDE * band
    )
    # The two matches that define a model always agree with it.
    beyond = np.maximum(sums[:, 0] - 2.0, 0.0) / max(float(w.sum()) - 2.0, 1.0)
    chance = float(np.quantile(beyond, TYPICAL)) / WIDE
    chosen, count = np.empty(2 * COMPETING, dtype=np.int64), 0
    for k, value in enumerate((sums[:, 0], sums[:, 0] + sums[:, 1])):
        order = np.argsort(-value, kind="stable")
        count = _select_distinct(order[:EXAMINED], agree, w, SAME_MODEL, chosen, count, (k + 1) * COMPETING)
    competing_models = [
        _competing_model(_refined(F[s], points, band), points, weights, (distances, inside), band)
        for s in chosen[:count]
    ]
    return competing_models, chance


def _pairs(inside: B8, rng: Generator) -> NDArray[np.int64]:
    pairs = rng.integers(0, len(inside), (PAIRS, 2))
    own, others = np.flatnonzero(inside), np.flatnonzero(~inside)
    if len(own) and len(others):
        half = PAIRS // 2
        pairs[:half, 0] = own[rng.integers(0, len(own), half)]
        pairs[:half, 1] = others[rng.integers(0, len(others), half)]
    return pairs


def _refined(f: F64, points: F64, band: float) -> F64:
    f = f.copy()
    for gate in GATES:
        refine(f, points, SAMPSON, gate * band, KNEE * gate * band, STEPS)
    return f


def _compare_competing_models(
    others: list[F64], f: F64, points: F64, weights: F64, *, band: float
) -> list[_CompetingModel]:
    """Other matrices (9,) as competing models of ``f``, each refined on all ``points`` (N, 4)."""
    distances = np.asarray(sampson_distances(f, points))
    found = (distances, distances < band)
    return [_competing_model(_refined(other, points, band), points, weights, found, band) for other in others]


def _competing_model(
    f: F64, points: F64, weights: F64, found: tuple[F64, B8], band: float
) -> _CompetingModel:
    distances, inside = found
    own = np.asarray(sampson_distances(f, points))
    agreeing = own < band
    lost, gained = weights[inside & ~agreeing].sum(), weights[agreeing & ~inside].sum()
    if not agreeing.any() or not inside.any():
        return _CompetingModel(f, float(lost), float(gained), np.inf, np.inf)
    error, back = (
        np.sqrt(np.mean(np.minimum(d, FAR * band) ** 2)) for d in (distances[agreeing], own[inside])
    )
    return _CompetingModel(f, float(lost), float(gained), float(error), float(min(error, back)))


@dataclass(frozen=True)
class _OffPlaneWeights:
    """Weights of matches off the plane: inliers of F, all, and contradicted inliers."""

    agreeing: float
    tried: float
    contradicted: float


def assess_degeneracy(fit: FundamentalFit, xy1: F64, xy2: F64, *, rng: Generator) -> DegeneracyReport:
    """Test whether the matches determine the fundamental matrix of a fit.

    F is undetermined if the inliers off the dominant plane are no more than expected by chance, if another F
    of that plane or of another search explains about as many matches (McNemar's test) at a relevant distance,
    if more than a fifth of the inliers off the plane are contradicted by neighbours on it, or if the
    covariance allows errors of the epipolar lines above a pixel. The F of a pure translation is determined.
    Wrong matches that are as coherent as a surface (a whole facade shifted by one window) cannot be detected.

    Parameters
    ----------
    fit : FundamentalFit
        The estimate.
    xy1, xy2 : array_like (N, 2)
        All matches with their outliers, N >= 8, px.
    rng : numpy.random.Generator
        Source of the samples.

    Returns
    -------
    DegeneracyReport
        Whether F is determined, with the evidence and the reasons if not.

    Raises
    ------
    ValueError
        If the inlier flags do not fit the matches, or as :func:`~thesisrecon.epipolar.frame.as_matches`.
    StageFailure
        As :func:`~thesisrecon.epipolar.frame.check_matches`.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import estimate_fundamental
    >>> rng = np.random.default_rng(0)
    >>> xy1 = rng.uniform(0, 500, (60, 2))
    >>> plane = xy1 + [40.0, 10.0] + rng.normal(0, 0.3, (60, 2))
    >>> assess_degeneracy(estimate_fundamental(xy1, plane), xy1, plane, rng=rng).determined
    False
    >>> relief = xy1 + np.array([[40.0, 10.0]]) / rng.uniform(1, 4, (60, 1)) + rng.normal(0, 0.3, (60, 2))
    >>> assess_degeneracy(estimate_fundamental(xy1, relief), xy1, relief, rng=rng).determined
    True
    """
    xy1, xy2 = check_matches(xy1, xy2, needed=MINIMUM)
    if fit.inliers.shape != (len(xy1),):
        raise ValueError(f"the fit has {fit.inliers.shape} inlier flags for {len(xy1)} matches")
    frame = PairFrame.of(xy1, xy2)
    points, f = frame.points(xy1, xy2), frame.matrix_in_frame(fit.F)
    sigma_px = max(fit.sigma_px, SIGMA_FLOOR_PX)
    band_px = max(BAND_SIGMAS * fit.sigma_px, BAND_FLOOR_PX)
    plane = find_dominant_plane(f, points, fit.inliers, sigma=sigma_px * frame.scale, rng=rng)
    error_px = _expected_error(fit, xy1, xy2)
    if plane is None:
        return DegeneracyReport(False, ("F has too few inliers",), expected_error_px=error_px)
    weights = multiplicity_weights(xy1, xy2)
    competing_models, by_model_chance = _find_competing_models(
        f, points, weights, plane, band=band_px * frame.scale, rng=rng
    )
    starts = [frame.matrix_in_frame(F) for F in fit.competing_models]
    competing_models += _compare_competing_models(starts, f, points, weights, band=band_px * frame.scale)
    support = _support(points, fit.inliers, weights, plane, 2.0 * sigma_px * frame.scale)
    by_chance = chance_of_agreement(xy1, xy2, band_px)
    chance = log10_false_alarms(
        support.agreeing - support.contradicted,
        support.tried,
        chance=max(by_model_chance, by_chance),
        free=2,
    )
    relevant_px = max(MAX_ERROR_PX, 2.0 * fit.sigma_px)
    least = _least_gain(support, by_chance)
    different = [r for r in competing_models if r.gained >= least and _differs(r, relevant_px * frame.scale)]
    other = min(different, key=lambda r: r.margin, default=None)
    return DegeneracyReport(
        determined=not (reasons := tuple(_reasons(support, chance, other, error_px, relevant_px))),
        reasons=reasons,
        off_plane=support.agreeing,
        contradicted=support.contradicted,
        log10_false_alarms=chance,
        competing_margin=other.margin if other is not None else float("inf"),
        competing_model=frame.matrix_in_pixels(other.f) if other is not None else None,
        expected_error_px=error_px,
    )


def _least_gain(support: _OffPlaneWeights, chance: float) -> float:
    """Weight of matches that a competing model must gain: more than wrong matches agree by chance."""
    expected = 2.0 * chance * (support.tried - support.agreeing)
    return float(max(MIN_GAIN * support.agreeing, expected + 2.0 * np.sqrt(expected) + 1.0))


def _differs(competing_model: _CompetingModel, relevant: float) -> bool:
    """Return whether F is wrong if the competing model is right.

    A model that explains all inliers of F must explain much more, since a wrong match or two that it gains
    are far from F.
    """
    return competing_model.apart > relevant or (
        competing_model.error > relevant and competing_model.margin < -MIN_MARGIN
    )


def _support(points: F64, inliers: B8, weights: F64, plane: DominantPlane, near: float) -> _OffPlaneWeights:
    own = inliers & plane.off
    chosen = np.flatnonzero(own[inliers])
    chosen = chosen[:: max(1, len(chosen) // SAMPLED)]
    ratios = _contradicted_ratios(plane.h, points[inliers], ~plane.off[inliers], chosen, near)
    some = weights[inliers][chosen]
    agreeing = float(weights[own].sum())
    part = float(some[ratios > CONTRADICTED].sum() / max(some.sum(), 1e-300))
    return _OffPlaneWeights(agreeing, float(weights[plane.off].sum()), part * agreeing)


def _expected_error(fit: FundamentalFit, xy1: F64, xy2: F64) -> float:
    """RMS distance of exact matches to their lines over the inliers, px, from the covariance of F."""
    some = np.flatnonzero(fit.inliers)
    some = some[:: max(1, len(some) // SAMPLED)]
    std = epipolar_distance_std(fit.F, fit.covariance, xy1[some], xy2[some])
    return float(np.sqrt(np.mean(std**2))) if len(std) else float("inf")


def _reasons(
    support: _OffPlaneWeights,
    chance: float,
    competing_model: _CompetingModel | None,
    error_px: float,
    relevant_px: float,
) -> list[str]:
    off = f"{support.agreeing:.0f} of {support.tried:.0f} matches off the dominant plane agree with F"
    reasons = []
    if chance > MAX_CHANCE:
        reasons.append(f"{off}, no more than expected by chance")
    if support.contradicted > MAX_CONTRADICTED * support.agreeing:
        reasons.append(
            f"{off}, but {support.contradicted:.0f} of them lie among matches of the plane, as matches "
            "between repeated structures do"
        )
    if competing_model is not None and competing_model.margin < MIN_MARGIN:
        reasons.append(
            f"another F explains {competing_model.gained:.0f} matches that this F does not explain, and "
            f"misses {competing_model.lost:.0f} of its inliers"
        )
    if error_px > relevant_px:
        reasons.append(f"the covariance of F allows epipolar line errors of {error_px:.2g} px")
    return reasons
