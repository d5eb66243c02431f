"""Cameras and motions taken apart: P, E, seven matches, and affine cameras of a measurement matrix."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from thesisrecon import camera
from thesisrecon.api.relative_pose import Calibration, calibrated_rays
from thesisrecon.arrays import F64, Record, checked, flag, require_calibration
from thesisrecon.epipolar.ransac import estimate_seven_point
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import checked_unit, quadratic_rows, symmetric
from thesisrecon.geometry.relative_pose import depths_of_matches, poses_from_essential
from thesisrecon.optimize.least_squares import central_differences


class CameraParts(NamedTuple):
    """P ~ K [R t] taken apart; the standard deviations are NaN without a covariance of P."""

    K: F64  #: (3, 3), K33 = 1
    R: F64  #: (3, 3) world to camera
    t: F64  #: (3,)
    centre: F64  #: (3,)
    K_std: F64  #: (3, 3)
    centre_covariance: F64  #: (3, 3)


def decompose_camera(P: F64, *, covariance: F64 | None = None) -> CameraParts:
    """Take a camera matrix apart into calibration, rotation and centre (3.21; HZ 6.2.4).

    P = [M | p] ~ K [R t]: RQ decomposition of M with a positive diagonal of K, and centre = -M^-1 p.

    Parameters
    ----------
    P : array_like (3, 4)
        Camera matrix of any scale and sign.
    covariance : array_like (12, 12), optional
        Covariance of its entries, row by row, such as that of :func:`thesisrecon.resect`.

    Returns
    -------
    CameraParts
        Parts, and standard deviations to first order.

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite, or the centre is at infinity.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import decompose_camera
    >>> parts = decompose_camera(-2.0 * np.array([[500.0, 0, 320, 500], [0, 500, 240, 0], [0, 0, 1, 0]]))
    >>> (parts.K.round(6) + 0.0).tolist(), (parts.centre + 0.0).round(6).tolist()
    ([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], [-1.0, 0.0, 0.0])
    """
    (P,) = checked("decompose_camera", P=(P, (3, 4)))

    def parts(P: F64) -> F64:
        K, R, t = camera.decompose_camera(P.reshape(3, 4))
        return np.concatenate([K.ravel(), -R.T @ t])

    K, R, t = camera.decompose_camera(P)
    deviations = np.full((12, 12), np.nan)
    if covariance is not None:
        (given,) = checked("decompose_camera", covariance=(covariance, (12, 12)))
        # Steps relative to entries of one size.
        scale = np.linalg.norm(P)
        J = central_differences(lambda p: parts(p * scale), P.ravel() / scale) / scale
        deviations = J @ given @ J.T
    std = np.sqrt(np.maximum(np.diag(deviations)[:9], 0.0)).reshape(3, 3)
    return CameraParts(K, R, t, -R.T @ t, std, deviations[9:, 9:])


class EssentialOfFundamental(NamedTuple):
    """E of unit norm, the singular values of K2' F K1 over the first, and the covariance of E."""

    E: F64
    singular_values: F64
    covariance: F64


def essential_from_fundamental(
    F: F64, K1: F64, K2: F64 | None = None, *, covariance: F64 | None = None
) -> EssentialOfFundamental:
    """Return the essential matrix nearest to K2' F K1 (HZ 9.6).

    Its singular values become 1, 1, 0. Unequal ones show a wrong calibration or the noise of F.

    Parameters
    ----------
    F : array_like (3, 3)
        Fundamental matrix x2' F x1 = 0 of any scale and sign.
    K1, K2 : array_like (3, 3)
        Calibrations; K2 None: as K1.
    covariance : array_like (9, 9), optional
        Covariance of the entries of F of unit norm.

    Returns
    -------
    EssentialOfFundamental
        E, the three singular values before, and the covariance (9, 9) of E to first order, NaN without that
        of F.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import essential_from_fundamental
    >>> F = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # t along x, no rotation
    >>> found = essential_from_fundamental(F, np.diag([500.0, 500, 1]))
    >>> found.E.round(3).tolist(), found.singular_values.round(6).tolist()
    ([[0.0, 0.0, 0.0], [0.0, 0.0, -0.707], [0.0, 0.707, 0.0]], [1.0, 1.0, 0.0])
    """
    caller = "essential_from_fundamental"
    F, K1, K2 = checked(caller, F=(F, (3, 3)), K1=(K1, (3, 3)), K2=(K1 if K2 is None else K2, (3, 3)))
    require_calibration(caller, K1)
    require_calibration(caller, K2)
    G, F = K2.T, checked_unit(F, caller)

    def nearest(f: F64) -> F64:
        U, _, Vt = np.linalg.svd(G @ f.reshape(3, 3) @ K1)
        return np.asarray(np.sqrt(0.5) * (U[:, :2] @ Vt[:2])).ravel()

    values = np.linalg.svd(G @ F @ K1, compute_uv=False)
    spread = np.full((9, 9), np.nan)
    if covariance is not None:
        (given,) = checked(caller, covariance=(covariance, (9, 9)))
        # The entries of F differ by the square of the focal length, and so do the steps.
        D = np.kron(np.linalg.inv(G), np.linalg.inv(K1.T)) * np.linalg.norm(G @ F @ K1)
        J = central_differences(lambda e: nearest(D @ e), np.linalg.solve(D, F.ravel())) @ np.linalg.inv(D)
        spread = J @ given @ J.T
    return EssentialOfFundamental(nearest(F).reshape(3, 3), values / values[0], spread)


