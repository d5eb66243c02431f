"""Self-calibration by the absolute dual quadric (section 7.3; HZ 19.3), and by hypotheses of all methods.

Linear: M. Pollefeys, F. Verbiest, L. Van Gool, ECCV 2002. A camera with square pixels, no skew and a central
principal point gives six equations linear in the quadric, whose weights assume a focal length near 1.
Nonlinear: M. Pollefeys, R. Koch, L. Van Gool, IJCV 32(1), 1999, over the plane and all unknown intrinsics.
Each closed form fails on some image sets, so that the default method refines the hypotheses of all.
"""

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.homogeneous import quadratic_rows, symmetric
from thesisrecon.optimize.least_squares import huber, minimize_residuals
from thesisrecon.records import IntrinsicsPrior, Reconstruction, SelfCalibration
from thesisrecon.selfcalibration import _frame, _refinement, _upgrade
from thesisrecon.selfcalibration._frame import ReferenceFrame, SolverUnknowns
from thesisrecon.selfcalibration._upgrade import Candidate
from thesisrecon.selfcalibration.cheirality import CheiralitySearch

_MIN_NOISE = 1e-9
_REWEIGHTINGS = 4
_NOISE_PASSES = 6  # maximum number of noise estimates


def linear_quadric(frame: ReferenceFrame, focals: F64) -> F64:
    """Solve the weighted linear equations for normalizing focal lengths (B,); return quadrics Q (B, 4, 4).

    Rows are divided by uncertainties, 9 (focal length), 0.2 (aspect), 0.01 (skew), 0.1 (principal point), and
    by w33 of the previous iterate; the first iteration divides by the norm of the row of w33, since the 1 of
    the paper depends on the camera scale. Q has unit norm, and rank 4 under noise.
    """
    P = frame.P[None].repeat(len(focals), axis=0)
    P[:, :, :2] /= focals[:, None, None, None]
    p1, p2, p3 = P[:, :, 0], P[:, :, 1], P[:, :, 2]
    w11, w22, w33 = (quadratic_rows(p, p) for p in (p1, p2, p3))
    rows = np.stack(
        [(w11 - w33) / 9, (w22 - w33) / 9, (w11 - w22) / 0.2, quadratic_rows(p1, p2) / 0.01,
         quadratic_rows(p1, p3) / 0.1, quadratic_rows(p2, p3) / 0.1], axis=2,
    )  # fmt: skip
    nu = np.linalg.norm(w33, axis=-1)
    q = np.zeros((len(focals), 10))
    for _ in range(_REWEIGHTINGS):
        weighted = rows / np.maximum(nu, 1e-9 * nu.max(axis=1, keepdims=True))[:, :, None, None]
        A = weighted.reshape(len(focals), -1, 10)
        # SVD of A, since A'A would lose half the digits.
        q = np.linalg.svd(A, full_matrices=A.shape[1] < 10)[2][:, 9]
        nu = np.abs(np.einsum("bvk,bk->bv", w33, q))
    Q = symmetric(q)
    Q *= np.where(np.trace(Q[:, :3, :3], axis1=1, axis2=2) < 0, -1.0, 1.0)[:, None, None]
    return Q


def rank_three(Q: F64) -> tuple[F64, F64]:
    """Return the nearest quadrics of rank 3 to Q (B, 4, 4) and their null vectors, the planes at infinity."""
    value, vector = np.linalg.eigh(Q)
    smallest = np.abs(value).argmin(axis=1)
    null = np.take_along_axis(vector, smallest[:, None, None], axis=2)[:, :, 0]
    np.put_along_axis(value, smallest[:, None], 0.0, axis=1)
    return np.asarray((vector * value[:, None, :]) @ vector.swapaxes(1, 2)), null


def quadric_hypotheses(frame: ReferenceFrame, focals: F64) -> tuple[F64, F64]:
    """Planes at infinity (B', 3) and reference focals (B',) of linear quadrics from focals (B,)."""
    try:
        Q, null = rank_three(linear_quadric(frame, focals))
    except np.linalg.LinAlgError:
        return np.zeros((0, 3)), np.zeros(0)
    with np.errstate(divide="ignore", invalid="ignore"):
        p = null[:, :3] / null[:, 3:]
        f2 = (Q[:, 0, 0] + Q[:, 1, 1]) / (2.0 * Q[:, 2, 2])
    f = np.sqrt(np.where(np.isfinite(f2) & (f2 > 0), f2, focals**2))
    good = np.isfinite(p).all(axis=1)
    return p[good], np.clip(f[good], *_upgrade.FOCAL_LIMITS)


