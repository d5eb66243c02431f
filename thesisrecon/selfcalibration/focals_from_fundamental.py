"""Focal lengths from fundamental matrices, each with its own uncertainty.

S. Bougnoux, "From projective to Euclidean space under any practical situation, a criticism of
self-calibration", ICCV 1998, has the closed form for one pair. It is singular where the optical axes meet or
are parallel, which is how most photographs are taken, and then says anything with the air of a result. So a
pair is also asked how well each focal explains its F, given the F's covariance and what is known of the
principal points (the idea of Kocur, Kyselica and Kukelova, CVPR 2024, "Robust self-calibration of focal
lengths from the fundamental matrix", without its iteration): the answer of a pair that does not know is flat,
and pairs vote with what they know.

Focals of all cameras by a vote of all pairs, each with what its F knows.

Every pair gives the likelihood of the focals on a grid (:mod:`focal_from_fundamental`); a pair whose F is
wrong or says nothing changes little, and a camera for which no pair speaks keeps its wide interval and is
named.
"""

from __future__ import annotations

from collections.abc import Callable
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
    require_cameras,
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


@dataclass(frozen=True)
class PairFocals:
    """Focals of the two cameras of a pair in the unit of F, NaN where F has no real one; relative standard
    deviations ``std`` (2,) to first order, infinite where the numerator or the denominator of the closed form
    cannot be told from 0."""

    focal: F64
    std: F64


def bougnoux_focals(F: F64) -> F64:
    """Squared focals (..., 2) of the first and the second camera from F (..., 3, 3), principal points at 0.

    f_1^2 = -(p'[e2]x I F p)(p'F'p) / (p'[e2]x I F I F'p), I = diag(1, 1, 0), p = (0, 0, 1), e2 the epipole in
    image 2 (F'e2 = 0); f_2 with F' and e1. Negative or infinite where no camera fits.
    """
    U, _, Vt = np.linalg.svd(F)
    terms = _bougnoux_terms(F, U[..., :, 2], Vt[..., 2, :])
    with np.errstate(divide="ignore", invalid="ignore"):
        return terms[..., 0] / terms[..., 1]


def _bougnoux_terms(F: F64, e2: F64, e1: F64) -> F64:
    """Numerator and denominator (..., 2 cameras, 2) of the closed form; p'[e]x is (-e_y, e_x, 0)."""
    terms = []
    for G, e in ((F, e2), (np.swapaxes(F, -1, -2), e1)):
        top = -(e[..., 0] * G[..., 1, 2] - e[..., 1] * G[..., 0, 2]) * G[..., 2, 2]
        GIGp = np.einsum("...ab,...b->...a", G[..., :2, :2], G[..., 2, :2])
        bottom = e[..., 0] * GIGp[..., 1] - e[..., 1] * GIGp[..., 0]
        terms.append(np.stack([top, bottom], axis=-1))
    return np.stack(terms, axis=-2)


def pair_focals(F: F64, covariance: F64, *, significance: float = 3.0) -> PairFocals:
    """Focals of one F (3, 3) with the ``covariance`` (9, 9) of vec(F), by the closed form.

    A focal whose numerator or denominator is within ``significance`` standard deviations of 0 is not
    determined by the pair: its deviation is infinite.
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
        return PairFocals(np.sqrt(squared), np.where(sure, deviation, np.inf))


def _terms_near(F0: F64, F: F64) -> F64:
    """Terms of matrices F (B, 3, 3) near F0, the signs of their epipoles those of F0's."""
    U0, _, Vt0 = np.linalg.svd(F0)
    U, _, Vt = np.linalg.svd(F)
    e2, e1 = U[:, :, 2], Vt[:, 2]
    e2 = e2 * np.where(e2 @ U0[:, 2] < 0.0, -1.0, 1.0)[:, None]
    e1 = e1 * np.where(e1 @ Vt0[2] < 0.0, -1.0, 1.0)[:, None]
    return _bougnoux_terms(F, e2, e1)


