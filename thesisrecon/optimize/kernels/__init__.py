"""Compiled loops of the optimisation; every one has a NumPy twin in the tests.

One module a purpose. numba keys its cache by the file of the outermost function alone: after an edit of
``scalars`` the modules that call it must be touched too, or their old code goes on being used.
"""

from __future__ import annotations

from thesisrecon.optimize.kernels.elimination import (
    Places,
    PointSums,
    Sums,
    eliminate_points,
    mark_pairs,
    substitute_points,
    sum_leverages,
)
from thesisrecon.optimize.kernels.metric import (
    MetricModel,
    linearize_metric,
    metric_cost,
    move_poses,
    project_metric,
)
from thesisrecon.optimize.kernels.points import hold_flipping_points, refine_each_point
from thesisrecon.optimize.kernels.projective import (
    UnitState,
    linearize_projective,
    project_projective,
    projective_cost,
    tangent_reflectors,
    tangent_step,
)
from thesisrecon.optimize.kernels.records import Jacobians, Seen, Weighing
from thesisrecon.optimize.kernels.reduced import (
    add_diagonal,
    fill_band,
    fill_dense,
    invert_band,
    multiply_blocks,
)

__all__ = [
    "Jacobians",
    "MetricModel",
    "Places",
    "PointSums",
    "Seen",
    "Sums",
    "UnitState",
    "Weighing",
    "add_diagonal",
    "eliminate_points",
    "fill_band",
    "fill_dense",
    "hold_flipping_points",
    "invert_band",
    "linearize_metric",
    "linearize_projective",
    "mark_pairs",
    "metric_cost",
    "move_poses",
    "multiply_blocks",
    "project_metric",
    "project_projective",
    "projective_cost",
    "refine_each_point",
    "substitute_points",
    "sum_leverages",
    "tangent_reflectors",
    "tangent_step",
]
