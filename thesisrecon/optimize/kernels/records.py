"""Arrays that travel together into the kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class Jacobians(NamedTuple):
    """Weighted ``residual`` (K, 2) and Jacobians ``A`` (K, 2, C), ``E`` (K, 2, F), ``B`` (K, 2, 3)."""

    residual: F64
    A: F64
    E: F64
    B: F64

    @classmethod
    def empty(cls, n: int, own: int, common: int) -> Jacobians:
        """Buffers of n observations with ``own`` columns in A and ``common`` ones in E."""
        return cls(*(np.empty((n, *shape)) for shape in [(2,), (2, own), (2, common), (2, 3)]))

    def part(self, first: int, last: int) -> Jacobians:
        """Those of observations first..last, without a copy."""
        return Jacobians(*(a[first:last] for a in self))


class Seen(NamedTuple):
    """Observations: ``view_index`` and ``point_index`` (K,), ``xy`` (K, 2) px."""

    view_index: I64
    point_index: I64
    xy: F64

    def part(self, first: int, last: int) -> Seen:
        """Observations first..last, without a copy."""
        return Seen(self.view_index[first:last], self.point_index[first:last], self.xy[first:last])


class Weighing(NamedTuple):
    """Residuals are counted in units of ``sigma`` under loss number ``code``, which turns at ``delta``.

    ``least`` is the share of the curvature along a residual that is kept at least where its loss bends
    (Triggs et al., Bundle Adjustment, 1999, equation 11): 1 is plain reweighting, less comes closer to
    Newton's steps.
    """

    sigma: float
    code: int
    delta: float
    least: float = 1.0
