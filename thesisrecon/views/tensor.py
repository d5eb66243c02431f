"""View synthesis in tensor space: cameras of two images, virtual cameras and their tensors (section 1.3).

After Avidan and Shashua (CVPR 1997, PAMI 1998). Cameras P1 = [I 0], P2 = [a, a_4], P3 = [b, b_4] have the
tensor T_i^jk = a_i^j b_4^k - a_4^j b_i^k. If the third camera rotates and moves to [Rb, R b_4 + t],

    T'_i^jk = R_l^k T_i^jl + t^k a_i^j

One seed tensor gives all others; neither cameras nor scene points are needed. Unknown intrinsics are guessed,
as in the thesis; new views are then correct up to a projective transform of space.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon.arrays import F64, require_calibration, require_finite
from thesisrecon.camera import rq
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import calibration_matrix
from thesisrecon.geometry.homogeneous import cross_matrix, dehomogenize, homogenize, unit_normals
from thesisrecon.geometry.two_view import enforce_rank_two, epipoles, require_parallax_of_matches


def _require_motion(R: F64, t: F64) -> None:
    """Check that R is a rotation within ``OFF_ROTATION`` and t three finite numbers."""
    off_rotation = 1e-4  # Tolerance of R'R - I: a rotation written with four digits passes
    R = np.asarray(R, dtype=np.float64)
    if R.shape != (3, 3) or not np.isfinite(R).all():
        raise ValueError(f"a rotation is a finite matrix (3, 3); got shape {R.shape}")
    off, det = float(np.abs(R.T @ R - np.eye(3)).max()), float(np.linalg.det(R))
    if not (off <= off_rotation and det > 0.0):
        raise ValueError(f"a rotation has R'R = I and det R = 1; this one is off by {off:.2g}, det {det:.3g}")
    if np.shape(t) != (3,) or not np.isfinite(t).all():
        raise ValueError(f"a translation is three finite numbers; got {t}")


@dataclass(frozen=True)
class CalibratedPair:
    """Two calibrated cameras, X_2 = R X_1 + t. For two images |t| = 1 is the unit of length."""

    K1: F64  #: (3, 3) intrinsics, as is ``K2``
    K2: F64
    R: F64  #: (3, 3) and ``t`` (3,) from the first to the second camera frame
    t: F64

    def __post_init__(self) -> None:
        require_calibration("view synthesis", self.K1)
        require_calibration("view synthesis", self.K2)
        _require_motion(self.R, self.t)
        if not np.linalg.norm(self.t) > 0.0:
            raise ValueError("CalibratedPair needs a translation other than 0")

    @property
    def P2(self) -> F64:
        """The second camera [a, a_4] = [K2 R K1^-1, K2 t] (3, 4) beside P1 = [I 0].

        Space points are K1 X_1, so a point is (x, 1 / depth) for its pixel x in view 1 and a is the infinite
        homography.
        """
        return np.column_stack([self.K2 @ self.R @ np.linalg.inv(self.K1), self.K2 @ self.t])

    @property
    def centre2(self) -> F64:
        """Centre (3,) of the second camera in the frame of the first."""
        return np.asarray(-self.R.T @ self.t)

    @property
    def swapped(self) -> CalibratedPair:
        """The same cameras in the other order."""
        return CalibratedPair(self.K2, self.K1, self.R.T, self.centre2)


def default_intrinsics(size: tuple[int, int]) -> F64:
    """Return K with the long side as focal length and the principal point at the image centre."""
    f = float(max(size))
    return calibration_matrix(f, f, 0.5 * (size[0] - 1.0), 0.5 * (size[1] - 1.0))


def pair_from_fundamental(F: F64, xy1: F64, xy2: F64, *, K1: F64, K2: F64) -> CalibratedPair:
    """Compute the two cameras of F for given intrinsics (thesis, section 1.3).

    The fundamental matrix of the result is F exactly. The first camera has K1; of all second cameras that F
    allows, the left part is nearest to K2 R K1^-1 (least squares in coordinates of K2 and K1) with R from the
    essential matrix. Its intrinsics differ from K2 where F contradicts them.
    """
    in_front = 0.75  # Share of matches that must lie in front of both cameras
    require_finite("pair_from_fundamental", F, xy1, xy2)
    require_calibration("view synthesis", K1)
    require_calibration("view synthesis", K2)
    require_parallax_of_matches(F, xy1, xy2)
    E = K2.T @ F @ K1
    rays1, rays2 = (homogenize(xy) @ np.linalg.inv(K).T for xy, K in ((xy1, K1), (xy2, K2)))
    candidates = _decompose(E / np.linalg.norm(E))
    shares = [_ratio_in_front(R, t, rays1, rays2) for R, t in candidates]
    best = int(np.argmax(shares))
    if not shares[best] >= in_front:
        raise StageFailure(
            "the scene is not in front of both cameras",
            f"{100.0 * shares[best]:.0f} % of {len(xy1)} matches are, with the best of {len(shares)} cameras",
            "check the fundamental matrix and the intrinsics",
        )
    return _pair_with(F, K1, K2, *candidates[best])


def _pair_with(F: F64, K1: F64, K2: F64, R: F64, t: F64) -> CalibratedPair:
    """The pair that has F and is nearest to K1, K2, R, t."""
    F = enforce_rank_two(F)
    e2 = epipoles(F)[1]
    H = -cross_matrix(e2) @ F
    # Least squares for m and m v: K2^-1 m (H + e2 v') K1 is nearest to R.
    back = np.linalg.inv(K2)
    design = np.stack(
        [(back @ M @ K1).ravel() for M in (H, *(np.outer(e2, axis) for axis in np.eye(3)))], axis=1
    )
    wanted = K2 @ R @ np.linalg.inv(K1)
    m, *mv = np.linalg.lstsq(design, (back @ wanted @ K1).ravel(), rcond=None)[0]
    left = m * (H + np.outer(e2, np.asarray(mv) / m)) @ K1
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


def _ratio_in_front(R: F64, t: F64, rays1: F64, rays2: F64) -> float:
    """Share of ray pairs (N, 3) that meet, at their closest points, in front of both cameras."""
    turned = rays1 @ R.T
    normal = np.cross(turned, rays2)
    first = -np.sum(np.cross(t, rays2) * normal, axis=1)
    second = -np.sum(np.cross(t, turned) * normal, axis=1)
    return float(np.mean((first > 0.0) & (second > 0.0)))


def _decompose(E: F64) -> list[tuple[F64, F64]]:
    """The four R = U W V' or U W' V' and unit t = +-u_3 of an essential matrix (HZ 9.6.2)."""
    U, _, Vt = np.linalg.svd(E)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turns = [U @ W @ Vt for W in (quarter, quarter.T)]
    turns = [R * np.sign(np.linalg.det(R)) for R in turns]
    return [(R, sign * U[:, 2]) for R in turns for sign in (1.0, -1.0)]


