"""Statistics of paired differences: intervals, p-values and effect sizes.

Few differences use Student's interval. From :data:`STUDENTISED_FROM` on it is the symmetric studentised
bootstrap (Hall, The Bootstrap and Edgeworth Expansion, 1992, 3.5): |t| of resamples replaces Student's
quantile, which keeps the level for skewed differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from thesisrecon.arrays import F64

Unit = Literal["seeds", "scenes"]

STUDENTISED_FROM = 12
"""With fewer differences too many resamples have almost no spread."""
SCENES_FROM = 6
"""Minimum number of scenes that are treated as a sample of scenes."""
RESAMPLES = 4999
_BLOCK = 2_000_000


@dataclass(frozen=True)
class Interval:
    """The mean of paired differences, its 95 % interval and two-sided p, and the effect size: the mean over
    the standard deviation of a difference, with Hedges' correction for few (infinite where all differences
    are the same and not 0).

    ``pairs`` counts differences. ``unit`` says what was drawn at random: "seeds" of these very scenes, or
    "scenes" of which these are a sample. NaN where there are too few to say.
    """

    mean: float
    low: float
    high: float
    p: float
    effect: float
    pairs: int
    unit: Unit


def paired_interval(groups: Sequence[F64], *, level: float = 0.95) -> Interval:
    """Return the interval of the mean of paired differences, grouped by scene.

    All scenes have equal weight, however many differences they have. Where there are at least ``SCENES_FROM``
    scenes, or three whose differences do not depend on the seed, the scenes' means are the sample and the
    answer is one for scenes like these. Else only the seeds are drawn at random (a stratified sample, degrees
    of freedom by Welch and Satterthwaite), and the answer is one for these scenes. Resampling is
    deterministic. Raises ``ValueError`` for a difference that is not finite.
    """
    groups = [np.asarray(g, dtype=np.float64) for g in groups if len(g)]
    if any(not np.isfinite(g).all() for g in groups):
        raise ValueError("paired differences are finite")
    if not groups:
        nan = float("nan")
        return Interval(nan, nan, nan, nan, nan, 0, "seeds")
    pairs = sum(map(len, groups))
    settled = all(np.ptp(g) == 0.0 for g in groups)
    if len(groups) >= SCENES_FROM or (settled and len(groups) >= 3):
        return _interval([np.array([g.mean() for g in groups])], level, pairs, "scenes")
    return _interval(groups, level, pairs, "seeds")


def _interval(strata: Sequence[F64], level: float, pairs: int, unit: Unit) -> Interval:
    mean = float(np.mean([g.mean() for g in strata]))
    parts = _parts(strata)
    error = float(np.sqrt(parts.sum()))
    deviation = float(np.sqrt(np.mean([g.var(ddof=1) for g in strata if len(g) > 1] or [np.nan])))
    if min(map(len, strata)) < 2:
        nan = float("nan")
        return Interval(mean, nan, nan, nan, nan, pairs, unit)
    # Sums of equal numbers leave rounding errors, which are not spread.
    if error <= 1e-12 * max(abs(mean), 1e-300):
        effect = float(np.copysign(np.inf, mean)) if mean else 0.0
        return Interval(mean, mean, mean, float(mean == 0.0), effect, pairs, unit)
    freedom = float(parts.sum() ** 2 / np.sum(parts**2 / np.array([len(g) - 1.0 for g in strata])))
    t = mean / error
    if min(map(len, strata)) < STUDENTISED_FROM:
        quantile, p = float(stats.t.ppf(0.5 + level / 2, freedom)), float(2 * stats.t.sf(abs(t), freedom))
    else:
        drawn = resampled_t(strata)
        quantile = float(drawn[int(np.ceil(level * (RESAMPLES + 1))) - 1])
        p = float((1 + np.sum(drawn >= abs(t))) / (RESAMPLES + 1))
    effect = mean / deviation * (1.0 - 3.0 / (4.0 * freedom - 1.0))
    return Interval(mean, mean - quantile * error, mean + quantile * error, p, effect, pairs, unit)


def _parts(strata: Sequence[F64]) -> F64:
    """Return the contribution of each stratum to the squared standard error of the mean of means."""
    found = [g.var(ddof=1) / len(g) if len(g) > 1 else np.nan for g in strata]
    return np.array(found) / len(strata) ** 2


def resampled_t(strata: Sequence[F64], *, resamples: int = RESAMPLES) -> F64:
    """|t| of resamples drawn with replacement inside each stratum, ascending, (resamples,)."""
    rng = np.random.default_rng(0)
    mean = np.mean([g.mean() for g in strata])
    found = []
    block = max(1, _BLOCK // sum(map(len, strata)))
    for start in range(0, resamples, block):
        count = min(block, resamples - start)
        means, squared = np.zeros(count), np.zeros(count)
        for g in strata:
            drawn = g[rng.integers(len(g), size=(count, len(g)))]
            means += drawn.mean(axis=1) / len(strata)
            squared += drawn.var(axis=1, ddof=1) / len(g) / len(strata) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            found.append(np.abs(means - mean) / np.sqrt(squared))
    return np.sort(np.nan_to_num(np.concatenate(found), nan=np.inf, posinf=np.inf))


def holm(p: Sequence[float]) -> list[float]:
    """Adjust p-values for multiple comparisons (Holm 1979): all below alpha are jointly correct with a
    probability of 1 - alpha. NaN is ignored."""
    values = np.asarray(p, dtype=np.float64)
    adjusted = np.full(len(values), np.nan)
    known = np.flatnonzero(np.isfinite(values))
    order = known[np.argsort(values[known], kind="stable")]
    largest = 0.0
    for rank, k in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * values[k]))
        adjusted[k] = largest
    return [float(v) for v in adjusted]


def mean_ranks(blocks: F64) -> F64:
    """Mean rank of each column (B, V) -> (V,), 1 the least of its row; equal values share their ranks, and
    NaN come last."""
    filled = np.where(np.isnan(blocks), np.inf, blocks)
    return np.asarray(stats.rankdata(filled, axis=1).mean(axis=0))


def on_front(cost: F64, loss: F64) -> NDArray[np.bool_]:
    """Return the Pareto-optimal entries (V,); never NaN."""
    known = np.isfinite(cost) & np.isfinite(loss)
    front = known.copy()
    for k in np.flatnonzero(known):
        no_worse = known & (cost <= cost[k]) & (loss <= loss[k])
        front[k] = not np.any(no_worse & ((cost < cost[k]) | (loss < loss[k])))
    return front
