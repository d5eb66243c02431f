"""Bundle adjustment of a metric estimate under its prior; noise and loss are estimated from the residuals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.metric._model import CENTRE, FOCAL, K1, WIDTH, MetricEstimate, residual_norms
from thesisrecon.optimize.bundle.metric import (
    MAX_ITERATIONS,
    BundleOptions,
    MetricBundleResult,
    refine_metric_bundle,
)
from thesisrecon.optimize.bundle.observations import Observations
from thesisrecon.optimize.bundle.scatter import (
    BlockScatter,
    LinearisedFit,
    PoseUncertainty,
    block_scatter,
    linearise_fit,
    pose_uncertainty,
)
from thesisrecon.optimize.noise import best_huber_width, noise_from_distances
from thesisrecon.records import IntrinsicsPrior

MIN_OBSERVATIONS = 40
MAX_LOSS_SIGMAS = 20.0
"""For a larger width of Huber's loss, in sigmas, least squares is used."""
RAYLEIGH_90 = 2.1460
"""90 % point of the Rayleigh distribution, the length of 2-D normal noise, in sigmas."""
SETTLED, ROUND_SETTLED = 1e-4, 5e-3
"""Predicted gain of the cameras, half a squared distance in standard deviations, at which an adjustment ends;
larger if the observations are chosen again after it."""
MIN_VIEWS_PER_LENS = 3
"""k2 and k3 are estimated only if this many views share them."""
CENTRE_DOF = 3.0
"""Degrees of freedom of the prior of principal points: heavy tails with finite variance."""
FOCAL_AND_CENTRE = np.isin(np.arange(WIDTH), (FOCAL, *CENTRE))


@dataclass(frozen=True)
class HierarchicalPrior:
    """``kind`` (G,) of each camera, -1 for none, and ``spread`` (G, 8) about its mean (focal: relative)."""

    kind: I64
    spread: F64


