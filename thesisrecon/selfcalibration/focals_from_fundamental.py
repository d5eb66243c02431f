"""Focal lengths from fundamental matrices, each with its uncertainty.

The closed form of S. Bougnoux ("From projective to Euclidean space under any practical situation, a criticism
of self-calibration", ICCV 1998) is singular if the optical axes meet or are parallel, as in most image sets.
Therefore each pair gives the likelihood of the focal lengths on a grid, from the covariance of F and the
prior of the principal points (the idea of Kocur, Kyselica, Kukelova, "Robust self-calibration of focal
lengths from the fundamental matrix", CVPR 2024, without its iteration). An uninformative pair has a flat
likelihood; the likelihoods of all pairs are combined.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from thesisrecon.arrays import F64, I64
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.numerics.levenberg_marquardt import minimize_residuals
from thesisrecon.records import Reconstruction, SelfCalibration
from thesisrecon.selfcalibration.candidates import (
    Candidate,
    as_stage_failure,
    focal_only_std,
    select_candidate,
    square_pixel_calibrations,
)
from thesisrecon.selfcalibration.focal_scan import log_grid, planes_for_focals
from thesisrecon.selfcalibration.frame import ReferenceFrame, normalized_frame
from thesisrecon.selfcalibration.kruppa import (
    PairGeometry,
    dual_conics,
    kruppa_residuals,
    pair_geometries,
    require_pairs,
)
from thesisrecon.selfcalibration.refinement import RotationCriterion, central_differences
from thesisrecon.selfcalibration.unknowns import SolverUnknowns, solver_unknowns, weak_focal_prior

_ROOT2 = np.sqrt(2.0)
# A refined focal length further from the posterior mean, in its standard deviations, is not used.
_MAX_DEPARTURE_SIGMAS = 4.0
# Probability that F of a pair is wrong: no single pair can exclude a focal length.
_WRONG_PAIR_PROBABILITY = 1e-2


def bougnoux_focals(F: F64) -> F64:
    """Compute squared focal lengths from F by the closed form.

    f_1^2 = -(p'[e2]x I F p)(p'F'p) / (p'[e2]x I F I F'p), I = diag(1, 1, 0), p = (0, 0, 1), e2 the epipole in
    image 2 (F'e2 = 0); f_2 with F' and e1.

    Parameters
    ----------
    F : ndarray (..., 3, 3)
        Fundamental matrices for principal points at 0.

    Returns
    -------
    ndarray (..., 2)
        Squared focal lengths of both cameras; negative or infinite if no camera fits.

    References
    ----------
    S. Bougnoux, ICCV 1998.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from thesisrecon.geometry.homogeneous import cross_matrix
    >>> R, t = Rotation.from_rotvec([0.2, 0.3, 0.1]).as_matrix(), np.array([1.0, 0.5, 0.2])
    >>> K1, K2 = np.diag([2.0, 2.0, 1.0]), np.diag([3.0, 3.0, 1.0])
    >>> F = np.linalg.inv(K2).T @ cross_matrix(t) @ R @ np.linalg.inv(K1)
    >>> np.round(np.sqrt(bougnoux_focals(F)), 6)
    array([2., 3.])
    """
    U, _, Vt = np.linalg.svd(F)
    terms = _bougnoux_terms(F, U[..., :, 2], Vt[..., 2, :])
    with np.errstate(divide="ignore", invalid="ignore"):
        return terms[..., 0] / terms[..., 1]


def _bougnoux_terms(F: F64, e2: F64, e1: F64) -> F64:
    """Return numerator and denominator (..., 2 cameras, 2) of the closed form; p'[e]x is (-e_y, e_x, 0)."""
    terms = []
    for G, e in ((F, e2), (np.swapaxes(F, -1, -2), e1)):
        top = -(e[..., 0] * G[..., 1, 2] - e[..., 1] * G[..., 0, 2]) * G[..., 2, 2]
        GIGp = np.einsum("...ab,...b->...a", G[..., :2, :2], G[..., 2, :2])
        bottom = e[..., 0] * GIGp[..., 1] - e[..., 1] * GIGp[..., 0]
        terms.append(np.stack([top, bottom], axis=-1))
    return np.stack(terms, axis=-2)


def pair_focals(F: F64, covariance: F64, *, significance: float = 3.0) -> tuple[F64, F64]:
    """Compute the focal lengths of one F by the closed form, with their uncertainty.

    Parameters
    ----------
    F : ndarray (3, 3)
        Fundamental matrix for principal points at 0.
    covariance : ndarray (9, 9)
        Covariance of vec(F), row-major.
    significance : float
        A numerator or denominator within this many standard deviations of 0 is undetermined.

    Returns
    -------
    focal : ndarray (2,)
        Focal lengths, NaN if not real.
    std : ndarray (2,)
        Relative standard deviations to first order, inf if undetermined.

    References
    ----------
    S. Bougnoux, ICCV 1998.
    """
    F = F / np.linalg.norm(F)
    centre = _terms_near(F, F[None])[0]
    steps = 1e-6 * np.eye(9).reshape(9, 3, 3)
    J = (_terms_near(F, F + steps) - _terms_near(F, F - steps)) / 2e-6
    std = np.sqrt(np.maximum(np.einsum("kct,kl,lct->ct", J, covariance, J), 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = centre[:, 0] / centre[:, 1]
        relative = J[:, :, 0] / centre[:, 0] - J[:, :, 1] / centre[:, 1]
        deviation = 0.5 * np.sqrt(np.maximum(np.einsum("kc,kl,lc->c", relative, covariance, relative), 0.0))
        sure = (np.abs(centre) > significance * std).all(axis=1) & (squared > 0.0) & np.isfinite(deviation)
        return np.sqrt(squared), np.where(sure, deviation, np.inf)


def _terms_near(F0: F64, F: F64) -> F64:
    """Return the terms of F (B, 3, 3) near F0 with epipoles of the same sign."""
    U0, _, Vt0 = np.linalg.svd(F0)
    U, _, Vt = np.linalg.svd(F)
    e2, e1 = U[:, :, 2], Vt[:, 2]
    e2 = e2 * np.where(e2 @ U0[:, 2] < 0.0, -1.0, 1.0)[:, None]
    e1 = e1 * np.where(e1 @ Vt0[2] < 0.0, -1.0, 1.0)[:, None]
    return _bougnoux_terms(F, e2, e1)


def _forms(F: F64) -> tuple[F64, F64, F64, F64]:
    """Return L, N (M, 2, 3) of the Kruppa equations L w*_i L' ~ N w*_j N' and their derivatives by vec(F).

    L = U2'F and N = U2'[e]x with U2 = (u1, u2), e = u3; dL, dN (M, 9, 2, 3) for fixed U2, de = -(F')^+ dF'e.
    """
    U, s, Vt = np.linalg.svd(F)
    U2 = U[:, :, :2].swapaxes(1, 2)
    e = U[:, :, 2]
    pseudo = np.einsum("mak,mk,mkb->mab", U[:, :, :2], 1.0 / np.maximum(s[:, :2], 1e-300), Vt[:, :2])
    # dF = e_k e_l': U2'dF has U2'e_k in column l, dF'e is e_l times the entry k of e.
    dL = np.einsum("mak,lb->mklab", U2, np.eye(3)).reshape(-1, 9, 2, 3)
    de = -np.einsum("mk,mal->mkla", e, pseudo).reshape(-1, 9, 3)
    dN = U2[:, None] @ cross_matrix(de)
    return U2 @ F, U2 @ cross_matrix(e), dL, dN


def _directions(rows: F64, w: F64, d_rows: F64, d_w: F64) -> tuple[F64, F64]:
    """Return unit triples (..., 3) of rows w rows' and derivatives (..., 9 + E, 3) by F and by w."""
    S = rows @ w @ np.swapaxes(rows, -1, -2)
    half = d_rows @ (w @ np.swapaxes(rows, -1, -2))[..., None, :, :]
    of_w = rows[..., None, :, :] @ d_w @ np.swapaxes(rows, -1, -2)[..., None, :, :]
    dS = np.concatenate([half + np.swapaxes(half, -1, -2), of_w], axis=-3)
    triple, d_triple = _triple(S), _triple(dS)
    norm = np.maximum(np.linalg.norm(triple, axis=-1, keepdims=True), 1e-300)
    unit = triple / norm
    along = np.sum(d_triple * unit[..., None, :], axis=-1, keepdims=True)
    return unit, (d_triple - along * unit[..., None, :]) / norm[..., None, :]


def _triple(S: F64) -> F64:
    return np.stack([S[..., 0, 0], _ROOT2 * S[..., 0, 1], S[..., 1, 1]], axis=-1)


def _kruppa_chi_square(
    pairs: PairGeometry, log_f_i: F64, log_f_j: F64, *, cell: float, principal_std: float
) -> F64:
    """Return squared Kruppa residuals (M, B) over their covariance for focal lengths exp(log_f) (B,).

    Propagates F, principal points off 0 by ``principal_std`` (in the unit of F) and focal lengths anywhere in
    a cell of width ``cell`` of log f. About chi-square with two degrees of freedom at the truth.
    """
    out = np.empty((len(pairs.i), len(log_f_i)))
    duals = _dual_with_changes(log_f_i), _dual_with_changes(log_f_j)
    for m in range(len(pairs.i)):
        one = _some(pairs, np.arange(len(pairs.i)) == m)
        g, C = _residual_with_covariance(one.F, *duals, _variances(one.covariance, cell, principal_std))
        out[m] = np.einsum("ba,bac,bc->b", g, _inverse_root(C, power=-1.0), g)
    return out


def _kruppa_whitening(pairs: PairGeometry, log_f: F64, *, principal_std: float) -> F64:
    """Return C^-1/2 (M, 3, 3) for the covariance C of the Kruppa residuals at log focal lengths (R,)."""
    duals = _dual_with_changes(log_f[pairs.i]), _dual_with_changes(log_f[pairs.j])
    variance = _variances(pairs.covariance, 0.0, principal_std)
    return _inverse_root(_residual_with_covariance(pairs.F, *duals, variance)[1], power=-0.5)


def _variances(covariance: F64, cell: float, principal_std: float) -> F64:
    """Return the covariance (M, 15, 15) of vec(F) and of (log f, principal point) of both cameras."""
    full = np.zeros((len(covariance), 15, 15))
    full[:, :9, :9] = covariance
    full[:, range(9, 15), range(9, 15)] = np.tile([cell**2 / 12.0, principal_std**2, principal_std**2], 2)
    return full


def _residual_with_covariance(F: F64, dual_i: F64, dual_j: F64, noise: F64) -> tuple[F64, F64]:
    """Return the cross products (B, 3) of the two unit triples and their covariances (B, 3, 3)."""
    L, N, dL, dN = _forms(F)
    n1, d1 = _directions(L, dual_i[:, 0], dL, dual_i[:, 1:])
    n2, d2 = _directions(N, dual_j[:, 0], dN, dual_j[:, 1:])
    by_first, by_second = np.cross(d1, n2[:, None]), np.cross(n1[:, None], d2)
    J = np.concatenate([by_first[:, :9] + by_second[:, :9], by_first[:, 9:], by_second[:, 9:]], axis=1)
    return np.cross(n1, n2), np.asarray(np.swapaxes(J, 1, 2) @ noise @ J)


def _dual_with_changes(log_f: F64) -> F64:
    """Return w* = diag(f^2, f^2, 1) and its derivatives by log f and principal point (B, 4, 3, 3)."""
    out = np.zeros((len(log_f), 4, 3, 3))
    squared = np.exp(2.0 * log_f)
    out[:, 0, 0, 0] = out[:, 0, 1, 1] = squared
    out[:, 0, 2, 2] = 1.0
    out[:, 1, 0, 0] = out[:, 1, 1, 1] = 2.0 * squared
    out[:, 2, 0, 2] = out[:, 2, 2, 0] = 1.0
    out[:, 3, 1, 2] = out[:, 3, 2, 1] = 1.0
    return out


def _inverse_root(C: F64, *, power: float) -> F64:
    """Return C^power of covariances (B, 3, 3) of rank 2.

    The third direction has a variance of second order only, which must not count: it gets 0.
    """
    value, vector = np.linalg.eigh(np.where(np.isfinite(C), C, 0.0))
    large = (value > 1e-10 * np.maximum(value[:, 2:], 1e-300)) & np.array([False, True, True])
    root = np.where(large, np.where(large, value, 1.0) ** power, 0.0)
    return np.asarray((vector * root[:, None, :]) @ np.swapaxes(vector, 1, 2))


@dataclass(frozen=True)
class FocalPosterior:
    """Posterior of the log focal lengths of the camera groups.

    Attributes
    ----------
    log_f, std : ndarray (G,)
        Means and standard deviations.
    support : ndarray (G, B)
        Log posterior on the grid.
    """

    log_f: F64
    std: F64
    support: F64


def focal_posterior(
    pairs: PairGeometry,
    group: I64,
    grid: F64,
    *,
    prior: tuple[F64, F64],
    principal_std: float = 0.01,
) -> FocalPosterior:
    """Combine the likelihoods of all pairs on a grid of log focal lengths.

    Pairs of one group inform one focal length, pairs of two groups two, and the other one is integrated out.
    Only 2 V - 3 of V (V - 1) / 2 pairs are independent: the sum is scaled down accordingly.

    Parameters
    ----------
    pairs : PairGeometry
        Fundamental matrices with covariances.
    group : ndarray (R,) of int
        Camera number of each view, dense.
    grid : ndarray (B,)
        Evenly spaced log focal lengths.
    prior : (ndarray (G,), ndarray (G,))
        Finite means and standard deviations (:func:`~thesisrecon.selfcalibration.unknowns.weak_focal_prior`).
    principal_std : float
        Standard deviation of the principal points, in the unit of F.

    Returns
    -------
    FocalPosterior
        Posterior of each group.

    References
    ----------
    V. Kocur, D. Kyselica, Z. Kukelova, CVPR 2024.
    """
    n, cell = int(group.max()) + 1, float(grid[1] - grid[0])
    # Widen a prior narrower than a cell, so that it does not fall between two of them.
    mean, std = prior[0][:, None], np.hypot(prior[1], cell)[:, None]
    log_prior = -0.5 * ((grid[None] - mean) / std) ** 2
    support = np.zeros((n, len(grid)))
    same = group[pairs.i] == group[pairs.j]
    if same.any():
        chi = _kruppa_chi_square(_some(pairs, same), grid, grid, cell=cell, principal_std=principal_std)
        np.add.at(support, group[pairs.i[same]], _robust(-0.5 * chi))
    if (~same).any():
        between = _some(pairs, ~same)
        first, second = (a.ravel() for a in np.meshgrid(grid, grid, indexing="ij"))
        for m in range(len(between.i)):
            one = _some(between, np.arange(len(between.i)) == m)
            chi = _kruppa_chi_square(one, first, second, cell=cell, principal_std=principal_std)
            table = -0.5 * chi.reshape(len(grid), len(grid))
            gi, gj = group[between.i[m]], group[between.j[m]]
            support[gi] += _robust(_marginal(table + log_prior[gj]))
            support[gj] += _robust(_marginal(table.T + log_prior[gi]))
    posterior = _independence_factor(pairs) * support + log_prior
    log_f, std = _moments(grid, posterior)
    return FocalPosterior(log_f, np.hypot(std, cell / np.sqrt(12.0)), posterior)


def _independence_factor(pairs: PairGeometry) -> float:
    """Return (2 V - 3) / M, at most 1, for M pairs of V cameras."""
    views = len(np.unique(np.concatenate([pairs.i, pairs.j])))
    return min(1.0, (2.0 * views - 3.0) / max(len(pairs.i), 1))


def _some(pairs: PairGeometry, chosen: NDArray[np.bool_]) -> PairGeometry:
    return PairGeometry(pairs.i[chosen], pairs.j[chosen], pairs.F[chosen], pairs.covariance[chosen])


def _marginal(table: F64) -> F64:
    """Return the log of the mean of exp(table) over the second axis."""
    top = float(table.max())
    return np.asarray(np.log(np.mean(np.exp(table - top), axis=1) + 1e-300))


def _robust(log_likelihood: F64) -> F64:
    """Return log((1 - c) L + c), L <= 1, with c the probability of a wrong pair."""
    relative = np.minimum(log_likelihood, 0.0)
    return np.asarray(np.log((1.0 - _WRONG_PAIR_PROBABILITY) * np.exp(relative) + _WRONG_PAIR_PROBABILITY))


def _moments(grid: F64, posterior: F64) -> tuple[F64, F64]:
    weight = np.exp(posterior - posterior.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    mean = weight @ grid
    return mean, np.sqrt(np.maximum(np.sum(weight * (grid - mean[:, None]) ** 2, axis=1), 0.0))


def _refine_focals(
    pairs: PairGeometry, unknown: SolverUnknowns, log_f: F64, *, principal_std: float = 1e-3
) -> tuple[F64, F64]:
    """Return log focal lengths (R,) and their standard deviations from all pairs, near a start (R,).

    Least squares of whitened Kruppa residuals over all unknowns. A shared principal point is one unknown: its
    error biases all pairs alike. ``principal_std`` (long sides) is the independent error of each view's. The
    loss turns at three sigmas: soft L1 for convergence, then Cauchy against wrong pairs.
    """
    unknown = unknown.with_focal_prior()
    x, share = unknown.from_log_focals(log_f[None])[0], _independence_factor(pairs)
    covariance = np.zeros((len(x), len(x)))
    for loss in ("soft_l1", "soft_l1", "cauchy", "cauchy") if len(x) else ():
        whitening = _kruppa_whitening(pairs, unknown.log_focals(x[None])[0], principal_std=principal_std)
        root = np.sqrt(share) * whitening

        def residuals(batch: F64, root: F64 = root) -> F64:
            w = dual_conics(unknown.calibrations(batch))
            g = kruppa_residuals(pairs.F, w[:, pairs.i], w[:, pairs.j])
            white = np.einsum("mac,bmc->bma", root, g).reshape(len(batch), -1)
            return np.concatenate([white, unknown.prior_residuals(batch)], axis=1)

        found = minimize_residuals(
            lambda y: residuals(y[None])[0], x,
            jacobian=lambda y: central_differences(residuals, y, np.full(len(y), 1e-6)),
            loss=loss, loss_scale=3.0 * np.sqrt(share), max_iterations=40,
        )  # fmt: skip
        x = found.x
        # The noise is known: the scale estimated by the minimizer is replaced by 1, or by the excess of the
        # residuals (two equations per pair) over their noise.
        variance = 2.0 * found.cost / max(len(found.residual) - len(x), 1)
        excess = 2.0 * found.cost / (share * max(2 * len(pairs.i) - len(x), 1))
        covariance = found.covariance / max(variance, 1e-300) * max(excess, 1.0)
    variances = np.append(np.maximum(covariance.diagonal(), 0.0), 0.0)
    return unknown.log_focals(x[None])[0], np.sqrt(variances[unknown.index[:, 0]])


@dataclass(frozen=True)
class FocalsFromFundamental:
    """Self-calibration by focal lengths from all fundamental matrices, each with its uncertainty.

    The posterior on a grid is refined jointly, and a plane at infinity is fitted to the focal lengths.

    Parameters
    ----------
    focal_range : (float, float)
        Focal lengths of the grid in long sides.
    focal_steps : int
        Number of focal lengths; a quarter of them if cameras differ.
    max_std : float
        A view whose log focal length has a larger standard deviation is reported as undetermined.
    min_common_points : int
        Minimum number of common observations of a pair.
    min_principal_point_std : float
        Lower bound of the standard deviation of the principal point, in long sides.
    criterion : RotationCriterion
        Criterion of the plane.

    References
    ----------
    S. Bougnoux, ICCV 1998; V. Kocur, D. Kyselica, Z. Kukelova, CVPR 2024.
    """

    focal_range: tuple[float, float] = (0.1, 60.0)
    focal_steps: int = 151
    max_std: float = 0.15
    min_common_points: int = 20
    min_principal_point_std: float = 1e-3
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
            Below three cameras or two pairs, or if the candidate does not place the points in front of the
            cameras.
        """
        frame = normalized_frame(reconstruction, prior)
        pairs = pair_geometries(frame, reconstruction, min_common_points=self.min_common_points)
        require_pairs(pairs, self.min_common_points)
        log_f, std = self.focals(pairs, frame, prior)
        log_f = np.array([np.median(log_f[frame.group == g]) for g in range(frame.n_groups)])
        plane, cost = planes_for_focals(frame, self.criterion, log_f)
        candidate = Candidate(plane, square_pixel_calibrations(log_f[frame.group]), cost, "focals from F")
        found = select_candidate(frame, reconstruction, self.criterion, [candidate])
        return self._with_focal_std(found, frame, std)

    def focals(self, pairs: PairGeometry, frame: ReferenceFrame, prior: IntrinsicsPrior) -> tuple[F64, F64]:
        """Estimate the focal lengths of all cameras.

        Parameters
        ----------
        pairs : PairGeometry
            Fundamental matrices with covariances.
        frame : ReferenceFrame
            Cameras.
        prior : IntrinsicsPrior
            Prior of all views.

        Returns
        -------
        log_f, std : ndarray (R,)
            Unit-free log focal lengths and their standard deviations.
        """
        several = frame.n_groups > 1
        grid = log_grid(self.focal_range, self.focal_steps // 4 if several else self.focal_steps)
        offset = np.median(prior.std[frame.views, 3]) / frame.pixel_from_unit[frame.views[0], 0, 0]
        principal_std = float(np.clip(np.nan_to_num(offset), self.min_principal_point_std, 0.1))
        nothing = np.full(frame.n_groups, np.nan), np.full(frame.n_groups, np.inf)
        known = nothing if frame.focal_mean is None or frame.focal_std is None else (
            frame.focal_mean, frame.focal_std,
        )  # fmt: skip
        weak = weak_focal_prior(*known)
        posterior = focal_posterior(pairs, frame.group, grid, principal_std=principal_std, prior=weak)
        unknown = solver_unknowns(frame, prior)
        start, spread = posterior.log_f[frame.group], posterior.std[frame.group]
        log_f, std = _refine_focals(pairs, unknown, start, principal_std=self.min_principal_point_std)
        # Whitened residuals also vanish at focal lengths near 0: keep the posterior mean there.
        diverged = np.abs(log_f - start) > _MAX_DEPARTURE_SIGMAS * np.maximum(spread, 0.1)
        return np.where(diverged, start, log_f), np.where(diverged, np.maximum(spread, self.max_std), std)

    def _with_focal_std(self, found: SelfCalibration, frame: ReferenceFrame, std: F64) -> SelfCalibration:
        K_std = focal_only_std(frame, found.K, std)
        open_views = frame.views[std >= self.max_std]
        if not len(open_views):
            return replace(found, K_std=K_std)
        names = ", ".join(f"#{v}" for v in open_views[:10])
        reason = (
            f"fundamental matrices do not determine the focal length of {len(open_views)} of "
            f"{len(frame.views)} images to {self.max_std:.0%} (image {names})"
        )
        return replace(found, K_std=K_std, identifiable=False, reasons=(*found.reasons, reason))
