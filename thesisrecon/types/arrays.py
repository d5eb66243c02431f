"""Names of the arrays that records hold."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
B8 = NDArray[np.bool_]

Stratum = Literal["projective", "affine", "metric"]
