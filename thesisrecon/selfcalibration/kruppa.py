"""Section 7.3, direct: the Kruppa equations, which ask only for fundamental matrices.

The epipolar lines tangent to the image of the absolute conic correspond: F w*_i F' ~ [e]x w*_j [e]x' with the
dual images w* = K K'. In the singular vectors of F = U diag(r, s, 0) V' (R. Hartley, "Kruppa's equations
derived from the fundamental matrix", PAMI 19(2), 1997):

    (u2'w*_j u2) / (r^2 v1'w*_i v1) = -(u1'w*_j u2) / (r s v1'w*_i v2) = (u1'w*_j u1) / (s^2 v2'w*_i v2).

The two triples are taken for vectors of space and their directions compared, which multiplies crosswise: no
denominator vanishes. The plane at infinity is not in them; that is their weakness (more motions are critical
than to the quadric) and their strength (no projective frame is needed).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.numerics.levenberg_marquardt import minimize_residuals
from thesisrecon.records import Reconstruction, SelfCalibration
from thesisrecon.selfcalibration.candidates import (
    Candidate,
    as_stage_failure,
    group_log_focals,
    require_cameras,
    select_candidate,
    square_pixel_calibrations,
)
from thesisrecon.selfcalibration.focal_scan import log_grid, planes_for_focals
from thesisrecon.selfcalibration.frame import SolverUnknowns, normalized_frame, solver_unknowns
from thesisrecon.selfcalibration.pair_geometry import PairGeometry, pair_geometries
from thesisrecon.selfcalibration.refinement import RotationCriterion

_ROOT2 = np.sqrt(2.0)


@dataclass(frozen=True)
class KruppaFit:
    """``unknowns`` (D,), unit-free ``K`` (R, 3, 3), ``cost`` (mean squared residual of a pair) and
    ``covariance`` (D, D)."""

    unknowns: F64
    K: F64
    cost: float
    covariance: F64


def kruppa_residuals(F: F64, dual_i: F64, dual_j: F64) -> F64:
    """Sines (B, M, 3) of the angles between the two sides of the Kruppa equations; 0 where they hold.

    F (M, 3, 3) of any norm; dual images ``dual_i, dual_j`` (B, M, 3, 3) of the first and second camera of
    every pair. The cross product of the two unit triples, at most two entries independent.
    """
    U, s, Vt = np.linalg.svd(F)
    left = s[:, :2, None] * Vt[:, :2]
    # In the basis U the matrix [e]x turns by a right angle: (u1, u2) become (u2, -u1) up to sign.
    right = np.stack([U[:, :, 1], -U[:, :, 0]], axis=1)
    return np.asarray(np.cross(_direction(left, dual_i), _direction(right, dual_j)))


def _direction(rows: F64, dual: F64) -> F64:
    """Unit triples (s11, sqrt2 s12, s22) of S = rows dual rows'; rows (M, 2, 3), dual (B, M, 3, 3)."""
    S = rows[None] @ dual @ rows[None].swapaxes(-1, -2)
    triple = np.stack([S[..., 0, 0], _ROOT2 * S[..., 0, 1], S[..., 1, 1]], axis=-1)
    return np.asarray(triple / np.maximum(np.linalg.norm(triple, axis=-1, keepdims=True), 1e-300))


def dual_images(K: F64) -> F64:
    """w* = K K' (..., 3, 3)."""
    return np.asarray(K @ K.swapaxes(-1, -2))


def kruppa_cost(pairs: PairGeometry, K: F64, *, loss_scale: float) -> F64:
    """Mean robust cost (B,) of a pair for calibrations K (B, R, 3, 3); soft L1 that turns at ``scale``."""
    w = dual_images(K)
    squared = np.sum(kruppa_residuals(pairs.F, w[:, pairs.i], w[:, pairs.j]) ** 2, axis=-1)
    return np.asarray(np.mean(2.0 * loss_scale**2 * (np.sqrt(1.0 + squared / loss_scale**2) - 1.0), axis=1))


