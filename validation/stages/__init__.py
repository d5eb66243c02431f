"""The stages of a report, by name, in the order of the pipeline."""

from __future__ import annotations

import tomllib
from pathlib import Path

from validation.runs.records import Stage, available_scenes
from validation.stages.boards import BoardsStage
from validation.stages.bundle import BundleStage
from validation.stages.cameras import CamerasStage
from validation.stages.clouds import CloudsStage
from validation.stages.depth import DepthStage
from validation.stages.disparity import DisparityStage
from validation.stages.features import FeaturesStage
from validation.stages.fundamental import FundamentalStage
from validation.stages.surface import SurfaceStage
from validation.stages.triangulation import TriangulationStage
from validation.stages.view_interpolation import ViewInterpolationStage
from validation.stages.views import ViewsStage

__all__ = ["STAGES", "available_scenes"]
_PAIRS = (BoardsStage(), FundamentalStage(), FeaturesStage(), TriangulationStage())
_CAMERAS = (CamerasStage(), CloudsStage(), BundleStage())
_DENSE = (DisparityStage(), ViewInterpolationStage(), DepthStage(), SurfaceStage(), ViewsStage())
STAGES: dict[str, Stage] = {stage.name: stage for stage in (*_PAIRS, *_CAMERAS, *_DENSE)}
for _name, _texts in tomllib.loads(Path(__file__).parent.with_suffix(".toml").read_text("utf-8")).items():
    STAGES[_name].title, STAGES[_name].definition = _texts["title"], _texts["definition"]
