"""Statistics of paired differences: intervals, p-values and effect sizes.

Where the seed draws the data (noise, points, cameras), the draws are the sample and the interval is one for
these very scenes. Elsewhere the scenes are the sample: a scene counts once, by the mean over its subsets and
seeds.

Few values use Student's interval. From :data:`STUDENTISED_FROM` on it is the symmetric studentised bootstrap
(Hall, The Bootstrap and Edgeworth Expansion, 1992, 3.5), which keeps the level for skewed differences. Scenes
are resampled first, then the subsets inside them. Beyond the tenth largest resample its tail is Student's, so
that p can fall below what the resamples resolve.

Failures have their own tests: :func:`sign_test` of the rows on which only one of two methods fails (exact;
McNemar 1947), and :func:`signed_rank_test` of all rows, with a failure worse than any number (Wilcoxon 1945;
for scenes with several rows Rosner, Glynn and Lee 2006).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from thesisrecon.arrays import F64

Sample = Literal["draws", "scenes"]
STUDENTISED_FROM = 12  # With fewer values too many resamples have almost no spread
MIN_SCENES = 3  # Fewer scenes are no sample of scenes
RESAMPLES = 4999
TAIL = 10
"""Fewer of the resamples are no estimate of a probability."""
ALL_SIGNS = 12
"""Up to this many values all choices of their signs are counted."""


@dataclass(frozen=True)
class Interval:
    """The mean of paired differences, its 95 % interval and two-sided p, and the effect size: the mean over
    the standard deviation of a sampled value, with Hedges' correction for few. ``count`` values of ``sample``
    ("draws" of these very scenes, or "scenes") are behind it, ``pairs`` counts the differences. All but the
    mean are NaN where there is no sample: one value, fewer than ``MIN_SCENES`` scenes, or draws that change
    nothing.
    """

    mean: float
    low: float
    high: float
    p: float
    effect: float
    pairs: int
    sample: Sample
    count: int


def paired_interval(groups: Sequence[F64], sample: Sample, *, level: float = 0.95) -> Interval:
    """Return the interval of the mean of paired differences, grouped by scene. All scenes have equal weight,
    however many differences they have. Draws are a stratified sample, with the degrees of freedom of Welch
    and Satterthwaite. Resampling is deterministic. Raises ``ValueError`` for a difference that is not finite.
    """
    groups = [np.asarray(g, dtype=np.float64) for g in groups if len(g)]
    if any(not np.isfinite(g).all() for g in groups):
        raise ValueError("paired differences are finite")
    if not groups:
        return _without_sample(float("nan"), 0, sample, 0)
    pairs = sum(map(len, groups))
    means = np.array([g.mean() for g in groups])
    if sample == "scenes":
        if len(groups) < MIN_SCENES:
            return _without_sample(float(means.mean()), pairs, sample, len(groups))
        return _interval([means], [groups], level, pairs, sample)
    # Differences that vary by less than this fraction of their mean do not vary.
    settled = max(float(np.ptp(g)) for g in groups) <= 1e-6 * np.abs(means).max()
    if min(map(len, groups)) < 2 or settled:
        return _without_sample(float(means.mean()), pairs, sample, pairs)
    return _interval(groups, [[np.array([v]) for v in g] for g in groups], level, pairs, sample)


def _without_sample(mean: float, pairs: int, sample: Sample, count: int) -> Interval:
    nan = float("nan")
    return Interval(mean, nan, nan, nan, nan, pairs, sample, count)


def _interval(
    strata: Sequence[F64], inside: Sequence[Sequence[F64]], level: float, pairs: int, sample: Sample
) -> Interval:
    """The interval of the mean of the means of strata; ``inside`` are the differences behind each value."""
    mean, count = float(np.mean([g.mean() for g in strata])), sum(map(len, strata))
    parts = np.array([g.var(ddof=1) / len(g) for g in strata]) / len(strata) ** 2
    error = float(np.sqrt(parts.sum()))
    # Sums of equal numbers leave rounding errors, which are not spread.
    if error <= 1e-12 * max(abs(mean), 1e-300):
        effect = float(np.copysign(np.inf, mean)) if mean else 0.0
        return Interval(mean, mean, mean, float(mean == 0.0), effect, pairs, sample, count)
    freedom = float(parts.sum() ** 2 / np.sum(parts**2 / np.array([len(g) - 1.0 for g in strata])))
    t = mean / error
    if min(map(len, strata)) < STUDENTISED_FROM:
        quantile, p = float(stats.t.ppf(0.5 + level / 2, freedom)), float(2 * stats.t.sf(abs(t), freedom))
    else:
        drawn = resampled_t(inside)
        quantile = float(drawn[int(np.ceil(level * (RESAMPLES + 1))) - 1])
        p = _tail(drawn, abs(t), freedom)
    deviation = float(np.sqrt(np.mean([g.var(ddof=1) for g in strata])))
    effect = mean / deviation * (1.0 - 3.0 / (4.0 * freedom - 1.0))
    return Interval(mean, mean - quantile * error, mean + quantile * error, p, effect, pairs, sample, count)


def _tail(drawn: F64, t: float, freedom: float) -> float:
    """Share of ascending resamples at or beyond ``t``; from the tenth largest on Student's tail, stretched so
    that it passes through that one.
    """
    beyond = len(drawn) - int(np.searchsorted(drawn, t))
    last, share = float(drawn[-TAIL]), TAIL / (len(drawn) + 1)
    if beyond >= TAIL or not np.isfinite(last):
        return (1 + beyond) / (len(drawn) + 1)
    scale = max(1.0, last / float(stats.t.isf(share / 2, freedom)))
    return float(min(share, 2 * stats.t.sf(t / scale, freedom)))


def sign_test(values: F64) -> float:
    """Two-sided p of as many positive and negative values (N,) by chance, exact; zeros do not count. Of
    differences in success it is McNemar's test. NaN without a value that is not zero.
    """
    up, down = int(np.sum(values > 0.0)), int(np.sum(values < 0.0))
    return float(stats.binomtest(up, up + down).pvalue) if up + down else float("nan")


def signed_rank_test(groups: Sequence[F64]) -> tuple[float, float]:
    """Return the mean signed rank of differences, between -1 and 1, and its two-sided p. An infinite
    difference is a failure of one of the two, beyond all others; zeros are dropped. Each group has one sign
    under the null hypothesis: the rows of a scene, or one draw. NaN where nothing is left.
    """
    sizes = [len(g) for g in groups]
    values = np.concatenate([*groups, np.zeros(0)])
    ranks = np.zeros(len(values))
    moved = values != 0.0
    if not moved.any():
        return float("nan"), float("nan")
    ranks[moved] = stats.rankdata(np.abs(values[moved])) * np.sign(values[moved]) / moved.sum()
    means = np.array([part.mean() for part in np.split(ranks, np.cumsum(sizes)[:-1]) if part.any()])
    mean = float(ranks.sum() / moved.sum())
    total = abs(float(means.sum()))
    if not len(means):
        return mean, 1.0
    if len(means) > ALL_SIGNS:
        return mean, float(2 * stats.norm.sf(total / np.sqrt(np.sum(means**2))))
    signs = 1 - 2 * (np.arange(2 ** len(means))[:, None] >> np.arange(len(means)) & 1)
    # Sums that are equal but for rounding are equal.
    return mean, float(np.mean(np.abs(signs @ means) >= total - 1e-9))


def resampled_t(strata: Sequence[Sequence[F64]], *, resamples: int = RESAMPLES) -> F64:
    """Return |t| (resamples,) of hierarchical resamples of strata, ascending."""
    rng = np.random.default_rng(0)
    mean = np.mean([np.mean([inner.mean() for inner in values]) for values in strata])
    found = []
    block = max(1, 2_000_000 // sum(len(inner) for values in strata for inner in values))
    for start in range(0, resamples, block):
        count = min(block, resamples - start)
        means, squared = np.zeros(count), np.zeros(count)
        for values in strata:
            drawn = _resampled_values(values, count, rng)
            means += drawn.mean(axis=1) / len(strata)
            squared += drawn.var(axis=1, ddof=1) / len(values) / len(strata) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            found.append(np.abs(means - mean) / np.sqrt(squared))
    return np.sort(np.nan_to_num(np.concatenate(found), nan=np.inf, posinf=np.inf))


def _resampled_values(values: Sequence[F64], count: int, rng: np.random.Generator) -> F64:
    """``count`` resamples (count, N) of N values, each the mean of a resample of what is inside."""
    sizes = np.array([len(inner) for inner in values])
    table = np.zeros((len(values), sizes.max()))
    for n, inner in enumerate(values):
        table[n, : len(inner)] = inner
    chosen = rng.integers(len(values), size=(count, len(values)))
    if sizes.max() == 1:
        return np.asarray(table[chosen, 0])
    inside = (rng.random((count, len(values), sizes.max())) * sizes[chosen][..., None]).astype(np.int64)
    use = np.arange(sizes.max()) < sizes[chosen][..., None]
    drawn = np.where(use, table[chosen[..., None], inside], 0.0)
    return np.asarray(drawn.sum(axis=2) / sizes[chosen])


def holm(p: Sequence[float]) -> list[float]:
    """Adjust p-values for multiple comparisons (Holm 1979); NaN is ignored."""
    values = np.asarray(p, dtype=np.float64)
    adjusted = np.full(len(values), np.nan)
    known = np.flatnonzero(np.isfinite(values))
    order = known[np.argsort(values[known], kind="stable")]
    largest = 0.0
    for rank, k in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * values[k]))
        adjusted[k] = largest
    return [float(v) for v in adjusted]


def on_front(cost: F64, loss: F64) -> NDArray[np.bool_]:
    """Return the Pareto-optimal entries (V,); never NaN."""
    known = np.isfinite(cost) & np.isfinite(loss)
    front = known.copy()
    for k in np.flatnonzero(known):
        no_worse = known & (cost <= cost[k]) & (loss <= loss[k])
        front[k] = not np.any(no_worse & ((cost < cost[k]) | (loss < loss[k])))
    return front
