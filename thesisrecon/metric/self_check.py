"""The self-check: numbers that would be off if the answer were wrong, and a sentence for each that is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from thesisrecon.metric.model import MetricModel, agreeing_observations, residual_norms
from thesisrecon.robust.noise import noise_from_distances
from thesisrecon.types import IntrinsicInterval, SelfCalibration

_FOCAL_RANGE = (0.2, 20.0)
_MAX_FOCAL_STD = 0.15
_MIN_EXPLAINED = 0.6
_MAX_SIGMA_REL = 0.0015
_MAX_PRINCIPAL_SHIFT = 0.06
_MAX_FOCAL_CHANGE = 0.25


def self_check(
    model: MetricModel,
    calibration: SelfCalibration,
    intervals: Sequence[Mapping[str, IntrinsicInterval]],
    *,
    sigmas: float,
) -> tuple[dict[str, float], list[str]]:
    """Measured numbers by name, and the doubts they raise (none: the answer is trusted)."""
    views = [int(v) for v in np.flatnonzero(model.registered)]
    longest = model.sizes[views].max(axis=1)
    rows = model.cameras.intrinsics[model.cameras.group[views]]
    near = model.registered[model.tracks.view_index]
    before = calibration.K[views, 0, 0]
    both = before > 0
    check = {
        "focal_min_long_sides": float((rows[:, 0] / longest).min()),
        "focal_max_long_sides": float((rows[:, 0] / longest).max()),
        "focal_std_rel_max": max(
            intervals[v]["focal_px"].std / intervals[v]["focal_px"].value for v in views
        ),
        "explained_share": float(agreeing_observations(model, sigmas=sigmas)[near].mean()),
        "sigma_rel": float(noise_from_distances(residual_norms(model)) / np.median(longest))
        if model.ok.any()
        else np.inf,
        "principal_shift_max_long_sides": float(
            (np.linalg.norm(rows[:, 3:5] - (model.sizes[views] - 1) / 2, axis=1) / longest).max()
        ),
        "focal_change_since_calibration": float(np.abs(np.log(rows[both, 0] / before[both])).max())
        if both.any()
        else 0.0,
    }
    return check, _doubts(check, calibration)


def _doubts(check: Mapping[str, float], calibration: SelfCalibration) -> list[str]:
    doubts = list(calibration.reasons) if not calibration.identifiable else []
    low, high = check["focal_min_long_sides"], check["focal_max_long_sides"]
    if not (_FOCAL_RANGE[0] < low and high < _FOCAL_RANGE[1]):
        doubts.append(f"a focal length of {low:.2f} to {high:.2f} long sides is not that of a photograph")
    if not check["focal_std_rel_max"] < _MAX_FOCAL_STD:
        doubts.append(f"a focal length is known only to {check['focal_std_rel_max']:.0%}")
    if not check["explained_share"] > _MIN_EXPLAINED:
        doubts.append(f"the model explains only {check['explained_share']:.0%} of the matches it should")
    if not check["sigma_rel"] < _MAX_SIGMA_REL:
        doubts.append(f"the reprojection noise is {check['sigma_rel']:.2%} of the long side")
    shift = check["principal_shift_max_long_sides"]
    if not shift < _MAX_PRINCIPAL_SHIFT:
        doubts.append(f"the principal point lies {shift:.0%} of the long side off the image centre")
    if not check["focal_change_since_calibration"] < _MAX_FOCAL_CHANGE:
        doubts.append(
            f"bundle adjustment moved the focal by {check['focal_change_since_calibration']:.0%} "
            "from what self-calibration found"
        )
    return doubts
