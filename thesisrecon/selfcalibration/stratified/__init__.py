"""Chapter 7, the stratified approach: the plane at infinity in three ways, then K in two."""

from thesisrecon.selfcalibration.stratified.affine import affine_camera_centres, upgrade_to_affine
from thesisrecon.selfcalibration.stratified.calibration import HartleyLinear, PollefeysQuadric
from thesisrecon.selfcalibration.stratified.cheirality_search import CheiralitySearch
from thesisrecon.selfcalibration.stratified.modulus import ModulusConstraint
from thesisrecon.selfcalibration.stratified.parallel_lines import ParallelLines, VanishingPoints
from thesisrecon.selfcalibration.stratified.variant import Stratified

__all__ = [
    "CheiralitySearch",
    "HartleyLinear",
    "ModulusConstraint",
    "ParallelLines",
    "PollefeysQuadric",
    "Stratified",
    "VanishingPoints",
    "affine_camera_centres",
    "upgrade_to_affine",
]
