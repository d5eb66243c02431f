"""Section 3.6.3: the trifocal tensor with the least reprojection error of points and lines in three views.

Three steps, each the start of the next: linear equations; the least algebraic error among tensors that have
cameras, over the two epipoles (HZ, algorithm 16.2); the least reprojection error over cameras, points and
lines (HZ 16.4) by Levenberg-Marquardt with points and lines eliminated. P1 = [I 0] stays fixed; P2 and P3
move with all their 24 entries; only 18 of them matter (damping handles the scales and the frame of space). A
point moves in the 3 directions orthogonal to its vector, a line, represented by two orthonormal points, in 4:
both without singularities.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.lines_and_planes import join, unit_normals
from thesisrecon.geometry.three_view import (
    NEEDED_EQUATIONS,
    TensorEquations,
    cameras_from_tensor,
    check_triplets,
    tensor_epipoles,
    tensor_equations,
    transform_tensor,
    unit_tensor,
)
from thesisrecon.geometry.triangulation import triangulate
from thesisrecon.numerics.levenberg_marquardt import (
    floored_diagonal,
    minimize_residuals,
    run_levenberg_marquardt,
    solve_positive,
)
from thesisrecon.numerics.losses import LOSSES

# Maximum weakness of a fit. Planes, rotations and random matches give 0.5 to 1.5 at any noise; scenes with
# depth and noise of a hundredth of the parallax below 0.1.
WEAK = 0.4
# A fit is refused if noise of 1.25 times its own explains six tensors of the linear equations. Points or
# lines of a plane and rotations leave 6 to 12, parallel lines 13 or more, three walls at most 5, which the
# constraints of the cameras resolve.
SAME_NOISE, FAMILY = 1.25, 6
NO_POINTS, NO_SEGMENTS = np.zeros((3, 0, 2)), np.zeros((3, 0, 2, 2))


@dataclass(frozen=True)
class _State:
    """Conditioned cameras (3, 3, 4), unit points (N, 4) and lines (M, 2, 4) as two orthonormal points."""

    P: F64
    X: F64
    lines: F64


@dataclass(frozen=True)
class _Step:
    """Steps of P2 and P3 (24,), of points (N, 3) and lines (M, 4) in their tangent spaces."""

    cameras: F64
    points: F64
    lines: F64


@dataclass(frozen=True)
class _FeatureBlock:
    """Normal equations of features: camera coupling W (n, 24, f), own V (n, f, f), gradient h (n, f)."""

    W: F64
    V: F64
    h: F64

    def damped(self, damping: float) -> tuple[F64, F64]:
        """V^-1 W' (n, f, 24) and V^-1 h (n, f) with the damped V."""
        V = self.V.copy()
        f = V.shape[1]
        V[:, range(f), range(f)] += self.diagonal(damping)
        solved = np.linalg.solve(V, np.concatenate([self.W.swapaxes(1, 2), self.h[:, :, None]], axis=2))
        return solved[:, :, :-1], solved[:, :, -1]

    def diagonal(self, damping: float) -> F64:
        """Damping terms (n, f) of the diagonals of V."""
        diagonal = np.diagonal(self.V, axis1=1, axis2=2)
        return damping * np.asarray(floored_diagonal(diagonal))