@dataclass(frozen=True)
class VirtualCamera:
    """A virtual camera: the third camera of the seed tensor, moved from X_3 to R X_3 + t."""

    rotation: F64  #: R (3, 3)
    translation: F64  #: t (3,) in baselines
    K: F64  #: (3, 3)
    size: tuple[int, int]  #: width and height in pixels

    def __post_init__(self) -> None:
        _require_motion(self.rotation, self.translation)
        require_calibration("view synthesis", self.K)
        if min(self.size) < 1:
            raise ValueError(f"an image is at least 1 x 1 px; got {self.size}")


def camera_at(
    pair: CalibratedPair, s: float, *, sizes: tuple[tuple[int, int], tuple[int, int]]
) -> VirtualCamera:
    """Place a virtual camera on the baseline; its rotation angle is the fraction ``s`` of that of the pair.

    K is interpolated if both sizes are equal, otherwise it is K2.
    """
    turned = scipy.spatial.transform.Rotation.from_rotvec(
        s * scipy.spatial.transform.Rotation.from_matrix(pair.R).as_rotvec()
    ).as_matrix()
    share = min(max(s, 0.0), 1.0) if sizes[0] == sizes[1] else 1.0
    K = (1.0 - share) * pair.K1 + share * pair.K2
    # X_s = turned (X_1 - s C_2) and X_1 = R'(X_2 - t).
    motion = turned @ pair.R.T
    return VirtualCamera(motion, -s * turned @ pair.centre2 - motion @ pair.t, K, sizes[1])


