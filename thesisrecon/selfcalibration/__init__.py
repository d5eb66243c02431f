"""Chapter 7: self-calibration."""

from thesisrecon.selfcalibration.hypotheses import HartleySearch, HypothesesAndRefinement
from thesisrecon.selfcalibration.infinity_search import InfinitySearch
from thesisrecon.selfcalibration.refinement import RotationCriterion

__all__ = ["HartleySearch", "HypothesesAndRefinement", "InfinitySearch", "RotationCriterion"]
