"""Coverage of the stated intervals on photographs with truth: random subsets of neighbouring images.

Each trial takes 3 to 20 images that are connected by verified matches and goes from their tracks to metric
cameras as the pipeline does. The focal length and both coordinates of the principal point should lie inside
their 68, 95 and 99 % intervals as often as these say, for every number of images.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.config import PipelineConfig
from thesisrecon.pipeline.reconstruction import reconstruct
from thesisrecon.runtime._run import stream
from validation.metrics.intervals import interval_scores
from validation.scenes.real import Scene, data_root, read_scene
from validation.studies.runner import Part, Rows, report_progress, text_table
from validation.studies.subsets import Matched, solve, take_views

SCENES = {
    "temple": "truth/temple",
    "lego": "truth/lego",
    "fountain-P11": "strecha/fountain-P11",
    "Herz-Jesus-P8": "strecha/Herz-Jesus-P8",
}
MIN_VIEWS, MAX_VIEWS, FEW = 3, 20, 8
MIN_MATCHES = 30
LEVELS = (1.0, 1.96, 2.576)
"""Half widths of 68, 95 and 99 % intervals in standard deviations."""
SIZES = ((3, 4), (5, 6), (7, 10), (11, 20))
MIN_HOLDING, MAX_SIGMAS = 0.92, 4.0


@dataclass(frozen=True)
class Trial:
    """One subset: errors ``z`` (3,) of focal length and principal point in stated standard deviations."""

    scene: str
    views: int
    trusted: bool
    z: F64


def draw_neighbours(matched: Matched, rng: np.random.Generator, count: int) -> I64:
    """Draw ``count`` images one by one among those that share verified matches with the ones drawn."""
    n = len(matched.sizes)
    weight = np.zeros((n, n))
    for pair in matched.pairs:
        if pair.accepted and pair.inliers > MIN_MATCHES:
            weight[pair.i, pair.j] = weight[pair.j, pair.i] = np.sqrt(pair.inliers)
    drawn = [int(rng.integers(n))]
    while len(drawn) < count:
        near = weight[drawn].max(axis=0)
        near[drawn] = 0.0
        if not near.any():
            break
        drawn.append(int(rng.choice(n, p=near / near.sum())))
    return np.sort(drawn)


def match_truth_scene(scene: Scene, work: Path, *, threads: int) -> tuple[Matched, F64]:
    """Run the front end of a set, or resume it; return its true K (V, 3, 3) at working size too."""
    result = reconstruct(scene.image_paths, work / scene.name, until="metric", threads=threads)
    assert result.tracks is not None
    sizes = np.array([image.size for image in result.images], dtype=np.int64)
    scale = np.array([image.scale for image in result.images])
    K = scene.cameras[0].copy()
    K[:, :2, 2] = (K[:, :2, 2] + 0.5) * scale[:, None] - 0.5
    K[:, [0, 1], [0, 1]] *= scale[:, None]
    focal = np.sqrt(K[:, 0, 0] * K[:, 1, 1])
    return Matched(scene.name, result.tracks, result.pairs, sizes, focal), K


def run_trial(matched: Matched, K: F64, number: int) -> Trial | None:
    """Draw one subset and solve it; None without a result."""
    rng = stream(number, "coverage-real")
    most = MAX_VIEWS if number % 2 else FEW
    drawn = draw_neighbours(matched, rng, int(rng.integers(MIN_VIEWS, min(most, len(K)) + 1)))
    every = np.ones(matched.tracks.n_points, dtype=bool)
    result, _, _ = solve(take_views(matched, drawn, every), PipelineConfig(), seed=number, first=0)
    if result is None:
        return None
    z = interval_scores(result, K[drawn]).z
    return Trial(matched.name, len(drawn), result.trusted, z[np.isfinite(z[:, 0])][0])


def table_row(name: str, trials: Sequence[Trial]) -> list[object]:
    """Count the trials and give the share of trusted values inside each interval."""
    trusted = [t.z for t in trials if t.trusted]
    z = np.abs(np.array(trusted).reshape(-1, 3))

    def share(columns: slice) -> list[str]:
        return [f"{100.0 * np.mean(z[:, columns] <= level):.0f}" if len(z) else "-" for level in LEVELS]

    worst = f"{z.max():.1f}" if len(z) else "-"
    return [name, len(trials), len(trusted), *share(slice(0, 1)), *share(slice(1, 3)), worst]


HEAD = [
    "subsets", "results", "trusted", "focal 68 %", "95 %", "99 %", "principal point 68 %", "95 %", "99 %",
    "largest error, stated sigmas",
]  # fmt: skip


def coverage_real_study(
    out: Path, scenes: Sequence[str] = tuple(SCENES), trials: int = 40, threads: int = 2
) -> Iterator[Part]:
    """Measure the coverage of the intervals on random subsets of photographs with truth."""
    root, done = data_root(), list[Trial]()
    for name in scenes:
        folder = root / SCENES[name] if root is not None else None
        if folder is None or not folder.is_dir():
            report_progress(f"{name}: its images are not on this machine, left out")
            continue
        matched, K = match_truth_scene(read_scene(folder, name), out, threads=threads)
        found = [run_trial(matched, K, number) for number in range(trials)]
        done += [trial for trial in found if trial is not None]
    if not done:
        return
    rows = [table_row("all", done)]
    rows += [table_row(name, [t for t in done if t.scene == name]) for name in scenes]
    rows += [table_row(f"{a} to {b} images", [t for t in done if a <= t.views <= b]) for a, b in SIZES]
    yield text_table(HEAD, rows)
    z = np.abs(np.array([t.z for t in done if t.trusted]))
    judged = Rows("coverage of real images", "share")
    for label, columns in (("focal length", slice(0, 1)), ("principal point", slice(1, 3))):
        held = float(np.mean(z[:, columns] <= LEVELS[1]))
        judged.add(f"95 % intervals of the {label} that hold the truth", held, at_least=MIN_HOLDING)
    judged.add("largest error of a trusted value", float(z.max()), "stated sigmas", at_most=MAX_SIGMAS)
    yield judged
