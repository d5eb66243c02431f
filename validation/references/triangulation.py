"""Triangulation by OpenCV and COLMAP with our signature: P (V, 3, 4), xy (V, N, 2) px -> X (N, 4)."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.two_view import fundamental_from_cameras
from validation.references.libraries import cv2, pycolmap


def opencv_linear(P: F64, xy: F64) -> F64:
    """``cv2.triangulatePoints``: the linear method of two views, its rows as they come."""
    found = cv2.triangulatePoints(P[0], P[1], xy[0].T.copy(), xy[1].T.copy())
    return np.asarray(found.T, dtype=np.float64)


def opencv_polynomial(P: F64, xy: F64) -> F64:
    """``cv2.correctMatches`` (Hartley and Sturm's polynomial), then ``cv2.triangulatePoints``."""
    F = fundamental_from_cameras(P[0], P[1])
    x1, x2 = cv2.correctMatches(F, xy[0][None], xy[1][None])
    return opencv_linear(P, np.stack([np.asarray(x1)[0], np.asarray(x2)[0]]).astype(np.float64))


def colmap_points(P: F64, xy: F64) -> F64:
    """``pycolmap.triangulate_point`` of two views, ``triangulate_multi_view_point`` of more, point by point.

    COLMAP needs normalised image points, so pixels and cameras are normalised together. Points
    that it refuses come out as zeros.
    """
    scale, middle = 1e-3, xy.mean(axis=1)
    T = np.zeros((len(P), 3, 3))
    T[:, 0, 0] = T[:, 1, 1] = scale
    T[:, :2, 2], T[:, 2, 2] = -scale * middle, 1.0
    cameras, moved = T @ P, (xy - middle[:, None]) * scale
    rays = np.concatenate([moved, np.ones((*moved.shape[:2], 1))], axis=2)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    X = np.zeros((xy.shape[1], 4))
    of_two, of_many = pycolmap.triangulate_point, pycolmap.triangulate_multi_view_point
    for n in range(xy.shape[1]):
        if len(P) == 2:
            found = of_two(cameras[0], cameras[1], moved[0, n], moved[1, n])
        else:
            found = of_many(list(cameras), rays[:, n])
        if found is not None:
            X[n] = [*np.asarray(found), 1.0]
    return X
