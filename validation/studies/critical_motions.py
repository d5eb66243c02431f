"""Critical motions: are they named, exact and as made by hand, and are general motions left alone.

Every trial is a random scene (:mod:`validation.scenes.critical`), its noisy tracks, the projective
reconstruction of maximum likelihood, self-calibration and its verdict. Where the cameras have no parallax,
pairs of views are estimated and verified first, as the pipeline does, and its refusal counts as naming where
it says the name. The dinosaur on its turntable ends the list.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence as Many
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.epipolar.verification import PairVerification
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.triangulation import triangulate_observations
from thesisrecon.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.numerics.projective_bundle import refine_projective_bundle
from thesisrecon.projective.initial_pair import require_pair_with_parallax
from thesisrecon.records import IdentifiabilityReport, Matches, Reconstruction, TwoView
from thesisrecon.selfcalibration.hypotheses import HypothesesAndRefinement
from validation.metrics.record import Metric, markdown_table
from validation.scenes.critical import Motion, Sequence, make_sequence, projective_estimate
from validation.scenes.dinosaur import Dinosaur, load_dinosaur

OURS = "ours"
CALIBRATOR = HypothesesAndRefinement(search=None, camera_subsets=0, focal_steps=17)
"""The default with fewer hypotheses: the verdict is what is measured, and 6000 trials must end."""
ZOOM = 0.3
WRONG_FOCAL = 0.15
PLANAR_OR_TURNTABLE = (Motion.TURNTABLE, Motion.PLANAR)
WITHOUT_PARALLAX = (Motion.ROTATION, Motion.PLANE)


@dataclass(frozen=True)
class Trial:
    """``named``: the critical motion that was told, empty for none; ``identifiable`` the verdict;
    ``focal_error`` of the adjusted focal (median over the views, relative), NaN without an answer."""

    named: str
    identifiable: bool
    focal_error: float


def run_trial(motion: Motion, seed: int, *, by_hand: bool, zoom: float) -> Trial:
    """One scene through the stages that can name its motion."""
    rng = np.random.default_rng([seed, list(Motion).index(motion), int(by_hand), int(zoom > 0.0)])
    scene = make_sequence(motion, rng, by_hand=by_hand, zoom=zoom)
    try:
        if motion in WITHOUT_PARALLAX:
            require_pair_with_parallax(_neighbours(scene, rng))
        reconstruction = projective_estimate(scene, rng)
        wish = IntrinsicsOptions(cameras="per-image" if zoom else "shared")
        verdict = CALIBRATOR.calibrate(reconstruction, prior=prior_for(reconstruction, wish), rng=rng).verdict
    except StageFailure as failure:
        said = [name.value for name in Motion if name.value in str(failure) and name is not Motion.GENERAL]
        return Trial(" or ".join(said) or "refused without a name", False, np.nan)
    assert verdict is not None
    truth = float(np.median(scene.K[:, 0, 0] / scene.sizes.max(axis=1)))
    found = verdict.evidence.get("focal_long_sides", np.nan)
    return Trial(
        verdict.motion if verdict.critical else "", verdict.identifiable, abs(float(np.log(found / truth)))
    )


def _neighbours(scene: Sequence, rng: np.random.Generator, *, most: int = 4) -> list[TwoView]:
    """The first pairs of neighbours, estimated and verified."""
    t = scene.tracks
    table = np.full((t.n_views, t.n_points), -1)
    table[t.view_index, t.point_index] = np.arange(len(t.xy))
    pairs = []
    for i in range(min(most, t.n_views - 1)):
        both = np.flatnonzero((table[i] >= 0) & (table[i + 1] >= 0))
        if len(both) < 16:
            continue
        n = len(both)
        matches = Matches(
            i, i + 1, both, both, t.xy[table[i, both]], t.xy[table[i + 1, both]],
            np.ones(n, dtype=np.float32), np.tile(np.eye(2), (n, 1, 1)),
        )  # fmt: skip
        fit = LocallyOptimisedRansac().estimate(matches.xy1, matches.xy2, rng)
        pairs.append(PairVerification(min_inliers=16).verify(matches, fit, rng))
    return pairs


def is_named(motion: Motion, named: str) -> bool:
    """Whether a name is right: planar motion and the turntable, which is one, count as one."""
    if motion in PLANAR_OR_TURNTABLE:
        return named in {kind.value for kind in PLANAR_OR_TURNTABLE}
    return motion.value in named.split(" or ")


def check_motion(
    motion: Motion, trials: Many[Trial], *, by_hand: bool, zoom: float
) -> tuple[list[Metric], str]:
    """Rows beside their targets, and a line of a table that tells all."""
    kind = "by hand" if by_hand else "exact"
    scene = f"{motion.value}, {kind}, {'zooming' if zoom else 'one focal'}"
    n = len(trials)
    wrong = sum(t.identifiable and not t.focal_error < WRONG_FOCAL for t in trials)
    sure = [t.focal_error for t in trials if t.identifiable]
    told = ", ".join(
        f"{name or 'none'} {count}" for name, count in Counter(t.named for t in trials).most_common()
    )
    if motion is Motion.GENERAL:
        alarms = sum(bool(t.named) or not t.identifiable for t in trials)
        rows = [Metric(scene, "false alarms", "%", {OURS: 100.0 * alarms / n}, OURS, 2.0)]
        named = 0
    else:
        named = sum(is_named(motion, t.named) for t in trials)
        rows = [Metric(scene, "named", "%", {OURS: 100.0 * named / n}, OURS, 95.0, at_most=False)]
    rows.append(Metric(scene, "called identifiable, focal off by 15 %", "%", {OURS: 100.0 * wrong / n}, OURS))
    error = f"{100.0 * float(np.median(sure)):.2f}" if sure else "-"
    line = (
        f"| {motion.value} | {kind} | {'zooming' if zoom else 'one'} | {100.0 * named / n:.1f} | "
        f"{100.0 * len(sure) / n:.1f} | {error} | {100.0 * wrong / n:.1f} | {told} |"
    )
    return rows, line


def dinosaur_verdict(reconstruction: Reconstruction, *, cameras: str = "shared") -> IdentifiabilityReport:
    """The verdict on projective cameras of the dinosaur; ``StageFailure`` where there is none."""
    wish = IntrinsicsOptions(cameras="per-image" if cameras == "per-image" else "shared")
    answer = HypothesesAndRefinement().calibrate(
        reconstruction, prior=prior_for(reconstruction, wish), rng=np.random.default_rng(0)
    )
    assert answer.verdict is not None
    return answer.verdict


def published_reconstruction(dinosaur: Dinosaur) -> Reconstruction:
    """The published cameras with their tracks triangulated and adjusted."""
    t = dinosaur.tracks
    seen = np.bincount(t.point_index, minlength=t.n_points) >= 3
    keep = seen[t.point_index]
    view, point, xy = t.view_index[keep], t.point_index[keep], t.xy[keep]
    X = triangulate_observations(dinosaur.P, view, point, xy, t.n_points)
    fit = refine_projective_bundle(dinosaur.P, X, view, point, xy, max_iterations=30)
    inlier = np.zeros(len(t.xy), dtype=bool)
    inlier[np.flatnonzero(keep)] = np.linalg.norm(fit.residual_px, axis=1) < 2.0
    n = len(dinosaur.P)
    sigma = float(np.median(np.linalg.norm(fit.residual_px, axis=1))) / 1.18
    return Reconstruction(
        "projective", fit.P, fit.X, np.ones(n, dtype=bool), seen, inlier, t, dinosaur.sizes, sigma, ("",) * n
    )


def main() -> int:
    """Print the tables; 1 where a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--zoom", choices=["no", "yes", "both"], default="both")
    names = [motion.name.lower() for motion in Motion]
    parser.add_argument("--motions", nargs="+", choices=names, default=names)
    wishes = parser.parse_args()
    rows: list[Metric] = []
    print("| motion | made | focal | named % | identifiable % | its focal error % | wrong % | names |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |", flush=True)
    zooms = {"no": [0.0], "yes": [ZOOM], "both": [0.0, ZOOM]}[wishes.zoom]
    with ProcessPoolExecutor(wishes.workers) as pool:
        for zoom in zooms:
            for motion in (Motion[name.upper()] for name in wishes.motions):
                for by_hand in (False, True) if motion is not Motion.GENERAL else (False,):
                    run = partial(run_trial, motion, by_hand=by_hand, zoom=zoom)
                    trials = list(pool.map(run, range(wishes.trials), chunksize=5))
                    block, line = check_motion(motion, trials, by_hand=by_hand, zoom=zoom)
                    rows += block
                    print(line, flush=True)
    print("", *(markdown_table([row]) for row in rows if row.verdict == "missed"), sep="\n\n")
    dinosaur = load_dinosaur()
    if dinosaur is not None:
        for cameras in ("shared", "per-image"):
            verdict = dinosaur_verdict(published_reconstruction(dinosaur), cameras=cameras)
            numbers = ", ".join(f"{name} {value:.3g}" for name, value in verdict.evidence.items())
            told = "; ".join(verdict.sentences)
            print(f"\ndinosaur, {cameras}: {verdict.motion}, critical {verdict.critical}: {told} ({numbers})")
    return int(any(row.verdict == "missed" for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
