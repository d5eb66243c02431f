"""Exact reference frames, with the plane at infinity that the methods must find."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from tests.synthetic import TrueScene, make_scene, projective_reconstruction
from thesisrecon.intrinsics import IntrinsicsAssumption, assumptions_of_views
from thesisrecon.records import Assumptions
from thesisrecon.selfcalibration.cheirality import ProjectiveScene
from thesisrecon.selfcalibration.frame import unknown_intrinsics
from thesisrecon.selfcalibration.hartley import Strata
from thesisrecon.selfcalibration.stratified import projective_scene

NOTHING_BUT_CONSTANT = IntrinsicsAssumption(
    aspect="constant", skew="constant", principal_point="constant", principal_point_std_rel=None
)
CENTRED = IntrinsicsAssumption(principal_point="known")
CENTRED_ZOOM = IntrinsicsAssumption(cameras="per-image", principal_point="known")


def assume(scene: TrueScene, wish: IntrinsicsAssumption = CENTRED) -> Assumptions:
    """The wish for the views of a scene."""
    sizes = [(int(w), int(h)) for w, h in scene.sizes]
    return assumptions_of_views(wish, sizes, np.full(len(sizes), np.nan), np.ones(len(sizes)))


def setup(
    scene: TrueScene, wish: IntrinsicsAssumption = CENTRED, *, seed: int = 0
) -> tuple[ProjectiveScene, np.ndarray, Strata]:
    """The scene behind a random projective transform, the true p, and what calibration is given."""
    assumed = assume(scene, wish)
    found = projective_scene(projective_reconstruction(scene, seed=seed), assumed)
    strata = Strata(
        found.frame, found.knowledge, unknown_intrinsics(found.frame, assumed), np.zeros((0, 2, 3))
    )
    return found, true_plane(scene, found), strata


def true_plane(scene: TrueScene, found: ProjectiveScene) -> np.ndarray:
    """p of the plane at infinity: A_j - a_j p' = s_j H_j with the true infinite homographies H_j."""
    frame = found.frame
    unit = np.linalg.inv(frame.pixel_from_unit)
    M = unit @ scene.K @ scene.R
    H = M @ np.linalg.inv(M[frame.reference])
    rows, right = [], []
    for j in range(len(H)):
        if j == frame.reference:
            continue
        block = np.zeros((9, 3 + len(H)))
        block[:, :3] = np.einsum("a,bc->abc", frame.a[j], np.eye(3)).reshape(9, 3)
        block[:, 3 + j] = H[j].ravel()
        rows.append(block)
        right.append(frame.A[j].ravel())
    A_ref = frame.A[frame.reference]
    assert np.allclose(A_ref, np.eye(3) * A_ref[0, 0])
    return np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0][:3]


def turned_about_one_axis(scene: TrueScene, degrees: np.ndarray) -> TrueScene:
    """The cameras of a scene with rotations about the y-axis alone."""
    R = Rotation.from_rotvec(np.outer(np.radians(degrees), [0.0, 1.0, 0.0])).as_matrix()
    centres = np.einsum("vba,b->va", R, [0.0, 0.0, -8.0]) + np.linspace(-0.4, 0.4, len(R))[:, None] * [
        1,
        0.7,
        0.2,
    ]
    centres[:, 1] += 0.3 * np.cos(np.arange(len(R)) * 2.0)
    return replace(scene, R=R, t=-np.einsum("vab,vb->va", R, centres))


__all__ = [
    "CENTRED",
    "CENTRED_ZOOM",
    "NOTHING_BUT_CONSTANT",
    "assume",
    "make_scene",
    "setup",
    "turned_about_one_axis",
]
