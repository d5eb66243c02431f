"""Bundle adjustment beside Ceres: ``python -m validation.studies.bundle [same] [covariance] [growth]``.

``same``: the final model of fountain-P11, perturbed, and the same with every point twice (fresh noise), to
the same optimum under each loss, principal point fixed and free, one camera for all and one each
(``--cameras``). Ours and Ceres run in turn; times are medians. ``covariance``: against COLMAP's at one
optimum, and against Monte Carlo. ``growth``: walks of 10 to 1000 photographs, each in a process of its own,
with Ceres' sparse and iterative solvers.
"""

from __future__ import annotations

import argparse
import itertools
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import thesisrecon
from thesisrecon.arrays import B8, F64
from thesisrecon.io.colmap import reconstruction_from_colmap
from thesisrecon.io.colmap_files import read_colmap_model
from thesisrecon.io.files import write_text
from thesisrecon.numerics.levenberg_marquardt import LossName
from thesisrecon.numerics.metric_bundle import BundleOptions, MetricBundleResult, refine_metric_bundle
from thesisrecon.numerics.metric_cameras import MetricCameras
from thesisrecon.numerics.observations import Observations
from thesisrecon.records import Reconstruction
from validation.studies.growth import exponent
from validation.harness.process import own_cores, run_process
from validation.metrics.record import Metric, markdown_table
from validation.references.ceres_bundle import LOSSES, CeresOptions, refine_with_ceres
from validation.references.ceres_covariance import ceres_covariances
from validation.scenes.real import load_real_scene
from validation.scenes.streets import SIZE, Walk, make_walk, project

OURS, CERES = "ours", "Ceres"
FOCAL_K1 = np.array([True, False, False, False, False, True])
WITH_CENTRE = np.array([True, False, False, True, True, True])
LOSS_PX = 0.2
"""Where the losses turn: at about twice the noise of the photographs, so that they matter."""
ENOUGH_S = 1.0
"""Seconds after which a measurement is not repeated any more."""


@dataclass(frozen=True)
class Case:
    """One problem: each point ``copies`` times, the ``loss``, whether the principal point moves (``centre``),
    ``threads``, and whether all photographs share one camera (``shared``) or have one each."""

    copies: int
    loss: LossName
    centre: bool
    threads: int
    shared: bool

    def title(self, observations: int) -> str:
        """In words."""
        what = f"principal point {'free' if self.centre else 'fixed'}"
        cameras = "one camera" if self.shared else "a camera each"
        threads = f"{self.threads} thread{'s' * (self.threads > 1)}"
        return f"{2 * observations} residuals, {self.loss}, {cameras}, {what}, {threads}"


def model_as_bundle(model: Reconstruction) -> tuple[MetricCameras, F64, Observations]:
    """A saved model: all cameras with the first's intrinsics, as far as SIMPLE_RADIAL has them; its points
    and its observations."""
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
    """One camera, ``shared`` or for each photograph, 2 % off in its focal, poses and points off by 0.3 % of
    the scene; each point ``copies`` times, with fresh noise."""
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


def timed(work: Callable[[], Any]) -> tuple[Any, float, float]:
    """The answer with its wall and processor seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    answer = work()
    return answer, time.perf_counter() - wall, time.process_time() - cpu


def timed_often(work: Callable[[], tuple[Any, float, float]]) -> tuple[Any, float, float]:
    """The first answer with the least of its seconds: what takes milliseconds is done up to 25 times, and
    what it takes longer then is the machine's other work."""
    runs = [work()]
    while len(runs) < 25 and sum(wall for _, wall, _ in runs) < ENOUGH_S:
        runs.append(work())
    wall, cpu = (min(run[n] for run in runs) for n in (1, 2))
    return runs[0][0], wall, cpu