def minimize_quadric(
    frame: ReferenceFrame, unknown: SolverUnknowns, plane: F64, log_f: F64, *,
    method: str, loss_scale: float = 0.05,
) -> Candidate:  # fmt: skip
    """Minimize the nonlinear criterion from one plane (3,) and log focal lengths (R,).

    The priors are weighted relative to the noise of the residuals: the first pass assumes 1 %, each further
    one uses the previous estimate until it no longer falls. Huber's loss is linear beyond ``loss_scale``.
    """
    # The residuals also vanish as all focal lengths go to 0: the weak prior makes this cost more than noise.
    free, unknown = 3 + int(np.isinf(unknown.std).sum()), unknown.with_focal_prior()
    theta, noise = np.concatenate([plane, unknown.from_log_focals(log_f[None])[0]]), 0.01
    # Five independent entries per camera except the reference, whose residuals vanish.
    views = len(frame.views)
    dof = max(5 * (views - 1) - free, 1)
    for _ in range(_NOISE_PASSES):

        def residuals(x: F64, noise: float = noise) -> F64:
            K = unknown.calibrations(x[None, 3:])
            data = _refinement.dual_image_residuals(frame, K, x[None, :3]).ravel()
            return np.concatenate([data, noise * unknown.prior_residuals(x[None, 3:])[0]])

        supposed, loss = noise, partial(huber, delta=loss_scale)
        fit = minimize_residuals(residuals, theta, loss=loss, max_iterations=100, tolerance=1e-14)
        theta, squares = fit.x, float(np.sum(fit.residual[: 6 * views] ** 2))
        noise = max(float(np.sqrt(squares / dof)), _MIN_NOISE)
        if noise > 0.7 * supposed:
            break
    scale = noise**2 * max(len(fit.residual) - len(theta), 1) / max(2.0 * fit.cost, 1e-300)
    K = unknown.calibrations(theta[None, 3:])[0]
    K_std = unknown.calibration_std(theta[3:], fit.covariance[3:, 3:] * scale)
    return Candidate(theta[:3], K, squares / views, method, K_std)


@dataclass(frozen=True)
class LinearQuadric:
    """Self-calibration by the linear quadric for one normalizing focal length, without refinement.

    The equations assume focal lengths near this one and bias the result even without noise, by tens of
    percent for other lenses: the focal lengths have no standard deviation (NaN).

    Parameters
    ----------
    normalising_focal : float
        In long sides; 1.67 is the 60 mm lens of Pollefeys et al. on 36 mm film.

    Examples
    --------
    ``projective`` as in the example of `thesisrecon.self_calibrate`:

    >>> from thesisrecon import PipelineConfig, self_calibrate
    >>> from thesisrecon.selfcalibration.quadric import LinearQuadric
    >>> config = PipelineConfig(selfcalibration=LinearQuadric(normalising_focal=842 / 823))
    >>> round(self_calibrate(projective, config=config).K[0, 0, 0])
    842
    """

    normalising_focal: float = 1.67

    @_upgrade.as_stage_failure
    def calibrate(
        self, reconstruction: Reconstruction, *, prior: IntrinsicsPrior, rng: np.random.Generator  # noqa: ARG002
    ) -> SelfCalibration:  # fmt: skip
        """See `thesisrecon.config.SelfCalibrator.calibrate`."""
        frame = _frame.normalized_frame(reconstruction, prior)
        p, f = quadric_hypotheses(frame, np.array([self.normalising_focal]))
        log_f = _upgrade.group_focals_from_planes(frame, p, f)
        cost = _refinement.rotation_cost(frame, p, log_f)
        theta = np.concatenate([p, log_f], axis=1)
        candidates = _upgrade.candidates_from_parameters(frame, theta, cost, "linear quadric")
        found = _upgrade.select_candidate(frame, reconstruction, candidates)
        # The error is a bias, not noise: it has no standard deviation.
        K_std = found.K_std.copy()
        K_std[frame.views[:, None], (0, 1), (0, 1)] = np.nan
        return replace(found, K_std=K_std)


@dataclass(frozen=True)
class NonlinearQuadric:
    """Self-calibration by the nonlinear quadric, started from scanned linear quadrics."""

    # Range and number of the normalizing focal lengths of the linear quadrics, in long sides.
    focal_range, focal_steps = (0.2, 40.0), 45
    starts = 5  # number of hypotheses to refine over all unknown intrinsics
    loss_scale = 0.05  # residual beyond which an entry counts linearly (Huber)

    @_upgrade.as_stage_failure
    def calibrate(
        self, reconstruction: Reconstruction, *, prior: IntrinsicsPrior, rng: np.random.Generator  # noqa: ARG002
    ) -> SelfCalibration:  # fmt: skip
        """See `thesisrecon.config.SelfCalibrator.calibrate`."""
        frame = _frame.normalized_frame(reconstruction, prior)
        unknown = _frame.solver_unknowns(frame, prior)
        p, f = quadric_hypotheses(frame, np.geomspace(*self.focal_range, self.focal_steps))
        log_f = _upgrade.group_focals_from_planes(frame, p, f)
        cost = _refinement.rotation_cost(frame, p, log_f)
        best = np.argsort(cost, kind="stable")[: self.starts]
        candidates = [
            minimize_quadric(
                frame, unknown, p[b], log_f[b][frame.group],
                method="nonlinear quadric", loss_scale=self.loss_scale,
            )
            for b in best[np.isfinite(cost[best])]
        ]  # fmt: skip
        return _upgrade.select_candidate(frame, reconstruction, candidates)


