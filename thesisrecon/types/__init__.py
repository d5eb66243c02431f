"""The records that travel between the stages.

Frozen dataclasses around plain NumPy arrays; the mathematics takes and returns plain arrays.
Conventions: ``xy`` are pixels, x right, y down, (0, 0) the centre of the top-left pixel;
``P = K [R t]`` with R world-to-camera; ``x2' F x1 = 0``; views, points and observations are
numbered i, j, k. A view's number is its place in the sorted list of photographs and never changes.
"""

from thesisrecon.types.arrays import B8, F32, F64, I64, Stratum
from thesisrecon.types.dense import (
    DepthMap,
    DisparityMap,
    HeldOut,
    PinholeView,
    RenderedView,
    TexturedMesh,
)
from thesisrecon.types.front_end import (
    Certainty,
    Features,
    FundamentalFit,
    Image,
    Matches,
    PairChoice,
    Seeds,
    TwoView,
)
from thesisrecon.types.reconstruction import (
    INTRINSICS,
    Assumptions,
    IntrinsicInterval,
    MetricResult,
    MotionVerdict,
    Reconstruction,
    SelfCalibration,
    Tracks,
    Upgrade,
)
from thesisrecon.types.run import RunResult, StageReport

__all__ = [
    "B8",
    "F32",
    "F64",
    "I64",
    "INTRINSICS",
    "Assumptions",
    "Certainty",
    "DepthMap",
    "DisparityMap",
    "Features",
    "FundamentalFit",
    "HeldOut",
    "Image",
    "IntrinsicInterval",
    "Matches",
    "MetricResult",
    "MotionVerdict",
    "PairChoice",
    "PinholeView",
    "Reconstruction",
    "RenderedView",
    "RunResult",
    "Seeds",
    "SelfCalibration",
    "StageReport",
    "Stratum",
    "TexturedMesh",
    "Tracks",
    "TwoView",
    "Upgrade",
]
