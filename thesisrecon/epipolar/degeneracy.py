"""The plane that most matches of an F lie on, and which matches stand off it.

Other epipolar geometries of the same plane that explain about as many matches as the one found.

Whether the matches of a pair determine its F, beyond agreeing with it: evidence, verdict, reasons.

Where most matches lie on one plane, every [e]x H of its homography H explains them, and the epipole rests on
the rest. A wrong F then has as many inliers as the right one, or more. It betrays itself in four ways: hardly
more matches off the plane agree with it than chance would have; another epipole explains about as many; its
covariance is large; or its matches off the plane lie amid those of the plane, where no surface could be, as
matches from one window of a facade to the next do.
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
from thesisrecon.epipolar.planes import DominantPlane, find_dominant_plane
from thesisrecon.epipolar.precision import epipolar_distance_std
from thesisrecon.epipolar.refinement import SAMPSON, refine
from thesisrecon.epipolar.sampling import sampson_distances
from thesisrecon.records import DegeneracyReport, FundamentalFit

SAME_PX = 2.0
NEIGHBOURS = 5


@njit(cache=True, nogil=True, error_model="numpy")
def _parallax_lines(h: F64, points: F64) -> F64:
    """(N, 3) lines x2 x H x1, in image 2 through a match and the place where the plane would have it."""
    lines = np.empty((len(points), 3))
    for k in range(len(points)):
        x1, y1, x2, y2 = points[k, 0], points[k, 1], points[k, 2], points[k, 3]
        p0 = h[0] * x1 + h[1] * y1 + h[2]
        p1 = h[3] * x1 + h[4] * y1 + h[5]
        p2 = h[6] * x1 + h[7] * y1 + h[8]
        lines[k, 0], lines[k, 1], lines[k, 2] = y2 * p2 - p1, p0 - x2 * p2, x2 * p1 - y2 * p0
    return lines


@njit(cache=True, nogil=True, error_model="numpy")
def _fundamental_of_plane(h: F64, e2: F64, f: F64) -> None:
    """f = [e2]x H, unit norm."""
    for j in range(3):
        f[j] = e2[1] * h[6 + j] - e2[2] * h[3 + j]
        f[3 + j] = e2[2] * h[j] - e2[0] * h[6 + j]
        f[6 + j] = e2[0] * h[3 + j] - e2[1] * h[j]
    f /= np.sqrt(np.sum(f * f)) + 1e-300


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"}, forceinline=True)
def _inlier_mask(f: F64, columns: F64, gate: float, agree: F64) -> None:
    """``agree`` (N,): 1 for the columns of (4, N) with a Sampson distance below the gate, else 0."""
    wide = gate * gate
    f0, f1, f2, f3, f4, f5, f6, f7, f8 = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
    for k in range(columns.shape[1]):
        x1, y1, x2, y2 = columns[0, k], columns[1, k], columns[2, k], columns[3, k]
        a0 = f0 * x1 + f1 * y1 + f2
        a1 = f3 * x1 + f4 * y1 + f5
        b0 = f0 * x2 + f3 * y2 + f6
        b1 = f1 * x2 + f4 * y2 + f7
        e = a0 * x2 + a1 * y2 + f6 * x1 + f7 * y1 + f8
        agree[k] = 1.0 if e * e < wide * (a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1) else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def fundamentals_of_plane(h: F64, points: F64, weights: F64, pairs: I64, gate: float) -> tuple[F64, F64, F64]:
    """[e2]x H with the epipole of every pair of matches off the plane, and the weight within the gate of it.

    ``points`` (N, 4) are matches off the plane, ``weights`` (M, N) several weights of each, ``pairs`` (S, 2)
    indices into them; -> F (S, 9), which agree (S, N) as 0 and 1, and the sums of the weights (S, M).
    """
    columns = np.ascontiguousarray(points.T)
    lines = _parallax_lines(h, points)
    F, agree, e2 = np.empty((len(pairs), 9)), np.empty((len(pairs), len(points))), np.empty(3)
    for s in range(len(pairs)):
        a, b = lines[pairs[s, 0]], lines[pairs[s, 1]]
        e2[0], e2[1], e2[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        _fundamental_of_plane(h, e2, F[s])
        _inlier_mask(F[s], columns, gate, agree[s])
    return F, agree, agree @ weights.T


@njit(cache=True, nogil=True)
def _select_distinct(
    order: I64, agree: F64, weights: F64, alike: float, chosen: I64, count: int, most: int
) -> int:
    """Add the first of ``order`` to ``chosen`` that share at most ``alike`` of their weight with one chosen
    before, until ``most`` are; ``count`` are there already. Returns how many there are then."""
    for s in order:
        own = 0.0
        for k in range(len(weights)):
            own += weights[k] * agree[s, k]
        fresh = True
        for c in range(count):
            common = 0.0
            for k in range(len(weights)):
                common += weights[k] * agree[s, k] * agree[chosen[c], k]
            if common > alike * own:
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
    """Of the nearest neighbours of each chosen point, the share that lie on the plane and contradict it.

    A neighbour contradicts where the parallax differs by more than the two are apart in image 1: no opaque
    surface looks so, two points of it would change places. Points nearer than ``near`` are the same feature
    and do not count.
    """
    parallax = np.empty((len(points), 2))
    for k in range(len(points)):
        x1, y1 = points[k, 0], points[k, 1]
        w = h[6] * x1 + h[7] * y1 + h[8]
        parallax[k, 0] = points[k, 2] - (h[0] * x1 + h[1] * y1 + h[2]) / w
        parallax[k, 1] = points[k, 3] - (h[3] * x1 + h[4] * y1 + h[5]) / w
    shares, nearest, which = np.zeros(len(chosen)), np.empty(NEIGHBOURS), np.empty(NEIGHBOURS, np.int64)
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
            shares[c] += 1.0 if on_plane[m] and apart > nearest[n] else 0.0
        shares[c] /= max(found, 1)
    return shares


def multiplicity_weights(xy1: F64, xy2: F64) -> F64:
    """Weights (N,): one over the number of matches that share a place (of 2 px) in either image.

    At most one of the matches of one place is right, and all of them agree with every F whose epipole lies
    there: they are one piece of evidence.
    """
    return 1.0 / np.maximum(_crowd(xy1), _crowd(xy2))


def _crowd(xy: F64) -> F64:
    cell = np.floor(xy / SAME_PX).astype(np.int64)
    _, place, count = np.unique(cell[:, 0] * 1_000_003 + cell[:, 1], return_inverse=True, return_counts=True)
    return np.asarray(count[place], dtype=np.float64)


def log10_false_alarms(agreeing: float, tried: float, *, chance: float, free: int) -> float:
    """log10 of how often ``agreeing`` or more of ``tried`` wrong matches agree with the best model by chance.

    The model is laid through ``free`` of them and each of the rest agrees with probability ``chance``: the
    a-contrario bound (tried - free) C(tried, free) P(Binomial >= agreeing - free) of Moisan and Stival (IJCV
    2004). 0 or more where that many are no surprise.
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
    """Probability that a wrong match lies within Sampson distance ``band_px`` of any F.

    A band of width 2 sqrt(2) band_px across the picture, over the picture: the bounds of the matches.
    """
    narrow = min(float(np.ptp(xy)) for xy in (*xy1.T, *xy2.T))
    return min(1.0, float(2.0 * np.sqrt(2.0) * band_px / max(narrow, 1e-300)))


