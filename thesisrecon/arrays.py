"""Names of NumPy array types, defined here only, and rows of arrays by the number of their image."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
I16 = NDArray[np.int16]
B8 = NDArray[np.bool_]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
U32 = NDArray[np.uint32]
U64 = NDArray[np.uint64]

Stratum = Literal["projective", "affine", "metric"]


def rows_of_views(view: I64, n_views: int) -> list[I64]:
    """The rows of ``view`` (K,) with each view, in their order."""
    ends = np.cumsum(np.bincount(view, minlength=n_views))
    return np.split(np.argsort(view, kind="stable"), ends[:-1])
