"""In which order pairs of photographs are visited."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon.arrays import I64

_BITS = 31


def morton_pair_order(first: ArrayLike, second: ArrayLike) -> I64:
    """(M,) the pairs of views in an order in which what was made of a view serves again.

    Along Morton's curve (G. M. Morton, A computer oriented geodetic data base, IBM, 1966) through the table
    of pairs, a pair and its turned one together: parts of any size hold few different views, so that of V
    views with room for M of them some V^2 / M are made, and not one for each pair, whatever M is.
    """
    i, j = np.asarray(first, dtype=np.int64), np.asarray(second, dtype=np.int64)
    low, high = np.minimum(i, j), np.maximum(i, j)
    curve = np.zeros(len(i), dtype=np.int64)
    for bit in range(_BITS):
        curve |= ((low >> bit) & 1) << (2 * bit + 1) | ((high >> bit) & 1) << (2 * bit)
    return np.lexsort((i, curve))
