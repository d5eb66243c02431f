"""The self-check on wrong and on right models.

Right models of real images are corrupted and adjusted again. The result is wrong or has recovered; both are
counted with the verdict of the self-check. Focal lengths fixed 10 % off stand for a wrong user prior; right
models lose some of their views and points.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import thesisrecon
from thesisrecon.arrays import F64, I64
from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.metric._adjustment import MetricAdjustment
from thesisrecon.metric._checks import self_check
from thesisrecon.metric._model import MetricEstimate, camera_rows, retriangulate_tracks
from thesisrecon.metric._shared_camera import contradicted_focal_priors
from thesisrecon.metric.refinement import finish_metric, settle_camera_model
from thesisrecon.optimize.bundle.projection import MetricCameras
from thesisrecon.records import IntrinsicInterval, IntrinsicsPrior, Reconstruction, SelfCalibration
from thesisrecon.results import RunResult
from validation.runs.study import Part, report_progress
from validation.runs.tables import Rows, text_table
from validation.scenes.real import scenes_here


def model_from_reconstruction(found: Reconstruction, prior: IntrinsicsPrior) -> MetricEstimate:
    """The working model of a metric reconstruction."""
    assert found.K is not None
    assert found.distortion is not None
    views = found.registered
    K = np.where(views[:, None, None], found.K, np.eye(3))
    Q = np.linalg.inv(K) @ found.P
    group, shared = camera_rows(prior)
    rows = np.zeros((len(shared), 8))
    for g in range(len(rows)):
        mine = np.flatnonzero((group == g) & views)
        v = int(mine[0]) if len(mine) else int(np.flatnonzero(views)[0])
        rows[g] = [K[v, 0, 0], K[v, 1, 1] / K[v, 0, 0], K[v, 0, 1], *K[v, :2, 2], *found.distortion[v]]
    cameras = MetricCameras(
        np.where(views[:, None, None], Q[:, :, :3], np.eye(3)), Q[:, :, 3], rows, group, shared
    )
    return MetricEstimate(
        found.tracks, found.sizes, cameras, views.copy(), found.X[:, :3].copy(), found.valid.copy(),
        found.inlier.copy(), max(found.sigma_px, 0.02),
    )  # fmt: skip


def _spread(model: MetricEstimate) -> float:
    C = model.cameras.centres[model.registered]
    return float(np.sqrt(np.mean(np.sum((C - C.mean(axis=0)) ** 2, axis=1))))


def _direction(rng: np.random.Generator) -> F64:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def _placed(model: MetricEstimate, R: F64, C: F64) -> MetricEstimate:
    t = -np.einsum("vab,vb->va", R, C)
    return replace(model, cameras=replace(model.cameras, R=R, t=t))


def move_cameras(
    model: MetricEstimate, rng: np.random.Generator, views: I64, degrees: float
) -> MetricEstimate:
    """Views turned by up to ``degrees`` (at least a quarter) and moved by a fifth to a half of the path."""
    R, C = model.cameras.R.copy(), model.cameras.centres
    for v in views:
        turn = np.radians(rng.uniform(degrees / 4.0, degrees)) * _direction(rng)
        R[v] = Rotation.from_rotvec(turn).as_matrix() @ R[v]
        C[v] += _spread(model) * rng.uniform(0.2, 0.5) * _direction(rng)
    return _placed(model, R, C)


def two_swapped(model: MetricEstimate, rng: np.random.Generator) -> MetricEstimate:
    """Swap two cameras."""
    i, j = rng.choice(np.flatnonzero(model.registered), 2, replace=False)
    R, C = model.cameras.R.copy(), model.cameras.centres
    R[[i, j]], C[[i, j]] = R[[j, i]], C[[j, i]]
    return _placed(model, R, C)


def mirrored(model: MetricEstimate, rng: np.random.Generator) -> MetricEstimate:
    """The depth reversal of weak perspective: mirrored at a plane across an axis, cameras turned round."""
    z = model.cameras.R[rng.choice(np.flatnonzero(model.registered)), 2]
    o = np.median(model.X[model.valid], axis=0)
    M = np.eye(3) - 2.0 * np.outer(z, z)
    R = np.diag([1.0, 1.0, -1.0]) @ model.cameras.R @ M
    # Mirrored cameras look away from the scene; move them back to their side.
    C = o + (model.cameras.centres - o) @ M
    return _placed(model, R, C - 2.0 * ((C - o) @ z)[:, None] * z)


def _transformed(model: MetricEstimate, H: F64, focal_factor: float) -> MetricEstimate:
    """Cameras nearest to those of the model in the frame H X, all focals multiplied."""
    intrinsics = model.cameras.intrinsics.copy()
    intrinsics[:, 0] *= focal_factor
    cameras = replace(model.cameras, intrinsics=intrinsics)
    P = np.linalg.inv(cameras.K) @ model.cameras.P @ np.linalg.inv(H)
    P *= np.where(np.linalg.det(P[:, :, :3]) < 0, -1.0, 1.0)[:, None, None]
    U, _, Vt = np.linalg.svd(P[:, :, :3])
    C = -np.linalg.solve(P[:, :, :3], P[:, :, 3:])[:, :, 0]
    return _placed(replace(model, cameras=cameras), U @ Vt, C)


def wrong_infinity(model: MetricEstimate, rng: np.random.Generator) -> MetricEstimate:
    """The upgrade with a plane at infinity 2.5 to 10 path lengths away."""
    H = np.eye(4)
    H[3, :3] = _direction(rng) * rng.uniform(0.1, 0.4) / _spread(model)
    H[3, 3] = 1.0 - H[3, :3] @ np.median(model.X[model.valid], axis=0)
    return _transformed(model, H, 1.0)


def wrong_focal(model: MetricEstimate, rng: np.random.Generator) -> MetricEstimate:
    """The bas-relief: half or double the focal, and the scene as deep as suits it."""
    factor = float(rng.choice([0.5, 2.0]))
    z = model.cameras.R[rng.choice(np.flatnonzero(model.registered)), 2]
    H = np.eye(4)
    H[:3, :3] += (factor - 1.0) * np.outer(z, z)
    return _transformed(model, H, factor)


CORRUPTIONS: dict[str, Callable[[MetricEstimate, np.random.Generator], MetricEstimate]] = {
    "one camera moved": lambda model, rng: move_cameras(
        model, rng, rng.choice(np.flatnonzero(model.registered), 1), 20.0
    ),
    "two cameras swapped": two_swapped,
    # Adjustment then ends in a local minimum.
    "all cameras moved": lambda model, rng: move_cameras(model, rng, np.flatnonzero(model.registered), 8.0),
    "mirrored": mirrored,
    "wrong plane at infinity": wrong_infinity,
    "focal halved or doubled": wrong_focal,
}  # Reconstruction errors by name
SCENES = ("courtyard", "fountain-P11", "Herz-Jesus-P8", "kermit")
LATE, ANGLE, ROUNDS = 7.0, np.radians(0.05), 3
WRONG_FOCAL, WRONG_CENTRE, WRONG_TURN_DEG = 0.03, 0.03, 1.0
Outcome = tuple[bool, bool] | None
"""Whether a corrupted or reduced model is wrong in truth, and rejected by the self-check; None if nothing is
left."""


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


def judge(
    model: MetricEstimate, right: MetricEstimate, calibration: SelfCalibration, adjustment: MetricAdjustment
) -> Outcome:
    """Settle a model and test it, its intervals as narrow as can be; None if nothing is left."""
    settled = settle(model, adjustment)
    if settled is None:
        return None
    try:
        (model, adjustment, *_), sharing, *_ = settle_camera_model(finish_metric(settled, adjustment))
    except StageFailure:
        return None
    focals = model.cameras.intrinsics[model.cameras.group, 0]
    stated = [{"focal_px": IntrinsicInterval(float(focal), 0.0, "")} for focal in focals]
    failed = sharing.failed_checks or self_check(model, calibration.K, stated, sigmas=LATE)[1]
    return is_wrong(model, right), bool(failed or contradicted_focal_priors(model, adjustment))


def corrupted_outcomes(result: RunResult, prior: IntrinsicsPrior, seeds: int) -> dict[str, list[Outcome]]:
    assert result.metric is not None
    assert result.calibration is not None
    adjustment, calibration = MetricAdjustment(prior, 0.02, 0.02), result.calibration
    right = settle(model_from_reconstruction(result.metric.reconstruction, prior), adjustment)
    assert right is not None
    found: dict[str, list[Outcome]] = defaultdict(list)
    for number, (name, corrupt) in enumerate(CORRUPTIONS.items()):
        for seed in range(seeds):
            bad = corrupt(right, np.random.default_rng([seed, number]))
            found[name].append(judge(bad, right, calibration, adjustment))
    fixed, fixed_prior = _fixed_focal(right, prior)
    off = judge(fixed, right, calibration, MetricAdjustment(fixed_prior, 0.02, 0.02))
    found["focal length fixed 10 % off"].append(off)
    found["right, as it is"].append(judge(right, right, calibration, adjustment))
    # Few views with a focal each leave the focals open, which only their intervals show.
    one_camera = len(np.unique(prior.shared[:, 0])) == 1
    for seed in range(seeds if one_camera else 0):
        some = _reduced(right, np.random.default_rng([seed, 99]))
        found["right, some views and points"].append(judge(some, right, calibration, adjustment))
    return found


def _fixed_focal(model: MetricEstimate, prior: IntrinsicsPrior) -> tuple[MetricEstimate, IntrinsicsPrior]:
    intrinsics = model.cameras.intrinsics.copy()
    intrinsics[:, 0] *= 1.1
    mean, std = prior.mean.copy(), prior.std.copy()
    mean[:, 0], std[:, 0] = intrinsics[model.cameras.group, 0], 0.0
    return (
        replace(model, cameras=replace(model.cameras, intrinsics=intrinsics)),
        replace(prior, mean=mean, std=std),
    )


def _reduced(model: MetricEstimate, rng: np.random.Generator) -> MetricEstimate:
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
    table: dict[str, list[Outcome]] = defaultdict(list)
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
        counts = Counter(outcomes)
        wrong, right = (counts[w, True] + counts[w, False] for w in (True, False))
        found = [len(outcomes), counts[None], wrong, counts[True, True], right, counts[False, True]]
        lines.append([kind, *found])
    yield text_table(["made", "models", "nothing left", "wrong", "rejected", "right", "rejected"], lines)
    every = [o for outcomes in table.values() for o in outcomes if o is not None]
    for name, bounds in {"wrong": {"at_least": 100.0}, "right": {"at_most": 2.0}}.items():
        values = [100.0 * o[1] for o in every if o[0] is (name == "wrong")]
        rows = Rows(f"{len(values)} {name}", "ours")
        rows.add("rejected", float(np.mean(values)), "%", **bounds)
        yield rows
