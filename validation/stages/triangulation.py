"""Section 6.2: triangulation from two and more views by ours, OpenCV and COLMAP, against the truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.api.cameras import triangulate
from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.optimize.bundle.projection import Observations
from thesisrecon.optimize.bundle.projective import refine_projective_bundle
from validation.references.fundamental import colmap_points, opencv_linear, opencv_polynomial
from validation.runs.records import Judgement, Outcome, ReportOptions, Stage, Task, read_arrays
from validation.runs.tables import Metric, Plot, each, plot, row, scatter
from validation.scenes.rigs import SCENES, DrawnRig, Group, draw_rig, squared_distances

OURS = "ours (polynomial, optimal)"
DESCENT = 40  # Iterations to the minimum reprojection error
LINEAR, MIDPOINT = "ours (linear)", "ours (mid-point)"
ADJUSTED = "ours (cameras too)"
"""Projective bundle adjustment of cameras and points of five views (chapter 6)."""
MOVED = 1e-3  # Relative perturbation of camera entries before the adjustment, about a pixel
OPENCV, OPENCV_POLYNOMIAL, COLMAP = "OpenCV", "OpenCV, correctMatches", "COLMAP"
NOISES_PX = (0.5, 1.0, 2.0)
POINTS, TRIALS = 400, 4  # of each scene, noise and frame
Method = Callable[[F64, F64], F64]


@dataclass(frozen=True)
class Problem(DrawnRig):
    """A rig with noise of ``sigma_px``, in a metric or in a projective frame of space."""

    sigma_px: float
    projective: bool


class TriangulationStage(Stage):
    """The thesis' comparison of methods, with the references."""

    name = "triangulation"
    always = (OURS, LINEAR, MIDPOINT, ADJUSTED, OPENCV, OPENCV_POLYNOMIAL, COLMAP)

    scenes = ("cloud",)

    def run(self, task: Task, folder: Path, options: ReportOptions) -> None:
        answers: dict[str, Any] = {}
        seconds = []
        for n, problem in enumerate(_problems(options)):
            if task.method == ADJUSTED:
                if len(problem.P) == 5:
                    answers[f"P{n}"], answers[f"{n}"] = _adjusted(problem, options.seed)
                continue
            method = _solver(task.method, len(problem.P))
            if method is None:
                continue
            method(problem.P, problem.xy[:, :8])  # compiles
            start = time.process_time()
            answers[f"{n}"] = method(problem.P, problem.xy)
            if len(problem.P) == 2:
                seconds.append((time.process_time() - start) / problem.xy.shape[1])
        np.savez(folder / "points.npz", seconds=np.array(seconds), **answers)

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        problems = list(_problems(options))
        found = {name: read_arrays(outcome, "points.npz") for name, outcome in outcomes.items()}
        metrics = [_adjustment(scene, problems, found.pop(ADJUSTED, None))]
        for views, projective in product((2, 5), (False, True)):
            chosen = {n: p for n, p in enumerate(problems) if (len(p.P), p.projective) == (views, projective)}
            where = f"{views} views, {'projective' if projective else 'metric'} frame"
            metrics += _metrics(scene, where, chosen, found)
        spent = each(found, lambda f: 1e6 * float(np.median(f["seconds"])))
        text = "two views, one processor, median"
        metrics.append(row(scene, "time a point", "us", spent, text, judged=OURS))
        return Judgement(metrics, plots=[_plot(problems, found)])


def _adjusted(problem: Problem, seed: int) -> tuple[F64, F64]:
    rng, (views, points) = np.random.default_rng(seed), problem.xy.shape[:2]
    P = problem.P * (1.0 + MOVED * rng.normal(size=problem.P.shape))
    view, point = np.tile(np.arange(views), points), np.repeat(np.arange(points), views)
    seen = problem.xy[view, point]
    start = triangulate(P, problem.xy, method="linear")
    fit = refine_projective_bundle(
        P, start, Observations(view, point, seen), loss_px=1e3, max_iterations=DESCENT
    )
    return fit.P, fit.X


def _adjustment(scene: str, problems: list[Problem], found: Mapping[str, F64] | None) -> Metric:
    over = []
    for n, p in enumerate(problems if found is not None else []):
        if found is not None and f"P{n}" in found:
            cost = squared_distances(found[f"P{n}"], found[f"{n}"], p.xy).sum()
            over.append(float(np.sqrt(cost / squared_distances(p.P, _least_near_truth(p), p.xy).sum()) - 1.0))
    text = "RMS residual of cameras and points over that of the best points with the true cameras, minus 1"
    return row(scene, "projective adjustment above the truth", "", max(over, default=None), text, judged=OURS)


def _solver(method: str, views: int) -> Method | None:
    """Return None if a method is limited to two views and there are more."""
    if method == OURS:
        return partial(triangulate, method="polynomial" if views == 2 else "optimal")
    if method in (LINEAR, MIDPOINT):
        return partial(triangulate, method="linear" if method == LINEAR else "midpoint")
    if method == COLMAP:
        return colmap_points
    if views > 2:
        return None
    return opencv_linear if method == OPENCV else opencv_polynomial


