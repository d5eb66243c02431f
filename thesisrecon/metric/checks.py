"""What each photograph says of the model, alone: a wrong camera shows here and hides in averages.

The self-check: numbers that would be off if the answer were wrong, and a sentence for each that is.

Averages hide a wrong camera, hence every photograph is also looked at alone
(:mod:`~thesisrecon.metric.checks`). Views are named by their number: "view 10" is ``images[10]``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.metric.model import MetricModel, agreeing_observations, project_observations, residual_norms
from thesisrecon.metric.uncertainty import USUAL_INFLATION
from thesisrecon.numerics.noise import MAD_FACTOR, noise_from_distances
from thesisrecon.numerics.separate_refinement import refine_pose
from thesisrecon.records import IntrinsicInterval, SelfCalibration

OWN = np.array([True, True, False, False, False, False])
"""Focal and aspect: what a camera that is right gives back when nothing but its points is believed."""
MOST_OBSERVATIONS = 1500
FEWEST_OBSERVATIONS = 30
ONE_PLACE = 2e-3
"""Of the distance to the scene: photographs taken nearer together have no parallax to speak of."""
LEAST_LEFT = 0.1
"""Coordinates that keep less than this share of their variance say little of the noise."""


@dataclass(frozen=True)
class PerViewChecks:
    """Per view (V,), NaN where not registered or nothing could be measured.

    ``explained`` share of the observations within reach that the model explains. ``confirmed`` share of the
    observations of points that other views fix (two or more of them) which agree with the view too: points
    of two views agree with any two cameras along their epipolar lines. ``behind`` share of the observations
    behind the camera. ``noise_px`` of one coordinate, as it was before the points were fitted to it.
    ``focal_off`` and ``aspect_off``: the logarithm of the view's own focal over the model's and of its own
    aspect, from its points alone, with their standard deviations ``focal_off_std`` and ``aspect_off_std`` at
    the noise that is left with them.
    """

    explained: F64
    confirmed: F64
    behind: F64
    noise_px: F64
    focal_off: F64
    focal_off_std: F64
    aspect_off: F64
    aspect_off_std: F64


def check_views(model: MetricModel, *, sigmas: float) -> PerViewChecks:
    """Measure every registered view; ``sigmas`` is the gate of an observation that agrees."""
    t = model.tracks
    n = t.n_views
    agree = agreeing_observations(model, sigmas=sigmas)
    near = within_reach(model)
    fixed = _fixed_by_others(model, agree)
    known = near & (np.abs(model.X[t.point_index]).sum(axis=1) > 0)
    _, depth = project_observations(model.cameras, model.X, t.view_index, t.point_index)
    own = [_own_camera(model, view, np.flatnonzero(agree & (t.view_index == view))) for view in range(n)]
    return PerViewChecks(
        _share(t.view_index, agree, near, n),
        _share(t.view_index, agree, near & fixed, n),
        _share(t.view_index, depth <= 0, known, n),
        noise_of_views(model, agree),
        *(np.array(column) for column in zip(*own, strict=True)),
    )


def within_reach(model: MetricModel) -> B8:
    """(K,) observations in registered views of points that two or more of these see from different places:
    no others can be explained. Photographs taken from one place share many, which have no depth."""
    t = model.tracks
    near = model.registered[t.view_index]
    seen = np.bincount(t.point_index[near], minlength=t.n_points)
    return np.asarray(near & (seen >= 2)[t.point_index] & _from_two_places(model, near)[t.point_index])


def _from_two_places(model: MetricModel, near: B8) -> B8:
    """(N,) whether the views that see a point stand apart by more than ``ONE_PLACE`` of the distance to the
    scene."""
    t = model.tracks
    centres = -np.einsum("vba,vb->va", model.cameras.R, model.cameras.t)
    view, point = t.view_index[near], t.point_index[near]
    known = model.ok[near]
    if not known.any():
        return np.ones(t.n_points, dtype=bool)
    distance = np.median(np.linalg.norm(model.X[point[known]] - centres[view[known]], axis=1))
    first, apart = np.zeros(t.n_points, dtype=np.int64), np.zeros(t.n_points)
    first[point[::-1]] = view[::-1]
    np.maximum.at(apart, point, np.linalg.norm(centres[view] - centres[first[point]], axis=1))
    return np.asarray(apart > ONE_PLACE * float(distance))


def _share(view: I64, good: B8, counted: B8, n: int) -> F64:
    all_ = np.bincount(view[counted], minlength=n)
    right = np.bincount(view[counted & good], minlength=n)
    return np.where(all_ > 0, right / np.maximum(all_, 1), np.nan)


def _fixed_by_others(model: MetricModel, agree: B8) -> B8:
    """(K,) whether an observation's point is explained in two or more other views."""
    t = model.tracks
    count = np.bincount(t.point_index[agree], minlength=t.n_points)
    return np.asarray(count[t.point_index] - agree >= 2)


