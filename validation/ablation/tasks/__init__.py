"""Tasks of study rows."""

from __future__ import annotations

from validation.ablation.tasks.calibration import CalibrationOverNoise
from validation.ablation.tasks.fundamental import FundamentalOfCube
from validation.ablation.tasks.pairs import ImagePairs
from validation.ablation.tasks.reconstruction import Reconstruction
from validation.ablation.tasks.stereo import RectifiedPairs
from validation.ablation.tasks.triangulation import TriangulationOverNoise

__all__ = ["TASKS", "Reconstruction"]

# The word of a study file and the task it means.
TASKS: dict[str, type] = {
    "reconstruction": Reconstruction,
    "pairs": ImagePairs,
    "fundamental": FundamentalOfCube,
    "triangulation": TriangulationOverNoise,
    "self-calibration": CalibrationOverNoise,
    "stereo": RectifiedPairs,
}
