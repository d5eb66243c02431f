"""Section 2.6: from depth maps to a surface with texture."""

from thesisrecon.model.depth_surface import surface_from_depth
from thesisrecon.model.fusion import DepthSheets, VolumetricFusion
from thesisrecon.model.mesh import coarser, keep_large_parts
from thesisrecon.model.stage import SurfaceModel
from thesisrecon.model.surfaces import BSplineSurface, LinearSurface

__all__ = [
    "BSplineSurface",
    "DepthSheets",
    "LinearSurface",
    "SurfaceModel",
    "VolumetricFusion",
    "coarser",
    "keep_large_parts",
    "surface_from_depth",
]
