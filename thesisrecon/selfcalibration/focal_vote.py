"""Focals of all cameras by a vote of all pairs, each with what its F knows.

Every pair gives the likelihood of the focals on a grid (:mod:`focal_from_fundamental`); a pair whose F is
wrong or says nothing changes little, and a camera for which no pair speaks keeps its wide interval and is
named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.optimize.levenberg_marquardt import minimize_residuals
from thesisrecon.selfcalibration.conclusion import (
    Answer,
    conclude,
    guarded,
    require_cameras,
    square_calibrations,
    square_std,
)
from thesisrecon.selfcalibration.focal_from_fundamental import kruppa_chi_square, kruppa_whitening
from thesisrecon.selfcalibration.focal_scan import log_grid, planes_for_focals
from thesisrecon.selfcalibration.frame import ReferenceFrame, assumed_frame
from thesisrecon.selfcalibration.intrinsics import UnknownIntrinsics, focal_prior, unknown_intrinsics
from thesisrecon.selfcalibration.kruppa import dual_images, kruppa_residuals, require_pairs
from thesisrecon.selfcalibration.pair_geometry import PairGeometry, camera_pairs
from thesisrecon.selfcalibration.refinement import RotationCriterion
from thesisrecon.types import Assumptions, Reconstruction, SelfCalibration

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

STRAYED = 4.0
"""Standard deviations of the vote, beyond which the joint answer has left it."""

WRONG_PAIR = 1e-2
"""Chance that a pair's F is wrong, so that no pair alone can forbid a focal."""


@dataclass(frozen=True)
class FocalVote:
    """``log_f`` and ``std`` (G,) of the groups' log focals; ``support`` (G, B) log posterior on the grid."""

    log_f: F64
    std: F64
    support: F64


def vote_on_focals(
    pairs: PairGeometry,
    group: I64,
    grid: F64,
    *,
    prior: tuple[F64, F64],
    principal_std: float = 0.01,
) -> FocalVote:
    """Log focals of G groups of cameras from all pairs.

    group (R,) camera number, dense; grid (B,) of log focals, evenly spaced; ``prior`` finite means and
    standard deviations (G,) of log focals (:func:`focal_prior`). Pairs within a group are asked about one
    focal, pairs between groups about two, and the other's is integrated out. Pairs share observations: of
    V (V - 1) / 2 pairs only 2 V - 3 are independent, and the sum of the votes is scaled down accordingly.
    """
    n, cell = int(group.max()) + 1, float(grid[1] - grid[0])
    # A prior narrower than a cell must not fall between two of them.
    mean, std = prior[0][:, None], np.hypot(prior[1], cell)[:, None]
    log_prior = -0.5 * ((grid[None] - mean) / std) ** 2
    support = np.zeros((n, len(grid)))
    same = group[pairs.i] == group[pairs.j]
    if same.any():
        chi = kruppa_chi_square(_some(pairs, same), grid, grid, cell=cell, principal_std=principal_std)
        np.add.at(support, group[pairs.i[same]], _robust(-0.5 * chi))
    if (~same).any():
        between = _some(pairs, ~same)
        first, second = (a.ravel() for a in np.meshgrid(grid, grid, indexing="ij"))
        for m in range(len(between.i)):
            one = _some(between, np.arange(len(between.i)) == m)
            chi = kruppa_chi_square(one, first, second, cell=cell, principal_std=principal_std)
            table = -0.5 * chi.reshape(len(grid), len(grid))
            gi, gj = group[between.i[m]], group[between.j[m]]
            support[gi] += _robust(_marginal(table + log_prior[gj]))
            support[gj] += _robust(_marginal(table.T + log_prior[gi]))
    posterior = independent_share(pairs) * support + log_prior
    log_f, std = _moments(grid, posterior)
    return FocalVote(log_f, np.hypot(std, cell / np.sqrt(12.0)), posterior)


