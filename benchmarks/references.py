"""Small functions of OpenCV, COLMAP and PoseLib with our signatures: maps, similarities, poses."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F32, F64, I64
from thesisrecon.records import Similarity, TexturedMesh
from thesisrecon.stereo.rectification import PlanarRectification
from validation.references.libraries import cv2, open3d, poselib, pycolmap


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


def opencv_uncalibrated(F: F64, xy1: F64, xy2: F64, size: tuple[int, int]) -> PlanarRectification | None:
    """``cv2.stereoRectifyUncalibrated`` (Hartley) into the image's frame; None if it refuses."""
    done, H1, H2 = cv2.stereoRectifyUncalibrated(xy1.copy(), xy2.copy(), F, size)
    if not done:
        return None
    return PlanarRectification(np.stack([_positive(np.asarray(H), size) for H in (H1, H2)]), size)


def warp_perspective(image: NDArray[Any], H: F64, size: tuple[int, int]) -> NDArray[Any]:
    """The image (H, W, C) whose pixel x goes to H x, H (3, 3), by cubic interpolation."""
    return np.asarray(cv2.warpPerspective(image, H, size, flags=cv2.INTER_CUBIC))


def _positive(H: F64, size: tuple[int, int]) -> F64:
    """H scaled such that the third coordinate is positive at the image's centre."""
    third = float(H[2] @ [0.5 * (size[0] - 1.0), 0.5 * (size[1] - 1.0), 1.0])
    return np.asarray(H * np.sign(third), dtype=np.float64)


def nearest_two(first: F32, second: F32) -> tuple[I64, F32]:
    """For each descriptor (N, D) the nearest two of (M, D) by brute force, and their distances; (N, 2)."""
    found = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first, second, k=2)
    index = np.array([[m.trainIdx for m in pair] for pair in found], dtype=np.int64)
    return index, np.array([[m.distance for m in pair] for pair in found], dtype=np.float32)


def opencv_seven_point(xy1: F64, xy2: F64) -> F64:
    """``cv2.findFundamentalMat`` of seven matches (7, 2) px: all its answers (M, 3, 3)."""
    F = cv2.findFundamentalMat(xy1, xy2, cv2.FM_7POINT)[0]
    return np.zeros((0, 3, 3)) if F is None else np.asarray(F, dtype=np.float64).reshape(-1, 3, 3)


def decimate_open3d(mesh: TexturedMesh, faces: int) -> TexturedMesh:
    """Reduce a mesh to a number of faces by quadric decimation (Garland and Heckbert 1997)."""
    whole = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices),
        open3d.utility.Vector3iVector(mesh.faces.astype(np.int32)),
    )
    fewer = whole.simplify_quadric_decimation(faces)
    return TexturedMesh(np.asarray(fewer.vertices), np.asarray(fewer.triangles).astype(np.int64))
