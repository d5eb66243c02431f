"""Two cameras from F and intrinsics, and virtual cameras along their baseline (thesis, section 1.3).

If the intrinsics are unknown they are guessed, as in the thesis; new views are then correct up to a
projective transform of space. The rotation is taken from F, small as in Avidan and Shashua (CVPR 1997, PAMI
1998) or general.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import calibration_matrix, rq
from thesisrecon.geometry.homogeneous import cross_matrix, homogenize, require_finite
from thesisrecon.geometry.two_view import (
    enforce_rank_two,
    epipoles,
    require_parallax_of_matches,
    sampson_residuals,
)

USUAL_FOCAL = 1.0
"""Default focal length in units of the long side, between telephoto (2) and wide angle (0.6)."""
MIN_MATCHES = 8
MAX_RESIDUAL = 0.005
"""Median distance of matches from their epipolar lines, in units of the long side, above which F is
rejected."""
RANK_ONE = 1e-9
OFF_ROTATION = 1e-4
"""Tolerance of R'R - I: a rotation written with four digits passes."""
IN_FRONT = 0.75
"""Share of matches that must lie in front of both cameras."""


@dataclass(frozen=True)
class CalibratedPair:
    """Two calibrated cameras, X_2 = R X_1 + t. For two images |t| = 1 is the unit of length.

    Parameters
    ----------
    K1, K2 : ndarray (3, 3)
        Intrinsics.
    R : ndarray (3, 3)
        Rotation from the first to the second camera frame.
    t : ndarray (3,)
        Translation.

    Raises
    ------
    ValueError
        If the arguments are no intrinsics, rotation or non-zero translation.
    """

    K1: F64
    K2: F64
    R: F64
    t: F64

    def __post_init__(self) -> None:
        require_intrinsics(self.K1)
        require_intrinsics(self.K2)
        require_rotation(self.R)
        require_finite("CalibratedPair", self.t)
        if np.shape(self.t) != (3,) or not np.linalg.norm(self.t) > 0.0:
            raise ValueError("CalibratedPair needs a translation (3,) other than 0")

    @property
    def P2(self) -> F64:
        """The second camera [a, a_4] = [K2 R K1^-1, K2 t] (3, 4) beside P1 = [I 0].

        Space points are K1 X_1, so a point is (x, 1 / depth) for its pixel x in view 1 and a is the
        infinite homography.
        """
        return np.column_stack([self.K2 @ self.R @ np.linalg.inv(self.K1), self.K2 @ self.t])

    @property
    def centre2(self) -> F64:
        """Centre (3,) of the second camera in the frame of the first."""
        return np.asarray(-self.R.T @ self.t)

    def swapped(self) -> CalibratedPair:
        """Return the same cameras in the other order.

        Returns
        -------
        CalibratedPair
            The pair with the first and second camera exchanged.
        """
        return CalibratedPair(self.K2, self.K1, self.R.T, self.centre2)


class Orientation(Protocol):
    """Decomposition of an essential matrix into rotation and translation."""

    def candidates(self, E: F64) -> list[tuple[F64, F64]]:
        """Candidate pairs of R (3, 3) and unit t (3,) of E (3, 3)."""
        ...


@dataclass(frozen=True)
class AnyRotation:
    """The four decompositions of an essential matrix (HZ 9.6.2)."""

    def candidates(self, E: F64) -> list[tuple[F64, F64]]:
        """Decompose E into R = U W V' or U W' V' and t = +-u_3.

        Parameters
        ----------
        E : ndarray (3, 3)
            Essential matrix.

        Returns
        -------
        list of tuple
            R (3, 3) and unit t (3,).
        """
        U, _, Vt = np.linalg.svd(E)
        quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        turns = [U @ W @ Vt for W in (quarter, quarter.T)]
        turns = [R * np.sign(np.linalg.det(R)) for R in turns]
        return [(R, sign * U[:, 2]) for R in turns for sign in (1.0, -1.0)]