def ours(
    cameras: MetricCameras,
    X: F64,
    seen: Observations,
    free: B8,
    *,
    loss: LossName = "squared",
    threads: int = 1,
) -> MetricBundleResult:
    """Ours to convergence."""
    options = BundleOptions(loss=loss, loss_px=LOSS_PX, max_iterations=200, threads=threads)
    return refine_metric_bundle(cameras, X, seen, free=free, options=options)


def check_same_problem(model: Reconstruction, case: Case, *, repeats: int) -> list[Metric]:
    """Cost, times, steps and what the two optima differ in, on one problem."""
    rng = np.random.default_rng(0)
    cameras, X, seen = perturbed_model(model, rng, copies=case.copies, shared=case.shared)
    size = tuple(int(s) for s in model.sizes[0])
    wishes = CeresOptions(case.loss, LOSS_PX, case.centre, case.threads)
    times: dict[str, list[tuple[float, float]]] = {OURS: [], CERES: []}

    def once() -> MetricBundleResult:
        free = WITH_CENTRE if case.centre else FOCAL_K1
        return ours(cameras, X, seen, free, loss=case.loss, threads=case.threads)

    once()
    for _ in range(repeats):
        mine, *spent = timed(once)
        times[OURS].append((spent[0], spent[1]))
        theirs = refine_with_ceres(cameras, X, seen, (size[0], size[1]), wishes)
        times[CERES].append((theirs.wall_s, theirs.cpu_s))
    wall, cpu = ({k: float(np.median([s[n] for s in v])) for k, v in times.items()} for n in (0, 1))
    title = case.title(len(seen.xy))
    focal = {OURS: mine.cameras.intrinsics[0, 0], CERES: theirs.cameras.intrinsics[0, 0]}
    over = mine.cost / theirs.cost - 1.0
    return [
        Metric(title, "final cost", "px^2", {OURS: mine.cost, CERES: theirs.cost}, OURS),
        Metric(title, "cost over Ceres' - 1", "", {OURS: over}, OURS, 1e-4),
        Metric(title, "wall time", "s", wall, OURS, wall[CERES]),
        Metric(title, "processor time", "s", cpu, OURS, cpu[CERES]),
        Metric(title, "wall time over Ceres'", "", {OURS: wall[OURS] / wall[CERES]}, OURS, 1.0),
        Metric(title, "linear systems", "", {OURS: mine.iterations, CERES: theirs.steps}, OURS),
        Metric(title, "focal of the first photograph", "px", focal, OURS),
    ]


def check_covariance(trials: int) -> list[Metric]:
    """Covariances at one optimum beside COLMAP's, and the size of errors over what they say."""
    walk = make_walk(12, "street", np.random.default_rng(4))
    fixed = np.arange(12) < 2
    options = BundleOptions(loss="squared", max_iterations=100, covariance=True, fixed_views=fixed)
    fit = refine_metric_bundle(walk.cameras, walk.X, walk.seen, free=WITH_CENTRE, options=options)
    poses, camera = ceres_covariances(walk.cameras, walk.X, walk.seen, SIZE, (0, 1))
    assert fit.pose_covariance is not None
    mine = fit.pose_covariance[2:] / fit.sigma_px**2
    own = fit.intrinsics_covariance[0][np.ix_([0, 3, 4, 5], [0, 3, 4, 5])] / fit.sigma_px**2
    title = "street, 12 photographs, two of them fixed"
    rows = [
        Metric(
            title, "poses: largest difference to COLMAP's", "std^2", {OURS: _off(mine, poses[2:])}, OURS, 1e-3
        ),
        Metric(
            title, "f, c, k1: largest difference to COLMAP's", "std^2", {OURS: _off(own, camera)}, OURS, 1e-3
        ),
    ]
    for shared in (True, False):
        rows += _monte_carlo(walk, shared, trials, options)
    return rows


def _off(a: F64, b: F64) -> float:
    """Largest difference of covariances in units of the standard deviations."""
    std = np.sqrt(np.diagonal(b, axis1=-2, axis2=-1))
    return float((np.abs(a - b) / (std[..., :, None] * std[..., None, :])).max())


