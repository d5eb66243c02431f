"""From where on an answer of self-calibration is not determined: for the verdict and for its words.

Section 7, "critical motions": how near the cameras come to motions that leave self-calibration open.

P. Sturm, "Critical motion sequences for monocular self-calibration and uncalibrated Euclidean
reconstruction", CVPR 1997, and BMVC 1999 for a varying focal; F. Kahl, B. Triggs and K. Astrom, "Critical
motions for auto-calibration when some intrinsic parameters can vary", J. Math. Imaging and Vision 13, 2000.
Every critical motion is kept by the transforms that it leaves open: a camera that did not turn did not turn
in any of the answers that fit its images, parallel axes stay parallel, points of a plane in a plane. What is
measured is thus the same for whichever of these answers was found.

The verdict on the motion in words: what was found, what it means, what to do.

Clauses without a capital or a full stop, as all failed_checks are: the page and the summary make sentences of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon.arrays import F64

MAX_FOCAL_STD = 0.15
"""A focal length that is not known to this relative deviation is not known."""
MIN_ROTATION_SIGNIFICANCE = 4.0
"""Noise alone turns cameras that did not turn, and what it feigns looks like information: a turn counts where
it stands out of its own deviation by so much."""
MAX_NOISE_RATIO = 3.0
"""Metric cameras leave this much more noise than the projective ones where they are not what was seen: a
principal point or distortion that the projective cameras took in costs less."""
MIN_INFINITY_SHIFT = 0.003
"""Of the picture of infinity, in long sides. What no lens model holds (a raster that was resampled, a lens
that breathes) moves pictures by 1e-4 or so, alike in all parts of a scene, so that no covariance knows of it.
A turn that moves the picture by s tells the focal length by its part of second order, s (x / f)^2, about a
tenth of s: to know the focal to 15 %, 2 (s / 10) 0.15 must stand out of 1e-4."""


PLANE = "planar scene"
ROTATION = "pure rotation"
TRANSLATION = "pure translation"
OPTICAL_AXIS = "rotation about the optical axis"
TURNTABLE = "turntable"
PLANAR = "planar motion"
PARALLEL_AXES = "parallel rotation axes"

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
"""What a photographer who wants the critical motion cannot avoid: a hand turns by a degree about each axis
(between two photographs twice as far, all in all), and keeps a place to a hundredth of the distance."""

MAX_INFINITY_SHIFT = 10.0
"""Long sides; what turns behind the camera counts as this."""

_NAMED_BY: Mapping[str, tuple[str, ...]] = {
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
"""From what leaves most open to what leaves least; a motion is near where all its measures are."""

_OR: Mapping[str, str] = {
    "infinity_shift": "rotation_rms_deg",
    "infinity_shift_beyond_roll": "optical_axis_rms_deg",
}
"""A hand turns a long lens as far as a short one, which moves its picture further: either measure may be
small. Where the focal is open the angle depends on the answer, the shift does not."""


@dataclass(frozen=True)
class UpgradedCameras:
    """Metric cameras in unit-free pixels, as an answer of self-calibration has them, and points.

    ``focal`` (V,), ``R`` (V, 3, 3) world-to-camera, ``C`` (V, 3) centres, ``X`` (N, 3) the points.
    """

    focal: F64
    R: F64
    C: F64
    X: F64

    @property
    def distance(self) -> float:
        """Median distance from a camera to the middle of the points."""
        centre = np.median(self.X, axis=0)
        return max(float(np.median(np.linalg.norm(centre - self.C, axis=1))), 1e-300)

    def infinite_homographies(self) -> F64:
        """(V, 3, 3) how the picture of infinity moves from the view that turned least to each view."""
        angles = scipy.spatial.transform.Rotation.from_matrix(
            self.R @ scipy.spatial.transform.Rotation.from_matrix(self.R).mean().as_matrix().T
        ).magnitude()
        middle = int(angles.argmin())
        K = np.stack([self.focal, self.focal, np.ones_like(self.focal)], axis=1)
        return np.asarray(K[:, :, None] * (self.R @ self.R[middle].T) / K[middle])


def measure_motion(metric: UpgradedCameras) -> dict[str, float]:
    """The measures of ``TOLERANCES`` and the largest turn, by name."""
    axis, turn, spread = _common_rotation_axis(metric.R)
    H = metric.infinite_homographies()
    return {
        "scene_planarity_ratio": planarity_ratio(metric.X),
        "centre_spread_over_distance": centre_spread_rms(metric.C) / metric.distance,
        "infinity_shift": infinite_homography_shift(H, roll=False),
        "infinity_shift_beyond_roll": infinite_homography_shift(H, roll=True),
        "largest_rotation_deg": turn,
        "rotation_rms_deg": _rotation_rms_deg(metric.R),
        "optical_axis_rms_deg": _optical_axis_rms_deg(metric.R),
        "rotation_axis_spread_deg": spread,
        "turntable_residual_over_distance": _turntable_residual(metric, axis) / metric.distance,
        "axial_translation_over_distance": axial_translation_rms(metric.C, axis) / metric.distance,
    }


def nearest_critical_motion(measures: Mapping[str, float]) -> tuple[str, float]:
    """Its name and how near it is: the largest of its measures over their tolerances, below 1 where the
    motion cannot be told from it by what a photographer does anyhow.

    Of several below 1 the one that leaves most open is meant, and of a rotation and a translation, of cameras
    that hardly turned nor moved, the nearer.
    """
    near: dict[str, float] = {}
    for name, needed in _NAMED_BY.items():
        if all(key in measures for key in needed):
            near[name] = max(_nearness(measures, key) for key in needed)
    within = [name for name, distance in near.items() if distance < 1.0]
    if ROTATION in within and near.get(TRANSLATION, 1.0) < near[ROTATION]:
        within.remove(ROTATION)
    chosen = within[0] if within else min(near, key=lambda name: near[name])
    return chosen, near[chosen]


def _nearness(measures: Mapping[str, float], key: str) -> float:
    """A measure over its tolerance, or that of its alternative where that is less."""
    keys = [k for k in (key, _OR.get(key, key)) if k in measures]
    return min(measures[k] / TOLERANCES[k] for k in keys)


def infinite_homography_shift(H: F64, *, roll: bool) -> float:
    """How far the picture of infinity moves between the views (rms over views and picture, in long sides)
    beyond zooming and, with ``roll``, turning in its plane.

    ``H`` (V, 3, 3): infinite homographies from one of the views in unit-free pixels, each compared with the
    nearest diag(g, g, h), with roll [[g, -k, 0], [k, g, 0], [0, 0, h]]. Zero for cameras that did not turn,
    whatever their focals and whatever is taken for them.
    """
    template = np.zeros_like(H)
    template[:, 0, 0] = template[:, 1, 1] = (H[:, 0, 0] + H[:, 1, 1]) / 2.0
    template[:, 2, 2] = H[:, 2, 2]
    if roll:
        template[:, 1, 0] = (H[:, 1, 0] - H[:, 0, 1]) / 2.0
        template[:, 0, 1] = -template[:, 1, 0]
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.4, 0.4, 5))
    grid = np.stack([u.ravel(), v.ravel(), np.ones(25)])
    shift = np.sum((_dehomogenized(H @ grid) - _dehomogenized(template @ grid)) ** 2, axis=1)
    return float(np.sqrt(np.mean(np.minimum(shift, MAX_INFINITY_SHIFT**2))))


def _dehomogenized(x: F64) -> F64:
    """(V, 3, M) -> (V, 2, M), kept finite."""
    w = x[:, 2:]
    return np.asarray(x[:, :2] / np.where(np.abs(w) < 1e-9, 1e-9, w))


def projective_infinity_shifts(A: F64, a: F64) -> dict[str, float]:
    """``infinity_shift`` and ``infinity_shift_beyond_roll`` of projective cameras [A | a] (V, 3, 3), (V, 3), one of
    them [I | 0], in unit-free pixels.

    Of all planes the one is taken that comes nearest to a camera that did not turn: A_i - a_i p' to be
    diag(g, g, h), with roll [[g, -k, 0], [k, g, 0], [0, 0, h]], which is linear in p, g, k, h. Small numbers
    are thus necessary for a camera that did not turn, and not sufficient: cameras that look at one point from
    a short arc give small ones too.
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
        shifts[name] = infinite_homography_shift(A - a[:, :, None] * p, roll=kinds == 3)
    return shifts


