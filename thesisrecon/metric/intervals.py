"""Intervals of the intrinsics that may be believed.

The covariance of bundle adjustment is right for independent noise and a right model, and too small on
photographs: matches err together, their noise has heavy tails, and lenses have more coefficients than ours.
How much too small it is shows in how far parts of the scene pull the cameras in different directions
(:mod:`thesisrecon.optimize.bundle_blocks`). What all parts have in common shows nowhere; a floor
stands for it (:mod:`thesisrecon.metric.model_error`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import scipy

from thesisrecon.metric.model import ASPECT, CENTRE, FOCAL, K1, SKEW, MetricModel
from thesisrecon.metric.model_error import LEAST_BLOCKS, USUAL_INFLATION, model_error_floor
from thesisrecon.metric.population import Borrowing
from thesisrecon.optimize.bundle_blocks import BlockScatter
from thesisrecon.optimize.metric_bundle import IntrinsicsPrior
from thesisrecon.types import F64, IntrinsicInterval

UNCHECKED = "the photographs cannot tell whether they share one focal: as of zooms that differ a little"
NORMAL_95 = 1.959964
_COLUMNS = {
    "focal_px": FOCAL, "aspect": ASPECT, "skew_px": SKEW,
    "principal_x_px": CENTRE[0], "principal_y_px": CENTRE[1],
    "k1": K1, "k2": K1 + 1, "k3": K1 + 2,
}  # fmt: skip


def intrinsic_intervals(
    model: MetricModel,
    scatter: BlockScatter,
    prior: IntrinsicsPrior,
    *,
    floor_rel: float,
    borrowed: Borrowing,
    noise_inflation: float = 1.0,
) -> tuple[Mapping[str, IntrinsicInterval], ...]:
    """Per view the intervals named in ``MetricResult`` (empty where not registered).

    ``scatter`` of the last adjustment under ``prior``; ``floor_rel`` is that of photographs, relative to the
    focal; ``noise_inflation`` by how much the noise counted for more than
    its size in ``scatter``. The std is such that +- 1.96 of it hold 95 % although it was measured on few
    blocks.
    """
    floors = model_error_floor(model, scatter, floor_rel)
    answer: list[Mapping[str, IntrinsicInterval]] = []
    for view in range(len(model.registered)):
        if not model.registered[view]:
            answer.append({})
            continue
        g = int(model.cameras.group[view])
        row = model.cameras.intrinsics[g]
        intervals = {}
        for name, column in _COLUMNS.items():
            value, variance = float(row[column]), float(scatter.model[g, column])
            if not variance > 0.0:
                intervals[name] = IntrinsicInterval(value, 0.0, "assumed")
                continue
            inflation, floor = _inflation(scatter, g, column), float(floors[g, column])
            measured = float(inflation * np.sqrt(variance))
            std = min(float(np.hypot(measured, floor)), float(prior.std[g, column]))
            how = _source(measured, floor, inflation * noise_inflation)
            if column == FOCAL and borrowed.lends(view, std):
                how = f"borrowed from the other cameras; its own matches {_open(borrowed.own_std[view])}"
            std *= row[FOCAL] if column == FOCAL else 1.0
            intervals[name] = IntrinsicInterval(value, float(std), how)
        answer.append(intervals)
    return tuple(answer)


def with_open_sharing(
    intervals: Sequence[Mapping[str, IntrinsicInterval]], focal_std: F64
) -> tuple[Mapping[str, IntrinsicInterval], ...]:
    """The intervals, those of focals widened to ``focal_std`` (V,) relative, where it is not NaN: of
    photographs that cannot tell whether their focal is one."""
    answer: list[Mapping[str, IntrinsicInterval]] = []
    for of_view, rel in zip(intervals, focal_std, strict=True):
        if of_view and np.isfinite(rel) and rel * of_view["focal_px"].value > of_view["focal_px"].std:
            focal = of_view["focal_px"]
            of_view = {**of_view, "focal_px": IntrinsicInterval(focal.value, rel * focal.value, UNCHECKED)}
        answer.append(of_view)
    return tuple(answer)


def _inflation(scatter: BlockScatter, g: int, column: int) -> float:
    ratio = float(scatter.ratio[g, column])
    if scatter.blocks < LEAST_BLOCKS or not np.isfinite(ratio):
        return USUAL_INFLATION
    return float(np.sqrt(ratio) * scipy.special.stdtrit(scatter.blocks - 1, 0.975) / NORMAL_95)


def _source(measured: float, floor: float, factor: float) -> str:
    """Where a deviation comes from: what was ``measured``, the ``factor`` in it, or the floor above it."""
    if floor > measured:
        return "bundle adjustment; what a model of a camera leaves out, which is more than the scatter shows"
    return f"bundle adjustment, deviation x {factor:.1f} from the scatter between parts of the scene"


def _open(own_std: float) -> str:
    return f"leave it open by {own_std:.2%} (one standard deviation)"
