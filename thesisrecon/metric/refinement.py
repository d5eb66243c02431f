"""From the upgrade of chapter 7 to the final metric model.

Every candidate calibration is tried on the cameras it came from; the best goes on: cameras that the
projective stage postponed join by calibrated resection, all tracks are triangulated, what is assumed to vary
is freed under its priors and everything is adjusted together until what is explained settles. Where cameras
of one kind have values of their own, how much these scatter is measured and binds them. The end is a
self-check in numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.errors import StageFailure
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.metric.adjustment import FOCAL_AND_CENTRE, Adjustment, with_wide_gate
from thesisrecon.metric.checks import self_check
from thesisrecon.metric.model import (
    K1,
    MetricModel,
    mark,
    residual_norms,
    retriangulate,
    truncated_cost,
    upgraded_model,
)
from thesisrecon.metric.resection import Completion
from thesisrecon.metric.shared_camera import centre_of_a_bent_model, check_shared_cameras, contradicted_focals
from thesisrecon.metric.uncertainty import (
    OwnValues,
    bind,
    borrowing,
    estimate_population,
    intrinsic_intervals,
    own_values,
    with_open_sharing,
)
from thesisrecon.numerics.block_scatter import BlockScatter
from thesisrecon.numerics.noise import noise_from_distances
from thesisrecon.records import MetricResult, Reconstruction, SelfCalibration, Upgrade

SETTLED = 0.002
START_ROUNDS = 3
# Zoomed photographs lie in a long valley: the last adjustment must reach its bottom.
LAST_ITERATIONS = 25


@dataclass(frozen=True)
class MetricRefinement:
    """The metric stage.

    Parameters
    ----------
    outlier_sigmas : residual gates of the early and the late rounds, in noise sigmas.
    noise_floor_px : the noise is never taken to be below this.
    min_angle_deg : points under a smaller triangulation angle are left out.
    min_points : points of the model that a postponed camera must see.
    max_rotation_residual : an upgraded camera further from a scaled rotation than this (Frobenius norm of
        3 C C' / tr - I) was made wrong by bad matches and is postponed too.
    rounds : final rounds of triangulation and adjustment of everything, at the most.
    lens_std : prior standard deviation around 0 of the radial coefficients k2 and k3 of a camera that took
        several photographs; 0 leaves them out.
    model_floor_rel : floor of every stated standard deviation, relative to the focal, where the data show
        that the camera model is not the whole truth: pixels are square to one or two parts in a thousand.
    undetermined_rel : a focal whose own matches leave it open by more than this (95 %, relative) is named.
    """

    outlier_sigmas: tuple[float, float] = (12.0, 7.0)
    noise_floor_px: float = 0.02
    min_angle_deg: float = 0.05
    min_points: int = 15
    max_rotation_residual: float = 0.3
    rounds: int = 4
    lens_std: float = 0.02
    model_floor_rel: float = 1e-3
    undetermined_rel: float = 0.1

    def refine(
        self,
        reconstruction: Reconstruction,
        calibration: SelfCalibration,
        *,
        prior: IntrinsicsPrior,
        rng: np.random.Generator,
    ) -> MetricResult:
        """The final model of one projective reconstruction; ``StageFailure`` where no candidate survives."""
        adjustment = Adjustment(prior, self.lens_std, self.noise_floor_px)
        trials = [self._start(reconstruction, u, adjustment) for u in calibration.candidates]
        models = [m for m in trials if m is not None]
        if not models:
            raise _no_candidate(prior, len(trials))
        gate = 3.0 * float(np.median([m.sigma_px for m in models]))
        costs = np.array([truncated_cost(m, gate) for m in models])
        completion = Completion(self.outlier_sigmas, np.radians(self.min_angle_deg), self.min_points)
        model, refused = completion.run(models[int(costs.argmin())], adjustment, rng)
        reasons = [
            "" if model.registered[v] else refused.get(v, reconstruction.reasons[v] or NOTHING_SHARED)
            for v in range(len(model.registered))
        ]
        model, adjustment, own, scatter = self._finish(model, adjustment)
        model = mark(model, sigmas=self.outlier_sigmas[1], min_angle=np.radians(self.min_angle_deg))
        sharing = check_shared_cameras(model, adjustment)
        borrowed = borrowing(own, adjustment.population, model.cameras.group)
        intervals = intrinsic_intervals(
            model,
            scatter,
            adjustment.row_prior(model),
            floor_rel=self.model_floor_rel,
            borrowed=borrowed,
            noise_inflation=adjustment.inflation,
        )
        intervals = with_open_sharing(intervals, sharing.focal_std)
        check, failed_checks = self_check(model, calibration, intervals, sigmas=self.outlier_sigmas[1])
        failed_checks += [*contradicted_focals(model, adjustment), *sharing.failed_checks]
        failed_checks += centre_of_a_bent_model(model, adjustment, scatter)
        final = _as_reconstruction(model, reasons)
        said = borrowed.warnings(np.flatnonzero(model.registered).tolist(), self.undetermined_rel / 1.96)
        said += sharing.warnings
        return MetricResult(final, intervals, check, not failed_checks, tuple(failed_checks), said)

    def _start(
        self, reconstruction: Reconstruction, upgrade: Upgrade, adjustment: Adjustment
    ) -> MetricModel | None:
        """The core cameras upgraded, on the points and observations of the projective stage.

        These explain the photographs with cameras of any principal point, and so do not say how far off an
        image centre is: all of them are kept at first, the principal point is free with the focal, and the
        gate narrows as the residuals shrink.
        """
        model = upgraded_model(reconstruction, upgrade, adjustment.prior, self.max_rotation_residual)
        if model is None:
            return None
        early, _ = self.outlier_sigmas
        # Without a lens the noise looks larger than it is: the gate must not be narrower than before.
        gentle = replace(adjustment, noise_floor_px=max(0.1, adjustment.noise_floor_px))
        model = with_wide_gate(model)
        for _ in range(START_ROUNDS):
            if model.valid.sum() < 20:
                return None
            model = mark(model, sigmas=early, min_angle=0.0)
            model = gentle.run(model, free=FOCAL_AND_CENTRE, iterations=15)[0]
        return mark(model, sigmas=early, min_angle=0.0)

    def _finish(
        self, model: MetricModel, adjustment: Adjustment
    ) -> tuple[MetricModel, Adjustment, OwnValues, BlockScatter]:
        """Everything free under its priors; then, where cameras of one kind have values of their own, bound
        to their kind."""
        model = self._settle(model, adjustment)
        scatter = adjustment.scatter(model)
        own = own_values(model, adjustment, scatter, self.model_floor_rel)
        assert model.cameras.shared is not None
        population = estimate_population(own, model.cameras.shared)
        if population is None:
            return model, adjustment, own, scatter
        inflation = float(np.sqrt(max(scatter.median_ratio, 1.0)))
        model, adjustment = bind(model, replace(adjustment, inflation=inflation), population)
        model = self._settle(model, adjustment)
        return model, adjustment, own, adjustment.scatter(model)

    def _settle(self, model: MetricModel, adjustment: Adjustment) -> MetricModel:
        """Rounds of adjustment and triangulation until the explained observations stay the same, ended by an
        adjustment."""
        late, angle = self.outlier_sigmas[1], np.radians(self.min_angle_deg)
        for _ in range(self.rounds):
            before = model.ok
            model = adjustment.run(model, iterations=10)[0]
            model = retriangulate(model, sigmas=late, min_angle=angle)
            if np.count_nonzero(before != model.ok) < SETTLED * len(before):
                break
        return adjustment.run(model, iterations=LAST_ITERATIONS)[0]


NOTHING_SHARED = "shares no points with the model"


def _no_candidate(prior: IntrinsicsPrior, tried: int) -> StageFailure:
    if not prior.focal_known.any():
        return StageFailure(
            "no candidate calibration survives metric bundle adjustment",
            f"{tried} were tried",
            "photograph the scene from more directions",
        )
    wide = float(prior.std[prior.focal_known, 0].max())
    return StageFailure(
        "the photographs contradict the focal length that was given",
        f"none of {tried} calibrations near it (+- {wide:.1%}) explains them",
        "leave the prior out, or give it a larger focal_std_rel",
    )


def _as_reconstruction(model: MetricModel, reasons: list[str]) -> Reconstruction:
    registered = model.registered
    P = np.where(registered[:, None, None], model.cameras.P, 0.0)
    K = np.where(registered[:, None, None], model.cameras.K, 0.0)
    distortion = np.where(registered[:, None], model.cameras.intrinsics[model.cameras.group, K1:], 0.0)
    X = np.where(model.valid[:, None], np.column_stack([model.X, np.ones(len(model.X))]), 0.0)
    norms = residual_norms(model)
    sigma = noise_from_distances(norms) if len(norms) else model.sigma_px
    return Reconstruction(
        "metric",
        P,
        X,
        registered,
        model.valid,
        model.ok,
        model.tracks,
        model.sizes,
        sigma,
        tuple(reasons),
        K,
        distortion,
    )
