"""Exact reference frames, with the plane at infinity that the methods must find."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from tests.synthetic import projective_reconstruction, with_poses
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_from_options
from thesisrecon.selfcalibration._frame import projective_scene

NOTHING_BUT_CONSTANT = IntrinsicsOptions(
    aspect="constant", skew="constant", principal_point="constant", principal_point_std_rel=None
)
CENTRED = IntrinsicsOptions(principal_point="known")
CENTRED_ZOOM = IntrinsicsOptions(cameras="per-image", principal_point="known")


def prior_for(scene, options=CENTRED):
    """The prior for the views of a scene."""
    sizes = [(int(w), int(h)) for w, h in scene.sizes]
    return prior_from_options(options, sizes, np.full(len(sizes), np.nan), np.ones(len(sizes)))


def setup(scene, options=CENTRED, *, seed=0):
    """The scene behind a random projective transform, and the true p."""
    found = projective_scene(projective_reconstruction(scene, seed=seed), prior_for(scene, options))
    return found, true_plane(scene, found)


def calibrated(method, scene, prior, *, seed=0):
    """What a method makes of the exact projective cameras of a scene in a random frame."""
    given = projective_reconstruction(scene, seed=seed)
    return method.calibrate(given, prior=prior, rng=np.random.default_rng(0))


def with_calibrations(scene, K):
    """The same views through other lenses."""
    return with_poses(replace(scene, K=np.broadcast_to(K, scene.K.shape).copy()), scene.R, scene.centres)


def true_plane(scene, found):
    """p of the plane at infinity: A_j - a_j p' = s_j H_j with the true infinite homographies H_j."""
    frame = found.frame
    M = np.linalg.inv(frame.pixel_from_unit) @ scene.K @ scene.R
    H = M @ np.linalg.inv(M[frame.reference])
    rows, right = [], []
    for j in np.delete(np.arange(len(H)), frame.reference):
        block = np.zeros((9, 3 + len(H)))
        block[:, :3] = np.einsum("a,bc->abc", frame.a[j], np.eye(3)).reshape(9, 3)
        block[:, 3 + j] = H[j].ravel()
        rows.append(block)
        right.append(frame.A[j].ravel())
    A_ref = frame.A[frame.reference]
    assert np.allclose(A_ref, np.eye(3) * A_ref[0, 0])
    return np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0][:3]


def turned_about_one_axis(scene, degrees):
    """The cameras of a scene with rotations about the y-axis alone."""
    R = Rotation.from_rotvec(np.outer(np.radians(degrees), [0.0, 1.0, 0.0])).as_matrix()
    along = np.linspace(-0.4, 0.4, len(R))[:, None]
    centres = np.einsum("vba,b->va", R, [0.0, 0.0, -8.0]) + along * [1, 0.7, 0.2]
    centres[:, 1] += 0.3 * np.cos(np.arange(len(R)) * 2.0)
    return with_poses(scene, R, centres)
