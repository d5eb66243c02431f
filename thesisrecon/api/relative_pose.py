"""Relative poses of calibrated cameras: essential matrix, recovered pose, homography taken apart."""

from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from thesisrecon.api.cameras import require_threshold, search_budget
from thesisrecon.api.lenses import undistort_points
from thesisrecon.arrays import F64, checked, generator, numbers, require_calibration
from thesisrecon.camera import Camera
from thesisrecon.epipolar.essential import EssentialFit, fit_essential
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.relative_pose import pose_in_front, poses_from_homography
from thesisrecon.runtime._blas import one_blas_thread

Calibration = F64 | Camera  # K (3, 3), or a camera, whose lens counts too and whose pose does not


class RelativePose(NamedTuple):
    """Pose of the second camera relative to the first: X in its frame is R X + t, with \\|t\\| = 1.

    ``depths`` (N, 2) of the matches in both cameras, in units of the baseline, are negative behind a camera.
    """

    R: F64
    t: F64
    depths: F64


class PlanePoses(NamedTuple):
    """Solutions R (S, 3, 3), t (S, 3) and unit normals (S, 3) of a plane n' X = d, with H ~ R + t n'.

    X is in the frame of the first camera and t in units of the distance d of the plane; ``in_front`` (S,) is
    the fraction of the given points in front of both cameras (1 without points).
    """

    R: F64
    t: F64
    normal: F64
    in_front: F64


@one_blas_thread()
def estimate_essential(
    xy1: F64, xy2: F64, K1: Calibration, K2: Calibration | None = None, *,
    threshold_px: float | None = 1.0, confidence: float = 0.9999, max_samples: int = 100_000,
    seed: int | Generator = 0,
) -> EssentialFit:  # fmt: skip
    """Estimate the essential matrix and the pose of matches with outliers by five points (HZ 9.6).

    RANSAC over samples of five, x2' K2^-T E K1^-1 x1 = 0 with det E = 0 and 2 E E' E = tr(E E') E, then the
    least Sampson distance of the inliers over the five freedoms of E = [t]x R.

    Parameters
    ----------
    xy1, xy2 : array_like (N, 2)
        Matched points, N >= 6, px.
    K1, K2 : ndarray (3, 3) or Camera
        Calibration of the two images; of a camera its distortion counts too. K2 None: as K1.
    threshold_px : float or None
        Sampson distance of an inlier during the search; None: all matches are inliers.
    confidence, max_samples : float, int
        Probability of a sample without outliers at which the search ends, and the largest number of samples.
    seed : int or numpy.random.Generator
        Random seed, or the generator to draw from.

    Returns
    -------
    EssentialFit
        E, the pose R and t with most matches in front of both cameras, inliers, noise and covariance. Points
        of one plane leave two poses possible: the other one is in ``competing_poses``. After a rotation
        without translation t is arbitrary, which its covariance shows.

    Raises
    ------
    StageFailure
        If there are too few matches, or no more inliers than chance explains.

    References
    ----------
    D. Nister, An efficient solution to the five-point relative pose problem, PAMI 26(6), 2004; H. Stewenius,
    C. Engels and D. Nister, Recent developments on direct relative orientation, ISPRS 60, 2006.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import estimate_essential
    >>> from thesisrecon.testing import two_views
    >>> pair = two_views(outliers=0.3)
    >>> fit = estimate_essential(pair.xy1, pair.xy2, *pair.cameras)
    >>> true = pair.cameras[1].t
    >>> bool(fit.t @ true > 0.9998 * np.linalg.norm(true))
    True
    """
    caller = "estimate_essential"
    x1, x2 = checked(caller, xy1=(xy1, ("N", 2)), xy2=(xy2, ("N", 2)))
    require_threshold(threshold_px, x1, x2)
    budget = search_budget(confidence, max_samples)
    (K1, x1), (K2, x2) = _pinhole(caller, K1, x1), _pinhole(caller, K1 if K2 is None else K2, x2)
    return fit_essential(x1, x2, K1, K2, threshold_px, budget, generator(caller, seed))


