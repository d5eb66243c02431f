"""Several depth maps as one surface."""

from thesisrecon.model.fusion.volume import VolumetricFusion

__all__ = ["VolumetricFusion"]