def noise_of_views(model: MetricModel, agree: B8) -> F64:
    """(V,) noise (px) of one coordinate of the observations ``agree`` (K,); NaN where too few tell it.

    A point that few views see is fitted to their noise, more to that of some views than of others: of three
    cameras in a row the outer ones keep hardly any residual. Each residual is hence taken over the root of
    the share 1 - (B V^-1 B')_cc of its variance that the three freedoms of its point leave, B = dx / dX and
    V = sum B'B.
    """
    t, cameras = model.tracks, model.cameras
    k = np.flatnonzero(agree)
    view, point = t.view_index[k], t.point_index[k]
    seen, depth = project_observations(cameras, model.X, view, point)
    R = cameras.R[view]
    x = np.einsum("kab,kb->ka", R[:, :2], model.X[point]) + cameras.t[view, :2]
    B = (R[:, :2] - (x / depth[:, None])[:, :, None] * R[:, 2:]) / depth[:, None, None]
    B *= cameras.intrinsics[cameras.group[view], 0][:, None, None]
    V = np.zeros((t.n_points, 3, 3))
    np.add.at(V, point, np.einsum("kca,kcb->kab", B, B))
    # The ridge keeps points of one view regular; nothing is left of their variance all the same.
    V += (1e-12 * np.trace(V, axis1=1, axis2=2) + 1e-300)[:, None, None] * np.eye(3)
    left = 1.0 - np.einsum("kca,kab,kcb->kc", B, np.linalg.inv(V)[point], B)
    told = left > LEAST_LEFT
    size = np.abs(seen - t.xy[k])[told] / np.sqrt(left[told])
    whose = np.repeat(view[:, None], 2, axis=1)[told]
    noise = np.full(t.n_views, np.nan)
    for v in range(t.n_views):
        if np.count_nonzero(whose == v) >= FEWEST_OBSERVATIONS:
            noise[v] = MAD_FACTOR * np.median(size[whose == v])
    return noise