def _common_rotation_axis(R: F64) -> tuple[F64, float, float]:
    """The direction (3,) nearest to all rotation axes, the largest turn between two views, and the spread of
    the axes, both in degrees.

    The spread is the rms turn about any axis across the common one: with the rotation vectors r of all pairs,
    in the world's frame, the root of the second eigenvalue of mean(r r').
    """
    i, j = np.triu_indices(len(R), 1)
    relative = R[j].swapaxes(1, 2) @ R[i]
    vectors = scipy.spatial.transform.Rotation.from_matrix(relative).as_rotvec()
    value, vector = np.linalg.eigh(vectors.T @ vectors / len(vectors))
    turn = float(np.degrees(np.linalg.norm(vectors, axis=1).max()))
    return vector[:, 2], turn, float(np.degrees(np.sqrt(max(value[1], 0.0))))


def _rotation_rms_deg(R: F64) -> float:
    """Rms angle (deg) of the turns between all pairs of views."""
    i, j = np.triu_indices(len(R), 1)
    angle = scipy.spatial.transform.Rotation.from_matrix(R[j] @ R[i].swapaxes(1, 2)).magnitude()
    return float(np.degrees(np.sqrt(np.mean(angle**2))))


def _optical_axis_rms_deg(R: F64) -> float:
    """Rms angle (deg) between the optical axes of all pairs of views."""
    i, j = np.triu_indices(len(R), 1)
    cosine = np.einsum("ka,ka->k", R[i, 2], R[j, 2])
    sine = np.linalg.norm(np.cross(R[i, 2], R[j, 2]), axis=1)
    return float(np.degrees(np.sqrt(np.mean(np.arctan2(sine, cosine) ** 2))))


