"""Image observations of scene points, and an order of view pairs for a cache of views."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon.arrays import F64, I64

_MORTON_BITS = 31


class Observations(NamedTuple):
    """Image observations of scene points, in any order; sorted by point is fastest.

    Parameters
    ----------
    view_index, point_index, xy : ndarray (K,) of int, (K,) of int, (K, 2)
        View, point and pixels of each observation.
    """

    view_index: I64
    point_index: I64
    xy: F64


def morton_pair_order(first: ArrayLike, second: ArrayLike) -> I64:
    """Return an order of view pairs in which cached data of a view are reused.

    Ranges of Morton's curve (IBM, 1966) contain few different views: a cache of M of V computes V^2 / M.

    Parameters
    ----------
    first, second : array_like (M,) of int
        Views of each pair.

    Returns
    -------
    ndarray (M,) of int
        Indices of the pairs; a pair and its reverse are adjacent.
    """
    i, j = np.asarray(first, dtype=np.int64), np.asarray(second, dtype=np.int64)
    low, high = np.minimum(i, j), np.maximum(i, j)
    curve = np.zeros(len(i), dtype=np.int64)
    for bit in range(_MORTON_BITS):
        curve |= ((low >> bit) & 1) << (2 * bit + 1) | ((high >> bit) & 1) << (2 * bit)
    return np.lexsort((i, curve))
