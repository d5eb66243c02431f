"""What the model of the camera leaves out: whether the data show it, and how far it may move an intrinsic.

What all parts of a scene have in common shows in no scatter. A floor stands for it, but only where the data
are seen to be more than a right model and normal noise. A value that one photograph holds alone feels an
error of the model more than that of a camera behind all of them: its floor is higher by the root of what its
standard deviation is (an error of the lens is common to all, one of the matches is each photograph's own).

Cameras of one kind: how much their intrinsics scatter about a common value, measured on themselves.

Photographs of one size are likely of one kind of lens. Each camera's own value is q_i with variance s_i^2
from its matches; the kind's values are taken as N(mu, tau^2) with mu and tau unknown (a random-effects model;
tau by restricted maximum likelihood, Harville 1977). Where the values agree within their noise tau is small
and a camera that is determined badly borrows from the others; where photographs were zoomed tau is large and
binds nothing. A camera far off the rest is left alone.

Intervals of the intrinsics that may be believed.

The covariance of bundle adjustment is right for independent noise and a right model, and too small on
photographs: matches err together, their noise has heavy tails, and lenses have more coefficients than ours.
How much too small it is shows in how far parts of the scene pull the cameras in different directions
(:mod:`thesisrecon.numerics.block_scatter`). What all parts have in common shows nowhere; a floor
stands for it (:mod:`thesisrecon.metric.uncertainty`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.metric.adjustment import Adjustment, Population
from thesisrecon.metric.model import ASPECT, CENTRE, FOCAL, K1, SKEW, WIDTH, MetricModel
from thesisrecon.numerics.block_scatter import BlockScatter
from thesisrecon.records import IntrinsicInterval

USUAL_INFLATION = 4.0
"""By how much the standard deviations of a bundle adjustment are taken to be too small on photographs where
nothing measures it: 2 to 5 is what the scatter shows where it does."""
# Below this the blocks of a scene say nothing.
LEAST_BLOCKS = 4
# The contradiction of noise alone keeps below the first; at the second the model is surely wrong somewhere.
CONTRADICTION = (1.3, 1.8)
# The same of the residuals' tail: normal noise has 1, matches of photographs 2 to 3.
TAIL = (1.2, 1.6)


def model_error_share(scatter: BlockScatter, tail: float) -> float:
    """0 where nothing but normal noise is seen, 1 where the model of camera and noise is surely not the whole
    truth."""
    if scatter.blocks < LEAST_BLOCKS or not np.isfinite(scatter.overdispersion):
        return 1.0
    signs = [(scatter.overdispersion, CONTRADICTION), (tail, TAIL)]
    return max(float(np.clip((sign - low) / (high - low), 0.0, 1.0)) for sign, (low, high) in signs)


def model_error_floor(model: MetricModel, scatter: BlockScatter, floor_rel: float) -> F64:
    """(G, C) standard deviation that the model's error gives each intrinsic (the focal's relative).

    ``floor_rel`` is that of one camera behind all photographs, relative to the focal; k1's is as large.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        alone = np.maximum(np.nan_to_num(scatter.variance / scatter.shared_variance), 1.0) ** 0.25
    units = np.ones_like(model.cameras.intrinsics)
    units[:, (SKEW, *CENTRE)] = model.cameras.intrinsics[:, :1]
    return np.asarray(floor_rel * model_error_share(scatter, model.tail) * alone * units)


# Intrinsics that a kind may have in common: focal, principal point, k1.
COLUMNS = (FOCAL, *CENTRE, K1)
LEAST_MEMBERS = 3
OUTLIER_SIGMAS = 4.0
# Cameras of one zoom setting are of one lens, whose k2 and k3 they share.
SAME_ZOOM = 0.01
LEAST_SPREAD = 1e-6
# The part of their noise by which values may differ although they agree.
BY_CHANCE = 0.3


@dataclass(frozen=True)
class OwnValues:
    """What each row's own matches say: ``value``, ``std`` (G, 8) (log of the focal, its std relative) by the
    noise, ``floor`` (G, 8) std by errors of the model, and which rows are ``members`` of a kind (G,), -1 for
    none."""

    value: F64
    std: F64
    floor: F64
    members: I64


def own_values(
    model: MetricModel, adjustment: Adjustment, scatter: BlockScatter, floor_rel: float
) -> OwnValues:
    """The model's intrinsics before a population binds them; rows without a registered view are no
    members."""
    group = model.cameras.group
    first = np.unique(group, return_index=True)[1]
    value = model.cameras.intrinsics.copy()
    value[:, FOCAL] = np.log(value[:, FOCAL])
    members = np.unique(adjustment.prior.kind[first], return_inverse=True)[1].reshape(-1)
    registered = np.isin(np.arange(len(first)), group[model.registered])
    inflation = np.sqrt(np.maximum(scatter.median_ratio, 1.0))
    members = np.where(registered, members, -1)
    std = inflation * np.sqrt(np.maximum(scatter.variance, 0.0))
    return OwnValues(value, std, model_error_floor(model, scatter, floor_rel), members)


