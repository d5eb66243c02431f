"""Section 1.3: the two cameras that the seed of view synthesis is made of, from F and intrinsics.

Intrinsics are fixed to a guess where nothing better is known, as the thesis has it: the new views are then
right up to a projective transform of space. The rotation between the two cameras is read off F, small as
Avidan and Shashua (CVPR 1997, PAMI 1998) take it, or any.

Virtual cameras of section 1.3, and their way along the baseline and beyond it.
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
from thesisrecon.geometry.two_view import enforce_rank_two, epipoles, require_parallax, sampson_residuals

USUAL_FOCAL = 1.0
"""Focal length over the long side of the picture: between a telephoto (2) and a wide-angle lens (0.6)."""
LEAST_MATCHES = 8
LARGEST_RESIDUAL = 0.005
"""Median distance of matches from their epipolar lines, over the long side, beyond which F is not theirs."""
RANK_ONE = 1e-9
OFF_ROTATION = 1e-4
"""Entries of R'R - I: of a rotation written with four digits."""
IN_FRONT = 0.75
"""Share of matches in front of both cameras, the rotation being the right one."""


@dataclass(frozen=True)
class CalibratedPair:
    """Two cameras, X_2 = R X_1 + t: ``K1``, ``K2``, ``R`` (3, 3), ``t`` (3,).

    Of two photographs |t| is not to be known: it is the unit of length, 1.
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
        """[a, a_4] = [K2 R K1^-1, K2 t] (3, 4) beside P1 = [I 0].

        Space is X_1 multiplied by K1, so that a point is (x, 1 / depth) for its pixel x in view 1, and a is
        the homography of the plane at infinity.
        """
        return np.column_stack([self.K2 @ self.R @ np.linalg.inv(self.K1), self.K2 @ self.t])

    @property
    def centre2(self) -> F64:
        """The second centre (3,) in the frame of the first camera."""
        return np.asarray(-self.R.T @ self.t)

    def swapped(self) -> CalibratedPair:
        """The same cameras in the other order."""
        return CalibratedPair(self.K2, self.K1, self.R.T, self.centre2)


class Orientation(Protocol):
    """A way from an essential matrix to rotations and directions of the baseline."""

    def candidates(self, E: F64) -> list[tuple[F64, F64]]:
        """Pairs of R (3, 3) and unit t (3,) of E (3, 3)."""
        ...


@dataclass(frozen=True)
class AnyRotation:
    """The four decompositions of an essential matrix (HZ 9.6.2)."""

    def candidates(self, E: F64) -> list[tuple[F64, F64]]:
        """R = U W V' or U W' V', t the last column of U or its opposite."""
        U, _, Vt = np.linalg.svd(E)
        quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        turns = [U @ W @ Vt for W in (quarter, quarter.T)]
        turns = [R * np.sign(np.linalg.det(R)) for R in turns]
        return [(R, sign * U[:, 2]) for R in turns for sign in (1.0, -1.0)]


@dataclass(frozen=True)
class SmallRotation:
    """R = I + [w]x to first order, as Avidan and Shashua take it (after Rousso et al., CVPR 1996).

    E ~ [t]x (I + [w]x) is linear in the scale s of E and in s w: nine equations for four unknowns (least
    squares). The rotation of the vector w is returned, for I + [w]x is none.
    """

    def candidates(self, E: F64) -> list[tuple[F64, F64]]:
        """One rotation, with t and its opposite."""
        _, t = epipoles(E)
        across = cross_matrix(t)
        columns = [across, *(across @ cross_matrix(axis) for axis in np.eye(3))]
        design = np.stack([column.ravel() for column in columns], axis=1)
        solution = np.linalg.lstsq(design, E.ravel(), rcond=None)[0]
        if not abs(solution[0]) > 1e-6 * np.linalg.norm(solution):
            raise StageFailure(
                "the rotation between the two photographs is not small",
                "no rotation near none explains the fundamental matrix",
                "take the rotation for any instead",
            )
        R = scipy.spatial.transform.Rotation.from_rotvec(solution[1:] / solution[0]).as_matrix()
        return [(R, t), (R, -t)]


