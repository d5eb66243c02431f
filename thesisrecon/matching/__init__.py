"""Section 4.2.2: corresponding feature points of two photographs, and tracks over all of them."""

from __future__ import annotations

from thesisrecon.matching.prepared import PreparedView
from thesisrecon.matching.records import FundamentalEstimator
from thesisrecon.matching.seeds_and_growth import SeedsAndGrowth
from thesisrecon.matching.strength import StrengthOfMatch
from thesisrecon.matching.tracks import AlignedTracks, PlainTracks

__all__ = [
    "AlignedTracks",
    "FundamentalEstimator",
    "PlainTracks",
    "PreparedView",
    "SeedsAndGrowth",
    "StrengthOfMatch",
]
