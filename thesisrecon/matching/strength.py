"""Section 4.2.2: matching by correlation within a radius and strength of match (algorithm 4.1)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from thesisrecon._numba import empty, full, kernel, zeros
from thesisrecon.arrays import F32, F64, I64
from thesisrecon.errors import require_range
from thesisrecon.matching import _prepared
from thesisrecon.matching.track_alignment import align_matches
from thesisrecon.records import Features, Image, Matches

TOLERANCE = 0.3  # tolerance of the relative difference of two displacements


@kernel
def _displacement_weight(a: F64, b: F64, closeness: float) -> float:
    """Lambda of figure 4.4: direction x length (at least 1 px) x distance of two displacements (2,) px."""
    na, nb = np.hypot(a[0], a[1]), np.hypot(b[0], b[1])
    cosine = 1.0
    if min(na, nb) >= 1.0:
        cosine = (a[0] * b[0] + a[1] * b[1]) / (na * nb)
    shorter, longer = max(min(na, nb), 1.0), max(max(na, nb), 1.0)
    return float(max(cosine, 0.0) * (shorter / longer) * closeness)


@kernel
def _relative_difference_weight(a: F64, b: F64, apart: float, tolerance: float) -> float:
    """Lambda exp(-1/2 (|a - b| / (tolerance apart + 1 px))^2) of displacements of corners ``apart`` px."""
    strain = np.hypot(a[0] - b[0], a[1] - b[1]) / (tolerance * apart + 1.0)
    return float(np.exp(-0.5 * strain * strain))


@kernel
def _strength_of_match(
    correlation: F32, xy1: F64, xy2: F64, near1: I64, near2: I64, search: tuple[float, int, float],
    tolerance: float,
) -> tuple[I64, F32]:  # fmt: skip
    """Corner of image 2 of largest strength SM_k = c_k sum_m max_n (c_mn lambda_n) (4.1), and SM; -1: none.

    ``near1``, ``near2``: neighbours (N1, M), (N2, N) or -1; ``search``: radius px, candidates, least
    correlation; ``tolerance`` of the relative difference, 0: product of figure 4.4.
    """
    index, strength = full(len(xy1), -1, np.int64), zeros(len(xy1), np.float32)
    held, moved, other = empty(search[1], np.int64), empty(2), empty(2)
    for u in range(len(xy1)):
        for k in range(_best_candidates(correlation[u], xy1[u], xy2, search, held)):
            v, total = held[k], 0.0
            moved[0], moved[1] = xy2[v, 0] - xy1[u, 0], xy2[v, 1] - xy1[u, 1]
            for m in near1[u]:
                if m < 0:
                    continue
                apart, best = np.hypot(xy1[m, 0] - xy1[u, 0], xy1[m, 1] - xy1[u, 1]), 0.0
                for n in near2[v]:
                    # Weights are at most 1, so only a correlation above the best can improve it.
                    if n >= 0 and correlation[m, n] > best:
                        other[0], other[1] = xy2[n, 0] - xy1[m, 0], xy2[n, 1] - xy1[m, 1]
                        if tolerance > 0.0:
                            agreement = _relative_difference_weight(moved, other, apart, tolerance)
                        else:
                            agreement = _displacement_weight(moved, other, 1.0 - apart / search[0])
                        best = max(best, correlation[m, n] * agreement)
                total += best
            if correlation[u, v] * total > strength[u]:
                index[u], strength[u] = v, correlation[u, v] * total
    return index, strength


@kernel
def _best_candidates(
    correlation: F32, position: F64, xy2: F64, search: tuple[float, int, float], held: I64
) -> int:
    """Write the best corners of image 2 within the radius to ``held``, best first; return their number."""
    radius, candidates, least = search
    count = 0
    for v in range(len(xy2)):
        c = correlation[v]
        if c <= least or (count == candidates and c <= correlation[held[count - 1]]):
            continue
        if (xy2[v, 0] - position[0]) ** 2 + (xy2[v, 1] - position[1]) ** 2 > radius * radius:
            continue
        count = min(count + 1, candidates)
        at = count - 1
        while at > 0 and correlation[held[at - 1]] < c:
            held[at] = held[at - 1]
            at -= 1
        held[at] = v
    return count


@dataclass(frozen=True)
class StrengthOfMatch:
    """The thesis' matching: a corner matches the one whose neighbours' displacements agree best.

    Each corner is compared with those within a radius; the strength (4.1) of its best candidates is computed
    over its neighbours, and of matches that share a corner the strongest is kept. Figure 4.4 with the weight
    functions is lost; lambda is the product of direction max(0, cos), length min / max and distance 1 - d /
    radius as in the text. ``weight`` = "relative-difference" and the fields after it are not in the thesis
    and off by default.
    """

    radius_rel: float = 0.16  #: search radius, relative to the long side
    candidates: int = 10  #: K, number of corners of highest correlation whose strength is computed
    neighbours: int = 10  #: M, number of neighbours of a corner in image 1; in image 2 these are 1.5 M
    window: int = _prepared.SIDE  #: K = L, side of the correlation window, px, odd
    colour: bool = False  #: mean correlation of red, green and blue instead of grey values
    weight: Literal["product", "relative-difference"] = "product"
    """Product of figure 4.4, or exp(-1/2 (|d_m - d| / (0.3 |u_m - u| + 1 px))^2) of displacements d, which
    also suits short displacements and deep scenes."""
    min_correlation: float = 0.0  #: correlation that a candidate must exceed
    min_strength: float = 0.0  #: minimum strength relative to M perfectly agreeing neighbours, in [0, 1)
    align: bool = False  #: align positions in image 2 by least-squares matching

    def __post_init__(self) -> None:
        require_range(self, candidates="[1, inf)", neighbours="[1, inf)")
        require_range(self, radius_rel="(0, inf)", min_strength="[0, 1)")
        if self.window < 3 or self.window % 2 == 0:
            raise ValueError(f"window must be odd and at least 3; got {self.window}")

    def prepare(self, image: Image, features: Features) -> _prepared.PreparedImage:
        """See `thesisrecon.config.Matcher.prepare`."""
        return _prepared.prepare_image(image, features, window=self.window, colour=self.colour)

    def match(
        self, view1: _prepared.PreparedImage, view2: _prepared.PreparedImage, *, pair: tuple[int, int],
        estimate_fundamental: _prepared.EstimateFundamental, rng: np.random.Generator,
    ) -> Matches:  # fmt: skip
        """See `thesisrecon.config.Matcher.match`."""
        del estimate_fundamental, rng
        if min(len(view1.features.xy), len(view2.features.xy)) < 2:
            return _prepared.empty_matches(pair)
        xy1, xy2 = view1.features.xy, view2.features.xy
        correlation = view1.patches @ view2.patches.T
        radius = self.radius_rel * max(view1.long_side, view2.long_side)
        near1 = _nearest(xy1, self.neighbours, radius)
        near2 = _nearest(xy2, self.neighbours + self.neighbours // 2, radius)
        search = radius, self.candidates, self.min_correlation
        tolerance = TOLERANCE if self.weight == "relative-difference" else 0.0
        index, strength = _strength_of_match(correlation, xy1, xy2, near1, near2, search, tolerance)
        index[strength < self.min_strength * self.neighbours] = -1
        rows = _prepared.one_to_one(index, strength)
        two = index[rows]
        maps = np.tile(np.eye(2), (len(rows), 1, 1))
        matches = Matches(*pair, rows, two, xy1[rows], xy2[two], correlation[rows, two], maps)
        return align_matches(view1, view2, matches) if self.align else matches


def _nearest(xy: F64, count: int, radius: float) -> I64:
    """Nearest other corners (N, count) within ``radius``, -1 for none."""
    distance, index = scipy.spatial.cKDTree(xy).query(xy, count + 1, distance_upper_bound=radius)
    near = np.where(np.isfinite(distance), index, -1)[:, 1:]
    return np.ascontiguousarray(near, dtype=np.int64)
