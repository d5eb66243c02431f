"""Whether the photographs contradict what was said of a focal length: a wrong word bends a model quietly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thesisrecon.metric.adjustment import Adjustment
from thesisrecon.metric.model import FOCAL, MetricModel
from thesisrecon.metric.model_error import USUAL_INFLATION
from thesisrecon.optimize.metric_bundle import (
    IntrinsicsPrior,
    Observations,
    refine_metric_bundle,
)
from thesisrecon.types import F64

MAX_SIGMAS = 3.0
LEAST_DIFFERENCE = 0.01
"""A prior wrong by less than a hundredth does no harm that a person would mend."""
FLOOR = 2e-3
"""Of the relative standard deviation of a focal that was left open."""
MOST_OBSERVATIONS = 15000
ROUNDS = 12


def contradicted_focals(model: MetricModel, adjustment: Adjustment) -> list[str]:
    """A sentence for every focal length of which something was said that the photographs contradict.

    The model is adjusted once more with nothing known of any focal, from where it is; what comes out is
    compared with what was said, both uncertainties together. Empty where nothing was said.
    """
    assumed = adjustment.assumed
    said = np.flatnonzero(assumed.focal_known & model.registered)
    if len(said) == 0:
        return []
    focal, std = _free_focals(model, adjustment)
    doubts = []
    for number in np.unique(assumed.shared[said, 0]):
        view = int(said[assumed.shared[said, 0] == number][0])
        mean, deviation = float(assumed.mean[view, 0]), float(assumed.std[view, 0])
        off = float(np.log(focal[view] / mean))
        if abs(off) > LEAST_DIFFERENCE and abs(off) > MAX_SIGMAS * float(np.hypot(std[view], deviation)):
            whose = "" if len(np.unique(assumed.shared[said, 0])) == 1 else f" of view {view}"
            doubts.append(
                f"the photographs contradict the focal length{whose} that was given: they ask for "
                f"{focal[view]:.0f} px (within {std[view]:.1%}) where {mean:.0f} px was given; leave it out, "
                "or give it a larger focal_std_rel"
            )
    return doubts


def _free_focals(model: MetricModel, adjustment: Adjustment) -> tuple[F64, F64]:
    """Focals (V,) and relative deviations (V,) when nothing is known of them."""
    t, cameras = model.tracks, model.cameras
    index = np.flatnonzero(model.ok)
    points = np.unique(t.point_index[index])
    chosen = np.zeros(t.n_points, dtype=bool)
    chosen[points[:: int(np.ceil(len(index) / MOST_OBSERVATIONS))]] = True
    index = index[chosen[t.point_index[index]]]
    prior = adjustment.prior(model)
    std, free = prior.std.copy(), adjustment.free(model)
    std[:, FOCAL], free[FOCAL] = np.inf, True
    result = refine_metric_bundle(
        cameras, model.X, Observations(t.view_index[index], t.point_index[index], t.xy[index]), free=free,
        prior=IntrinsicsPrior(prior.mean, std),
        options=replace(
            adjustment.options(model, iterations=ROUNDS), covariance=True, noise_floor_px=model.sigma_px
        ),
    )  # fmt: skip
    focal = result.cameras.intrinsics[:, FOCAL]
    variance = np.maximum(result.intrinsics_covariance[:, FOCAL, FOCAL], 0.0)
    deviation = np.hypot(USUAL_INFLATION * np.sqrt(variance) / focal, FLOOR)
    return focal[cameras.group], deviation[cameras.group]
