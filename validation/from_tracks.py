"""Chapters 6 and 7 on tracks at hand: parts of a set matched once, and scenes without photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from thesisrecon.assumptions import IntrinsicsAssumption, assumptions_of_views
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure
from thesisrecon.pipeline import ATTEMPTS
from thesisrecon.run import stream
from thesisrecon.types import B8, I64, Assumptions, MetricResult, RunResult, Tracks, TwoView

Cameras = Literal["shared", "per-image"]


@dataclass(frozen=True)
class Matched:
    """A set that was matched: ``tracks``, verified ``pairs`` and ``sizes`` (V, 2) at working size."""

    tracks: Tracks
    pairs: tuple[TwoView, ...]
    sizes: I64

    @classmethod
    def from_run(cls, run: RunResult) -> Matched:
        """What a run found up to its tracks."""
        if run.tracks is None:
            raise ValueError("a run up to its tracks is needed; this one has none")
        return cls(run.tracks, run.pairs, np.array([image.size for image in run.images], dtype=np.int64))

    def subset(self, views: Sequence[int]) -> Matched:
        """These views alone, numbered anew in their order; points keep their numbers."""
        number = np.full(self.tracks.n_views, -1, dtype=np.int64)
        number[list(views)] = np.arange(len(views))
        pairs = [p for p in self.pairs if number[p.i] >= 0 and number[p.j] >= 0]
        kept = number[self.tracks.view_index] >= 0
        tracks = _part(self.tracks, kept)
        view = number[tracks.view_index]
        order = np.lexsort((view, tracks.point_index))
        tracks = Tracks(
            view[order], tracks.point_index[order], tracks.xy[order], len(views), self.tracks.n_points
        )
        renumbered = tuple(replace(p, i=int(number[p.i]), j=int(number[p.j])) for p in pairs)
        return Matched(tracks, renumbered, self.sizes[list(views)])

    def keeping(self, observations: B8) -> Matched:
        """Only these ``observations`` (K,) of the tracks; the pairs stay what they were."""
        return replace(self, tracks=_part(self.tracks, observations))

    def without(self, observations: B8, view: int) -> Matched:
        """Without these ``observations`` (K,), all of one ``view``, and without its pairs, whose matches
        are no longer what they were."""
        pairs = tuple(p for p in self.pairs if view not in (p.i, p.j))
        return Matched(_part(self.tracks, ~observations), pairs, self.sizes)

    def assumptions(self, wish: IntrinsicsAssumption) -> Assumptions:
        """The wish for photographs of these sizes that name no focal length."""
        n = len(self.sizes)
        sizes = [(int(width), int(height)) for width, height in self.sizes]
        return assumptions_of_views(wish, sizes, np.full(n, np.nan), np.ones(n))


def _part(tracks: Tracks, kept: B8) -> Tracks:
    """The kept observations of points that have two of them."""
    count = np.bincount(tracks.point_index[kept], minlength=tracks.n_points)
    kept = kept & (count[tracks.point_index] >= 2)
    return Tracks(
        tracks.view_index[kept], tracks.point_index[kept], tracks.xy[kept], tracks.n_views, tracks.n_points
    )


def reconstruct_tracks(matched: Matched, config: PipelineConfig, *, seed: int = 0) -> MetricResult:
    """Projective, self-calibration and metric stage as a run has them, without a folder.

    The first trusted result of up to ``ATTEMPTS`` initial pairs, else the first with most cameras;
    ``StageFailure`` where there is none.
    """
    assumed = matched.assumptions(config.intrinsics)
    results: list[MetricResult] = []
    failures: list[StageFailure] = []
    for attempt in range(ATTEMPTS):
        try:
            projective = config.projective.reconstruct(
                matched.tracks, matched.pairs, matched.sizes, rng=stream(seed, "projective", attempt),
                attempt=attempt,
            )  # fmt: skip
            calibration = config.selfcalibration.calibrate(
                projective, assumed=assumed, rng=stream(seed, "selfcalibration", attempt)
            )
            result = config.metric.refine(
                projective, calibration, assumed=assumed, rng=stream(seed, "metric", attempt)
            )
        except StageFailure as failure:
            failures.append(failure)
            continue
        results.append(result)
        if result.trusted:
            return result
    if not results:
        raise failures[0]
    return max(results, key=lambda r: int(r.reconstruction.registered.sum()))
