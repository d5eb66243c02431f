"""Criterion and batched Levenberg-Marquardt for hypotheses of (plane at infinity, focal lengths).

With C_i = K_i^-1 (A_i - a_i p') K_r a correct hypothesis makes every C_i a scaled rotation. The residuals are
the six entries of 3 C C' / tr(C C') - I: the nonlinear criterion of Pollefeys et al. (IJCV 32(1), 1999) in
scale-free form, with one log f per camera group.
"""

from collections.abc import Callable

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.optimize.least_squares import central_differences, soft_l1
from thesisrecon.selfcalibration._frame import ReferenceFrame

SCALE = 0.05  #: distance from a scaled rotation beyond which the loss is linear
FOCAL_LOG_MEAN, FOCAL_WEIGHT = 0.2, 2e-3
"""Weak prior of an unknown focal length: mean of its logarithm, and weight."""
GIVEN_WEIGHT = 0.01  #: weight of a given focal length in units of its standard deviation
_UPPER = np.triu_indices(3)
ENTRY_WEIGHT = np.where(_UPPER[0] == _UPPER[1], 1.0, np.sqrt(2.0))


def _weighted_entries(M: F64) -> F64:
    """Return the upper triangles (..., 6) of symmetric matrices, whose norm is the Frobenius norm."""
    return np.asarray(M[..., *_UPPER] * ENTRY_WEIGHT, dtype=np.float64)


def dual_image_residuals(frame: ReferenceFrame, K: F64, planes: F64) -> F64:
    """Entries (B, R, 6) of K K' / |K K'| - P Q P' / |P Q P'| for K (B, R, 3, 3) (IJCV 32(1), 1999)."""
    C = frame.homographies(planes) @ K[:, None, frame.reference]
    return _weighted_entries(_unit(K @ K.swapaxes(-1, -2)) - _unit(C @ C.swapaxes(-1, -2)))


def _unit(conic: F64) -> F64:
    norm = np.sqrt(np.sum(conic**2, axis=(-2, -1), keepdims=True))
    return np.asarray(conic / np.maximum(norm, 1e-300))


def rotation_residuals(frame: ReferenceFrame, theta: F64) -> F64:
    """Residuals (B, 6 R + G) of cameras and focal priors for hypotheses (p, log f) (B, 3 + G).

    Of the cameras the weighted entries of 3 C C' / tr(C C') - I.
    """
    log_f = theta[:, 3:]
    f = np.exp(log_f)[:, frame.group]
    C = frame.homographies(theta[:, :3])
    C[..., :2] *= f[:, frame.reference, None, None, None]
    C[..., :2, :] /= f[..., None, None]
    CC = C @ C.swapaxes(-1, -2)
    trace = np.trace(CC, axis1=-2, axis2=-1)[..., None, None]
    cameras = _weighted_entries(3.0 * CC / np.maximum(trace, 1e-300) - np.eye(3)).reshape(len(theta), -1)
    known = np.isfinite(frame.focal_std)
    given = (log_f - np.where(known, frame.focal_mean, 0.0)) / np.where(known, frame.focal_std, 1.0)
    priors = np.where(known, GIVEN_WEIGHT * given, FOCAL_WEIGHT * (log_f - FOCAL_LOG_MEAN))
    return np.concatenate([cameras, priors], axis=1)


def rotation_loss(frame: ReferenceFrame, r: F64) -> tuple[F64, F64]:
    """Costs (B,) per camera and weights (B, 6 R + G) of residuals, soft-L1 of each camera's norm."""
    cameras, priors = np.split(r, [6 * len(frame.views)], axis=1)
    robust, weight = soft_l1(np.sum(cameras.reshape(len(r), -1, 6) ** 2, axis=-1), SCALE)
    cost = (robust.sum(axis=1) + np.sum(priors**2, axis=1)) / len(frame.views)
    return cost, np.concatenate([np.repeat(weight, 6, axis=1), np.ones_like(priors)], axis=1)


def rotation_cost(frame: ReferenceFrame, p: F64, log_f: F64) -> F64:
    """Return the robust cost (B,) per camera of planes (B, 3) with log focal lengths (B, G)."""
    return rotation_loss(frame, rotation_residuals(frame, np.concatenate([p, log_f], axis=1)))[0]


