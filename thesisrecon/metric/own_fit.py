"""A finished model adjusted once more with values of their own for the photographs, to hold against what they
are said to share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.metric.adjustment import Adjustment
from thesisrecon.metric.model import CENTRE, FOCAL, WIDTH, MetricModel
from thesisrecon.optimize.metric_bundle import (
    IntrinsicsPrior,
    MetricBundleResult,
    MetricCameras,
    Observations,
    refine_metric_bundle,
)
from thesisrecon.types import I64

CENTRE_STD = 0.1
"""Long sides; a photograph may be cut out of a larger one anywhere."""
MOST_OBSERVATIONS = 15000
ROUNDS = 30
"""A model that is bent lies in a long valley: a dozen rounds leave the values where they were."""


def part_of_explained(model: MetricModel) -> I64:
    """Explained observations, those of every n-th point where they are many."""
    index = np.flatnonzero(model.ok)
    point = model.tracks.point_index[index]
    chosen = np.zeros(model.tracks.n_points, dtype=bool)
    chosen[np.unique(point)[:: int(np.ceil(len(index) / MOST_OBSERVATIONS))]] = True
    return np.asarray(index[chosen[point]], dtype=np.int64)


@dataclass(frozen=True)
class OwnFit:
    """The registered ``views`` of a model; rows of every answer are in their order."""

    model: MetricModel
    adjustment: Adjustment
    views: I64

    def adjusted(self, columns: tuple[int, ...], *, focal_spread: float = np.inf) -> MetricBundleResult:
        """With a value of its own in ``columns`` for every view, of which nothing is known but, where it is
        finite, the ``focal_spread`` (relative) of the focals that were shared about one that is not
        known."""
        model, views, adjustment = self.model, self.views, replace(self.adjustment, population=None)
        t, cameras, index = model.tracks, model.cameras, part_of_explained(model)
        assert cameras.shared is not None
        rows = cameras.group[views]
        shared, own = cameras.shared[rows].copy(), np.arange(len(views), dtype=np.int64)
        prior, free = adjustment.prior(model), adjustment.free(model)
        std = prior.std[rows].copy()
        for column in columns:
            shared[:, column], free[column] = own, True
            longest = model.sizes[views].max(axis=1)
            std[:, column] = CENTRE_STD * longest if column in CENTRE else np.inf
        known = IntrinsicsPrior(prior.mean[rows], std)
        if np.isfinite(focal_spread):
            spread = np.where(np.arange(WIDTH) == FOCAL, focal_spread, np.inf)
            known = replace(known, population=cameras.shared[rows, FOCAL], spread=spread)
        options = replace(adjustment, inflation=1.0).options(model, iterations=ROUNDS)
        return refine_metric_bundle(
            MetricCameras(cameras.R[views], cameras.t[views], cameras.intrinsics[rows], own, shared),
            model.X,
            Observations(np.searchsorted(views, t.view_index[index]), t.point_index[index], t.xy[index]),
            free=free,
            prior=known,
            options=replace(options, covariance=True, noise_floor_px=model.sigma_px),
        )
