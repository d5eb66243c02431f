"""The stages of a report, by name, in the order of the pipeline."""

from __future__ import annotations

from validation.harness.records import Stage
from validation.harness.scenes import available_scenes
from validation.harness.stages.between import BetweenStage
from validation.harness.stages.boards import BoardsStage
from validation.harness.stages.bundle import BundleStage
from validation.harness.stages.cameras import CamerasStage
from validation.harness.stages.clouds import CloudsStage
from validation.harness.stages.depth import DepthStage
from validation.harness.stages.disparity import DisparityStage
from validation.harness.stages.features import FeaturesStage
from validation.harness.stages.fundamental import FundamentalStage
from validation.harness.stages.surface import SurfaceStage
from validation.harness.stages.triangulation import TriangulationStage
from validation.harness.stages.views import ViewsStage

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
        BetweenStage(),
        DepthStage(),
        SurfaceStage(),
        ViewsStage(),
    )
}
