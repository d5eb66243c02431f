"""Strips of rows, so that the memory of a pair is bounded and threads have something to share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TypeVar

Result = TypeVar("Result")
Strip = tuple[int, int, int, int]

MARGIN = 24
"""Rows above and below that a strip also looks at: what is farther off hardly changes a path."""
LEAST = 32


def row_strips(height: int, bytes_per_row: int, memory_bytes: float) -> list[Strip]:
    """(first, last, from, to) of strips: rows [first, last) are its own, [from, to) it looks at.

    The fewest whose rows, margins included, fit the memory, but with at least ``LEAST`` rows of their own.
    They depend on the sizes alone, never on the number of threads.
    """
    fitting = int(memory_bytes // max(bytes_per_row, 1))
    if height <= fitting:
        return [(0, height, 0, height)]
    own = max(fitting - 2 * MARGIN, LEAST)
    count = -(-height // own)
    edges = [height * k // count for k in range(count + 1)]
    return [
        (first, last, max(first - MARGIN, 0), min(last + MARGIN, height)) for first, last in pairwise(edges)
    ]


def run_strips(work: Callable[[Strip], Result], strips: Sequence[Strip], threads: int) -> list[Result]:
    """``work`` of every strip, in order, on so many threads."""
    if threads < 2 or len(strips) < 2:
        return [work(strip) for strip in strips]
    with ThreadPoolExecutor(min(threads, len(strips))) as pool:
        return list(pool.map(work, strips))
