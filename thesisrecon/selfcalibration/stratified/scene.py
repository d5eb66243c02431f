"""What the ways to the plane at infinity are given, and what they give."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thesisrecon.selfcalibration.frame import ReferenceFrame
from thesisrecon.selfcalibration.stratified.image_conic import ConicKnowledge
from thesisrecon.types import Reconstruction

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class ProjectiveScene:
    """A projective reconstruction, its registered cameras in a reference frame, what is assumed of them."""

    reconstruction: Reconstruction
    frame: ReferenceFrame
    knowledge: ConicKnowledge


@dataclass(frozen=True)
class PlaneCandidates:
    """Planes at infinity p (B, 3), each (p, 1) in the reference frame, the best first with their ``scores``.

    ``orthogonal`` (M, 2, 3): pairs of vanishing points in the reference view, unit-free, whose directions are
    taken to be at right angles.
    """

    planes: F64
    scores: F64
    orthogonal: F64 = field(default_factory=lambda: np.zeros((0, 2, 3)))
