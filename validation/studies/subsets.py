"""The coverage of stated intervals: 95 % intervals should contain the truth in 95 of 100 cases.

``calibration-coverage``: synthetic scenes that match the model. ``coverage-real``: random connected subsets
of photographs with truth. What is within 3 % and not trusted, or off by more and trusted, is counted.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.arrays import F64, I64
from thesisrecon.config import PipelineConfig
from thesisrecon.config.intrinsics import prior_for, prior_from_options
from thesisrecon.errors import StageFailure
from thesisrecon.pipeline.algorithm1 import ATTEMPTS
from thesisrecon.pipeline.run import stream
from thesisrecon.records import MetricResult, Tracks, TwoView
from validation.metrics.cameras import LEVEL, holding_std, interval_scores, pose_scores
from validation.runs.study import Part
from validation.runs.tables import Metric, Rows, text_table
from validation.scenes.critical import Motion, make_sequence, projective_estimate
from validation.scenes.real import Scene, scenes_here

Cameras = Literal["shared", "per-image"]
MODES: tuple[Cameras, ...] = ("shared", "per-image")
SUCCESS_PCT = 3.0
COVERAGE = 0.92, 0.98
ZOOM = 0.3


def run_synthetic(cameras: Cameras, number: int) -> tuple[F64, MetricResult] | None:
    """Solve one synthetic scene; None if calibration fails."""
    rng = np.random.default_rng([number, 5])
    scene = make_sequence(Motion.GENERAL, rng, zoom=0.0 if cameras == "shared" else ZOOM)
    projective, config = projective_estimate(scene, rng), PipelineConfig()
    prior = prior_for(projective, replace(config.intrinsics, cameras=cameras))
    rngs = stream(number, "selfcalibration"), stream(number, "metric")
    try:
        calibration = config.selfcalibration.calibrate(projective, prior=prior, rng=rngs[0])
        result = config.metric.refine(projective, calibration, prior=prior, rng=rngs[1], threads=1)
    except StageFailure:
        return None
    scores = interval_scores(result, scene.K)
    if cameras == "shared":
        scores = scores[np.isfinite(scores[:, 3])][:1]
    return scores, result


def check_coverage(cameras: Cameras, numbers: Iterable[int]) -> list[Metric]:
    """Measure one mode over these trials; results that are not trusted do not count."""
    found = [run_synthetic(cameras, number) for number in numbers]
    trusted = [part for part in found if part is not None and part[1].trusted]
    rows = Rows(f"synthetic, {cameras}", "ours (default)")
    rows.add(f"calibrated of {len(found)}", float(sum(part is not None for part in found)))
    rows.add(f"trusted of {len(found)}", float(len(trusted)), at_least=1.0)
    if not trusted:
        return rows
    for label, columns in {"focal": slice(1), "principal point": slice(1, 3)}.items():
        scores = [part[0][:, columns] for part in trusted]
        z = np.concatenate(scores)
        name = f"95 % intervals of the {label} that hold the truth"
        share = float(np.mean(np.abs(z[np.isfinite(z)]) <= LEVEL))
        rows.add(name, share, at_least=COVERAGE[0])
        rows.add(f"{name} (no wider than needed)", share, at_most=COVERAGE[1])
        rows.add(f"{name}, 95 % uncertainty of this share", LEVEL * holding_std(scores))
        rows.add(f"error, {label}, rms in stated standard deviations", float(np.sqrt(np.nanmean(z**2))))
    stated = np.concatenate([part[0][:, 3] for part in trusted])
    rows.add("stated standard deviation of the focal, median, %", float(100 * np.nanmedian(stated)))
    return rows


def calibration_coverage_study(trials: int = 200) -> Iterator[Part]:
    """Count 95 % intervals that contain the truth, on synthetic scenes that match the model."""
    for cameras in MODES:
        yield check_coverage(cameras, range(trials))


@dataclass(frozen=True)
class Matched:
    """An image set after its front end: its tracks and pairs, and the image ``sizes`` (V, 2)."""

    name: str
    tracks: Tracks
    pairs: Sequence[TwoView]
    sizes: I64


def match_scene(scene: Scene, work: Path) -> tuple[Matched, F64]:
    """Run the front end of a set, or resume it in ``work``; return also the scales (V,) of the images."""
    result = reconstruct(scene.image_paths, work / scene.name, until="metric", threads=2)
    assert result.tracks is not None
    sizes = np.array([image.size for image in result.images], dtype=np.int64)
    scale = np.array([image.scale for image in result.images])
    return Matched(scene.name, result.tracks, result.pairs, sizes), scale


def take_views(matched: Matched, views: I64) -> Matched:
    """Return the set as if only these views existed."""
    t, number = matched.tracks, np.full(matched.tracks.n_views, -1, dtype=np.int64)
    number[views] = np.arange(len(views))
    k = number[t.view_index] >= 0
    k &= np.bincount(t.point_index[k], minlength=t.n_points)[t.point_index] >= 2
    points, point_index = np.unique(t.point_index[k], return_inverse=True)
    tracks = Tracks(number[t.view_index[k]], point_index, t.xy[k], len(views), len(points))
    pairs = [
        replace(pair, i=int(number[pair.i]), j=int(number[pair.j]))
        for pair in matched.pairs
        if number[pair.i] >= 0 and number[pair.j] >= 0
    ]
    return replace(matched, tracks=tracks, pairs=pairs, sizes=matched.sizes[views])


def solve(
    matched: Matched, config: PipelineConfig, *, seed: int
) -> tuple[MetricResult | None, tuple[str, ...]]:
    """Go from tracks to metric cameras with the attempts of the pipeline."""
    n, sizes = len(matched.sizes), [(int(width), int(height)) for width, height in matched.sizes]
    prior = prior_from_options(config.intrinsics, sizes, np.full(n, np.nan), np.ones(n))
    found, failures, given = list[MetricResult](), list[str](), (matched.tracks, matched.pairs, matched.sizes)
    for k in range(ATTEMPTS):
        rngs = [stream(seed, stage, k) for stage in ("projective", "selfcalibration", "metric")]
        try:
            projective = config.projective.reconstruct(*given, rng=rngs[0], attempt=k)
            calibration = config.selfcalibration.calibrate(projective, prior=prior, rng=rngs[1])
            refined = config.metric.refine(projective, calibration, prior=prior, rng=rngs[2], threads=1)
        except StageFailure as failure:
            failures.append(str(failure))
            continue
        found.append(refined)
        if refined.trusted:
            break
    best = max(
        found,
        key=lambda one: (one.trusted, one.reconstruction.registered.sum(), one.reconstruction.valid.sum()),
        default=None,
    )
    return best, tuple(failures)


SCENES = ("temple", "lego", "fountain-P11", "Herz-Jesus-P8")
FEWEST_VIEWS, MOST_VIEWS, FEW = 3, 20, 8
LEVELS = (1.0, 1.96, 2.576)  # Half widths of 68, 95 and 99 % intervals in standard deviations
KINDS = ("focal length", "principal point", "centres", "rotations")
MIN_HOLDING, MAX_SIGMAS = 0.92, 4.0


class CoverageTrial(NamedTuple):
    """``rotation_deg``: the largest; ``focal_pct``: error of the focal length; ``z``: errors in stated
    deviations for each of :data:`KINDS`.
    """

    scene: str
    views: int
    rotation_deg: float
    trusted: bool
    focal_pct: float
    z: tuple[F64, ...]


def draw_neighbours(matched: Matched, rng: np.random.Generator, count: int) -> I64:
    """Draw ``count`` images one by one among those that share verified matches with the ones drawn."""
    n = len(matched.sizes)
    weight = np.zeros((n, n))
    for pair in matched.pairs:
        if pair.accepted and pair.inliers > 30:
            weight[pair.i, pair.j] = weight[pair.j, pair.i] = np.sqrt(pair.inliers)
    drawn = [int(rng.integers(n))]
    while len(drawn) < count:
        near = weight[drawn].max(axis=0)
        near[drawn] = 0.0
        if not near.any():
            break
        drawn.append(int(rng.choice(n, p=near / near.sum())))
    return np.sort(drawn)


def run_coverage_trial(matched: Matched, truth: tuple[F64, F64, F64], number: int) -> CoverageTrial | None:
    """Draw one subset and solve it; None without a result. ``truth`` is K, R and C of all images."""
    rng = stream(number, "coverage-real")
    most = MOST_VIEWS if number % 2 else FEW
    drawn = draw_neighbours(matched, rng, int(rng.integers(FEWEST_VIEWS, min(most, len(truth[0])) + 1)))
    result, _ = solve(take_views(matched, drawn), PipelineConfig(), seed=number)
    if result is None:
        return None
    K, R, C = (values[drawn] for values in truth)
    scores = interval_scores(result, K)
    *camera, stated = scores[np.isfinite(scores[:, 0])][0]
    poses = pose_scores(result, R, C)
    poses = poses[np.isfinite(poses[:, 0])]
    turns = Rotation.from_matrix(np.einsum("iab,jcb->ijac", R, R).reshape(-1, 3, 3)).magnitude()
    z = np.array(camera[:1]), np.array(camera[1:]), poses[:, 3:].ravel(), poses[:, :3].ravel()
    turned, off = float(np.degrees(turns.max())), 100.0 * abs(camera[0]) * stated
    return CoverageTrial(matched.name, len(drawn), turned, result.trusted, off, z)


def trusted_errors(trials: Sequence[CoverageTrial], kind: int) -> F64:
    """Absolute errors of one of :data:`KINDS` in all trusted trials."""
    return np.asarray(np.abs(np.concatenate([np.zeros(0), *(t.z[kind] for t in trials if t.trusted)])))


def coverage_row(name: str, trials: Sequence[CoverageTrial]) -> list[object]:
    """Count the trials, those within 3 % and not trusted, and those farther off and trusted; give the share
    of trusted values inside their 68, 95 and 99 % intervals.
    """
    errors = [trusted_errors(trials, kind) for kind in range(len(KINDS))]
    shares = [
        " ".join(f"{100.0 * np.mean(z <= level):.0f}" for level in LEVELS) if len(z) else "-" for z in errors
    ]
    worst = [f"{z.max():.1f}" if len(z) else "-" for z in errors]
    wrong = sum(t.focal_pct > SUCCESS_PCT for t in trials if t.trusted)
    doubted = sum(t.focal_pct <= SUCCESS_PCT for t in trials if not t.trusted)
    return [name, len(trials), sum(t.trusted for t in trials), doubted, wrong, *shares, " ".join(worst)]


def coverage_real_study(out: Path, scenes: Sequence[str] = SCENES, trials: int = 40) -> Iterator[Part]:
    """Measure the coverage of the intervals on random subsets of photographs with truth."""
    done = list[CoverageTrial]()
    for scene in scenes_here(scenes):
        matched, scale = match_scene(scene, out)
        K = scene.cameras[0].copy()
        K[:, :2, 2] = (K[:, :2, 2] + 0.5) * scale[:, None] - 0.5
        K[:, [0, 1], [0, 1]] *= scale[:, None]
        found = [run_coverage_trial(matched, (K, *scene.cameras[1:]), number) for number in range(trials)]
        done += [trial for trial in found if trial is not None]
    if not done:
        return
    groups = {"all": done} | {name: [t for t in done if t.scene == name] for name in scenes}
    for a, b in ((3, 4), (5, 6), (7, 10), (11, 20)):
        groups[f"{a} to {b} images"] = [t for t in done if a <= t.views <= b]
    for a, b in ((0, 30), (30, 60), (60, 180)):
        groups[f"rotation of {a} to {b} degrees"] = [t for t in done if a <= t.rotation_deg < b]
    head = [
        "subsets",
        "results",
        "trusted",
        "right, not trusted",
        "off by 3 %, trusted",
        *(f"{kind}, 68 95 99 %" for kind in KINDS),
    ]
    rows = [coverage_row(name, some) for name, some in groups.items()]
    yield text_table([*head, "largest errors, sigmas"], rows)
    judged = Rows("coverage of real images", "share")
    for kind, label in enumerate(KINDS):
        held = float(np.mean(trusted_errors(done, kind) <= LEVELS[1]))
        judged.add(f"95 % intervals of the {label} that hold the truth", held, at_least=MIN_HOLDING)
    worst = max(float(trusted_errors(done, kind).max()) for kind in range(len(KINDS)))
    judged.add("largest error of a trusted value", worst, "stated sigmas", at_most=MAX_SIGMAS)
    yield judged
