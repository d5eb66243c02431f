"""Whether the camera motion determines the calibration at all, and the nearest critical motion by name.

Sturm, "Critical motion sequences", CVPR 1997: pure translation, pure rotation, rotation about parallel axes
(planar and turntable motion) leave a family of answers that fit the images equally well.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thesisrecon.selfcalibration.frame import ReferenceFrame

F64 = NDArray[np.float64]

_MIN_ROTATION_DEG = 3.0
_MIN_AXIS_SPREAD_DEG = 2.0
_MAX_FOCAL_STD = 0.15


def upgraded_rotations(frame: ReferenceFrame, theta: F64) -> F64:
    """Nearest rotations (R, 3, 3) of the upgraded cameras, reference at the identity."""
    f = np.exp(theta[3:])[frame.group]
    C = frame.A - frame.a[:, :, None] * theta[None, None, :3]
    C = C * np.array([1.0, 1.0, 0.0]) * f[frame.reference] + C * np.array([0.0, 0.0, 1.0])
    C[:, :2] /= f[:, None, None]
    C *= np.where(np.linalg.det(C) < 0, -1.0, 1.0)[:, None, None]
    U, _, Vt = np.linalg.svd(C)
    return np.asarray(U @ Vt, dtype=np.float64)


def rotation_spread(R: F64) -> tuple[float, float]:
    """Largest rotation angle between views and how far the rotations are from sharing one axis, both in
    degrees.

    The second number is the rms angle out of the best common axis: with rotation vectors r of all view pairs
    it is the square root of the smallest but one eigenvalue of mean(r r').
    """
    i, j = np.triu_indices(len(R), 1)
    vectors = Rotation.from_matrix(R[j] @ R[i].swapaxes(1, 2)).as_rotvec()
    # Axes in the world frame, so that a turntable shows one axis whatever the cameras look like.
    world = np.einsum("kba,kb->ka", R[i], vectors)
    values = np.linalg.eigvalsh(world.T @ world / len(world))
    return float(np.degrees(np.linalg.norm(vectors, axis=1).max())), float(
        np.degrees(np.sqrt(max(values[1], 0.0)))
    )


def identifiability(
    frame: ReferenceFrame, theta: F64, std_log_f: F64, noise: float
) -> tuple[bool, tuple[str, ...]]:
    """Verdict and its reasons for a refined answer theta (3 + G,)."""
    angle, spread = rotation_spread(upgraded_rotations(frame, theta))
    worst = float(std_log_f.max())
    reasons = []
    if not worst < _MAX_FOCAL_STD:
        reasons.append(
            f"the cameras fix the focal length only to {min(worst, 9.99):.0%} (residual noise {noise:.3f}); "
            "turn the camera more between photographs, or give a focal prior"
        )
    if angle < _MIN_ROTATION_DEG:
        reasons.append(
            f"the cameras hardly turn (largest rotation {angle:.1f} deg): close to a pure translation, "
            "which leaves the calibration undetermined"
        )
    elif reasons and spread < _MIN_AXIS_SPREAD_DEG:
        reasons.append(
            f"all rotations share one axis to within {spread:.1f} deg: close to a planar or turntable motion"
        )
    return not reasons, tuple(reasons)
