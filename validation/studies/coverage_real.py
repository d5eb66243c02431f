"""Coverage of the stated intervals on photographs with truth: random subsets of neighbouring images.

Each trial takes 3 to 20 images that are connected by verified matches and goes from their tracks to metric
cameras as the pipeline does. Focal length, principal point, every centre and every rotation should lie inside
their 68, 95 and 99 % intervals as often as these say, for every number of images and amount of rotation.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.arrays import F64, I64
from thesisrecon.config import PipelineConfig
from thesisrecon.runtime._run import stream
from validation.metrics.intervals import interval_scores, pose_scores
from validation.runs.study import Part
from validation.runs.tables import Rows, text_table
from validation.scenes.real import Scene, scenes_here
from validation.studies.subsets import Matched, solve, take_views

SCENES = ("temple", "lego", "fountain-P11", "Herz-Jesus-P8")
MIN_VIEWS, MAX_VIEWS, FEW = 3, 20, 8
MIN_MATCHES = 30
LEVELS = (1.0, 1.96, 2.576)
"""Half widths of 68, 95 and 99 % intervals in standard deviations."""
KINDS = ("focal length", "principal point", "centres", "rotations")
SIZES = ((3, 4), (5, 6), (7, 10), (11, 20))
TURNS_DEG = ((0, 30), (30, 60), (60, 180))
MIN_HOLDING, MAX_SIGMAS = 0.92, 4.0


@dataclass(frozen=True)
class Trial:
    """One subset: its number of ``views`` and largest true rotation between two of them, and errors in stated
    standard deviations for each of :data:`KINDS`."""

    scene: str
    views: int
    rotation_deg: float
    trusted: bool
    z: tuple[F64, ...]


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


def run_trial(matched: Matched, truth: tuple[F64, F64, F64], number: int) -> Trial | None:
    """Draw one subset and solve it; None without a result. ``truth`` is K, R and C of all images."""
    rng = stream(number, "coverage-real")
    most = MAX_VIEWS if number % 2 else FEW
    drawn = draw_neighbours(matched, rng, int(rng.integers(MIN_VIEWS, min(most, len(truth[0])) + 1)))
    every = np.ones(matched.tracks.n_points, dtype=bool)
    result, _, _ = solve(take_views(matched, drawn, every), PipelineConfig(), seed=number, first=0)
    if result is None:
        return None
    K, R, C = (values[drawn] for values in truth)
    camera = interval_scores(result, K).z
    camera = camera[np.isfinite(camera[:, 0])][0]
    poses = pose_scores(result, R, C)
    poses = poses[np.isfinite(poses[:, 0])]
    turns = Rotation.from_matrix(np.einsum("iab,jcb->ijac", R, R).reshape(-1, 3, 3)).magnitude()
    z = camera[:1], camera[1:], poses[:, 3:].ravel(), poses[:, :3].ravel()
    return Trial(matched.name, len(drawn), float(np.degrees(turns.max())), result.trusted, z)


def trusted_errors(trials: Sequence[Trial], kind: int) -> F64:
    """Absolute errors of one of :data:`KINDS` in all trusted trials."""
    return np.asarray(np.abs(np.concatenate([np.zeros(0), *(t.z[kind] for t in trials if t.trusted)])))


def table_row(name: str, trials: Sequence[Trial]) -> list[object]:
    """Count the trials and give the share of trusted values inside their 68, 95 and 99 % intervals."""
    errors = [trusted_errors(trials, kind) for kind in range(len(KINDS))]
    shares = [
        " ".join(f"{100.0 * np.mean(z <= level):.0f}" for level in LEVELS) if len(z) else "-" for z in errors
    ]
    worst = [f"{z.max():.1f}" if len(z) else "-" for z in errors]
    return [name, len(trials), sum(t.trusted for t in trials), *shares, " ".join(worst)]


HEAD = ["subsets", "results", "trusted", *(f"{kind}, 68 95 99 %" for kind in KINDS), "largest errors, sigmas"]


def coverage_real_study(
    out: Path, scenes: Sequence[str] = SCENES, trials: int = 40, threads: int = 2
) -> Iterator[Part]:
    """Measure the coverage of the intervals on random subsets of photographs with truth."""
    done = list[Trial]()
    for scene in scenes_here(scenes):
        matched, K = match_truth_scene(scene, out, threads=threads)
        found = [run_trial(matched, (K, *scene.cameras[1:]), number) for number in range(trials)]
        done += [trial for trial in found if trial is not None]
    if not done:
        return
    rows = [table_row("all", done)]
    rows += [table_row(name, [t for t in done if t.scene == name]) for name in scenes]
    rows += [table_row(f"{a} to {b} images", [t for t in done if a <= t.views <= b]) for a, b in SIZES]
    rows += [
        table_row(f"rotation of {a} to {b} degrees", [t for t in done if a <= t.rotation_deg < b])
        for a, b in TURNS_DEG
    ]
    yield text_table(HEAD, rows)
    judged = Rows("coverage of real images", "share")
    for kind, label in enumerate(KINDS):
        held = float(np.mean(trusted_errors(done, kind) <= LEVELS[1]))
        judged.add(f"95 % intervals of the {label} that hold the truth", held, at_least=MIN_HOLDING)
    worst = max(float(trusted_errors(done, kind).max()) for kind in range(len(KINDS)))
    judged.add("largest error of a trusted value", worst, "stated sigmas", at_most=MAX_SIGMAS)
    yield judged
