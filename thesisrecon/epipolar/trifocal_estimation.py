"""Section 3.6.3: the trifocal tensor with the least reprojection error of points and lines in three views.

Linear equations; the least algebraic error over both epipoles (HZ, algorithm 16.2); the least reprojection
error over cameras, points and lines (HZ 16.4).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar._tensor_equations import (
    NEEDED_EQUATIONS,
    TensorEquations,
    check_triplets,
    tensor_equations,
)
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import homogenize, unit_normals
from thesisrecon.geometry.three_view import cameras_from_tensor, tensor_epipoles, tensor_from_cameras
from thesisrecon.numerics.levenberg_marquardt import (
    DenseSystem,
    invert_information,
    minimize_residuals,
    run_levenberg_marquardt,
)
from thesisrecon.numerics.noise import huber

# Largest relative standard deviation of T. Planes, rotations and random matches give 0.5 to 1.5 at any noise;
# scenes with depth and noise of a hundredth of the parallax below 0.1.
WEAK = 0.4
# A fit is refused if noise of 1.25 times its own explains six tensors of the linear equations. Points or
# lines of a plane and rotations leave 6 to 12, parallel lines 13 or more, three walls at most 5, which the
# constraints of the cameras resolve.
SAME_NOISE, FAMILY = 1.25, 6
NO_POINTS, NO_SEGMENTS = np.zeros((3, 0, 2)), np.zeros((3, 0, 2, 2))
UNDETERMINED = "the matches do not determine the trifocal tensor"
REMEDY = "use matches off one plane from three different positions, and check for wrong matches"
_State = tuple[F64, F64]


@dataclass(frozen=True)
class TrifocalFit:
    """A trifocal tensor with its residuals and noise.

    Parameters
    ----------
    T : ndarray (3, 3, 3)
        Tensor in pixels, unit norm; its cameras are exact.
    point_residuals_px, line_residuals_px : ndarray (3, N), (3, M, 2)
        Distances of the points to their reprojections and of the segment ends to the reprojected lines.
    sigma_px : float
        Noise of one coordinate from all residuals and degrees of freedom.
    covariance : ndarray (27, 27)
        First-order covariance of T, row-major, rank 18.
    relative_std : float
        Largest standard deviation of T in conditioned coordinates, times the root of the number of matches.
        Near 1 a change of T by its own size moves the images no more than their noise.
    """

    T: F64
    point_residuals_px: F64
    line_residuals_px: F64
    sigma_px: float
    covariance: F64
    relative_std: float


def estimate_trifocal(
    points: F64 = NO_POINTS, segments: F64 = NO_SEGMENTS, *, loss_px: float = 1.0
) -> TrifocalFit:
    """Estimate the trifocal tensor from points and lines of three views.

    Minimises Huber's loss of the distances of points to their reprojections and of segment ends to their
    reprojected lines: the maximum likelihood for Gaussian noise, tolerant of a few wrong matches. The ends of
    a segment need not match between views.

    Parameters
    ----------
    points : ndarray (3, N, 2)
        Matched points, px.
    segments : ndarray (3, M, 2, 2)
        Ends of matched line segments, px; 4 N + 2 M >= 26.
    loss_px : float
        Turning point of Huber's loss.

    Returns
    -------
    TrifocalFit
        Tensor, residuals, noise and covariance.

    Raises
    ------
    ValueError
        If the shapes are wrong or values are not finite.
    StageFailure
        If there are too few matches, or they do not determine the tensor, exactly or within their noise:
        points of one plane or line, pure rotation, random matches.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon.geometry.camera_matrix import project
    >>> X = np.random.default_rng(0).uniform(-1, 1, (20, 3)) + [0, 0, 5]
    >>> K, views = np.diag([800.0, 800.0, 1.0]), ([0, 0, 0], [-1, 0.2, 0], [0.3, -1, 0.4])
    >>> points = np.stack([project(K @ np.c_[np.eye(3), t], X) for t in views])
    >>> bool(estimate_trifocal(points).point_residuals_px.max() < 1e-6)
    True
    """
    if not loss_px > 0.0:
        raise ValueError(f"loss_px must be positive; got {loss_px}")
    points, segments = check_triplets(points, segments)
    n, m = points.shape[1], segments.shape[1]
    if 4 * n + 2 * m < NEEDED_EQUATIONS:
        raise StageFailure(
            "too few matches for the trifocal tensor",
            f"found {n} points and {m} lines; 7 points, 13 lines or a mixture are needed",
            "use images with more overlap",
        )
    equations = tensor_equations(points, segments)
    try:
        T = _minimize_algebraic_error(equations, equations.solve())
    except ValueError as error:
        raise StageFailure(UNDETERMINED, "they are in a special position", REMEDY) from error
    problem = _ReprojectionProblem(T, points, segments, equations.transforms, loss_px)
    fit = _minimize_reprojection_error(problem, equations)
    _require_determined(fit, equations, np.concatenate([points, segments.reshape(3, -1, 2)], axis=1))
    return fit


def _minimize_algebraic_error(equations: TensorEquations, start: F64) -> F64:
    """Conditioned T (3, 3, 3) with cameras and the least |A t| near a start.

    The epipoles are the six parameters; all other entries follow from them.
    """

    def tensor(epipoles: F64) -> F64:
        e2, e3 = epipoles[:3], epipoles[3:]
        T = equations.solve_with_epipoles(e2 / np.linalg.norm(e2), e3 / np.linalg.norm(e3))
        # The sign of the start keeps the residuals continuous.
        return T * (1.0 if np.sum(T * start) >= 0.0 else -1.0)

    found = minimize_residuals(
        lambda e: equations.A @ tensor(e).ravel(), np.concatenate(tensor_epipoles(start))
    )
    return tensor(found.x)


class _ReprojectionProblem:
    """Reprojection error of points and lines by 18 coordinates c of P2 and P3 near those of a conditioned T.

    A state is c and four coordinates f of each point (the last one unused) and line, all moves orthogonal to
    the start. Points and lines are fitted to the cameras of each step (variable projection).
    """

    def __init__(self, T: F64, points: F64, segments: F64, transforms: F64, loss_px: float) -> None:
        H = transforms.swapaxes(1, 2)
        self.x, self.y = (homogenize(points) @ H).swapaxes(0, 1), homogenize(segments).swapaxes(0, 1) @ H
        self.per_pixel, self.loss_px = transforms[:, 0, 0], loss_px
        self.P, self.moves = np.stack(cameras_from_tensor(T)), np.eye(24)
        # T does not depend on six of 24 directions: the scales of P2 and P3 and the frame of space.
        self.moves = np.linalg.svd(_derivatives(self.tensors, np.zeros(24)).reshape(27, 24))[2][:18]
        # A line is where the planes of its image lines meet, a point where those of axis-parallel lines meet.
        axes = np.eye(3)[:2] - self.x[..., :2, None] * np.eye(3)[2]
        lines = unit_normals(np.cross(self.y[:, :, :1], self.y[:, :, 1:]))
        # The last rows of X and L span the points and lines, the first rows their moves.
        self.X = np.linalg.svd((axes @ self.P).reshape(-1, 6, 4))[2]
        self.L = np.linalg.svd((lines @ self.P).reshape(-1, 3, 4))[2]

    def cameras(self, c: F64) -> F64:
        """Conditioned cameras (..., 3, 3, 4)."""
        moves = np.reshape(c @ self.moves, (*c.shape[:-1], 2, 3, 4))
        return self.P + np.insert(moves, 0, 0.0, axis=-3)

    def tensors(self, c: F64) -> F64:
        """Conditioned tensors (B, 3, 3, 3) of unit norm for coordinates (B, 18)."""
        return np.stack([tensor_from_cameras(*P) for P in self.cameras(c)])

    def residual(self, c: F64, f: F64) -> F64:
        """Offsets of the points, then distances of the segment ends, (..., N + M, 3 views, 2) px."""
        P, n = self.cameras(c)[..., None, :, :, :], len(self.X)
        X = self.X[:, 3:] + f[..., :n, None, :3] @ self.X[:, :3]
        L = self.L[:, 2:] + f.reshape(*f.shape[:-1], 2, 2)[..., n:, :, :] @ self.L[:, :2]
        image, ends = (P @ Y.swapaxes(-1, -2)[..., None, :, :] for Y in (X, L))
        # Points of a principal plane have a distant image instead of none.
        z = np.where(np.abs(image[..., 2:, 0]) < 1e-12, 1e-12, image[..., 2:, 0])
        seen = unit_normals(np.cross(ends[..., 0], ends[..., 1]))[..., None]
        offsets, distances = image[..., :2, 0] / z - self.x[..., :2], (self.y @ seen)[..., 0]
        return np.asarray(np.concatenate([offsets, distances], axis=-3) / self.per_pixel[:, None])

    def losses(self, residual: F64) -> tuple[F64, F64]:
        """Huber's loss and weight (N + M, 3) of each image of a point or line."""
        return huber(np.sum(residual**2, axis=2), self.loss_px)

    def cost(self, state: _State) -> float:
        return 0.5 * float(self.losses(self.residual(*state))[0].sum())

    def linearize(self, state: _State) -> DenseSystem:
        """The normal equations of the cameras, points and lines eliminated."""
        c, f = state
        r, B = self._weighted(state, _derivatives(lambda f: self.residual(c, f), f))
        _, A = self._weighted(state, _derivatives(lambda c: self.residual(c, f), c))
        A = A - B @ (np.linalg.pinv(B) @ A)
        H, g = np.einsum("nri,nrj->ij", A, A), np.einsum("nri,nrj->i", A, r)
        return DenseSystem(self.cost(state), H, g)

    def retract(self, state: _State, step: F64) -> _State:
        """Move the cameras, then points and lines by Gauss-Newton steps that lower their cost."""
        c, f = state[0] + step, state[1]
        for _ in range(3):
            r, B = self._weighted((c, f), _derivatives(lambda f: self.residual(c, f), f))
            moved = f - (np.linalg.pinv(B) @ r)[..., 0]
            before, after = (self.losses(self.residual(c, g))[0].sum(axis=1) for g in (f, moved))
            f = np.where((after < before)[:, None], moved, f)
        return c, f

    def _weighted(self, state: _State, J: F64) -> tuple[F64, F64]:
        """Residuals (N + M, 6, 1) and derivatives (N + M, 6, D), times the roots of their weights."""
        residual = self.residual(*state)[..., None]
        root = np.sqrt(self.losses(residual[..., 0])[1])[..., None, None]
        return (root * residual).reshape(-1, 6, 1), (root * J).reshape(-1, 6, J.shape[-1])


