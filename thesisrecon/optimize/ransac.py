"""RANSAC: random samples, and the model of least truncated cost among them (Fischler and Bolles 1981)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import F64, I64


def draw_samples(rng: Generator, count: int, n: int, size: int) -> I64:
    """Samples (count, size) of distinct numbers below n."""
    return rng.random((count, n)).argpartition(size - 1, axis=1)[:, :size]


def search_models(
    solve: Callable[[I64], F64], costs: Callable[[F64], F64], rng: Generator, n: int, size: int, *,
    batch: int, batches: int, risk: float,
) -> F64:  # fmt: skip
    """The model of least cost that ``solve`` makes of random samples (batch, size) of n data.

    ``costs`` are means of truncated squares in [0, 1]: 1 minus the least is at most the share of inliers. The
    search ends when a sample without outliers was drawn with probability 1 - ``risk``.
    """
    least = np.inf
    for drawn in range(batch, batch * batches + 1, batch):
        models = solve(draw_samples(rng, batch, n, size))
        cost = costs(models)
        if cost.min() < least or drawn == batch:
            least, best = float(cost.min()), models[cost.argmin()]
        if drawn * np.log1p(-min((1.0 - least) ** size, 1.0 - 1e-9)) < np.log(risk):
            break
    return np.asarray(best)
