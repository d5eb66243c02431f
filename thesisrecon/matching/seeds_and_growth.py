"""The default matching: seeds without a radius, then growth along the epipolar lines, then sub-pixel
alignment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from thesisrecon.errors import StageFailure, UsageError
from thesisrecon.matching.alignment import aligned_matches, strongest_distinct
from thesisrecon.matching.kernels import fit_local_affines, grow_corners
from thesisrecon.matching.prepared import PreparedView, prepare_view
from thesisrecon.matching.records import FundamentalEstimator, empty_matches, matches_at, one_to_one
from thesisrecon.matching.seeds import SeedMatches, corners_of_seeds, match_seeds, neighbour_support
from thesisrecon.types import F64, I64, Features, Image, Matches

Found = tuple[I64, I64, SeedMatches]
"""Corners of image 1, corners of image 2, and the matches with their places, maps and correlations."""


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
    orientation : seeds by their upright patches, by those turned to their gradient, or "auto": the turned
        ones too where the upright ones do not relate the pair well.
    support : whether F is sought among the seeds whose neighbours move as they do ("always"), among all
        ("never"), or in both ways and the better kept ("auto").
    growth : corners are sought where the seeds tell, else only those that a seed stands on are matched.
    coarse_first : the corners of the coarser size grow before all of them, and give a better F to these.
    rematch : guided rematching: all corners are sought once more with the F and the maps of the matches that
        grew.
    align : places in image 2 are moved to sub-pixel by least-squares matching, else stay at the corners.
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
    orientation: Literal["auto", "upright", "turned"] = "auto"
    support: Literal["auto", "always", "never"] = "auto"
    growth: bool = True
    coarse_first: bool = True
    rematch: bool = True
    align: bool = True

    def __post_init__(self) -> None:
        for name in ("least_seeds", "neighbours"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1; got {getattr(self, name)}")
        for name in ("ratio", "grown_ratio", "band_rel", "radius_rel"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be above 0; got {getattr(self, name)}")
        if not self.affine_std >= 0.0:
            raise ValueError(f"affine_std must be at least 0; got {self.affine_std}")

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
        """Corner matches of two photographs, one-to-one, aligned to sub-pixel; empty if none.

        Raises :class:`UsageError` for features without seeds.
        """
        if view1.features.seeds is None or view2.features.seeds is None:
            raise UsageError(
                "matching by seeds and growth needs features with seeds; set "
                "features.kind=multi-scale-corners, or matching.kind=strength-of-match"
            )
        start = self._verified_seeds(view1, view2, estimate_fundamental, rng)
        if start is None:
            return empty_matches(pair)
        if self.growth:
            one, two, found = self._grow_in_rounds(view1, view2, start, estimate_fundamental, rng)
        else:
            one, two, found = corners_of_seeds(view1.features.xy, view2.features.xy, start[0])
        matches = Matches(*pair, one, two, found.xy1, found.xy2, found.score, found.affine)
        if not self.align:
            return matches_at(matches, strongest_distinct(matches))
        return aligned_matches(
            view1,
            view2,
            matches,
            affine_std=self.affine_std,
            least_correlation=self.aligned_correlation,
        )

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
        for turned in {"auto": (False, True), "upright": (False,), "turned": (True,)}[self.orientation]:
            seeds = match_seeds(seeds1, seeds2, turned=turned, ratio=self.ratio)
            for trial in self._trials(seeds):
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

    def _trials(self, seeds: SeedMatches) -> tuple[SeedMatches, ...]:
        """The sets of seeds among which F is sought; none where there are too few."""
        if self.support == "never":
            return (seeds,) if len(seeds) >= self.least_seeds else ()
        supported = neighbour_support(seeds) >= self.least_support
        if supported.sum() < self.least_seeds:
            return ()
        return (seeds.at(supported), seeds) if self.support == "auto" else (seeds.at(supported),)

    def _grow_in_rounds(
        self,
        view1: PreparedView,
        view2: PreparedView,
        start: tuple[SeedMatches, F64],
        estimate: FundamentalEstimator,
        rng: np.random.Generator,
    ) -> Found:
        """The corners of the coarser size, then all, then all once more, each led by those before it."""
        known, F = start
        scale = view1.features.scale
        everything = np.arange(len(scale))
        rounds = [np.flatnonzero(scale > scale.min())] if self.coarse_first else []
        rounds += [everything] * (1 + self.rematch)
        for chosen in rounds[:-1]:
            one, _, grown = self._grow(view1, view2, chosen, known, F)
            if len(one) < 8:
                continue
            try:
                fit = estimate(grown.xy1, grown.xy2, rng)
            except StageFailure:
                continue
            F, known = fit.F, grown.at(fit.inliers)
        return self._grow(view1, view2, everything, known, F)

    def _grow(
        self, view1: PreparedView, view2: PreparedView, chosen: I64, known: SeedMatches, F: F64
    ) -> Found:
        xy1, scale1 = view1.features.xy[chosen], view1.features.scale[chosen]
        # Asked for a list of ranks, the tree answers with a row a corner even where that is one neighbour.
        ranks = np.arange(1, min(self.neighbours, len(known)) + 1)
        near = scipy.spatial.cKDTree(known.xy1).query(xy1, ranks)[1]
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