# Standard deviation of principal point (long sides), aspect or skew beyond which estimating focal lengths
# alone is insufficient.
_MAX_OFFSET_STD = 0.02


@dataclass(frozen=True)
class HypothesesAndRefinement:
    """Self-calibration by hypotheses of all methods, a common refinement and a cheirality test.

    The refinement estimates focal lengths of cameras without skew. If the prior has a skew, or leaves more
    undetermined than a small offset of the principal point, the best candidates are refined by the nonlinear
    quadric over all unknown intrinsics.

    Parameters
    ----------
    search : CheiralitySearch, optional
        Hartley's search; None to omit it.
    """

    search: CheiralitySearch | None = field(default_factory=CheiralitySearch)

    focal_range, focal_steps = (0.2, 40.0), 45  # range in long sides and number of scanned focal lengths
    camera_subsets = 6  # number of random camera subsets for the quadric
    # Numbers of hypotheses to refine, and of distinct candidates to refine over all unknown intrinsics.
    max_refined, max_full_refined = 40, 8
    max_candidates = 3  # maximum number of candidates for bundle adjustment
    min_in_front_ratio = 0.95  # required share of observations with positive depth

    @_upgrade.as_stage_failure
    def calibrate(
        self, reconstruction: Reconstruction, *, prior: IntrinsicsPrior, rng: np.random.Generator
    ) -> SelfCalibration:
        """See `thesisrecon.config.SelfCalibrator.calibrate`."""
        frame = _frame.normalized_frame(reconstruction, prior)
        planes, log_f = self._propose(frame, reconstruction, rng)
        cost = np.nan_to_num(_refinement.rotation_cost(frame, planes, log_f), nan=np.inf)
        best = np.argsort(cost, kind="stable")[: self.max_refined]
        theta = np.concatenate([planes[best], log_f[best]], axis=1)
        theta, cost = _refinement.refine_hypotheses(frame, theta)
        candidates = _upgrade.candidates_from_parameters(frame, theta, cost, "hypotheses and refinement")
        unknown = _frame.solver_unknowns(frame, prior)
        others = np.setdiff1d(np.arange(len(unknown.std)), unknown.focals)
        if unknown.std[others].max(initial=0.0) > _MAX_OFFSET_STD or unknown.known[:, 2].any():
            candidates = [
                minimize_quadric(
                    frame, unknown, one.plane, _upgrade.group_log_focals(frame, one.K)[frame.group],
                    method="hypotheses and nonlinear quadric", loss_scale=_refinement.SCALE,
                )
                for one in _upgrade.distinct_candidates(frame, candidates, self.max_full_refined)
            ]  # fmt: skip
        return _upgrade.select_candidate(
            frame, reconstruction, candidates,
            max_candidates=self.max_candidates, min_in_front_ratio=self.min_in_front_ratio,
        )  # fmt: skip

    def _propose(
        self, frame: ReferenceFrame, reconstruction: Reconstruction, rng: np.random.Generator
    ) -> tuple[F64, F64]:
        """Return planes (B, 3) and log focal lengths (B, G) of all methods."""
        focals = np.geomspace(*self.focal_range, self.focal_steps)
        found = [quadric_hypotheses(frame, focals)]
        others = np.delete(np.arange(len(frame.views)), frame.reference)
        for _ in range(self.camera_subsets if len(others) > 3 else 0):
            size = int(rng.integers(3, len(others)))
            chosen = np.sort(np.append(rng.choice(others, size, replace=False), frame.reference))
            found.append(quadric_hypotheses(frame.subset(chosen), focals[::4]))
        # Equal focal lengths of one camera, else all pairs of every other value.
        pairs = [f.ravel() for f in np.meshgrid(focals[::2], focals[::2])]
        for other in others:
            f1, f2 = [focals] * 2 if frame.group[other] == frame.group[frame.reference] else pairs
            found.append(
                (_upgrade.gherardi_fusiello_planes(frame, int(other), f1, f2), np.concatenate([f1, f1]))
            )
        if self.search is not None:
            found.append(
                self.search.search(frame, reconstruction, _frame.square_pixel_constraints(frame), rng)
            )
        p = np.concatenate([part[0] for part in found])
        f = np.concatenate([part[1] for part in found])
        good = np.isfinite(p).all(axis=1) & np.isfinite(f)
        return p[good], _upgrade.group_focals_from_planes(frame, p[good], f[good])
