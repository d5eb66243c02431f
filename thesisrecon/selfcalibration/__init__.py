"""Chapter 7: self-calibration."""

from thesisrecon.selfcalibration.focal_scan import FocalScan
from thesisrecon.selfcalibration.focal_vote import FocalsFromFundamental
from thesisrecon.selfcalibration.hypotheses import HypothesesAndRefinement
from thesisrecon.selfcalibration.kruppa import KruppaEquations
from thesisrecon.selfcalibration.nonlinear_quadric import NonlinearQuadric
from thesisrecon.selfcalibration.quadric import LinearQuadric, ScannedQuadric
from thesisrecon.selfcalibration.refinement import RotationCriterion
from thesisrecon.selfcalibration.stratified import (
    CheiralitySearch,
    HartleyLinear,
    ModulusConstraint,
    ParallelLines,
    PollefeysQuadric,
    Stratified,
    VanishingPoints,
    affine_camera_centres,
    upgrade_to_affine,
)

__all__ = [
    "CheiralitySearch",
    "FocalScan",
    "FocalsFromFundamental",
    "HartleyLinear",
    "HypothesesAndRefinement",
    "KruppaEquations",
    "LinearQuadric",
    "ModulusConstraint",
    "NonlinearQuadric",
    "ParallelLines",
    "PollefeysQuadric",
    "RotationCriterion",
    "ScannedQuadric",
    "Stratified",
    "VanishingPoints",
    "affine_camera_centres",
    "upgrade_to_affine",
]
