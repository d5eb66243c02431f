"""True cameras of interpolated views, and homographies between images."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import B8, F64, U8
from thesisrecon.geometry.camera_matrix import camera_centre, decompose_camera
from thesisrecon.geometry.two_view import estimate_homography, homography_residuals
from thesisrecon.views._warping import sample
from thesisrecon.views.interpolation import InterpolatedPair, original_from_rectified
from validation.scenes.fixtures import Pose


def camera_between(pair: InterpolatedPair, P: tuple[F64, F64], s: float) -> F64:
    """The camera (3, 4) that the view at s is of, given those of the images.

    In the rectified frame both have their rows and depths in common up to a scale, so that the interpolated
    place of every point is its image in (1 - s) P_0 + s P_1 (Seitz and Dyer).
    """
    first, second = (H @ camera for H, camera in zip(pair.H, P, strict=True))
    # Equal up to the errors of F.
    scale = float(np.sum(first[1:] * second[1:]) / np.sum(second[1:] ** 2))
    P_s = (1.0 - s) * first + s * scale * second
    return np.asarray(original_from_rectified(pair.H, pair.size, s) @ P_s)


def pose_of(P: F64) -> Pose:
    """K, R, C of a camera."""
    K, R, t = decompose_camera(P)
    return Pose(K, R, -R.T @ t)


def camera_centre_of(pair: InterpolatedPair, P: tuple[F64, F64], s: float) -> F64:
    """(3,) where the view at s is taken from."""
    C = camera_centre(camera_between(pair, P, s))
    return np.asarray(C[:3] / C[3])


def nearest_place(pair: InterpolatedPair, P: tuple[F64, F64], C: F64) -> float:
    """The s, to a hundredth, whose camera is nearest to C (3,)."""
    places = np.linspace(0.0, 1.0, 101)
    return float(places[np.argmin([np.linalg.norm(camera_centre_of(pair, P, s) - C) for s in places])])


def best_homography(xy1: F64, xy2: F64) -> F64:
    """Least squares over the nine tenths of the points that fit best."""
    kept = np.ones(len(xy1), dtype=bool)
    H = estimate_homography(xy1, xy2)
    for _ in range(3):
        off = homography_residuals(H, xy1, xy2)
        kept = off <= np.quantile(off, 0.9)
        H = estimate_homography(xy1[kept], xy2[kept])
    return H


def turned(picture: U8, H: F64) -> tuple[U8, B8]:
    """The image through H (3, 3), black outside, and where it has pixels."""
    height, width = picture.shape[:2]
    y, x = np.indices((height, width), dtype=np.float64)
    back: F64 = np.asarray(np.linalg.inv(H), dtype=np.float64)
    source = through(back, np.stack([x.ravel(), y.ravel()], axis=1)).reshape(height, width, 2)
    rgb = sample(picture.astype(np.float32), source.astype(np.float32), threads=2)
    kept = np.isfinite(rgb[..., 0])
    return np.clip(np.rint(np.nan_to_num(rgb)), 0, 255).astype(np.uint8), kept


def through(H: F64, xy: F64) -> F64:
    """Points (N, 2) moved by H (3, 3)."""
    xh = np.column_stack([xy, np.ones(len(xy))]) @ H.T
    return np.asarray(xh[:, :2] / xh[:, 2:])
