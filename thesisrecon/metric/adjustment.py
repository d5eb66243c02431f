"""Bundle adjustment of a metric model under the user's assumptions, with the noise taken from the data."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.metric.model import CENTRE, FOCAL, K1, WIDTH, MetricModel, residual_norms
from thesisrecon.numerics.block_scatter import BlockScatter, block_scatter
from thesisrecon.numerics.metric_bundle import BundleOptions, MetricBundleResult, refine_metric_bundle
from thesisrecon.numerics.noise import best_huber_width, noise_from_distances
from thesisrecon.numerics.observations import Observations

MIN_OBSERVATIONS = 40
# Where Huber's loss never turns, in sigmas.
NO_LOSS = 20.0
# 90 % of the lengths of two-dimensional normal noise are within this many sigmas.
RAYLEIGH_90 = 2.1460
# Views that must share a lens before its higher coefficients are asked for.
VIEWS_OF_A_LENS = 3


@dataclass(frozen=True)
class Population:
    """Cameras of one kind: ``rows`` (G,) number of the kind of each row of intrinsics, -1 for none, and
    ``spread`` (G, 8) of each intrinsic about the mean of its row's kind (relative for the focal, inf = not
    bound)."""

    rows: I64
    spread: F64


@dataclass(frozen=True)
class Adjustment:
    """Everything bundle adjustment is told beside the model.

    Parameters
    ----------
    assumed : of the intrinsics.
    lens_std : prior standard deviation of k2 and k3 around 0; 0 leaves them out.
    noise_floor_px : no match is taken to be better than this.
    population : of the cameras, None before it is known.
    inflation : by how much the noise counts for more than its size says, since it is not independent.
    """

    prior: IntrinsicsPrior
    lens_std: float
    noise_floor_px: float
    population: Population | None = None
    inflation: float = 1.0

    def options(self, model: MetricModel, *, iterations: int = 0) -> BundleOptions:
        """Weights and loss of the model's noise."""
        return BundleOptions(
            sigma_px=self.inflation * model.sigma_px,
            loss_px=model.loss_sigmas * model.sigma_px,
            max_iterations=iterations,
        )

    def row_prior(self, model: MetricModel) -> IntrinsicsPrior:
        """What is assumed of each row of the model's intrinsics."""
        group = model.cameras.group
        first = np.unique(group, return_index=True)[1]
        mean, std = np.zeros((len(first), WIDTH)), np.zeros((len(first), WIDTH))
        mean[:, : K1 + 1], std[:, : K1 + 1] = self.prior.mean[first], self.prior.std[first]
        std[:, K1 + 1 :] = np.where(self._shares_a_lens(model) & (std[:, K1] > 0.0), self.lens_std, 0.0)[
            :, None
        ]
        # A photograph may be cut out of a larger one: a principal point far from where it is expected is held
        # by its prior no more (the weight of a Cauchy distribution, (1 + (off / std)^2)^-1).
        for column in CENTRE:
            off = model.cameras.intrinsics[:, column] - mean[:, column]
            std[:, column] = np.hypot(std[:, column], np.where(std[:, column] > 0.0, off, 0.0))
        silent = ~np.isfinite(mean)
        mean[silent] = model.cameras.intrinsics[silent]
        p = self.population
        kind, spread = (None, None) if p is None else (p.rows, p.spread)
        return IntrinsicsPrior.unshared(mean, std, kind=kind, spread=spread)

    def free(self, model: MetricModel) -> B8:
        """(8,) intrinsics that move in some camera."""
        return np.asarray((self.row_prior(model).std > 0.0).any(axis=0))

    def run(
        self, model: MetricModel, *, free: B8 | None = None, iterations: int
    ) -> tuple[MetricModel, MetricBundleResult]:
        """The model after bundle adjustment of the explained observations, its noise measured anew.

        ``free`` (8,) keeps some intrinsics where they are. Raises ``StageFailure`` where hardly anything is
        explained.
        """
        prior, moves = self.row_prior(model), self.free(model)
        result = refine_metric_bundle(
            model.cameras,
            model.X,
            explained(model),
            free=moves if free is None else moves & free,
            prior=prior,
            options=self.options(model, iterations=iterations),
        )
        norms = np.linalg.norm(result.residual_px, axis=1)
        sigma = max(noise_from_distances(norms), self.noise_floor_px)
        model = replace(model, cameras=result.cameras, X=result.X, sigma_px=sigma)
        loss = best_loss(result.residual_px, sigma)
        return replace(model, loss_sigmas=loss, tail=tail_width(norms, sigma)), result

    def scatter(self, model: MetricModel) -> BlockScatter:
        """How far parts of the scene contradict each other at the end of an adjustment."""
        return block_scatter(
            model.cameras,
            model.X,
            explained(model),
            free=self.free(model),
            prior=self.row_prior(model),
            noise=(self.inflation * model.sigma_px, model.loss_sigmas * model.sigma_px),
        )

    def _shares_a_lens(self, model: MetricModel) -> B8:
        """(G,) rows whose k2 and k3 enough registered views share."""
        assert model.cameras.shared is not None
        lens = np.unique(model.cameras.shared[:, K1 + 1], return_inverse=True)[1].reshape(-1)
        views = np.bincount(lens[model.cameras.group[model.registered]], minlength=int(lens.max()) + 1)
        return np.asarray(views[lens] >= VIEWS_OF_A_LENS)


def explained(model: MetricModel) -> Observations:
    """The observations that the model explains."""
    t, k = model.tracks, np.flatnonzero(model.ok)
    if len(k) < MIN_OBSERVATIONS:
        raise StageFailure(
            "hardly any point survives the metric upgrade",
            f"{counted(len(k), 'observation')} left that the cameras explain at sufficient angles",
            "walk further around the scene between photographs",
        )
    return Observations(t.view_index[k], t.point_index[k], t.xy[k])


def best_loss(residual_px: F64, sigma: float) -> float:
    """The turn of Huber's loss, in sigmas, that promises the least variance for the residuals (K, 2)."""
    width = best_huber_width(np.abs(residual_px).ravel(), sigma)
    return min(width / sigma, NO_LOSS)


def tail_width(norms: F64, sigma: float) -> float:
    """How many times wider the tail of residual lengths (K,) is than that of normal noise sigma, 1 to 3.

    By the 90 % point. Residuals of matches have a tail several times as wide as their core, which is not of
    wrong matches: a gate in sigmas of the core would cut it off.
    """
    wide = float(np.quantile(norms, 0.9)) / RAYLEIGH_90
    return float(np.clip(wide / sigma, 1.0, 3.0))


def with_wide_gate(model: MetricModel) -> MetricModel:
    """The model with a loss and gates as wide as the residuals that it has before any adjustment, while the
    noise stays what it is: what is known beforehand must not outweigh the photographs meanwhile."""
    norms = residual_norms(model)
    norms = norms[np.isfinite(norms)]
    if not len(norms):
        return model
    wider = max(1.0, noise_from_distances(norms) / model.sigma_px)
    return replace(model, tail=wider, loss_sigmas=2.0 * wider)


FOCAL_AND_CENTRE = np.isin(np.arange(WIDTH), (FOCAL, *CENTRE))
