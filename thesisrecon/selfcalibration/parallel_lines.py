"""Plane at infinity from the vanishing points of parallel lines (chapter 7, stratified; HZ 10.4.1).

Vanishing points of a direction in two images or more are triangulated to a point at infinity; three such
points span the plane.
"""

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.selfcalibration._frame import require_cameras_of_full_rank
from thesisrecon.selfcalibration.cheirality import unit_rows

_MIN_SPREAD = 1e-3


def plane_from_vanishing_points(P: F64, xyh: F64, unit: F64) -> F64:
    """The unit plane at infinity (4,) from vanishing points xyh (V, D, 3), NaN where not seen."""
    require_cameras_of_full_rank(P)
    cameras = np.linalg.inv(unit) @ P
    cameras = cameras / np.linalg.norm(cameras, axis=(1, 2), keepdims=True)
    # In this frame of space the rows of the cameras are orthonormal.
    M = np.linalg.qr(cameras.reshape(-1, 4))[1]
    X = _points_at_infinity(cameras @ np.linalg.inv(M), np.einsum("vij,vdj->vdi", np.linalg.inv(unit), xyh))
    _, s, Vt = np.linalg.svd(unit_rows(X))
    if not s[2] / s[0] > _MIN_SPREAD:
        raise StageFailure.of("directions-in-one-plane", s[2] / s[0])
    plane = M.T @ Vt[-1]
    return np.asarray(plane / np.linalg.norm(plane))


def _points_at_infinity(P: F64, v: F64) -> F64:
    """Triangulated points (D', 4), v x P X = 0, from vanishing points v (V, D, 3)."""
    v = v / np.linalg.norm(v, axis=2, keepdims=True)
    seen = np.asarray(np.isfinite(v).all(axis=2))
    found = []
    for d in np.flatnonzero(seen.sum(axis=0) >= 2):
        rows = np.cross(v[seen[:, d], d, :, None], P[seen[:, d]], axisa=-2, axisb=-2, axisc=-2)
        values, vectors = np.linalg.eigh(np.einsum("nri,nrj->ij", rows, rows))
        # Epipoles determine nothing.
        if values[1] > _MIN_SPREAD**2 * values[3]:
            found.append(vectors[:, 0])
    if len(found) < 3:
        raise StageFailure.of("few-parallel-directions", len(found))
    return np.stack(found)
