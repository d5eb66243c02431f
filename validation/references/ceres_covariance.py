"""Covariances of cameras at an optimum by COLMAP (Ceres), in our coordinates of a pose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.numerics.metric_cameras import MetricCameras
from thesisrecon.numerics.observations import Observations
from validation.references.ceres_bundle import CeresOptions, bundle_adjuster
from validation.references.colmap_model import colmap_model
from validation.references.libraries import pycolmap


def ceres_covariances(
    cameras: MetricCameras, X: F64, seen: Observations, size: tuple[int, int], fixed: Sequence[int]
) -> tuple[F64, F64]:
    """Covariances (V, 6, 6) of poses and (4, 4) of (f, cx, cy, k1) for noise of 1 px, by COLMAP.

    One camera; the views ``fixed`` hold the frame. Poses as ours: (w, d) of x -> exp(w) x + d. COLMAP's own
    coordinates are half the angle (Ceres' quaternions) and a translation that the rotation leaves alone.
    """
    model = colmap_model(cameras, X, seen, size)
    adjuster = bundle_adjuster(model, CeresOptions(principal_point=True, function_tolerance=0.0), fixed)
    adjuster.solve()
    found = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    if found is None:
        raise RuntimeError("COLMAP has no covariances for this problem")
    poses = np.zeros((len(cameras.R), 6, 6))
    for v in np.setdiff1d(np.arange(len(poses)), fixed):
        ours_from_theirs = np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
        t = model.images[v + 1].cam_from_world().translation
        ours_from_theirs[3:, :3] = 2.0 * cross_matrix(t)
        poses[v] = ours_from_theirs @ found.get_cam_cov_from_world(v + 1) @ ours_from_theirs.T
    return poses, np.asarray(found.get_other_params_cov(model.cameras[1].params))
