"""Chapter 7 on synthetic scenes as a task: the focal lengths of one draw by the configured variant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from thesisrecon.config import PipelineConfig
from thesisrecon.errors import UsageError, unknown_word
from thesisrecon.records import Reconstruction
from validation.ablation.study import Measure, Place, Task
from validation.scenes.rigs import Rig
from validation.studies.selfcalibration import MODES, SCENES, Cell, assumptions, draw_cell


@dataclass(frozen=True)
class CalibrationOverNoise(Task):
    """``views`` cameras of the cube or of a cloud with Gaussian noise of ``noise_px``, handed to the
    self-calibration as the minimum of the projective bundle adjustment in a random frame.

    ``mode`` is "constant" (one focal length) or "zooming". With ``bundle`` the metric stage follows.
    """

    noise_px: float = 1.0
    views: int = 9
    mode: str = "constant"
    bundle: bool = False

    measures: ClassVar[Sequence[Measure]] = (
        Measure("focal_error_pct", "%", "less", True, "median |f / f_true - 1| of the cameras"),
        Measure("worst_focal_error_pct", "%", "less", True, "largest |f / f_true - 1| of the cameras"),
        Measure("success_pct", "%", "more", False, "100 where the median focal error is below 3 %, else 0"),
    )

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ValueError(unknown_word("mode", self.mode, MODES))
        if self.noise_px < 0.0 or not 3 <= self.views <= 27:
            raise ValueError("noise_px is at least 0, views between 3 and 27")

    def check(self, scene: str) -> None:
        if scene not in SCENES:
            raise UsageError(unknown_word("scene", scene, SCENES))

    def run(self, config: PipelineConfig, scene: str, seed: int, place: Place) -> Mapping[str, float]:
        rig, projective = _drawn(Cell(scene, self.mode, self.noise_px, self.views), seed)
        prior, rng = assumptions(rig, self.mode), np.random.default_rng(seed)
        calibration = config.selfcalibration.calibrate(projective, prior=prior, rng=rng)
        K = calibration.K
        if self.bundle:
            refined = config.metric.refine(projective, calibration, prior=prior, rng=rng)
            assert refined.reconstruction.K is not None
            K = refined.reconstruction.K
        judged = projective.registered
        error = 100.0 * np.abs(K[judged, 0, 0] / rig.K[judged, 0, 0] - 1.0)
        median = float(np.median(error))
        return {
            "focal_error_pct": median,
            "worst_focal_error_pct": float(error.max()),
            "success_pct": 100.0 * (median <= 3.0),
        }


@lru_cache(maxsize=4)
def _drawn(cell: Cell, seed: int) -> tuple[Rig, Reconstruction]:
    """Cache draws; the rows of one draw are consecutive."""
    return draw_cell(cell, seed)
