"""Bundle adjustment of a metric estimate under its prior; noise and loss are estimated from the residuals.

Also a richer camera model (intrinsics per image) where the images contradict shared intrinsics: optical
stabilisation and crops move the principal point, focus and zoom change the focal length. It is kept if it
predicts held-out observations far better.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import Notice, StageFailure, counted
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.metric._model import (
    CENTRE,
    DECENTRING,
    DECENTRING_STD,
    FOCAL,
    K1,
    LENS_STD,
    LENS_WIDTH,
    WIDTH,
    MetricEstimate,
    camera_rows,
    reproject_observations,
)
from thesisrecon.optimize.bundle.knowledge import NO_PRIOR, BundleKnowledge, PositionPrior
from thesisrecon.optimize.bundle.metric import (
    MAX_ITERATIONS,
    BundleOptions,
    MetricBundleResult,
    refine_metric_bundle,
)
from thesisrecon.optimize.bundle.projection import LENS, Observations
from thesisrecon.optimize.bundle.scatter import LinearisedFit, linearise_fit, median_blocks
from thesisrecon.optimize.least_squares import best_huber_width, noise_from_distances
from thesisrecon.records import IntrinsicsPrior

MIN_OBSERVATIONS = 40
SETTLED, ROUND_SETTLED = 1e-4, 5e-3
"""Predicted gain of the cameras, half a squared distance in standard deviations, at which an adjustment ends;
larger if the observations are chosen again after it."""
MAX_CHANGE = 0.05
"""Relative change of centres and focal lengths up to which the simpler camera model is accurate enough."""
CENTRE_DOF = 3  # degrees of freedom of the prior of the principal point: the fewest with a finite variance
FOCAL_AND_CENTRE = np.isin(np.arange(LENS_WIDTH), (FOCAL, *CENTRE))


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
    residuals. Lenses in tables of twelve columns may be ``decentred``; ``centres`` are known positions
    of cameras; angles of view change by ``lens_change`` degrees with another lens that predicts as well. The
    result does not depend on ``threads``.
    """

    prior: IntrinsicsPrior
    lens_std: float
    noise_floor_px: float
    hierarchical: HierarchicalPrior | None = None
    inflation: float = 1.0
    threads: int = 1
    decentred: bool = False
    centres: PositionPrior = NO_PRIOR
    lens_change: tuple[float, float] = (0.0, 0.0)

    def options(
        self, model: MetricEstimate, *, iterations: int = MAX_ITERATIONS, settled: float = SETTLED
    ) -> BundleOptions:
        """Weights and loss for the noise of a model."""
        return BundleOptions(
            sigma_px=self.inflation * model.sigma_px, loss_px=model.loss_sigmas * model.sigma_px,
            max_iterations=iterations, settled=settled, threads=self.threads,
        )  # fmt: skip

    def row_prior(self, model: MetricEstimate) -> IntrinsicsPrior:
        """Prior of each row of ``model.cameras.intrinsics``."""
        group = model.cameras.group
        first = np.unique(group, return_index=True)[1]
        mean, std = np.zeros((2, *model.cameras.intrinsics.shape))
        mean[:, : K1 + 1], std[:, : K1 + 1] = self.prior.mean[first], self.prior.std[first]
        has_lens = _shares_a_lens(model) & (std[:, K1] > 0.0)
        std[:, K1 + 1 : WIDTH] = np.where(has_lens, self.lens_std, 0.0)[:, None]
        for row in np.flatnonzero(has_lens) if mean.shape[1] == LENS_WIDTH else ():
            lens = model.cameras.intrinsics[row, LENS]
            coefficients = LENS_STD[int(lens)]
            mean[row, LENS], mean[row, K1], std[row, K1:] = lens, 0.0, 0.0
            std[row, K1 : K1 + len(coefficients)] = coefficients
            std[row, DECENTRING] = DECENTRING_STD if self.decentred else 0.0
        # Images may be crops: the principal point has a bivariate t distribution, whose weight over that of
        # the normal one falls with the distance from the mean.
        off, known = model.cameras.intrinsics[:, CENTRE] - mean[:, CENTRE], std[:, CENTRE] > 0.0
        squared = np.sum(np.where(known, off, 0.0) ** 2, axis=1, keepdims=True)
        std[:, CENTRE] = np.hypot(std[:, CENTRE], np.where(known, np.sqrt(squared / (CENTRE_DOF + 2.0)), 0.0))
        unknown = ~np.isfinite(mean)
        mean[unknown] = model.cameras.intrinsics[unknown]
        kinds = {} if self.hierarchical is None else vars(self.hierarchical)
        return IntrinsicsPrior.unshared(mean, std, **kinds)

    def shares_a_lens(self, model: MetricEstimate) -> bool:
        """Whether some views share a lens whose coefficients are estimated."""
        first = np.unique(model.cameras.group, return_index=True)[1]
        return bool((_shares_a_lens(model) & (self.prior.std[first, K1] > 0.0)).any())

    def free(self, model: MetricEstimate) -> B8:
        """Which of the intrinsics are estimated in some camera."""
        return np.asarray((self.row_prior(model).std > 0.0).any(axis=0))

    def run(
        self, model: MetricEstimate, *, free: B8 | None = None, fixed: B8 | None = None,
        iterations: int = MAX_ITERATIONS, settled: float = ROUND_SETTLED, keep_noise: bool = False,
    ) -> tuple[MetricEstimate, MetricBundleResult]:  # fmt: skip
        """Adjust the model to its inliers, all that is ``free`` but ``fixed`` (V,) cameras; measure noise."""
        moves, options = self.free(model), self.options(model, iterations=iterations, settled=settled)
        moves = moves if free is None else moves & free[: len(moves)]
        seen = np.isin(self.centres.index, model.tracks.view_index[model.inlier])
        known = PositionPrior(*(a[seen] for a in vars(self.centres).values()))
        result = refine_metric_bundle(
            model.cameras, model.X, inlier_observations(model), free=moves,
            prior=self.row_prior(model), options=options, fixed=fixed,
            knowledge=BundleKnowledge(centres=known) if seen.any() else None,
        )  # fmt: skip
        model = replace(model, cameras=result.cameras, X=result.X, sigmas_to_minimum=result.sigmas_to_minimum)
        if keep_noise:
            return model, result
        norms = np.linalg.norm(result.residual_px, axis=1)
        sigma = max(noise_from_distances(norms), self.noise_floor_px)
        width = best_huber_width(np.abs(result.residual_px).ravel(), sigma)
        # For a larger width it is least squares.
        loss, tail = min(width / sigma, 20.0), tail_width(norms, sigma)
        return replace(model, sigma_px=sigma, loss_sigmas=loss, tail=tail), result

    def linearised(self, model: MetricEstimate) -> LinearisedFit:
        """The linearised adjustment of a model at its minimum."""
        noise = self.inflation * model.sigma_px, model.loss_sigmas * model.sigma_px
        seen, free, prior = inlier_observations(model), self.free(model), self.row_prior(model)
        return linearise_fit(model.cameras, model.X, seen, free=free, prior=prior, noise=noise)