@dataclass(frozen=True)
class SmallRotation:
    """R = I + [w]x to first order, as in Avidan and Shashua (after Rousso et al., CVPR 1996).

    E ~ [t]x (I + [w]x) is linear in the scale s of E and in s w: nine equations for four unknowns. The
    returned rotation is that of the rotation vector w.
    """

    def candidates(self, E: F64) -> list[tuple[F64, F64]]:
        """Decompose E by least squares.

        Parameters
        ----------
        E : ndarray (3, 3)
            Essential matrix.

        Returns
        -------
        list of tuple
            The rotation with both signs of t.

        Raises
        ------
        StageFailure
            If no small rotation explains E.
        """
        _, t = epipoles(E)
        across = cross_matrix(t)
        columns = [across, *(across @ cross_matrix(axis) for axis in np.eye(3))]
        design = np.stack([column.ravel() for column in columns], axis=1)
        solution = np.linalg.lstsq(design, E.ravel(), rcond=None)[0]
        if not abs(solution[0]) > 1e-6 * np.linalg.norm(solution):
            raise StageFailure(
                "the rotation between the two images is not small",
                "no small rotation explains the fundamental matrix",
                "use AnyRotation",
            )
        R = scipy.spatial.transform.Rotation.from_rotvec(solution[1:] / solution[0]).as_matrix()
        return [(R, t), (R, -t)]


def default_intrinsics(size: tuple[int, int], *, focal: float = USUAL_FOCAL) -> F64:
    """Return default intrinsics: square pixels, principal point in the image centre.

    Parameters
    ----------
    size : tuple of int
        Width and height in pixels.
    focal : float
        Focal length in units of the long side.

    Returns
    -------
    ndarray (3, 3)
        K.

    Raises
    ------
    ValueError
        If the focal length is not positive.
    """
    f = focal * max(size)
    return calibration_matrix(f, f, 0.5 * (size[0] - 1.0), 0.5 * (size[1] - 1.0))


def pair_from_fundamental(
    F: F64, xy1: F64, xy2: F64, *, K1: F64, K2: F64, orientation: Orientation | None = None
) -> CalibratedPair:
    """Compute the two cameras of F for given intrinsics (thesis, section 1.3).

    The fundamental matrix of the result is F exactly. The first camera has K1; of all second cameras
    that F allows, the left part is nearest to K2 R K1^-1 (least squares in coordinates of K2 and K1)
    with R from the essential matrix. Its intrinsics differ from K2 where F contradicts them.

    Parameters
    ----------
    F : ndarray (3, 3)
        Fundamental matrix, x2' F x1 = 0.
    xy1, xy2 : ndarray (N, 2)
        At least eight matches in pixels that agree with F; they select the decomposition.
    K1, K2 : ndarray (3, 3)
        Intrinsics, known or guessed (:func:`default_intrinsics`).
    orientation : Orientation, optional
        Default :class:`AnyRotation`; or :class:`SmallRotation`.

    Returns
    -------
    CalibratedPair
        Cameras with a baseline of length 1.

    Raises
    ------
    ValueError
        For wrong shapes, non-finite values or invalid intrinsics.
    StageFailure
        For too few matches, an F of rank 1 or of other matches, no parallax, or points behind the
        cameras.
    """
    F, xy1, xy2 = _checked(F, xy1, xy2)
    require_intrinsics(K1)
    require_intrinsics(K2)
    _require_theirs(F, xy1, xy2)
    E = K2.T @ F @ K1
    rays1, rays2 = (homogenize(xy) @ np.linalg.inv(K).T for xy, K in ((xy1, K1), (xy2, K2)))
    candidates = (orientation or AnyRotation()).candidates(E / np.linalg.norm(E))
    shares = [ratio_in_front(R, t, rays1, rays2) for R, t in candidates]
    best = int(np.argmax(shares))
    if not shares[best] >= IN_FRONT:
        raise StageFailure(
            "the scene is not in front of both cameras",
            f"{100.0 * shares[best]:.0f} % of {len(xy1)} matches are, for the best of {len(shares)} cameras",
            "check the fundamental matrix and the intrinsics",
        )
    return _pair_with(F, K1, K2, *candidates[best])


def _pair_with(F: F64, K1: F64, K2: F64, R: F64, t: F64) -> CalibratedPair:
    """The pair that has F and is nearest to K1, K2, R, t."""
    F = enforce_rank_two(F)
    e2 = epipoles(F)[1]
    H = -cross_matrix(e2) @ F
    m, v = nearest_plane(H, e2, K2 @ R @ np.linalg.inv(K1), K1=K1, K2=K2)
    left = m * (H + np.outer(e2, v)) @ K1
    if not np.linalg.det(left) > 0.0:
        raise StageFailure(
            "the fundamental matrix contradicts the intrinsics",
            "no second camera that it allows is close to these intrinsics",
            "set another focal length, or none",
        )
    own, turn = rq(left)
    baseline: F64 = np.asarray(np.linalg.solve(own, e2), dtype=np.float64)
    baseline *= np.sign(baseline @ t) / np.linalg.norm(baseline)
    return CalibratedPair(np.asarray(K1, dtype=np.float64), own / own[2, 2], turn, baseline)


