"""Section 4.2.1: feature points."""

from __future__ import annotations

from thesisrecon.features.harris import HarrisCorners
from thesisrecon.features.measure import CornerMeasure
from thesisrecon.features.multiscale import MultiScaleCorners

__all__ = ["CornerMeasure", "HarrisCorners", "MultiScaleCorners"]
