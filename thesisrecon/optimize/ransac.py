"""RANSAC (Fischler and Bolles 1981): samples, rejection, local optimisation, and what chance explains."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy
from numpy.random import Generator

from thesisrecon.arrays import F64, I64

# Data on which all models are tried first, and data on which the remaining ones are scored.
FIRST, SCORED = 48, 2000
# Probability that a good model is rejected by its first data, and the quantile of the normal distribution.
LOST, LOST_SIGMAS = 0.05, 1.645
# Residuals of models computed at once.
AT_ONCE = 2**17
CHANCE = -4.0
"""Logarithm to base 10 of the largest expected number of models of wrong data with as many inliers."""


class Budget(NamedTuple):
    """Probability that one of the samples has no outlier, and the largest number of samples."""

    confidence: float = 0.9999
    max_samples: int = 100_000


class Found(NamedTuple):
    """The best model, the number of samples, and its inliers among the scored data (rows)."""

    model: F64
    samples: int
    inliers: I64


def draw_samples(rng: Generator, count: int, n: int, size: int) -> I64:
    """Samples (count, size) of distinct numbers below n."""
    if n < 8 * size:
        return rng.random((count, n)).argpartition(size - 1, axis=1)[:, :size]
    drawn = rng.integers(0, n, (count, size))
    while len(again := np.flatnonzero((np.diff(np.sort(drawn, axis=1), axis=1) == 0).any(axis=1))):
        drawn[again] = rng.integers(0, n, (len(again), size))
    return drawn


def search_models(
    solve: Callable[[I64], F64],
    squared: Callable[[F64, I64], F64],
    refit: Callable[[F64, I64], F64],
    rng: Generator,
    n: int,
    size: int,
    budget: Budget,
) -> Found | None:
    """The model of least truncated cost of random samples of ``size`` of n data, each best one refitted.

    ``solve`` makes models (B', ...) of samples (B, size); ``squared`` gives squared distances (B', M) of
    some data from models, 1 at the threshold; ``refit`` improves one model by its inliers (rows). Models with
    fewer inliers among the first data than the best one leads to expect are not scored further, as in the
    sequential test of Matas and Chum (ICCV 2005). The search ends when a sample without outliers was drawn
    with the confidence of the ``budget``. None without any model.
    """
    scored = rng.permutation(n) if n <= SCORED else rng.choice(n, SCORED, replace=False)
    most = max(AT_ONCE // FIRST, 64)
    best, least, share, drawn, batch = None, np.inf, 0.0, 0, 64
    while drawn < budget.max_samples:
        batch = min(batch, budget.max_samples - drawn)
        models = solve(draw_samples(rng, batch, n, size))
        drawn += batch
        if len(models):
            inside = np.count_nonzero(squared(models, scored[:FIRST]) < 1.0, axis=1)
            tried = min(FIRST, len(scored))
            models = models[inside >= tried * share - LOST_SIGMAS * np.sqrt(tried * share * (1.0 - share))]
        for some in np.array_split(models, len(models) * len(scored) // AT_ONCE + 1) if len(models) else ():
            cost = np.minimum(squared(some, scored), 1.0).mean(axis=1)
            if cost.min() < least:
                best, least, inliers = _refitted(some[cost.argmin()], squared, refit, scored)
                share = len(inliers) / len(scored)
        good = (1.0 - LOST) * min(share**size, 1.0 - 1e-9)
        if drawn * np.log1p(-good) < np.log1p(-budget.confidence):
            break
        batch = min(2 * batch, most)
    return None if best is None else Found(best, drawn, inliers)


def _refitted(
    model: F64, squared: Callable[[F64, I64], F64], refit: Callable[[F64, I64], F64], scored: I64
) -> tuple[F64, float, I64]:
    """A model refitted to its inliers while its cost falls (Chum et al. 2003), its cost and its inliers."""
    distances = squared(model[None], scored)[0]
    for _ in range(4):
        inliers = scored[distances < 1.0]
        trial = refit(model, inliers)
        now = squared(trial[None], scored)[0]
        if not np.minimum(now, 1.0).sum() < np.minimum(distances, 1.0).sum():
            break
        model, distances = trial, now
    return model, float(np.minimum(distances, 1.0).mean()), scored[distances < 1.0]


def log10_false_alarms(agreeing: float, tried: float, *, chance: float, free: int) -> float:
    """log10 of the expected number of models with as many inliers among wrong matches, sums of weights.

    A-contrario bound (tried - free) C(tried, free) P(Binomial >= agreeing - free): the model passes through
    ``free`` matches, the rest agree with probability ``chance`` (Moisan and Stival, IJCV 57, 2004).
    """
    rest, hits = tried - free, agreeing - free
    if hits <= 0.0 or rest <= 0.0:
        return 0.0
    tail = float(scipy.special.betainc(hits, max(rest - hits, 0.0) + 1.0, min(chance, 1.0)))
    ways = (
        scipy.special.gammaln(tried + 1.0)
        - scipy.special.gammaln(free + 1.0)
        - scipy.special.gammaln(rest + 1.0)
        + np.log(max(rest, 1.0))
    )
    return float((ways + np.log(max(tail, 1e-300))) / np.log(10.0))
