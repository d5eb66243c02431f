"""Pairs of places that look alike: few matches between views that are far apart by the strong pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.records import TwoView

MANY_VIEWS = 40
"""Fewer views have few pairs, none of which is redundant."""
STRONG = 0.1
"""A pair is strong if it has this fraction of the matches, or common points, of the best pair of one of its
views."""
MAX_STEPS = 5
"""Strong pairs that connect the views of a weak one at most, if both show one place."""


def reject_repeated_structure(pairs: Sequence[TwoView], n_views: int) -> list[TwoView]:
    """Reject weak pairs whose views many strong pairs separate.

    Views with a common part are connected through views between them, which share more with both. The same
    windows on two houses give few matches, and the houses are far apart. Weak pairs that connect groups of
    strongly connected views stay: nothing else relates these.
    """
    accepted = [pair for pair in pairs if pair.accepted]
    if n_views <= MANY_VIEWS or not accepted:
        return list(pairs)
    i, j, count = np.array([(pair.i, pair.j, pair.inliers) for pair in accepted]).T
    strong = strong_pairs(i, j, count, n_views)
    ends = i[strong], j[strong]
    graph = scipy.sparse.coo_array((np.ones(strong.sum()), ends), (n_views, n_views)).tocsr()
    group = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    steps = _steps_within(graph + graph.T, np.unique(i[~strong]), MAX_STEPS)
    weak = ~strong & (group[i] == group[j])
    apart = set(zip(i[weak].tolist(), j[weak].tolist(), strict=True)) - set(map(tuple, steps.tolist()))
    return [
        replace(pair, accepted=False, reason=_reason(pair))
        if pair.accepted and (pair.i, pair.j) in apart
        else pair
        for pair in pairs
    ]


def strong_pairs(i: I64, j: I64, count: I64 | F64, n_views: int) -> B8:
    """Whether pairs (i, j) have ``STRONG`` of the ``count`` of the best pair of one of their views."""
    most = np.zeros(n_views, count.dtype)
    np.maximum.at(most, np.concatenate([i, j]), np.tile(count, 2))
    return np.asarray(count >= STRONG * np.minimum(most[i], most[j]))


def _steps_within(graph: scipy.sparse.csr_array, start: np.ndarray, steps: int) -> np.ndarray:
    """Views (M, 2) that at most so many edges connect, of those that begin at ``start``."""
    reached = scipy.sparse.csr_array((np.ones(len(start)), (start, start)), (graph.shape[0], graph.shape[0]))
    for _ in range(steps):
        reached = reached + reached @ graph
        reached.data[:] = 1.0
    return np.column_stack(reached.nonzero())


def _reason(pair: TwoView) -> str:
    return (
        f"its {pair.inliers} matches are few compared with those of each image's best pair, and "
        f"at least {MAX_STEPS + 1} strong pairs separate the images: probably repeated structure"
    )