def _shares_a_lens(model: MetricEstimate) -> B8:
    """(G,) rows whose k2 and k3 at least three registered views share; else they are not estimated."""
    lens = np.unique(model.cameras.shared[:, K1 + 1], return_inverse=True)[1].reshape(-1)
    views = np.bincount(lens[model.cameras.group[model.registered]], minlength=int(lens.max()) + 1)
    return np.asarray(views[lens] >= 3)


def inlier_observations(model: MetricEstimate) -> Observations:
    t, k = model.tracks, np.flatnonzero(model.inlier)
    if len(k) < MIN_OBSERVATIONS:
        raise StageFailure.of("few-metric-inliers", counted(len(k), "inlier observation"), MIN_OBSERVATIONS)
    return Observations(t.view_index[k], t.point_index[k], t.xy[k])


def tail_width(norms: F64, sigma: float) -> float:
    """Tail width, 1 to 3, of residual lengths px relative to normal noise, from their 90 % quantile."""
    # Over that of the length of 2-D normal noise (Rayleigh).
    wide = float(np.quantile(norms, 0.9)) / 2.1460
    return float(np.clip(wide / sigma, 1.0, 3.0))


def richer_models(contradicted: B8, prior: IntrinsicsPrior) -> Iterator[tuple[int, ...]]:
    """Columns with one value per image that contain the ``contradicted`` (8,) ones, simplest model first."""
    if not contradicted.any():
        return
    unknown, richer = np.flatnonzero((prior.std > 0.0).any(axis=0)), (CENTRE, (FOCAL,), (FOCAL, *CENTRE))
    # Without known columns two models may be the same.
    for columns in dict.fromkeys(tuple(c for c in columns if c in unknown) for columns in richer):
        if np.isin(np.flatnonzero(contradicted), columns).all():
            yield columns