@dataclass(frozen=True)
class _System:
    """[[H, W], [W', V]] of the cameras and both kinds of features, which are eliminated."""

    cost: float
    H: F64
    g: F64
    blocks: tuple[_FeatureBlock, _FeatureBlock]

    def reduced(self, damping: float) -> tuple[F64, F64, list[tuple[F64, F64]]]:
        """The damped system S c = b of the cameras, and V^-1 W', V^-1 h of each block."""
        S = self.H + np.diag(damping * floored_diagonal(np.diag(self.H)))
        b = -self.g
        solved = [block.damped(damping) for block in self.blocks]
        for block, (Y, z) in zip(self.blocks, solved, strict=True):
            S = S - np.einsum("nif,nfj->ij", block.W, Y)
            b = b + np.einsum("nif,nf->i", block.W, z)
        return S, b, solved

    def solve(self, damping: float) -> tuple[_Step, float] | None:
        """The damped step and its predicted gain."""
        S, b, solved = self.reduced(damping)
        cameras = solve_positive(S, b)
        if cameras is None:
            return None
        diagonal = damping * floored_diagonal(np.diag(self.H))
        promised = float(cameras @ (diagonal * cameras - self.g))
        moves = [-(z + Y @ cameras) for Y, z in solved]
        for block, move in zip(self.blocks, moves, strict=True):
            promised += float(np.sum(move * (block.diagonal(damping) * move - block.h)))
        return _Step(cameras, moves[0], moves[1]), 0.5 * promised


