"""Chapter 7: self-calibration."""

from thesisrecon.selfcalibration.focal_scan import FocalScan
from thesisrecon.selfcalibration.focal_vote import FocalsFromFundamental
from thesisrecon.selfcalibration.hypotheses import HartleySearch, HypothesesAndRefinement
from thesisrecon.selfcalibration.infinity_search import InfinitySearch
from thesisrecon.selfcalibration.kruppa import KruppaEquations
from thesisrecon.selfcalibration.nonlinear_quadric import NonlinearQuadric
from thesisrecon.selfcalibration.quadric import LinearQuadric, ScannedQuadric
from thesisrecon.selfcalibration.refinement import RotationCriterion

__all__ = [
    "FocalScan",
    "FocalsFromFundamental",
    "HartleySearch",
    "HypothesesAndRefinement",
    "InfinitySearch",
    "KruppaEquations",
    "LinearQuadric",
    "NonlinearQuadric",
    "RotationCriterion",
    "ScannedQuadric",
]
