"""Image sequences with critical motions for self-calibration, and general ones.

Every motion comes exact and hand-held: ``HAND_TURN_DEG`` is the rotation about each axis, ``HAND_SHIFT`` the
shift in units of the distance, ``WALL_RELIEF`` the relief of a wall in units of its width. Scenes, focal
lengths, distances, numbers of cameras and noise are random.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64
from thesisrecon.camera import project_camera
from thesisrecon.geometry.camera_matrix import camera_from_centre
from thesisrecon.optimize.bundle.projection import Observations
from thesisrecon.optimize.bundle.projective import refine_projective_bundle
from thesisrecon.records import Reconstruction, Tracks
from validation.scenes.pose import UP, look_at, turntable
from validation.scenes.rigs import observe

SIZE = np.array([1536, 1024])
HAND_TURN_DEG, HAND_SHIFT, WALL_RELIEF = 1.0, 0.01, 0.01


class Motion(Enum):
    """Camera motions and scene types."""

    GENERAL = "general"
    TRANSLATION = "pure translation"
    ROTATION = "pure rotation"
    TURNTABLE = "turntable"
    PLANAR = "planar motion"
    PARALLEL_AXES = "parallel rotation axes"
    OPTICAL_AXIS = "rotation about the optical axis"
    PLANE = "planar scene"


@dataclass(frozen=True)
class Sequence:
    """True cameras and points, ``tracks`` with noise ``sigma_px``, and ``sizes`` (V, 2) of the images."""

    K: F64
    R: F64
    C: F64
    X: F64
    tracks: Tracks
    sizes: NDArray[np.int64]
    sigma_px: float

    @property
    def P(self) -> F64:
        """(V, 3, 4) true cameras."""
        return camera_from_centre(self.K, self.R, self.C)


class _Path(NamedTuple):
    """``distance`` in units of the scene's radius; ``spread`` of the path in units of the distance."""

    views: int
    distance: float
    spread: float


def _general(w: _Path, rng: np.random.Generator) -> tuple[F64, F64]:
    """Cameras on a cap of 40 to 80 degrees across, with a roll of up to 30 degrees and an inexact aim."""
    half = np.radians(rng.uniform(20.0, 40.0))
    azimuth, height = rng.uniform(-half, half, (2, w.views))
    direction = np.stack(
        [np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)], axis=1
    )
    C = direction * w.distance * rng.uniform(0.8, 1.25, (w.views, 1))
    roll = rng.uniform(-np.pi / 6, np.pi / 6, w.views)
    R = [look_at(c, 0.2 * rng.normal(size=3), float(a)) for c, a in zip(C, roll, strict=True)]
    return np.array(R), C


def _translation(w: _Path, rng: np.random.Generator) -> tuple[F64, F64]:
    start = np.array([w.distance, 0.0, 0.0])
    C = start + w.spread * w.distance * rng.uniform(-0.5, 0.5, (w.views, 3))
    R = look_at(start, 0.1 * rng.normal(size=3), rng.uniform(-0.3, 0.3))
    return np.tile(R, (w.views, 1, 1)), C


def _rotation(w: _Path, rng: np.random.Generator) -> tuple[F64, F64]:
    """A panorama from one point, turned up to 15 degrees about any axis."""
    start = np.array([w.distance, 0.0, 0.0])
    R = look_at(start, np.zeros(3), rng.uniform(-0.3, 0.3))
    turns = np.radians(rng.uniform(-15.0, 15.0, (w.views, 3)))
    return Rotation.from_rotvec(turns).as_matrix() @ R, np.tile(start, (w.views, 1))


def _planar(w: _Path, rng: np.random.Generator, axial: float = 0.0) -> tuple[F64, F64]:
    """A tripod moved over the floor: another heading at each position, a constant tilt."""
    azimuth = rng.uniform(-0.6, 0.6, w.views)
    C = w.distance * np.stack([np.cos(azimuth), np.sin(azimuth), 0.0 * azimuth], axis=1)
    C *= rng.uniform(0.75, 1.25, (w.views, 1))
    C[:, 2] = w.distance * (rng.uniform(-0.1, 0.4) + axial * rng.uniform(-0.5, 0.5, w.views))
    start = look_at(
        np.array([w.distance, 0.0, C[:, 2].mean()]), 0.1 * rng.normal(size=3), rng.uniform(-0.3, 0.3)
    )
    heading = azimuth + np.radians(rng.uniform(-8.0, 8.0, w.views))
    turn = Rotation.from_rotvec(heading[:, None] * UP).as_matrix()
    return start @ turn.swapaxes(1, 2), C


def _optical_axis(w: _Path, rng: np.random.Generator) -> tuple[F64, F64]:
    """Translation with roll about the optical axis, whose direction is constant."""
    R, C = _translation(w, rng)
    roll = rng.uniform(-np.pi, np.pi, w.views)
    return Rotation.from_rotvec(roll[:, None] * UP).as_matrix() @ R, C