def centre_spread_rms(C: F64) -> float:
    """Rms distance of the centres from their mean."""
    return float(np.sqrt(np.mean(np.sum((C - C.mean(axis=0)) ** 2, axis=1))))


def axial_translation_rms(C: F64, axis: F64) -> float:
    """Rms way of the centres along an axis."""
    return float(np.sqrt(np.mean(((C - C.mean(axis=0)) @ axis) ** 2)))


def _turntable_residual(metric: UpgradedCameras, axis: F64) -> float:
    """Rms distance of the centres from where one line of this direction would turn them to.

    Seen along the line, a camera on a turntable keeps its place relative to itself: R_i (C_i - c) is the same
    for all views but for its part along R_i axis, which is the climb. The point c of the line is found by
    least squares.
    """
    seen = metric.R @ (np.eye(3) - np.outer(axis, axis))
    places = np.einsum("vab,vb->va", seen, metric.C)
    coefficients, right = seen - seen.mean(axis=0), places - places.mean(axis=0)
    c = np.linalg.lstsq(coefficients.reshape(-1, 3), right.ravel(), rcond=1e-9)[0]
    return float(np.sqrt(np.mean(np.sum((right - coefficients @ c) ** 2, axis=1))))


def planarity_ratio(X: F64, *, kept: float = 0.95) -> float:
    """Rms distance of the points from their best plane over their rms extent along it; the ``kept`` nearest
    to the centre and then to the plane count."""
    for _ in range(3):
        centred = X - np.median(X, axis=0)
        near = np.argsort(np.linalg.norm(centred, axis=1), kind="stable")[: max(int(kept * len(X)), 4)]
        X = X[near]
        if len(X) < 50:
            break
    centred = X - X.mean(axis=0)
    for _ in range(3):
        normal = np.linalg.svd(centred, full_matrices=False)[2][2]
        order = np.argsort(np.abs(centred @ normal), kind="stable")[: max(int(kept * len(centred)), 4)]
        centred = centred[order] - centred[order].mean(axis=0)
    s = np.linalg.svd(centred, compute_uv=False)
    return float(s[2] / max(float(s[1]), 1e-300))


_FOUND: Mapping[str, str] = {
    PLANE: (
        "the points lie in one plane up to {scene_planarity_ratio:.1%} of its width: a planar scene, which leaves "
        "the "
        "cameras hardly determined"
    ),
    ROTATION: (
        "the camera turned about one point (it moved by {centre_spread_over_distance:.1%} of the distance to the "
        "scene): close to a pure rotation, which tells the focal length but hardly any depth"
    ),
    TRANSLATION: (
        "the camera moved and hardly turned (by {largest_rotation_deg:.1f} degrees at most): close to a pure "
        "translation, which leaves the focal length open"
    ),
    OPTICAL_AXIS: (
        "the camera turned about its optical axis only, always looking in one direction: this leaves the "
        "focal "
        "length open, as a pure translation does"
    ),
    TURNTABLE: (
        "all views turn about one axis (to within {rotation_axis_spread_deg:.1f} degrees), as on a turntable: this "
        "leaves "
        "the scale along the axis open unless the shape of the pixels is known"
    ),
    PLANAR: (
        "the camera moved in a plane and turned about one direction (to within {rotation_axis_spread_deg:.1f} "
        "degrees), "
        "a planar motion: this leaves the scale across the plane open unless the shape of the pixels is known"
    ),
    PARALLEL_AXES: (
        "all rotations have parallel axes (to within {rotation_axis_spread_deg:.1f} degrees): this leaves the scale "
        "along "
        "the axes open unless the shape of the pixels is known"
    ),
}
_FOUND_WITHOUT_AN_ANSWER: Mapping[str, str] = {
    TRANSLATION: (
        "the projective cameras fit a camera that moved without turning, a pure translation, which leaves "
        "the "
        "focal length open (the picture of infinity moves by {infinity_shift:.1%} of the image)"
    ),
    OPTICAL_AXIS: (
        "the projective cameras fit a camera that turned about its optical axis only, which leaves the focal "
        "length open (the picture of infinity moves by {infinity_shift_beyond_roll:.1%} of the image)"
    ),
}
_TURN_MORE = "turn the camera by 10 degrees and more between photographs, about the vertical and sideways"
_ADVICE: Mapping[str, str] = {
    PLANE: "have things at different depths in the picture",
    ROTATION: "walk around the scene between photographs",
    TRANSLATION: _TURN_MORE,
    OPTICAL_AXIS: "point the camera in different directions",
    TURNTABLE: "take some photographs from higher or lower, or with the camera turned on its side",
    PLANAR: "take some photographs from higher or lower, or with the camera turned on its side",
    PARALLEL_AXES: "tilt the camera up and down too, or turn it on its side",
}
_FOCAL_SETTLES = (_TURN_MORE, _ADVICE[OPTICAL_AXIS])
_SHAPE_SETTLES = (TURNTABLE, PLANAR, PARALLEL_AXES)