PAIRS, COMPETING_SUBSET, COMPETING, LOOKED_AT = 300, 400, 3, 100
"""Epipoles tried, matches off the plane that each is judged on, and how many of the best by all of these, and
by those that the found F does not explain, are refined if they are unlike each other."""
TYPICAL = 0.3
"""Of the epipoles tried, so many are taken for wrong: what they explain, chance explains."""
ALIKE = 0.8
"""Share of its matches that two geometries have in common to count as one."""
GATES, KNEE, STEPS = (2.4, 1.8, 1.2), 0.4, 5
WIDE = 2.0
"""In bands: two noisy matches and a plane that is known where its matches are do not make a good F."""
FAR = 20.0
"""Distances count to so many bands, or one wrong match would be the whole difference of two geometries."""


@dataclass(frozen=True)
class _CompetingModel:
    """Another F: ``f`` (9,) in the frame, and how it differs from the one that was found.

    ``lost`` and ``gained`` are weights of matches that only the one or only the other explains; ``error`` is
    the RMS distance of the rival's inliers to the found F, ``apart`` that or the other way round, whichever
    is less, in the units of the frame.
    """

    f: F64
    lost: float
    gained: float
    error: float
    apart: float

    @property
    def margin(self) -> float:
        """By how many standard errors the found F explains more: McNemar's test."""
        return (self.lost - self.gained) / float(np.sqrt(max(self.lost + self.gained, 1.0)))