def nearest_plane(a: F64, a4: F64, wanted: F64, *, K1: F64, K2: F64) -> tuple[float, F64]:
    """Find m and v for which m (a + a_4 v') is nearest to ``wanted``: least squares of K2^-1 (.) K1.

    Parameters
    ----------
    a : ndarray (3, 3)
        Left part of the second camera.
    a4 : ndarray (3,)
        Epipole in image 2.
    wanted : ndarray (3, 3)
        Infinite homography to approximate.
    K1, K2 : ndarray (3, 3)
        Intrinsics.

    Returns
    -------
    m : float
        Scale.
    v : ndarray (3,)
        Plane at infinity of the metric frame.
    """
    back = np.linalg.inv(K2)
    members = [a, *(np.outer(a4, axis) for axis in np.eye(3))]
    design = np.stack([(back @ member @ K1).ravel() for member in members], axis=1)
    m, *mv = np.linalg.lstsq(design, (back @ wanted @ K1).ravel(), rcond=None)[0]
    return float(m), np.asarray(mv) / m


def ratio_in_front(R: F64, t: F64, rays1: F64, rays2: F64) -> float:
    """Return the share of ray pairs that meet, at their closest points, in front of both cameras.

    Parameters
    ----------
    R : ndarray (3, 3)
        Rotation.
    t : ndarray (3,)
        Translation.
    rays1, rays2 : ndarray (N, 3)
        Corresponding rays.

    Returns
    -------
    float
        Share, 0 to 1.
    """
    turned = rays1 @ R.T
    normal = np.cross(turned, rays2)
    first = -np.sum(np.cross(t, rays2) * normal, axis=1)
    second = -np.sum(np.cross(t, turned) * normal, axis=1)
    return float(np.mean((first > 0.0) & (second > 0.0)))


def require_rotation(R: F64) -> None:
    """Check that R is a rotation: R'R = I and det R = 1 within ``OFF_ROTATION``.

    Parameters
    ----------
    R : ndarray (3, 3)
        The matrix.

    Raises
    ------
    ValueError
        If it is not a rotation.
    """
    R = np.asarray(R, dtype=np.float64)
    if R.shape != (3, 3) or not np.isfinite(R).all():
        raise ValueError(f"a rotation is a finite matrix (3, 3); got shape {R.shape}")
    off, det = float(np.abs(R.T @ R - np.eye(3)).max()), float(np.linalg.det(R))
    if not (off <= OFF_ROTATION and det > 0.0):
        raise ValueError(f"a rotation has R'R = I and det R = 1; this one is off by {off:.2g}, det {det:.3g}")


def require_translation(t: F64) -> None:
    """Check that t consists of three finite numbers.

    Parameters
    ----------
    t : ndarray (3,)
        The vector.

    Raises
    ------
    ValueError
        If it is not a translation.
    """
    if np.shape(t) != (3,) or not np.isfinite(t).all():
        raise ValueError(f"a translation is three finite numbers; got {t}")


def require_intrinsics(K: F64) -> None:
    """Check that K is upper triangular with positive focal lengths and K33 = 1.

    Parameters
    ----------
    K : ndarray (3, 3)
        The matrix.

    Raises
    ------
    ValueError
        If it is not a matrix of intrinsics.
    """
    K = np.asarray(K, dtype=np.float64)
    if K.shape != (3, 3) or not np.isfinite(K).all():
        raise ValueError(f"intrinsics are a finite matrix (3, 3); got shape {K.shape}")
    lower = float(np.abs(np.tril(K, -1)).max())
    if not (min(K[0, 0], K[1, 1]) > 0.0 and K[2, 2] == 1.0 and lower == 0.0):
        raise ValueError("intrinsics are [[f_u, skew, u_0], [0, f_v, v_0], [0, 0, 1]] with positive focals")


def _checked(F: F64, xy1: F64, xy2: F64) -> tuple[F64, F64, F64]:
    F, xy1, xy2 = (np.asarray(a, dtype=np.float64) for a in (F, xy1, xy2))
    if F.shape != (3, 3) or not np.isfinite(F).all() or not F.any():
        raise ValueError(f"a fundamental matrix is finite, (3, 3) and not zero; got shape {F.shape}")
    if xy1.shape != xy2.shape or xy1.ndim != 2 or xy1.shape[1] != 2:
        raise ValueError(f"matches are two (N, 2) arrays; got {xy1.shape} and {xy2.shape}")
    require_finite("view synthesis, for its matches,", xy1, xy2)
    if len(xy1) < MIN_MATCHES:
        raise StageFailure(
            "the two images have too few matches",
            f"{len(xy1)}, needed at least {MIN_MATCHES}",
            "choose images that overlap more",
        )
    return F, xy1, xy2


