"""Section 1.3: new views from two photographs by the trilinear tensor (Avidan and Shashua)."""

from thesisrecon.views.tensor.pair import (
    AnyRotation,
    CalibratedPair,
    SmallRotation,
    guessed_intrinsics,
    pair_from_fundamental,
)
from thesisrecon.views.tensor.path import VirtualCamera, camera_at, cameras_along
from thesisrecon.views.tensor.seed import VirtualTensor, seed_of_three, seed_of_two
from thesisrecon.views.tensor.synthesis import TensorSynthesis, prepare_synthesis

__all__ = [
    "AnyRotation",
    "CalibratedPair",
    "SmallRotation",
    "TensorSynthesis",
    "VirtualCamera",
    "VirtualTensor",
    "camera_at",
    "cameras_along",
    "guessed_intrinsics",
    "pair_from_fundamental",
    "prepare_synthesis",
    "seed_of_three",
    "seed_of_two",
]
