"""Covariances of cameras at an optimum by COLMAP (Ceres), in our coordinates of a pose."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import cross_matrix, scene_frame
from thesisrecon.numerics._covariance import gauge_directions
from thesisrecon.numerics.metric_cameras import MetricCameras
from thesisrecon.numerics.observations import Observations
from validation.references.ceres_bundle import CeresOptions, bundle_adjuster
from validation.references.colmap_model import colmap_model
from validation.references.libraries import pycolmap


def ceres_covariances(
    cameras: MetricCameras, X: F64, seen: Observations, size: tuple[int, int]
) -> tuple[F64, F64]:
    """Covariances (V, 6, 6) of poses and (4, 4) of (f, cx, cy, k1) for noise of 1 px, by COLMAP.

    One camera. Poses as ours: (w, d) of x -> exp(w) x + d, in the inner gauge. COLMAP's own coordinates are
    half the angle (Ceres' quaternions) and a translation that the rotation leaves alone; it fixes the first
    pose and the largest coordinate of the translation to the second.
    """
    model = colmap_model(cameras, X, seen, size)
    adjuster = bundle_adjuster(model, CeresOptions(principal_point=True, function_tolerance=0.0))
    adjuster.solve()
    found = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    if found is None:
        raise RuntimeError("COLMAP has no covariances for this problem")
    V = len(cameras.R)
    poses = [model.images[v + 1].cam_from_world() for v in range(V)]
    R, t = np.stack([p.rotation.matrix() for p in poses]), np.stack([p.translation for p in poses])
    ours_from_theirs = np.tile(np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 1.0]), (V, 1, 1))
    ours_from_theirs[:, 3:, :3] = 2.0 * cross_matrix(t)
    fixed = 3 + int(np.argmax(np.abs(t[1] - R[1] @ R[0].T @ t[0])))
    moving = [np.arange(0), np.delete(np.arange(6), fixed), *[np.arange(6)] * (V - 2)]
    joint = np.zeros((V, 6, V, 6))
    for a in range(1, V):
        for b in range(1, V):
            C = (
                found.get_cam_cov_from_world(a + 1)
                if a == b
                else found.get_cam_cross_cov_from_world(a + 1, b + 1)
            )
            J, K = ours_from_theirs[a][:, moving[a]], ours_from_theirs[b][:, moving[b]]
            joint[a, :, b] = J @ C @ K.T
    origin, scale = scene_frame(X)
    N = gauge_directions(R, scale * (t + R @ origin))
    units = np.tile([1.0, 1.0, 1.0, scale, scale, scale], V)
    to_gauge = (np.eye(6 * V) - N @ N.T) * units
    inner = to_gauge @ joint.reshape(6 * V, 6 * V) @ to_gauge.T / units / units[:, None]
    of_view = np.arange(V)
    camera = np.asarray(found.get_other_params_cov(model.cameras[1].params))
    return inner.reshape(V, 6, V, 6)[of_view, :, of_view], camera