class EssentialPoses(NamedTuple):
    """The four poses of an essential matrix: R (4, 3, 3), unit t (4, 3), and in_front (4,).

    ``in_front`` is the fraction of the matches in front of both cameras, NaN without matches.
    """

    R: F64
    t: F64
    in_front: F64


def decompose_essential(
    E: F64, xy1: F64 | None = None, xy2: F64 | None = None, K1: Calibration | None = None,
    K2: Calibration | None = None,
) -> EssentialPoses:  # fmt: skip
    """Return the four poses of an essential matrix, and how many matches each has in front (HZ 9.6.2, 9.6.3).

    With E = U diag(1, 1, 0) V', R is U W V' or U W' V' and t is u3 or -u3.
    :func:`thesisrecon.recover_pose` returns the one of most matches.

    Parameters
    ----------
    E : array_like (3, 3)
        Essential matrix of any scale and sign.
    xy1, xy2 : array_like (N, 2), optional
        Matches, px.
    K1, K2 : ndarray (3, 3) or Camera, optional
        Calibrations of the matches. K1 None: xy are rays (x, y, 1); K2 None: as K1.

    Returns
    -------
    EssentialPoses
        The poses with more matches in front first: ``R[0]``, ``t[0]`` is that of the cameras.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import decompose_essential
    >>> E = np.array([[0.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    >>> poses = decompose_essential(E, [[0.0, 0.0]], [[-0.5, 0.0]])
    >>> poses.in_front.tolist(), (poses.t[0] + 0.0).round(6).tolist()
    ([1.0, 0.0, 0.0, 0.0], [-1.0, 0.0, 0.0])
    """
    caller = "decompose_essential"
    (E,) = checked(caller, E=(E, (3, 3)))
    R, t = poses_from_essential(E)
    if xy1 is None or xy2 is None:
        return EssentialPoses(R, t, np.full(4, np.nan))
    x1, x2 = checked(caller, xy1=(xy1, ("N", 2)), xy2=(xy2, ("N", 2)))
    K1 = np.eye(3) if K1 is None else K1
    rays = calibrated_rays(caller, K1, x1), calibrated_rays(caller, K1 if K2 is None else K2, x2)
    front = (depths_of_matches(R, t, *rays) > 0.0).all(axis=2).mean(axis=1)
    order = np.argsort(-front, kind="stable")
    return EssentialPoses(R[order], t[order], front[order])


def seven_point(xy1: F64, xy2: F64) -> F64:
    """Return all fundamental matrices of seven matches (5.1; HZ 11.1.2).

    det(a F1 + (1 - a) F2) = 0 in the null space of the seven equations x2' F x1 = 0 is a cubic in a.

    Parameters
    ----------
    xy1, xy2 : array_like (7, 2)
        Matches, px.

    Returns
    -------
    ndarray (S, 3, 3)
        The one or three solutions, of rank 2 and unit norm; none if the matches are dependent.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon import seven_point
    >>> xy1 = np.random.default_rng(1).uniform(0, 500, (7, 2))
    >>> xy2 = xy1 + np.array([[40.0, 10.0]]) / np.arange(1, 8)[:, None]
    >>> F = seven_point(xy1, xy2)
    >>> len(F) in (1, 3), bool(np.abs(np.linalg.det(F)).max() < 1e-12)
    (True, True)
    """
    xy1, xy2 = checked("seven_point", xy1=(xy1, (7, 2)), xy2=(xy2, (7, 2)))
    return estimate_seven_point(xy1, xy2)


