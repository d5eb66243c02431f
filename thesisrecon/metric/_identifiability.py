"""Identifiability of the cameras and points that the metric stage returns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from thesisrecon.arrays import I64
from thesisrecon.geometry.critical_motions import UpgradedCameras
from thesisrecon.metric._adjustment import MetricAdjustment
from thesisrecon.metric._model import FOCAL, MetricEstimate
from thesisrecon.metric._shared_camera import runs_of_views, subsample_inliers
from thesisrecon.optimize.bundle.identifiability import (
    CalibrationProblem,
    excess_equations,
    identifiability_report,
)
from thesisrecon.optimize.bundle.metric_kernels import MetricCameras
from thesisrecon.optimize.bundle.observations import Observations
from thesisrecon.records import IdentifiabilityReport, IntrinsicInterval, IntrinsicsPrior

MIN_OBSERVATIONS = 10
"""Views with fewer of the observations used are left out: their poses may be undetermined."""


def returned_cameras(model: MetricEstimate) -> UpgradedCameras:
    """Return the registered cameras and valid points, from which the motion is measured."""
    v, cameras = np.flatnonzero(model.registered), model.cameras
    focal = cameras.intrinsics[cameras.group[v], FOCAL] / model.sizes[v].max(axis=1)
    return UpgradedCameras(focal, cameras.R[v], cameras.centres[v], model.X[model.valid])


def check_returned(
    model: MetricEstimate,
    adjustment: MetricAdjustment,
    metric: UpgradedCameras,
    intervals: Sequence[Mapping[str, IntrinsicInterval]],
) -> IdentifiabilityReport:
    """Check whether the images and the prior determine a model as it is, without adjusting it again.

    The motion is that of all ``metric`` cameras, and the focal lengths are known as the ``intervals`` say.
    Covariances are those of some of the views and observations.
    """
    part = runs_of_views(model)
    seen = subsample_inliers(part)
    count = np.bincount(seen.view_index, minlength=len(model.registered))
    views = np.flatnonzero(count >= min(MIN_OBSERVATIONS, int(np.sort(count)[-3])))
    used = _in_two_views(seen, views)
    cameras, rows, prior = model.cameras, model.cameras.group[views], adjustment.row_prior(model)
    assert cameras.shared is not None
    own = np.arange(len(views), dtype=np.int64)
    problem = CalibrationProblem(
        MetricCameras(
            cameras.R[views], cameras.t[views], cameras.intrinsics[rows], own, cameras.shared[rows]
        ),
        model.X,
        Observations(np.searchsorted(views, seen.view_index[used]), seen.point_index[used], seen.xy[used]),
        IntrinsicsPrior.unshared(prior.mean[rows], prior.std[rows]),
        max(model.sigma_px, 1e-3),
        len(used) / max(int(model.inlier.sum()), 1),
        model.sizes[views].max(axis=1).astype(np.float64),
        views,
    )
    focals = [intervals[v]["focal_px"] for v in views.tolist()]
    std = np.array([focal.std / focal.value for focal in focals])
    excess = excess_equations(adjustment.prior, model.registered)
    return identifiability_report(problem, excess, metric=metric, focal_std=std)


def _in_two_views(seen: Observations, views: I64) -> I64:
    """Observations in ``views`` of points that two or more of them see."""
    index = np.flatnonzero(np.isin(seen.view_index, views))
    count = np.bincount(seen.point_index[index])
    return index[count[seen.point_index[index]] >= 2]
