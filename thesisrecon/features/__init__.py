"""Section 4.2.1: feature points."""

from __future__ import annotations

from typing import Protocol

from thesisrecon.features.harris import HarrisCorners
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.types import Features, Image

__all__ = ["Detector", "HarrisCorners", "MultiScaleCorners"]


class Detector(Protocol):
    """What a variant of this stage does."""

    def detect(self, image: Image) -> Features:
        """Corners of one photograph."""
        ...
