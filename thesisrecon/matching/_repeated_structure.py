"""Rejection of pairs that match repeated structure: few matches between views that show different places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.records import TwoView

FEW_VIEWS = 40
"""Up to this number of views no pair is rejected: few pairs are redundant then."""
STRONG = 0.1
"""A pair is strong if it has this fraction of the matches, or common points, of the best pair of one of its
views."""
MAX_STEPS = 5
"""Maximum number of strong pairs on the shortest path between two views of the same place."""


def reject_repeated_structure(pairs: Sequence[TwoView], n_views: int) -> list[TwoView]:
    """Reject weak pairs whose views are connected only by long paths of strong pairs.

    Views that overlap are connected by a short path of strong pairs through the views between them. Equal
    windows of two houses give few matches between views that only a long path connects. Weak pairs between
    groups that no strong pair connects stay, because nothing else relates these groups.
    """
    accepted = [pair for pair in pairs if pair.accepted]
    if n_views <= FEW_VIEWS or not accepted:
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
    """Pairs of views (M, 2), the first one from ``start``, that at most ``steps`` edges connect."""
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
