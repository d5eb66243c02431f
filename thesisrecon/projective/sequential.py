"""Chapter 6 to the letter: the sequential variant of the preset ``thesis``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import I64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.projective.incremental import IncrementalProjective
from thesisrecon.projective.initial_pair import require_pair_with_parallax
from thesisrecon.projective.model import adjust_all, to_reconstruction
from thesisrecon.records import Reconstruction, Tracks, TwoView


@dataclass(frozen=True)
class SequentialProjective:
    """Chapter 6 as the thesis has it: one view after the other in the order of the photographs.

    The pair of neighbours with most matches begins; each further view is resected from the points there
    are, new points are triangulated, outliers discarded. No covariance gate; one bundle adjustment at the
    end, since the thesis' chapter on it is lost and without any the later chapters have nothing to work on.
    """

    min_points: int = 12
    outlier_sigmas: float = 12.0

    def reconstruct(
        self,
        tracks: Tracks,
        pairs: Sequence[TwoView],
        sizes: I64,
        *,
        rng: np.random.Generator,
        attempt: int = 0,
    ) -> Reconstruction:
        """As :meth:`IncrementalProjective.reconstruct`; ``attempt`` takes the next best pair of neighbours."""
        require_pair_with_parallax(pairs)
        local_bundle_views = [p for p in pairs if p.accepted and p.j == p.i + 1]
        candidates = local_bundle_views or [p for p in pairs if p.accepted]
        candidates = sorted(candidates, key=lambda p: (-p.inliers, p.i, p.j))
        if attempt >= len(candidates):
            raise StageFailure(
                "no pair of photographs to begin with", f"{counted(len(candidates), 'pair')} accepted"
            )
        engine = IncrementalProjective(
            min_points=self.min_points,
            outlier_sigmas=(self.outlier_sigmas, self.outlier_sigmas),
            max_projection_std_rel=None,
            bundle_iterations=0,
            final_rounds=0,
        )
        state = engine.begin(tracks, candidates[attempt], sizes)
        while engine.add_next_camera(state, rng) is not None:
            pass
        adjust_all(state, 10, self.outlier_sigmas)
        return to_reconstruction(state)
