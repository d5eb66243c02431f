"""Strength of match, equation (4.1), and the weight functions of figure 4.4.

Section 4.2.2: correlation within a radius and strength of match (algorithm 4.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy
from numba import njit

from thesisrecon.arrays import F32, F64, I64
from thesisrecon.matching.alignment import aligned_matches
from thesisrecon.matching.prepared import (
    SIDE,
    FundamentalEstimator,
    PreparedView,
    empty_matches,
    one_to_one,
    prepare_view,
)
from thesisrecon.records import Features, Image, Matches


@njit(cache=True, nogil=True)
def displacement_weight(a: F64, b: F64, closeness: float, terms: tuple[bool, bool, bool]) -> float:
    """lambda of figure 4.4: direction x length x distance of two displacement vectors, in [0, 1].

    ``terms`` says which of the three factors take part. Displacements under one pixel have no direction worth
    the name; their lengths are taken as one pixel.
    """
    direction, length, distance = terms
    weight = closeness if distance else 1.0
    na, nb = np.hypot(a[0], a[1]), np.hypot(b[0], b[1])
    if na < 1.0 and nb < 1.0:
        return float(weight)
    cosine = (a[0] * b[0] + a[1] * b[1]) / max(na * nb, 1e-12)
    shorter, longer = max(min(na, nb), 1.0), max(na, nb)
    along = max(cosine, 0.0) if direction else 1.0
    return float(along * (shorter / longer if length else 1.0) * weight)


@njit(cache=True, nogil=True)
def relative_difference_weight(a: F64, b: F64, apart: float, tolerance: float) -> float:
    """exp(-1/2 (|a - b| / (tolerance apart + 1 px))^2), in (0, 1]: neighbours may move the more differently
    the farther ``apart`` px they are, whatever the length of their displacements."""
    strain = np.hypot(a[0] - b[0], a[1] - b[1]) / (tolerance * apart + 1.0)
    return float(np.exp(-0.5 * strain * strain))


@njit(cache=True, nogil=True)
def strength_of_match(
    correlation: F32,
    xy: tuple[F64, F64],
    near: tuple[I64, I64],
    search: tuple[float, int, float],
    weight: tuple[float, tuple[bool, bool, bool]],
) -> tuple[I64, F32]:
    """Equation 4.1: for each corner of image 1 the candidate of largest SM_k = c_k sum_m max_n (c_mn
    lambda_n).

    ``correlation`` (N1, N2); ``xy`` the corners of both images; ``near`` the neighbours (N1, M) and (N2, N)
    of each corner in its own image, -1 where there are fewer; ``search`` = radius px, number of candidates,
    correlation that a candidate must exceed; ``weight`` = tolerance of the relative difference (0: the
    product of figure 4.4) and the factors of the product. Returns the corner of image 2 (N1,), -1 where no
    candidate lies within the radius, and the strength (N1,).
    """
    xy1, xy2 = xy
    index = np.full(len(xy1), -1, np.int64)
    strength = np.zeros(len(xy1), np.float32)
    held = np.empty(search[1], np.int64)
    for u in range(len(xy1)):
        count = _best_candidates(correlation[u], xy1[u], xy2, search, held)
        for k in range(count):
            v = held[k]
            total = _neighbours_agree(correlation, xy, (near[0][u], near[1][v]), (u, v), (search[0], weight))
            if correlation[u, v] * total > strength[u]:
                index[u], strength[u] = v, correlation[u, v] * total
    return index, strength


@njit(cache=True, nogil=True)
def _best_candidates(
    correlation: F32, place: F64, xy2: F64, search: tuple[float, int, float], held: I64
) -> int:
    """How many corners of image 2 within the radius are candidates; the best, best first, go to ``held``."""
    radius, candidates, least = search
    count = 0
    for v in range(len(xy2)):
        c = correlation[v]
        if c <= least or (count == candidates and c <= correlation[held[count - 1]]):
            continue
        if (xy2[v, 0] - place[0]) ** 2 + (xy2[v, 1] - place[1]) ** 2 > radius * radius:
            continue
        count = min(count + 1, candidates)
        at = count - 1
        while at > 0 and correlation[held[at - 1]] < c:
            held[at] = held[at - 1]
            at -= 1
        held[at] = v
    return count


@njit(cache=True, nogil=True)
def _neighbours_agree(
    correlation: F32,
    xy: tuple[F64, F64],
    near: tuple[I64, I64],
    pair: tuple[int, int],
    rule: tuple[float, tuple[float, tuple[bool, bool, bool]]],
) -> float:
    """sum_m max_n (c_mn lambda_n) of one pair of corners, figure 4.3 step 1 (a) i."""
    xy1, xy2 = xy
    u, v = pair
    radius, (tolerance, terms) = rule
    moved, other = np.empty(2), np.empty(2)
    moved[0], moved[1] = xy2[v, 0] - xy1[u, 0], xy2[v, 1] - xy1[u, 1]
    total = 0.0
    for m in near[0]:
        if m < 0:
            continue
        apart = np.hypot(xy1[m, 0] - xy1[u, 0], xy1[m, 1] - xy1[u, 1])
        best = 0.0
        for n in near[1]:
            # A weight is at most 1, so that only a correlation above the best can beat it.
            if n >= 0 and correlation[m, n] > best:
                other[0], other[1] = xy2[n, 0] - xy1[m, 0], xy2[n, 1] - xy1[m, 1]
                if tolerance > 0.0:
                    agreement = relative_difference_weight(moved, other, apart, tolerance)
                else:
                    agreement = displacement_weight(moved, other, 1.0 - apart / radius, terms)
                best = max(best, correlation[m, n] * agreement)
        total += best
    return total


@dataclass(frozen=True)
class StrengthOfMatch:
    """The thesis' matching: a corner goes with the one whose neighbours' displacements agree best.

    Every corner is compared with those within a radius; for its best candidates the strength SM_k = c_k sum_m
    max_n (c_mn lambda_n) (4.1) is computed over its neighbours, and of matches that share a corner the
    strongest stays. Figure 4.4 with the weight functions is lost; lambda is taken as the product of direction
    max(0, cos), length min / max and distance 1 - d / radius, as the text tells it. The fields after
    ``neighbours`` and ``weight`` = "relative-difference" go beyond the thesis, and are off.

    Parameters
    ----------
    radius_rel : search radius as a share of the long side of the photographs.
    candidates : K, the corners of highest correlation whose strength is computed.
    neighbours : M, the nearest corners around a corner that lend it strength, and half as many again on the
        other side, because some of them have no partner.
    window : K = L, side of the correlation window in pixels, odd.
    colour : the correlation is the mean of those of red, green and blue, else that of the grey values.
    weight : "product" is figure 4.4; "relative-difference" is exp(-1/2 (|d_m - d| / (tolerance |u_m - u| +
        1 px))^2), d the displacements: right also where displacements are short or the scene is deep.
    use_direction, use_length, use_distance : the factors of the product that take part.
    tolerance : of the relative difference.
    least_correlation : a candidate must correlate by more.
    least_strength : of a match, as a share of what M neighbours that agree perfectly would lend; in [0, 1).
    align : places in image 2 are moved to sub-pixel by least-squares matching.
    """

    radius_rel: float = 0.16
    candidates: int = 10
    neighbours: int = 10
    window: int = SIDE
    colour: bool = False
    weight: Literal["product", "relative-difference"] = "product"
    use_direction: bool = True
    use_length: bool = True
    use_distance: bool = True
    tolerance: float = 0.3
    least_correlation: float = 0.0
    least_strength: float = 0.0
    align: bool = False

    def __post_init__(self) -> None:
        if self.candidates < 1 or self.neighbours < 1:
            raise ValueError(
                f"candidates and neighbours must be at least 1; got {self.candidates} and {self.neighbours}"
            )
        if self.window < 3 or self.window % 2 == 0:
            raise ValueError(f"window must be odd and at least 3; got {self.window}")
        if not (self.radius_rel > 0.0 and self.tolerance > 0.0):
            raise ValueError(
                f"radius_rel and tolerance must be above 0; got {self.radius_rel} and {self.tolerance}"
            )
        if not 0.0 <= self.least_strength < 1.0:
            raise ValueError(f"least_strength must lie in [0, 1); got {self.least_strength}")

    def prepare(self, image: Image, features: Features) -> PreparedView:
        """What is computed once for a photograph."""
        return prepare_view(image, features, window=self.window, colour=self.colour)

    def match(
        self,
        view1: PreparedView,
        view2: PreparedView,
        *,
        pair: tuple[int, int],
        estimate_fundamental: FundamentalEstimator,
        rng: np.random.Generator,
    ) -> Matches:
        """One-to-one matches at the corners themselves, identity maps; empty where either has under two
        corners.

        ``estimate_fundamental`` and ``rng`` belong to the stage's protocol; this variant uses neither.
        """
        del estimate_fundamental, rng
        if min(len(view1.features.xy), len(view2.features.xy)) < 2:
            return empty_matches(pair)
        matches = self._strongest(view1, view2, pair)
        if not self.align:
            return matches
        return aligned_matches(view1, view2, matches, affine_std=0.02, least_correlation=0.8)

    def _strongest(self, view1: PreparedView, view2: PreparedView, pair: tuple[int, int]) -> Matches:
        xy1, xy2 = view1.features.xy, view2.features.xy
        correlation = view1.patches @ view2.patches.T
        radius = self.radius_rel * max(view1.long_side, view2.long_side)
        near1 = _nearest(xy1, self.neighbours, radius)
        near2 = _nearest(xy2, self.neighbours + self.neighbours // 2, radius)
        terms = (self.use_direction, self.use_length, self.use_distance)
        index, strength = strength_of_match(
            correlation,
            (xy1, xy2),
            (near1, near2),
            (radius, self.candidates, self.least_correlation),
            (self.tolerance if self.weight == "relative-difference" else 0.0, terms),
        )
        index[strength < self.least_strength * self.neighbours] = -1
        rows = one_to_one(index, strength)
        two = index[rows]
        maps = np.tile(np.eye(2), (len(rows), 1, 1))
        return Matches(*pair, rows, two, xy1[rows], xy2[two], correlation[rows, two], maps)


def _nearest(xy: F64, count: int, radius: float) -> I64:
    """(N, count) the nearest other corners within ``radius``, -1 where there are fewer."""
    distance, index = scipy.spatial.cKDTree(xy).query(xy, count + 1, distance_upper_bound=radius)
    near = np.where(np.isfinite(distance), index, -1)[:, 1:]
    return np.ascontiguousarray(near, dtype=np.int64)