def _own_camera(model: MetricModel, view: int, index: I64) -> tuple[float, float, float, float]:
    """Own focal and aspect of a view with their deviations; NaN where it has too few observations."""
    nothing = (np.nan,) * 4
    if not model.registered[view] or len(index) < FEWEST_OBSERVATIONS:
        return nothing
    index = index[:: int(np.ceil(len(index) / MOST_OBSERVATIONS))]
    t, cameras = model.tracks, model.cameras
    X, xy = model.X[t.point_index[index]], t.xy[index]
    seen, _ = project_observations(cameras, model.X, t.view_index[index], t.point_index[index])
    noise = max(noise_from_distances(np.linalg.norm(seen - xy, axis=1)), 1e-3)
    intrinsics = cameras.intrinsics[cameras.group[view]]
    free = np.zeros(len(intrinsics), dtype=bool)
    free[: len(OWN)] = OWN
    try:
        fit = refine_pose(
            cameras.R[view], cameras.t[view], intrinsics, X, xy, free=free, loss_px=2.0 * noise, iterations=10
        )
    except ValueError:
        return nothing
    left = max(noise_from_distances(np.linalg.norm(fit.residual_px, axis=1)), 1e-3)
    std = left * np.sqrt(np.maximum(np.diag(fit.covariance)[6:8], 0.0))
    focal = float(np.log(fit.intrinsics[0] / intrinsics[0]))
    return (
        focal,
        float(std[0]),
        float(np.log(max(fit.intrinsics[1] / intrinsics[1], 1e-9))),
        float(std[1]),
    )


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
    """Measured numbers by name, and the failed_checks they raise (none: the answer is trusted).

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
    failed_checks = list(calibration.reasons) if not calibration.identifiable else []
    return check, [*failed_checks, *_doubts_of_views(views, model), *_doubts(check)]


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


def _noise_ratio(views: PerViewChecks) -> F64:
    """Noise of each view over the median of all."""
    known = views.noise_px[np.isfinite(views.noise_px)]
    return np.asarray(views.noise_px / max(float(np.median(known)), 1e-9) if len(known) else views.noise_px)


def _own_focal_sigmas(views: PerViewChecks) -> F64:
    return np.asarray(np.abs(views.focal_off) / np.maximum(USUAL_INFLATION * views.focal_off_std, 1e-9))


def _doubts_of_views(views: PerViewChecks, model: MetricModel) -> list[str]:
    """A sentence for the views that are doubted for one reason; of several reasons a view has the gravest."""
    ratio, own = _noise_ratio(views), _own_focal_sigmas(views)
    left = model.registered.copy()

    def take(bad: B8) -> I64:
        taken = np.flatnonzero(left & bad)
        left[taken] = False
        return taken

    failed_checks = []
    if len(wrong := take(views.confirmed < MIN_CONFIRMED_OF_VIEW)):
        failed_checks.append(
            f"{_named(wrong)}: only {_range(views.confirmed[wrong])} of the points that other views fix are "
            "where they are seen; the camera is wrong or its matches are: leave the photograph out, or take "
            "others between it and the rest"
        )
    if len(wrong := take(~(views.explained >= MIN_EXPLAINED_OF_VIEW))):
        failed_checks.append(
            f"{_named(wrong)}: the model explains only {_range(views.explained[wrong])} of the matches; the "
            "camera is wrong, or that of the views it is matched with"
        )
    if len(wrong := take(views.behind > MAX_BEHIND)):
        failed_checks.append(
            f"{_named(wrong)}: {_range(views.behind[wrong])} of the points lie behind the camera"
        )
    for view in take((np.abs(views.focal_off) > MAX_OWN_FOCAL) & (own > MAX_OWN_SIGMAS)):
        off = float(np.expm1(views.focal_off[view]))
        failed_checks.append(
            f"view {view} alone asks for a focal length {abs(off):.1%} "
            f"{'longer' if off > 0.0 else 'shorter'} than the model's: it is of another camera or zoomed, "
            "or the model is bent"
        )
    if len(wrong := take(ratio > MAX_NOISE_RATIO)):
        failed_checks.append(
            f"{_named(wrong)}: explained with {ratio[wrong].max():.1f} times the noise of the others"
        )
    return failed_checks


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
    """The failed_checks about the model as a whole."""
    failed_checks = []
    low, high = check["focal_min_long_sides"], check["focal_max_long_sides"]
    if not (_FOCAL_RANGE[0] < low and high < _FOCAL_RANGE[1]):
        failed_checks.append(
            f"a focal length of {low:.2f} to {high:.2f} long sides is not that of a photograph"
        )
    if not check["focal_std_rel_max"] < _MAX_FOCAL_STD:
        failed_checks.append(f"a focal length is known only to {check['focal_std_rel_max']:.0%}")
    if not check["explained_share"] > _MIN_EXPLAINED:
        failed_checks.append(
            f"the model explains only {check['explained_share']:.0%} of the matches it should"
        )
    if not check["sigma_rel"] < _MAX_SIGMA_REL:
        failed_checks.append(f"the reprojection noise is {check['sigma_rel']:.2%} of the long side")
    shift = check["principal_shift_max_long_sides"]
    if not shift < _MAX_PRINCIPAL_SHIFT:
        failed_checks.append(f"the principal point lies {shift:.0%} of the long side off the image centre")
    if not check["focal_change_since_calibration"] < _MAX_FOCAL_CHANGE:
        failed_checks.append(
            f"bundle adjustment moved the focal by {check['focal_change_since_calibration']:.0%} "
            "from what self-calibration found"
        )
    return failed_checks