@dataclass(frozen=True)
class VirtualTensor:
    """The tensor of two images and a virtual camera."""

    T: F64  #: (3, 3, 3) a_i^j b_4^k - a_4^j b_i^k with its scale, which determines signs and depths
    P2: F64  #: (3, 4) [a, a_4] beside P1 = [I 0], as :attr:`CalibratedPair.P2`
    K: F64  #: (3, 3) intrinsics of the third camera

    @property
    def P3(self) -> F64:
        """The third camera [b, b_4] (3, 4) with its scale, from nine linear equations per row."""
        design = np.zeros((3, 3, 4))
        design[:, :, 3] = self.P2[:, :3].T
        for i in range(3):
            design[i, :, i] = -self.P2[:, 3]
        return np.asarray(np.linalg.lstsq(design.reshape(9, 4), self.T.reshape(9, 3), rcond=None)[0].T)

    @property
    def swapped(self) -> VirtualTensor:
        """The tensor <2, 1, 3> in the frame of the swapped pair."""
        change = np.linalg.inv(np.vstack([self.P2, np.eye(4)[3]]))
        return VirtualTensor(_tensor(change[:3], self.P3 @ change), change[:3], self.K)

    def moved(self, rotation: F64, translation: F64, *, K: F64 | None = None) -> VirtualTensor:
        """Return the tensor after a motion of the third camera from X_3 to R X_3 + t."""
        K = self.K if K is None else K
        turn, shift = K @ rotation @ np.linalg.inv(self.K), K @ translation
        T = np.einsum("kl,ijl->ijk", turn, self.T) + np.einsum("k,ji->ijk", shift, self.P2[:, :3])
        return VirtualTensor(T, self.P2, K)

    def _perpendicular_lines(self, xy1: F64, xy2: F64) -> F64:
        """Lines (..., 3) through x2, perpendicular to the epipolar lines of x1; zero at the epipole."""
        epipolar = unit_normals(np.cross(self.P2[:, 3], homogenize(xy1) @ self.P2[:, :3].T))
        along = np.stack([epipolar[..., 1], -epipolar[..., 0]], axis=-1)
        return np.concatenate([along, -np.sum(along * xy2, axis=-1, keepdims=True)], axis=-1)

    def transfer(self, xy1: F64, xy2: F64) -> tuple[F64, F64]:
        """Transfer matches to the third image, x''^k = x^i l_j T_i^jk, l perpendicular to epipolar lines."""
        x = homogenize(xy1)
        lines = self._perpendicular_lines(xy1, xy2)
        places = np.einsum("ni,nj,ijk->nk", x, lines, self.T)
        # With X = (x, rho), l'(a x + rho a_4) = 0 and the places are -(l'a_4) (b x + rho b_4).
        sweep = lines @ self.P2[:, 3]
        seen = -places[:, 2] * sweep > 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse_depth = np.sum(lines * (x @ self.P2[:, :3].T), axis=1) / places[:, 2]
        inverse_depth[~seen] = np.nan
        return np.where(seen[:, None], dehomogenize(places), np.nan), inverse_depth

    def disparity_per_inverse_depth(self, xy1: F64, xy2: F64) -> F64:
        """Return the displacement in image 2 per unit of inverse depth in the third view, to first order."""
        x = homogenize(xy1)
        a, a4 = x @ self.P2[:, :3].T, self.P2[:, 3]
        lines, third = self._perpendicular_lines(xy1, xy2), self.P3[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            rho = -np.sum(lines * a, axis=1) / (lines @ a4)
            # x_2 = (a + rho a_4) / w_2, and the inverse depth is rho / w_3.
            w2, w3 = a[:, 2] + rho * a4[2], x @ third[:3] + rho * third[3]
            along = np.linalg.norm(a4[:2] * a[:, 2:] - a[:, :2] * a4[2], axis=1) / w2**2
            return np.asarray(along * w3**2 / np.abs(x @ third[:3]))


def seed_of_two(pair: CalibratedPair, *, first: bool = False) -> VirtualTensor:
    """Return the seed tensor <1, 2, 2> of two views, in which one view is also the third."""
    P3, K = (np.eye(3, 4), pair.K1) if first else (pair.P2, pair.K2)
    return VirtualTensor(_tensor(pair.P2, P3), pair.P2, K)


def _tensor(P2: F64, P3: F64) -> F64:
    """a_i^j b_4^k - a_4^j b_i^k (3, 3, 3) with the scales of P2 and P3 (3, 4)."""
    first, second = np.einsum("ji,k->ijk", P2[:, :3], P3[:, 3]), np.einsum("j,ki->ijk", P2[:, 3], P3[:, :3])
    return np.asarray(first - second)
