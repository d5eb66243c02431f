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


class _WithoutAdjustment(IncrementalProjective):
    """Resection and triangulation alone, without a test of the new camera."""

    outlier_sigmas = (12.0, 12.0)
    max_projection_std_rel = None
    bundle_iterations, final_rounds = 0, 0


@dataclass(frozen=True)
class SequentialProjective:
    """Projective reconstruction of one view after the other in image order (6.6).

    Starts with the pair of neighbours with most matches; each further view is resected, new points are
    triangulated and outliers removed. One bundle adjustment at the end replaces a lost chapter of the thesis.
    """

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
        incremental = _WithoutAdjustment()
        model = incremental.begin(tracks, candidates[attempt], sizes)
        while incremental.add_next_camera(model, rng) is not None:
            pass
        adjust_all(model, 10, incremental.outlier_sigmas[1])
        return to_reconstruction(model, incremental.min_points)
