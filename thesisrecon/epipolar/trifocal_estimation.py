"""Section 3.6.3: the trifocal tensor that fits points and lines of three views best in pixels.

Three steps, each the start of the next: linear equations; the least algebraic error among tensors that have
cameras, over the two epipoles (Hartley and Zisserman, algorithm 16.2); the least reprojection error over
cameras, points and lines (their 16.4), by Levenberg-Marquardt with the points and lines eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.epipolar.trifocal_reprojection import TrifocalReprojection, TrifocalState
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.trifocal import (
    tensor_epipoles,
    transform_tensor,
    unit_tensor,
)
from thesisrecon.geometry.trifocal_linear import (
    NEEDED_EQUATIONS,
    TensorEquations,
    check_triplets,
    tensor_equations,
)
from thesisrecon.optimize.levenberg_marquardt import (
    floored_diagonal,
    minimize_residuals,
    run_levenberg_marquardt,
)

F64 = NDArray[np.float64]

WEAK = 0.4
"""Weakness beyond which a fit is refused. Planes, rotations and chance matches come out between 0.5 and 1.5
at any noise; scenes with depth, noise being a hundredth of the parallax, below 0.1."""

SAME_NOISE, FAMILY = 1.25, 6
"""A fit is refused where noise up to 1.25 that of the fit explains a family of six tensors by the linear
equations. Points or lines of a plane and rotations leave 6 to 12, parallel lines 13 or more, three walls 5 at
most: what the linear equations leave free there, the constraints of the cameras determine."""

NO_POINTS, NO_SEGMENTS = np.zeros((3, 0, 2)), np.zeros((3, 0, 2, 2))


@dataclass(frozen=True)
class TrifocalFit:
    """A tensor with the cameras it is made of.

    ``T`` (3, 3, 3) unit norm and ``P`` (3, 3, 4), P[0] = [I 0], in pixels; ``X`` (N, 4) points; ``lines`` (M,
    2, 4) two points of each line; ``point_residuals_px`` (3, N) distances of the images to the reprojected
    points, ``line_residuals_px`` (3, M, 2) of the segments' ends to the reprojected lines; ``sigma_px`` the
    noise of one coordinate, from all residuals and the freedoms left; ``covariance`` (27, 27) of T,
    row-major, to first order for that noise, of rank 18. ``weakness`` is the
    standard deviation of T in its least certain direction, in coordinates conditioned as for the linear
    equations and relative to T, times the root of the number of matches: near 1, a change of T by its own
    size moves the images no more than their noise.
    """

    T: F64
    P: F64
    X: F64
    lines: F64
    point_residuals_px: F64
    line_residuals_px: F64
    sigma_px: float
    covariance: F64
    weakness: float
    iterations: int


def minimize_algebraic_error(equations: TensorEquations, start: F64) -> F64:
    """T (3, 3, 3), unit norm, that has cameras and the least |A t|, near a tensor ``start`` (HZ 16.2).

    Both in the equations' conditioned coordinates. The epipoles are the six parameters; all other entries
    follow from them.
    """

    def tensor(epipoles: F64) -> F64:
        e2, e3 = epipoles[:3], epipoles[3:]
        T = equations.solve_with_epipoles(e2 / np.linalg.norm(e2), e3 / np.linalg.norm(e3))
        # The singular vector has either sign: that of the start keeps the residuals continuous.
        return T * (1.0 if np.sum(T * start) >= 0.0 else -1.0)

    e2, e3 = tensor_epipoles(start)
    found = minimize_residuals(lambda e: equations.A @ tensor(e).ravel(), np.concatenate([e2, e3]))
    return unit_tensor(tensor(found.x))


def estimate_trifocal(
    points: F64 = NO_POINTS, segments: F64 = NO_SEGMENTS, *, loss_px: float = 1.0, max_iterations: int = 50
) -> TrifocalFit:
    """Tensor and cameras of three views with the least reprojection error of points and lines.

    points (3, N, 2) px; segments (3, M, 2, 2) px, the ends of each line's piece in each view, which need not
    match each other; 4 N + 2 M >= 26. Minimises sum rho over images of the squared distance of a point to its
    reprojection and of the two squared distances of a segment's ends to its reprojected line, rho = Huber's
    loss at ``loss_px``: optimal for Gaussian noise of the points and ends, tolerant of a few wrong matches.
    Raises ``ValueError`` for wrong shapes and values that are not finite, ``StageFailure`` for too few
    matches and where they leave the tensor free, exactly or up to their noise: points of one plane or line, a
    pure rotation, matches by chance. Points of the plane of the three centres are no exception.
    """
    if not loss_px > 0.0:
        raise ValueError(f"loss_px must be positive; got {loss_px}")
    points, segments = check_triplets(points, segments)
    n, m = points.shape[1], segments.shape[1]
    if 4 * n + 2 * m < NEEDED_EQUATIONS:
        raise StageFailure(
            "too few matches for the geometry of three views",
            f"found {n} points and {m} lines, needed 7 points, 13 lines or a mixture",
            "use photographs that overlap more",
        )
    equations = tensor_equations(points, segments)
    try:
        start = equations.solve()
    except ValueError as error:
        raise StageFailure(
            "the matches do not determine the geometry of three views",
            f"{n} points and {m} lines in a special position",
            "use matches that do not lie on one plane",
        ) from error
    T = equations.in_pixels(minimize_algebraic_error(equations, start))
    fit = refine_trifocal(T, points, segments, loss_px=loss_px, max_iterations=max_iterations)
    refuse_undetermined(fit, equations, np.concatenate([points, segments.reshape(3, -1, 2)], axis=1))
    return fit


def refuse_undetermined(fit: TrifocalFit, equations: TensorEquations, xy: F64, *, weak: float = WEAK) -> None:
    """``StageFailure`` where the noise alone decides the fit; xy (3, K, 2) all points and ends, in px.

    Three kinds of evidence: noise like that of the fit explains many solutions of the linear equations; the
    covariance of the fit; the matches are of one line of an image.
    """
    family = int(np.sum(equations.explained_px() <= SAME_NOISE * fit.sigma_px))
    across = np.linalg.svd(xy - xy.mean(axis=1, keepdims=True), compute_uv=False)[:, 1]
    narrowest = float(across.min()) / np.sqrt(xy.shape[1])
    if not (family < FAMILY and fit.weakness <= weak and narrowest > 3.0 * fit.sigma_px):
        raise StageFailure(
            "the matches do not determine the geometry of three views",
            f"noise {fit.sigma_px:.2g} px, which explains {family} independent tensors where {FAMILY - 1} "
            f"is the most, narrowest spread of the matches {narrowest:.3g} px, weakness {fit.weakness:.2g} "
            f"where {weak:.2g} is the most",
            "use matches of more than one plane from three places; wrong matches look like this, too",
        )


def refine_trifocal(
    T: F64, points: F64, segments: F64, *, loss_px: float = 1.0, max_iterations: int = 50
) -> TrifocalFit:
    """The fit of least reprojection error near a tensor T (3, 3, 3) in px, as :func:`estimate_trifocal`.

    Nothing is refused for what the fit turns out to be. Raises ``ValueError`` as
    :func:`~thesisrecon.geometry.trifocal_linear.tensor_equations` and for a T that is not finite or zero.
    """
    points, segments = check_triplets(points, segments)
    T = np.asarray(T, dtype=np.float64)
    if T.shape != (3, 3, 3) or not np.isfinite(T).all() or not T.any():
        raise ValueError(f"the refinement starts from a finite tensor (3, 3, 3) that is not 0; got {T.shape}")
    transforms = tensor_equations(points, segments).transforms
    problem = TrifocalReprojection.of(points, segments, transforms, loss_px)
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
    """Conditioned cameras in pixels with P1 = [I 0], and the (4, 4) transform of space that goes with it."""
    G = np.eye(4)
    G[:3, :3] = np.linalg.inv(transforms[0])
    return np.asarray(np.linalg.inv(transforms) @ P @ np.linalg.inv(G)), G


def _tensor_and_root(problem: TrifocalReprojection, state: TrifocalState) -> tuple[F64, F64]:
    """Flat T (27,), unit norm, conditioned, and a root (27, 18) of its covariance for unit noise in px."""
    P2, P3 = state.P[1:]
    # T is linear in either camera, so its derivatives are the tensors of single entries.
    entries = np.eye(12).reshape(12, 3, 4)
    columns = [_canonical_tensor(E, P3) for E in entries] + [_canonical_tensor(P2, E) for E in entries]
    T, J = _canonical_tensor(P2, P3).ravel(), np.stack(columns, axis=-1).reshape(27, 24)
    information = problem.linearize(state).reduced(1e-12)[0]
    scale = 1.0 / np.sqrt(floored_diagonal(np.diag(information)))
    values, vectors = np.linalg.eigh(information * scale * scale[:, None])
    # 6 of the 24 freedoms are the cameras' scales and the frame of space, which T does not feel.
    root = scale[:, None] * vectors[:, 6:] / np.sqrt(np.maximum(values[6:], 1e-14 * values[-1]))
    return _normalized(T, J @ root)


def _normalized(T: F64, root: F64) -> tuple[F64, F64]:
    """T / |T| and the root (27, 18) of the covariance of that unit vector."""
    size = float(np.linalg.norm(T))
    T = T / size
    return T, (root - np.outer(T, T @ root)) / size


def _in_pixels(transforms: F64) -> F64:
    """(27, 27) matrix that takes flat conditioned tensors to pixels."""
    inverse = np.linalg.inv(transforms)
    by_index = np.einsum("ri,js,kt->ijkrst", transforms[0], inverse[1], inverse[2])
    return np.asarray(by_index.reshape(27, 27))


def _canonical_tensor(P2: F64, P3: F64) -> F64:
    """T_i^jk = a_i^j b_4^k - a_4^j b_i^k of cameras beside [I 0], not normalised (HZ 15.1)."""
    of_first = np.einsum("ji,k->ijk", P2[:, :3], P3[:, 3])
    return np.asarray(of_first - np.einsum("j,ki->ijk", P2[:, 3], P3[:, :3]))
