"""The affine stratum as a result of its own (3.4.3): parallels are parallel, ratios along them are true."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import pixel_from_unit
from thesisrecon.geometry.strata import affine_from_projective, transform_cameras, transform_points
from thesisrecon.records import Reconstruction

_NEAR_INFINITY = 1e-9


def upgrade_to_affine(reconstruction: Reconstruction, plane: F64) -> Reconstruction:
    """A projective reconstruction with its plane at infinity (4,) moved to (0, 0, 0, 1).

    Cameras and points follow the table of 3.3: P G^-1, G X. Affine frames differ by what the calibration and
    the pose of one camera would tell; here the camera with most observations is [I | 0] behind a nominal
    calibration (focal of one long side), with its points at a median depth of 1, so that the scene looks
    right from there but for its depth. X[:, 3] = 1 where valid, and points that lie on the plane are no
    longer valid. Parallels and ratios of lengths on parallel lines are those of the scene; angles are not.
    Raises ``ValueError`` for a reconstruction of another stratum and for a plane that is zero or not finite.
    """
    if reconstruction.stratum != "projective":
        raise ValueError(f"upgrade_to_affine takes a projective reconstruction; got {reconstruction.stratum}")
    G = affine_from_projective(np.asarray(plane, dtype=np.float64))
    X = transform_points(G, reconstruction.X)
    size = np.linalg.norm(X, axis=1)
    valid = reconstruction.valid & (np.abs(X[:, 3]) > _NEAR_INFINITY * np.maximum(size, 1e-300))
    X[~valid] = 0.0
    X[valid] /= X[valid, 3:]
    P = np.where(reconstruction.registered[:, None, None], transform_cameras(G, reconstruction.P), 0.0)
    affine = replace(reconstruction, stratum="affine", P=P, X=X, valid=valid)
    affine = replace(affine, P=_facing(affine))
    T = _nominal_frame(affine)
    X[valid] = transform_points(T, X[valid])
    return replace(affine, P=transform_cameras(T, affine.P), X=X)


def _nominal_frame(affine: Reconstruction) -> F64:
    """Affine transform (4, 4) to the frame in which the camera with most observations is at the origin."""
    tracks, keep = affine.tracks, affine.inlier & affine.valid[affine.tracks.point_index]
    seen = np.bincount(tracks.view_index[keep], minlength=len(affine.P)) * affine.registered
    view = int(np.argmax(seen))
    T = np.eye(4)
    T[:3] = np.linalg.solve(pixel_from_unit(affine.sizes)[view], affine.P[view])
    T[:3] /= max(float(np.linalg.norm(T[:3, :3])), 1e-300)
    if not seen[view] or abs(np.linalg.det(T)) < _NEAR_INFINITY:
        return np.eye(4)
    depth = affine.X[tracks.point_index[keep & (tracks.view_index == view)]] @ T[2]
    T[:3] /= max(float(np.median(depth)), 1e-300)
    return T


def _facing(affine: Reconstruction) -> F64:
    """Cameras (V, 3, 4) with the signs that give the points positive depths."""
    tracks, keep = affine.tracks, affine.inlier & affine.valid[affine.tracks.point_index]
    view, point = tracks.view_index[keep], tracks.point_index[keep]
    depth = np.einsum("kj,kj->k", affine.P[view, 2], affine.X[point])
    balance = np.bincount(view, np.sign(depth), minlength=len(affine.P))
    return affine.P * np.where(balance < 0.0, -1.0, 1.0)[:, None, None]


def affine_camera_centres(reconstruction: Reconstruction) -> F64:
    """Centres (R, 3) of the registered cameras of an affine or metric reconstruction."""
    P = reconstruction.P[reconstruction.registered]
    return np.asarray(-np.linalg.solve(P[:, :, :3], P[:, :, 3:])[..., 0])