def estimate_population(own: OwnValues, shared: I64) -> Population | None:
    """The kinds among the rows and the spread of their values; None where nothing is to be borrowed.

    Raises nothing: kinds with fewer than ``LEAST_MEMBERS`` distinct values are left alone.
    """
    rows = own.members.copy()
    spread = np.full((len(rows), WIDTH), np.inf)
    outside = np.zeros(len(rows), dtype=bool)
    for column in COLUMNS:
        for kind in np.unique(rows[rows >= 0]):
            index = np.flatnonzero(rows == kind)
            index = index[np.unique(shared[index, column], return_index=True)[1]]
            value, std = own.value[index, column], own.std[index, column]
            if len(index) < LEAST_MEMBERS or not (std > 0.0).all():
                continue
            total = np.hypot(std, own.floor[index, column])
            far = outlying(value, total)
            if column == FOCAL:
                outside |= np.isin(shared[:, column], shared[index[far], column]) & (rows == kind)
            spread[rows == kind, column] = measured_spread(value[~far], std[~far], total[~far])
    rows[outside] = -1
    return Population(rows, spread) if np.isfinite(spread).any() else None


def outlying(value: F64, std: F64) -> B8:
    """(n,) values further from the median than ``OUTLIER_SIGMAS`` of their noise and the values' scatter."""
    off = np.abs(value - np.median(value))
    scatter = 1.4826 * float(np.median(off))
    return np.asarray(off > OUTLIER_SIGMAS * np.hypot(scatter, std))


def measured_spread(value: F64, std: F64, total: F64) -> float:
    """Standard deviation tau of the true values behind n noisy ones, by restricted maximum likelihood.

    ``std`` (n,) is their noise, ``total`` their noise and the error of the model, which is no difference
    between cameras. A few values can agree by chance: tau is never below a part of the noise.
    """
    if len(value) < 2:
        return np.inf
    taus = np.concatenate(
        [[0.0], np.geomspace(1e-2 * float(total.min()), 10.0 * float(np.ptp(value)) + 1e-9, 200)]
    )
    variance = taus[:, None] ** 2 + total**2
    weight = 1.0 / variance
    mean = (weight @ value) / weight.sum(axis=1)
    squares = np.sum(weight * (value - mean[:, None]) ** 2, axis=1)
    likelihood = -0.5 * (np.log(variance).sum(axis=1) + np.log(weight.sum(axis=1)) + squares)
    tau = float(taus[int(likelihood.argmax())])
    return max(float(np.hypot(tau, BY_CHANCE * np.median(std))), LEAST_SPREAD)


def bind(
    model: MetricModel, adjustment: Adjustment, population: Population
) -> tuple[MetricModel, Adjustment]:
    """The adjustment with the population, and the model with the lens shared where the zoom is one."""
    assert model.cameras.shared is not None
    shared = model.cameras.shared.copy()
    for kind in np.unique(population.rows[population.rows >= 0]):
        rows = np.flatnonzero(population.rows == kind)
        if population.spread[rows[0], FOCAL] < SAME_ZOOM:
            shared[rows, K1 + 1 :] = shared[rows[0], K1 + 1 :]
    model = replace(model, cameras=replace(model.cameras, shared=shared))
    return model, replace(adjustment, population=population)


@dataclass(frozen=True)
class Borrowing:
    """How far each view's focal stands on its own: ``own_std`` (V,) relative, what its own matches give (one
    deviation, with the error of the model as in every stated one), and ``weight`` (V,) its part in the
    answer, 1 where nothing was borrowed."""

    own_std: F64
    weight: F64

    def lends(self, view: int, std: float) -> bool:
        """Whether the others tell more of a view's focal than its own matches; ``std`` is stated of it."""
        return bool(self.weight[view] < 0.5 and self.own_std[view] > std)

    def warnings(self, registered: Sequence[int], least: float) -> tuple[str, ...]:
        """A sentence for each focal that its own matches leave open by more than ``least`` (relative)."""
        said = []
        for view in registered:
            if self.own_std[view] > least:
                end = (
                    "it is borrowed from the other cameras"
                    if self.weight[view] < 0.5
                    else "no other camera is there to borrow from"
                )
                said.append(
                    f"the focal length of view {view} is not determined by its own matches "
                    f"(open by {self.own_std[view]:.0%}, one standard deviation); {end}"
                )
        return tuple(said)


def borrowing(own: OwnValues, population: Population | None, group: I64) -> Borrowing:
    """Who borrows a focal: weight tau^2 / (tau^2 + s_i^2) on a camera's own matches."""
    std = own.std[:, FOCAL]
    weight = np.ones(len(std))
    if population is not None:
        tau = population.spread[:, FOCAL]
        bound = (population.rows >= 0) & np.isfinite(tau)
        tau = np.where(bound, tau, 1.0)
        weight = np.where(bound, tau**2 / (tau**2 + std**2), 1.0)
    return Borrowing(np.hypot(std, own.floor[:, FOCAL])[group], weight[group])


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
            value, variance = float(row[column]), float(scatter.variance[g, column])
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
