"""Intervals of the intrinsics that may be believed.

The covariance of bundle adjustment is right for independent noise and a right model, and too small on
photographs: matches err together and lenses have more coefficients than ours. Two things are measured on top
of it. Where views share a camera, each view alone gives its own intrinsics, and their scatter around the
common value against what the covariance promises is a factor of inflation. And a floor stands for what the
camera model leaves out.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from thesisrecon.metric.model import MetricModel
from thesisrecon.optimize.metric_bundle import (
    BundleOptions,
    IntrinsicsPrior,
    MetricBundleResult,
    MetricCameras,
    Observations,
    refine_metric_bundle,
)
from thesisrecon.types import I64, IntrinsicInterval

F64 = NDArray[np.float64]

# What photographs are known to need (covariances 4 to 10 times too small), and how many degrees of freedom
# that knowledge is worth beside the scatter that a set of photographs shows itself.
DEFAULT_INFLATION = 4.0
DEFAULT_WEIGHT = 4.0
_COLUMNS = {"focal_px": 0, "principal_x_px": 3, "principal_y_px": 4, "k1": 5}


def intrinsic_intervals(
    model: MetricModel, bundle: MetricBundleResult, prior: IntrinsicsPrior, *, floor_rel: float, indices: I64
) -> tuple[Mapping[str, IntrinsicInterval], ...]:
    """Per view the intervals named in ``MetricResult`` (empty where not registered).

    ``bundle`` is the last adjustment, made on observations ``indices``, with its covariance.
    """
    inflation, how = measured_inflation(model, prior, indices)
    covariance = bundle.intrinsics_covariance
    answer: list[Mapping[str, IntrinsicInterval]] = []
    for view in range(len(model.registered)):
        if not model.registered[view]:
            answer.append({})
            continue
        g = int(model.cameras.group[view])
        row = model.cameras.intrinsics[g]
        floor = floor_rel * np.array([row[0], row[0], row[0], 1.0])
        intervals = {}
        for n, (name, column) in enumerate(_COLUMNS.items()):
            deviation = float(np.sqrt(max(covariance[g, column, column], 0.0)))
            std = float(np.hypot(inflation * deviation, floor[n]))
            if deviation == 0.0:
                intervals[name] = IntrinsicInterval(float(row[column]), 0.0, "assumed")
                continue
            limit = float(prior.std[g, column]) * (row[0] if column == 0 else 1.0)
            std = min(std, limit) if np.isfinite(limit) else std
            intervals[name] = IntrinsicInterval(float(row[column]), std, f"bundle adjustment, {how}")
        answer.append(intervals)
    return tuple(answer)


def measured_inflation(
    model: MetricModel, prior: IntrinsicsPrior, indices: I64, *, max_observations: int = 30000
) -> tuple[float, str]:
    """How many times too small the covariance is, and how that is known.

    Adjusts once more with a focal of its own for every view of the largest camera group and compares the
    scatter of those focals with their standard deviations: z_i = (f_i - weighted mean) / std_i. A few views
    say little of a spread, hence the factor is sqrt((n0 a^2 + sum z^2) / (n0 + n - 1)) with the known a =
    ``DEFAULT_INFLATION`` counting as n0 = ``DEFAULT_WEIGHT`` degrees of freedom. With fewer than four views
    nothing is measured and a is taken.
    """
    registered = np.flatnonzero(model.registered)
    group = model.cameras.group
    largest = int(np.bincount(group[registered]).argmax())
    views = registered[group[registered] == largest]
    if len(views) < 4:
        return DEFAULT_INFLATION, f"covariance x {DEFAULT_INFLATION:.0f}"
    k = _thin(model, indices, max_observations)
    separate = np.arange(len(group), dtype=np.int64)
    intrinsics = model.cameras.intrinsics[group]
    t = model.tracks
    result = refine_metric_bundle(
        MetricCameras(model.cameras.R, model.cameras.t, intrinsics, separate),
        model.X,
        Observations(t.view_index[k], t.point_index[k], t.xy[k]),
        free=np.array([True, False, False, False, False, False]),
        prior=IntrinsicsPrior(prior.mean[group], prior.std[group]),
        options=BundleOptions(
            sigma_px=model.sigma_px, loss_px=2.0 * model.sigma_px, max_iterations=8, covariance=True
        ),
    )
    log_f = np.log(result.cameras.intrinsics[views, 0])
    std = (
        np.sqrt(np.maximum(result.intrinsics_covariance[views, 0, 0], 0.0))
        / result.cameras.intrinsics[views, 0]
    )
    if not (np.isfinite(std).all() and (std > 0).all()):
        return DEFAULT_INFLATION, f"covariance x {DEFAULT_INFLATION:.0f}"
    weight = 1.0 / std**2
    mean = np.sum(weight * log_f) / weight.sum()
    squares = float(np.sum(weight * (log_f - mean) ** 2))
    known = DEFAULT_WEIGHT * DEFAULT_INFLATION**2
    factor = float(np.sqrt((known + squares) / (DEFAULT_WEIGHT + len(views) - 1)))
    return factor, f"covariance x {factor:.1f} from the scatter between views"


def _thin(model: MetricModel, indices: I64, most: int) -> I64:
    """Observations of every n-th point, so that at most about ``most`` remain."""
    step = int(np.ceil(len(indices) / most))
    point = model.tracks.point_index[indices]
    rank = np.unique(point, return_inverse=True)[1]
    return np.asarray(indices[rank % step == 0])
