"""Self-calibration by the Kruppa equations, which need fundamental matrices only (section 7.3, direct).

Corresponding epipolar lines are tangent to the images of the absolute conic: F w*_i F' ~ [e]x w*_j [e]x' with
the dual images w* = K K' (HZ 19.4). With F = U diag(r, s, 0) V' (R. Hartley, "Kruppa's equations derived from
the fundamental matrix", PAMI 19(2), 1997):

    (u2'w*_j u2) / (r^2 v1'w*_i v1) = -(u1'w*_j u2) / (r s v1'w*_i v2) = (u1'w*_j u1) / (s^2 v2'w*_i v2).

Both triples are normalized and compared by their cross product, so that no denominator vanishes. The plane at
infinity does not appear: more motions are critical than for the quadric, but no projective frame is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.two_view import fundamental_from_cameras, unit_norm
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.numerics.levenberg_marquardt import minimize_residuals
from thesisrecon.numerics.losses import soft_l1
from thesisrecon.records import Reconstruction, SelfCalibration
from thesisrecon.selfcalibration.candidates import (
    Candidate,
    as_stage_failure,
    group_log_focals,
    select_candidate,
    square_pixel_calibrations,
)
from thesisrecon.selfcalibration.focal_scan import log_grid, planes_for_focals
from thesisrecon.selfcalibration.frame import ReferenceFrame, normalized_frame
from thesisrecon.selfcalibration.refinement import RotationCriterion, central_differences
from thesisrecon.selfcalibration.unknowns import SolverUnknowns, solver_unknowns

# Curvatures below this share of the largest are raised to it: an open direction is uncertain, not infinite.
_MIN_CURVATURE_REL = 1e-12

_MIN_SIGMA = 1e-12
_ROOT2 = np.sqrt(2.0)


@dataclass(frozen=True)
class PairGeometry:
    """Fundamental matrices of M camera pairs with their covariances.

    Attributes
    ----------
    i, j : ndarray (M,) of int
        Places of the two cameras in the frame.
    F : ndarray (M, 3, 3)
        x_j' F x_i = 0 in unit-free coordinates, unit norm.
    covariance : ndarray (M, 9, 9)
        Covariance of vec(F), row-major.
    """

    i: I64
    j: I64
    F: F64
    covariance: F64


def pair_geometries(
    frame: ReferenceFrame, reconstruction: Reconstruction, *, min_common_points: int = 20, refit: bool = True
) -> PairGeometry:
    """Compute F and its covariance for all pairs with enough common observations.

    Parameters
    ----------
    frame : ReferenceFrame
        Cameras.
    reconstruction : Reconstruction
        Projective reconstruction.
    min_common_points : int
        Minimum number of common observations.
    refit : bool
        Fit F to the matches of the pair; else F of the two cameras, and the covariance is too large.

    Returns
    -------
    PairGeometry
        The pairs.
    """
    xy, order = _unit_free_table(frame, reconstruction)
    found: list[tuple[int, int, F64, F64]] = []
    P = np.concatenate([frame.A, frame.a[:, :, None]], axis=2)
    for i in range(len(order)):
        for j in range(i + 1, len(order)):
            both = np.isfinite(xy[i, :, 0]) & np.isfinite(xy[j, :, 0])
            if both.sum() < max(min_common_points, 8):
                continue
            try:
                start = fundamental_from_cameras(P[i], P[j])
            except ValueError:
                continue  # one centre: no epipolar geometry
            F, covariance = _fit_fundamental(start, xy[i, both], xy[j, both], iterations=5 if refit else 0)
            if np.isfinite(F).all() and np.isfinite(covariance).all():
                found.append((i, j, F, covariance))
    columns = list(zip(*found, strict=True)) if found else [(), (), np.zeros((0, 3, 3)), np.zeros((0, 9, 9))]
    return PairGeometry(
        np.array(columns[0], dtype=np.int64), np.array(columns[1], dtype=np.int64), np.array(columns[2]),
        np.array(columns[3]),
    )  # fmt: skip


def _unit_free_table(frame: ReferenceFrame, reconstruction: Reconstruction) -> tuple[F64, I64]:
    """Return inlier observations (R, N, 2) in unit-free coordinates, NaN if not observed, and the views."""
    tracks, keep = reconstruction.tracks, reconstruction.inlier
    place = np.full(tracks.n_views, -1)
    place[frame.views] = np.arange(len(frame.views))
    keep = keep & (place[tracks.view_index] >= 0)
    view, point = tracks.view_index[keep], tracks.point_index[keep]
    unit = np.linalg.inv(frame.pixel_from_unit[view])
    table = np.full((len(frame.views), tracks.n_points, 2), np.nan)
    table[place[view], point] = np.einsum("kab,kb->ka", unit, homogenize(tracks.xy[keep]))[:, :2]
    return table, frame.views


def _fit_fundamental(F: F64, x1: F64, x2: F64, *, iterations: int = 5) -> tuple[F64, F64]:
    """Refine F (3, 3) to minimum Sampson distances (5.4); return F and the covariance (9, 9) of vec(F).

    Gauss-Newton in the seven-dimensional tangent space of unit-norm matrices of rank 2, with Huber weights at
    2.5 sigma.
    """
    F = unit_norm(F)
    B, r, J = _linearised(F, x1, x2)
    for _ in range(iterations):
        sigma = 1.4826 * float(np.median(np.abs(r)))
        w = np.minimum(1.0, 2.5 * sigma / np.maximum(np.abs(r), 1e-300)) if sigma > 0.0 else np.ones_like(r)
        U, s, Vt = np.linalg.svd((J @ B) * np.sqrt(w)[:, None], full_matrices=False)
        s = np.maximum(s, np.sqrt(_MIN_CURVATURE_REL) * max(float(s[0]), 1e-300))
        trial = _rank_two(F - (B @ (Vt.T @ ((U.T @ (np.sqrt(w) * r)) / s))).reshape(3, 3))
        B_new, r_new, J_new = _linearised(trial, x1, x2)
        if not float(np.abs(r_new).sum()) < float(np.abs(r).sum()):
            break
        F, B, r, J = trial, B_new, r_new, J_new
    sigma = max(1.4826 * float(np.median(np.abs(r))) * np.sqrt(len(r) / (len(r) - 7.0)), _MIN_SIGMA)
    value, vector = np.linalg.eigh((J @ B).T @ (J @ B))
    half = B @ (vector / np.sqrt(np.maximum(value, _MIN_CURVATURE_REL * max(float(value[-1]), 1e-300))))
    return F, np.asarray(sigma**2 * half @ half.T)


def _linearised(F: F64, x1: F64, x2: F64) -> tuple[F64, F64, F64]:
    """Return the tangent basis (9, 7), Sampson distances (N,) and their derivatives (N, 9) by vec(F)."""
    U, _, Vt = np.linalg.svd(F)
    across = np.stack([np.outer(U[:, 2], Vt[2]).ravel(), F.ravel()])
    basis = np.linalg.svd(across)[2][2:].T
    h1, h2 = homogenize(x1), homogenize(x2)
    l2, l1 = h1 @ F.T, h2 @ F
    gradient = np.sqrt(np.sum(l2[:, :2] ** 2, axis=1) + np.sum(l1[:, :2] ** 2, axis=1)) + 1e-300
    r = np.sum(h2 * l2, axis=1) / gradient
    J = (h2[:, :, None] * h1[:, None, :]).reshape(-1, 9) / gradient[:, None]
    return basis, r, J


def _rank_two(F: F64) -> F64:
    U, s, Vt = np.linalg.svd(F)
    return unit_norm((U[:, :2] * s[:2]) @ Vt[:2])


@dataclass(frozen=True)
class _KruppaFit:
    """Unknowns (D,), unit-free K (R, 3, 3), mean squared residual of a pair and covariance (D, D)."""

    unknowns: F64
    K: F64
    cost: float
    covariance: F64


def kruppa_residuals(F: F64, dual_i: F64, dual_j: F64) -> F64:
    """Compute the residuals of the Kruppa equations for all pairs.

    Parameters
    ----------
    F : ndarray (M, 3, 3)
        Fundamental matrices of any norm.
    dual_i, dual_j : ndarray (B, M, 3, 3)
        Dual images K K' of the absolute conic in the first and second camera of each pair.

    Returns
    -------
    ndarray (B, M, 3)
        Cross products of the two unit triples (sine of their angle); at most two entries are independent.

    References
    ----------
    HZ 19.4; R. Hartley, PAMI 19(2), 1997.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon.geometry.homogeneous import cross_matrix
    >>> K, R, t = np.diag([2.0, 2.0, 1.0]), np.diag([1.0, -1.0, -1.0]), np.array([1.0, 2.0, 3.0])
    >>> F = np.linalg.inv(K).T @ cross_matrix(t) @ R @ np.linalg.inv(K)
    >>> w = (K @ K.T)[None, None]
    >>> bool(np.abs(kruppa_residuals(F[None], w, w)).max() < 1e-12)
    True
    """
    U, s, Vt = np.linalg.svd(F)
    left = s[:, :2, None] * Vt[:, :2]
    # In the basis U, [e]x rotates by 90 degrees: (u1, u2) -> (u2, -u1) up to sign.
    right = np.stack([U[:, :, 1], -U[:, :, 0]], axis=1)
    return np.asarray(np.cross(_direction(left, dual_i), _direction(right, dual_j)))


def _direction(rows: F64, dual: F64) -> F64:
    """Return unit triples (s11, sqrt2 s12, s22) of S = rows dual rows', rows (M, 2, 3), dual (B, M, 3, 3)."""
    S = rows[None] @ dual @ rows[None].swapaxes(-1, -2)
    triple = np.stack([S[..., 0, 0], _ROOT2 * S[..., 0, 1], S[..., 1, 1]], axis=-1)
    return np.asarray(triple / np.maximum(np.linalg.norm(triple, axis=-1, keepdims=True), 1e-300))


