"""Chapter 6 as in the thesis: sequential projective reconstruction, used by the preset ``thesis``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from numpy.random import Generator

from thesisrecon.arrays import I64
from thesisrecon.errors import Notice, StageFailure, counted
from thesisrecon.projective._model import adjust_all, to_reconstruction
from thesisrecon.projective._track_selection import require_pair_with_parallax
from thesisrecon.projective.incremental import IncrementalProjective
from thesisrecon.records import Reconstruction, Tracks, TwoView


@dataclass(frozen=True)
class SequentialProjective:
    """Projective reconstruction of one view after the other in image order (6.6).

    Starts with the pair of neighbours with most matches; each further view is resected, new points are
    triangulated and outliers removed. One bundle adjustment at the end replaces a lost chapter of the thesis.

    Parameters
    ----------
    min_points, outlier_sigmas : int, float
        Matches needed for resection, and inlier threshold in noise sigmas.
    """

    min_points: int = 12
    outlier_sigmas: float = 12.0

    def reconstruct(
        self, tracks: Tracks, pairs: Sequence[TwoView], sizes: I64, *, rng: Generator, attempt: int = 0
    ) -> Reconstruction:
        """See `thesisrecon.config.ProjectiveReconstructor.reconstruct`."""
        require_pair_with_parallax(pairs)
        accepted = [p for p in pairs if p.accepted]
        neighbours = [p for p in accepted if p.j == p.i + 1]
        candidates = sorted(neighbours or accepted, key=lambda p: (-p.inliers, p.i, p.j))
        if attempt >= len(candidates):
            raise StageFailure(
                Notice("no-initial-pair"), f"{counted(len(candidates), 'image pair')} accepted"
            )
        incremental = IncrementalProjective(
            min_points=self.min_points,
            outlier_sigmas=(self.outlier_sigmas, self.outlier_sigmas),
            max_projection_std_rel=None,
            bundle_iterations=0,
            final_rounds=0,
        )
        model = incremental.begin(tracks, candidates[attempt], sizes)
        while incremental.add_next_camera(model, rng) is not None:
            pass
        adjust_all(model, 10, self.outlier_sigmas)
        return to_reconstruction(model, self.min_points)