def motion_sentences(
    motion: str, evidence: Mapping[str, float], *, identifiable: bool, focal_std: float
) -> tuple[str, ...]:
    """What a person is told of a verdict; empty where there is nothing to say (a general motion that
    determines all). ``focal_std`` is the largest relative deviation of the focal lengths that were given, inf
    where one was not."""
    is_critical = bool(motion) and evidence["nearness"] < 1.0
    answered = "focal_std_rel" in evidence
    told = []
    if evidence["excess_equations"] < 0:
        told.append(
            f"the photographs are too few for so little that is known of the cameras: "
            f"{-evidence['excess_equations']:.0f} equations are missing; add photographs, or let them share "
            "one camera"
        )
    if is_critical:
        found = (_FOUND if answered else _FOUND_WITHOUT_AN_ANSWER)[motion]
        told.append(found.format(**evidence))
    if _bent(evidence):
        told.append(
            f"cameras as they are said to be explain the photographs with "
            f"{evidence['noise_ratio_to_projective']:.1f} times the noise of projective ones: photographs were "
            "zoomed or cropped one by one, or belong to other cameras; let every photograph have its own "
            "(cameras = per-image)"
        )
    if identifiable:
        return (*told, *_what_holds(motion, evidence)) if is_critical else tuple(told)
    return (*told, *_what_fails(motion, evidence, is_critical, focal_std))


def _what_holds(motion: str, evidence: Mapping[str, float]) -> list[str]:
    std, alone = evidence["focal_std_rel_median"], evidence["focal_std_rel_free"]
    if motion in _SHAPE_SETTLES and alone > 2.0 * std:
        return [
            f"square pixels and a principal point near the middle of the image settle it if the cameras are "
            f"what they are said to be: the focal length is known to {_percent(std)} with them and to "
            f"{_percent(alone)} without; to rest on less, "
            f"{_ADVICE[motion]}"
        ]
    if motion in (PLANE, ROTATION):
        return [
            f"the focal length is known to {_percent(std)} if the cameras are what they are said to be; for "
            f"depths that hold, {_ADVICE[motion]}"
        ]
    return [
        f"if the cameras are what they are said to be, what departs from it fixes the focal length to "
        f"{_percent(std)}"
    ]


def _what_fails(motion: str, evidence: Mapping[str, float], is_critical: bool, focal_std: float) -> list[str]:
    advice = _ADVICE.get(motion, _TURN_MORE) if is_critical else _TURN_MORE
    if advice in _FOCAL_SETTLES and focal_std > 0.0:
        given = " more exactly" if focal_std < float("inf") else ""
        advice += f", or give the focal length{given}"
    if "focal_std_rel" not in evidence:
        return [advice]
    std = evidence["focal_std_rel_median"]
    if evidence["rotation_significance"] < MIN_ROTATION_SIGNIFICANCE and std < MAX_FOCAL_STD:
        return [f"the turns cannot be told from noise, and no focal length can be had from them; {advice}"]
    if evidence["infinity_shift_beyond_roll"] < MIN_INFINITY_SHIFT and std < MAX_FOCAL_STD:
        return [
            f"the turns move the picture by {evidence['infinity_shift_beyond_roll']:.2%} of its width, as "
            f"little as what a lens model leaves out, and no focal length can be had from them; {advice}"
        ]
    if std >= MAX_FOCAL_STD:
        return [f"the cameras fix the focal length only to {_percent(std)}; {advice}"]
    # No turn of the camera mends cameras that are not what they are said to be.
    return [] if _bent(evidence) else [advice]


def _bent(evidence: Mapping[str, float]) -> bool:
    return evidence.get("noise_ratio_to_projective", 0.0) >= MAX_NOISE_RATIO


def _percent(share: float) -> str:
    if share < 0.001:
        return "better than 0.1 %"
    return f"{100.0 * share:.1f} %" if share < 0.1 else f"{100.0 * min(share, 9.99):.0f} %"
