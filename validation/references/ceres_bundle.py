"""Bundle adjustment by COLMAP (Ceres) through pycolmap: the same problem, start and loss as ours."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.numerics.metric_cameras import MetricCameras
from thesisrecon.numerics.observations import Observations
from validation.references.colmap_model import cameras_from_colmap, colmap_model
from validation.references.libraries import pycolmap

SOLVERS = {"dense": "DENSE_SCHUR", "sparse": "SPARSE_SCHUR", "iterative": "ITERATIVE_SCHUR"}


@dataclass(frozen=True)
class CeresOptions:
    """Options of Ceres: Huber's loss turns at ``loss_px``; ``principal_point`` frees it;
    ``function_tolerance`` 0 is COLMAP's default, 1e-6 Ceres'; ``solver`` a name of :data:`SOLVERS`, or "" for
    COLMAP's choice."""

    loss_px: float = np.inf
    principal_point: bool = False
    threads: int = 1
    function_tolerance: float = 1e-6
    max_iterations: int = 100
    solver: str = ""


@dataclass(frozen=True)
class CeresResult:
    """Result of Ceres: ``cost`` and ``initial_cost`` 1/2 sum rho in px^2, ``steps`` linear systems solved,
    ``wall_s`` of everything from the model in memory to the refined model, ``cpu_s`` processor time."""

    cameras: MetricCameras
    X: F64
    cost: float
    initial_cost: float
    steps: int
    wall_s: float
    cpu_s: float


def refine_with_ceres(
    cameras: MetricCameras, X: F64, seen: Observations, size: tuple[int, int], options: CeresOptions
) -> CeresResult:
    """Adjust all poses, points, focals and k1 (and principal points) by Ceres."""
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    model = colmap_model(cameras, X, seen, size)
    wall, cpu = time.perf_counter(), time.process_time()
    summary: Any = bundle_adjuster(model, options).solve()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    report = summary.ceres_summary
    refined, points = cameras_from_colmap(model, cameras)
    moved = X.copy()
    moved[np.bincount(seen.point_index, minlength=len(X)) > 0] = points
    steps = report.num_successful_steps + report.num_unsuccessful_steps
    return CeresResult(refined, moved, report.final_cost, report.initial_cost, steps, wall, cpu)


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
    if options.solver:
        ceres.auto_select_solver_type = False
        solver.mergedict(
            {"linear_solver_type": SOLVERS[options.solver], "preconditioner_type": "SCHUR_JACOBI"}
        )
    return pycolmap.create_default_ceres_bundle_adjuster(adjustment, config, model)
