"""What the ways to choose pairs share."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import combinations
from typing import Any

import numpy as np

from thesisrecon.types import I64

MapAll = Callable[[Callable[[Any], Any], Iterable[Any]], list[Any]]
"""Calls a function on each item, perhaps in several threads, and returns the answers in order."""


def pair_array(pairs: Iterable[Iterable[int]]) -> I64:
    """Pairs as (M, 2) with the smaller number first, sorted."""
    rows = sorted({(min(pair), max(pair)) for pair in (tuple(p) for p in pairs)})
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def every_pair(n: int) -> I64:
    """All pairs of ``n`` views."""
    return pair_array(combinations(range(n), 2))
