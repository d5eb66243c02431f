"""Critical motions: whether they are named, exact and by hand, and general motions are not.

Every trial is a random scene (:mod:`validation.scenes.critical`) with noisy tracks, the projective
maximum-likelihood reconstruction, self-calibration and its identifiability report. Without parallax, pairs of
views are verified first, as in the pipeline; a refusal that names the motion counts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from thesisrecon.config.intrinsics import IntrinsicsOptions, prior_for
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.epipolar.verification import PairVerification
from thesisrecon.errors import StageFailure
from thesisrecon.projective._model import require_pair_with_parallax
from thesisrecon.records import Matches, TwoView
from thesisrecon.selfcalibration.quadric import HypothesesAndRefinement
from validation.runs.study import Part, pick, report_progress
from validation.runs.tables import Metric, Rows, text_table
from validation.scenes.critical import Motion, make_sequence, projective_estimate
from validation.scenes.critical import Sequence as SyntheticSequence


class FewHypotheses(HypothesesAndRefinement):
    """The default with fewer hypotheses, because thousands of trials measure its report only."""

    camera_subsets, focal_steps = 0, 17


CALIBRATOR = FewHypotheses(search=None)
ZOOM = 0.3
PLANAR_OR_TURNTABLE = (Motion.TURNTABLE, Motion.PLANAR)


class Trial(NamedTuple):
    """One scene: the reported critical motion, empty for none; whether the focal length is reported as
    identifiable; |log f / f_true| of the median view, NaN without an answer.
    """

    named: str
    identifiable: bool
    focal_error: float


def run_trial(motion: Motion, seed: int, *, by_hand: bool, zoom: float) -> Trial:
    """Run one scene through the stages that can name its motion."""
    rng = np.random.default_rng([seed, list(Motion).index(motion), int(by_hand), int(zoom > 0.0)])
    scene = make_sequence(motion, rng, by_hand=by_hand, zoom=zoom)
    try:
        if motion in (Motion.ROTATION, Motion.PLANE):
            require_pair_with_parallax(_neighbours(scene, rng))
        reconstruction = projective_estimate(scene, rng)
        options = IntrinsicsOptions(cameras="per-image" if zoom else "shared")
        report = CALIBRATOR.calibrate(
            reconstruction, prior=prior_for(reconstruction, options), rng=rng
        ).identifiability
    except StageFailure as failure:
        said = [name.value for name in Motion if name.value in str(failure) and name is not Motion.GENERAL]
        return Trial(" or ".join(said) or "refused without a name", False, np.nan)
    assert report is not None
    truth = float(np.median(scene.K[:, 0, 0] / scene.sizes.max(axis=1)))
    found = report.evidence.get("focal_long_sides", np.nan)
    return Trial(
        report.motion if report.critical else "", report.identifiable, abs(float(np.log(found / truth)))
    )


def _neighbours(scene: SyntheticSequence, rng: np.random.Generator, *, most: int = 4) -> list[TwoView]:
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


def check_motion(
    motion: Motion, trials: Sequence[Trial], *, by_hand: bool, zoom: float
) -> tuple[list[Metric], list[object]]:
    """Return the judged rows and a row of the table of all motions."""
    kind, focal = "by hand" if by_hand else "exact", "zooming" if zoom else "one"
    rows, n = Rows(f"{motion.value}, {kind}, {'zooming' if zoom else 'one focal'}", "ours"), len(trials)
    wrong = 100.0 * sum(t.identifiable and not t.focal_error < 0.15 for t in trials) / n
    sure = [t.focal_error for t in trials if t.identifiable]
    named = 0.0
    if motion is Motion.GENERAL:
        alarms = 100.0 * sum(bool(t.named) or not t.identifiable for t in trials) / n
        rows.add("false alarms", alarms, "%", at_most=2.0)
    else:
        # Planar motion includes the turntable.
        alike = PLANAR_OR_TURNTABLE if motion in PLANAR_OR_TURNTABLE else (motion,)
        right = {kind.value for kind in alike}
        named = 100.0 * sum(bool(right & set(t.named.split(" or "))) for t in trials) / n
        rows.add("named", named, "%", at_least=95.0)
    rows.add("called identifiable, focal off by 15 %", wrong, "%")
    names = ", ".join(f"{name or 'none'} {k}" for name, k in Counter(t.named for t in trials).most_common())
    error = f"{100.0 * float(np.median(sure)):.2f}" if sure else "-"
    shares = [f"{named:.1f}", f"{100.0 * len(sure) / n:.1f}", error, f"{wrong:.1f}"]
    return rows, [motion.value, kind, focal, *shares, names]


HEAD = ["motion", "made", "focal", "named %", "identifiable %", "its focal error %", "wrong %", "names"]


def critical_motions_study(
    trials: int = 200,
    workers: int = 1,
    zoom: Literal["no", "yes", "both"] = "both",
    motions: Sequence[str] | None = None,
) -> Iterator[Part]:
    """Count critical motions that are named and general motions that are not."""
    names = pick(motions, [motion.name.lower() for motion in Motion])
    lines, judged = [], list[list[Metric]]()
    with ProcessPoolExecutor(workers) as pool:
        for factor in {"no": [0.0], "yes": [ZOOM], "both": [0.0, ZOOM]}[zoom]:
            for motion in (Motion[name.upper()] for name in names):
                for by_hand in (False, True) if motion is not Motion.GENERAL else (False,):
                    run = partial(run_trial, motion, by_hand=by_hand, zoom=factor)
                    done = list(pool.map(run, range(trials), chunksize=5))
                    block, line = check_motion(motion, done, by_hand=by_hand, zoom=factor)
                    judged.append(block)
                    lines.append(line)
                    report_progress(" | ".join(map(str, line)))
    yield text_table(HEAD, lines)
    yield from judged