def guessed_intrinsics(size: tuple[int, int], *, focal: float = USUAL_FOCAL) -> F64:
    """K (3, 3) with square pixels, the principal point in the middle of ``size`` (width, height) and a focal
    length of ``focal`` long sides.

    Raises ``ValueError`` for a focal length that is not positive.
    """
    f = focal * max(size)
    return calibration_matrix(f, f, 0.5 * (size[0] - 1.0), 0.5 * (size[1] - 1.0))


def pair_from_fundamental(
    F: F64, xy1: F64, xy2: F64, *, K1: F64, K2: F64, orientation: Orientation | None = None
) -> CalibratedPair:
    """The two cameras of F and its matches, seen through K1 and K2 (section 1.3).

    Parameters
    ----------
    F : (3, 3), x2' F x1 = 0.
    xy1, xy2 : (N >= 8, 2) px matches that obey F; they say which camera looks where, and whether F is theirs.
    K1, K2 : (3, 3) intrinsics, guessed (:func:`guessed_intrinsics`) or known.
    orientation : :class:`AnyRotation` by default, or :class:`SmallRotation`.

    Returns
    -------
    Cameras with a baseline of length 1 whose fundamental matrix is F exactly, so that both photographs agree
    on every point. They have K1 and, of all second cameras that F allows, the one whose left part is nearest
    to K2 R K1^-1 (least squares, in coordinates of K2 and K1) with R of the essential matrix: its K2 differs
    from the given one as far as F contradicts the intrinsics.

    Raises
    ------
    ValueError
        Wrong shapes, numbers that are not finite, K that are no intrinsics.
    StageFailure
        Too few matches, an F of rank 1 or of other matches, no parallax, and matches that lie behind the
        cameras.
    """
    F, xy1, xy2 = _checked(F, xy1, xy2)
    require_intrinsics(K1)
    require_intrinsics(K2)
    _require_theirs(F, xy1, xy2)
    E = K2.T @ F @ K1
    rays1, rays2 = (homogenize(xy) @ np.linalg.inv(K).T for xy, K in ((xy1, K1), (xy2, K2)))
    candidates = (orientation or AnyRotation()).candidates(E / np.linalg.norm(E))
    shares = [share_in_front(R, t, rays1, rays2) for R, t in candidates]
    best = int(np.argmax(shares))
    if not shares[best] >= IN_FRONT:
        raise StageFailure(
            "the scene is not in front of both photographs",
            f"{100.0 * shares[best]:.0f} % of {len(xy1)} matches are, for the best of {len(shares)} cameras",
            "the fundamental matrix or the intrinsics are wrong; estimate them anew",
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
            "no second camera that it allows is near to one with these",
            "give the focal length of the photographs, or none",
        )
    own, turn = rq(left)
    baseline: F64 = np.asarray(np.linalg.solve(own, e2), dtype=np.float64)
    baseline *= np.sign(baseline @ t) / np.linalg.norm(baseline)
    return CalibratedPair(np.asarray(K1, dtype=np.float64), own / own[2, 2], turn, baseline)


def nearest_plane(a: F64, a4: F64, wanted: F64, *, K1: F64, K2: F64) -> tuple[float, F64]:
    """m and v (3,) for which m (a + a_4 v') is nearest to ``wanted`` (3, 3): least squares of K2^-1 (.) K1.

    Of all planes that may play infinity it is the one that is where it would be in a metric frame.
    """
    back = np.linalg.inv(K2)
    members = [a, *(np.outer(a4, axis) for axis in np.eye(3))]
    design = np.stack([(back @ member @ K1).ravel() for member in members], axis=1)
    m, *mv = np.linalg.lstsq(design, (back @ wanted @ K1).ravel(), rcond=None)[0]
    return float(m), np.asarray(mv) / m


def share_in_front(R: F64, t: F64, rays1: F64, rays2: F64) -> float:
    """Share of the rays (N, 3), (N, 3) that meet, at their nearest, in front of both cameras."""
    turned = rays1 @ R.T
    normal = np.cross(turned, rays2)
    first = -np.sum(np.cross(t, rays2) * normal, axis=1)
    second = -np.sum(np.cross(t, turned) * normal, axis=1)
    return float(np.mean((first > 0.0) & (second > 0.0)))


