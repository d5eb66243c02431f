"""Several depth maps to one surface: their mean in space, or their own surfaces put together."""

from thesisrecon.model.fusion.sheets import DepthSheets
from thesisrecon.model.fusion.volume import VolumetricFusion

__all__ = ["DepthSheets", "VolumetricFusion"]
