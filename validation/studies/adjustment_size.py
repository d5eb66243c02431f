"""Bundle adjustment of 100 to 1000 cameras by ours and by Ceres: the same start, loss and observations.

One place, whose reduced system is dense: the courtyard with its true depths, so that walls hide points. And a
street, whose system is banded: a row of facades. Corners repeat by chance within an angle and a scale, have
noise, and some are wrong. Costs are computed by one function.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from typing import Any, Literal

import numpy as np

from thesisrecon.arrays import F32, F64, I64
from thesisrecon.geometry.triangulation import triangulate_observations
from thesisrecon.optimize.bundle.metric import BundleOptions, refine_metric_bundle
from thesisrecon.optimize.bundle.projection import MetricCameras, Observations
from thesisrecon.records import Tracks
from validation.references.ceres import CeresOptions, refine_with_ceres
from validation.runs.processes import call_apart, timed
from validation.runs.study import Part
from validation.runs.tables import text_table
from validation.scenes.courtyard import build_courtyard
from validation.scenes.many_views import walk, walk_calibration
from validation.scenes.pose import Pose, look_at, perturb
from validation.scenes.raycast import trace
from validation.stages.bundle import FOCAL_K1

SIZE, MARGIN_PX = (480, 360), 3
CORNERS, REPEATED, ANGLE_DEG, SCALE = 2500, 0.55, 28.0, 1.6
NOISE_PX, WIDE, WRONG, WRONG_PX = 0.25, 2.5, 0.03, 12.0
"""A tenth of the corners have ``WIDE`` times the noise; ``WRONG`` is the share of wrong ones."""
Kind = Literal["place", "street"]


def make_tracks(kind: Kind, count: int, *, seed: int = 7) -> tuple[Tracks, list[Pose]]:
    """Simulate ``count`` views of one place or along a street, some 3500 corners each."""
    rng = np.random.default_rng(seed)
    poses, X, first, depths = (_place if kind == "place" else _street)(count, rng)
    seen = [_observe(pose, X, first, depths, k, rng) for k, pose in enumerate(poses)]
    view = np.repeat(np.arange(count), [len(point) for point, _ in seen])
    point, xy = np.concatenate([p for p, _ in seen]), np.concatenate([x for _, x in seen])
    often = np.bincount(point, minlength=len(X))[point] >= 2
    view, xy, (used, point) = view[often], xy[often], np.unique(point[often], return_inverse=True)
    spread = NOISE_PX * np.where(rng.random(len(xy)) < 0.1, WIDE, 1.0)
    spread = np.where(rng.random(len(xy)) < WRONG, WRONG_PX, spread)
    xy = xy + spread[:, None] * rng.normal(size=xy.shape)
    order = np.lexsort((view, point))
    tracks = Tracks(view[order], point[order].astype(np.int64), xy[order], count, len(used))
    return tracks, poses


_Scene = tuple[list[Pose], F64, F64, F32 | None]
"""Cameras, points, the camera centres that the corners were found from, and depths (V, H, W)."""


def _place(count: int, rng: np.random.Generator) -> _Scene:
    poses, world, (width, height) = walk(count, SIZE), build_courtyard(), SIZE
    with ThreadPoolExecutor(2) as pool:
        maps = pool.map(lambda pose: trace(world, pose, SIZE, shade=False)[1].astype(np.float32), poses)
        depths = np.array(list(maps))
    each = int(np.clip(CORNERS / min(0.2 * REPEATED * count, 20.0), 60, CORNERS))
    X, first = list[F64](), list[F64]()
    for pose, depth in zip(poses, depths, strict=True):
        u, v = rng.integers(0, width, each), rng.integers(0, height, each)
        z = depth[v, u].astype(np.float64)
        rays = np.stack([u, v, np.ones(each)])[:, z > 0] * z[z > 0]
        X.append((np.linalg.inv(pose.K) @ rays).T @ pose.R + pose.C)
        first.append(np.tile(pose.C, (len(X[-1]), 1)))
    return poses, np.concatenate(X), np.concatenate(first), depths


def _street(count: int, rng: np.random.Generator, *, step: float = 0.5) -> _Scene:
    K = walk_calibration(SIZE)

    def bend(x: F64) -> F64:
        return np.asarray(6.0 * np.sin(x / 25.0))

    along = step * np.arange(count, dtype=np.float64)
    C = np.column_stack([along, bend(along), np.full(count, 1.6)])
    C[:, 1:] += rng.normal(0.0, 0.15, (count, 2))
    heading = 0.35 * np.sin(along / 3.5) + rng.normal(0.0, 0.1, count)
    ahead = np.column_stack([6.0 * np.sin(heading), 6.0 * np.cos(heading), rng.normal(0.0, 0.4, count)])
    rolls = np.tan(np.radians(rng.uniform(-4.0, 4.0, count)) / 2.0)
    poses = [Pose(K, look_at(c, c + d, r), c) for c, d, r in zip(C, ahead, rolls.tolist(), strict=True)]
    n = count * CORNERS // 4
    x = rng.uniform(-4.0, step * count + 4.0, n)
    away = rng.choice([4.0, 7.0, 7.5, 9.0], n) + rng.uniform(0.0, 0.8, n)
    X = np.column_stack([x, bend(x) + away, rng.uniform(-1.0, 5.0, n)])
    nearest = np.clip(np.rint(x / step).astype(int) + rng.integers(-4, 5, n), 0, count - 1)
    return poses, X, C[nearest], None


def _observe(
    pose: Pose, X: F64, first: F64, depths: F32 | None, k: int, rng: np.random.Generator
) -> tuple[I64, F64]:
    """Points (M,) that view k has as corners, and their exact pixels."""
    (width, height), Y = SIZE, (X - pose.C) @ pose.R.T
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = (Y @ pose.K.T)[:, :2] / Y[:, 2:]
    seen = (Y[:, 2] > 0.2) & (xy > MARGIN_PX).all(axis=1)
    seen &= (xy[:, 0] < width - 1 - MARGIN_PX) & (xy[:, 1] < height - 1 - MARGIN_PX)
    ray, old = X - pose.C, X - first
    length, before = np.linalg.norm(ray, axis=1), np.linalg.norm(old, axis=1)
    seen &= np.einsum("na,na->n", ray, old) > np.cos(np.radians(ANGLE_DEG)) * length * before
    seen &= (length < SCALE * before) & (before < SCALE * length)
    i = np.flatnonzero(seen)
    if depths is not None:
        u, v = np.rint(xy[i]).astype(int).T
        i = i[np.abs(depths[k, v, u] - Y[i, 2]) < 0.02 * Y[i, 2]]
    i = i[rng.random(len(i)) < REPEATED]
    if len(i) > 1.5 * CORNERS:
        i = np.sort(rng.choice(i, 3 * CORNERS // 2, replace=False))
    return i, xy[i]


LOSS_PX, MIN_VIEWS = 0.5, 3
FOCAL_OFF, MOVED = 1.02, 0.003


def adjustment_problem(kind: Kind, views: int) -> tuple[MetricCameras, F64, Observations]:
    """Return perturbed cameras and points (focal length by 2 %) and the simulated observations."""
    (t, poses), rng = make_tracks(kind, views), np.random.default_rng(5)
    K, R, C = (np.array([getattr(pose, name) for pose in poses]) for name in "KRC")
    Rt = np.concatenate([R, -np.einsum("vab,vb->va", R, C)[:, :, None]], axis=2)
    normalized = (t.xy - K[0, :2, 2]) / K[0, 0, 0]
    Xh = triangulate_observations(Rt, t.view_index, t.point_index, normalized, t.n_points)
    with np.errstate(divide="ignore", invalid="ignore"):
        X = Xh[:, :3] / Xh[:, 3:]
    z = np.einsum("ka,ka->k", Rt[t.view_index, 2, :3], X[t.point_index]) + Rt[t.view_index, 2, 3]
    good = np.isfinite(X).all(axis=1) & (np.bincount(t.point_index, minlength=len(X)) >= MIN_VIEWS)
    good[t.point_index[~((z > 0.5) & (z < 50.0))]] = False
    used = np.flatnonzero(good)
    number = np.full(len(X), -1)
    number[used] = np.arange(len(used))
    k = np.flatnonzero(good[t.point_index])
    row = np.array([[K[0, 0, 0], 1.0, 0.0, K[0, 0, 2], K[0, 1, 2], 0.0]])
    exact = MetricCameras(R, Rt[:, :, 3], row, np.zeros(views, dtype=np.int64))
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
    heads = ["observations", "wall s", "Ceres", "ratio", "processor s", "Ceres", "peak MB", "Ceres"]
    lines = list[list[str]]()
    for kind, views in product(kinds, sizes):
        found = [call_apart(measure_adjustment, kind, views, name, threads) for name in ("ours", "Ceres")]
        (ours, mine), (theirs, other) = found
        line = [f"{kind} {views}", f"{ours['observations']}", f"{ours['wall']:.1f}", f"{theirs['wall']:.1f}"]
        line += [f"{ours['wall'] / theirs['wall']:.2f}", f"{ours['cpu']:.1f}", f"{theirs['cpu']:.1f}"]
        line += [f"{mine.peak_mb:.0f}", f"{other.peak_mb:.0f}", f"{ours['cost'] / theirs['cost'] - 1.0:.1e}"]
        lines.append(line)
        yield " ".join(line)
    yield text_table(["", *heads, "cost above Ceres'"], lines)
