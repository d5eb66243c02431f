"""Section 3.6.3: the trifocal tensor with the least reprojection error of points and lines in three views.

Linear equations; the least algebraic error over both epipoles (HZ, algorithm 16.2); the least reprojection
error over cameras, points and lines (HZ 16.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import homogenize, unit_normals
from thesisrecon.geometry.three_view import (
    NEEDED_EQUATIONS,
    TensorEquations,
    cameras_from_tensor,
    check_triplets,
    tensor_epipoles,
    tensor_equations,
    unit_tensor,
)
from thesisrecon.numerics.levenberg_marquardt import (
    invert_information,
    minimize_residuals,
)

# Largest relative standard deviation of T. Planes, rotations and random matches give 0.5 to 1.5 at any noise;
# scenes with depth and noise of a hundredth of the parallax below 0.1.
WEAK = 0.4
# A fit is refused if noise of 1.25 times its own explains six tensors of the linear equations. Points or
# lines of a plane and rotations leave 6 to 12, parallel lines 13 or more, three walls at most 5, which the
# constraints of the cameras resolve.
SAME_NOISE, FAMILY = 1.25, 6
NO_POINTS, NO_SEGMENTS = np.zeros((3, 0, 2)), np.zeros((3, 0, 2, 2))
OPT={}


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
        raise StageFailure(
            "the matches do not determine the trifocal tensor",
            f"{n} points and {m} lines in a special position",
            "add matches off the dominant plane",
        ) from error
    fit = _minimize_reprojection_error(T, points, segments, equations, loss_px)
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
    return unit_tensor(tensor(found.x))


class _Reprojection:
    """Residuals of conditioned points x (3, N, 3) and segment ends y (3, M, 2, 3) near cameras P (3, 3, 4).

    The parameters are 18 moves of P2 and P3, then 3 of each point and 4 of each line (two points), orthogonal
    to the start: without singularities and independent of the frame of space.
    """

    def __init__(self, T: F64, points: F64, segments: F64, transforms: F64) -> None:
        H = transforms.swapaxes(1, 2)
        self.x, self.y, self.scale = homogenize(points) @ H, homogenize(segments) @ H[:, None], H[:, 0, 0]
        self.P = np.stack(cameras_from_tensor(T))
        self.P[1:] /= np.linalg.norm(self.P[1:], axis=(1, 2), keepdims=True)
        # T does not depend on six directions: the scales of P2 and P3 and the frame of space.
        self.moves = np.linalg.svd(_by_cameras(self.P))[2][:18].reshape(18, 2, 3, 4)
        axes = np.eye(3)[:2] - self.x[..., :2, None] * np.eye(3)[2]
        lines = unit_normals(np.cross(self.y[:, :, 0], self.y[:, :, 1]))[:, :, None]
        # A point is the intersection of the planes of its axis-parallel image lines, as a line is of its lines.
        planes = (np.concatenate(list(l @ self.P[:, None]), axis=1) for l in (axes, lines))
        self.X, self.L = (np.linalg.svd(p)[2] for p in planes)

    def cameras(self, p: F64) -> F64:
        return self.P + np.concatenate([np.zeros((1, 3, 4)), np.tensordot(p[:18], self.moves, 1)])

    def residuals(self, p: F64) -> F64:
        """Offsets of the points, then distances of the segment ends, (N + M, 3 views, 2) px."""
        n, P = len(self.X), self.cameras(p)
        X = self.X[:, 3:] + p[18 : 18 + 3 * n].reshape(n, 1, 3) @ self.X[:, :3]
        L = self.L[:, 2:] + p[18 + 3 * n :].reshape(-1, 2, 2) @ self.L[:, :2]
        image, ends = np.einsum("vab,nkb->kvna", P, X)[0], np.einsum("vab,mkb->kvma", P, L)
        # Points of a principal plane have a distant image instead of none.
        z = np.where(np.abs(image[..., 2:]) < 1e-12, 1e-12, image[..., 2:])
        offsets = image[..., :2] / z - self.x[..., :2]
        distances = (self.y @ unit_normals(np.cross(*ends))[..., None])[..., 0]
        both = np.concatenate([offsets, distances], axis=1) / self.scale[:, None, None]
        return np.asarray(both.swapaxes(0, 1))

    def sparsity(self) -> scipy.sparse.csr_matrix:
        n, m = len(self.X), len(self.L)
        own = scipy.sparse.block_diag([np.ones((6, 3))] * n + [np.ones((6, 4))] * m)
        return scipy.sparse.hstack([np.ones((6 * (n + m), 18)), own]).tocsr()


def _minimize_reprojection_error(
    T: F64, points: F64, segments: F64, equations: TensorEquations, loss_px: float
) -> TrifocalFit:
    """The fit, started from a conditioned tensor; whether the matches determine it is not tested."""
    n, m = points.shape[1], segments.shape[1]
    problem = _Reprojection(T, points, segments, equations.transforms)
    found = scipy.optimize.least_squares(
        lambda p: problem.residuals(p).ravel(),
        np.zeros(18 + 3 * n + 4 * m),
        jac_sparsity=problem.sparsity(),
        x_scale="jac",
        loss="huber",
        f_scale=loss_px,
        max_nfev=50, **OPT
    )
    residual, P = problem.residuals(found.x), problem.cameras(found.x)
    sigma = float(np.sqrt(np.sum(residual**2) / max(3 * n + 2 * m - 18, 1)))
    J = found.jac.toarray() if hasattr(found.jac,'toarray') else found.jac
    by_camera = _by_cameras(P) @ problem.moves.reshape(18, 24).T
    covariance = sigma**2 * invert_information(J.T @ J)[:18, :18]
    T = _canonical_tensor(P[1], P[2]).ravel()
    T, covariance = _normalized(T, by_camera @ covariance @ by_camera.T)
    relative = float(np.sqrt(np.linalg.norm(covariance, ord=2) * (n + m)))
    H1, (_, H2, H3) = equations.transforms[0], np.linalg.inv(equations.transforms)
    to_pixels = np.einsum("ri,js,kt->ijkrst", H1, H2, H3).reshape(27, 27)
    T, covariance = _normalized(to_pixels @ T, to_pixels @ covariance @ to_pixels.T)
    return TrifocalFit(
        T.reshape(3, 3, 3),
        np.linalg.norm(residual[:n], axis=2).T,
        np.abs(residual[n:]).swapaxes(0, 1),
        sigma,
        covariance,
        relative,
    )


def _by_cameras(P: F64) -> F64:
    """Derivatives (27, 24) of the tensor by the entries of P2 and P3."""
    entries = np.eye(12).reshape(12, 3, 4)
    columns = np.concatenate([_canonical_tensor(entries, P[2]), _canonical_tensor(P[1], entries)])
    return columns.reshape(24, 27).T


def _canonical_tensor(P2: F64, P3: F64) -> F64:
    """A_ji b_k - a_j B_ki (..., 3, 3, 3) of cameras [A a] and [B b] (HZ 15.1), linear in either."""
    left = np.einsum("...ji,...k->...ijk", P2[..., :3], P3[..., 3])
    return np.asarray(left - np.einsum("...j,...ki->...ijk", P2[..., 3], P3[..., :3]))


def _normalized(T: F64, covariance: F64) -> tuple[F64, F64]:
    """T / |T| (27,) and the covariance (27, 27) of that unit vector."""
    size = float(np.linalg.norm(T))
    J = (np.eye(27) - np.outer(T, T) / size**2) / size
    return T / size, J @ covariance @ J.T


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
            "the matches do not determine the trifocal tensor",
            f"noise {fit.sigma_px:.2g} px explains {family} independent tensors (at most {FAMILY - 1}); "
            f"narrowest spread of the matches {narrowest:.3g} px; relative standard deviation "
            f"{fit.relative_std:.2g} (at most {WEAK:.2g})",
            "use matches off one plane from three different positions, and check for wrong matches",
        )
