"""Bundle adjustment by COLMAP (Ceres) through pycolmap: the same problem, start and loss as ours."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.optimize.losses import LossName
from thesisrecon.optimize.metric_bundle import MetricCameras, Observations
from thesisrecon.types import F64
from validation.references.libraries import pycolmap

LOSSES: dict[LossName, str] = {
    "squared": "TRIVIAL",
    "soft_l1": "SOFT_L1",
    "cauchy": "CAUCHY",
    "huber": "HUBER",
}
SOLVERS = {
    "dense": "DENSE_SCHUR",
    "sparse": "SPARSE_SCHUR",
    "iterative": "ITERATIVE_SCHUR",
}


@dataclass(frozen=True)
class CeresOptions:
    """What Ceres is to do: ``principal_point`` frees it; ``function_tolerance`` 0 is COLMAP's default, 1e-6
    Ceres'; ``solver`` a name of :data:`SOLVERS`, or "" for COLMAP's choice."""

    loss: LossName = "squared"
    loss_px: float = 1.0
    principal_point: bool = False
    threads: int = 1
    function_tolerance: float = 1e-6
    max_iterations: int = 100
    solver: str = ""


@dataclass(frozen=True)
class CeresResult:
    """Where Ceres ended: ``cost`` and ``initial_cost`` 1/2 sum rho in px^2, ``steps`` linear systems solved,
    ``wall_s`` of everything from the model in memory to the refined model, ``cpu_s`` processor time."""

    cameras: MetricCameras
    X: F64
    cost: float
    initial_cost: float
    steps: int
    wall_s: float
    cpu_s: float


def colmap_model(
    cameras: MetricCameras, X: F64, seen: Observations, size: tuple[int, int]
) -> pycolmap.Reconstruction:
    """A COLMAP model with SIMPLE_RADIAL cameras; views, rows of intrinsics and points count from 1 in it."""
    model = pycolmap.Reconstruction()
    for g, (f, _, _, cx, cy, k1) in enumerate(cameras.intrinsics):
        camera = pycolmap.Camera(
            model="SIMPLE_RADIAL",
            width=size[0],
            height=size[1],
            params=[f, cx + 0.5, cy + 0.5, k1],
            camera_id=g + 1,
        )
        model.add_camera_with_trivial_rig(camera)
    order = np.lexsort((seen.point_index, seen.view_index))
    view, point, xy = seen.view_index[order], seen.point_index[order], seen.xy[order] + 0.5
    first = np.searchsorted(view, np.arange(len(cameras.R) + 1))
    for v in range(len(cameras.R)):
        image = pycolmap.Image(
            name=f"{v}.png",
            keypoints=xy[first[v] : first[v + 1]],
            camera_id=int(cameras.group[v]) + 1,
            image_id=v + 1,
        )
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


def bundle_adjuster(
    model: pycolmap.Reconstruction, options: CeresOptions, fixed: Sequence[int] = ()
) -> pycolmap.CeresBundleAdjuster:
    """COLMAP's adjuster of all images; the views ``fixed`` hold the frame, else two as in its mapper."""
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images:
        config.add_image(image)
    for view in fixed:
        config.set_constant_rig_from_world_pose(model.images[view + 1].frame_id)
    if not fixed:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    wishes = pycolmap.BundleAdjustmentOptions()
    wishes.refine_principal_point = options.principal_point
    wishes.print_summary = False
    ceres = wishes.ceres
    ceres.loss_function_type = getattr(pycolmap.LossFunctionType, LOSSES[options.loss])
    ceres.loss_function_scale = options.loss_px
    ceres.min_num_residuals_for_cpu_multi_threading = 0
    solver = ceres.solver_options
    solver.num_threads, solver.max_num_iterations = options.threads, options.max_iterations
    solver.function_tolerance = options.function_tolerance
    if options.solver:
        ceres.auto_select_solver_type = False
        solver.mergedict(
            {"linear_solver_type": SOLVERS[options.solver], "preconditioner_type": "SCHUR_JACOBI"}
        )
    return pycolmap.create_default_ceres_bundle_adjuster(wishes, config, model)


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


def refine_with_ceres(
    cameras: MetricCameras, X: F64, seen: Observations, size: tuple[int, int], options: CeresOptions
) -> CeresResult:
    """Adjust all poses, points, focals and k1 (and principal points) by Ceres."""
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    model = colmap_model(cameras, X, seen, size)
    wall, cpu = time.perf_counter(), time.process_time()
    summary: Any = bundle_adjuster(model, options).solve()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    told = summary.ceres_summary
    refined, points = cameras_from_colmap(model, cameras)
    moved = X.copy()
    moved[np.bincount(seen.point_index, minlength=len(X)) > 0] = points
    steps = told.num_successful_steps + told.num_unsuccessful_steps
    return CeresResult(refined, moved, told.final_cost, told.initial_cost, steps, wall, cpu)


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
