"""Conjugate gradients for bundle adjustments of many views, whose reduced matrix is applied, but not formed.

The preconditioner has two levels: the blocks of single views (Schur-Jacobi; Agarwal, Snavely, Seitz and
Szeliski, ECCV 2010) reduce noise, and clusters of views that move as one body by a similarity reduce the long
waves that those leave: M^-1 = sum_v S_vv^-1 + W (W' S W)^-1 W'.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon.arrays import F64, I64

FORCING = 1e-3
"""Gain of an iteration, times their number, relative to the whole gain at which a step is accurate enough."""
EXACT, MOST = 1e-7, 600
"""That for covariances, and the bound of the iterations."""


@dataclass(frozen=True)
class Preconditioner:
    """Inverse blocks (b, C, C) of views; Cholesky ``factor`` of the system of ``motions`` (b, C, m).

    Views of a cluster (``label`` (b,)) have the same coefficients (m,); common columns are coarse unknowns.
    """

    inverse: F64
    motions: F64
    label: I64
    factor: F64

    def __call__(self, r: F64) -> F64:
        """Return M^-1 r; (D,)."""
        (b, C, m), n = self.motions.shape, int(self.label.max()) + 1
        views, coarse = r[: b * C].reshape(b, C), np.zeros((n, m))
        np.add.at(coarse, self.label, np.einsum("vcm,vc->vm", self.motions, views))
        x = scipy.linalg.cho_solve((self.factor, False), np.append(coarse, r[b * C :]), check_finite=False)
        moved = np.einsum("vcm,vm->vc", self.motions, x[: n * m].reshape(n, m)[self.label])
        return np.append(moved + np.einsum("vab,vb->va", self.inverse, views), x[n * m :])


def conjugate_gradients(
    multiply: Callable[[F64], F64], precondition: Callable[[F64], F64], rhs: F64, *, forcing: float = FORCING
) -> F64:
    """Solve S x = rhs until an iteration gains little (Nash and Sofer 1990); rhs is in the range of S."""
    x, r = np.zeros_like(rhs), rhs.copy()
    z = precondition(r)
    p, product, gained = z, float(r @ z), 0.0
    for i in range(1, MOST + 1):
        q = multiply(p)
        curvature = float(p @ q)
        if not (product > 0.0 and curvature > 0.0):
            break
        step = product / curvature
        x += step * p
        r -= step * q
        gained += step * product
        if i * step * product <= forcing * gained:
            break
        z = precondition(r)
        before, product = product, float(r @ z)
        p = z + (product / before) * p
    return x