def _solve_batch(N: F64, g: F64) -> F64:
    """Solve N x = g for symmetric positive N (B, n, n); singular or non-finite systems give 0."""
    bad = np.asarray(~(np.isfinite(N).all(axis=(1, 2)) & np.isfinite(g).all(axis=1)))
    N = np.where(bad[:, None, None], np.eye(N.shape[1]), N)
    g = np.where(bad[:, None], 0.0, g)
    scale = np.maximum(np.abs(np.einsum("bii->bi", N)), 1e-300) ** -0.5
    scaled = N * scale[:, :, None] * scale[:, None, :] + 1e-13 * np.eye(N.shape[1])
    try:
        return np.asarray(np.linalg.solve(scaled, (g * scale)[..., None])[..., 0] * scale, dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.zeros_like(g)


def minimize_batch(
    residuals: Callable[[F64], F64], x: F64, *, iterations: int, loss_scale: float = np.inf,
    loss: Callable[[F64], tuple[F64, F64]] | None = None, project: Callable[[F64], F64] = lambda x: x,
    damping: float = 1e-2, decrease: float = 6.0, max_damping: float = 1e10, tolerance: float = 1e-14,
) -> tuple[F64, F64]:  # fmt: skip
    """Levenberg-Marquardt on all rows of x (B, D) until every row has finished; minima and costs (B,)."""

    # `residuals` maps (B, D) to (B, M) row by row, `loss` these to costs and weights, by default means of
    # soft-L1 losses, inf where NaN.
    def mean_loss(r: F64) -> tuple[F64, F64]:
        losses, weight = (r**2, np.ones_like(r)) if np.isinf(loss_scale) else soft_l1(r**2, loss_scale)
        return np.nan_to_num(losses.mean(axis=1), nan=np.inf), weight

    loss = loss or mean_loss
    cost, damped = loss(residuals(x))[0], np.full(len(x), damping)
    for _ in range(iterations):
        r, J = residuals(x), central_differences(residuals, x)
        weight = loss(r)[1]
        N, g = np.einsum("bmi,bm,bmj->bij", J, weight, J), np.einsum("bmi,bm->bi", J, weight * r)
        diagonal = np.einsum("bii->bi", N)
        # Products with an identity matrix would be NaN where the diagonal is infinite.
        diagonal += damped[:, None] * (diagonal + 1e-12)
        trial = project(x - _solve_batch(N, g))
        trial_cost = loss(residuals(trial))[0]
        better = np.asarray(trial_cost < cost)
        finished = (better & (cost - trial_cost <= tolerance * cost)) | ~np.isfinite(cost)
        x, cost = np.where(better[:, None], trial, x), np.where(better, trial_cost, cost)
        damped = np.where(better, damped / decrease, damped * 4.0)
        if (finished | (damped > max_damping)).all():
            break
    return x, cost


def refine_hypotheses(frame: ReferenceFrame, theta: F64, *, planes_only: bool = False) -> tuple[F64, F64]:
    """Refine hypotheses (p, log f) (B, 3 + G) at once; return them with their costs (B,)."""
    moving = 3 if planes_only else theta.shape[1]

    def with_fixed(x: F64) -> F64:
        return np.concatenate([x, theta[:, moving:]], axis=1)

    x, cost = minimize_batch(
        lambda x: rotation_residuals(frame, with_fixed(x)), theta[:, :moving], iterations=25,
        loss=lambda r: rotation_loss(frame, r), damping=1e-3, decrease=5.0, max_damping=1e8, tolerance=1e-10,
        project=lambda x: np.concatenate([x[:, :3], np.clip(x[:, 3:], -4.0, 5.4)], axis=1),
    )  # fmt: skip
    return with_fixed(x), cost


def focal_std(frame: ReferenceFrame, theta: F64) -> F64:
    """Standard deviations (G,) of the log focals at a minimum (p, log f) by (J'J)^-1; inf if singular."""
    r = rotation_residuals(frame, theta[None])
    J = central_differences(lambda x: rotation_residuals(frame, x), theta[None])[0]
    root = np.sqrt(rotation_loss(frame, r)[1][0])
    dof = max(5 * len(frame.views) - len(theta), 1)
    noise = float(np.sqrt(np.sum((root * r[0]) ** 2) / dof))
    J = root[:, None] * J
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-12)
    S, Vt = np.linalg.svd(J / scale)[1:]
    with np.errstate(divide="ignore"):
        variance = np.sum((Vt / np.maximum(S, 1e-300)[:, None]) ** 2, axis=0) / scale**2
    return np.asarray(noise * np.sqrt(variance[3:]), dtype=np.float64)
