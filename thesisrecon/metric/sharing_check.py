"""Whether the photographs contradict that they share a camera: zooms that differ by a few percent, and crops,
bend a model quietly, since each photograph fits points that were bent with it.

The word is hence tested as a hypothesis: the model is adjusted once more with a focal length, and once with a
focal length and a principal point, for every photograph of its own; whether these agree is a sum of squares
in units of their deviations, chi-square with V - 1 degrees of freedom where they do.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from thesisrecon.metric.adjustment import Adjustment
from thesisrecon.metric.model import MetricModel
from thesisrecon.optimize.metric_bundle import (
    IntrinsicsPrior,
    MetricBundleResult,
    MetricCameras,
    Observations,
    refine_metric_bundle,
)
from thesisrecon.optimize.metric_cameras import FOCAL
from thesisrecon.types import B8, F64, I64

CENTRE = (3, 4)
ALARM = 1e-3
"""Chance of a false alarm where the deviations are right."""
INFLATION, FLOOR = 4.0, 2e-3
"""Covariances are this many times too small on photographs, and never below the floor."""
LEAST_APART = {"focal": 0.01, "centre": 0.03}
"""Relative and in long sides: what differs by less does no harm that a person would mend."""
CENTRE_STD = 0.1
"""Long sides; a photograph may be cut out of a larger one anywhere."""
MOST_OBSERVATIONS = 15000
ROUNDS = 12


def contradicted_sharing(model: MetricModel, adjustment: Adjustment) -> list[str]:
    """A sentence for every camera that is said to have taken several photographs whose own focal lengths or
    principal points do not agree. Empty where nothing is shared, or three views are too few to tell."""
    views = np.flatnonzero(model.registered)
    assert model.cameras.shared is not None
    number = model.cameras.shared[model.cameras.group[views]]
    sets = [np.flatnonzero(number[:, FOCAL] == k) for k in np.unique(number[:, FOCAL])]
    sets = [places for places in sets if len(places) >= 3]
    if not sets:
        return []
    doubts = []
    alone = _with_own(model, adjustment, views, (FOCAL,))
    both = None
    for places in sets:
        focal = alone.cameras.intrinsics[places, FOCAL]
        std = _deviation(alone, places, FOCAL, focal)
        if _apart(np.log(focal), std, LEAST_APART["focal"]):
            doubts.append(_focals_differ(views[places], focal, std))
            continue
        both = both or _with_own(model, adjustment, views, (FOCAL, *CENTRE))
        longest = model.sizes[views[places]].max(axis=1).astype(np.float64)
        shared = [c for c in CENTRE if len(np.unique(number[places, c])) == 1]
        at = [both.cameras.intrinsics[places, c] / longest for c in shared]
        if any(
            _apart(x, _deviation(both, places, c, longest), LEAST_APART["centre"])
            for x, c in zip(at, shared, strict=True)
        ):
            doubts.append(_centres_differ(views[places], max(float(np.ptp(x)) for x in at)))
    return doubts


def _with_own(
    model: MetricModel, adjustment: Adjustment, views: I64, columns: tuple[int, ...]
) -> MetricBundleResult:
    """The model adjusted with a value of its own in ``columns`` for every one of the ``views``, of which
    nothing is known; rows of the answer are in their order."""
    t, cameras = model.tracks, model.cameras
    assert cameras.shared is not None
    index = _some(model)
    rows = cameras.group[views]
    shared = cameras.shared[rows].copy()
    prior, free = adjustment.prior(model), adjustment.free(model)
    std = prior.std[rows].copy()
    for column in columns:
        shared[:, column] = np.arange(len(views))
        longest = model.sizes[views].max(axis=1)
        std[:, column] = np.inf if column == FOCAL else CENTRE_STD * longest
        free[column] = True
    own = np.arange(len(views), dtype=np.int64)
    return refine_metric_bundle(
        MetricCameras(cameras.R[views], cameras.t[views], cameras.intrinsics[rows], own, shared), model.X,
        Observations(np.searchsorted(views, t.view_index[index]), t.point_index[index], t.xy[index]),
        free=free, prior=IntrinsicsPrior(prior.mean[rows], std),
        options=replace(
            adjustment.options(model, iterations=ROUNDS), covariance=True, noise_floor_px=model.sigma_px
        ),
    )  # fmt: skip


def _some(model: MetricModel) -> I64:
    """Explained observations, those of every n-th point where they are many."""
    index = np.flatnonzero(model.ok)
    point = model.tracks.point_index[index]
    chosen = np.zeros(model.tracks.n_points, dtype=bool)
    chosen[np.unique(point)[:: int(np.ceil(len(index) / MOST_OBSERVATIONS))]] = True
    return np.asarray(index[chosen[point]], dtype=np.int64)


def _deviation(result: MetricBundleResult, places: I64, column: int, unit: F64) -> F64:
    """Standard deviations as photographs need them, in ``unit``; infinite where nothing is told."""
    variance = result.intrinsics_covariance[places, column, column]
    std = np.hypot(INFLATION * np.sqrt(np.maximum(variance, 0.0)) / unit, FLOOR)
    return np.where(np.isfinite(std) & (variance > 0.0), std, np.inf)


def _apart(value: F64, std: F64, least: float) -> bool:
    """Whether values do not agree, and by more than ``least``."""
    told: B8 = np.isfinite(std) & np.isfinite(value)
    if told.sum() < 3:
        return False
    value, weight = value[told], std[told] ** -2.0
    off = value - (weight @ value) / weight.sum()
    squares = float(weight @ off**2)
    return bool(np.abs(off).max() > least and squares > chi2.isf(ALARM, len(off) - 1))


def _focals_differ(views: I64, focal: F64, std: F64) -> str:
    low, high = int(focal.argmin()), int(focal.argmax())
    return (
        f"the photographs contradict that they have one focal length: view {views[low]} asks for "
        f"{focal[low]:.0f} px (within {std[low]:.1%}), view {views[high]} for {focal[high]:.0f} px (within "
        f"{std[high]:.1%}); let every photograph have its own (cameras = per-image), or leave out those that "
        "were zoomed"
    )


def _centres_differ(views: I64, apart: float) -> str:
    return (
        f"the photographs contradict that they have one principal point: those of {len(views)} views lie up "
        f"to {apart:.0%} of the long side apart, as of photographs cropped one by one; let every photograph "
        "have its own (cameras = per-image)"
    )