def minimize_kruppa(
    pairs: PairGeometry, unknown: SolverUnknowns, start: F64, *, loss_scale: float = 0.02, noise: float = 0.01
) -> KruppaFit:
    """The minimum of the Kruppa equations over all unknown intrinsics nearest to a start (D,).

    Soft L1 that turns at ``scale``; what is known beforehand weighs against residuals of size ``noise``.
    """

    def residuals(batch: F64) -> F64:
        w = dual_images(unknown.calibrations(batch))
        r = kruppa_residuals(pairs.F, w[:, pairs.i], w[:, pairs.j]).reshape(len(batch), -1)
        return np.concatenate([r, noise * unknown.prior_residuals(batch)], axis=1)

    def jacobian(x: F64) -> F64:
        steps = np.diag(np.full(len(x), 1e-6))
        return np.asarray(((residuals(x + steps) - residuals(x - steps)) / 2e-6).T)

    found = minimize_residuals(
        lambda x: residuals(x[None])[0], start, jacobian=jacobian, loss="soft_l1", loss_scale=loss_scale,
        max_iterations=80, tolerance=1e-14,
    )  # fmt: skip
    data = found.residual[: 3 * len(pairs.i)]
    K = unknown.calibrations(found.x[None])[0]
    return KruppaFit(found.x, K, float(np.sum(data**2) / len(pairs.i)), found.covariance)


@dataclass(frozen=True)
class KruppaEquations:
    """The Kruppa equations alone, over the fundamental matrices of all camera pairs.

    One focal for all cameras is scanned (``focal_range`` in long sides, ``focal_steps``), its ``starts`` best
    minima are refined over everything that is unknown, and the plane at infinity is fitted to each. The one
    whose cameras are nearest to rotations is the answer: of few pairs the equations have false solutions
    without residual, focals near 0 among them. ``scale``: residual of a pair beyond which it counts linearly.
    ``min_common`` observations make a pair; ``own_matches`` fits each F to the matches of its pair instead of
    taking it from the cameras.
    """

    focal_range: tuple[float, float] = (0.2, 40.0)
    focal_steps: int = 90
    starts: int = 4
    loss_scale: float = 0.02
    min_common_points: int = 20
    refit_pairs: bool = False
    criterion: RotationCriterion = field(default_factory=RotationCriterion)

    @as_stage_failure
    def calibrate(
        self,
        reconstruction: Reconstruction,
        *,
        prior: IntrinsicsPrior,
        rng: np.random.Generator,  # noqa: ARG002 - one signature for all methods
    ) -> SelfCalibration:
        """Upgrade by the Kruppa equations; ``StageFailure`` below three cameras, without pairs, and where no
        answer puts the scene in front of the cameras."""
        require_cameras(reconstruction)
        frame = normalized_frame(reconstruction, prior)
        pairs = pair_geometries(frame, reconstruction, min_common_points=self.min_common_points, refine=self.refit_pairs)
        require_pairs(pairs, self.min_common_points)
        unknown = solver_unknowns(frame, prior)
        answers = []
        for log_f in self._scan(pairs, len(frame.views)):
            start = unknown.start(np.full((1, len(frame.views)), log_f))[0]
            found = minimize_kruppa(pairs, unknown, start, loss_scale=self.loss_scale)
            plane, cost = planes_for_focals(frame, self.criterion, group_log_focals(frame, found.K))
            K_std = unknown.calibration_std(found.unknowns, found.covariance)
            answers.append(Candidate(plane, found.K, cost, "Kruppa equations", K_std))
        return select_candidate(
            frame, reconstruction, self.criterion, answers, max_candidates=1, min_in_front_ratio=0.5
        )

    def _scan(self, pairs: PairGeometry, n: int) -> list[float]:
        """The best local minima of one common focal; logarithms."""
        grid = log_grid(self.focal_range, self.focal_steps)
        K = square_pixel_calibrations(np.repeat(grid[:, None], n, axis=1))
        cost = kruppa_cost(pairs, K, loss_scale=self.loss_scale)
        padded = np.pad(cost, 1, constant_values=np.inf)
        minima = np.flatnonzero((cost <= padded[:-2]) & (cost <= padded[2:]))
        return [float(grid[k]) for k in minima[np.argsort(cost[minima], kind="stable")][: self.starts]]


def require_pairs(pairs: PairGeometry, min_common_points: int) -> None:
    """``StageFailure`` below two pairs of cameras."""
    if len(pairs.i) < 2:
        raise StageFailure(
            "focal lengths from fundamental matrices need at least 2 pairs of photographs",
            f"{counted(len(pairs.i), 'pair')} with {min_common_points} points or more in common",
            "add photographs with more overlap",
        )