def dual_conics(K: F64) -> F64:
    """Compute the dual images w* = K K' of the absolute conic.

    Parameters
    ----------
    K : ndarray (..., 3, 3)
        Calibrations.

    Returns
    -------
    ndarray (..., 3, 3)
        Dual conics.
    """
    return np.asarray(K @ K.swapaxes(-1, -2))


def _kruppa_cost(pairs: PairGeometry, K: F64, *, loss_scale: float) -> F64:
    """Return the mean soft-L1 cost (B,) of a pair for calibrations K (B, R, 3, 3)."""
    w = dual_conics(K)
    squared = np.sum(kruppa_residuals(pairs.F, w[:, pairs.i], w[:, pairs.j]) ** 2, axis=-1)
    return np.asarray(np.mean(soft_l1(squared, loss_scale)[0], axis=1))


def _minimize_kruppa(
    pairs: PairGeometry, unknown: SolverUnknowns, start: F64, *, loss_scale: float = 0.02, noise: float = 0.01
) -> _KruppaFit:
    """Minimize the Kruppa residuals over all unknown intrinsics from a start (D,).

    Priors are weighed against residuals of size ``noise``.
    """

    def residuals(batch: F64) -> F64:
        w = dual_conics(unknown.calibrations(batch))
        r = kruppa_residuals(pairs.F, w[:, pairs.i], w[:, pairs.j]).reshape(len(batch), -1)
        return np.concatenate([r, noise * unknown.prior_residuals(batch)], axis=1)

    found = minimize_residuals(
        lambda x: residuals(x[None])[0], start,
        jacobian=lambda x: central_differences(residuals, x, np.full(len(x), 1e-6)),
        loss="soft_l1", loss_scale=loss_scale,
        max_iterations=80, tolerance=1e-14,
    )  # fmt: skip
    data = found.residual[: 3 * len(pairs.i)]
    K = unknown.calibrations(found.x[None])[0]
    return _KruppaFit(found.x, K, float(np.sum(data**2) / len(pairs.i)), found.covariance)


