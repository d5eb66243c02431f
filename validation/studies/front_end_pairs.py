"""Verified matches of pairs of photographs with known cameras: our front ends beside SIFT.

All front ends see the same photographs, and their matches go through one estimator of F and one verification,
those of the preset ``default``. A match counts as verified where it is an inlier, within max(2.5 sigma,
0.3 px), of an F that is right: the RMS distance of true correspondences to its epipolar lines is below 1 px.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.config import PipelineConfig, preset
from thesisrecon.geometry.two_view import sampson_residuals
from thesisrecon.io.images import read_photographs
from thesisrecon.pipeline.features_to_tracks import detect_features, match_views
from thesisrecon.records import Image, TwoView
from validation.metrics.epipolar import NONE_PX, rms_epipolar_distance
from validation.metrics.record import Metric
from validation.references.sift_front_end import sift_front_end
from validation.scenes.real import load_real_scene
from validation.scenes.real_pairs import camera_pairs

OURS, THESIS, SIFT = "ours", "thesis", "SIFT"
MAX_SIZE_PX = 1536
RIGHT_PX = 1.0
VERIFIED_TARGETS = {1: 1.05, 2: 1.4, 3: 1.7}
SIGMA_TARGETS = {1: 0.6, 2: 0.7, 3: 0.75}
ALL_MUST_BE_RIGHT = (1, 2)
Values = dict[str, float | None]


def front_ends() -> dict[str, PipelineConfig]:
    """The default, the thesis' corners and correlation, and SIFT, all with one estimator and verification."""
    ours, thesis = preset("default"), preset("thesis")
    return {
        OURS: ours,
        THESIS: replace(ours, features=thesis.features, matching=thesis.matching),
        SIFT: sift_front_end(ours),
    }


@dataclass(frozen=True)
class Related:
    """A pair of photographs by one front end: what it verified and how far its F is from the truth."""

    view: TwoView
    error_px: float

    @property
    def right(self) -> bool:
        """Whether the F is right."""
        return self.error_px < RIGHT_PX

    @property
    def verified(self) -> int:
        """Inliers of a right F."""
        return self.view.inliers if self.right else 0

    @property
    def falsely_accepted(self) -> bool:
        """Whether the pair passed the verification with a wrong F."""
        return self.view.accepted and not self.right

    @property
    def residual_px(self) -> float:
        """RMS Sampson distance of the verified matches to their own F, NaN without any."""
        if self.view.inliers == 0:
            return float("nan")
        d = sampson_residuals(self.view.F, self.view.xy1, self.view.xy2)
        return float(np.sqrt(np.mean(d**2)))


@dataclass(frozen=True)
class MeasuredPair:
    """One pair of views (i, i + gap) by every front end."""

    name: str
    gap: int
    by: Mapping[str, Related]


class PreparedViews:
    """What one front end needs of each photograph, computed when it is first asked for."""

    def __init__(self, config: PipelineConfig, images: tuple[Image, ...]) -> None:
        self.config, self.images = config, images
        self._views: dict[int, Any] = {}

    def __getitem__(self, i: int) -> Any:
        if i not in self._views:
            features = detect_features(self.config, self.images[i])
            self._views[i] = self.config.matching.prepare(self.images[i], features)
        return self._views[i]

    def relate(self, i: int, j: int, seed: int = 0) -> TwoView:
        """Matches, F and verification of one pair."""
        return match_views(self.config, self[i], self[j], (i, j), seed)


def measure_pairs(
    scene_name: str,
    gaps: tuple[int, ...],
    cache: Path,
    *,
    names: tuple[str, ...] = (OURS, THESIS, SIFT),
    most: int | None = None,
) -> Iterator[MeasuredPair]:
    """The pairs (i, i + gap) of a scene with known cameras, ``most`` of each gap, by the front ends
    ``names``; nothing where the photographs are not on this machine."""
    scene = load_real_scene(scene_name)
    if scene is None:
        return
    images = read_photographs(scene.image_paths, max_size_px=MAX_SIZE_PX).images
    configs = front_ends()
    by = {name: PreparedViews(configs[name], images) for name in names}
    for gap in gaps:
        for i, pair in enumerate(islice(camera_pairs(load_real_scene(scene_name), cache, (gap,)), most)):
            assert pair.truth is not None
            views = {name: prepared.relate(i, i + gap) for name, prepared in by.items()}
            related = {name: Related(view, _error(view, pair.truth)) for name, view in views.items()}
            yield MeasuredPair(f"{i}-{i + gap}", gap, related)


