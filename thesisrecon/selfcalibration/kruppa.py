"""Self-calibration by the Kruppa equations, which need fundamental matrices only (section 7.3, direct).

Corresponding epipolar lines are tangent to the images of the absolute conic: F w*_i F' ~ [e]x w*_j [e]x' with
the dual images w* = K K' (HZ 19.4). With F = U diag(r, s, 0) V' (R. Hartley, "Kruppa's equations derived from
the fundamental matrix", PAMI 19(2), 1997):

    (u2'w*_j u2) / (r^2 v1'w*_i v1) = -(u1'w*_j u2) / (r s v1'w*_i v2) = (u1'w*_j u1) / (s^2 v2'w*_i v2).

Both triples are normalized and compared by their cross product, so that no denominator vanishes. The plane at
infinity does not appear: more motions are critical than for the quadric, but no projective frame is needed.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.homogeneous import pixel_from_unit, unit_norm
from thesisrecon.geometry.two_view import fundamental_from_cameras
from thesisrecon.optimize.least_squares import minimize_residuals, soft_l1
from thesisrecon.records import IntrinsicsPrior, Reconstruction, SelfCalibration
from thesisrecon.selfcalibration import _frame, _upgrade
from thesisrecon.selfcalibration._frame import ReferenceFrame, SolverUnknowns
from thesisrecon.selfcalibration._refinement import refine_hypotheses, rotation_cost
from thesisrecon.selfcalibration._upgrade import Candidate

_ROOT2 = np.sqrt(2.0)
_MAX_PLANES = 8  # number of planes to refine for each calibration
# Residual of a good pair, the noise to which the priors are weighted, and residual that is rounding.
_NOISE, _ROUNDING = 0.01, 1e-9
# Standard deviation of the log focal length from which it is undetermined, and the step of its derivative.
_MAX_FOCAL_STD, _STEP = 0.15, 0.05
_CENTRE_STD = 0.01  # prior of the principal point in long sides, as for all methods by default
# Difference of log focal lengths below which they are the same; ratio of residuals of equally good solutions.
_SAME, _ALIKE = 0.03, 2.0


class _Pairs(NamedTuple):
    """F (M, 3, 3) of camera pairs at places i, j (M,): x_j' F x_i = 0 in unit-free coordinates, unit norm."""

    i: I64
    j: I64
    F: F64


def _overlapping_pairs(frame: ReferenceFrame, reconstruction: Reconstruction, min_common: int) -> _Pairs:
    """Return F of the cameras for all pairs with at least ``min_common`` common observations."""
    common = reconstruction.common_points[np.ix_(frame.views, frame.views)]
    if not reconstruction.inlier.any():
        common[:] = np.inf  # cameras without points: all pairs
    P = frame.P
    places, found = [], []
    for i, j in np.argwhere(np.triu(common >= min_common, 1)):
        try:
            found.append(unit_norm(fundamental_from_cameras(P[i], P[j])))
        except ValueError:
            continue  # one centre: no epipolar geometry
        places.append((i, j))
    i, j = np.array(places, dtype=np.int64).reshape(-1, 2).T
    return _Pairs(i, j, np.array(found).reshape(-1, 3, 3))


def _kruppa_residuals(F: F64, dual_i: F64, dual_j: F64) -> F64:
    """Cross products (B, M, 3) of the unit triples, for F (M, 3, 3) and dual conics (B, M, 3, 3)."""
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


def _pair_residuals(pairs: _Pairs, K: F64) -> F64:
    """Return the residuals (B, M, 3) of all pairs for calibrations K (B, R, 3, 3)."""
    w = K @ K.swapaxes(-1, -2)
    return _kruppa_residuals(pairs.F, w[:, pairs.i], w[:, pairs.j])


def _kruppa_cost(pairs: _Pairs, K: F64, *, loss_scale: float) -> F64:
    """Return the mean soft-L1 cost (B,) of a pair for calibrations K (B, R, 3, 3)."""
    squared = np.sum(_pair_residuals(pairs, K) ** 2, axis=-1)
    return np.asarray(np.mean(soft_l1(squared, loss_scale)[0], axis=1))


