"""What every method of chapter 7 ends with: answers are turned into upgrades, checked and judged.

A method gives a plane at infinity and calibrations; here the scene is put in front of the cameras, answers
that cannot are dropped, and the verdict on the motion is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import ParamSpec

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.records import Reconstruction, SelfCalibration, Upgrade
from thesisrecon.selfcalibration.frame import ReferenceFrame, metric_from_calibration
from thesisrecon.selfcalibration.identifiability import check_identifiability, verdict_without_an_answer
from thesisrecon.selfcalibration.refinement import RotationCriterion, focal_std

P = ParamSpec("P")

SAME_ANSWER = 0.03
"""Answers whose log focals differ by less than this are one."""

MAX_LOG_STD = 1e3

FOCAL_LIMITS = (0.02, 200.0)
"""No lens has a focal length outside of these, in long sides of the image: 178 deg to 0.3 deg of view."""


def log_focals_of(frame: ReferenceFrame, K: F64) -> F64:
    """Log focals (G,) of the camera groups of calibrations K (R, 3, 3), each the median of its views."""
    log_f = 0.5 * np.log(K[:, 0, 0] * K[:, 1, 1])
    return np.array([np.median(log_f[frame.group == g]) for g in range(frame.n_groups)])


@dataclass(frozen=True)
class Answer:
    """A plane at infinity (3,) and unit-free calibrations ``K`` (R, 3, 3) in a reference frame, the ``cost``
    by which answers are ordered, the ``method`` they come from, and the deviations ``K_std`` (R, 3, 3) of K,
    None where the method has none."""

    plane: F64
    K: F64
    cost: float
    method: str
    K_std: F64 | None = None

    def log_focals(self, frame: ReferenceFrame) -> F64:
        """Log focals (G,) of the camera groups, each the median of its views."""
        return log_focals_of(frame, self.K)


def guarded(calibrate: Callable[P, SelfCalibration]) -> Callable[P, SelfCalibration]:
    """A ``calibrate`` whose decompositions end in a ``StageFailure`` where they do not converge.

    Numbers that overflow on the way make hypotheses without a finite cost, which never win; they warn nobody.
    """

    @wraps(calibrate)
    def inner(*args: P.args, **kwargs: P.kwargs) -> SelfCalibration:
        with np.errstate(all="ignore"):
            try:
                return calibrate(*args, **kwargs)
            except np.linalg.LinAlgError as error:
                raise StageFailure(
                    "the projective cameras are not such that they can be calibrated",
                    f"a decomposition failed: {error}",
                    "photograph the scene from different places",
                ) from error

    return inner


def require_cameras(reconstruction: Reconstruction) -> None:
    """``StageFailure`` below three registered cameras."""
    n = int(reconstruction.registered.sum())
    if n < 3:
        raise StageFailure(
            "self-calibration needs at least 3 photographs that are tied together",
            f"{n} could be registered",
            "add photographs with more overlap",
        )


def square_calibrations(log_f: F64) -> F64:
    """Unit-free K (..., 3, 3) = diag(f, f, 1) of log focals (...)."""
    K = np.zeros((*np.shape(log_f), 3, 3))
    K[..., 0, 0] = K[..., 1, 1] = np.exp(log_f)
    K[..., 2, 2] = 1.0
    return K


def focals_of_groups(frame: ReferenceFrame, p: F64, f_reference: F64) -> F64:
    """Log focals (B, G) that suit planes p (B, 3) and reference focals (B,).

    From w*_i = H_i K_r K_r' H_i': f_i^2 = (w11 + w22) / (2 w33); a group takes the median of its cameras, the
    reference camera's group its own focal.
    """
    f = np.clip(f_reference, *FOCAL_LIMITS)
    H = frame.A[None] - frame.a[None, :, :, None] * p[:, None, None, :]
    H[..., :2] *= f[:, None, None, None]
    ww = np.sum(H**2, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_f = 0.5 * np.log((ww[..., 0] + ww[..., 1]) / (2.0 * ww[..., 2]))
    low, high = np.log(FOCAL_LIMITS)
    log_f = np.clip(np.nan_to_num(log_f, nan=0.0, posinf=high, neginf=low), low, high)
    groups = np.stack([np.median(log_f[:, frame.group == g], axis=1) for g in range(frame.n_groups)], axis=1)
    groups[:, frame.group[frame.reference]] = np.log(f)
    return groups


def answers_from_theta(frame: ReferenceFrame, theta: F64, cost: F64, method: str) -> list[Answer]:
    """Answers of rows theta (B, 3 + G) = (plane, log focals) with their costs (B,)."""
    K = square_calibrations(theta[:, 3:][:, frame.group])
    return [Answer(t[:3], k, float(c), method) for t, k, c in zip(theta, K, cost, strict=True)]


def distinct_answers(frame: ReferenceFrame, answers: Sequence[Answer], most: int) -> list[Answer]:
    """At most ``most`` answers of finite cost whose log focals or planes differ, the best first."""

    def same(one: Answer, other: Answer) -> bool:
        apart = np.linalg.norm(one.plane - other.plane) > SAME_ANSWER * np.linalg.norm(one.plane)
        return not apart and np.abs(one.log_focals(frame) - other.log_focals(frame)).max() < SAME_ANSWER

    chosen: list[Answer] = []
    for answer in sorted(answers, key=lambda a: a.cost):
        if len(chosen) == most or not np.isfinite(answer.cost):
            break
        if not any(same(answer, other) for other in chosen):
            chosen.append(answer)
    return chosen


def conclude(
    frame: ReferenceFrame,
    reconstruction: Reconstruction,
    criterion: RotationCriterion,
    answers: Sequence[Answer],
    *,
    kept: int,
    min_positive: float,
) -> SelfCalibration:
    """The ``kept`` best distinct answers with at least the share ``min_positive`` of the points in front of
    the cameras, and the verdict on the motion under ``frame.assumed``; ``StageFailure`` where none is left.
    """
    if frame.assumed is None:
        raise ValueError("a conclusion needs a frame that knows what is assumed: see assumed_frame")
    chosen = _distinct_upgrades(frame, reconstruction, answers, kept, min_positive)
    if not chosen:
        raise _nothing_in_front(frame, reconstruction, len(answers))
    answer, best = chosen[0]
    theta = np.concatenate([answer.plane, answer.log_focals(frame)])
    std_log_f, _ = focal_std(criterion, frame, theta)
    verdict = check_identifiability(reconstruction, best, frame.assumed)
    K_std = _deviations(frame, best.K, answer, np.minimum(std_log_f[frame.group], MAX_LOG_STD))
    return SelfCalibration(
        best.metric_from_projective, best.K, K_std, verdict.identifiable,
        () if verdict.identifiable else verdict.sentences, tuple(upgrade for _, upgrade in chosen), verdict,
    )  # fmt: skip


def _nothing_in_front(frame: ReferenceFrame, reconstruction: Reconstruction, tried: int) -> StageFailure:
    """The failure of a method none of whose answers can be carried out."""
    assert frame.assumed is not None
    evidence = f"{counted(tried, 'answer')} tried over {counted(len(frame.views), 'camera')}"
    given = frame.views[frame.assumed.focal_known[frame.views]]
    if len(given):
        # All answers were drawn to it: whoever gave a focal length cannot mend this by giving one.
        focal = frame.assumed.mean[given, 0]
        few = f"{focal.min():.0f}" if np.ptp(focal) < 0.5 else f"{focal.min():.0f} to {focal.max():.0f}"
        return StageFailure(
            "no calibration near the focal length that was given puts the scene in front of all cameras",
            f"{few} px (+- {frame.assumed.std[given, 0].max():.1%}) at working size was given; {evidence}",
            "the photographs contradict it: leave it out, or give it a larger focal_std_rel",
        )
    said = verdict_without_an_answer(reconstruction, frame.assumed).sentences
    return StageFailure(
        "no camera calibration puts the scene in front of all cameras",
        evidence,
        "; ".join(said) or "photograph the scene from more directions, turning the camera between shots",
    )


def _deviations(frame: ReferenceFrame, K: F64, answer: Answer, focal_std: F64) -> F64:
    """(V, 3, 3) deviations of K (V, 3, 3): those of the answer; else those of the focals and of what was
    assumed, where nothing but the focals was solved for; else NaN."""
    if answer.K_std is not None:
        unit = frame.pixel_from_unit[frame.views]
        K_std = np.zeros_like(K)
        # The last row of K is known, so that rows of the answer are rows of K in other units.
        K_std[frame.views] = np.diagonal(unit, axis1=1, axis2=2)[:, :, None] * answer.K_std
        return K_std
    K_std = square_std(frame, K, focal_std)
    focals_only = np.allclose(answer.K, square_calibrations(np.log(answer.K[:, 0, 0])), atol=1e-12)
    if not focals_only:
        K_std[frame.views[:, None], (0, 0, 0, 1, 1), (0, 1, 2, 1, 2)] = np.nan
    return K_std


def square_std(frame: ReferenceFrame, K: F64, focal_std: F64) -> F64:
    """(V, 3, 3) deviations of calibrations K (V, 3, 3) of which the focals alone were solved for.

    ``focal_std`` (R,) of the log focals; the rest has the deviation that was assumed of it, NaN where nothing
    was.
    """
    if frame.assumed is None:
        raise ValueError("deviations need a frame that knows what is assumed: see assumed_frame")
    K_std, rows = np.zeros_like(K), frame.views
    assumed = np.where(np.isfinite(frame.assumed.std), frame.assumed.std, np.nan)[rows]
    K_std[rows, 0, 0] = K[rows, 0, 0] * focal_std
    K_std[rows, 1, 1] = K[rows, 1, 1] * np.hypot(focal_std, assumed[:, 1] / frame.assumed.mean[rows, 1])
    K_std[rows, 0, 1], K_std[rows, 0, 2], K_std[rows, 1, 2] = assumed[:, 2:5].T
    return K_std


def _distinct_upgrades(
    frame: ReferenceFrame,
    reconstruction: Reconstruction,
    answers: Sequence[Answer],
    kept: int,
    min_positive: float,
) -> list[tuple[Answer, Upgrade]]:
    """The ``kept`` best answers of different focals that can be carried out, with their upgrades."""
    chosen: list[tuple[Answer, Upgrade]] = []
    for answer in sorted(answers, key=lambda a: a.cost):
        if len(chosen) == kept or not np.isfinite(answer.cost):
            break
        log_f = answer.log_focals(frame)
        if any(np.abs(log_f - other.log_focals(frame)).max() < SAME_ANSWER for other, _ in chosen):
            continue
        upgrade = upgrade_from_answer(frame, reconstruction, answer, min_positive)
        if upgrade is not None:
            chosen.append((answer, upgrade))
    return chosen


def upgrade_from_answer(
    frame: ReferenceFrame, reconstruction: Reconstruction, answer: Answer, min_positive: float
) -> Upgrade | None:
    """The upgrade of an answer, mirrored where most points are behind; None where it is singular or leaves
    less than ``min_positive`` of the observations in front."""
    K_reference = answer.K[frame.reference]
    if not (np.isfinite(answer.plane).all() and np.isfinite(answer.K).all()):
        return None
    G = metric_from_calibration(answer.plane, K_reference) @ frame.reference_from_projective
    if not np.isfinite(G).all() or abs(np.linalg.det(G)) < 1e-300:
        return None
    share = _share_in_front(reconstruction, G)
    if share < 0.5:
        G, share = np.diag([-1.0, -1.0, -1.0, 1.0]) @ G, 1.0 - share
    if share < min_positive:
        return None
    K = np.zeros((len(reconstruction.P), 3, 3))
    K[frame.views] = frame.pixel_from_unit[frame.views] @ answer.K
    return Upgrade(G, K, answer.cost, answer.method)


def _share_in_front(reconstruction: Reconstruction, G: F64) -> float:
    keep = reconstruction.inlier
    view, point = reconstruction.tracks.view_index[keep], reconstruction.tracks.point_index[keep]
    P = reconstruction.P @ np.linalg.inv(G)
    P *= np.where(np.linalg.det(P[:, :, :3]) < 0, -1.0, 1.0)[:, None, None]
    X = reconstruction.X @ G.T
    in_front = np.einsum("kj,kj->k", P[view, 2], X[point]) * X[point, 3] > 0
    return float(in_front.mean()) if len(in_front) else 0.0
