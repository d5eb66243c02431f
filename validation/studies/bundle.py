"""Bundle adjustment beside Ceres.

``same``: the final model of fountain-P11, perturbed, and the same with every point twice (fresh noise), to
the same optimum with each loss, principal point fixed and free, one camera for all and one each. Ours and
Ceres run in turn; times are medians. ``covariance``: against COLMAP's at one optimum, and against Monte
Carlo. ``growth``: walks of 10 to 1000 images, each in a process of its own, with Ceres' sparse and iterative
solvers.
"""

from __future__ import annotations

import itertools
import resource
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

import thesisrecon
from thesisrecon.arrays import B8, F64
from thesisrecon.errors import UsageError
from thesisrecon.io.colmap import reconstruction_from_colmap
from thesisrecon.io.colmap_model import read_colmap_model
from thesisrecon.numerics.losses import LossName
from thesisrecon.numerics.metric_bundle import BundleOptions, MetricBundleResult, refine_metric_bundle
from thesisrecon.numerics.metric_cameras import MetricCameras
from thesisrecon.numerics.observations import Observations
from thesisrecon.records import Reconstruction
from validation.metrics.record import Metric
from validation.references.ceres_bundle import LOSSES, CeresOptions, refine_with_ceres
from validation.references.ceres_covariance import ceres_covariances
from validation.scenes.real import load_real_scene
from validation.scenes.streets import SIZE, Walk, make_walk, project
from validation.studies.measuring import call_apart, exponent, timed
from validation.studies.runner import Part, Rows

OURS, CERES = "ours", "Ceres"
FOCAL_K1 = np.array([True, False, False, False, False, True])
WITH_CENTRE = np.array([True, False, False, True, True, True])
LOSS_PX = 0.2
"""Scale of the robust losses: about twice the noise of the images, so that they take effect."""
ENOUGH_S = 1.0
"""Total seconds after which a measurement is not repeated."""


@dataclass(frozen=True)
class Case:
    """One problem.

    ``copies``: how often each point is repeated; ``loss``: name of the loss; ``centre``: whether the
    principal point is free; ``shared``: one camera for all images, or one for each.
    """

    copies: int
    loss: LossName
    centre: bool
    shared: bool

    def title(self, observations: int) -> str:
        """Describe the problem."""
        point = f"principal point {'free' if self.centre else 'fixed'}"
        cameras = "one camera" if self.shared else "a camera each"
        return f"{2 * observations} residuals, {self.loss}, {cameras}, {point}"


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
    model: Reconstruction, rng: np.random.Generator, *, copies: int = 1, shared: bool = True
) -> tuple[MetricCameras, F64, Observations]:
    """Perturb a model.

    The focal length is 2 % off, poses and points move by 0.3 % of the scene, each point is repeated
    ``copies`` times with fresh noise; one camera is ``shared``, or each image has its own.
    """
    exact, X, seen = model_as_bundle(model)
    R, t = exact.R, exact.t
    scale = float(np.median(np.linalg.norm(X - np.median(X, axis=0), axis=1)))
    turn = Rotation.from_rotvec(0.003 * rng.normal(size=t.shape)).as_matrix()
    row = exact.intrinsics * [1.02, 1.0, 1.0, 1.0, 1.0, 1.0]
    moved = t + 0.003 * scale * rng.normal(size=t.shape)
    group = np.zeros(len(R), int) if shared else np.arange(len(R))
    cameras = MetricCameras(turn @ R, moved, np.repeat(row, group.max() + 1, axis=0), group)
    many = np.tile(X, (copies, 1))
    xy = np.tile(seen.xy, (copies, 1))
    xy[len(seen.xy) :] += model.sigma_px * rng.normal(size=xy[len(seen.xy) :].shape)
    point = np.concatenate([seen.point_index + n * len(X) for n in range(copies)])
    again = Observations(np.tile(seen.view_index, copies), point, xy)
    return cameras, many + 0.003 * scale * rng.normal(size=many.shape), again


