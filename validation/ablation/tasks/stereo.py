"""Rectified pairs with dense truth as a task: disparities of the configured matcher."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from thesisrecon.config import PipelineConfig
from thesisrecon.errors import UsageError, unknown_word
from thesisrecon.stereo.depth import MultiViewStereo
from validation.ablation.study import Measure, Place, Task
from validation.metrics.depth import bad_pixels
from validation.scenes.stereo import STEREO_PAIRS, StereoPair, load_stereo_pair


@dataclass(frozen=True)
class RectifiedPairs(Task):
    """``dense.pairs.matcher`` on a pair with dense truth, judged where both cameras see."""

    measures: ClassVar[Sequence[Measure]] = (
        Measure("bad1_pct", "%", "less", True, "pixels off by more than 1 px, holes filled along the row"),
        Measure("bad2_pct", "%", "less", True, "pixels off by more than 2 px, holes filled along the row"),
        Measure("known_pct", "%", "more", False, "share of the pixels that are known before the filling"),
    )

    def check(self, scene: str) -> None:
        if scene not in STEREO_PAIRS:
            raise UsageError(unknown_word("scene", scene, STEREO_PAIRS))
        if load_stereo_pair(scene) is None:
            raise UsageError(f"the pair {scene} is not on this machine (THESISRECON_DATA; scikit-image)")

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        pair = _pair(scene)
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
def _pair(scene: str) -> StereoPair:
    pair = load_stereo_pair(scene)
    assert pair is not None
    return pair
