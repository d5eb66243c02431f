"""Section 3.6.3: the trifocal tensor with the least reprojection error of points and lines in three views.

Linear equations, then those of cameras with their epipoles (HZ 16.3); least reprojection error (HZ 16.4).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import B8, F64, Record
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import homogenize, normalizing_transform, unit_normals, unit_tensor
from thesisrecon.geometry.three_view import cameras_from_tensor, tensor_epipoles, tensor_from_cameras
from thesisrecon.optimize import least_squares

NEEDED_EQUATIONS = 26  # seven points, thirteen lines, or a mixture (HZ 16.1)
# Largest relative standard deviation of T. Planes, rotations and random matches give 0.5 to 1.5 at any noise;
# scenes with depth and noise of a hundredth of the parallax below 0.1.
WEAK = 0.4
_SEARCHED = 12  # minimum number of points for the search for wrong ones
NO_POINTS, NO_SEGMENTS = np.zeros((0, 2)), np.zeros((3, 0, 2, 2))
_State = tuple[F64, F64]


@dataclass(frozen=True, eq=False)
class TrifocalFit(Record):
    """A trifocal tensor with its residuals and noise."""

    T: F64  #: (3, 3, 3) in pixels, unit norm; its cameras are exact
    point_residuals_px: F64  #: (3, N) distances of the points to their reprojections
    line_residuals_px: F64  #: (3, M, 2) distances of the endpoints to the reprojected lines
    sigma_px: float  #: noise of one coordinate from all residuals and degrees of freedom
    covariance: F64  #: (27, 27) to first order of T, row-major, rank 18
    relative_std: float
    """Largest standard deviation of T in conditioned coordinates, times the root of the number of matches. At
    values near 1, T is undetermined: changing it by its own size moves the reprojections no more than their
    noise."""
    inliers: B8  #: (N,) points that were used; the residuals of the others are NaN


def fit_trifocal(
    every: F64, segments: F64, *, search: LocallyOptimisedRansac | None, loss_px: float, rng: Generator
) -> TrifocalFit:
    """Fit a trifocal tensor to points (3, N, 2) and segments; see :func:`thesisrecon.estimate_trifocal`."""
    inliers = np.ones(every.shape[1], dtype=bool)
    if search is not None and len(inliers) >= _SEARCHED:
        inliers = _epipolar_inliers(every, search, rng)
    points = every[:, inliers]
    n, m = points.shape[1], segments.shape[1]
    if 4 * n + 2 * m < NEEDED_EQUATIONS and n < len(inliers):
        evidence = f"only {n} of {len(inliers)} points agree with the epipolar geometry of all pairs of views"
        raise StageFailure.of("undetermined-tensor", evidence)
    if 4 * n + 2 * m < NEEDED_EQUATIONS:
        raise StageFailure.of("few-trifocal-matches", n, m)
    try:
        equations = _tensor_equations(points, segments)
        T = equations.solve_with_epipoles(*tensor_epipoles(equations.solve()))
    except ValueError as error:
        raise StageFailure.of("undetermined-tensor", "they are in a degenerate configuration") from error
    problem = _ReprojectionProblem(T, points, segments, equations.transforms, loss_px)
    fit = _minimize_reprojection_error(problem, equations)
    # The noise alone must not decide the fit.
    xy = np.concatenate([points, segments.reshape(3, -1, 2)], axis=1)
    across = np.linalg.svd(xy - xy.mean(axis=1, keepdims=True), compute_uv=False)[:, 1]
    narrowest, noise = float(across.min()) / np.sqrt(xy.shape[1]), f"noise of {fit.sigma_px:.2g} px"
    found = list[str]()
    if not fit.relative_std <= WEAK:
        change = f"{fit.relative_std:.0%} of its size (at most {WEAK:.0%})"
        found.append(f"{noise} changes the tensor by {change}")
    if not narrowest > 3.0 * fit.sigma_px:
        narrow = f"the matches of one image deviate from a line by only {narrowest:.2g} px"
        found.append(f"{narrow}, less than three times the {noise}")
    if found:
        raise StageFailure.of("undetermined-tensor", "; ".join(found))
    residuals = np.full((3, len(inliers)), np.nan)
    residuals[:, inliers] = fit.point_residuals_px
    return replace(fit, point_residuals_px=residuals, inliers=inliers)


def _epipolar_inliers(points: F64, search: LocallyOptimisedRansac, rng: Generator) -> B8:
    """Points (N,) that agree with the fundamental matrices of all three pairs of views; all if one fails."""
    inliers = np.ones(points.shape[1], dtype=bool)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        try:
            fit = search.estimate(points[i], points[j], rng)
        except StageFailure:
            # Points of a line or chance matches: the test of the tensor names them.
            return np.ones(points.shape[1], dtype=bool)
        inliers &= fit.inliers
    return inliers


class _ReprojectionProblem:
    """Reprojection error of points and lines by 18 coordinates c of P2 and P3 near those of a conditioned T.

    A state is c and four coordinates f of each point and line, fitted at each step (variable projection).
    """

    def __init__(self, T: F64, points: F64, segments: F64, transforms: F64, loss_px: float) -> None:
        H = transforms.swapaxes(1, 2)
        self.x, self.y = (homogenize(points) @ H).swapaxes(0, 1), homogenize(segments).swapaxes(0, 1) @ H
        self.per_pixel, self.loss_px = transforms[:, 0, 0], loss_px
        self.P, self.moves = np.stack(cameras_from_tensor(T)), np.eye(24)
        # T does not depend on six of 24 directions: the scales of P2 and P3 and the frame of space.
        self.moves = np.linalg.svd(
            least_squares.central_differences(self.tensor, np.zeros(24)).reshape(27, 24)
        )[2][:18]
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

    def tensor(self, c: F64) -> F64:
        """Conditioned tensor (3, 3, 3) of unit norm for coordinates (18,)."""
        return tensor_from_cameras(*self.cameras(c))

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
        return least_squares.huber(np.sum(residual**2, axis=2), self.loss_px)

    def cost(self, state: _State) -> float:
        return 0.5 * float(self.losses(self.residual(*state))[0].sum())

    def linearize(self, state: _State) -> least_squares.DenseSystem:
        """The normal equations of the cameras, points and lines eliminated."""
        c, f = state
        r, B = self._weighted(state, least_squares.central_differences(lambda f: self.residual(c, f), f))
        _, A = self._weighted(state, least_squares.central_differences(lambda c: self.residual(c, f), c))
        A = A - B @ (np.linalg.pinv(B) @ A)
        H, g = np.einsum("nri,nrj->ij", A, A), np.einsum("nri,nrj->i", A, r)
        return least_squares.DenseSystem(self.cost(state), H, g)

    def retract(self, state: _State, step: F64) -> _State:
        """Move the cameras, then points and lines by Gauss-Newton steps that lower their cost."""
        c, f = state[0] + step, state[1]
        for _ in range(3):
            r, B = self._weighted((c, f), least_squares.central_differences(lambda f: self.residual(c, f), f))
            moved = f - (np.linalg.pinv(B) @ r)[..., 0]
            before, after = (self.losses(self.residual(c, g))[0].sum(axis=1) for g in (f, moved))
            f = np.where((after < before)[:, None], moved, f)
        return c, f

    def _weighted(self, state: _State, J: F64) -> tuple[F64, F64]:
        """Residuals (N + M, 6, 1) and derivatives (N + M, 6, D), times the roots of their weights."""
        residual = self.residual(*state)[..., None]
        root = np.sqrt(self.losses(residual[..., 0])[1])[..., None, None]
        return (root * residual).reshape(-1, 6, 1), (root * J).reshape(-1, 6, J.shape[-1])


def _minimize_reprojection_error(problem: _ReprojectionProblem, equations: _TensorEquations) -> TrifocalFit:
    """The fit; whether the matches determine it is not tested."""
    n, m = len(problem.X), len(problem.L)
    start = problem.retract((np.zeros(18), np.zeros((n + m, 4))), np.zeros(18))
    found = least_squares.run_levenberg_marquardt(
        problem.linearize, problem.retract, problem.cost, start,
        max_iterations=50, tolerance=1e-9, initial_damping=1e-3,
    )  # fmt: skip
    c, f = found.state
    residual = problem.residual(c, f)
    sigma = float(np.sqrt(np.sum(residual**2) / max(3 * n + 2 * m - 18, 1)))
    of_cameras = sigma**2 * least_squares.invert_information(problem.linearize((c, f)).hessian)

    def tensor_px(c: F64) -> F64:
        return equations.in_pixels(problem.tensor(c))

    J, J_px = (
        least_squares.central_differences(tensor, c).reshape(27, 18) for tensor in (problem.tensor, tensor_px)
    )
    return TrifocalFit(
        T=tensor_px(c),
        point_residuals_px=np.linalg.norm(residual[:n], axis=2).T,
        line_residuals_px=np.abs(residual[n:]).swapaxes(0, 1),
        sigma_px=sigma,
        covariance=J_px @ of_cameras @ J_px.T,
        relative_std=float(np.sqrt((n + m) * np.linalg.norm(J @ of_cameras @ J.T, ord=2))),
        inliers=np.ones(n, dtype=bool),
    )


@dataclass(frozen=True)
class _TensorEquations:
    """Linear equations A t = 0 of the tensor entries t, in conditioned image coordinates."""

    A: F64  #: (27, 27) triangular factor of all equations
    transforms: F64  #: (3, 3, 3) from pixels to conditioned coordinates

    def solve(self) -> F64:
        """The unit tensor (3, 3, 3) of least |A t| (HZ algorithm 16.1), in general not one of cameras."""
        _, s, Vt = np.linalg.svd(self.A)
        if not s[25] > 1e-10 * s[0]:
            raise ValueError("the matches leave the tensor free; they need to be in general position")
        return np.asarray(Vt[26].reshape(3, 3, 3))

    def solve_with_epipoles(self, e2: F64, e3: F64) -> F64:
        """The unit tensor of cameras with these epipoles (3,) in views 2 and 3 and least |A t| (HZ 16.3)."""
        # T_i^jk = a_i^j e3^k - e2^j b_i^k is linear in the other entries of the cameras: t = E (a, b). E (27,
        # 18) has rank 15, and t is sought in its range.
        eye = np.eye(3)
        left = np.einsum("ri,sj,k->ijkrs", eye, eye, e3).reshape(27, 9)
        right = np.einsum("ri,j,sk->ijkrs", eye, e2, eye).reshape(27, 9)
        basis = np.linalg.svd(np.hstack([left, -right]))[0][:, :15]
        best = np.linalg.svd(self.A @ basis)[2][14]
        return np.asarray((basis @ best).reshape(3, 3, 3))

    def in_pixels(self, T: F64) -> F64:
        """A conditioned tensor in pixels x' = H x: T'_i^jk = (H1^-1)^r_i H2^j_s H3^k_t T_r^st, unit norm."""
        _, H2, H3 = np.linalg.inv(self.transforms)
        return unit_tensor(np.einsum("ri,js,kt,rst->ijk", self.transforms[0], H2, H3, T))


def _tensor_equations(points: F64, segments: F64) -> _TensorEquations:
    """Linear equations of points (3, N, 2), four each by axis-parallel lines, and of segments, two each."""
    ends = segments.reshape(3, -1, 2)
    transforms = np.stack([normalizing_transform(xy) for xy in np.concatenate([points, ends], axis=1)])
    x = homogenize(points) @ transforms.swapaxes(1, 2)
    y = homogenize(segments) @ transforms.swapaxes(1, 2)[:, None]
    lines = unit_normals(np.cross(y[:, :, 0], y[:, :, 1]))[:, :, None]
    # The lines x = u and y = v (N, 2, 3) through the points.
    axes2, axes3 = np.eye(3)[:2] - x[1:, :, :2, None] * np.eye(3)[2]
    rows = [_products(x[0][:, None], axes2, axes3), _products(y[0], lines[1], lines[2])]
    A = np.asarray(np.linalg.qr(np.concatenate([*rows, np.zeros((27, 27))]), mode="r"))
    return _TensorEquations(A, transforms)


def _products(x: F64, l2: F64, l3: F64) -> F64:
    """Rows x^i l2_j l3_k of every choice of one of (n, a, 3), (n, b, 3), (n, c, 3)."""
    return np.asarray(np.einsum("nai,nbj,nck->nabcijk", x, l2, l3).reshape(-1, 27))
