"""Section 4.2.2: correlation within a radius and strength of match (algorithm 4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from thesisrecon.matching.kernels import strength_of_match
from thesisrecon.matching.prepared import PreparedView, prepare_view
from thesisrecon.matching.records import FundamentalEstimator, empty_matches, one_to_one
from thesisrecon.types import F64, I64, Features, Image, Matches


@dataclass(frozen=True)
class StrengthOfMatch:
    """The thesis' matching: a corner goes with the one whose neighbours' displacements agree best.

    Every corner is compared with those within a radius; for its best candidates the strength SM_k = c_k sum_m
    max_n (c_mn lambda_n) (4.1) is computed over its neighbours, and of matches that share a corner the
    strongest stays. Figure 4.4 with the weight functions is lost; lambda is taken as the product of direction
    max(0, cos), length min / max and distance 1 - d / radius.

    Parameters
    ----------
    radius_rel : search radius as a share of the long side of the photographs.
    candidates : K, the corners of highest correlation whose strength is computed.
    neighbours : M, the nearest corners around a corner that lend it strength, and half as many again on the
        other
        side, because some of them have no partner.
    """

    radius_rel: float = 0.16
    candidates: int = 10
    neighbours: int = 10

    def prepare(self, image: Image, features: Features) -> PreparedView:
        """What is computed once for a photograph."""
        return prepare_view(image, features)

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
        xy1, xy2 = view1.features.xy, view2.features.xy
        if min(len(xy1), len(xy2)) < 2:
            return empty_matches(pair)
        correlation = view1.patches @ view2.patches.T
        radius = self.radius_rel * max(view1.long_side, view2.long_side)
        near1 = _nearest(xy1, self.neighbours, radius)
        near2 = _nearest(xy2, self.neighbours + self.neighbours // 2, radius)
        index, strength = strength_of_match(correlation, (xy1, xy2), (near1, near2), radius, self.candidates)
        rows = one_to_one(index, strength)
        two = index[rows]
        maps = np.tile(np.eye(2), (len(rows), 1, 1))
        return Matches(*pair, rows, two, xy1[rows], xy2[two], correlation[rows, two], maps)


def _nearest(xy: F64, count: int, radius: float) -> I64:
    """(N, count) the nearest other corners within ``radius``, -1 where there are fewer."""
    distance, index = cKDTree(xy).query(xy, count + 1, distance_upper_bound=radius)
    near = np.where(np.isfinite(distance), index, -1)[:, 1:]
    return np.ascontiguousarray(near, dtype=np.int64)
