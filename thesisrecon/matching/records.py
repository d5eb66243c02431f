"""What the variants of this stage share: the types of the values they are given, and the empty answer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from thesisrecon.types import F32, F64, I64, FundamentalFit, Matches

FundamentalEstimator = Callable[[F64, F64, np.random.Generator], FundamentalFit]


def empty_matches(pair: tuple[int, int]) -> Matches:
    """No matches between the two views."""
    index, xy = np.empty(0, np.int64), np.empty((0, 2))
    return Matches(*pair, index, index, xy, xy, np.empty(0, np.float32), np.empty((0, 2, 2)))


def one_to_one(index: I64, score: F32) -> I64:
    """Rows that keep their claim: of those that want one corner of image 2 the best."""
    rows = np.flatnonzero(index >= 0)
    rows = rows[np.lexsort((rows, -score[rows]))]
    return np.sort(rows[np.unique(index[rows], return_index=True)[1]])


def matches_at(matches: Matches, rows: I64) -> Matches:
    """A part of the matches."""
    return Matches(
        matches.i,
        matches.j,
        matches.index1[rows],
        matches.index2[rows],
        matches.xy1[rows],
        matches.xy2[rows],
        matches.score[rows],
        matches.affine[rows],
    )
