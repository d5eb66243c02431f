"""From the upgrade of chapter 7 to the final metric model.

Every candidate calibration is tried on the cameras it came from; the best goes on: cameras that the
projective stage postponed join by calibrated resection, all tracks are triangulated, the principal point and
the radial distortion are freed under their priors, and what remains is adjusted together. The end is a
self-check in numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.errors import StageFailure
from thesisrecon.metric.intervals import intrinsic_intervals
from thesisrecon.metric.model import (
    MetricModel,
    mark,
    residual_norms,
    retriangulate,
    truncated_cost,
)
from thesisrecon.metric.resection import add_missing_cameras
from thesisrecon.metric.self_check import self_check
from thesisrecon.optimize.metric_bundle import (
    BundleOptions,
    IntrinsicsPrior,
    MetricBundleResult,
    MetricCameras,
    Observations,
    refine_metric_bundle,
)
from thesisrecon.robust.noise import noise_from_distances
from thesisrecon.types import (
    B8,
    I64,
    Assumptions,
    MetricResult,
    Reconstruction,
    SelfCalibration,
    Upgrade,
)

F64 = NDArray[np.float64]

MIN_OBSERVATIONS = 40
FOCAL_ONLY = np.array([True, False, False, False, False, False])


@dataclass(frozen=True)
class UpgradeAndBundle:
    """The metric stage.

    Parameters
    ----------
    outlier_sigmas : residual gates of the early and the late rounds, in noise sigmas.
    noise_floor_px : the noise is never taken to be below this.
    min_angle_deg : points under a smaller triangulation angle are left out.
    min_points : points of the model that a postponed camera must see.
    max_rotation_residual : an upgraded camera further from a scaled rotation than this (Frobenius norm of
        3 C C' / tr - I) was made wrong by bad matches and is postponed too.
    rounds : final rounds of triangulation and adjustment of everything.
    model_floor_rel : floor of every stated standard deviation, relative to the focal: what the pinhole model
        with one radial coefficient leaves unexplained in real lenses, and the pixels that are taken to be
        square and are so only to one or two parts in a thousand.
    """

    outlier_sigmas: tuple[float, float] = (12.0, 7.0)
    noise_floor_px: float = 0.1
    min_angle_deg: float = 0.5
    min_points: int = 15
    max_rotation_residual: float = 0.3
    rounds: int = 2
    model_floor_rel: float = 1e-3

    def refine(
        self,
        reconstruction: Reconstruction,
        calibration: SelfCalibration,
        *,
        assumed: Assumptions,
        rng: np.random.Generator,
    ) -> MetricResult:
        """The final model of one projective reconstruction; ``StageFailure`` where no candidate survives."""
        trials = [self._start(reconstruction, u, assumed) for u in calibration.candidates]
        models = [m for m in trials if m is not None]
        if not models and assumed.focal_known.any():
            wide = float(assumed.std[assumed.focal_known, 0].max())
            raise StageFailure(
                "the photographs contradict the focal length that was given",
                f"none of {len(trials)} calibrations near it (+- {wide:.1%}) explains them",
                "leave the prior out, or give it a larger focal_std_rel",
            )
        if not models:
            raise StageFailure(
                "no candidate calibration survives metric bundle adjustment",
                f"{len(trials)} were tried",
                "photograph the scene from more directions",
            )
        gate = 3.0 * float(np.median([m.sigma_px for m in models]))
        costs = np.array([truncated_cost(m, gate) for m in models])
        model = models[int(costs.argmin())]
        model, reasons = self._complete(model, reconstruction, assumed, rng)
        model, bundle, bundle_index = self._finish(model, assumed)
        intervals = intrinsic_intervals(
            model,
            bundle,
            self._prior(model, assumed),
            floor_rel=self.model_floor_rel,
            indices=bundle_index,
        )
        check, doubts = self_check(model, calibration, intervals, sigmas=self.outlier_sigmas[1])
        final = _as_reconstruction(model, reasons)
        return MetricResult(final, intervals, check, not doubts, tuple(doubts))

    def _start(
        self, reconstruction: Reconstruction, upgrade: Upgrade, assumed: Assumptions
    ) -> MetricModel | None:
        """The core cameras upgraded, on the points of the projective stage, with only the focals free."""
        started = _upgraded_model(reconstruction, upgrade, assumed, self.max_rotation_residual)
        if started is None:
            return None
        early, _ = self.outlier_sigmas
        model = mark(started, sigmas=2.0 * early, min_angle=0.0)
        for _ in range(2):
            if model.valid.sum() < 20:
                return None
            model = self._bundle(model, FOCAL_ONLY, assumed, iterations=10)[0]
            model = mark(model, sigmas=early, min_angle=0.0)
        return model

    def _complete(
        self,
        model: MetricModel,
        reconstruction: Reconstruction,
        assumed: Assumptions,
        rng: np.random.Generator,
    ) -> tuple[MetricModel, list[str]]:
        """All tracks triangulated, and the postponed cameras, in two passes since each adds points for the
        other."""
        early, late = self.outlier_sigmas
        angle = np.radians(self.min_angle_deg)
        refused: dict[int, str] = {}
        model = retriangulate(model, sigmas=early, min_angle=angle)
        for _ in range(2):
            if model.registered.all():
                break
            before = int(model.registered.sum())
            model, refused = add_missing_cameras(model, sigmas=early, min_points=self.min_points, rng=rng)
            if model.registered.sum() == before:
                break
            model = retriangulate(model, sigmas=early, min_angle=angle)
            model = self._bundle(model, FOCAL_ONLY, assumed, iterations=6)[0]
            model = retriangulate(model, sigmas=late, min_angle=angle)
        reasons = [
            ""
            if model.registered[v]
            else refused.get(v, reconstruction.reasons[v] or "shares no points with the model")
            for v in range(len(model.registered))
        ]
        return model, reasons

    def _finish(
        self, model: MetricModel, assumed: Assumptions
    ) -> tuple[MetricModel, MetricBundleResult, I64]:
        free = np.asarray((assumed.std > 0.0).any(axis=0))
        angle = np.radians(self.min_angle_deg)
        for _ in range(self.rounds):
            model, bundle, index = self._bundle(model, free, assumed, iterations=12)
            model = retriangulate(model, sigmas=self.outlier_sigmas[1], min_angle=angle)
        model, bundle, index = self._bundle(model, free, assumed, iterations=15, covariance=True)
        return mark(model, sigmas=self.outlier_sigmas[1], min_angle=angle), bundle, index

    def _bundle(
        self,
        model: MetricModel,
        free: B8,
        assumed: Assumptions,
        *,
        iterations: int,
        covariance: bool = False,
    ) -> tuple[MetricModel, MetricBundleResult, I64]:
        t = model.tracks
        k = np.flatnonzero(model.ok)
        if len(k) < MIN_OBSERVATIONS:
            raise StageFailure(
                "hardly any point survives the metric upgrade",
                f"{len(k)} observations fit the cameras at angles of {self.min_angle_deg} deg or more",
                "walk further around the scene between photographs",
            )
        result = refine_metric_bundle(
            model.cameras,
            model.X,
            Observations(t.view_index[k], t.point_index[k], t.xy[k]),
            free=free,
            prior=self._prior(model, assumed),
            options=BundleOptions(
                sigma_px=model.sigma_px,
                loss_px=2.0 * model.sigma_px,
                max_iterations=iterations,
                covariance=covariance,
            ),
        )
        norms = np.asarray(np.linalg.norm(result.residual_px, axis=1))
        sigma = max(noise_from_distances(norms), self.noise_floor_px)
        return replace(model, cameras=result.cameras, X=result.X, sigma_px=sigma), result, k

    def _prior(self, model: MetricModel, assumed: Assumptions) -> IntrinsicsPrior:
        """What is assumed, per camera; a value that is known exactly keeps a deviation of next to nothing."""
        rows = np.array(
            [np.flatnonzero(model.cameras.group == g)[0] for g in range(len(model.cameras.intrinsics))]
        )
        mean, std = assumed.mean[rows].copy(), np.maximum(assumed.std[rows], 1e-9)
        silent = ~np.isfinite(mean)
        mean[silent] = model.cameras.intrinsics[silent]
        return IntrinsicsPrior(mean, std)


def _upgraded_model(
    reconstruction: Reconstruction, upgrade: Upgrade, assumed: Assumptions, max_rotation_residual: float
) -> MetricModel | None:
    """Rotations, translations and intrinsics of an upgraded projective reconstruction."""
    group = assumed.group
    views = np.flatnonzero(reconstruction.registered)
    P = reconstruction.P[views] @ np.linalg.inv(upgrade.metric_from_projective)
    Q = np.linalg.inv(upgrade.K[views]) @ P
    Q *= np.where(np.linalg.det(Q[:, :, :3]) < 0, -1.0, 1.0)[:, None, None]
    U, S, Vt = np.linalg.svd(Q[:, :, :3])
    scale = S.mean(axis=1)
    off = np.sqrt(np.sum((3.0 * S**2 / np.sum(S**2, axis=1, keepdims=True) - 1.0) ** 2, axis=1))
    good = off < max_rotation_residual
    if good.sum() < 3:
        return None
    n = len(reconstruction.P)
    R, t = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    R[views], t[views] = U @ Vt, Q[:, :, 3] / scale[:, None]
    registered = np.zeros(n, dtype=bool)
    registered[views[good]] = True
    intrinsics = _intrinsics(upgrade.K, reconstruction.registered, reconstruction.sizes, assumed)
    Xm = reconstruction.X @ upgrade.metric_from_projective.T
    with np.errstate(divide="ignore", invalid="ignore"):
        X = Xm[:, :3] / Xm[:, 3:]
    finite = reconstruction.valid & np.isfinite(X).all(axis=1)
    X = np.where(finite[:, None], X, 0.0)
    # The upgrade fixes the frame up to scale: bring the cameras' spread to 1.
    spread = float(np.median(np.linalg.norm(X[finite] - np.median(X[finite], axis=0), axis=1)))
    cameras = MetricCameras(R, t / spread, intrinsics, group)
    ok = reconstruction.inlier & registered[reconstruction.tracks.view_index]
    return MetricModel(
        reconstruction.tracks,
        reconstruction.sizes,
        cameras,
        registered,
        X / spread,
        finite,
        ok,
        reconstruction.sigma_px,
    )


def _intrinsics(K: F64, registered: B8, sizes: I64, assumed: Assumptions) -> F64:
    """(G, 6) rows from the K of the registered views; a group without any starts from the others' field of
    view."""
    group, longest = assumed.group, sizes.max(axis=1)
    typical = float(np.median(K[registered, 0, 0] / longest[registered]))
    rows = np.zeros((int(group.max()) + 1, 6))
    for g in range(len(rows)):
        views = np.flatnonzero(group == g)
        known = views[registered[views]]
        focal = float(np.median(K[known, 0, 0])) if len(known) else typical * longest[views[0]]
        rows[g] = [focal, *assumed.mean[views[0], 1:]]
    return rows


def _as_reconstruction(model: MetricModel, reasons: list[str]) -> Reconstruction:
    registered = model.registered
    P = np.where(registered[:, None, None], model.cameras.P, 0.0)
    K = np.where(registered[:, None, None], model.cameras.K, 0.0)
    k1 = np.where(registered, model.cameras.intrinsics[model.cameras.group, 5], 0.0)
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
        k1,
    )
