"""Section 2.5, rectification: maps of a pair to a frame in which epipolar lines are rows of equal number.

Planar from F (Hartley; Loop and Zhang; the least distorted), planar from metric cameras (a common
orientation), polar for any position of the epipoles, and the best of them by what each does to the
photographs.
"""

from thesisrecon.dense.rectification.choice import (
    AnyRectification,
    LeastDistorted,
    disparity_range,
    rectify,
    rectify_cameras,
    rectify_pair,
)
from thesisrecon.dense.rectification.from_cameras import CommonOrientation
from thesisrecon.dense.rectification.from_fundamental import Hartley, LeastDistortion, LoopZhang
from thesisrecon.dense.rectification.pair import EpipolarPair, pair_of_cameras, pair_of_fundamental
from thesisrecon.dense.rectification.planar import FrameLimits, PlanarRectification
from thesisrecon.dense.rectification.polar import Polar, PolarRectification
from thesisrecon.dense.rectification.quality import RectificationQuality, measure_quality

__all__ = [
    "AnyRectification",
    "CommonOrientation",
    "EpipolarPair",
    "FrameLimits",
    "Hartley",
    "LeastDistorted",
    "LeastDistortion",
    "LoopZhang",
    "PlanarRectification",
    "Polar",
    "PolarRectification",
    "RectificationQuality",
    "disparity_range",
    "measure_quality",
    "pair_of_cameras",
    "pair_of_fundamental",
    "rectify",
    "rectify_cameras",
    "rectify_pair",
]
