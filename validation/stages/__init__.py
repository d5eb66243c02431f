"""The stages of a report, by name, in the order of the pipeline."""

from __future__ import annotations

from validation.runs.records import Stage
from validation.runs.scenes import available_scenes
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

STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        BoardsStage(),
        FundamentalStage(),
        FeaturesStage(),
        TriangulationStage(),
        CamerasStage(),
        CloudsStage(),
        BundleStage(),
        DisparityStage(),
        ViewInterpolationStage(),
        DepthStage(),
        SurfaceStage(),
        ViewsStage(),
    )
}