def recover_pose(E: F64, xy1: F64, xy2: F64, K1: Calibration, K2: Calibration | None = None) -> RelativePose:
    """Return the pose of an essential matrix that places most matches in front of both cameras (HZ 9.6.3).

    With E = U diag(1, 1, 0) V', R is U W V' or U W' V' and t is u3 or -u3 (HZ 9.6.2); of the four, the one
    with the most positive depths.

    Parameters
    ----------
    E : ndarray (3, 3)
        Essential matrix of any scale and sign, or K2' F K1 of a fundamental matrix.
    xy1, xy2 : array_like (N, 2)
        Inliers, N >= 1, px.
    K1, K2 : ndarray (3, 3) or Camera
        As for :func:`estimate_essential`.

    Returns
    -------
    RelativePose
        R, t and the depths of the matches.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import recover_pose
    >>> E = np.array([[0.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # t along x, no rotation
    >>> pose = recover_pose(E, np.array([[0.0, 0.0]]), np.array([[-0.5, 0.0]]), np.eye(3))
    >>> np.allclose(pose.R, np.eye(3)), np.allclose(pose.t, [-1, 0, 0]), pose.depths.round(9).tolist()
    (True, True, [[2.0, 2.0]])
    """
    caller = "recover_pose"
    (E,) = checked(caller, E=(E, (3, 3)))
    x1, x2 = checked(caller, xy1=(xy1, ("N", 2)), xy2=(xy2, ("N", 2)))
    if not len(x1):
        raise ValueError("recover_pose needs at least one match, which decides between four poses; got none")
    rays1, rays2 = calibrated_rays(caller, K1, x1), calibrated_rays(caller, K1 if K2 is None else K2, x2)
    return RelativePose(*pose_in_front(E, rays1, rays2))


def decompose_homography(
    H: F64, K1: Calibration, K2: Calibration | None = None, *, xy1: F64 | None = None
) -> PlanePoses:
    """Take the homography of a plane apart into rotation, translation and normal.

    K2^-1 H K1 ~ R + t n' for the points n' X = d of a plane (HZ 13.2, with t in units of d). There are four
    solutions, two of each sign of n, and one without plane if the camera only turned.

    Parameters
    ----------
    H : ndarray (3, 3)
        Homography x2 ~ H x1 in pixels, of any scale and sign.
    K1, K2 : ndarray (3, 3) or Camera
        Calibration of the two images, without distortion (undistort the points before). K2 None: as K1.
    xy1 : array_like (N, 2), optional
        Points of the plane in image 1: only solutions that place most of them in front of both cameras are
        returned, one or two.

    Returns
    -------
    PlanePoses
        The solutions; those with more points in front first.

    Raises
    ------
    ValueError
        If a shape is wrong, H is singular or not finite, or K is no calibration matrix.

    References
    ----------
    O. Faugeras and F. Lustman, Motion and structure from motion in a piecewise planar environment, IJPRAI
    2(3), 1988; E. Malis and M. Vargas, Deeper understanding of the homography decomposition, INRIA RR-6303,
    2007.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import decompose_homography
    >>> H = np.eye(3) + np.outer([0.2, 0, 0], [0, 0, 1.0])  # along x, before a plane z = 1
    >>> found = decompose_homography(H, np.eye(3), xy1=np.array([[0.0, 0.0], [0.3, 0.2]]))
    >>> k = int(np.argmax(found.normal[:, 2]))
    >>> len(found.R), np.allclose(found.t[k], [0.2, 0, 0]), np.allclose(found.normal[k], [0, 0, 1])
    (2, True, True)
    """
    caller = "decompose_homography"
    (H,) = checked(caller, H=(H, (3, 3)))
    (A, _), (B, _) = (_pinhole(caller, K, np.zeros((0, 2))) for K in (K1, K1 if K2 is None else K2))
    G = np.linalg.inv(B) @ H @ A
    if not np.linalg.svd(G, compute_uv=False)[2] > 1e-12 * np.linalg.norm(G):
        raise ValueError(f"{caller} needs a regular homography; H is singular: its plane contains a centre")
    R, t, normal = poses_from_homography(G)
    if xy1 is None:
        return PlanePoses(R, t, normal, np.ones(len(R)))
    x1 = calibrated_rays(caller, K1, *checked(caller, xy1=(xy1, ("N", 2))))
    toward = normal @ x1.T
    # X = x1 d / (n' x1), of which the depth in the second camera is that of R X + t.
    after = x1 @ np.swapaxes(R, 1, 2) + t[:, None] * toward[:, :, None]
    front = (toward > 0.0) & (after[..., 2] > 0.0)
    front |= ~normal.any(axis=1, keepdims=True)
    share = front.mean(axis=1)
    order = np.argsort(-share, kind="stable")
    order = order[share[order] > 0.5 * share.max(initial=0.0)]
    return PlanePoses(R[order], t[order], normal[order], share[order])


def _pinhole(caller: str, calibration: Calibration, xy: F64) -> tuple[F64, F64]:
    """K (3, 3), and the pixels (N, 2) without distortion."""
    if isinstance(calibration, Camera):
        return calibration.K, undistort_points(xy, calibration)
    (K,) = numbers(caller, K=calibration)
    require_calibration(caller, K)
    return K, xy


def calibrated_rays(caller: str, calibration: Calibration, xy: F64) -> F64:
    """Rays (N, 3) of pixels, with z = 1."""
    K, xy = _pinhole(caller, calibration, xy)
    return np.asarray(homogenize(xy) @ np.linalg.inv(K).T)