def _monte_carlo(walk: Walk, shared: bool, trials: int, options: BundleOptions) -> list[Metric]:
    """z = error / stated deviation over fresh noise: its root mean square should be 1."""
    c, n, sigma = walk.cameras, len(walk.cameras.R), 0.5
    if not shared:
        rows = np.tile(c.intrinsics, (n, 1))
        common = np.zeros(rows.shape, dtype=np.int64)
        common[:, 0] = np.arange(n)
        c = MetricCameras(c.R, c.t, rows, np.arange(n), common)
    exact = project(c, walk.X, walk.seen.view_index, walk.seen.point_index)
    rng, z, z_pose, noise = np.random.default_rng(7), [], [], []
    for _ in range(trials):
        seen = replace(walk.seen, xy=exact + sigma * rng.normal(size=exact.shape))
        fit = refine_metric_bundle(c, walk.X, seen, free=WITH_CENTRE, options=options)
        assert fit.pose_covariance is not None
        std = np.sqrt(np.diagonal(fit.intrinsics_covariance, axis1=1, axis2=2))
        z.append(((fit.cameras.intrinsics - c.intrinsics)[std > 0.0] / std[std > 0.0]) ** 2)
        turn = Rotation.from_matrix(fit.cameras.R @ np.swapaxes(c.R, 1, 2))
        shift = fit.cameras.t - np.einsum("vab,vb->va", turn.as_matrix(), c.t)
        error = np.concatenate([turn.as_rotvec(), shift], axis=1)[2:]
        z_pose.append(error**2 / np.diagonal(fit.pose_covariance[2:], axis1=1, axis2=2))
        noise.append(fit.sigma_px / sigma)
    title = f"street, 12 photographs, {'one focal' if shared else 'a focal each'}, {trials} trials"
    values = {"z of intrinsics, root mean square": z, "z of poses, root mean square": z_pose}
    measured = [
        Metric(title, f"{name}: distance to 1", "", {OURS: abs(float(np.sqrt(np.mean(v))) - 1.0)}, OURS, 0.05)
        for name, v in values.items()
    ]
    return [*measured, Metric(title, "noise found over true", "", {OURS: float(np.mean(noise))}, OURS)]


def measure_walk(kind: str, n: int, method: str) -> dict[str, float]:
    """One method on one walk in this process, warm."""
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
            told = fit.cost, fit.iterations
        else:
            done = refine_with_ceres(*start, walk.seen, SIZE, CeresOptions(solver=method))
            told, wall, cpu = (done.cost, done.steps), done.wall_s, done.cpu_s
        peak.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        return told, wall, cpu

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


def check_growth(sizes: list[int], methods: list[str], iterative_up_to: int) -> list[Metric]:
    """Time and memory over the number of photographs."""
    rows: list[Metric] = []
    for kind in ("street", "loop"):
        told: dict[int, dict[str, dict[str, float]]] = {}
        for n in sizes:
            used = [m for m in methods if m != "iterative" or n <= iterative_up_to]
            told[n] = {method: _measure_child(kind, n, method) for method in used}
            rows += walk_rows(f"{kind}, {n} photographs", told[n])
            print(markdown_table(rows[-4:]), flush=True)
        for what in ("cpu", "mb"):
            powers = {
                m: exponent([n for n in sizes if m in told[n] and n > sizes[0]],
                            [told[n][m][what] for n in sizes if m in told[n] and n > sizes[0]])
                for m in methods
                if sum(m in told[n] for n in sizes if n > sizes[0]) > 1
            }  # fmt: skip
            name = {"cpu": "processor time", "mb": "memory"}[what]
            rows.append(Metric(kind, f"power of N of {name}", "", powers, OURS))
    return rows


