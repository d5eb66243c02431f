"""The range of disparities that is searched."""

from __future__ import annotations

LARGEST = 4096
"""Disparities in a range, at most."""


def checked_range(disparity_range: tuple[int, int]) -> tuple[int, int]:
    """First and last disparity, both included; ``ValueError`` where they are no range."""
    first, last = (int(d) for d in disparity_range)
    if not 0 <= last - first < LARGEST:
        raise ValueError(f"a disparity range needs first <= last < first + {LARGEST}; got {disparity_range}")
    return first, last