def with_prior(
    model: MetricEstimate, adjustment: MetricAdjustment, prior: IntrinsicsPrior
) -> tuple[MetricEstimate, MetricAdjustment]:
    """The model under a prior that leaves more unknown, without hierarchical prior; new columns are 0."""
    group, table = camera_rows(prior)
    rows = model.cameras.intrinsics[model.cameras.group[np.unique(group, return_index=True)[1]]]
    rows = np.pad(rows, ((0, 0), (0, table.shape[1] - rows.shape[1])))
    cameras = replace(model.cameras, intrinsics=rows, group=group, shared=table)
    return replace(model, cameras=cameras), replace(adjustment, prior=prior, hierarchical=None, inflation=1.0)


def held_out_observations(model: MetricEstimate) -> I64:
    """Inliers of every fifth block of neighbouring points, others in each view; points keep two or more."""
    t = model.tracks
    count = np.bincount(t.point_index[model.inlier], minlength=t.n_points)
    block = median_blocks(model.X, count > 0)
    held = model.inlier & ((block[t.point_index] + t.view_index) % 5 == 0)
    left = count - np.bincount(t.point_index[held], minlength=t.n_points)
    return np.flatnonzero(held & (left >= 2)[t.point_index])


def remaining_cost(
    simple: tuple[MetricEstimate, MetricAdjustment], rich: tuple[MetricEstimate, MetricAdjustment]
) -> float:
    """Cost of held-out observations, richer over simple model; 1 if there are fewer than 30."""
    costs = _held_out_costs(simple, rich)
    return 1.0 if costs is None else float(costs[1].mean() / costs[0].mean())


def predicts_better(
    simple: tuple[MetricEstimate, MetricAdjustment], rich: tuple[MetricEstimate, MetricAdjustment]
) -> bool:
    """Whether a richer model predicts held-out observations better by three standard errors."""
    costs = _held_out_costs(simple, rich)
    if costs is None:
        return False
    gain = costs[0] - costs[1]
    return bool(gain.mean() > 3.0 * gain.std() / np.sqrt(len(gain)))


def best_predictors(models: Sequence[MetricEstimate], adjustment: MetricAdjustment) -> list[MetricEstimate]:
    """The model that predicts held-out observations best, and those worse by three standard errors at most.

    The observations are some of the inliers of any of the models: those that image less of the scene do not
    choose by which they are judged.
    """
    unit = min(models, key=lambda model: model.sigma_px)
    if len(models) == 1:
        return [unit]
    held = held_out_observations(replace(unit, inlier=np.any([m.inlier for m in models], axis=0)))
    costs = [_held_out_cost(m, adjustment, held, unit) for m in models]
    best = int(np.argmin([cost.sum() for cost in costs]))
    worse = [(cost - costs[best]).sum() / (np.linalg.norm(cost - costs[best]) + 1e-300) for cost in costs]
    return [models[best], *(m for k, m in enumerate(models) if k != best and worse[k] <= 3.0)]