def _error(view: TwoView, truth: F64) -> float:
    return rms_epipolar_distance(view.F, truth) if view.F.any() else NONE_PX


def check_pairs(scene: str, gap: int, pairs: list[MeasuredPair]) -> list[Metric]:
    """The rows of one scene and gap, ours judged against SIFT and the targets."""

    def row(name: str, values: Values, unit: str = "", **judged: Any) -> Metric:
        return Metric(f"{scene}, (i, i+{gap})", name, unit, values, OURS, **judged)

    def over(read: Callable[[list[Related]], float]) -> Values:
        return {name: read([pair.by[name] for pair in pairs]) for name in pairs[0].by}

    def to_sift(read: Callable[[Related], float]) -> Values:
        return {name: _mean_ratio(pairs, name, read) for name in pairs[0].by}

    right = over(lambda found: float(sum(r.right for r in found)))
    everyone, beyond_sift = float(len(pairs)), float(right[SIFT] or 0.0) + 1.0
    needed = everyone if gap in ALL_MUST_BE_RIGHT else min(everyone, beyond_sift)
    verified = over(lambda found: float(sum(r.verified for r in found)))
    of_sums: Values = {name: (total or 0.0) / (verified[SIFT] or 1.0) for name, total in verified.items()}
    more: dict[str, Any] = {"target": VERIFIED_TARGETS.get(gap), "at_most": False}
    of_pairs, of_sigma = to_sift(lambda r: float(r.verified)), to_sift(lambda r: r.view.sigma_px)
    false = over(lambda found: float(sum(r.falsely_accepted for r in found)))
    sure = over(lambda found: float(sum(r.falsely_accepted and not r.view.undetermined for r in found)))
    return [
        row("verified matches, all pairs", verified),
        row("verified, mean of the pairs' ratios to SIFT", of_pairs, **more),
        row("verified, ratio of the sums to SIFT", of_sums, **more),
        row(f"pairs whose F is right, of {len(pairs)}", right, target=needed, at_most=False),
        row("median error of F", over(lambda found: float(np.median([r.error_px for r in found]))), "px"),
        row("largest error of F", over(lambda found: max(r.error_px for r in found)), "px"),
        row("sigma, mean of the pairs' ratios to SIFT", of_sigma, target=SIGMA_TARGETS.get(gap)),
        row("RMS of verified residuals, mean of the ratios to SIFT", to_sift(lambda r: r.residual_px)),
        row("pairs accepted with a wrong F", false, target=0.0),
        row("of these, not called undetermined", sure),
    ]


def _mean_ratio(pairs: list[MeasuredPair], name: str, read: Callable[[Related], float]) -> float | None:
    """Mean over the pairs that SIFT relates rightly; a wrong F of the other counts 0, or not where it has no
    such number."""
    ratios = [
        read(pair.by[name]) / read(pair.by[SIFT])
        for pair in pairs
        if pair.by[SIFT].right and (pair.by[name].right or read(pair.by[name]) == 0.0)
    ]
    return float(np.mean(ratios)) if ratios else None


def pair_table(scene: str, pairs: list[MeasuredPair]) -> str:
    """Every pair as a row: verified matches / error of F px / sigma px of each front end."""
    methods = list(pairs[0].by)
    lines = [
        f"| {scene} | {' | '.join(methods)} |",
        f"| --- |{' --- |' * len(methods)}",
    ]
    for pair in pairs:
        cells = [_cell(pair.by[name]) for name in methods]
        lines.append(f"| {pair.name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(found: Related) -> str:
    wrong = "" if found.right else ", WRONG" if found.view.accepted else ", wrong and refused"
    open_ = ", undetermined" if found.view.undetermined else ""
    return f"{found.view.inliers} / {found.error_px:.2f} / {found.view.sigma_px:.3f}{wrong}{open_}"
