"""Section 3.6.3: the trifocal tensor of points and lines in three views with noise."""

from __future__ import annotations

import contextlib

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.three_view import (
    NEEDED_EQUATIONS,
    TensorEquations,
    check_triplets,
    tensor_epipoles,
    tensor_equations,
    unit_tensor,
)
from thesisrecon.numerics.levenberg_marquardt import minimize_residuals

# The matches are refused if noise of 1.7 times their own explains six tensors: points or lines of a plane and
# rotations (29 of 30 scenes of 40 points), parallel lines. Lines of a facade and its surroundings leave five.
SAME_NOISE, FAMILY = 1.7, 6
NO_POINTS, NO_SEGMENTS = np.zeros((3, 0, 2)), np.zeros((3, 0, 2, 2))


def estimate_trifocal(points: F64 = NO_POINTS, segments: F64 = NO_SEGMENTS) -> F64:
    """Estimate the trifocal tensor from points and lines of three views.

    Linear equations, then the least algebraic error over both epipoles among the tensors that have cameras
    (HZ, algorithm 16.2). The ends of a segment need not match between views.

    Parameters
    ----------
    points : ndarray (3, N, 2)
        Matched points, px.
    segments : ndarray (3, M, 2, 2)
        Ends of matched line segments, px; 4 N + 2 M >= 26.

    Returns
    -------
    ndarray (3, 3, 3)
        Tensor in pixels, unit norm; its cameras are exact.

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
    >>> from thesisrecon.geometry.three_view import transfer_points
    >>> X = np.random.default_rng(0).uniform(-1, 1, (20, 3)) + [0, 0, 5]
    >>> K, views = np.diag([800.0, 800.0, 1.0]), ([0, 0, 0], [-1, 0.2, 0], [0.3, -1, 0.4])
    >>> points = np.stack([project(K @ np.c_[np.eye(3), t], X) for t in views])
    >>> T = estimate_trifocal(points)
    >>> bool(np.abs(transfer_points(T, points[0], points[1]) - points[2]).max() < 1e-6)
    True
    """
    points, segments = check_triplets(points, segments)
    n, m = points.shape[1], segments.shape[1]
    if 4 * n + 2 * m < NEEDED_EQUATIONS:
        raise StageFailure(
            "too few matches for the trifocal tensor",
            f"found {n} points and {m} lines; 7 points, 13 lines or a mixture are needed",
            "use images with more overlap",
        )
    equations = tensor_equations(points, segments)
    family, sigma_px, T = 27, np.inf, np.zeros((3, 3, 3))
    with contextlib.suppress(ValueError):
        T = _minimize_algebraic_error(equations, equations.solve())
        t = T.ravel()
        sigma_px = float(np.linalg.norm(equations.A @ t) / np.linalg.norm(equations.noise @ t))
        family = int(np.sum(equations.noise_levels_px() <= SAME_NOISE * sigma_px))
    xy = np.concatenate([points, segments.reshape(3, -1, 2)], axis=1)
    across = np.linalg.svd(xy - xy.mean(axis=1, keepdims=True), compute_uv=False)[:, 1]
    narrowest = float(across.min()) / np.sqrt(xy.shape[1])
    if family >= FAMILY or not narrowest > 3.0 * sigma_px:
        raise StageFailure(
            "the matches do not determine the trifocal tensor",
            f"noise {sigma_px:.2g} px explains {family} independent tensors (at most {FAMILY - 1}); "
            f"narrowest spread of the matches {narrowest:.3g} px",
            "use matches off one plane from three different positions, and check for wrong matches",
        )
    return equations.in_pixels(T)


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
