"""The trilinear tensor of virtual cameras (thesis, section 1.3; Avidan and Shashua 1997).

Cameras P1 = [I 0], P2 = [a, a_4], P3 = [b, b_4] have the tensor T_i^jk = a_i^j b_4^k - a_4^j b_i^k. If the
third camera rotates and moves to [Rb, R b_4 + t], the tensor becomes

    T'_i^jk = R_l^k T_i^jl + t^k a_i^j

One seed tensor gives all others; neither cameras nor scene points are needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize, require_finite
from thesisrecon.geometry.three_view import cameras_from_tensor, fundamentals_from_tensor
from thesisrecon.views.virtual_camera import (
    CalibratedPair,
    Orientation,
    nearest_plane,
    pair_from_fundamental,
    require_intrinsics,
    require_rotation,
    require_translation,
)


@dataclass(frozen=True)
class VirtualTensor:
    """The tensor of two images and a virtual camera.

    Parameters
    ----------
    T : ndarray (3, 3, 3)
        a_i^j b_4^k - a_4^j b_i^k with its scale, which determines signs and depths.
    P2 : ndarray (3, 4)
        [a, a_4] beside P1 = [I 0], in the frame of :attr:`CalibratedPair.P2`.
    K : ndarray (3, 3)
        Intrinsics of the third camera.
    """

    T: F64
    P2: F64
    K: F64

    @property
    def P3(self) -> F64:
        """The third camera [b, b_4] (3, 4) with its scale, from nine linear equations per row."""
        design = np.zeros((3, 3, 4))
        design[:, :, 3] = self.P2[:, :3].T
        for i in range(3):
            design[i, :, i] = -self.P2[:, 3]
        return np.asarray(np.linalg.lstsq(design.reshape(9, 4), self.T.reshape(9, 3), rcond=None)[0].T)

    @property
    def centre(self) -> F64:
        """Homogeneous centre (4,) of the third camera."""
        return camera_centre(self.P3)

    def swapped(self) -> VirtualTensor:
        """Return the tensor <2, 1, 3> in the frame of the swapped pair.

        Returns
        -------
        VirtualTensor
            The tensor with the roles of the first two images exchanged.
        """
        change = np.linalg.inv(np.vstack([self.P2, np.eye(4)[3]]))
        return VirtualTensor(_tensor(change[:3], self.P3 @ change), change[:3], self.K)

    def moved(self, rotation: F64, translation: F64, *, K: F64 | None = None) -> VirtualTensor:
        """Return the tensor after a motion of the third camera from X_3 to R X_3 + t.

        Parameters
        ----------
        rotation : ndarray (3, 3)
            R.
        translation : ndarray (3,)
            t in units of the baseline.
        K : ndarray (3, 3), optional
            New intrinsics; default: unchanged.

        Returns
        -------
        VirtualTensor
            The tensor; in pixels the motion is K R K_3^-1 and K t.

        Raises
        ------
        ValueError
            If the arguments are no rotation, translation or intrinsics.
        """
        require_rotation(rotation)
        require_translation(translation)
        K = self.K if K is None else K
        require_intrinsics(K)
        turn, shift = K @ rotation @ np.linalg.inv(self.K), K @ translation
        T = np.einsum("kl,ijl->ijk", turn, self.T) + np.einsum("k,ji->ijk", shift, self.P2[:, :3])
        return VirtualTensor(T, self.P2, K)

    def perpendicular_lines(self, xy1: F64, xy2: F64) -> F64:
        """Return lines in image 2 through x2, perpendicular to the epipolar lines of x1.

        Of all lines through x2 these carry the most information: an x2 off its epipolar line acts as its
        nearest point on the line.

        Parameters
        ----------
        xy1, xy2 : ndarray (..., 2)
            Matches in pixels.

        Returns
        -------
        ndarray (..., 3)
            Lines; zero at the epipole.
        """
        epipolar = np.cross(self.P2[:, 3], homogenize(xy1) @ self.P2[:, :3].T)
        norm = np.linalg.norm(epipolar[..., :2], axis=-1, keepdims=True)
        along = np.stack([epipolar[..., 1], -epipolar[..., 0]], axis=-1) / np.where(norm > 0.0, norm, 1.0)
        return np.concatenate([along, -np.sum(along * xy2, axis=-1, keepdims=True)], axis=-1)

    def transfer(self, xy1: F64, xy2: F64, *, lines: F64 | None = None) -> tuple[F64, F64]:
        """Transfer matches to the third image, x''^k = x^i l_j T_i^jk.

        Parameters
        ----------
        xy1, xy2 : ndarray (N, 2)
            Matches in pixels.
        lines : ndarray (N, 3), optional
            Lines through x2 in image 2 other than epipolar lines; default: :meth:`perpendicular_lines`.

        Returns
        -------
        xy : ndarray (N, 2)
            Pixels of the third image, NaN behind the camera.
        inverse_depth : ndarray (N,)
            1 / z in the third camera (z in baselines); negative beyond infinity.
        """
        x = homogenize(xy1)
        lines = self.perpendicular_lines(xy1, xy2) if lines is None else lines
        places = np.einsum("ni,nj,ijk->nk", x, lines, self.T)
        # With X = (x, rho), l'(a x + rho a_4) = 0 and the places are -(l'a_4) (b x + rho b_4).
        sweep = lines @ self.P2[:, 3]
        seen = -places[:, 2] * sweep > 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse_depth = np.where(
                seen, np.sum(lines * (x @ self.P2[:, :3].T), axis=1) / places[:, 2], np.nan
            )
        return np.where(seen[:, None], dehomogenize(places), np.nan), inverse_depth

    def disparity_per_inverse_depth(self, xy1: F64, xy2: F64) -> F64:
        """Return the displacement in image 2 per unit of inverse depth in the third view, to first order.

        Parameters
        ----------
        xy1, xy2 : ndarray (N, 2)
            Matches in pixels.

        Returns
        -------
        ndarray (N,)
            Pixels per unit of inverse depth; NaN at the epipole.
        """
        x = homogenize(xy1)
        a, a4 = x @ self.P2[:, :3].T, self.P2[:, 3]
        lines, third = self.perpendicular_lines(xy1, xy2), self.P3[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            rho = -np.sum(lines * a, axis=1) / (lines @ a4)
            # x_2 = (a + rho a_4) / w_2, and the inverse depth is rho / w_3.
            w2, w3 = a[:, 2] + rho * a4[2], x @ third[:3] + rho * third[3]
            along = np.linalg.norm(a4[:2] * a[:, 2:] - a[:, :2] * a4[2], axis=1) / w2**2
            return np.asarray(along * w3**2 / np.abs(x @ third[:3]))


def seed_of_two(pair: CalibratedPair) -> VirtualTensor:
    """Return the seed tensor <1, 2, 2> of two views, in which the second view is also the third.

    Parameters
    ----------
    pair : CalibratedPair
        The cameras.

    Returns
    -------
    VirtualTensor
        The tensor; it holds the same information as F.
    """
    return VirtualTensor(_tensor(pair.P2, pair.P2), pair.P2, pair.K2)


def seed_of_first(pair: CalibratedPair) -> VirtualTensor:
    """Return the tensor <1, 2, 1> of two views; its inverse depth is that in view 1.

    Parameters
    ----------
    pair : CalibratedPair
        The cameras.

    Returns
    -------
    VirtualTensor
        The tensor.
    """
    return VirtualTensor(_tensor(pair.P2, np.eye(3, 4)), pair.P2, pair.K1)


def seed_of_three(
    T: F64, xy1: F64, xy2: F64, *, K: tuple[F64, F64, F64], orientation: Orientation | None = None
) -> tuple[CalibratedPair, VirtualTensor]:
    """Return the tensor <1, 2, 3> of three images in the frame of the first two cameras.

    The plane at infinity is that of :func:`pair_from_fundamental`; the scale of the third camera makes
    its left part a rotation.

    Parameters
    ----------
    T : ndarray (3, 3, 3)
        Trifocal tensor in pixels.
    xy1, xy2 : ndarray (N, 2)
        Matches of the first two images in pixels.
    K : tuple of ndarray (3, 3)
        Intrinsics of the three images.
    orientation : Orientation, optional
        Decomposition of the essential matrix.

    Returns
    -------
    CalibratedPair, VirtualTensor
        The first two cameras, and the tensor in their frame.

    Raises
    ------
    ValueError, StageFailure
        As :func:`pair_from_fundamental`.
    """
    require_finite("seed_of_three", T)
    require_intrinsics(K[2])
    _, P2, P3 = cameras_from_tensor(T)
    pair = pair_from_fundamental(
        fundamentals_from_tensor(T)[0], xy1, xy2, K1=K[0], K2=K[1], orientation=orientation
    )
    # P2 of the pair is m (a + a_4 v', s a_4).
    a, a4 = P2[:, :3], P2[:, 3]
    m, v = nearest_plane(a, a4, pair.P2[:, :3], K1=pair.K1, K2=pair.K2)
    change = np.eye(4)
    change[3, :3] = v
    change[3, 3] = a4 @ pair.P2[:, 3] / (m * (a4 @ a4))
    third = np.linalg.inv(K[2]) @ P3 @ change
    left = third[:, :3] @ K[0]
    third = K[2] @ third / np.cbrt(np.linalg.det(left))
    return pair, VirtualTensor(_tensor(pair.P2, third), pair.P2, np.asarray(K[2], dtype=np.float64))


def _tensor(P2: F64, P3: F64) -> F64:
    """a_i^j b_4^k - a_4^j b_i^k (3, 3, 3) with the scales of P2 and P3 (3, 4)."""
    return np.asarray(
        np.einsum("ji,k->ijk", P2[:, :3], P3[:, 3]) - np.einsum("j,ki->ijk", P2[:, 3], P3[:, :3])
    )
