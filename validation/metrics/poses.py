"""Relative poses of pairs of cameras, without a common frame: recall over thresholds, AUC and mAA.

The error of a pair is the larger one of the angles of its relative rotation and of its direction of
translation (Jin et al. 2021, IMW), as in the benchmarks of SuperGlue, COLMAP and HLoc.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64, I64

AUC_DEG = (0.1, 0.5, 1.0, 3.0, 5.0, 10.0, 20.0)
STEPS = 100
"""Thresholds of a recall curve, from zero to the largest of :data:`AUC_DEG`."""


def relative_pose_errors(R: F64, C: F64, R_true: F64, C_true: F64) -> F64:
    """Errors (V (V - 1) / 2,) in degrees of all pairs i < j of cameras.

    R (V, 3, 3) are world-to-camera, C (V, 3) centres. A pair of which a camera is missing (NaN) in the first
    model has an infinite error; one that is missing in the truth is left out, and a pair with one true centre
    is judged by its rotation.
    """
    known = np.isfinite(C_true).all(axis=1) & np.isfinite(R_true).all(axis=(1, 2))
    pairs = np.array(list(combinations(np.flatnonzero(known), 2)), dtype=np.int64).reshape(-1, 2)
    i, j = pairs.T
    (turn, step), (turn_true, step_true) = (_relative(*given, i, j) for given in ((R, C), (R_true, C_true)))
    errors = np.full(len(pairs), np.inf)
    there = np.isfinite(step).all(axis=1) & np.isfinite(turn).all(axis=(1, 2))
    between = np.swapaxes(turn_true[there], 1, 2) @ turn[there]
    rotation = Rotation.from_matrix(between).magnitude() if there.any() else np.zeros(0)
    lengths = np.linalg.norm(step[there], axis=1), np.linalg.norm(step_true[there], axis=1)
    sine = np.linalg.norm(np.cross(step[there], step_true[there]), axis=1)
    direction = np.arctan2(sine, np.sum(step[there] * step_true[there], axis=1))
    extent = max(float(np.linalg.norm(step_true, axis=1).max(initial=0.0)), 1e-300)
    direction = np.where(lengths[1] > 1e-9 * extent, direction, 0.0)
    errors[there] = np.degrees(np.maximum(rotation, direction))
    return errors


def _relative(R: F64, C: F64, i: I64, j: I64) -> tuple[F64, F64]:
    """Rotations from camera i to camera j and the centres of j in the frames of i."""
    return R[j] @ np.swapaxes(R[i], 1, 2), np.einsum("kab,kb->ka", R[i], C[j] - C[i])


def recall(errors: F64, thresholds: F64) -> F64:
    """Share of the errors of at most each threshold."""
    if not len(errors):
        return np.asarray(thresholds) * np.nan
    return np.asarray((errors[:, None] <= np.asarray(thresholds)).mean(axis=0))


def area_under_recall(errors: F64, threshold: float) -> float:
    """Area under the recall curve up to a threshold, over it: the mean of max(0, 1 - e / threshold)."""
    return float(np.maximum(1.0 - errors / threshold, 0.0).mean()) if len(errors) else float("nan")


def pose_scores_pct(errors: F64) -> dict[str, float]:
    """AUC at every threshold and mAA(10 degrees), in percent, by the names of the ablations."""
    areas = {f"auc{at:g}_pct": 100.0 * area_under_recall(errors, at) for at in AUC_DEG}
    return {**areas, "maa_pct": 100.0 * mean_accuracy(errors)}


def mean_accuracy(errors: F64, up_to: int = 10) -> float:
    """Mean of the recalls at 1, 2, ... ``up_to`` degrees (mAA)."""
    return float(recall(errors, np.arange(1.0, up_to + 1.0)).mean())
