"""Plane at infinity from guessed focals of two cameras (Gherardi and Fusiello, "Practical autocalibration",
ECCV 2010).

Two cameras with known K fix the plane at infinity in closed form; scanning the two focals over the plausible
range and looking at all the other cameras replaces every nonconvex search.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.selfcalibration.frame import ReferenceFrame

F64 = NDArray[np.float64]


def _rotation_to_first_axis(t: F64) -> F64:
    """Rotations R (B, 3, 3) with R t = (|t|, 0, 0); rows t/|t| and any two orthonormal to it."""
    first = t / np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-300)
    helper = np.eye(3)[np.abs(first).argmin(axis=1)]
    second = np.cross(first, helper)
    second /= np.maximum(np.linalg.norm(second, axis=1, keepdims=True), 1e-300)
    return np.stack([first, second, np.cross(first, second)], axis=1)


def plane_from_focals(frame: ReferenceFrame, other: int, f_reference: F64, f_other: F64) -> F64:
    """Planes at infinity p (2 B, 3) for guessed unit-free focals (B,) of the reference and of camera
    ``other``.

    Both signs of the second camera are returned, since a projective camera has none.
    """
    K1 = np.stack([f_reference, f_reference, np.ones_like(f_reference)], axis=1)
    K2 = np.stack([f_other, f_other, np.ones_like(f_other)], axis=1)
    t = frame.a[other] / K2
    rotation = _rotation_to_first_axis(t)
    W = rotation @ ((frame.A[other][None] / K2[:, :, None]) * K1[:, None, :])
    planes = []
    for sign in (1.0, -1.0):
        w1, w2, w3 = sign * W[:, 0], sign * W[:, 1], sign * W[:, 2]
        length = np.maximum(np.linalg.norm(w3, axis=1, keepdims=True), 1e-300)
        baseline = sign * np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-300)
        planes.append(-(np.cross(w2, w3) / length - w1) / baseline / K1)
    return np.concatenate(planes)