@dataclass(frozen=True)
class _PairForms:
    """What of M pairs the Kruppa equations need, and its derivatives by vec(F).

    S_i = L w*_i L' and S_j = N w*_j N' with rows L, N (M, 2, 3); dL, dN (M, 9, 2, 3) while the basis (u1, u2)
    of image 2 stays.
    """

    L: F64
    N: F64
    dL: F64
    dN: F64


def _forms(F: F64) -> _PairForms:
    """L = U2'F and N = U2'[e]x with U2 = (u1, u2), e = u3; de = -(F')^+ dF'e."""
    U, s, Vt = np.linalg.svd(F)
    U2 = U[:, :, :2].swapaxes(1, 2)
    e = U[:, :, 2]
    pseudo = np.einsum("mak,mk,mkb->mab", U[:, :, :2], 1.0 / np.maximum(s[:, :2], 1e-300), Vt[:, :2])
    # dF = e_k e_l': U2'dF has U2'e_k in column l, dF'e is e_l times the entry k of e.
    dL = np.einsum("mak,lb->mklab", U2, np.eye(3)).reshape(-1, 9, 2, 3)
    de = -np.einsum("mk,mal->mkla", e, pseudo).reshape(-1, 9, 3)
    dN = U2[:, None] @ cross_matrix(de)
    return _PairForms(U2 @ F, U2 @ cross_matrix(e), dL, dN)


def _directions(rows: F64, w: F64, d_rows: F64, d_w: F64) -> tuple[F64, F64]:
    """Unit triples (..., 3) of rows w rows' and their derivatives (..., 9 + E, 3) by F and by E changes of w.

    rows (..., 2, 3), w (..., 3, 3), d_rows (..., 9, 2, 3), d_w (..., E, 3, 3).
    """
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


def kruppa_chi_square(
    pairs: PairGeometry, log_f_i: F64, log_f_j: F64, *, cell: float, principal_std: float
) -> F64:
    """Squared Kruppa residuals (M, B) over their covariance for focals exp(log_f) (B,) of both cameras.

    The covariance is propagated from F, from principal points that lie off 0 with standard deviation
    ``principal_std`` (in the unit of F), and from focals anywhere in a cell of width ``cell`` of log f. About
    chi-square with two degrees of freedom at the truth, however little the pair knows.
    """
    forms = _forms(pairs.F)
    out = np.empty((len(pairs.i), len(log_f_i)))
    duals = _dual_with_changes(log_f_i), _dual_with_changes(log_f_j)
    for m in range(len(pairs.i)):
        one = _PairForms(forms.L[m][None], forms.N[m][None], forms.dL[m][None], forms.dN[m][None])
        variance = _variances(pairs.covariance[m][None], cell, principal_std)
        g, C = _residual_with_covariance(one, *duals, variance)
        out[m] = np.einsum("ba,bac,bc->b", g, _inverse_root(C, power=-1.0), g)
    return out


def kruppa_whitening(pairs: PairGeometry, log_f: F64, *, principal_std: float) -> F64:
    """C^-1/2 (M, 3, 3) of the Kruppa residuals' covariance C at log focals (R,) of the cameras."""
    duals = _dual_with_changes(log_f[pairs.i]), _dual_with_changes(log_f[pairs.j])
    variance = _variances(pairs.covariance, 0.0, principal_std)
    return _inverse_root(_residual_with_covariance(_forms(pairs.F), *duals, variance)[1], power=-0.5)


def _variances(covariance: F64, cell: float, principal_std: float) -> F64:
    """Covariance (M, 15, 15) of vec(F) and of (log f, principal point) of both cameras."""
    full = np.zeros((len(covariance), 15, 15))
    full[:, :9, :9] = covariance
    full[:, range(9, 15), range(9, 15)] = np.tile([cell**2 / 12.0, principal_std**2, principal_std**2], 2)
    return full


