"""Sections 2.5 and 2.6: dense correspondence of neighbouring views, and depth from it."""

from thesisrecon.dense.matching import MaximumLikelihoodScanline
from thesisrecon.dense.multiview import (
    MultiViewScene,
    MultiViewStereo,
    PairMatching,
    RectifiedPair,
    SequenceLinking,
)

__all__ = [
    "MaximumLikelihoodScanline",
    "MultiViewScene",
    "MultiViewStereo",
    "PairMatching",
    "RectifiedPair",
    "SequenceLinking",
]