def _problems(options: ReportOptions) -> Iterator[Problem]:
    for scene, sigma, projective, trial in product(SCENES, NOISES_PX, (False, True), range(TRIALS)):
        rng = np.random.default_rng([options.seed, trial])
        frame: Group = "projective" if projective else "metric"
        drawn = draw_rig(scene, sigma, frame, rng, POINTS)
        yield Problem(**vars(drawn), sigma_px=sigma, projective=projective)


def _metrics(
    scene: str, where: str, problems: Mapping[int, Problem], found: Mapping[str, Mapping[str, F64] | None]
) -> list[Metric]:
    best = {}
    for n, p in problems.items():
        # The minimum of all answers and of a descent from the truth.
        solved = [a[f"{n}"] for a in found.values() if a is not None and f"{n}" in a]
        costs = [squared_distances(p.P, X, p.xy) for X in (*solved, _least_near_truth(p))]
        best[n] = np.min(costs, axis=0)
    above: dict[str, float | None] = {}
    apart: dict[str, float | None] = {}
    for name, answers in found.items():
        some = {n: answers[f"{n}"] for n in problems if answers is not None and f"{n}" in answers}
        if not some:
            above[name] = apart[name] = None
            continue
        cost = np.concatenate([squared_distances(problems[n].P, X, problems[n].xy) for n, X in some.items()])
        least = np.concatenate([best[n] for n in some])
        above[name] = float(np.sqrt(cost.mean() / least.mean()) - 1.0)
        apart[name] = _median_space_error(problems, some)
    optimum = _median_space_error(problems, {n: _least_near_truth(p) for n, p in problems.items()})
    over = each(apart, lambda value: value / optimum)
    optimal = f"the optimum, {where}"
    text = "of the median error in space over that of points found from the truth by descent"
    residual = "RMS distance to the measured points over that of the optimum, minus 1"
    distance = "median distance from the true point over its distance from the first camera"
    return [
        *(
            row(scene, f"{title}error in space over {optimal}", "", over.get(name), text, judged=name)
            for name, title in {OURS: "", LINEAR: f"{LINEAR}: ", MIDPOINT: f"{MIDPOINT}: "}.items()
        ),
        row(scene, f"residual above the optimum, {where}", "", above, residual, judged=OURS),
        row(scene, f"error in space, {where}", "%", apart, distance, judged=OURS),
    ]


def _median_space_error(problems: Mapping[int, Problem], answers: Mapping[int, F64]) -> float:
    """Return the median over all points of all problems (%)."""
    return float(np.median(np.concatenate([problems[n].errors_pct(X) for n, X in answers.items()])))


def _least_near_truth(problem: Problem) -> F64:
    """Return points (N, 4) of minimum reprojection error, iterated from the true ones."""
    P, X = problem.P @ problem.G, problem.X
    cost, damping = np.full(len(X), np.inf), np.full(len(X), 1e-3)
    trial = X
    for _ in range(DESCENT):
        x = np.einsum("vab,nb->vna", P, homogenize(trial))
        new = np.sum((x[..., :2] / x[..., 2:] - problem.xy) ** 2, axis=(0, 2))
        better = new < cost
        X, cost = np.where(better[:, None], trial, X), np.where(better, new, cost)
        damping = np.clip(np.where(better, damping / 10.0, damping * 10.0), 1e-9, 1e9)
        x = np.einsum("vab,nb->vna", P, homogenize(X))
        seen = x[..., :2] / x[..., 2:]
        J = (P[:, None, :2, :3] - seen[..., None] * P[:, None, 2:, :3]) / x[..., 2:, None]
        N = np.einsum("vnia,vnib->nab", J, J)
        g = np.einsum("vnia,vni->na", J, seen - problem.xy)
        N = N + damping[:, None, None] * np.einsum("naa->na", N)[:, :, None] * np.eye(3)
        trial = X - np.linalg.solve(N, g[:, :, None])[..., 0]
    return np.asarray(homogenize(X) @ problem.G.T)


def _plot(problems: list[Problem], found: Mapping[str, Mapping[str, F64] | None]) -> Plot:
    """Plot the error in space over noise: two views, metric frame."""
    traces = []
    for name, answers in found.items():
        if answers is None:
            continue
        y = []
        for sigma in NOISES_PX:
            errors = [
                p.errors_pct(answers[f"{n}"])
                for n, p in enumerate(problems)
                if p.sigma_px == sigma and not p.projective and len(p.P) == 2 and f"{n}" in answers
            ]
            y.append(float(np.median(np.concatenate(errors))))
        traces.append(scatter(name, NOISES_PX, y, "lines+markers"))
    zero = {"rangemode": "tozero"}
    return plot("Two views, metric frame", traces, "noise (px)", "median error in space (%)", yaxis=zero)