def _find_competing_models(
    f: F64, points: F64, weights: F64, plane: DominantPlane, *, band: float, rng: Generator
) -> tuple[list[_CompetingModel], float]:
    """The rivals of ``f`` and the share of the matches off the plane that a geometry explains by chance.

    [e]x H of the plane and two matches off it (Chum, Werner and Matas, CVPR 2005), right or wrong, are judged
    on all matches off it; the best that are unlike each other are refined on all ``points`` (N, 4). Of half
    of the pairs one match agrees with ``f`` and the other does not: a wrong F often has most of its matches
    in common with the right one. Matches have ``weights`` (N,), and agree within ``band``.
    """
    distances = np.asarray(sampson_distances(f, points))
    inside = distances < band
    off = np.flatnonzero(plane.off)
    if len(off) < 3:
        return [], 0.0
    off = off[rng.permutation(len(off))[:COMPETING_SUBSET]]
    w, mine = weights[off], inside[off]
    F, agree, sums = fundamentals_of_plane(
        plane.h, points[off], np.stack([w, w * ~mine]), _pairs(mine, rng), WIDE * band
    )
    # The two matches that made a geometry agree with it always.
    beyond = np.maximum(sums[:, 0] - 2.0, 0.0) / max(float(w.sum()) - 2.0, 1.0)
    chance = float(np.quantile(beyond, TYPICAL)) / WIDE
    chosen, count = np.empty(2 * COMPETING, dtype=np.int64), 0
    for k, value in enumerate((sums[:, 0], sums[:, 0] + sums[:, 1])):
        order = np.argsort(-value, kind="stable")
        count = _select_distinct(order[:LOOKED_AT], agree, w, ALIKE, chosen, count, (k + 1) * COMPETING)
    competing_models = [
        _competing_model(_refined(F[s], points, band), points, weights, (distances, inside), band)
        for s in chosen[:count]
    ]
    return competing_models, chance


def _pairs(inside: B8, rng: Generator) -> NDArray[np.int64]:
    pairs = rng.integers(0, len(inside), (PAIRS, 2))
    mine, others = np.flatnonzero(inside), np.flatnonzero(~inside)
    if len(mine) and len(others):
        half = PAIRS // 2
        pairs[:half, 0] = mine[rng.integers(0, len(mine), half)]
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
    """Other matrices (9,) in the frame as rivals of ``f``, each refined on all ``points`` (N, 4)."""
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


MINIMUM = 8
BAND_SIGMAS, BAND_FLOOR_PX, SIGMA_FLOOR_PX = 2.5, 0.3, 0.1
LARGEST_CHANCE = -2.0
"""log10 of the false alarms that matches off the plane may be."""
LEAST_MARGIN = 3.0
"""Standard errors by which a rival must be worse. Right ones of real facades have 7 and more, wrong ones less
than 2; it is no bound of a probability, since matches of repeated parts are not independent."""
LEAST_GAIN = 0.05
"""A rival that changes less than this share of the matches off the plane is F with other wrong matches."""
LARGEST_ERROR_PX = 1.0
"""Distance from epipolar lines that matters, in pixels, or 2 sigma where that is more."""
CONTRADICTED, MOST_CONTRADICTED, JUDGED = 0.3, 0.2, 60
"""A match is contradicted where more than this share of its neighbours does so; so many matches may be."""


@dataclass(frozen=True)
class _Support:
    """Weights of matches off the plane: ``agreeing`` with F, all ``tried``, and what is ``contradicted``."""

    agreeing: float
    tried: float
    contradicted: float


