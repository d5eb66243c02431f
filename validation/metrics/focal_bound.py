"""The Cramer-Rao bound of focal lengths from points in many views (chapter 7)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64
from validation.scenes.rigs import Rig

_STEP = 1e-6


def focal_bound(rig: Rig, sigma_px: float, *, zooming: bool, principal_std_px: float) -> F64:
    """Relative standard deviations (V,) of the focals, in percent; one of all views unless ``zooming``. All
    views share a principal point. Points seen by fewer than two views do not count.
    """
    seen = np.isfinite(rig.pixels()[..., 0])
    seen &= seen.sum(axis=0) >= 2
    n, groups = len(rig.K), len(rig.K) if zooming else 1
    size = 6 * n + groups + 2
    information = np.zeros((size, size))
    point_part = np.zeros((len(rig.X), 3, 3))
    mixed = np.zeros((len(rig.X), size, 3))
    for v in range(n):
        k = np.flatnonzero(seen[v])
        columns = np.r_[6 * v : 6 * v + 6, 6 * n + (v if zooming else 0), size - 2, size - 1]
        J, B = _derivatives(rig, v, rig.X[k])
        information[np.ix_(columns, columns)] += np.einsum("kra,krb->ab", J, J)
        point_part[k] += B.swapaxes(1, 2) @ B
        mixed[k[:, None], columns] += J.swapaxes(1, 2) @ B
    used = seen.any(axis=0)
    W, V = mixed[used], np.linalg.inv(point_part[used])
    information -= np.einsum("kac,kcd,kbd->ab", W, V, W)
    information /= sigma_px**2
    information[range(size - 2, size), range(size - 2, size)] += principal_std_px**-2
    # The pseudo-inverse removes the seven gauge freedoms; focal lengths do not depend on them.
    scale = 1.0 / np.sqrt(information.diagonal())
    value, vector = np.linalg.eigh(information * scale * scale[:, None])
    inverse = np.where(np.arange(size) < 7, 0.0, 1.0 / np.maximum(value, 1e-15))
    variance = np.sum(vector**2 * inverse, axis=1) * scale**2
    std = 100.0 * np.sqrt(variance[6 * n : 6 * n + groups])
    return std if zooming else np.repeat(std, n)


def _derivatives(rig: Rig, v: int, X: F64) -> tuple[F64, F64]:
    """Derivatives of pixels of X (M, 3) by (rotation, shift, log f, centre) (M, 2, 9) and X (M, 2, 3)."""

    def pixels(p: F64) -> F64:
        R = Rotation.from_rotvec(p[:3]).as_matrix() @ rig.R[v]
        x = (X - rig.C[v] - p[9:]) @ R.T + p[3:6]
        f = rig.K[v, [0, 1], [0, 1]] * np.exp(p[6])
        return np.asarray(x[:, :2] / x[:, 2:] * f + rig.K[v, :2, 2] + p[7:9])

    steps = _STEP * np.eye(12)
    J = np.stack([(pixels(s) - pixels(-s)) / (2.0 * _STEP) for s in steps], axis=-1)
    # Moving the centre by d is equivalent to moving all points by -d.
    return J[:, :, :9], -J[:, :, 9:]