def require_rotation(R: F64) -> None:
    """``ValueError`` unless R (3, 3) is a rotation: R'R = I, det R = 1, to ``OFF_ROTATION``."""
    R = np.asarray(R, dtype=np.float64)
    if R.shape != (3, 3) or not np.isfinite(R).all():
        raise ValueError(f"a rotation is a finite matrix (3, 3); got shape {R.shape}")
    off, det = float(np.abs(R.T @ R - np.eye(3)).max()), float(np.linalg.det(R))
    if not (off <= OFF_ROTATION and det > 0.0):
        raise ValueError(f"a rotation has R'R = I and det R = 1; this one is off by {off:.2g}, det {det:.3g}")


def require_translation(t: F64) -> None:
    """``ValueError`` unless t is three finite numbers."""
    if np.shape(t) != (3,) or not np.isfinite(t).all():
        raise ValueError(f"a translation is three finite numbers; got {t}")


def require_intrinsics(K: F64) -> None:
    """``ValueError`` unless K (3, 3) is upper triangular with positive focals and K33 = 1."""
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
    if len(xy1) < LEAST_MATCHES:
        raise StageFailure(
            "the two photographs have too few matches",
            f"{len(xy1)}, needed at least {LEAST_MATCHES}",
            "choose photographs that overlap more",
        )
    return F, xy1, xy2


def _require_theirs(F: F64, xy1: F64, xy2: F64) -> None:
    """Refuse an F without epipolar lines, matches that are not on them, and matches without parallax."""
    s = np.linalg.svd(F, compute_uv=False)
    if not s[1] > RANK_ONE * s[0]:
        raise StageFailure(
            "the fundamental matrix has rank 1 and no epipolar lines",
            f"its second singular value is {s[1] / s[0]:.1g} of the first",
            "estimate it from more matches",
        )
    distance = np.abs(sampson_residuals(enforce_rank_two(F), xy1, xy2))
    extent = float(max(np.ptp(xy1, axis=0).max(), np.ptp(xy2, axis=0).max()))
    if not np.median(distance) <= LARGEST_RESIDUAL * extent:
        raise StageFailure(
            "the fundamental matrix is not that of the matches",
            f"half of them are more than {np.median(distance):.3g} px off their epipolar lines",
            "estimate it from these matches",
        )
    require_parallax(F, xy1, xy2)


@dataclass(frozen=True)
class VirtualCamera:
    """The third camera of the seed after a motion from X_3 to R X_3 + t: the second one's, where two
    photographs are all there is.

    ``rotation`` R (3, 3); ``translation`` t (3,) in baselines; ``K`` (3, 3) and ``size`` (width, height) of
    its picture. Raises ``ValueError`` for what is no rotation, translation or K, and a size below 1 px.
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
            raise ValueError(f"a picture is at least 1 x 1 px; got {self.size}")


def cameras_along(
    pair: CalibratedPair,
    frames: int,
    *,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    beyond: float = 0.0,
    third: tuple[F64, F64] | None = None,
) -> list[VirtualCamera]:
    """``frames`` cameras from the first photograph to the second, and ``beyond`` baselines farther at both
    ends.

    Centres are evenly spaced on the line of the baseline; rotations go on about their axis as from the first
    to the second. Pictures have the second one's size (width, height); where ``sizes`` are equal K is
    interpolated, else it is K2. One frame is the middle. ``third`` R (3, 3), t (3,) of the seed's third
    camera, X_3 = R X_1 + t, by default the second one. Raises ``ValueError`` for no frame, and for a
    ``beyond`` that is negative or no number.
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
    """The camera at ``s`` baselines from the first photograph to the second; see :func:`cameras_along`."""
    turned = scipy.spatial.transform.Rotation.from_rotvec(
        s * scipy.spatial.transform.Rotation.from_matrix(pair.R).as_rotvec()
    ).as_matrix()
    share = min(max(s, 0.0), 1.0) if sizes[0] == sizes[1] else 1.0
    K = (1.0 - share) * pair.K1 + share * pair.K2
    # X_s = turned (X_1 - s C_2) and X_1 = R_3'(X_3 - t_3).
    R3, t3 = (pair.R, pair.t) if third is None else third
    motion = turned @ R3.T
    return VirtualCamera(motion, -s * turned @ pair.centre2 - motion @ t3, K, sizes[1])
