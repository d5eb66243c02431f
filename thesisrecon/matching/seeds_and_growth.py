"""The default matching: seeds without a radius, then growth along the epipolar lines, then sub-pixel
alignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from thesisrecon.errors import StageFailure
from thesisrecon.matching.alignment import align_corners
from thesisrecon.matching.kernels import fit_local_affines, grow_corners
from thesisrecon.matching.prepared import PreparedView, prepare_view
from thesisrecon.matching.records import FundamentalEstimator, empty_matches, one_to_one
from thesisrecon.matching.seeds import SeedMatches, match_seeds, neighbour_support
from thesisrecon.types import B8, F64, I64, Features, Image, Matches


@dataclass(frozen=True)
class SeedsAndGrowth:
    """Seeds give F, F and the seeds' local affine maps tell each corner where to look, alignment does the
    rest.

    Parameters
    ----------
    ratio : distance of a seed to its match as a share of the distance to the best rival, at most.
    least_support : strength of match (of at most 10) that a seed needs in the filtered trial.
    least_seeds : verified seeds under which a pair counts as not overlapping.
    band_rel : half width of the epipolar band, share of the long side.
    radius_rel : largest search radius around the predicted place, share of the long side.
    least_correlation : of a grown match at its corner; ``aligned_correlation`` after alignment.
    grown_ratio : as ``ratio``, for a grown match and the rivals in its part of the epipolar band.
    neighbours : matches that define a local affine map.
    affine_std : prior standard deviation of an affine coefficient in the alignment.
    """

    ratio: float = 0.8
    least_support: float = 2.0
    least_seeds: int = 12
    band_rel: float = 0.002
    radius_rel: float = 0.025
    least_correlation: float = 0.7
    aligned_correlation: float = 0.8
    grown_ratio: float = 0.8
    neighbours: int = 10
    affine_std: float = 0.02

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
        """Corner matches of two photographs, one-to-one, aligned to sub-pixel; empty if none."""
        if view1.features.seeds is None or view2.features.seeds is None:
            raise ValueError("SeedsAndGrowth needs features with seeds; MultiScaleCorners finds them")
        start = self._verified_seeds(view1, view2, estimate_fundamental, rng)
        if start is None:
            return empty_matches(pair)
        known, F = start
        one = two = np.empty(0, np.int64)
        for scales in (np.greater, np.greater_equal):
            chosen = np.flatnonzero(scales(view1.features.scale, view1.features.scale.min()))
            one, two, grown = self._grow(view1, view2, chosen, known, F)
            if len(one) < 8:
                continue
            try:
                fit = estimate_fundamental(grown.xy1, grown.xy2, rng)
            except StageFailure:
                continue
            F, known = fit.F, grown.at(fit.inliers)
        one, two, grown = self._grow(view1, view2, np.arange(len(view1.features.xy)), known, F)
        return self._align(view1, view2, pair, (one, two, grown))

    def _verified_seeds(
        self,
        view1: PreparedView,
        view2: PreparedView,
        estimate: FundamentalEstimator,
        rng: np.random.Generator,
    ) -> tuple[SeedMatches, F64] | None:
        seeds1, seeds2 = view1.features.seeds, view2.features.seeds
        assert seeds1 is not None
        assert seeds2 is not None
        best: tuple[SeedMatches, F64] | None = None
        for turned in (False, True):
            seeds = match_seeds(seeds1, seeds2, turned=turned, ratio=self.ratio)
            supported = neighbour_support(seeds) >= self.least_support
            if supported.sum() < self.least_seeds:
                continue
            for trial in (seeds.at(supported), seeds):
                try:
                    fit = estimate(trial.xy1, trial.xy2, rng)
                except StageFailure:
                    continue
                if fit.inliers.sum() >= self.least_seeds and (
                    best is None or fit.inliers.sum() > len(best[0])
                ):
                    best = trial.at(fit.inliers), fit.F
            if best is not None and len(best[0]) >= max(50, 0.5 * len(seeds)):
                break
        return best

    def _grow(
        self, view1: PreparedView, view2: PreparedView, chosen: I64, known: SeedMatches, F: F64
    ) -> tuple[I64, I64, SeedMatches]:
        xy1, scale1 = view1.features.xy[chosen], view1.features.scale[chosen]
        near = cKDTree(known.xy1).query(xy1, min(self.neighbours, len(known)))[1]
        affine, place, spread = fit_local_affines(xy1, near, known.xy1, known.xy2, known.affine)
        long_side = view2.long_side
        radius = np.clip(3.0 * spread, 0.004 * long_side, self.radius_rel * long_side)
        corners2 = (view2.features.xy, view2.features.scale, view2.patches)
        index, score, rival = grow_corners(
            view1.pyramid,
            (xy1, scale1),
            (affine, place, radius),
            corners2,
            view2.cells,
            (F, self.band_rel * long_side, self.least_correlation),
        )
        index[1.0 - score > self.grown_ratio**2 * (1.0 - rival)] = -1
        rows = one_to_one(index, score)
        one, two = chosen[rows], index[rows]
        return one, two, SeedMatches(xy1[rows], view2.features.xy[two], affine[rows], score[rows])

    def _align(
        self,
        view1: PreparedView,
        view2: PreparedView,
        pair: tuple[int, int],
        grown: tuple[I64, I64, SeedMatches],
    ) -> Matches:
        one, two, known = grown
        xy2, affine, score = align_corners(
            view1,
            view2,
            (known.xy1, view1.features.scale[one], known.xy2, known.affine),
            affine_std=self.affine_std,
            largest_shift=3.0,
        )
        good = np.flatnonzero(score >= self.aligned_correlation)
        good = good[np.argsort(-score[good], kind="stable")]
        good = good[_distinct(known.xy1[good], xy2[good])]
        good = good[np.argsort(one[good], kind="stable")]
        return Matches(*pair, one[good], two[good], known.xy1[good], xy2[good], score[good], affine[good])


def _distinct(xy1: F64, xy2: F64, apart_px: float = 1.0) -> B8:
    """Matches (strongest first) that do not repeat a stronger one within ``apart_px`` in both images."""
    keep = np.ones(len(xy1), np.bool_)
    if len(xy1) < 2:
        return keep
    for a, b in sorted(cKDTree(np.hstack([xy1, xy2])).query_pairs(apart_px)):
        if keep[a]:
            keep[b] = False
    return keep
