"""Small functions of OpenCV, COLMAP and PoseLib with our signatures: maps, similarities, poses."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.records import Similarity
from validation.references.libraries import cv2, poselib, pycolmap


def opencv_homography(xy1: F64, xy2: F64) -> F64:
    """``cv2.findHomography`` of all matches (N, 2): x2 ~ H x1, least squares in image 2."""
    return np.asarray(cv2.findHomography(xy1, xy2, 0)[0], dtype=np.float64)


def opencv_projection(K: F64, R: F64, t: F64, X: F64, *, distortion: F64) -> F64:
    """``cv2.projectPoints``: pixels (N, 2) of points (N, 3), ``radial`` (3,) of r^2, r^4 and r^6."""
    turn = cv2.Rodrigues(R)[0]
    found = cv2.projectPoints(
        X, turn, t, K, np.array([distortion[0], distortion[1], 0.0, 0.0, distortion[2]])
    )[0]
    return np.asarray(found, dtype=np.float64)[:, 0]


def opencv_undistortion(xy: F64, *, distortion: F64) -> F64:
    """``cv2.undistortPoints`` of normalised points (N, 2)."""
    terms = np.array([distortion[0], distortion[1], 0.0, 0.0, distortion[2]])
    return np.asarray(cv2.undistortPoints(xy[:, None], np.eye(3), terms), dtype=np.float64)[:, 0]


def colmap_similarity(source: F64, target: F64) -> Similarity:
    """``pycolmap.estimate_sim3d``: least squares from (N, 3) to (N, 3)."""
    found = pycolmap.estimate_sim3d(source, target)
    if found is None:
        raise ValueError("COLMAP finds no similarity")
    return Similarity(float(found.scale), np.asarray(found.rotation.matrix()), np.asarray(found.translation))


def poselib_three_points(X: F64, rays: F64) -> tuple[F64, F64]:
    """``poselib.p3p`` of one sample: world-to-camera R (C, 3, 3) and t (C, 3) of unit rays (3, 3)."""
    poses = poselib.p3p(rays, X)
    return np.array([pose.R for pose in poses]), np.array([pose.t for pose in poses])