def _poses(model: Reconstruction) -> tuple[F64, F64]:
    assert model.K is not None
    poses = np.linalg.inv(model.K) @ model.P
    return poses[:, :, :3], poses[:, :, 3]


def timed_often(work: Callable[[], tuple[Any, float, float]]) -> tuple[Any, float, float]:
    """Repeat short work up to 25 times; return its first answer and its least seconds."""
    runs = [work()]
    while len(runs) < 25 and sum(wall for _, wall, _ in runs) < ENOUGH_S:
        runs.append(work())
    wall, cpu = (min(run[n] for run in runs) for n in (1, 2))
    return runs[0][0], wall, cpu


def ours(
    cameras: MetricCameras, X: F64, seen: Observations, free: B8, *, loss: LossName = "squared"
) -> MetricBundleResult:
    """Run our bundle adjustment to convergence."""
    options = BundleOptions(loss=loss, loss_px=LOSS_PX, max_iterations=200)
    return refine_metric_bundle(cameras, X, seen, free=free, options=options)


def check_same_problem(model: Reconstruction, case: Case, *, repeats: int) -> list[Metric]:
    """Compare cost, time and optimum of ours and of Ceres on one problem."""
    rng = np.random.default_rng(0)
    cameras, X, seen = perturbed_model(model, rng, copies=case.copies, shared=case.shared)
    size = (int(model.sizes[0][0]), int(model.sizes[0][1]))
    options = CeresOptions(case.loss, LOSS_PX, case.centre)
    times: dict[str, list[tuple[float, float]]] = {OURS: [], CERES: []}

    def once() -> MetricBundleResult:
        free = WITH_CENTRE if case.centre else FOCAL_K1
        return ours(cameras, X, seen, free, loss=case.loss)

    once()
    for _ in range(repeats):
        mine, *spent = timed(once)
        times[OURS].append((spent[0], spent[1]))
        theirs = refine_with_ceres(cameras, X, seen, size, options)
        times[CERES].append((theirs.wall_s, theirs.cpu_s))
    wall, cpu = ({k: float(np.median([s[n] for s in v])) for k, v in times.items()} for n in (0, 1))
    focal = {OURS: mine.cameras.intrinsics[0, 0], CERES: theirs.cameras.intrinsics[0, 0]}
    rows = Rows(case.title(len(seen.xy)), OURS)
    rows.add("final cost", {OURS: mine.cost, CERES: theirs.cost}, "px^2")
    rows.add("cost over Ceres' - 1", mine.cost / theirs.cost - 1.0, at_most=1e-4)
    rows.add("wall time", wall, "s", at_most=wall[CERES])
    rows.add("processor time", cpu, "s", at_most=cpu[CERES])
    rows.add("wall time over Ceres'", wall[OURS] / wall[CERES], at_most=1.0)
    rows.add("linear systems", {OURS: mine.iterations, CERES: theirs.steps})
    rows.add("focal of the first image", focal, "px")
    return rows


def check_covariance(trials: int) -> list[Metric]:
    """Compare covariances with COLMAP's at one optimum, and with Monte Carlo."""
    walk = make_walk(12, "street", np.random.default_rng(4))
    fixed = np.arange(12) < 2
    options = BundleOptions(loss="squared", max_iterations=100, covariance=True, fixed_views=fixed)
    fit = refine_metric_bundle(walk.cameras, walk.X, walk.seen, free=WITH_CENTRE, options=options)
    poses, camera = ceres_covariances(walk.cameras, walk.X, walk.seen, SIZE, (0, 1))
    assert fit.pose_covariance is not None
    mine = fit.pose_covariance[2:] / fit.sigma_px**2
    own = fit.intrinsics_covariance[0][np.ix_([0, 3, 4, 5], [0, 3, 4, 5])] / fit.sigma_px**2
    rows = Rows("street, 12 images, two of them fixed", OURS)
    rows.add("poses: largest difference to COLMAP's", _off(mine, poses[2:]), "std^2", at_most=1e-3)
    rows.add("f, c, k1: largest difference to COLMAP's", _off(own, camera), "std^2", at_most=1e-3)
    for shared in (True, False):
        rows += _monte_carlo(walk, shared, trials, options)
    return rows


