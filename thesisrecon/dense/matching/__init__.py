"""Section 2.5, dense correspondence of a rectified pair.

The scanline program that the thesis refers to, and what came of it: scanlines tied together by the columns,
and semi-global matching.
"""

from thesisrecon.dense.matching.costs import CensusAndColour
from thesisrecon.dense.matching.door import PairMatcher, match_rectified
from thesisrecon.dense.matching.finish import Finish
from thesisrecon.dense.matching.paths import PathPenalties
from thesisrecon.dense.matching.scanline import MaximumLikelihoodScanline
from thesisrecon.dense.matching.semi_global import CohesiveScanlines, SemiGlobal

__all__ = [
    "CensusAndColour",
    "CohesiveScanlines",
    "Finish",
    "MaximumLikelihoodScanline",
    "PairMatcher",
    "PathPenalties",
    "SemiGlobal",
    "match_rectified",
]
