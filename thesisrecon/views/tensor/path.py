"""Virtual cameras of section 1.3, and their way along the baseline and beyond it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon.types import F64
from thesisrecon.views.tensor.pair import (
    CalibratedPair,
    require_intrinsics,
    require_rotation,
    require_translation,
)


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