@dataclass(frozen=True)
class _ReprojectionProblem:
    """Conditioned points (N, 3, 2) and segment ends (M, 3, 2, 3); ``scale`` (3,) per pixel."""

    points: F64
    ends: F64
    scale: F64
    loss_px: float

    @classmethod
    def of(cls, points: F64, segments: F64, transforms: F64, loss_px: float) -> _ReprojectionProblem:
        """Condition points and segments by ``transforms`` (3, 3, 3)."""
        x = homogenize(points) @ transforms.swapaxes(1, 2)
        y = homogenize(segments) @ transforms.swapaxes(1, 2)[:, None]
        return cls(x[:, :, :2].swapaxes(0, 1), y.swapaxes(0, 1), transforms[:, 0, 0], loss_px)

    def start(self, T: F64) -> _State:
        """Cameras of a conditioned tensor, triangulated points, lines as intersections of planes."""
        P = np.stack(cameras_from_tensor(T))
        P[1:] /= np.linalg.norm(P[1:], axis=(1, 2), keepdims=True)
        X = _off_principal_planes(triangulate(P, self.points.swapaxes(0, 1), method="linear"), P)
        seen = unit_normals(join(self.ends[:, :, 0], self.ends[:, :, 1]))
        planes = np.einsum("mva,vab->mvb", seen, P)
        return _State(P, X, np.linalg.svd(planes)[2][:, 2:])

    def linearize(self, state: _State) -> _System:
        """Normal equations with Huber's weights, in pixels."""
        residual = self.residual(state)
        rho, weight = LOSSES["huber"](np.sum(residual**2, axis=2), self.loss_px)
        root = np.sqrt(weight)[:, :, None]
        H, g, blocks, first = np.zeros((24, 24)), np.zeros(24), [], 0
        for cameras, features in (self._point_jacobian(state), self._line_jacobian(state)):
            n = len(cameras)
            w = root[first : first + n]
            r = (w * residual[first : first + n]).reshape(n, 6)
            A, B = ((w[..., None] * J).reshape(n, 6, J.shape[3]) for J in (cameras, features))
            H += np.einsum("nri,nrj->ij", A, A)
            g += np.einsum("nri,nr->i", A, r)
            At, Bt = A.swapaxes(1, 2), B.swapaxes(1, 2)
            blocks.append(_FeatureBlock(At @ B, Bt @ B, (Bt @ r[:, :, None])[:, :, 0]))
            first += n
        return _System(0.5 * float(rho.sum()), H, g, (blocks[0], blocks[1]))

    def retract(self, state: _State, step: _Step) -> _State:
        """Apply a step; cameras and points keep unit norm, lines stay orthonormal."""
        P = state.P.copy()
        P[1:] += step.cameras.reshape(2, 3, 4)
        P[1:] /= np.linalg.norm(P[1:], axis=(1, 2), keepdims=True)
        X = state.X + np.einsum("nf,nfa->na", step.points, _complement(state.X[:, None]))
        X /= np.linalg.norm(X, axis=1, keepdims=True)
        lines = state.lines + step.lines.reshape(-1, 2, 2) @ _complement(state.lines)
        return _State(P, X, np.linalg.qr(lines.swapaxes(1, 2))[0].swapaxes(1, 2))

    def cost(self, state: _State) -> float:
        """1/2 sum rho, px^2; inf if a point lies on a principal plane."""
        residual = self.residual(state)
        if not np.isfinite(residual).all():
            return np.inf
        return 0.5 * float(LOSSES["huber"](np.sum(residual**2, axis=2), self.loss_px)[0].sum())

    def residual(self, state: _State) -> F64:
        """Offsets of the points, then distances of the segment ends; (N + M, 3 views, 2) px."""
        p = np.einsum("vab,nb->nva", state.P, state.X)
        with np.errstate(divide="ignore", invalid="ignore"):
            offset = p[:, :, :2] / p[:, :, 2:] - self.points
            distance = self._line_distances(*self._line_images(state))
        return np.concatenate([offset, distance]) / self.scale[:, None]

    def _line_images(self, state: _State) -> tuple[F64, F64]:
        """Images (M, 3, 3) of the two points that represent each line."""
        ends = np.einsum("vab,meb->mvea", state.P, state.lines)
        return ends[:, :, 0], ends[:, :, 1]

    def _line_distances(self, p: F64, q: F64) -> F64:
        """Signed distances (M, 3, 2) of the segment ends to the lines through p and q, conditioned."""
        return np.asarray(np.einsum("mvea,mva->mve", self.ends, unit_normals(join(p, q))))

    def _point_jacobian(self, state: _State) -> tuple[F64, F64]:
        """Derivatives by the cameras (N, 3, 2, 24) and the points (N, 3, 2, 3), px."""
        p = np.einsum("vab,nb->nva", state.P, state.X)
        by_image = np.zeros((*p.shape[:2], 2, 3))
        by_image[:, :, 0, 0] = by_image[:, :, 1, 1] = 1.0 / p[:, :, 2]
        by_image[:, :, :, 2] = -p[:, :, :2] / p[:, :, 2:] ** 2
        by_image /= self.scale[:, None, None]
        by_point = np.einsum("nvra,vab,nfb->nvrf", by_image, state.P, _complement(state.X[:, None]))
        return _camera_columns(np.einsum("nvra,nb->nvrab", by_image, state.X)), by_point

    def _line_jacobian(self, state: _State) -> tuple[F64, F64]:
        """Derivatives by cameras (M, 3, 2, 24) and lines (M, 3, 2, 4): d = l.y / |(l_1, l_2)|, l = p x q."""
        p, q = self._line_images(state)
        l = join(p, q)
        size = np.linalg.norm(l[:, :, :2], axis=2)[:, :, None]
        unit = l / size
        distance = self._line_distances(p, q)
        normal = np.concatenate([unit[:, :, :2], np.zeros_like(unit[:, :, 2:])], axis=2)
        by_line = self.ends - distance[..., None] * normal[:, :, None]
        by_line /= (size * self.scale[:, None])[..., None]
        by_p, by_q = np.cross(q[:, :, None], by_line), np.cross(by_line, p[:, :, None])
        by_camera = np.einsum("mvra,mb->mvrab", by_p, state.lines[:, 0])
        by_camera += np.einsum("mvra,mb->mvrab", by_q, state.lines[:, 1])
        across = np.einsum("vab,mfb->mvaf", state.P, _complement(state.lines))
        return _camera_columns(by_camera), np.concatenate([by_p @ across, by_q @ across], axis=3)


def _off_principal_planes(X: F64, P: F64) -> F64:
    """Unit points X (N, 4), moved off a principal plane so that they have an image."""
    on = (np.einsum("va,na->nv", P[:, 2], X) == 0.0).any(axis=1)
    X = X + 1e-9 * on[:, None] * np.array([0.6, -0.5, 0.4, 0.3])
    return np.asarray(X / np.maximum(np.linalg.norm(X, axis=1, keepdims=True), 1e-300))


