"""The affine stratum as a result of its own (3.4.3): parallels are parallel, ratios along them are true."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.cheirality import orient_signs
from thesisrecon.geometry.strata import affine_from_projective, transform_cameras, transform_points
from thesisrecon.types import Reconstruction

F64 = NDArray[np.float64]

_NEAR_INFINITY = 1e-9


def upgrade_to_affine(reconstruction: Reconstruction, plane: F64) -> Reconstruction:
    """A projective reconstruction with its plane at infinity (4,) moved to (0, 0, 0, 1).

    Cameras and points follow the table of 3.3: P G^-1, G X. Of the affine frames that is one where the points
    have the mean 0 and the covariance I over their nearer half, none being distinguished; X[:, 3] = 1 where
    valid, and points that lie on the plane are no longer valid. Parallels and ratios of lengths on parallel
    lines are those of the scene; angles are not, and handedness may be the other one. Raises ``ValueError``
    for a reconstruction of another stratum and for a plane that is zero or not finite.
    """
    if reconstruction.stratum != "projective":
        raise ValueError(f"upgrade_to_affine takes a projective reconstruction; got {reconstruction.stratum}")
    G = affine_from_projective(np.asarray(plane, dtype=np.float64))
    X = transform_points(G, reconstruction.X)
    size = np.linalg.norm(X, axis=1)
    valid = reconstruction.valid & (np.abs(X[:, 3]) > _NEAR_INFINITY * np.maximum(size, 1e-300))
    xyz = X[valid, :3] / X[valid, 3:]
    G = _centred_and_white(xyz) @ G
    X = np.zeros_like(reconstruction.X)
    X[valid] = transform_points(G, reconstruction.X[valid])
    X[valid] /= X[valid, 3:]
    P = np.where(reconstruction.registered[:, None, None], transform_cameras(G, reconstruction.P), 0.0)
    return replace(reconstruction, stratum="affine", P=_facing(reconstruction, P, X), X=X, valid=valid)


def _centred_and_white(xyz: F64) -> F64:
    """Affine transform (4, 4) that gives the nearer half of points (N, 3) the mean 0 and covariance I."""
    if len(xyz) < 4:
        return np.eye(4)
    centred = xyz - np.median(xyz, axis=0)
    spread = np.maximum(np.median(np.abs(centred), axis=0), 1e-300)
    distance = np.linalg.norm(centred / spread, axis=1)
    half = xyz[distance <= np.median(distance)]
    value, vector = np.linalg.eigh(np.cov(half.T))
    T = np.eye(4)
    T[:3, :3] = vector @ np.diag(np.maximum(value, 1e-18 * value[-1]) ** -0.5) @ vector.T
    T[:3, 3] = -T[:3, :3] @ half.mean(axis=0)
    return T


def _facing(reconstruction: Reconstruction, P: F64, X: F64) -> F64:
    """Cameras (V, 3, 4) with the signs that give the points positive depths."""
    tracks, keep = reconstruction.tracks, reconstruction.inlier
    view, point = tracks.view_index[keep], tracks.point_index[keep]
    return P * orient_signs(P, X, view, point)[0][:, None, None]


def affine_camera_centres(reconstruction: Reconstruction) -> F64:
    """Centres (R, 3) of the registered cameras of an affine or metric reconstruction."""
    P = reconstruction.P[reconstruction.registered]
    return np.asarray(-np.linalg.solve(P[:, :, :3], P[:, :, 3:])[..., 0])