def _derivatives(function: Callable[[F64], F64], x: F64) -> F64:
    """Central differences (..., D) by the last axis (D,) of x; the function takes a batch."""
    steps = 1e-6 * np.expand_dims(np.eye(x.shape[-1]), tuple(range(1, x.ndim)))
    return np.moveaxis(function(x + steps) - function(x - steps), 0, -1) / 2e-6


def _minimize_reprojection_error(problem: _ReprojectionProblem, equations: TensorEquations) -> TrifocalFit:
    """The fit; whether the matches determine it is not tested."""
    n, m = len(problem.X), len(problem.L)
    start = problem.retract((np.zeros(18), np.zeros((n + m, 4))), np.zeros(18))
    c, f = run_levenberg_marquardt(problem, start, max_iterations=50, tolerance=1e-9, initial_damping=1e-3)[0]
    residual = problem.residual(c, f)
    sigma = float(np.sqrt(np.sum(residual**2) / max(3 * n + 2 * m - 18, 1)))
    of_cameras = sigma**2 * invert_information(problem.linearize((c, f)).hessian)

    def tensors_px(c: F64) -> F64:
        return np.stack([equations.in_pixels(T) for T in problem.tensors(c)])

    J, J_px = (_derivatives(tensors, c).reshape(27, 18) for tensors in (problem.tensors, tensors_px))
    return TrifocalFit(
        T=tensors_px(c[None])[0],
        point_residuals_px=np.linalg.norm(residual[:n], axis=2).T,
        line_residuals_px=np.abs(residual[n:]).swapaxes(0, 1),
        sigma_px=sigma,
        covariance=J_px @ of_cameras @ J_px.T,
        relative_std=float(np.sqrt((n + m) * np.linalg.norm(J @ of_cameras @ J.T, ord=2))),
    )


def _require_determined(fit: TrifocalFit, equations: TensorEquations, xy: F64) -> None:
    """Raise StageFailure if the noise alone decides a fit to points and segment ends xy (3, K, 2).

    Three indicators: noise like that of the fit explains many solutions of the linear equations; the
    covariance of the fit; collinear matches in an image.
    """
    family = int(np.sum(equations.noise_levels_px() <= SAME_NOISE * fit.sigma_px))
    across = np.linalg.svd(xy - xy.mean(axis=1, keepdims=True), compute_uv=False)[:, 1]
    narrowest = float(across.min()) / np.sqrt(xy.shape[1])
    if not (family < FAMILY and fit.relative_std <= WEAK and narrowest > 3.0 * fit.sigma_px):
        raise StageFailure(
            UNDETERMINED,
            f"noise {fit.sigma_px:.2g} px explains {family} independent tensors (at most {FAMILY - 1}); "
            f"narrowest spread of the matches {narrowest:.3g} px; relative standard deviation "
            f"{fit.relative_std:.2g} (at most {WEAK:.2g})",
            REMEDY,
        )
