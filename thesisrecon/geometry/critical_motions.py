"""Critical motions: how close cameras are to motions that self-calibration cannot resolve (HZ 19.8, 19.9).

P. Sturm, CVPR 1997, and BMVC 1999 for varying focal lengths; F. Kahl, B. Triggs, K. Astrom, JMIV 13, 2000. A
critical motion is invariant under the transforms that it leaves undetermined (a camera without rotation has
none in any solution), so the measures here hold for any of these solutions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon.arrays import F64, I64

PLANE = "planar scene"
ROTATION = "pure rotation"
TRANSLATION = "pure translation"
OPTICAL_AXIS = "rotation about the optical axis"
TURNTABLE = "turntable"
PLANAR = "planar motion"
PARALLEL_AXES = "parallel rotation axes"

# Tolerances for the unintended motion of a hand-held camera: rotations of a degree about each axis (twice
# that between two images), translations of a hundredth of the distance.
TOLERANCES: Mapping[str, float] = {
    "scene_planarity_ratio": 0.02,
    "centre_spread_over_distance": 0.03,
    "infinity_shift": 0.08,
    "infinity_shift_beyond_roll": 0.08,
    "rotation_rms_deg": 3.5,
    "optical_axis_rms_deg": 3.5,
    "rotation_axis_spread_deg": 3.0,
    "turntable_residual_over_distance": 0.05,
    "axial_translation_over_distance": 0.025,
}

MAX_CAMERAS = 1000
# Long sides; also used for points that rotate behind the camera.
_MAX_SHIFT = 10.0

# Sorted by how much the motion leaves undetermined. A motion is critical if all its measures are within
# tolerance.
_MEASURES_OF: Mapping[str, tuple[str, ...]] = {
    PLANE: ("scene_planarity_ratio",),
    ROTATION: ("centre_spread_over_distance",),
    TRANSLATION: ("infinity_shift",),
    OPTICAL_AXIS: ("infinity_shift_beyond_roll",),
    TURNTABLE: (
        "rotation_axis_spread_deg",
        "turntable_residual_over_distance",
        "axial_translation_over_distance",
    ),
    PLANAR: ("rotation_axis_spread_deg", "axial_translation_over_distance"),
    PARALLEL_AXES: ("rotation_axis_spread_deg",),
}

# With a long lens an unintended rotation moves the image more, so it is enough if the shift or the angle is
# within its tolerance. The angle depends on the focal length, which may be undetermined; the shift does not.
_ALTERNATIVE: Mapping[str, str] = {
    "infinity_shift": "rotation_rms_deg",
    "infinity_shift_beyond_roll": "optical_axis_rms_deg",
}


@dataclass(frozen=True)
class UpgradedCameras:
    """Metric cameras: unit-free focal lengths (V,), R (V, 3, 3), C (V, 3), and points X (N, 3)."""

    focal: F64
    R: F64
    C: F64
    X: F64

    @property
    def distance(self) -> float:
        """Median distance from the cameras to the median point."""
        centre = np.median(self.X, axis=0)
        return max(float(np.median(np.linalg.norm(centre - self.C, axis=1))), 1e-300)

    def infinite_homographies(self) -> F64:
        """Return the unit-free infinite homographies (V, 3, 3) from the view nearest to the mean rotation."""
        mean = scipy.spatial.transform.Rotation.from_matrix(self.R).mean().as_matrix()
        middle = int(scipy.spatial.transform.Rotation.from_matrix(self.R @ mean.T).magnitude().argmin())
        K = np.stack([self.focal, self.focal, np.ones_like(self.focal)], axis=1)
        return np.asarray(K[:, :, None] * (self.R @ self.R[middle].T) / K[middle])


def measure_motion(metric: UpgradedCameras) -> dict[str, float]:
    """Return the measures of ``TOLERANCES`` by name, and the largest rotation (chapter 7).

    Of more than ``MAX_CAMERAS`` cameras, evenly many are used: all pairs are compared.
    """
    if len(metric.R) > MAX_CAMERAS:
        few = np.unique(np.rint(np.linspace(0, len(metric.R) - 1, MAX_CAMERAS)).astype(np.int64))
        metric = UpgradedCameras(metric.focal[few], metric.R[few], metric.C[few], metric.X)
    axis, angle, spread = _common_rotation_axis(metric.R)
    H, offset = metric.infinite_homographies(), metric.C - metric.C.mean(axis=0)
    return {
        "scene_planarity_ratio": _planarity_ratio(metric.X),
        "centre_spread_over_distance": _rms(offset) / metric.distance,
        "infinity_shift": _infinite_homography_shift(H, roll=False),
        "infinity_shift_beyond_roll": _infinite_homography_shift(H, roll=True),
        "largest_rotation_deg": angle,
        "rotation_rms_deg": _rotation_rms_deg(metric.R),
        "optical_axis_rms_deg": _optical_axis_rms_deg(metric.R),
        "rotation_axis_spread_deg": spread,
        "turntable_residual_over_distance": _turntable_residual(metric, axis) / metric.distance,
        "axial_translation_over_distance": _rms((offset @ axis)[:, None]) / metric.distance,
    }


def nearest_critical_motion(measures: Mapping[str, float]) -> tuple[str, float]:
    """The nearest critical motion, and its largest measure over its tolerance (chapter 7)."""
    near: dict[str, float] = {}
    for name, needed in _MEASURES_OF.items():
        if all(key in measures for key in needed):
            near[name] = max(_tolerance_ratio(measures, key) for key in needed)
    within = [name for name, distance in near.items() if distance < 1.0]
    if ROTATION in within and near.get(TRANSLATION, 1.0) < near[ROTATION]:
        within.remove(ROTATION)
    chosen = within[0] if within else min(near, key=lambda name: near[name])
    return chosen, near[chosen]


def _tolerance_ratio(measures: Mapping[str, float], key: str) -> float:
    """Return a measure over its tolerance, or the smaller ratio of its alternative."""
    keys = [k for k in (key, _ALTERNATIVE.get(key, key)) if k in measures]
    return min(measures[k] / TOLERANCES[k] for k in keys)


def _infinite_homography_shift(H: F64, *, roll: bool) -> float:
    """Rms shift (long sides) of points at infinity by H (V, 3, 3) beyond zoom and, with ``roll``, roll."""
    template = np.zeros_like(H)
    zoom = (H[:, 0, 0] + H[:, 1, 1]) / 2.0
    # A roll of 180 degrees is no zoom, although it maps points as one with a negative scale.
    template[:, 0, 0] = template[:, 1, 1] = zoom if roll else np.where(zoom * H[:, 2, 2] > 0.0, zoom, 0.0)
    template[:, 2, 2] = H[:, 2, 2]
    if roll:
        template[:, 1, 0] = (H[:, 1, 0] - H[:, 0, 1]) / 2.0
        template[:, 0, 1] = -template[:, 1, 0]
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.4, 0.4, 5))
    grid = np.stack([u.ravel(), v.ravel(), np.ones(25)])
    shift = np.sum((_dehomogenized(H @ grid) - _dehomogenized(template @ grid)) ** 2, axis=1)
    return float(np.sqrt(np.mean(np.minimum(shift, _MAX_SHIFT**2))))


def _dehomogenized(x: F64) -> F64:
    """Return (V, 2, M) from (V, 3, M), finite."""
    w = x[:, 2:]
    return np.asarray(x[:, :2] / np.where(np.abs(w) < 1e-9, 1e-9, w))


def projective_infinity_shifts(A: F64, a: F64) -> dict[str, float]:
    """Return lower bounds of the shifts of points at infinity from projective cameras [A | a] alone.

    The plane at infinity is chosen such that the cameras come nearest to having no rotation: A_i - a_i p' =
    diag(g, g, h), with roll [[g, -k, 0], [k, g, 0], [0, 0, h]], linear in p, g, k, h. Small shifts are
    necessary but not sufficient for a camera without rotation.
    """
    identity = np.zeros((3, 3, 3))
    identity[0, 0, 0] = identity[0, 1, 1] = identity[1, 2, 2] = identity[2, 1, 0] = 1.0
    identity[2, 0, 1] = -1.0
    shifts = {}
    for name, kinds in (("infinity_shift", 2), ("infinity_shift_beyond_roll", 3)):
        rows = np.zeros((len(A), 9, 3 + kinds * len(A)))
        for k in range(3):
            rows[:, k::3, k] = a
        for i in range(len(A)):
            rows[i, :, 3 + kinds * i : 3 + kinds * (i + 1)] = identity[:kinds].reshape(kinds, 9).T
        p = np.linalg.lstsq(rows.reshape(9 * len(A), -1), A.reshape(-1), rcond=None)[0][:3]
        shifts[name] = _infinite_homography_shift(A - a[:, :, None] * p, roll=kinds == 3)
    return shifts


def _common_rotation_axis(R: F64) -> tuple[F64, float, float]:
    """Direction (3,) nearest to all rotation axes, the largest rotation and the axis spread (degrees)."""
    i, j = np.triu_indices(len(R), 1)
    relative = R[j].swapaxes(1, 2) @ R[i]
    vectors = scipy.spatial.transform.Rotation.from_matrix(relative).as_rotvec()
    value, vector = np.linalg.eigh(vectors.T @ vectors / len(vectors))
    angle = float(np.degrees(np.linalg.norm(vectors, axis=1).max()))
    return vector[:, 2], angle, float(np.degrees(np.sqrt(max(value[1], 0.0))))


def _rotation_rms_deg(R: F64) -> float:
    """Return the rms rotation angle between all pairs of views."""
    i, j = np.triu_indices(len(R), 1)
    angle = scipy.spatial.transform.Rotation.from_matrix(R[j] @ R[i].swapaxes(1, 2)).magnitude()
    return float(np.degrees(np.sqrt(np.mean(angle**2))))


def _optical_axis_rms_deg(R: F64) -> float:
    """Return the rms angle between the optical axes of all pairs of views."""
    i, j = np.triu_indices(len(R), 1)
    cosine = np.einsum("ka,ka->k", R[i, 2], R[j, 2])
    sine = np.linalg.norm(np.cross(R[i, 2], R[j, 2]), axis=1)
    return float(np.degrees(np.sqrt(np.mean(np.arctan2(sine, cosine) ** 2))))


def _rms(vectors: F64) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _turntable_residual(metric: UpgradedCameras, axis: F64) -> float:
    """Rms distance of the centres from a common circular motion about one line along ``axis``."""
    seen = metric.R @ (np.eye(3) - np.outer(axis, axis))
    places = np.einsum("vab,vb->va", seen, metric.C)
    coefficients, right = seen - seen.mean(axis=0), places - places.mean(axis=0)
    c = np.linalg.lstsq(coefficients.reshape(-1, 3), right.ravel(), rcond=1e-9)[0]
    return _rms(right - coefficients @ c)


def _planarity_ratio(X: F64) -> float:
    """Rms thickness of 95 % of the points (N, 3) about their best plane over their rms extent in it.

    Before, the farthest 5 % of the points are left out.
    """

    def nearest(distance: F64) -> I64:
        return np.argsort(distance, kind="stable")[: max(int(0.95 * len(distance)), 4)]

    X = X[nearest(np.linalg.norm(X - np.median(X, axis=0), axis=1))]
    near = X
    for _ in range(3):
        normal = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][2]
        near = X[nearest(np.abs((X - near.mean(axis=0)) @ normal))]
    s = np.linalg.svd(near - near.mean(axis=0), compute_uv=False)
    return float(s[2] / max(float(s[1]), 1e-300))