@dataclass(frozen=True, eq=False)
class AffineFactorization(Record):
    """Affine cameras x = M X + t and points of a measurement matrix, up to a rotation and a reflection."""

    M: F64  #: (V, 2, 3); rows orthogonal and of equal length (of length 1 if orthographic)
    t: F64  #: (V, 2) centroids of the pixels
    X: F64  #: (N, 3), with centroid 0
    residual_px: F64  #: (V, N, 2)
    sigma_px: float  #: standard deviation of one image coordinate
    point_covariance: F64  #: (3, 3) of each point for given cameras


def factorize_affine(xy: F64, *, orthographic: bool = False) -> AffineFactorization:
    """Reconstruct points and affine cameras by factorisation (Tomasi and Kanade, IJCV 9(2), 1992; HZ 18.2).

    W = x - t has rank 3: W = U D V' = M X, the least squares of the pixels. The metric frame is that in which
    the rows a, b of each camera satisfy a' Q b = 0 and a' Q a = b' Q b (scaled orthography), or = 1
    (orthographic), with Q = A A'.

    Parameters
    ----------
    xy : array_like (V, N, 2)
        Pixels of N >= 4 points, all seen in V >= 3 views (2 do not determine the metric frame).
    orthographic : bool
        Whether all cameras have one scale.

    Returns
    -------
    AffineFactorization
        Cameras and points; the scale is that of the first camera, whose rows have length 1.

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite, or there are too few views or points.
    StageFailure
        If the points lie in a plane, or the motion does not determine the metric frame.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from thesisrecon import factorize_affine
    >>> R = Rotation.from_euler("xyz", np.random.default_rng(0).uniform(-1, 1, (5, 3))).as_matrix()
    >>> X = np.random.default_rng(1).uniform(-1, 1, (20, 3))
    >>> found = factorize_affine(X @ R[:, :2].swapaxes(1, 2) * 100 + 300)
    >>> true = np.linalg.norm(X[1] - X[0]) / np.linalg.norm(X[2] - X[0])
    >>> ratio = np.linalg.norm(found.X[1] - found.X[0]) / np.linalg.norm(found.X[2] - found.X[0])
    >>> round(float(ratio / true), 6)
    1.0
    """
    caller = "factorize_affine"
    (xy,) = checked(caller, xy=(xy, ("V", "N", 2)))
    orthographic = flag(caller, "orthographic", orthographic)
    n_views, n = xy.shape[:2]
    if n_views < 3 or n < 4:
        raise ValueError(f"{caller} needs three views and four points or more; got {n_views} and {n}")
    t = xy.mean(axis=1)
    W = (xy - t[:, None]).swapaxes(1, 2).reshape(2 * n_views, n)
    U, D, Vt = np.linalg.svd(W, full_matrices=False)
    if not D[2] > 1e-9 * D[0]:
        raise StageFailure.of("affine-undetermined", "the points lie in a plane, or the camera did not turn")
    M, X = U[:, :3] * D[:3], Vt[:3]
    a, b = M[::2], M[1::2]

    square, norm = quadratic_rows(a, a), D[0] ** 2
    rows, right = [square - quadratic_rows(b, b), square[:1]], np.append(np.zeros(2 * n_views), norm)
    if orthographic:
        rows, right = [square, quadratic_rows(b, b)], np.repeat([0.0, norm, norm], n_views)
    A = np.concatenate([quadratic_rows(a, b), *rows])
    solution, _, rank, _ = np.linalg.lstsq(A, right, rcond=1e-9)
    Q = symmetric(solution)
    if rank < 6 or not np.linalg.eigvalsh(Q)[0] > 1e-9 * np.abs(Q).max():
        raise StageFailure.of("affine-undetermined", "no metric frame gives all cameras square pixels")
    A = np.linalg.cholesky(Q)
    M, X = M @ A, np.linalg.solve(A, X)
    scale = np.linalg.norm(M, axis=1).mean() if orthographic else np.linalg.norm(M[:2], axis=1).mean()
    M, X = M / scale, X.T * scale
    residual = (M @ X.T - W).reshape(n_views, 2, n).swapaxes(1, 2)
    sigma = float(np.sqrt(np.sum(residual**2) / max(2 * n_views * n - 8 * n_views - 3 * n + 12, 1)))
    covariance = sigma**2 * np.linalg.inv(M.T @ M)
    return AffineFactorization(M.reshape(n_views, 2, 3), t, X, residual, sigma, covariance)