def independent_share(pairs: PairGeometry) -> float:
    """(2 V - 3) / M, at most 1, of M pairs between V cameras: what each says that the others do not."""
    views = len(np.unique(np.concatenate([pairs.i, pairs.j])))
    return min(1.0, (2.0 * views - 3.0) / max(len(pairs.i), 1))


def _some(pairs: PairGeometry, chosen: NDArray[np.bool_]) -> PairGeometry:
    return PairGeometry(pairs.i[chosen], pairs.j[chosen], pairs.F[chosen], pairs.covariance[chosen])


def _marginal(table: F64) -> F64:
    """Log of the mean over the second axis of exp(table), best cell 0."""
    top = float(table.max())
    return np.asarray(np.log(np.mean(np.exp(table - top), axis=1) + 1e-300))


def _robust(log_likelihood: F64) -> F64:
    """log((1 - c) L + c) with L at most 1 and c the chance that the pair is wrong; (..., B)."""
    relative = np.minimum(log_likelihood, 0.0)
    return np.asarray(np.log((1.0 - WRONG_PAIR) * np.exp(relative) + WRONG_PAIR))


def _moments(grid: F64, posterior: F64) -> tuple[F64, F64]:
    weight = np.exp(posterior - posterior.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    mean = weight @ grid
    return mean, np.sqrt(np.maximum(np.sum(weight * (grid - mean[:, None]) ** 2, axis=1), 0.0))


def refine_focals(
    pairs: PairGeometry, unknown: UnknownIntrinsics, log_f: F64, *, principal_std: float = 1e-3
) -> tuple[F64, F64]:
    """Log focals (R,) of the cameras and their standard deviations from all pairs, near a start (R,).

    Least squares of the Kruppa residuals over all that is ``unknown``, each residual whitened by its own
    covariance at the last answer. A principal point that all views share is one unknown: its error pulls all
    pairs the same way, and no number of them averages it out. ``principal_std`` (long sides) is what may be
    wrong with each view's by itself. The loss turns at three sigmas: first that of soft L1, which leads to
    the minimum from afar, then Cauchy's against wrong pairs.
    """
    unknown = unknown.with_weak_focals()
    x, share = unknown.start(log_f[None])[0], independent_share(pairs)
    covariance = np.zeros((len(x), len(x)))
    for loss in ("soft_l1", "soft_l1", "cauchy", "cauchy") if len(x) else ():
        whitening = kruppa_whitening(pairs, unknown.focals(x[None])[0], principal_std=principal_std)
        root = np.sqrt(share) * whitening

        def residuals(batch: F64, root: F64 = root) -> F64:
            w = dual_images(unknown.calibrations(batch))
            g = kruppa_residuals(pairs.F, w[:, pairs.i], w[:, pairs.j])
            white = np.einsum("mac,bmc->bma", root, g).reshape(len(batch), -1)
            return np.concatenate([white, unknown.deviations(batch)], axis=1)

        found = minimize_residuals(
            lambda y: residuals(y[None])[0], x, jacobian=lambda y: _central(residuals, y), loss=loss,
            loss_scale=3.0 * np.sqrt(share), max_iterations=40,
        )  # fmt: skip
        x = found.x
        # The noise is known: in place of the scale that the minimiser estimated stands 1, or what the pairs
        # (two equations each) contradict each other more than their noise allows.
        variance = 2.0 * found.cost / max(len(found.residual) - len(x), 1)
        contradiction = 2.0 * found.cost / (share * max(2 * len(pairs.i) - len(x), 1))
        covariance = found.covariance / max(variance, 1e-300) * max(contradiction, 1.0)
    variances = np.append(np.maximum(covariance.diagonal(), 0.0), 0.0)
    return unknown.focals(x[None])[0], np.sqrt(variances[unknown.place[:, 0]])


def _central(residuals: Callable[[F64], F64], x: F64) -> F64:
    steps = np.diag(np.full(len(x), 1e-6))
    return np.asarray(((residuals(x + steps) - residuals(x - steps)) / 2e-6).T)


@dataclass(frozen=True)
class FocalsFromFundamental:
    """Focals from fundamental matrices alone, each camera's with its own uncertainty.

    All pairs vote on a grid of ``focal_steps`` focals in ``focal_range`` (long sides; a quarter of them where
    cameras differ), the joint answer is refined, and the plane at infinity fitted to it. A camera whose focal
    stays open by more than ``max_std`` (of its logarithm) is named in the reasons. ``min_common``
    observations make a pair; ``min_principal_std``: the principal point is never trusted more (long sides).
    """

    focal_range: tuple[float, float] = (0.1, 60.0)
    focal_steps: int = 151
    max_std: float = 0.15
    min_common: int = 20
    min_principal_std: float = 1e-3
    criterion: RotationCriterion = field(default_factory=RotationCriterion)

    @guarded
    def calibrate(
        self,
        reconstruction: Reconstruction,
        *,
        assumed: Assumptions,
        rng: np.random.Generator,  # noqa: ARG002 - one signature for all methods
    ) -> SelfCalibration:
        """Upgrade by the vote; ``StageFailure`` below three cameras, without pairs, and where no answer puts
        the scene in front of the cameras."""
        require_cameras(reconstruction)
        frame = assumed_frame(reconstruction, assumed)
        pairs = camera_pairs(frame, reconstruction, min_common=self.min_common)
        require_pairs(pairs, self.min_common)
        log_f, std = self.focals(pairs, frame, assumed)
        log_f = np.array([np.median(log_f[frame.group == g]) for g in range(frame.n_groups)])
        plane, cost = planes_for_focals(frame, self.criterion, log_f)
        answer = Answer(plane, square_calibrations(log_f[frame.group]), cost, "focals from F")
        found = conclude(frame, reconstruction, self.criterion, [answer], kept=1, min_positive=0.5)
        return self._with_own_deviations(found, frame, std)

    def focals(self, pairs: PairGeometry, frame: ReferenceFrame, assumed: Assumptions) -> tuple[F64, F64]:
        """Log focals (R,) of the cameras, unit-free, and their standard deviations."""
        several = frame.n_groups > 1
        grid = log_grid(self.focal_range, self.focal_steps // 4 if several else self.focal_steps)
        offset = np.median(assumed.std[frame.views, 3]) / frame.pixel_from_unit[frame.views[0], 0, 0]
        principal_std = float(np.clip(np.nan_to_num(offset), self.min_principal_std, 0.1))
        nothing = np.full(frame.n_groups, np.nan), np.full(frame.n_groups, np.inf)
        known = nothing if frame.focal_mean is None or frame.focal_std is None else (
            frame.focal_mean, frame.focal_std,
        )  # fmt: skip
        prior = focal_prior(*known)
        vote = vote_on_focals(pairs, frame.group, grid, principal_std=principal_std, prior=prior)
        unknown = unknown_intrinsics(frame, assumed)
        start, spread = vote.log_f[frame.group], vote.std[frame.group]
        log_f, std = refine_focals(pairs, unknown, start, principal_std=self.min_principal_std)
        # Residuals also vanish where everything is blurred, at focals near 0: there the vote stands.
        strayed = np.abs(log_f - start) > STRAYED * np.maximum(spread, 0.1)
        return np.where(strayed, start, log_f), np.where(strayed, np.maximum(spread, self.max_std), std)

    def _with_own_deviations(
        self, found: SelfCalibration, frame: ReferenceFrame, std: F64
    ) -> SelfCalibration:
        K_std = square_std(frame, found.K, std)
        open_views = frame.views[std >= self.max_std]
        if not len(open_views):
            return replace(found, K_std=K_std)
        names = ", ".join(str(v) for v in open_views[:10])
        reason = (
            f"fundamental matrices leave the focal of {len(open_views)} of {len(frame.views)} photographs "
            f"open by more than {self.max_std:.0%} (number {names})"
        )
        return replace(found, K_std=K_std, identifiable=False, reasons=(*found.reasons, reason))