def _residual_with_covariance(forms: _PairForms, dual_i: F64, dual_j: F64, noise: F64) -> tuple[F64, F64]:
    """Cross products (B, 3) of the two unit triples and their covariances (B, 3, 3); all broadcasts."""
    n1, d1 = _directions(forms.L, dual_i[:, 0], forms.dL, dual_i[:, 1:])
    n2, d2 = _directions(forms.N, dual_j[:, 0], forms.dN, dual_j[:, 1:])
    by_first, by_second = np.cross(d1, n2[:, None]), np.cross(n1[:, None], d2)
    J = np.concatenate([by_first[:, :9] + by_second[:, :9], by_first[:, 9:], by_second[:, 9:]], axis=1)
    return np.cross(n1, n2), np.asarray(np.swapaxes(J, 1, 2) @ noise @ J)


def _dual_with_changes(log_f: F64) -> F64:
    """w* = diag(f^2, f^2, 1) and its derivatives by log f and by the principal point; (B, 4, 3, 3)."""
    out = np.zeros((len(log_f), 4, 3, 3))
    squared = np.exp(2.0 * log_f)
    out[:, 0, 0, 0] = out[:, 0, 1, 1] = squared
    out[:, 0, 2, 2] = 1.0
    out[:, 1, 0, 0] = out[:, 1, 1, 1] = 2.0 * squared
    out[:, 2, 0, 2] = out[:, 2, 2, 0] = 1.0
    out[:, 3, 1, 2] = out[:, 3, 2, 1] = 1.0
    return out


def _inverse_root(C: F64, *, power: float) -> F64:
    """C^power of covariances (B, 3, 3) of rank 2; the direction without noise or residual gets 0.

    Away from the solution that direction has a small variance of second order, which must not count.
    """
    value, vector = np.linalg.eigh(np.where(np.isfinite(C), C, 0.0))
    large = (value > 1e-10 * np.maximum(value[:, 2:], 1e-300)) & np.array([False, True, True])
    root = np.where(large, np.where(large, value, 1.0) ** power, 0.0)
    return np.asarray((vector * root[:, None, :]) @ np.swapaxes(vector, 1, 2))


STRAYED = 4.0
"""Standard deviations of the vote, beyond which the joint answer has left it."""

WRONG_PAIR = 1e-2
"""Chance that a pair's F is wrong, so that no pair alone can forbid a focal."""


