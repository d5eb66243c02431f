"""Bundle adjustment and covariances by Ceres through pycolmap: the same problem, start and loss as ours.

COLMAP's pixels have their origin at the corner of the first one; its poses are world-to-camera as ours.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import cross_matrix, scene_frame
from thesisrecon.optimize.bundle.covariance import gauge_directions
from thesisrecon.optimize.bundle.projection import MetricCameras, Observations
from validation.references.libraries import pycolmap


def colmap_model(
    cameras: MetricCameras, X: F64, seen: Observations, size: tuple[int, int]
) -> pycolmap.Reconstruction:
    """A COLMAP model with SIMPLE_RADIAL cameras; views, rows of intrinsics and points count from 1 in it."""
    model = pycolmap.Reconstruction()
    for g, (f, _, _, cx, cy, k1) in enumerate(cameras.intrinsics):
        params, (width, height) = [f, cx + 0.5, cy + 0.5, k1], size
        camera = pycolmap.Camera(
            model="SIMPLE_RADIAL", width=width, height=height, params=params, camera_id=g + 1
        )
        model.add_camera_with_trivial_rig(camera)
    order = np.lexsort((seen.point_index, seen.view_index))
    view, point, xy = seen.view_index[order], seen.point_index[order], seen.xy[order] + 0.5
    first = np.searchsorted(view, np.arange(len(cameras.R) + 1))
    for v in range(len(cameras.R)):
        keypoints, camera_id = xy[first[v] : first[v + 1]], int(cameras.group[v]) + 1
        image = pycolmap.Image(name=f"{v}.png", keypoints=keypoints, camera_id=camera_id, image_id=v + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(cameras.R[v]), cameras.t[v])
        model.add_image_with_trivial_frame(image, pose)
    place = np.arange(len(view)) - first[view]
    by_point = np.argsort(point, kind="stable")
    bounds = np.searchsorted(point[by_point], np.arange(len(X) + 1))
    for j in range(len(X)):
        k = by_point[bounds[j] : bounds[j + 1]]
        if len(k):
            track = pycolmap.Track([pycolmap.TrackElement(int(view[i]) + 1, int(place[i])) for i in k])
            model.add_point3D(X[j], track, np.zeros(3, dtype=np.uint8))
    return model


def cameras_from_colmap(model: pycolmap.Reconstruction, like: MetricCameras) -> tuple[MetricCameras, F64]:
    """The cameras of :func:`colmap_model` and its points in their order."""
    poses = [model.images[v + 1].cam_from_world() for v in range(len(like.R))]
    rows = []
    for g in range(len(like.intrinsics)):
        f, cx, cy, k = model.cameras[g + 1].params
        rows.append([f, 1.0, 0.0, cx - 0.5, cy - 0.5, k])
    R = np.array([pose.rotation.matrix() for pose in poses])
    t = np.array([pose.translation for pose in poses])
    X = np.array([model.points3D[j].xyz for j in sorted(model.points3D)])
    return MetricCameras(R, t, np.array(rows), like.group, like.shared), X


class CeresOptions(NamedTuple):
    """Huber's loss turns at ``loss_px``; ``function_tolerance`` 0 is COLMAP's default, 1e-6 Ceres'."""

    loss_px: float = np.inf
    principal_point: bool = False
    threads: int = 1
    function_tolerance: float = 1e-6
    max_iterations: int = 100


class CeresResult(NamedTuple):
    """Result of Ceres; the seconds do not include building the model."""

    cameras: MetricCameras
    X: F64
    wall_s: float
    cpu_s: float


def refine_with_ceres(
    cameras: MetricCameras, X: F64, seen: Observations, size: tuple[int, int], options: CeresOptions
) -> CeresResult:
    """Adjust all poses, points, focals and k1 (and principal points) by Ceres."""
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    model = colmap_model(cameras, X, seen, size)
    wall, cpu = time.perf_counter(), time.process_time()
    bundle_adjuster(model, options).solve()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    refined, points = cameras_from_colmap(model, cameras)
    moved = X.copy()
    moved[np.bincount(seen.point_index, minlength=len(X)) > 0] = points
    return CeresResult(refined, moved, wall, cpu)


def bundle_adjuster(model: pycolmap.Reconstruction, options: CeresOptions) -> pycolmap.CeresBundleAdjuster:
    """COLMAP's adjuster of all images; two views hold the frame, as in its mapper."""
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images:
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.refine_principal_point = options.principal_point
    adjustment.print_summary = False
    ceres = adjustment.ceres
    if np.isfinite(options.loss_px):
        ceres.loss_function_type = pycolmap.LossFunctionType.HUBER
        ceres.loss_function_scale = options.loss_px
    ceres.min_num_residuals_for_cpu_multi_threading = 0
    solver = ceres.solver_options
    solver.num_threads, solver.max_num_iterations = options.threads, options.max_iterations
    solver.function_tolerance = options.function_tolerance
    return pycolmap.create_default_ceres_bundle_adjuster(adjustment, config, model)


def ceres_covariances(
    cameras: MetricCameras, X: F64, seen: Observations, size: tuple[int, int]
) -> tuple[F64, F64]:
    """Covariances (V, 6, 6) of poses and (4, 4) of (f, cx, cy, k1) for noise of 1 px, by COLMAP. One camera.
    Poses as ours: (w, d) of x -> exp(w) x + d, in the inner gauge. COLMAP's own coordinates are half the
    angle (Ceres' quaternions) and a translation that the rotation leaves alone; it fixes the first pose and
    the largest coordinate of the translation to the second.
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
            same = a == b
            C = (
                found.get_cam_cov_from_world(a + 1)
                if same
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