def _off(a: F64, b: F64) -> float:
    """Return the largest difference of covariances in units of the standard deviations."""
    std = np.sqrt(np.diagonal(b, axis1=-2, axis2=-1))
    return float((np.abs(a - b) / (std[..., :, None] * std[..., None, :])).max())


def _monte_carlo(walk: Walk, shared: bool, trials: int, options: BundleOptions) -> list[Metric]:
    """Measure z = error / stated standard deviation over fresh noise; its RMS should be 1."""
    c, n, sigma = walk.cameras, len(walk.cameras.R), 0.5
    if not shared:
        each = np.tile(c.intrinsics, (n, 1))
        common = np.zeros(each.shape, dtype=np.int64)
        common[:, 0] = np.arange(n)
        c = MetricCameras(c.R, c.t, each, np.arange(n), common)
    exact = project(c, walk.X, walk.seen.view_index, walk.seen.point_index)
    rng, z, z_pose, noise = np.random.default_rng(7), [], [], []
    for _ in range(trials):
        seen = walk.seen._replace(xy=exact + sigma * rng.normal(size=exact.shape))
        fit = refine_metric_bundle(c, walk.X, seen, free=WITH_CENTRE, options=options)
        assert fit.pose_covariance is not None
        std = np.sqrt(np.diagonal(fit.intrinsics_covariance, axis1=1, axis2=2))
        z.append(((fit.cameras.intrinsics - c.intrinsics)[std > 0.0] / std[std > 0.0]) ** 2)
        turn = Rotation.from_matrix(fit.cameras.R @ np.swapaxes(c.R, 1, 2))
        shift = fit.cameras.t - np.einsum("vab,vb->va", turn.as_matrix(), c.t)
        error = np.concatenate([turn.as_rotvec(), shift], axis=1)[2:]
        z_pose.append(error**2 / np.diagonal(fit.pose_covariance[2:], axis1=1, axis2=2))
        noise.append(fit.sigma_px / sigma)
    rows = Rows(f"street, 12 images, {'one focal' if shared else 'a focal each'}, {trials} trials", OURS)
    for name, squares in (("intrinsics", z), ("poses", z_pose)):
        off = abs(float(np.sqrt(np.mean(squares))) - 1.0)
        rows.add(f"z of {name}, root mean square: distance to 1", off, at_most=0.05)
    rows.add("noise found over true", float(np.mean(noise)))
    return rows


def measure_walk(kind: str, n: int, method: str) -> dict[str, float]:
    """Measure one method on one walk in this process, warm."""
    rng = np.random.default_rng([n, 1])
    if method == OURS:
        warm = np.random.default_rng(0)
        small = make_walk(10, "street", warm)
        ours(*small.start(warm), small.seen, FOCAL_K1)
    walk = make_walk(n, "loop" if kind == "loop" else "street", rng)
    start = walk.start(rng)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    peak = []

    def once() -> tuple[tuple[float, int], float, float]:
        if method == OURS:
            fit, wall, cpu = timed(lambda: ours(*start, walk.seen, FOCAL_K1))
            answer = fit.cost, fit.iterations
        else:
            done = refine_with_ceres(*start, walk.seen, SIZE, CeresOptions(solver=method))
            answer, wall, cpu = (done.cost, done.steps), done.wall_s, done.cpu_s
        peak.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        return answer, wall, cpu

    (cost, steps), wall, cpu = timed_often(once)
    mb = (peak[0] - before) / 1024.0
    return {
        "cost": cost,
        "steps": steps,
        "wall": wall,
        "cpu": cpu,
        "mb": mb,
        "observations": len(walk.seen.xy),
    }


