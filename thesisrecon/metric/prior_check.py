"""Whether the photographs contradict what was said of a focal length: a wrong word bends a model quietly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thesisrecon.metric.adjustment import Adjustment
from thesisrecon.metric.model import CENTRE, FOCAL, MetricModel
from thesisrecon.metric.model_error import LEAST_BLOCKS, USUAL_INFLATION
from thesisrecon.metric.own_fit import ROUNDS, part_of_explained
from thesisrecon.optimize.bundle_blocks import BlockScatter
from thesisrecon.optimize.metric_bundle import (
    IntrinsicsPrior,
    Observations,
    refine_metric_bundle,
)
from thesisrecon.types import F64, I64

MAX_SIGMAS = 3.0
LEAST_DIFFERENCE = 0.01
"""A prior wrong by less than a hundredth does no harm that a person would mend."""
MAX_CENTRE_SIGMAS = 5.0
MOST_CONTRADICTION = 8.0
"""Variance ratio of blocks over points; right models of photographs have 1.5 to 5, bent ones 11 to 28."""
FLOOR = 2e-3
"""Of the relative standard deviation of a focal that was left open."""
WIDEN = "leave it out, or give it a larger focal_std_rel"


def contradicted_focals(model: MetricModel, adjustment: Adjustment) -> list[str]:
    """A sentence for every focal length of which something was said that the photographs contradict.

    The model is adjusted once more with nothing known of any focal, from where it is; what comes out is
    compared with what was said, both uncertainties together. Empty where nothing was said.
    """
    assumed = adjustment.assumed
    said = np.flatnonzero(assumed.focal_known & model.registered)
    if len(said) == 0:
        return []
    number = _numbers_when_free(model, adjustment)
    focal, std = _free_focals(model, adjustment, number)
    number = number[model.cameras.group]
    doubts = []
    for k in np.unique(number[said]):
        view = int(said[number[said] == k][0])
        mean, deviation = float(assumed.mean[view, 0]), float(assumed.std[view, 0])
        off = float(np.log(focal[view] / mean))
        if abs(off) > LEAST_DIFFERENCE and abs(off) > MAX_SIGMAS * float(np.hypot(std[view], deviation)):
            whose = "" if len(np.unique(number[said])) == 1 else f" of view {view}"
            doubts.append(
                f"the photographs contradict the focal length{whose} that was given: they ask for one "
                f"{abs(np.expm1(off)):.1%} {'longer' if off > 0 else 'shorter'} (within {std[view]:.1%}, one "
                f"standard deviation); {'leave it out' if deviation == 0.0 else WIDEN}"
            )
    return doubts


def centre_of_a_bent_model(model: MetricModel, adjustment: Adjustment, scatter: BlockScatter) -> list[str]:
    """A sentence where a principal point lies far off what was said of it and parts of the scene contradict
    each other as well: photographs cropped alike do the first, but not the second."""
    views = np.flatnonzero(model.registered)
    if scatter.blocks < LEAST_BLOCKS or not scatter.contradiction > MOST_CONTRADICTION:
        return []
    said = adjustment.assumed.std[views][:, CENTRE]
    values = model.cameras.intrinsics[model.cameras.group[views]][:, CENTRE]
    off = np.abs(values - adjustment.assumed.mean[views][:, CENTRE])
    sigmas = np.where(said > 0.0, off / np.where(said > 0.0, said, 1.0), 0.0).max(axis=1)
    worst = int(sigmas.argmax())
    if not sigmas[worst] > MAX_CENTRE_SIGMAS:
        return []
    share = float(off[worst].max() / model.sizes[views[worst]].max())
    return [
        f"the principal point lies {share:.0%} of the long side off ({sigmas[worst]:.0f} standard deviations "
        f"of what is said of it) and parts of the scene contradict each other by {scatter.contradiction:.0f} "
        "times what their points let expect: photographs were zoomed or cropped one by one, or the model is "
        "bent"
    ]


def _numbers_when_free(model: MetricModel, adjustment: Adjustment) -> I64:
    """(G,) numbers of the focals when nothing is known of them: known ones, which are not tied, are one where
    one value was given for them."""
    assert model.cameras.shared is not None
    prior, number = adjustment.prior(model), model.cameras.shared[:, FOCAL].copy()
    known = np.flatnonzero(prior.std[:, FOCAL] == 0.0)
    number[known] = number.max() + 1 + np.unique(prior.mean[known, FOCAL], return_inverse=True)[1].reshape(-1)
    return np.asarray(number)


def _free_focals(model: MetricModel, adjustment: Adjustment, number: I64) -> tuple[F64, F64]:
    """Focals (V,) and relative deviations (V,) when nothing is known of them; rows of one ``number`` share
    theirs."""
    t, cameras = model.tracks, model.cameras
    index = part_of_explained(model)
    assert cameras.shared is not None
    shared = cameras.shared.copy()
    shared[:, FOCAL] = number
    prior = adjustment.prior(model)
    std, free = prior.std.copy(), adjustment.free(model)
    std[:, FOCAL], free[FOCAL] = np.inf, True
    result = refine_metric_bundle(
        replace(cameras, shared=shared), model.X,
        Observations(t.view_index[index], t.point_index[index], t.xy[index]), free=free,
        prior=IntrinsicsPrior(prior.mean, std),
        options=replace(
            adjustment.options(model, iterations=ROUNDS), covariance=True, noise_floor_px=model.sigma_px
        ),
    )  # fmt: skip
    focal = result.cameras.intrinsics[:, FOCAL]
    variance = np.maximum(result.intrinsics_covariance[:, FOCAL, FOCAL], 0.0)
    deviation = np.hypot(USUAL_INFLATION * np.sqrt(variance) / focal, FLOOR)
    return focal[cameras.group], deviation[cameras.group]
