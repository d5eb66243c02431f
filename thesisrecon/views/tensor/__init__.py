"""Section 1.3: new views from two photographs by the trilinear tensor (Avidan and Shashua)."""

from thesisrecon.views.tensor.pair import (
    AnyRotation,
    CalibratedPair,
    SmallRotation,
    guessed_intrinsics,
    pair_from_fundamental,
)
from thesisrecon.views.tensor.seed import VirtualTensor, seed_of_three, seed_of_two

__all__ = [
    "AnyRotation",
    "CalibratedPair",
    "SmallRotation",
    "VirtualTensor",
    "guessed_intrinsics",
    "pair_from_fundamental",
    "seed_of_three",
    "seed_of_two",
]