@dataclass(frozen=True)
class KruppaEquations:
    """Self-calibration by the Kruppa equations over all camera pairs.

    One common focal length is scanned; the best minima are refined over all unknown intrinsics, and a plane
    at infinity is fitted to each. The candidate whose cameras are nearest to rotations is selected, because
    few pairs leave false solutions without residual, among them focal lengths near 0.

    Parameters
    ----------
    focal_range : (float, float)
        Scanned focal lengths in long sides.
    focal_steps : int
        Number of scanned focal lengths.
    starts : int
        Number of minima to refine.
    loss_scale : float
        Residual of a pair beyond which it counts linearly (soft L1).
    min_common_points : int
        Minimum number of common observations of a pair.
    refit_pairs : bool
        Fit F to the matches of each pair instead of taking it from the cameras.
    criterion : RotationCriterion
        Criterion that selects the candidate.

    References
    ----------
    HZ 19.4; R. Hartley, PAMI 19(2), 1997.
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
        """Upgrade a projective reconstruction.

        Parameters
        ----------
        reconstruction, prior, rng
            As in :meth:`thesisrecon.config.SelfCalibrator.calibrate`.

        Returns
        -------
        SelfCalibration
            The upgrade with its identifiability.

        Raises
        ------
        StageFailure
            Below three cameras or two pairs, or if no candidate places the points in front of the cameras.
        """
        frame = normalized_frame(reconstruction, prior)
        pairs = pair_geometries(
            frame, reconstruction, min_common_points=self.min_common_points, refit=self.refit_pairs
        )
        require_pairs(pairs, self.min_common_points)
        unknown = solver_unknowns(frame, prior)
        candidates = []
        for log_f in self._scan(pairs, len(frame.views)):
            start = unknown.from_log_focals(np.full((1, len(frame.views)), log_f))[0]
            found = _minimize_kruppa(pairs, unknown, start, loss_scale=self.loss_scale)
            plane, cost = planes_for_focals(frame, self.criterion, group_log_focals(frame, found.K))
            K_std = unknown.calibration_std(found.unknowns, found.covariance)
            candidates.append(Candidate(plane, found.K, cost, "Kruppa equations", K_std))
        return select_candidate(frame, reconstruction, self.criterion, candidates)

    def _scan(self, pairs: PairGeometry, n: int) -> list[float]:
        """Return the best local minima of one common log focal length."""
        grid = log_grid(self.focal_range, self.focal_steps)
        K = square_pixel_calibrations(np.repeat(grid[:, None], n, axis=1))
        cost = _kruppa_cost(pairs, K, loss_scale=self.loss_scale)
        padded = np.pad(cost, 1, constant_values=np.inf)
        minima = np.flatnonzero((cost <= padded[:-2]) & (cost <= padded[2:]))
        return [float(grid[k]) for k in minima[np.argsort(cost[minima], kind="stable")][: self.starts]]


def require_pairs(pairs: PairGeometry, min_common_points: int) -> None:
    """Raise an error if there are fewer than two pairs.

    Parameters
    ----------
    pairs : PairGeometry
        The pairs.
    min_common_points : int
        Minimum number of common observations of a pair.

    Raises
    ------
    StageFailure
        If there are fewer than two pairs.
    """
    if len(pairs.i) < 2:
        raise StageFailure(
            "focal lengths from fundamental matrices need at least 2 pairs of images",
            f"{counted(len(pairs.i), 'pair')} with at least {min_common_points} common points",
            "add images with more overlap",
        )