def _complement(subspace: F64) -> F64:
    """Orthonormal rows (n, 4 - k, 4) orthogonal to those of (n, k, 4)."""
    return np.linalg.svd(subspace)[2][:, subspace.shape[1] :]


def _camera_columns(by_camera: F64) -> F64:
    """Derivatives (n, 3, 2, 3, 4) by the camera of each view as columns (n, 3, 2, 24) of P2 and P3."""
    n = len(by_camera)
    columns = np.zeros((n, 3, 2, 2, 12))
    for view in (1, 2):
        columns[:, view, :, view - 1] = by_camera[:, view].reshape(n, 2, 12)
    return columns.reshape(n, 3, 2, 24)


@dataclass(frozen=True)
class TrifocalFit:
    """A trifocal tensor with its cameras.

    Parameters
    ----------
    T : ndarray (3, 3, 3)
        Tensor in pixels, unit norm.
    P : ndarray (3, 3, 4)
        Cameras in pixels, P[0] = [I 0].
    X : ndarray (N, 4)
        Points.
    lines : ndarray (M, 2, 4)
        Two points of each line.
    point_residuals_px : ndarray (3, N)
        Distances of the points to their reprojections.
    line_residuals_px : ndarray (3, M, 2)
        Distances of the segment ends to the reprojected lines.
    sigma_px : float
        Noise of one coordinate from all residuals and degrees of freedom.
    covariance : ndarray (27, 27)
        First-order covariance of T, row-major, rank 18.
    weakness : float
        Largest standard deviation of T in conditioned coordinates, relative to T, times the root of the
        number of matches. Near 1 a change of T by its own size moves the images no more than their noise.
    iterations : int
        Iterations of Levenberg-Marquardt.
    """

    T: F64
    P: F64
    X: F64
    lines: F64
    point_residuals_px: F64
    line_residuals_px: F64
    sigma_px: float
    covariance: F64
    relative_std: float
    iterations: int


def _minimize_algebraic_error(equations: TensorEquations, start: F64) -> F64:
    """T (3, 3, 3), unit norm, with cameras and the least |A t| near a tensor ``start`` (HZ 16.2).

    Conditioned coordinates. The epipoles are the six parameters; all other entries follow from them.
    """

    def tensor(epipoles: F64) -> F64:
        e2, e3 = epipoles[:3], epipoles[3:]
        T = equations.solve_with_epipoles(e2 / np.linalg.norm(e2), e3 / np.linalg.norm(e3))
        # The sign of the start keeps the residuals continuous.
        return T * (1.0 if np.sum(T * start) >= 0.0 else -1.0)

    e2, e3 = tensor_epipoles(start)
    found = minimize_residuals(lambda e: equations.A @ tensor(e).ravel(), np.concatenate([e2, e3]))
    return unit_tensor(tensor(found.x))