def assess_degeneracy(fit: FundamentalFit, xy1: F64, xy2: F64, *, rng: Generator) -> DegeneracyReport:
    """Whether the matches (N, 2) px, wrong ones too, leave only ``fit`` as their epipolar geometry.

    Undetermined where fewer matches off the dominant plane agree with F than would be a surprise by chance,
    where another F, of that plane or from another search, explains about as many (McNemar's test, distances
    that matter), where more than a fifth of those off the plane are contradicted by neighbours on it, or
    where the covariance lets the inliers be more than a pixel off their lines. A pure translation is
    determined. Wrong matches that are as coherent as a surface (a whole facade shifted by a window) cannot be
    told from one.

    Raises ``ValueError`` where ``fit`` and the matches do not belong together, and as
    :func:`~thesisrecon.epipolar.frame.check_matches`.
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
        return DegeneracyReport(
            False, ("too few matches agree with the geometry",), expected_error_px=error_px
        )
    weights = multiplicity_weights(xy1, xy2)
    competing_models, share = _find_competing_models(
        f, points, weights, plane, band=band_px * frame.scale, rng=rng
    )
    ends = [frame.matrix_in_frame(F) for F in fit.competing_models]
    competing_models += _compare_competing_models(ends, f, points, weights, band=band_px * frame.scale)
    support = _support(points, fit.inliers, weights, plane, 2.0 * sigma_px * frame.scale)
    by_chance = chance_of_agreement(xy1, xy2, band_px)
    chance = log10_false_alarms(
        support.agreeing - support.contradicted,
        support.tried,
        chance=max(share, by_chance),
        free=2,
    )
    matters_px = max(LARGEST_ERROR_PX, 2.0 * fit.sigma_px)
    least = _least_gain(support, by_chance)
    different = [r for r in competing_models if r.gained >= least and _differs(r, matters_px * frame.scale)]
    other = min(different, key=lambda r: r.margin, default=None)
    return DegeneracyReport(
        determined=not (reasons := tuple(_reasons(support, chance, other, error_px, matters_px))),
        reasons=reasons,
        off_plane=support.agreeing,
        contradicted=support.contradicted,
        log10_false_alarms=chance,
        competing_margin=other.margin if other is not None else float("inf"),
        competing_model=frame.matrix_in_pixels(other.f) if other is not None else None,
        expected_error_px=error_px,
    )


def _least_gain(support: _Support, chance: float) -> float:
    """Weight of matches that a rival must gain to be one: more than of the wrong ones agree by chance."""
    expected = 2.0 * chance * (support.tried - support.agreeing)
    return float(max(LEAST_GAIN * support.agreeing, expected + 2.0 * np.sqrt(expected) + 1.0))


def _differs(competing_model: _CompetingModel, matters: float) -> bool:
    """Whether F is wrong if the rival is right; one that explains all that F does must explain much more, as
    a wrong match or two that it gains are far from F too."""
    return competing_model.apart > matters or (
        competing_model.error > matters and competing_model.margin < -LEAST_MARGIN
    )


def _support(points: F64, inliers: B8, weights: F64, plane: DominantPlane, near: float) -> _Support:
    mine = inliers & plane.off
    chosen = np.flatnonzero(mine[inliers])
    # Every k-th: enough to know a share.
    chosen = chosen[:: max(1, len(chosen) // JUDGED)]
    shares = _contradicted_ratios(plane.h, points[inliers], ~plane.off[inliers], chosen, near)
    some = weights[inliers][chosen]
    agreeing = float(weights[mine].sum())
    part = float(some[shares > CONTRADICTED].sum() / max(some.sum(), 1e-300))
    return _Support(agreeing, float(weights[plane.off].sum()), part * agreeing)


def _expected_error(fit: FundamentalFit, xy1: F64, xy2: F64) -> float:
    """RMS over the inliers of the distance of exact matches to their lines, px, from the covariance of F."""
    some = np.flatnonzero(fit.inliers)
    some = some[:: max(1, len(some) // JUDGED)]
    std = epipolar_distance_std(fit.F, fit.covariance, xy1[some], xy2[some])
    return float(np.sqrt(np.mean(std**2))) if len(std) else float("inf")


def _reasons(
    support: _Support,
    chance: float,
    competing_model: _CompetingModel | None,
    error_px: float,
    matters_px: float,
) -> list[str]:
    off = f"{support.agreeing:.0f} of {support.tried:.0f} matches off the dominant plane agree with it"
    reasons = []
    if chance > LARGEST_CHANCE:
        reasons.append(f"{off}, no more than chance gives")
    if support.contradicted > MOST_CONTRADICTED * support.agreeing:
        reasons.append(
            f"{off}, but {support.contradicted:.0f} of them lie amid matches of the plane, as those between "
            f"repeated parts do"
        )
    if competing_model is not None and competing_model.margin < LEAST_MARGIN:
        reasons.append(
            f"another geometry explains {competing_model.gained:.0f} matches that it does not, and "
            f"leaves {competing_model.lost:.0f} of its own"
        )
    if error_px > matters_px:
        reasons.append(f"its covariance allows epipolar lines to be {error_px:.2g} px off")
    return reasons