@dataclass(frozen=True)
class MetricAdjustment:
    """Bundle adjustments of one metric stage: settings, and :meth:`run` for a model.

    ``lens_std`` is the prior standard deviation of k2 and k3 about 0 (0 fixes them), ``noise_floor_px`` the
    lower bound of the estimated noise, ``inflation`` a factor on the noise in the weights, for correlated
    residuals. The result does not depend on ``threads``.
    """

    prior: IntrinsicsPrior
    lens_std: float
    noise_floor_px: float
    hierarchical: HierarchicalPrior | None = None
    inflation: float = 1.0
    threads: int = 1

    def options(
        self, model: MetricEstimate, *, iterations: int = MAX_ITERATIONS, settled: float = SETTLED
    ) -> BundleOptions:
        """Weights and loss for the noise of a model."""
        return BundleOptions(
            sigma_px=self.inflation * model.sigma_px,
            loss_px=model.loss_sigmas * model.sigma_px,
            max_iterations=iterations,
            settled=settled,
            threads=self.threads,
        )

    def row_prior(self, model: MetricEstimate) -> IntrinsicsPrior:
        """Prior of each row of ``model.cameras.intrinsics``, 8 columns."""
        group = model.cameras.group
        first = np.unique(group, return_index=True)[1]
        mean, std = np.zeros((len(first), WIDTH)), np.zeros((len(first), WIDTH))
        mean[:, : K1 + 1], std[:, : K1 + 1] = self.prior.mean[first], self.prior.std[first]
        has_lens = _shares_a_lens(model) & (std[:, K1] > 0.0)
        std[:, K1 + 1 :] = np.where(has_lens, self.lens_std, 0.0)[:, None]
        # Images may be crops: the principal point has a bivariate t distribution, whose weight over that of
        # the normal one falls with the distance from the mean.
        off, known = model.cameras.intrinsics[:, CENTRE] - mean[:, CENTRE], std[:, CENTRE] > 0.0
        squared = np.sum(np.where(known, off, 0.0) ** 2, axis=1, keepdims=True)
        std[:, CENTRE] = np.hypot(std[:, CENTRE], np.where(known, np.sqrt(squared / (CENTRE_DOF + 2.0)), 0.0))
        unknown = ~np.isfinite(mean)
        mean[unknown] = model.cameras.intrinsics[unknown]
        kinds = self.hierarchical
        if kinds is None:
            return IntrinsicsPrior.unshared(mean, std)
        return IntrinsicsPrior.unshared(mean, std, kind=kinds.kind, spread=kinds.spread)

    def free(self, model: MetricEstimate) -> B8:
        """Which of the 8 intrinsics are estimated in some camera."""
        return np.asarray((self.row_prior(model).std > 0.0).any(axis=0))

    def run(
        self,
        model: MetricEstimate,
        *,
        free: B8 | None = None,
        fixed: B8 | None = None,
        iterations: int = MAX_ITERATIONS,
        settled: float = ROUND_SETTLED,
        keep_noise: bool = False,
    ) -> tuple[MetricEstimate, MetricBundleResult]:
        """Adjust the model to its inliers, by default all that the prior leaves ``free``; measure noise.

        ``fixed`` (V,) cameras do not move. With ``keep_noise`` the noise stays that of the
        adjustment, and the result is its minimum.
        """
        prior, moves = self.row_prior(model), self.free(model)
        result = refine_metric_bundle(
            model.cameras,
            model.X,
            _inlier_observations(model),
            free=moves if free is None else moves & free,
            prior=prior,
            options=self.options(model, iterations=iterations, settled=settled),
            fixed=fixed,
        )
        model = replace(model, cameras=result.cameras, X=result.X, sigmas_to_minimum=result.sigmas_to_minimum)
        if keep_noise:
            return model, result
        norms = np.linalg.norm(result.residual_px, axis=1)
        sigma = max(noise_from_distances(norms), self.noise_floor_px)
        width = best_huber_width(np.abs(result.residual_px).ravel(), sigma)
        model = replace(
            model,
            sigma_px=sigma,
            loss_sigmas=min(width / sigma, MAX_LOSS_SIGMAS),
            tail=tail_width(norms, sigma),
        )
        return model, result

    def scatter(self, model: MetricEstimate) -> BlockScatter:
        """Covariance of the cameras, and the scatter of their estimates between blocks of the scene."""
        return block_scatter(self._linearised(model))

    def poses(self, model: MetricEstimate) -> PoseUncertainty:
        """Covariance of the poses, and what the intrinsics and faults of the camera model change in them."""
        return pose_uncertainty(self._linearised(model))

    def _linearised(self, model: MetricEstimate) -> LinearisedFit:
        return linearise_fit(
            model.cameras,
            model.X,
            _inlier_observations(model),
            free=self.free(model),
            prior=self.row_prior(model),
            noise=(self.inflation * model.sigma_px, model.loss_sigmas * model.sigma_px),
        )


def _shares_a_lens(model: MetricEstimate) -> B8:
    """(G,) rows whose k2 and k3 at least ``MIN_VIEWS_PER_LENS`` registered views share."""
    assert model.cameras.shared is not None
    lens = np.unique(model.cameras.shared[:, K1 + 1], return_inverse=True)[1].reshape(-1)
    views = np.bincount(lens[model.cameras.group[model.registered]], minlength=int(lens.max()) + 1)
    return np.asarray(views[lens] >= MIN_VIEWS_PER_LENS)


def _inlier_observations(model: MetricEstimate) -> Observations:
    t, k = model.tracks, np.flatnonzero(model.inlier)
    if len(k) < MIN_OBSERVATIONS:
        raise StageFailure(
            "the metric upgrade leaves too few inliers",
            f"{counted(len(k), 'inlier observation')} at sufficient triangulation angles; at least "
            f"{MIN_OBSERVATIONS} are needed",
            "take images from more different places around the scene",
        )
    return Observations(t.view_index[k], t.point_index[k], t.xy[k])


def tail_width(norms: F64, sigma: float) -> float:
    """Tail width, 1 to 3, of residual lengths px relative to normal noise, from their 90 % quantile."""
    wide = float(np.quantile(norms, 0.9)) / RAYLEIGH_90
    return float(np.clip(wide / sigma, 1.0, 3.0))


def with_initial_gate(model: MetricEstimate) -> MetricEstimate:
    """Widen loss and gates, but not ``sigma_px`` (the weight of the prior), to the residuals at the start."""
    norms = residual_norms(model)
    norms = norms[np.isfinite(norms)]
    if not len(norms):
        return model
    wider = max(1.0, noise_from_distances(norms) / model.sigma_px)
    return replace(model, tail=wider, loss_sigmas=2.0 * wider)
