"""Depth made to agree with the photographs themselves, by slanted windows."""

from thesisrecon.dense.multiview.refinement.planes import PlaneRefinement

__all__ = ["PlaneRefinement"]