@dataclass(frozen=True)
class KruppaEquations:
    """Self-calibration by the Kruppa equations over all camera pairs.

    One common focal length is scanned; the best minima are refined over all unknown intrinsics, and a plane
    at infinity is fitted to each. The candidate whose cameras are nearest to rotations is selected, because
    few pairs leave false solutions without residual. Solutions that do not determine a focal length that is
    not given are rejected: those near 0, and all of cameras on a sphere that look at its centre [1]_.

    References
    ----------
    .. [1] P. Sturm, "A case against Kruppa's equations for camera self-calibration", PAMI 22(10), 2000.
    """

    # Range in long sides and number of the scanned focal lengths.
    focal_range, focal_steps = (0.2, 40.0), 90
    starts = 4  # number of minima to refine
    loss_scale = 0.02  # residual of a pair beyond which it counts linearly (soft L1)
    min_common_points = 20  # minimum number of common observations of a pair

    @_upgrade.as_stage_failure
    def calibrate(
        self, reconstruction: Reconstruction, *, prior: IntrinsicsPrior, rng: np.random.Generator  # noqa: ARG002
    ) -> SelfCalibration:  # fmt: skip
        """See `thesisrecon.config.SelfCalibrator.calibrate`."""
        frame = _frame.normalized_frame(reconstruction, prior)
        pairs = _overlapping_pairs(frame, reconstruction, self.min_common_points)
        if len(pairs.i) < 2:
            raise StageFailure.of("few-kruppa-pairs", counted(len(pairs.i), "pair"), self.min_common_points)
        unknown = _frame.solver_unknowns(frame, prior)
        candidates = []
        for K, K_std, _ in self._solutions(pairs, unknown, len(frame.views)):
            plane, cost = _plane_for_focals(frame, _upgrade.group_log_focals(frame, K))
            candidates.append(Candidate(plane, K, cost, "Kruppa equations", K_std))
        return _upgrade.select_candidate(frame, reconstruction, candidates)

    def _solutions(self, pairs: _Pairs, unknown: SolverUnknowns, n: int) -> list[tuple[F64, F64, float]]:
        """K (n, 3, 3), standard deviations and rms residual of minima whose focal is determined or given."""

        def residuals(x: F64) -> F64:
            r = _pair_residuals(pairs, unknown.calibrations(x[None])).ravel()
            return np.concatenate([r, _NOISE * unknown.prior_residuals(x[None])[0]])

        found, weakest = [], np.inf
        given = float(unknown.std[unknown.focals].max(initial=0.0))
        # The best local minima of one common log focal length.
        grid = np.linspace(np.log(self.focal_range[0]), np.log(self.focal_range[1]), self.focal_steps)
        K = _upgrade.square_pixel_calibrations(np.repeat(grid[:, None], n, axis=1))
        cost = _kruppa_cost(pairs, K, loss_scale=self.loss_scale)
        padded = np.pad(cost, 1, constant_values=np.inf)
        minima = np.flatnonzero((cost <= padded[:-2]) & (cost <= padded[2:]))
        for log_f in grid[minima[np.argsort(cost[minima], kind="stable")][: self.starts]].tolist():
            start = unknown.from_log_focals(np.full((1, n), log_f))[0]
            loss = partial(soft_l1, delta=self.loss_scale)
            fit = minimize_residuals(residuals, start, loss=loss, max_iterations=80, tolerance=1e-14)
            K, K_std = unknown.calibrations(fit.x[None])[0], unknown.calibration_std(fit.x, fit.covariance)
            # The deviation of log f by the change of the residuals with all focal lengths.
            scaled = np.repeat(K[None], 3, axis=0)
            scaled[:, :, :2, :2] *= np.exp([-_STEP, 0.0, _STEP])[:, None, None, None]
            lower, middle, upper = _pair_residuals(pairs, scaled)
            slope = float(np.linalg.norm(upper - lower)) / (2.0 * _STEP)
            residual = float(np.sqrt(np.mean(np.sum(middle**2, axis=1))))
            focal_std = max(residual, _ROUNDING) / max(slope, 1e-300)
            weakest = min(weakest, focal_std)
            if min(focal_std, given) < _MAX_FOCAL_STD:
                found.append((K, K_std, residual))
        if found:
            return sorted(found, key=lambda solution: solution[2])
        raise StageFailure.of(
            "undetermined-kruppa-focal",
            f"{counted(len(pairs.i), 'pair')} of views agree with "
            + ("any focal length" if weakest > 1.0 else f"focal lengths within {weakest:.0%}"),
        )


def _plane_for_focals(frame: ReferenceFrame, log_f: F64) -> tuple[F64, float]:
    """The best plane (3,) for known log focal lengths (G,) and its cost; NaN and inf if there is none."""
    f = np.exp(log_f[frame.group])
    reference = np.array([f[frame.reference]])
    others = np.delete(np.arange(len(f)), frame.reference)
    planes = np.concatenate(
        [_upgrade.gherardi_fusiello_planes(frame, int(k), reference, f[k : k + 1]) for k in others]
    )
    planes = planes[np.isfinite(planes).all(axis=1)]
    if not len(planes):
        return np.full(3, np.nan), np.inf
    theta = np.concatenate([planes, np.repeat(log_f[None], len(planes), axis=0)], axis=1)
    order = np.argsort(rotation_cost(frame, theta[:, :3], theta[:, 3:]), kind="stable")[:_MAX_PLANES]
    theta, cost = refine_hypotheses(frame, theta[order], planes_only=True)
    best = int(np.nan_to_num(cost, nan=np.inf).argmin())
    return theta[best, :3], float(cost[best])


def calibrate_from_fundamentals(F: F64, sizes: I64) -> F64:
    """Calibrate a camera from F (M, 3, 3), all images of one size; see :func:`thesisrecon.kruppa`."""
    unit = pixel_from_unit(sizes)[0]
    F = unit_norm(unit.T @ F @ unit)
    if not len(F) or not (np.linalg.svd(F, compute_uv=False)[:, 1] > 1e-9).all():
        raise ValueError("kruppa needs at least one fundamental matrix, each of rank 2")
    same = np.zeros(len(F), dtype=np.int64)
    index, known = np.array([[0, -1, -1, 1, 2]]), np.zeros((1, 5))
    unknown = SolverUnknowns(index, known, np.zeros(3), np.array([np.inf, _CENTRE_STD, _CENTRE_STD]))
    best, *others = KruppaEquations()._solutions(_Pairs(same, same, F), unknown, 1)
    focal = [float(unit[0, 0] * K[0, 0, 0]) for K, _, _ in (best, *others)]
    for f, (_, _, residual) in zip(focal[1:], others, strict=True):
        if abs(np.log(f / focal[0])) > _SAME and residual <= max(_ALIKE * best[2], _ROUNDING):
            raise StageFailure.of("several-kruppa-solutions", focal[0], f, counted(len(F), "pair"))
    return np.asarray(unit @ best[0][0])
