"""Section 2.6: from depth maps to a surface with texture."""

from thesisrecon.model.depth_surface import surface_from_depth
from thesisrecon.model.fusion import VolumetricFusion
from thesisrecon.model.mesh import keep_large_parts

__all__ = ["VolumetricFusion", "keep_large_parts", "surface_from_depth"]
