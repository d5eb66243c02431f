"""The self-check: numbers that would be off if the answer were wrong, and a sentence for each that is.

Averages hide a wrong camera, hence every photograph is also looked at alone
(:mod:`~thesisrecon.metric.view_checks`). Views are named by their number: "view 10" is ``images[10]``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from thesisrecon.metric.model import MetricModel, agreeing_observations, residual_norms
from thesisrecon.metric.model_error import USUAL_INFLATION
from thesisrecon.metric.view_checks import ViewChecks, check_views, within_reach
from thesisrecon.robust.noise import noise_from_distances
from thesisrecon.types import B8, F64, I64, IntrinsicInterval, SelfCalibration

_FOCAL_RANGE = (0.2, 20.0)
_MAX_FOCAL_STD = 0.15
_MIN_EXPLAINED = 0.6
_MAX_SIGMA_REL = 0.0015
# Cutting a tenth off the middle of a photograph each way moves its principal point by 0.12 long sides.
_MAX_PRINCIPAL_SHIFT = 0.15
_MAX_FOCAL_CHANGE = 0.25

MIN_EXPLAINED_OF_VIEW = 0.5
"""Of its matches, those with a wrong partner included; a right camera explains nearly all of the others."""
MIN_CONFIRMED_OF_VIEW = 0.7
"""Of the points that others fix. Right cameras reach 0.9 and more, wrong ones stay below a half."""
MAX_BEHIND = 0.05
MAX_NOISE_RATIO = 3.0
MAX_OWN_FOCAL = 0.03
MAX_OWN_SIGMAS = 5.0


def self_check(
    model: MetricModel,
    calibration: SelfCalibration,
    intervals: Sequence[Mapping[str, IntrinsicInterval]],
    *,
    sigmas: float,
) -> tuple[dict[str, float], list[str]]:
    """Measured numbers by name, and the doubts they raise (none: the answer is trusted).

    ``sigmas`` is the gate, in noise sigmas, of an observation that agrees with the model.
    """
    check = _whole(model, calibration, intervals, sigmas)
    views = check_views(model, sigmas=sigmas)
    own = _own_focal_sigmas(views)
    check |= {
        "explained_share_worst_view": _worst(views.explained, np.nanmin),
        "confirmed_share_worst_view": _worst(views.confirmed, np.nanmin),
        "behind_share_worst_view": _worst(views.behind, np.nanmax),
        "noise_ratio_worst_view": _worst(_noise_ratio(views), np.nanmax),
        "own_focal_off_worst_view": _worst(np.abs(views.focal_off), np.nanmax),
        "own_focal_sigmas_worst_view": _worst(own, np.nanmax),
    }
    doubts = list(calibration.reasons) if not calibration.identifiable else []
    return check, [*doubts, *_doubts_of_views(views, model), *_doubts(check)]


def _whole(
    model: MetricModel,
    calibration: SelfCalibration,
    intervals: Sequence[Mapping[str, IntrinsicInterval]],
    sigmas: float,
) -> dict[str, float]:
    """The numbers of the model as a whole."""
    views = [int(v) for v in np.flatnonzero(model.registered)]
    longest = model.sizes[views].max(axis=1)
    rows = model.cameras.intrinsics[model.cameras.group[views]]
    near = within_reach(model)
    before = calibration.K[views, 0, 0]
    both = before > 0
    return {
        "focal_min_long_sides": float((rows[:, 0] / longest).min()),
        "focal_max_long_sides": float((rows[:, 0] / longest).max()),
        "focal_std_rel_max": max(
            intervals[v]["focal_px"].std / intervals[v]["focal_px"].value for v in views
        ),
        "explained_share": float(agreeing_observations(model, sigmas=sigmas)[near].mean())
        if near.any()
        else 0.0,
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


def _worst(values: F64, worst: Callable[[F64], float]) -> float:
    """The worst of the values that are known; NaN where none is."""
    return float(worst(values)) if np.isfinite(values).any() else np.nan


def _noise_ratio(views: ViewChecks) -> F64:
    """Noise of each view over the median of all."""
    known = views.noise_px[np.isfinite(views.noise_px)]
    return np.asarray(views.noise_px / max(float(np.median(known)), 1e-9) if len(known) else views.noise_px)


def _own_focal_sigmas(views: ViewChecks) -> F64:
    return np.asarray(np.abs(views.focal_off) / np.maximum(USUAL_INFLATION * views.focal_off_std, 1e-9))


def _doubts_of_views(views: ViewChecks, model: MetricModel) -> list[str]:
    """A sentence for the views that are doubted for one reason; of several reasons a view has the gravest."""
    ratio, own = _noise_ratio(views), _own_focal_sigmas(views)
    left = model.registered.copy()

    def take(bad: B8) -> I64:
        taken = np.flatnonzero(left & bad)
        left[taken] = False
        return taken

    doubts = []
    if len(wrong := take(views.confirmed < MIN_CONFIRMED_OF_VIEW)):
        doubts.append(
            f"{_named(wrong)}: only {_range(views.confirmed[wrong])} of the points that other views fix are "
            "where they are seen; the camera is wrong or its matches are: leave the photograph out, or take "
            "others between it and the rest"
        )
    if len(wrong := take(~(views.explained >= MIN_EXPLAINED_OF_VIEW))):
        doubts.append(
            f"{_named(wrong)}: the model explains only {_range(views.explained[wrong])} of the matches; the "
            "camera is wrong, or that of the views it is matched with"
        )
    if len(wrong := take(views.behind > MAX_BEHIND)):
        doubts.append(f"{_named(wrong)}: {_range(views.behind[wrong])} of the points lie behind the camera")
    for view in take((np.abs(views.focal_off) > MAX_OWN_FOCAL) & (own > MAX_OWN_SIGMAS)):
        off = float(np.expm1(views.focal_off[view]))
        doubts.append(
            f"view {view} alone asks for a focal length {abs(off):.1%} "
            f"{'longer' if off > 0.0 else 'shorter'} than the model's: it is of another camera or zoomed, "
            "or the model is bent"
        )
    if len(wrong := take(ratio > MAX_NOISE_RATIO)):
        doubts.append(
            f"{_named(wrong)}: explained with {ratio[wrong].max():.1f} times the noise of the others"
        )
    return doubts


def _named(views: I64) -> str:
    """ "view 3" or "views 1, 4 and 7"."""
    numbers = [str(int(view)) for view in views]
    if len(numbers) == 1:
        return f"view {numbers[0]}"
    return f"views {', '.join(numbers[:-1])} and {numbers[-1]}"


def _range(shares: F64) -> str:
    low, high = (f"{100.0 * np.nan_to_num(edge(shares)):.0f}" for edge in (np.min, np.max))
    return f"{low} %" if low == high else f"{low} to {high} %"


def _doubts(check: Mapping[str, float]) -> list[str]:
    """The doubts about the model as a whole."""
    doubts = []
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
