"""The self-check on wrong and on right models.

Right models of real images are corrupted (:mod:`validation.scenes.corrupted`) and adjusted again. The result
is wrong or has recovered; both are counted with the verdict of the self-check. Focal lengths fixed 10 % off
stand for a wrong user prior; right models lose some of their views and points.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import thesisrecon
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.metric._adjustment import MetricAdjustment
from thesisrecon.metric._checks import self_check
from thesisrecon.metric._model import MetricEstimate, retriangulate_tracks
from thesisrecon.metric._shared_camera import contradicted_focal_priors
from thesisrecon.metric.refinement import finish_metric, settle_camera_model
from thesisrecon.records import IntrinsicInterval, IntrinsicsPrior, SelfCalibration
from thesisrecon.results import RunResult
from validation.runs.study import Part, report_progress
from validation.runs.tables import Rows, text_table
from validation.scenes.corrupted import CORRUPTIONS, model_from_reconstruction
from validation.scenes.real import scenes_here

OURS = "ours"
SCENES = ("courtyard", "fountain-P11", "Herz-Jesus-P8", "kermit")
LATE, ANGLE, ROUNDS = 7.0, np.radians(0.05), 3
WRONG_FOCAL, WRONG_CENTRE, WRONG_TURN_DEG = 0.03, 0.03, 1.0
HELD_OFF = 1.1


@dataclass(frozen=True)
class Outcome:
    """A corrupted or reduced model: ``wrong`` in truth, ``rejected`` by the self-check."""

    wrong: bool
    rejected: bool


def settle(model: MetricEstimate, adjustment: MetricAdjustment) -> MetricEstimate | None:
    """Triangulate and adjust in turn, as the metric stage ends; None if nothing is left."""
    try:
        for _ in range(ROUNDS):
            model = retriangulate_tracks(model, sigmas=LATE, min_angle=ANGLE)
            model = adjustment.run(model, iterations=10)[0]
    except StageFailure:
        return None
    return retriangulate_tracks(model, sigmas=LATE, min_angle=ANGLE)


def is_wrong(model: MetricEstimate, right: MetricEstimate) -> bool:
    """Return whether a focal errs by 3 %, or an aligned camera by 3 % of the path or by 1 degree."""
    v = model.registered & right.registered
    A, B = right.cameras.centres[v], model.cameras.centres[v]
    move = estimate_similarity(B, A)
    off, path = np.linalg.norm(A - move.apply(B), axis=1), np.linalg.norm(A - A.mean(axis=0), axis=1)
    turned = Rotation.from_matrix(
        model.cameras.R[v] @ move.R.T @ right.cameras.R[v].swapaxes(1, 2)
    ).magnitude()
    focal, truth = (m.cameras.intrinsics[m.cameras.group[v], 0] for m in (model, right))
    return bool(
        np.abs(np.log(focal / truth)).max() > WRONG_FOCAL
        or off.max() > WRONG_CENTRE * np.sqrt(np.mean(path**2))
        or np.degrees(turned.max()) > WRONG_TURN_DEG
    )


def fails_self_check(
    model: MetricEstimate, calibration: SelfCalibration, adjustment: MetricAdjustment
) -> bool:
    """Return whether a model with narrow intervals fails the self-check, shared cameras apart."""
    stated = [
        {"focal_px": IntrinsicInterval(float(model.cameras.intrinsics[g, 0]), 0.0, "")}
        for g in model.cameras.group
    ]
    failed_checks = self_check(model, calibration, stated, sigmas=LATE)[1]
    return bool(failed_checks or contradicted_focal_priors(model, adjustment))


def judge(
    model: MetricEstimate, right: MetricEstimate, calibration: SelfCalibration, adjustment: MetricAdjustment
) -> Outcome | None:
    settled = settle(model, adjustment)
    if settled is None:
        return None
    try:
        (model, adjustment, *_), sharing, *_ = settle_camera_model(finish_metric(settled, adjustment))
    except StageFailure:
        return None
    rejected = bool(sharing.failed_checks) or fails_self_check(model, calibration, adjustment)
    return Outcome(is_wrong(model, right), rejected)


def corrupted_outcomes(
    result: RunResult, prior: IntrinsicsPrior, seeds: int
) -> dict[str, list[Outcome | None]]:
    assert result.metric is not None
    assert result.calibration is not None
    adjustment = MetricAdjustment(prior, 0.02, 0.02)
    right = settle(model_from_reconstruction(result.metric.reconstruction, prior), adjustment)
    assert right is not None
    found: dict[str, list[Outcome | None]] = defaultdict(list)
    for number, (name, corrupt) in enumerate(CORRUPTIONS.items()):
        for seed in range(seeds):
            bad = corrupt(right, np.random.default_rng([seed, number]))
            found[name].append(judge(bad, right, result.calibration, adjustment))
    fixed, fixed_prior = _fixed_focal(right, prior)
    found["focal length fixed 10 % off"].append(
        judge(fixed, right, result.calibration, MetricAdjustment(fixed_prior, 0.02, 0.02))
    )
    found["right, as it is"].append(judge(right, right, result.calibration, adjustment))
    # Few views with a focal each leave the focals open, which only their intervals show.
    one_camera = len(np.unique(prior.shared[:, 0])) == 1
    for seed in range(seeds if one_camera else 0):
        rng = np.random.default_rng([seed, 99])
        found["right, some views and points"].append(
            judge(_reduced(right, rng), right, result.calibration, adjustment)
        )
    return found


def _fixed_focal(model: MetricEstimate, prior: IntrinsicsPrior) -> tuple[MetricEstimate, IntrinsicsPrior]:
    intrinsics = model.cameras.intrinsics.copy()
    intrinsics[:, 0] *= HELD_OFF
    mean, std = prior.mean.copy(), prior.std.copy()
    mean[:, 0], std[:, 0] = intrinsics[model.cameras.group, 0], 0.0
    return (
        replace(model, cameras=replace(model.cameras, intrinsics=intrinsics)),
        replace(prior, mean=mean, std=std),
    )


def _reduced(model: MetricEstimate, rng: np.random.Generator) -> MetricEstimate:
    """Keep four or more neighbouring views and half of the points."""
    views = np.flatnonzero(model.registered)
    count = int(rng.integers(4, len(views) + 1))
    begin = int(rng.integers(0, len(views) - count + 1))
    registered = np.zeros(len(model.registered), dtype=bool)
    registered[views[begin : begin + count]] = True
    t = model.tracks
    kept = (rng.random(t.n_points) < 0.5)[t.point_index] & registered[t.view_index]
    tracks = replace(t, view_index=t.view_index[kept], point_index=t.point_index[kept], xy=t.xy[kept])
    return replace(model, tracks=tracks, registered=registered, inlier=model.inlier[kept])


def self_check_study(out: Path, scenes: Sequence[str] = SCENES, seeds: int = 5) -> Iterator[Part]:
    """Count wrong models that fail the self-check and right models that pass."""
    table: dict[str, list[Outcome | None]] = defaultdict(list)
    for scene in scenes_here(scenes):
        result = thesisrecon.reconstruct(scene.image_paths[0].parent, out / scene.name, until="metric")
        assert result.metric is not None
        for options in (IntrinsicsOptions(cameras="shared"), IntrinsicsOptions(cameras="per-image")):
            prior = prior_for(result.metric.reconstruction, options)
            for kind, outcomes in corrupted_outcomes(result, prior, seeds).items():
                table[kind] += outcomes
        report_progress(f"{scene.name} done")
    lines = []
    for kind, outcomes in table.items():
        some = [o for o in outcomes if o is not None]
        wrong, right = [o for o in some if o.wrong], [o for o in some if not o.wrong]
        counts = [len(outcomes), len(outcomes) - len(some), len(wrong), sum(o.rejected for o in wrong)]
        lines.append([kind, *counts, len(right), sum(o.rejected for o in right)])
    yield text_table(["made", "models", "nothing left", "wrong", "rejected", "right", "rejected"], lines)
    every = [o for outcomes in table.values() for o in outcomes if o is not None]
    rejected = {
        name: [100.0 * o.rejected for o in every if o.wrong is (name == "wrong")]
        for name in ("wrong", "right")
    }
    for name, values in rejected.items():
        rows, share = Rows(f"{len(values)} {name}", OURS), float(np.mean(values))
        bound = 100.0 if name == "wrong" else None
        rows.add("rejected", share, "%", at_most=2.0 if bound is None else None, at_least=bound)
        yield rows
