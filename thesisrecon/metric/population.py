"""Cameras of one kind: how much their intrinsics scatter about a common value, measured on themselves.

Photographs of one size are likely of one kind of lens. Each camera's own value is q_i with variance s_i^2
from its matches; the kind's values are taken as N(mu, tau^2) with mu and tau unknown (a random-effects model;
tau by restricted maximum likelihood, Harville 1977). Where the values agree within their noise tau is small
and a camera that is determined badly borrows from the others; where photographs were zoomed tau is large and
binds nothing. A camera far off the rest is left alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.metric.adjustment import Adjustment, Population
from thesisrecon.metric.model import CENTRE, FOCAL, K1, WIDTH, MetricModel
from thesisrecon.metric.model_error import model_error_floor
from thesisrecon.optimize.bundle_blocks import BlockScatter
from thesisrecon.types import B8, I64

F64 = NDArray[np.float64]

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
    members = np.unique(adjustment.assumed.alike[first], return_inverse=True)[1].reshape(-1)
    registered = np.isin(np.arange(len(first)), group[model.registered])
    inflation = np.sqrt(np.maximum(scatter.typical_ratio, 1.0))
    members = np.where(registered, members, -1)
    std = inflation * np.sqrt(np.maximum(scatter.model, 0.0))
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
