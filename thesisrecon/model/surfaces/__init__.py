"""Section 2.6: depth maps as surfaces, linear between their points or fitted."""

from thesisrecon.model.surfaces.bspline import BSplineSurface
from thesisrecon.model.surfaces.linear import LinearSurface
from thesisrecon.model.surfaces.surface import (
    DepthSurface,
    FittedSurface,
    SurfaceSample,
    normals,
    resampled,
    sampled_mesh,
)

__all__ = [
    "BSplineSurface",
    "DepthSurface",
    "FittedSurface",
    "LinearSurface",
    "SurfaceSample",
    "normals",
    "resampled",
    "sampled_mesh",
]