@dataclass(frozen=True)
class FocalPosterior:
    """``log_f`` and ``std`` (G,) of the groups' log focals; ``support`` (G, B) log posterior on the grid."""

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
    """Log focals of G groups of cameras from all pairs.

    group (R,) camera number, dense; grid (B,) of log focals, evenly spaced; ``prior`` finite means and
    standard deviations (G,) of log focals (:func:`weak_focal_prior`). Pairs within a group are asked about one
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
    posterior = independence_factor(pairs) * support + log_prior
    log_f, std = _moments(grid, posterior)
    return FocalPosterior(log_f, np.hypot(std, cell / np.sqrt(12.0)), posterior)


def independence_factor(pairs: PairGeometry) -> float:
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
    pairs: PairGeometry, unknown: SolverUnknowns, log_f: F64, *, principal_std: float = 1e-3
) -> tuple[F64, F64]:
    """Log focals (R,) of the cameras and their standard deviations from all pairs, near a start (R,).

    Least squares of the Kruppa residuals over all that is ``unknown``, each residual whitened by its own
    covariance at the last answer. A principal point that all views share is one unknown: its error pulls all
    pairs the same way, and no number of them averages it out. ``principal_std`` (long sides) is what may be
    wrong with each view's by itself. The loss turns at three sigmas: first that of soft L1, which leads to
    the minimum from afar, then Cauchy's against wrong pairs.
    """
    unknown = unknown.with_focal_prior()
    x, share = unknown.from_log_focals(log_f[None])[0], independence_factor(pairs)
    covariance = np.zeros((len(x), len(x)))
    for loss in ("soft_l1", "soft_l1", "cauchy", "cauchy") if len(x) else ():
        whitening = kruppa_whitening(pairs, unknown.log_focals(x[None])[0], principal_std=principal_std)
        root = np.sqrt(share) * whitening

        def residuals(batch: F64, root: F64 = root) -> F64:
            w = dual_conics(unknown.calibrations(batch))
            g = kruppa_residuals(pairs.F, w[:, pairs.i], w[:, pairs.j])
            white = np.einsum("mac,bmc->bma", root, g).reshape(len(batch), -1)
            return np.concatenate([white, unknown.prior_residuals(batch)], axis=1)

        found = minimize_residuals(
            lambda y: residuals(y[None])[0], x, jacobian=lambda y: central_differences(residuals, y, np.full(len(y), 1e-6)), loss=loss,
            loss_scale=3.0 * np.sqrt(share), max_iterations=40,
        )  # fmt: skip
        x = found.x
        # The noise is known: in place of the scale that the minimiser estimated stands 1, or what the pairs
        # (two equations each) contradict each other more than their noise allows.
        variance = 2.0 * found.cost / max(len(found.residual) - len(x), 1)
        contradiction = 2.0 * found.cost / (share * max(2 * len(pairs.i) - len(x), 1))
        covariance = found.covariance / max(variance, 1e-300) * max(contradiction, 1.0)
    variances = np.append(np.maximum(covariance.diagonal(), 0.0), 0.0)
    return unknown.log_focals(x[None])[0], np.sqrt(variances[unknown.index[:, 0]])


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
        """Upgrade by the vote; ``StageFailure`` below three cameras, without pairs, and where no answer puts
        the scene in front of the cameras."""
        require_cameras(reconstruction)
        frame = normalized_frame(reconstruction, prior)
        pairs = pair_geometries(frame, reconstruction, min_common_points=self.min_common_points)
        require_pairs(pairs, self.min_common_points)
        log_f, std = self.focals(pairs, frame, prior)
        log_f = np.array([np.median(log_f[frame.group == g]) for g in range(frame.n_groups)])
        plane, cost = planes_for_focals(frame, self.criterion, log_f)
        answer = Candidate(plane, square_pixel_calibrations(log_f[frame.group]), cost, "focals from F")
        found = select_candidate(
            frame, reconstruction, self.criterion, [answer], max_candidates=1, min_in_front_ratio=0.5
        )
        return self._with_own_deviations(found, frame, std)

    def focals(self, pairs: PairGeometry, frame: ReferenceFrame, prior: IntrinsicsPrior) -> tuple[F64, F64]:
        """Log focals (R,) of the cameras, unit-free, and their standard deviations."""
        several = frame.n_groups > 1
        grid = log_grid(self.focal_range, self.focal_steps // 4 if several else self.focal_steps)
        offset = np.median(prior.std[frame.views, 3]) / frame.pixel_from_unit[frame.views[0], 0, 0]
        principal_std = float(np.clip(np.nan_to_num(offset), self.min_principal_point_std, 0.1))
        nothing = np.full(frame.n_groups, np.nan), np.full(frame.n_groups, np.inf)
        known = nothing if frame.focal_mean is None or frame.focal_std is None else (
            frame.focal_mean, frame.focal_std,
        )  # fmt: skip
        weak = weak_focal_prior(*known)
        vote = focal_posterior(pairs, frame.group, grid, principal_std=principal_std, prior=weak)
        unknown = solver_unknowns(frame, prior)
        start, spread = vote.log_f[frame.group], vote.std[frame.group]
        log_f, std = refine_focals(pairs, unknown, start, principal_std=self.min_principal_point_std)
        # Residuals also vanish where everything is blurred, at focals near 0: there the vote stands.
        strayed = np.abs(log_f - start) > STRAYED * np.maximum(spread, 0.1)
        return np.where(strayed, start, log_f), np.where(strayed, np.maximum(spread, self.max_std), std)

    def _with_own_deviations(
        self, found: SelfCalibration, frame: ReferenceFrame, std: F64
    ) -> SelfCalibration:
        K_std = focal_only_std(frame, found.K, std)
        open_views = frame.views[std >= self.max_std]
        if not len(open_views):
            return replace(found, K_std=K_std)
        names = ", ".join(str(v) for v in open_views[:10])
        reason = (
            f"fundamental matrices leave the focal of {len(open_views)} of {len(frame.views)} photographs "
            f"open by more than {self.max_std:.0%} (number {names})"
        )
        return replace(found, K_std=K_std, identifiable=False, reasons=(*found.reasons, reason))