_MOTIONS: dict[Motion, Callable[[_Path, np.random.Generator], tuple[F64, F64]]] = {
    Motion.GENERAL: _general,
    Motion.TRANSLATION: _translation,
    Motion.ROTATION: _rotation,
    Motion.TURNTABLE: lambda w, rng: turntable(rng, w.views, w.distance, highest_deg=45.0, widest_deg=360.0),
    Motion.PLANAR: _planar,
    # Planar motion with changes of height.
    Motion.PARALLEL_AXES: lambda w, rng: _planar(w, rng, axial=rng.uniform(0.2, 0.6)),
    Motion.OPTICAL_AXIS: _optical_axis,
    Motion.PLANE: _general,
}


def make_sequence(
    motion: Motion, rng: np.random.Generator, *, by_hand: bool = False, zoom: float = 0.0
) -> Sequence:
    """5 to 15 cameras and 150 to 400 points in a box, 0.5 to 1 px noise, a focal of 0.7 to 2 long sides.
    ``by_hand`` adds the unavoidable errors of a hand-held camera; ``zoom``: focals vary by factors e^+-zoom.
    The principal point is off by 0.5 % of the long side (rms), and a tenth of what is in the image is not
    matched.
    """
    path = _Path(int(rng.integers(5, 16)), rng.uniform(3.0, 6.0), rng.uniform(0.4, 0.8))
    R, C = _MOTIONS[motion](path, rng)
    if by_hand:
        R = Rotation.from_rotvec(np.radians(rng.normal(0.0, HAND_TURN_DEG, (len(R), 3)))).as_matrix() @ R
        C = C + path.distance * rng.normal(0.0, HAND_SHIFT, C.shape)
    X = rng.uniform(-1.0, 1.0, (int(rng.integers(150, 401)), 3)) * rng.uniform(0.5, 1.0, 3)
    if motion is Motion.PLANE:
        X[:, 0] = (WALL_RELIEF * rng.uniform(-1.0, 1.0, len(X)) if by_hand else 0.0) * np.ones(len(X))
    focal = np.clip(filling_focal(R, C, X) * rng.uniform(0.7, 1.1), 0.6, 2.5) * SIZE.max()
    centre = (SIZE - 1) / 2 + rng.normal(0.0, 0.005 / np.sqrt(2.0), 2) * SIZE.max()
    K = np.zeros((len(R), 3, 3))
    K[:, 0, 0] = K[:, 1, 1] = focal * np.exp(rng.uniform(-zoom, zoom, len(R)))
    K[:, :2, 2], K[:, 2, 2] = centre, 1.0
    sigma = rng.uniform(0.5, 1.0)
    return Sequence(K, R, C, X, _observe(K, R, C, X, sigma, rng), np.tile(SIZE, (len(R), 1)), sigma)


def filling_focal(R: F64, C: F64, X: F64) -> float:
    """The focal length in long sides that fills the images with nine tenths of the scene."""
    Y = np.einsum("vab,vnb->vna", R, X[None] - C[:, None])
    return float(0.5 / np.quantile(np.abs(Y[..., 0] / np.maximum(Y[..., 2], 1e-3)), 0.9))


def _observe(K: F64, R: F64, C: F64, X: F64, sigma: float, rng: np.random.Generator) -> Tracks:
    t = -np.einsum("vab,vb->va", R, C)
    xy = np.stack([project_camera(K[v], R[v], t[v], X) for v in range(len(K))])
    depth = np.einsum("va,vna->vn", R[:, 2], X[None] - C[:, None])
    seen = (depth > 0.1) & ((xy >= 0) & (xy <= SIZE - 1)).all(axis=2) & (rng.random(depth.shape) < 0.9)
    return observe(xy, seen, sigma, rng)


def projective_estimate(scene: Sequence, rng: np.random.Generator) -> Reconstruction:
    """Adjust the truth, in a random projective frame, to the noisy observations."""
    G = np.eye(4) + 0.2 * rng.normal(size=(4, 4))
    seen = np.bincount(scene.tracks.point_index, minlength=len(scene.X)) >= 2
    Xh = np.column_stack([scene.X, np.ones(len(scene.X))]) @ G.T
    Xh /= np.linalg.norm(Xh, axis=1, keepdims=True)
    if scene.X.std(axis=0).min() == 0.0:
        # Points of a plane exactly leave the frame of bundle adjustment singular.
        Xh += 1e-6 * rng.normal(size=Xh.shape)
    P = scene.P @ np.linalg.inv(G)
    P /= np.linalg.norm(P, axis=(1, 2))[:, None, None]
    t = scene.tracks
    fit = refine_projective_bundle(P, Xh, Observations(t.view_index, t.point_index, t.xy), max_iterations=20)
    n = len(P)
    return Reconstruction(
        "projective", fit.P, fit.X, np.ones(n, dtype=bool), seen, np.ones(len(t.xy), dtype=bool), t,
        scene.sizes, scene.sigma_px, ("",) * n,
    )  # fmt: skip
