"""Section 1.2: physically valid views between two photographs by interpolation (Seitz and Dyer 1995)."""

from thesisrecon.views.interpolation.frame import FrameBetween
from thesisrecon.views.interpolation.monotonicity import Monotonicity, check_monotonicity
from thesisrecon.views.interpolation.pair import (
    Blending,
    InterpolatedPair,
    other_side,
    pair_of_rectified,
    unsure,
)

__all__ = [
    "Blending",
    "FrameBetween",
    "InterpolatedPair",
    "Monotonicity",
    "check_monotonicity",
    "other_side",
    "pair_of_rectified",
    "unsure",
]