def _held_out_costs(
    simple: tuple[MetricEstimate, MetricAdjustment], rich: tuple[MetricEstimate, MetricAdjustment]
) -> tuple[F64, F64] | None:
    """Costs of held-out observations of both models; None if there are fewer than 30."""
    model = simple[0]
    held = held_out_observations(replace(model, inlier=model.inlier & rich[0].inlier))
    if len(held) < 30:
        return None
    return _held_out_cost(*simple, held, model), _held_out_cost(*rich, held, model)


def _held_out_cost(
    model: MetricEstimate, adjustment: MetricAdjustment, held: I64, unit: MetricEstimate
) -> F64:
    """Huber's loss of held-out observations, in the noise and the loss of the model ``unit``."""
    inlier = model.inlier.copy()
    inlier[held] = False
    model = adjustment.run(replace(model, inlier=inlier))[0]
    t = model.tracks
    xy, _ = reproject_observations(model, t.view_index[held], t.point_index[held])
    size = np.linalg.norm(np.nan_to_num(xy, nan=np.inf) - t.xy[held], axis=1) / unit.sigma_px
    size, loss = np.minimum(size, 100.0), unit.loss_sigmas
    return np.asarray(np.where(size < loss, 0.5 * size**2, loss * (size - 0.5 * loss)))


def differences_of_images(model: MetricEstimate, columns: tuple[int, ...]) -> str:
    """A sentence on the richer model and how much its values differ between images."""
    views = np.flatnonzero(model.registered)
    rows = model.cameras.intrinsics[model.cameras.group[views]]
    longest = model.sizes[views].max(axis=1, keepdims=True)
    centre = (rows[:, CENTRE] - (model.sizes[views] - 1) / 2) / longest
    apart = f"principal points up to {np.ptp(centre, axis=0).max():.1%} of the long side apart"
    if FOCAL not in columns:
        return Notice("own-centre", apart)
    focal = rows[:, FOCAL] / longest[:, 0]
    return Notice("own-intrinsics", focal.max() / focal.min() - 1.0, apart)


@dataclass(frozen=True)
class CameraDifferences:
    """Largest differences of the cameras between two camera models.

    ``centre`` relative to the RMS radius of the camera path, ``focal`` relative, ``principal_point`` over the
    focal length.
    """

    centre: float
    focal: float
    principal_point: float

    @property
    def harmless(self) -> bool:
        """Whether centres and focal lengths hardly depend on the camera model."""
        return max(self.centre, self.focal) < MAX_CHANGE


def camera_differences(a: MetricEstimate, b: MetricEstimate) -> CameraDifferences:
    """Differences between the cameras of two estimates after a similarity alignment of their centres.

    Infinite for fewer than three cameras, whose centres a similarity aligns whatever they are.
    """
    v = np.flatnonzero(a.registered & b.registered)
    if len(v) < 3:
        return CameraDifferences(np.inf, np.inf, np.inf)
    A, B = (m.cameras.centres[v] for m in (a, b))
    move = estimate_similarity(B, A)
    off = np.linalg.norm(A - move.apply(B), axis=1)
    radius = np.sqrt(np.mean(np.sum((A - A.mean(axis=0)) ** 2, axis=1)))
    f, g = (m.cameras.intrinsics[m.cameras.group[v], FOCAL] for m in (a, b))
    c, d = (m.cameras.intrinsics[m.cameras.group[v]][:, CENTRE] for m in (a, b))
    moved = float((np.abs(d - c) / f[:, None]).max())
    return CameraDifferences(float(off.max() / radius), float(np.abs(np.log(g / f)).max()), moved)