def walk_rows(title: str, told: dict[str, dict[str, float]]) -> list[Metric]:
    """What the methods told of one walk, ours judged by the best of the others."""
    best = min(t["cost"] for t in told.values())
    over = {m: t["cost"] / best - 1.0 for m, t in told.items()}
    cpu = {m: t["cpu"] for m, t in told.items()}
    theirs = min((c for m, c in cpu.items() if m != OURS), default=None)
    return [
        Metric(title, "cost over the least - 1", "", over, OURS, 1e-4),
        Metric(title, "processor time", "s", cpu, OURS, theirs),
        Metric(title, "linear systems", "", {m: t["steps"] for m, t in told.items()}, OURS),
        Metric(title, "memory beside the problem", "MB", {m: t["mb"] for m, t in told.items()}, OURS),
    ]


def _measure_child(kind: str, n: int, method: str) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as place:
        answer, log = Path(place) / "answer.json", Path(place) / "log"
        command = [sys.executable, "-m", "validation.studies.bundle", "--child", kind, str(n), method]
        run = run_process(
            [*command, "-o", str(answer)],
            log=log,
            cores=own_cores()[:1],
            environment={"OPENBLAS_NUM_THREADS": "1"},
        )
        if run.code != 0:
            raise RuntimeError(log.read_text(encoding="utf-8"))
        told: dict[str, float] = json.loads(answer.read_text(encoding="utf-8"))
        return told


def final_model(folder: Path | None, place: Path) -> Reconstruction:
    """The COLMAP model in ``folder``, or that of a run on fountain-P11."""
    if folder is None:
        scene = load_real_scene("fountain-P11")
        if scene is None:
            raise SystemExit("fountain-P11 is not on this machine: give a COLMAP model with --model")
        thesisrecon.reconstruct(scene.image_paths[0].parent, place, until="metric")
        folder = place / "sparse" / "0"
    return reconstruction_from_colmap(read_colmap_model(folder))


def wished_cases(wishes: argparse.Namespace) -> list[Case]:
    """All combinations of what is asked for."""
    kinds = [kind == "shared" for kind in wishes.cameras]
    every = itertools.product(wishes.copies, wishes.threads, kinds, (False, True), wishes.losses)
    return [Case(copies, loss, centre, threads, shared) for copies, threads, shared, centre, loss in every]


def main(arguments: list[str] | None = None) -> int:
    """Print the tables; 1 where a target is missed."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.bundle", description=__doc__)
    parser.add_argument("parts", nargs="*", default=["same", "covariance", "growth"])
    parser.add_argument(
        "--model", type=Path, help="folder of a COLMAP model, in place of a run on fountain-P11"
    )
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--losses", nargs="+", default=list(LOSSES))
    parser.add_argument("--cameras", nargs="+", default=["shared", "per-image"])
    parser.add_argument("--copies", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--sizes", type=int, nargs="+", default=[10, 100, 300, 1000])
    parser.add_argument("--methods", nargs="+", default=[OURS, "sparse", "iterative"])
    parser.add_argument("--iterative-up-to", type=int, default=300)
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("-o", "--out", type=Path, help="folder of the run (file, of a child)")
    wishes = parser.parse_args(arguments)
    if wishes.child:
        told = measure_walk(wishes.child[0], int(wishes.child[1]), wishes.child[2])
        write_text(wishes.out, json.dumps(told))
        return 0
    rows: list[Metric] = []
    if "same" in wishes.parts:
        with tempfile.TemporaryDirectory() as place:
            model = final_model(wishes.model, wishes.out or Path(place))
        for case in wished_cases(wishes):
            rows += (block := check_same_problem(model, case, repeats=wishes.repeats))
            print(f"\n{block[0].scene}\n", markdown_table(block), sep="\n", flush=True)
    if "covariance" in wishes.parts:
        rows += (block := check_covariance(wishes.trials))
        print("\ncovariances\n", markdown_table(block), sep="\n", flush=True)
    if "growth" in wishes.parts:
        rows += (block := check_growth(wishes.sizes, wishes.methods, wishes.iterative_up_to))
        print("\ngrowth\n", markdown_table(block), sep="\n", flush=True)
    return int(any(row.verdict == "missed" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
