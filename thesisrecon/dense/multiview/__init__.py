"""Sections 2.5 and 2.6: depth maps of every view from all photographs.

Undistorted views, the choice of neighbours, pairwise correspondence through rectification, linking through
the sequence or robust fusion, and consistency between the maps.
"""

from thesisrecon.dense.multiview.completion import Completion
from thesisrecon.dense.multiview.consistency import Consistency
from thesisrecon.dense.multiview.correspondence import Correspondence, PairMatching
from thesisrecon.dense.multiview.linking import InverseDepth, Linker, RobustFusion, SequenceLinking
from thesisrecon.dense.multiview.neighbours import NeighbourChoice, SparsePoints, sparse_points
from thesisrecon.dense.multiview.refinement import PlaneRefinement
from thesisrecon.dense.multiview.stage import MultiViewScene, MultiViewStereo
from thesisrecon.dense.multiview.two_views import RectifiedPair, match_two_views
from thesisrecon.dense.multiview.undistort import pinhole_view

__all__ = [
    "Completion",
    "Consistency",
    "Correspondence",
    "InverseDepth",
    "Linker",
    "MultiViewScene",
    "MultiViewStereo",
    "NeighbourChoice",
    "PairMatching",
    "PlaneRefinement",
    "RectifiedPair",
    "RobustFusion",
    "SequenceLinking",
    "SparsePoints",
    "match_two_views",
    "pinhole_view",
    "sparse_points",
]
