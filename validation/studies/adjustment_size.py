"""Bundle adjustment of 100 to 1000 cameras by ours and by Ceres: the same start, loss and observations.

One place, whose reduced system is dense, and a street, whose is banded; tracks are simulated with noise and
wrong observations. Costs are computed by one function.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.triangulation import triangulate_observations
from thesisrecon.optimize.bundle.metric import BundleOptions, refine_metric_bundle
from thesisrecon.optimize.bundle.metric_kernels import MetricCameras
from thesisrecon.optimize.bundle.observations import Observations
from validation.references.ceres import CeresOptions, refine_with_ceres
from validation.runs.processes import call_apart, timed
from validation.runs.study import Part
from validation.runs.tables import text_table
from validation.scenes.many_tracks import SIZE, Kind, make_tracks
from validation.scenes.pose import perturb
from validation.stages.bundle import FOCAL_K1

LOSS_PX, MIN_VIEWS = 0.5, 3
FOCAL_OFF, MOVED = 1.02, 0.003
METHODS = ("ours", "Ceres")


def adjustment_problem(kind: Kind, views: int) -> tuple[MetricCameras, F64, Observations]:
    """Return perturbed cameras and points (focal length by 2 %) and the simulated observations."""
    made, rng = make_tracks(kind, views), np.random.default_rng(5)
    t = made.tracks
    K, R, C = (np.array([getattr(pose, name) for pose in made.poses]) for name in "KRC")
    poses = np.concatenate([R, -np.einsum("vab,vb->va", R, C)[:, :, None]], axis=2)
    normalized = (t.xy - K[0, :2, 2]) / K[0, 0, 0]
    Xh = triangulate_observations(poses, t.view_index, t.point_index, normalized, t.n_points)
    with np.errstate(divide="ignore", invalid="ignore"):
        X = Xh[:, :3] / Xh[:, 3:]
    z = np.einsum("ka,ka->k", poses[t.view_index, 2, :3], X[t.point_index]) + poses[t.view_index, 2, 3]
    good = np.isfinite(X).all(axis=1) & (np.bincount(t.point_index, minlength=len(X)) >= MIN_VIEWS)
    good[t.point_index[~((z > 0.5) & (z < 50.0))]] = False
    used = np.flatnonzero(good)
    number = np.full(len(X), -1)
    number[used] = np.arange(len(used))
    k = np.flatnonzero(good[t.point_index])
    row = np.array([[K[0, 0, 0], 1.0, 0.0, K[0, 0, 2], K[0, 1, 2], 0.0]])
    exact = MetricCameras(R, poses[:, :, 3], row, np.zeros(views, dtype=np.int64))
    cameras, X = perturb(
        exact, X[used], rng, turned=MOVED, moved=MOVED, zoomed=FOCAL_OFF, points_moved=2.0 * MOVED
    )
    return cameras, X, Observations(t.view_index[k], number[t.point_index[k]], t.xy[k])


def measure_adjustment(kind: Kind, views: int, method: str, threads: int) -> dict[str, Any]:
    """Adjust by one method in this process: final cost, focal length, wall and processor seconds."""
    cameras, X, seen = adjustment_problem(kind, views)
    if method == "Ceres":
        theirs = refine_with_ceres(cameras, X, seen, SIZE, CeresOptions(LOSS_PX, threads=threads))
        cameras, X, wall, cpu = theirs.cameras, theirs.X, theirs.wall_s, theirs.cpu_s
    else:
        # The first call of a kernel loads it.
        few = Observations(seen.view_index[:2000], seen.point_index[:2000], seen.xy[:2000])
        refine_metric_bundle(cameras, X, few, free=FOCAL_K1, options=BundleOptions(max_iterations=1))
        options = BundleOptions(loss_px=LOSS_PX, max_iterations=100, threads=threads)
        fit, wall, cpu = timed(lambda: refine_metric_bundle(cameras, X, seen, free=FOCAL_K1, options=options))
        cameras, X = fit.cameras, fit.X
    exact = BundleOptions(loss_px=LOSS_PX, max_iterations=0)
    cost = refine_metric_bundle(cameras, X, seen, free=FOCAL_K1, options=exact).cost
    sizes = {"observations": len(seen.xy), "points": len(X)}
    return {"cost": cost, "focal": float(cameras.intrinsics[0, 0]), "wall": wall, "cpu": cpu} | sizes


def adjustment_size_study(
    kinds: tuple[str, ...] = ("place", "street"), sizes: tuple[int, ...] = (100, 300, 1000), threads: int = 2
) -> Iterator[Part]:
    """Compare bundle adjustment of many cameras with Ceres from the same start."""
    lines = []
    for kind in kinds:
        for views in sizes:
            found = [call_apart(measure_adjustment, kind, views, name, threads) for name in METHODS]
            ours, theirs = (answer for answer, _ in found)
            lines.append(
                [
                    f"{kind} {views}",
                    f"{ours['observations']}",
                    *(f"{a['wall']:.1f}" for a in (ours, theirs)),
                    f"{ours['wall'] / theirs['wall']:.2f}",
                    *(f"{a['cpu']:.1f}" for a in (ours, theirs)),
                    *(f"{process.peak_mb:.0f}" for _, process in found),
                    f"{ours['cost'] / theirs['cost'] - 1.0:.1e}",
                ]
            )
            yield " ".join(lines[-1])
    heads = ["observations", "wall s", "Ceres", "ratio", "processor s", "Ceres", "peak MB", "Ceres"]
    yield text_table(["", *heads, "cost above Ceres'"], lines)