def check_growth(
    sizes: Sequence[int], methods: Sequence[str], iterative_up_to: int
) -> Iterator[list[Metric]]:
    """Measure time and memory over the number of images, each walk in its own process."""
    for kind in ("street", "loop"):
        found: dict[int, dict[str, dict[str, float]]] = {}
        for n in sizes:
            used = [m for m in methods if m != "iterative" or n <= iterative_up_to]
            found[n] = {m: call_apart(measure_walk, kind, n, m, cores=1)[0] for m in used}
            yield walk_rows(f"{kind}, {n} images", found[n])
        rows = Rows(kind, OURS)
        for key, name in (("cpu", "processor time"), ("mb", "memory")):
            powers = {}
            for method in methods:
                known = [n for n in sizes if method in found[n] and n > sizes[0]]
                if len(known) > 1:
                    powers[method] = exponent(known, [found[n][method][key] for n in known])
            rows.add(f"power of N of {name}", powers)
        yield rows


def walk_rows(title: str, found: Mapping[str, Mapping[str, float]]) -> list[Metric]:
    """Return the rows of one walk; ours is judged by the best of the others."""
    best = min(t["cost"] for t in found.values())
    cpu = {m: t["cpu"] for m, t in found.items()}
    theirs = min((c for m, c in cpu.items() if m != OURS), default=None)
    rows = Rows(title, OURS)
    rows.add("cost over the least - 1", {m: t["cost"] / best - 1.0 for m, t in found.items()}, at_most=1e-4)
    rows.add("processor time", cpu, "s", at_most=theirs)
    rows.add("linear systems", {m: t["steps"] for m, t in found.items()})
    rows.add("memory beside the problem", {m: t["mb"] for m, t in found.items()}, "MB")
    return rows


def final_model(folder: Path | None, place: Path) -> Reconstruction:
    """Return the COLMAP model in ``folder``, or that of a run on fountain-P11."""
    if folder is None:
        scene = load_real_scene("fountain-P11")
        if scene is None:
            raise UsageError("fountain-P11 is not on this machine; give a COLMAP model with --model")
        thesisrecon.reconstruct(scene.image_paths[0].parent, place, until="metric")
        folder = place / "sparse" / "0"
    return reconstruction_from_colmap(read_colmap_model(folder))


Name = Literal["same", "covariance", "growth"]


def bundle_study(
    out: Path,
    parts: Sequence[Name] = ("same", "covariance", "growth"),
    model: Path | None = None,
    repeats: int = 5,
    trials: int = 200,
    losses: Sequence[LossName] = tuple(LOSSES),
    cameras: Sequence[Literal["shared", "per-image"]] = ("shared", "per-image"),
    copies: Sequence[int] = (1, 2),
    sizes: Sequence[int] = (10, 100, 300, 1000),
    methods: Sequence[str] = (OURS, "sparse", "iterative"),
    iterative_up_to: int = 300,
) -> Iterator[Part]:
    """Compare bundle adjustment with Ceres: optimum, time, covariance, growth.

    Parameters
    ----------
    model : Path
        Folder of a COLMAP model (default: a run on fountain-P11).
    losses : sequence of str
        Names of losses.
    copies : sequence of int
        How often each point is repeated.
    iterative_up_to : int
        Largest walk for Ceres' iterative solver.
    """
    if "same" in parts:
        final = final_model(model, out)
        shared = [kind == "shared" for kind in cameras]
        for many, one, centre, loss in itertools.product(copies, shared, (False, True), losses):
            yield check_same_problem(final, Case(many, loss, centre, one), repeats=repeats)
    if "covariance" in parts:
        yield check_covariance(trials)
    if "growth" in parts:
        yield from check_growth(sizes, methods, iterative_up_to)
