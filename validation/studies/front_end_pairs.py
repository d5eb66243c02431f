"""Verified matches of pairs with known cameras: our front ends beside SIFT.

All front ends get the same images; their matches go through one estimator of F and one verification, those of
the preset ``default``. A match counts as verified if it is an inlier, within max(2.5 sigma, 0.3 px), of an F
that is right: the RMS distance of true correspondences to its epipolar lines is below 1 px.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.config import PipelineConfig, preset
from thesisrecon.geometry.two_view import sampson_residuals
from thesisrecon.io._images import read_images
from thesisrecon.pipeline._image_pair import match_views
from thesisrecon.records import Image, TwoView
from validation.metrics.epipolar import rms_epipolar_distance
from validation.metrics.record import Metric
from validation.references.sift import sift_front_end
from validation.scenes.real import load_real_scene
from validation.scenes.real_pairs import camera_pairs
from validation.studies.runner import Rows, text_table

OURS, THESIS, SIFT = "ours", "thesis", "SIFT"
MAX_SIZE_PX = 1536
RIGHT_PX = 1.0
VERIFIED_TARGETS = {1: 1.05, 2: 1.4, 3: 1.7}
SIGMA_TARGETS = {1: 0.6, 2: 0.7, 3: 0.75}
ALL_MUST_BE_RIGHT = (1, 2)
Values = dict[str, float | None]


def front_ends() -> dict[str, PipelineConfig]:
    """Return default, thesis and SIFT front ends with one estimator and verification."""
    ours, thesis = preset("default"), preset("thesis")
    return {
        OURS: ours,
        THESIS: replace(ours, features=thesis.features, matching=thesis.matching),
        SIFT: sift_front_end(ours),
    }


@dataclass(frozen=True)
class Related:
    """A pair of images by one front end, and the error of its F."""

    view: TwoView
    error_px: float

    @property
    def right(self) -> bool:
        return self.error_px < RIGHT_PX

    @property
    def verified(self) -> int:
        return self.view.inliers if self.right else 0

    @property
    def falsely_accepted(self) -> bool:
        return self.view.accepted and not self.right

    @property
    def residual_px(self) -> float:
        """RMS Sampson distance of the verified matches to their own F, NaN without matches."""
        if self.view.inliers == 0:
            return float("nan")
        d = sampson_residuals(self.view.F, self.view.xy1, self.view.xy2)
        return float(np.sqrt(np.mean(d**2)))


@dataclass(frozen=True)
class MeasuredPair:
    """One pair (i, i + gap) by every front end."""

    name: str
    gap: int
    by: Mapping[str, Related]


class PreparedViews:
    """Prepared images of one front end, computed on first use."""

    def __init__(self, config: PipelineConfig, images: tuple[Image, ...]) -> None:
        self.config, self.images = config, images
        self._views: dict[int, Any] = {}

    def __getitem__(self, i: int) -> Any:
        if i not in self._views:
            features = self.config.features.detect(self.images[i])
            self._views[i] = self.config.matching.prepare(self.images[i], features)
        return self._views[i]

    def relate(self, i: int, j: int, seed: int = 0) -> TwoView:
        return match_views(self.config, self[i], self[j], (i, j), seed)


def measure_pairs(
    scene_name: str,
    gaps: tuple[int, ...],
    cache: Path,
    *,
    names: tuple[str, ...] = (OURS, THESIS, SIFT),
    most: int | None = None,
) -> Iterator[MeasuredPair]:
    """Relate the pairs (i, i + gap) of a scene with known cameras, ``most`` of each gap."""
    scene = load_real_scene(scene_name)
    if scene is None:
        return
    images = read_images(scene.image_paths, max_size_px=MAX_SIZE_PX).images
    configs = front_ends()
    by = {name: PreparedViews(configs[name], images) for name in names}
    for gap in gaps:
        for i, pair in enumerate(islice(camera_pairs(scene, cache, (gap,)), most)):
            assert pair.truth is not None
            views = {name: prepared.relate(i, i + gap) for name, prepared in by.items()}
            related = {n: Related(v, rms_epipolar_distance(v.F, pair.truth)) for n, v in views.items()}
            yield MeasuredPair(f"{i}-{i + gap}", gap, related)


def check_pairs(scene: str, gap: int, pairs: list[MeasuredPair]) -> list[Metric]:
    """Return the rows of one scene and gap; ours is held against SIFT."""

    def over(read: Callable[[list[Related]], float]) -> Values:
        return {name: read([pair.by[name] for pair in pairs]) for name in pairs[0].by}

    def to_sift(read: Callable[[Related], float]) -> Values:
        return {name: _mean_ratio(pairs, name, read) for name in pairs[0].by}

    right = over(lambda found: float(sum(r.right for r in found)))
    everyone, beyond_sift = float(len(pairs)), float(right[SIFT] or 0.0) + 1.0
    needed = everyone if gap in ALL_MUST_BE_RIGHT else min(everyone, beyond_sift)
    verified = over(lambda found: float(sum(r.verified for r in found)))
    of_sums: Values = {name: (total or 0.0) / (verified[SIFT] or 1.0) for name, total in verified.items()}
    more, of_pairs = VERIFIED_TARGETS.get(gap), to_sift(lambda r: float(r.verified))
    sure = over(lambda found: float(sum(r.falsely_accepted and not r.view.undetermined for r in found)))
    rows = Rows(f"{scene}, (i, i+{gap})", OURS)
    rows.add("verified matches, all pairs", verified)
    rows.add("verified, mean of the pairs' ratios to SIFT", of_pairs, at_least=more)
    rows.add("verified, ratio of the sums to SIFT", of_sums, at_least=more)
    rows.add(f"pairs whose F is right, of {len(pairs)}", right, at_least=needed)
    rows.add("median error of F", over(lambda found: float(np.median([r.error_px for r in found]))), "px")
    rows.add("largest error of F", over(lambda found: max(r.error_px for r in found)), "px")
    sigma, bound = to_sift(lambda r: r.view.sigma_px), SIGMA_TARGETS.get(gap)
    rows.add("sigma, mean of the pairs' ratios to SIFT", sigma, at_most=bound)
    rows.add("RMS of verified residuals, mean of the ratios to SIFT", to_sift(lambda r: r.residual_px))
    false = over(lambda found: float(sum(r.falsely_accepted for r in found)))
    rows.add("pairs accepted with a wrong F", false, at_most=0.0)
    rows.add("of these, not called undetermined", sure)
    return rows


def _mean_ratio(pairs: list[MeasuredPair], name: str, read: Callable[[Related], float]) -> float | None:
    """Return the mean over pairs that SIFT relates rightly; a wrong F counts 0 or, without a number, not."""
    ratios = [
        read(pair.by[name]) / read(pair.by[SIFT])
        for pair in pairs
        if pair.by[SIFT].right and (pair.by[name].right or read(pair.by[name]) == 0.0)
    ]
    return float(np.mean(ratios)) if ratios else None


def pair_table(scene: str, pairs: Sequence[MeasuredPair]) -> str:
    """Return verified matches / error of F px / sigma px of every pair and front end."""
    methods = list(pairs[0].by)
    return text_table([scene, *methods], ([p.name, *(_cell(p.by[name]) for name in methods)] for p in pairs))


def _cell(found: Related) -> str:
    wrong = "" if found.right else ", WRONG" if found.view.accepted else ", wrong and refused"
    open_ = ", undetermined" if found.view.undetermined else ""
    return f"{found.view.inliers} / {found.error_px:.2f} / {found.view.sigma_px:.3f}{wrong}{open_}"