def estimate_trifocal(
    points: F64 = NO_POINTS, segments: F64 = NO_SEGMENTS, *, loss_px: float = 1.0, max_iterations: int = 50
) -> TrifocalFit:
    """Estimate the trifocal tensor and cameras from points and lines of three views.

    Minimises Huber's loss of the squared distances of points to their reprojections and of segment ends to
    their reprojected lines: optimal for Gaussian noise, tolerant of a few wrong matches. The ends of a
    segment need not match between views.

    Parameters
    ----------
    points : ndarray (3, N, 2)
        Matched points, px.
    segments : ndarray (3, M, 2, 2)
        Ends of matched line segments, px; 4 N + 2 M >= 26.
    loss_px : float
        Width of Huber's loss.
    max_iterations : int
        Maximum number of iterations.

    Returns
    -------
    TrifocalFit
        Tensor, cameras, points, lines, noise and covariance.

    Raises
    ------
    ValueError
        If the shapes are wrong or values are not finite.
    StageFailure
        If there are too few matches, or they do not determine the tensor, exactly or within their noise:
        points of one plane or line, pure rotation, random matches.

    References
    ----------
    Hartley and Zisserman, Multiple View Geometry, chapter 16.

    Examples
    --------
    >>> import numpy as np
    >>> from thesisrecon.geometry.camera_matrix import project
    >>> X = np.random.default_rng(0).uniform(-1, 1, (20, 3)) + [0, 0, 5]
    >>> K, views = np.diag([800.0, 800.0, 1.0]), ([0, 0, 0], [-1, 0.2, 0], [0.3, -1, 0.4])
    >>> points = np.stack([project(K @ np.c_[np.eye(3), t], X) for t in views])
    >>> fit = estimate_trifocal(points)
    >>> bool(fit.point_residuals_px.max() < 1e-6)
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
        start = equations.solve()
    except ValueError as error:
        raise StageFailure(
            "the matches do not determine the trifocal tensor",
            f"{n} points and {m} lines in a special position",
            "add matches off the dominant plane",
        ) from error
    T = equations.in_pixels(_minimize_algebraic_error(equations, start))
    fit = refine_trifocal(T, points, segments, loss_px=loss_px, max_iterations=max_iterations)
    require_determined(fit, equations, np.concatenate([points, segments.reshape(3, -1, 2)], axis=1))
    return fit


def require_determined(fit: TrifocalFit, equations: TensorEquations, xy: F64, *, weak: float = WEAK) -> None:
    """Raise if the noise alone decides a trifocal fit.

    Three indicators: noise like that of the fit explains many solutions of the linear equations; the
    covariance of the fit; collinear matches in an image.

    Parameters
    ----------
    fit : TrifocalFit
        The fit.
    equations : TensorEquations
        Linear equations of its matches.
    xy : ndarray (3, K, 2)
        All points and segment ends, px.
    weak : float
        Maximum weakness.

    Raises
    ------
    StageFailure
        If the tensor is undetermined.
    """
    family = int(np.sum(equations.noise_levels_px() <= SAME_NOISE * fit.sigma_px))
    across = np.linalg.svd(xy - xy.mean(axis=1, keepdims=True), compute_uv=False)[:, 1]
    narrowest = float(across.min()) / np.sqrt(xy.shape[1])
    if not (family < FAMILY and fit.relative_std <= weak and narrowest > 3.0 * fit.sigma_px):
        raise StageFailure(
            "the matches do not determine the trifocal tensor",
            f"noise {fit.sigma_px:.2g} px explains {family} independent tensors (at most {FAMILY - 1}); "
            f"narrowest spread of the matches {narrowest:.3g} px; weakness {fit.relative_std:.2g} (at most "
            f"{weak:.2g})",
            "use matches off one plane from three different positions, and check for wrong matches",
        )


def refine_trifocal(
    T: F64, points: F64, segments: F64, *, loss_px: float = 1.0, max_iterations: int = 50
) -> TrifocalFit:
    """Minimise the reprojection error of points and lines from a start.

    Parameters
    ----------
    T : array_like (3, 3, 3)
        Start, px.
    points : ndarray (3, N, 2)
        Matched points, px.
    segments : ndarray (3, M, 2, 2)
        Ends of matched line segments, px.
    loss_px : float
        Width of Huber's loss.
    max_iterations : int
        Maximum number of iterations.

    Returns
    -------
    TrifocalFit
        The fit; whether the matches determine it is not tested.

    Raises
    ------
    ValueError
        As :func:`~thesisrecon.geometry.three_view.tensor_equations`, or if T is zero or not finite.
    """
    points, segments = check_triplets(points, segments)
    T = np.asarray(T, dtype=np.float64)
    if T.shape != (3, 3, 3) or not np.isfinite(T).all() or not T.any():
        raise ValueError(f"the refinement needs a finite tensor (3, 3, 3) other than 0; got {T.shape}")
    transforms = tensor_equations(points, segments).transforms
    problem = _ReprojectionProblem.of(points, segments, transforms, loss_px)
    solution = run_levenberg_marquardt(
        problem,
        problem.start(transform_tensor(T, *transforms)),
        max_iterations=max_iterations,
        tolerance=1e-9,
        initial_damping=1e-3,
    )
    state = solution.state
    residual = problem.residual(state)
    n = points.shape[1]
    freedom = max(3 * n + 2 * segments.shape[1] - 18, 1)
    sigma = float(np.sqrt(np.sum(residual**2) / freedom))
    P, G = _pixel_cameras(state.P, transforms)
    conditioned, root = _tensor_and_root(problem, state)
    to_pixels = _in_pixels(transforms)
    T, pixel_root = _normalized(to_pixels @ conditioned, to_pixels @ root)
    spread = sigma * float(np.linalg.norm(root, ord=2))
    return TrifocalFit(
        T.reshape(3, 3, 3),
        P,
        state.X @ G.T,
        state.lines @ G.T,
        np.linalg.norm(residual[:n], axis=2).T,
        np.abs(residual[n:]).transpose(1, 0, 2),
        sigma,
        sigma**2 * pixel_root @ pixel_root.T,
        spread * float(np.sqrt(n + segments.shape[1])),
        solution.iterations,
    )


def _pixel_cameras(P: F64, transforms: F64) -> tuple[F64, F64]:
    """Conditioned cameras in pixels with P1 = [I 0], and the (4, 4) transform of space."""
    G = np.eye(4)
    G[:3, :3] = np.linalg.inv(transforms[0])
    return np.asarray(np.linalg.inv(transforms) @ P @ np.linalg.inv(G)), G


def _tensor_and_root(problem: _ReprojectionProblem, state: _State) -> tuple[F64, F64]:
    """Flat T (27,), unit norm, conditioned, and a root (27, 18) of its covariance for unit noise in px."""
    P2, P3 = state.P[1:]
    # T is linear in either camera, so its derivatives are the tensors of single entries.
    entries = np.eye(12).reshape(12, 3, 4)
    columns = [_canonical_tensor(E, P3) for E in entries] + [_canonical_tensor(P2, E) for E in entries]
    T, J = _canonical_tensor(P2, P3).ravel(), np.stack(columns, axis=-1).reshape(27, 24)
    information = problem.linearize(state).reduced(1e-12)[0]
    scale = 1.0 / np.sqrt(floored_diagonal(np.diag(information)))
    values, vectors = np.linalg.eigh(information * scale * scale[:, None])
    # 6 of the 24 parameters are the camera scales and the frame of space, on which T does not depend.
    root = scale[:, None] * vectors[:, 6:] / np.sqrt(np.maximum(values[6:], 1e-14 * values[-1]))
    return _normalized(T, J @ root)


def _normalized(T: F64, root: F64) -> tuple[F64, F64]:
    """T / |T| and the root (27, 18) of the covariance of that unit vector."""
    size = float(np.linalg.norm(T))
    T = T / size
    return T, (root - np.outer(T, T @ root)) / size


def _in_pixels(transforms: F64) -> F64:
    """Matrix (27, 27) that takes flat conditioned tensors to pixels."""
    inverse = np.linalg.inv(transforms)
    by_index = np.einsum("ri,js,kt->ijkrst", transforms[0], inverse[1], inverse[2])
    return np.asarray(by_index.reshape(27, 27))


def _canonical_tensor(P2: F64, P3: F64) -> F64:
    """T_i^jk = a_i^j b_4^k - a_4^j b_i^k of cameras with P1 = [I 0], not normalised (HZ 15.1)."""
    of_first = np.einsum("ji,k->ijk", P2[:, :3], P3[:, 3])
    return np.asarray(of_first - np.einsum("j,ki->ijk", P2[:, 3], P3[:, :3]))