def _require_theirs(F: F64, xy1: F64, xy2: F64) -> None:
    """Reject an F of rank 1, matches that do not fit F, and matches without parallax."""
    s = np.linalg.svd(F, compute_uv=False)
    if not s[1] > RANK_ONE * s[0]:
        raise StageFailure(
            "the fundamental matrix has rank 1 and no epipolar lines",
            f"its second singular value is {s[1] / s[0]:.1g} of the first",
            "estimate it from more matches",
        )
    distance = np.abs(sampson_residuals(enforce_rank_two(F), xy1, xy2))
    extent = float(max(np.ptp(xy1, axis=0).max(), np.ptp(xy2, axis=0).max()))
    if not np.median(distance) <= MAX_RESIDUAL * extent:
        raise StageFailure(
            "the fundamental matrix does not fit the matches",
            f"their median distance from the epipolar lines is {np.median(distance):.3g} px",
            "estimate it from these matches",
        )
    require_parallax_of_matches(F, xy1, xy2)


@dataclass(frozen=True)
class VirtualCamera:
    """The third camera of the seed after a motion from X_3 to R X_3 + t.

    Parameters
    ----------
    rotation : ndarray (3, 3)
        R.
    translation : ndarray (3,)
        t in baselines.
    K : ndarray (3, 3)
        Intrinsics.
    size : tuple of int
        Width and height in pixels.

    Raises
    ------
    ValueError
        If the arguments are no rotation, translation or intrinsics, or the size is below 1 px.
    """

    rotation: F64
    translation: F64
    K: F64
    size: tuple[int, int]

    def __post_init__(self) -> None:
        require_rotation(self.rotation)
        require_translation(self.translation)
        require_intrinsics(self.K)
        if min(self.size) < 1:
            raise ValueError(f"an image is at least 1 x 1 px; got {self.size}")


def cameras_along(
    pair: CalibratedPair,
    frames: int,
    *,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    beyond: float = 0.0,
    third: tuple[F64, F64] | None = None,
) -> list[VirtualCamera]:
    """Place virtual cameras on the baseline from the first image to the second and beyond.

    Centres are equally spaced on the baseline; the rotation continues about its axis. K is interpolated
    if both sizes are equal, otherwise it is K2. One frame is the middle.

    Parameters
    ----------
    pair : CalibratedPair
        The cameras.
    frames : int
        Number of cameras, at least 1.
    sizes : tuple
        Width and height of both images; views have the size of the second.
    beyond : float
        Extension at both ends, in baselines.
    third : tuple of ndarray, optional
        R (3, 3) and t (3,) of the third camera of the seed, X_3 = R X_1 + t; default: the second
        camera.

    Returns
    -------
    list of VirtualCamera
        The cameras.

    Raises
    ------
    ValueError
        If ``frames`` is below 1 or ``beyond`` is negative or not finite.
    """
    if frames < 1:
        raise ValueError(f"a path needs at least one frame; got {frames}")
    if not 0.0 <= beyond < np.inf:
        raise ValueError(f"a path goes 0 or more baselines beyond; got {beyond}")
    at = np.linspace(-beyond, 1.0 + beyond, frames) if frames > 1 else np.array([0.5])
    return [camera_at(pair, float(s), sizes=sizes, third=third) for s in at]


def camera_at(
    pair: CalibratedPair,
    s: float,
    *,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    third: tuple[F64, F64] | None = None,
) -> VirtualCamera:
    """Place one virtual camera on the baseline; see :func:`cameras_along`.

    Parameters
    ----------
    pair : CalibratedPair
        The cameras.
    s : float
        Position in baselines from the first image (0) to the second (1).
    sizes : tuple
        Width and height of both images.
    third : tuple of ndarray, optional
        R (3, 3) and t (3,) of the third camera of the seed; default: the second camera.

    Returns
    -------
    VirtualCamera
        The camera.
    """
    turned = scipy.spatial.transform.Rotation.from_rotvec(
        s * scipy.spatial.transform.Rotation.from_matrix(pair.R).as_rotvec()
    ).as_matrix()
    share = min(max(s, 0.0), 1.0) if sizes[0] == sizes[1] else 1.0
    K = (1.0 - share) * pair.K1 + share * pair.K2
    # X_s = turned (X_1 - s C_2) and X_1 = R_3'(X_3 - t_3).
    R3, t3 = (pair.R, pair.t) if third is None else third
    motion = turned @ R3.T
    return VirtualCamera(motion, -s * turned @ pair.centre2 - motion @ t3, K, sizes[1])
