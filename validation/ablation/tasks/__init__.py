"""Tasks of study rows."""

from __future__ import annotations

from validation.ablation.tasks.images import ImagePairs, RectifiedPairs
from validation.ablation.tasks.reconstruction import Reconstruction
from validation.ablation.tasks.searches import RobustSearch
from validation.ablation.tasks.synthetic import (
    CalibrationOverNoise,
    FundamentalOfCube,
    TriangulationOverNoise,
)

__all__ = ["TASKS", "Reconstruction"]

# The word of a study file and the task it means.
TASKS: dict[str, type] = {
    "reconstruction": Reconstruction,
    "pairs": ImagePairs,
    "search": RobustSearch,
    "fundamental": FundamentalOfCube,
    "triangulation": TriangulationOverNoise,
    "self-calibration": CalibrationOverNoise,
    "stereo": RectifiedPairs,
}
