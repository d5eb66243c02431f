"""What each photograph says of the model, alone: a wrong camera shows here and hides in averages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.metric.model import MetricModel, agreeing_observations, project_observations
from thesisrecon.optimize.triangulation_refine import refine_pose
from thesisrecon.robust.noise import MAD_FACTOR, noise_from_distances
from thesisrecon.types import B8, I64

F64 = NDArray[np.float64]

OWN = np.array([True, True, False, False, False, False])
"""Focal and aspect: what a camera that is right gives back when nothing but its points is believed."""
MOST_OBSERVATIONS = 1500
FEWEST_OBSERVATIONS = 30
ONE_PLACE = 2e-3
"""Of the distance to the scene: photographs taken nearer together have no parallax to speak of."""
LEAST_LEFT = 0.1
"""Coordinates that keep less than this share of their variance say little of the noise."""


@dataclass(frozen=True)
class ViewChecks:
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


def check_views(model: MetricModel, *, sigmas: float) -> ViewChecks:
    """Measure every registered view; ``sigmas`` is the gate of an observation that agrees."""
    t = model.tracks
    n = t.n_views
    agree = agreeing_observations(model, sigmas=sigmas)
    near = within_reach(model)
    fixed = _fixed_by_others(model, agree)
    known = near & (np.abs(model.X[t.point_index]).sum(axis=1) > 0)
    _, depth = project_observations(model.cameras, model.X, t.view_index, t.point_index)
    own = [_own_camera(model, view, np.flatnonzero(agree & (t.view_index == view))) for view in range(n)]
    return ViewChecks(
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
