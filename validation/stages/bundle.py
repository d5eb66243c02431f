"""Bundle adjustment of the same problem by ours and COLMAP (Ceres): cost, parameters, covariances."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.optimize.bundle.metric import BundleOptions, refine_metric_bundle
from thesisrecon.optimize.bundle.projection import MetricCameras, Observations
from thesisrecon.records import Reconstruction
from validation.references.ceres import CeresOptions, ceres_covariances, refine_with_ceres
from validation.runs.records import (
    IMAGE_SCENES,
    Judgement,
    Outcome,
    ReportOptions,
    Stage,
    Task,
    load_images,
    read_arrays,
)
from validation.runs.tables import OURS, Metric, each, ratio, row
from validation.scenes.pose import perturb
from validation.scenes.walks import SIZE, make_walk
from validation.stages.cameras import our_model

CERES = "Ceres"
STREET = "street"
FOCAL_K1 = np.array([True, False, False, False, False, True])
LOSS_PX = 0.2  # Scale of the robust losses: about twice the noise of the images, so that they take effect


class BundleStage(Stage):
    """The same problem, start and loss for all methods."""

    name = "bundle"
    scenes, own = (STREET, *IMAGE_SCENES), True
    required = (("cameras", OURS),)
    always = (OURS, CERES)

    def run(self, task: Task, folder: Path, options: ReportOptions) -> None:
        exact, points, given, size = _optimum(task.scene, options)
        poses, camera = _covariances(task.method, exact, points, given, size)
        np.savez(folder / "covariances.npz", poses=poses, camera=camera)
        if task.scene == STREET:
            return
        adjusted, X, seconds = _adjust(task.method, *_problem(task.scene, options))
        R, t, intrinsics = adjusted.R, adjusted.t, adjusted.intrinsics
        np.savez(folder / "adjusted.npz", R=R, t=t, intrinsics=intrinsics, X=X, seconds=seconds)

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        covariances = _covariance_metrics(scene, outcomes)
        if scene == STREET:
            return Judgement(covariances)
        cameras, _, seen, _ = _problem(scene, options)
        found = {name: read_arrays(outcome, "adjusted.npz") for name, outcome in outcomes.items()}
        costs = each(found, lambda f: _cost(f, cameras.group, seen))
        over = ratio(costs[OURS], costs[CERES])
        focals, seconds = each(found, lambda f: f["intrinsics"][0, 0]), each(found, lambda f: f["seconds"])
        above = None if over is None else over - 1.0
        metrics = [
            row(scene, "cost", "px^2", costs, "1/2 sum of rho(r^2), Huber at 0.2 px"),
            row(scene, "cost above Ceres", "", above, "ratio of costs minus 1"),
            row(scene, "focal length", "px", focals, "of the first camera", ranked=False),
            row(scene, "time", "s", seconds, "processor time of the second run"),
            *covariances,
        ]
        return Judgement(metrics, notes=[f"{2 * len(seen.xy)} residuals."])


Problem = tuple[MetricCameras, F64, Observations, tuple[int, int]]


def _problem(scene: str, options: ReportOptions) -> Problem:
    model, size = _saved(scene, options)
    return *perturbed_model(model, np.random.default_rng(options.seed)), size


def _optimum(scene: str, options: ReportOptions) -> Problem:
    """Return the model of the covariances: the true street, or the saved model."""
    if scene == STREET:
        walk = make_walk(12, np.random.default_rng(4))
        return walk.cameras, walk.X, walk.seen, SIZE
    model, size = _saved(scene, options)
    return *model_as_bundle(model), size


def _saved(scene: str, options: ReportOptions) -> tuple[Reconstruction, tuple[int, int]]:
    model = our_model(load_images(scene, options), options)
    if not model.registered.all():
        raise ValueError("an image has no camera, so this model is not adjusted")
    return model, (int(model.sizes[0, 0]), int(model.sizes[0, 1]))


def _adjust(
    method: str, cameras: MetricCameras, X: F64, seen: Observations, size: tuple[int, int]
) -> tuple[MetricCameras, F64, float]:
    """Run twice and return the second run; the first compiles."""
    if method == CERES:
        result = refine_with_ceres(cameras, X, seen, size, CeresOptions(LOSS_PX))
        return result.cameras, result.X, result.cpu_s
    options = BundleOptions(loss_px=LOSS_PX, max_iterations=200)
    for _ in range(2):
        start = time.process_time()
        fit = refine_metric_bundle(cameras, X, seen, free=FOCAL_K1, options=options)
        seconds = time.process_time() - start
    return fit.cameras, fit.X, seconds


def _cost(kept: Mapping[str, F64], group: np.ndarray, seen: Observations) -> float:
    """1/2 sum rho(|r|^2), rho(s) = s or, beyond s = c^2, 2 c sqrt(s) - c^2: no library involved."""
    f, aspect, skew, cx, cy, k1 = kept["intrinsics"][group[seen.view_index]].T
    X = kept["X"][seen.point_index]
    x = np.einsum("nab,nb->na", kept["R"][seen.view_index], X) + kept["t"][seen.view_index]
    u, v = x[:, 0] / x[:, 2], x[:, 1] / x[:, 2]
    d = 1.0 + k1 * (u * u + v * v)
    dx = f * d * u + skew * d * v + cx - seen.xy[:, 0]
    dy = f * aspect * d * v + cy - seen.xy[:, 1]
    r = np.hypot(dx, dy)
    return 0.5 * float(np.sum(np.where(r <= LOSS_PX, r**2, 2.0 * LOSS_PX * r - LOSS_PX**2)))


def _covariances(
    method: str, cameras: MetricCameras, X: F64, seen: Observations, size: tuple[int, int]
) -> tuple[F64, F64]:
    """Return covariances of poses (V, 6, 6), in the inner gauge, and (f, cx, cy, k1) for 1 px noise."""
    options = BundleOptions(loss_px=np.inf, max_iterations=100, covariance=True)
    for _ in range(2):  # the second run ends closer to the optimum
        fit = refine_metric_bundle(
            cameras, X, seen, free=np.array([True, False, False, True, True, True]), options=options
        )
        cameras, X = fit.cameras, fit.X
    if method == CERES:
        return ceres_covariances(cameras, X, seen, size)
    assert fit.pose_covariance is not None
    some = [0, 3, 4, 5]
    camera = fit.intrinsics_covariance[0][np.ix_(some, some)]
    return fit.pose_covariance / fit.sigma_px**2, camera / fit.sigma_px**2


def _covariance_metrics(scene: str, outcomes: Mapping[str, Outcome]) -> list[Metric]:
    ours, ceres = (read_arrays(outcomes[name], "covariances.npz") for name in (OURS, CERES))
    if ours is None or ceres is None:
        return [row(scene, "largest difference of covariances", "std^2", None)]
    poses, camera = _off(ours["poses"], ceres["poses"]), _off(ours["camera"], ceres["camera"])
    text = "largest entry of the covariances in units of COLMAP's standard deviations, ours minus COLMAP's"
    return [
        row(scene, "covariance of poses", "std^2", poses, text),
        row(scene, "covariance of intrinsics", "std^2", camera, text),
    ]


def _off(a: F64, b: F64) -> float:
    std = np.sqrt(np.diagonal(b, axis1=-2, axis2=-1))
    return float((np.abs(a - b) / (std[..., :, None] * std[..., None, :])).max())


def model_as_bundle(model: Reconstruction) -> tuple[MetricCameras, F64, Observations]:
    """Return cameras with the intrinsics of the first, the points and the observations of a saved model."""
    assert model.K is not None
    assert model.distortion is not None
    R, t = _poses(model)
    K = model.K[0]
    row = [K[0, 0], 1.0, 0.0, K[0, 2], K[1, 2], float(model.distortion[0, 0])]
    seen = Observations(model.tracks.view_index, model.tracks.point_index, model.tracks.xy)
    X = model.X[:, :3] / model.X[:, 3:]
    return MetricCameras(R, t, np.array([row]), np.zeros(len(R), dtype=np.int64)), X, seen


def perturbed_model(
    model: Reconstruction, rng: np.random.Generator
) -> tuple[MetricCameras, F64, Observations]:
    """Set the focal length 2 % off and move poses and points by 0.3 % of the scene."""
    exact, X, seen = model_as_bundle(model)
    scale = float(np.median(np.linalg.norm(X - np.median(X, axis=0), axis=1)))
    cameras, X = perturb(exact, X, rng, turned=0.003, moved=0.003 * scale, zoomed=1.02)
    return cameras, X, seen


def _poses(model: Reconstruction) -> tuple[F64, F64]:
    assert model.K is not None
    poses = np.linalg.inv(model.K) @ model.P
    return poses[:, :, :3], poses[:, :, 3]
