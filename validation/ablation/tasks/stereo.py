"""Rectified pairs with dense truth as a task: disparities of the configured matcher."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

import numpy as np

from thesisrecon.config import PipelineConfig
from thesisrecon.errors import UsageError, unknown_word
from thesisrecon.stereo.depth import MultiViewStereo
from validation.ablation.study import Measure, Place, Task, window_names, window_parts, window_slice
from validation.metrics.depth import bad_pixels
from validation.scenes.many_views import yard_number
from validation.scenes.stereo import STEREO_PAIRS, StereoPair, load_stereo_pair


@dataclass(frozen=True)
class RectifiedPairs(Task):
    """``dense.pairs.matcher`` on a pair with dense truth, judged where both cameras see.

    "yard-N" is a rendered pair, another one for each number. A subset is a window of two thirds of the rows.
    """

    measures: ClassVar[Sequence[Measure]] = (
        Measure("bad1_pct", "%", "less", True, "pixels off by more than 1 px, holes filled along the row"),
        Measure("bad2_pct", "%", "less", True, "pixels off by more than 2 px, holes filled along the row"),
        Measure("known_pct", "%", "more", False, "share of the pixels that are known before the filling"),
    )

    def scene_of(self, scene: str) -> str:
        return window_parts(scene)[0]

    def subsets(self, scene: str, count: int) -> list[str]:
        return window_names(scene, count)

    def check(self, scene: str) -> None:
        name = self.scene_of(scene)
        if name not in STEREO_PAIRS and yard_number(name) is None:
            raise UsageError(unknown_word("scene", name, STEREO_PAIRS))
        if load_stereo_pair(name) is None:
            raise UsageError(f"the pair {name} is not on this machine (THESISRECON_DATA; scikit-image)")

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        pair = matched_pair(scene)
        if not isinstance(config.dense, MultiViewStereo):
            found = config.dense.match_rectified(
                pair.left, pair.right, max_disparity_px=float(pair.disparities - 1)
            )
        else:
            limits = (0, pair.disparities - 1)
            found = config.dense.pairs.matcher.match(pair.left, pair.right, disparity_range=limits)
        known = np.isfinite(found.disparity)[pair.judged]
        return {
            "bad1_pct": bad_pixels(found.disparity, pair, 1.0),
            "bad2_pct": bad_pixels(found.disparity, pair, 2.0),
            "known_pct": 100.0 * float(known.mean()),
        }


@lru_cache(maxsize=4)
def matched_pair(scene: str) -> StereoPair:
    """The rectified pair of a scene or the rows of a window of it."""
    pair = load_stereo_pair(window_parts(scene)[0])
    assert pair is not None
    rows = window_slice(scene, len(pair.left))
    cut = {name: getattr(pair, name)[rows] for name in ("left", "right", "truth", "judged")}
    return replace(pair, **cut)
