"""What the variants of this stage share: the types of the values they are given, and the empty answer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from thesisrecon.types import F64, FundamentalFit, Matches

FundamentalEstimator = Callable[[F64, F64, np.random.Generator], FundamentalFit]


def empty_matches(pair: tuple[int, int]) -> Matches:
    """No matches between the two views."""
    index, xy = np.empty(0, np.int64), np.empty((0, 2))
    return Matches(*pair, index, index, xy, xy, np.empty(0, np.float32), np.empty((0, 2, 2)))
