"""Homographies of matches: linear estimate, residuals, and the test for parallax (sections 3.6.4 and 5.5)."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64, require_shapes
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.conditioning import normalizing_transform, unit_norm
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.two_view import sampson_residuals

_PARALLAX_PER_NOISE, _MIN_PARALLAX_PX = 3.0, 0.05
"""Least parallax (90 % quantile): this multiple of the epipolar distances plus this many px."""
_MAX_OFF_PX, _MAX_OFF_REL = 1.0, 0.001
"""Largest median distance of the matches of F from their epipolar lines, in px or over their extent."""


def homography_linear(xy1: F64, xy2: F64) -> F64:
    """The homography x2 ~ H x1 of unit norm by normalised DLT of four matches or more (HZ algorithm 4.2)."""
    require_shapes("homography_linear", xy1=(xy1, ("N", 2)), xy2=(xy2, ("N", 2)))
    if len(xy1) < 4:
        raise ValueError(f"homography_linear needs at least 4 matches; got {len(xy1)}")
    T1, T2 = normalizing_transform(xy1), normalizing_transform(xy2)
    x1, (u, v) = homogenize(xy1) @ T1.T, (xy2 @ T2[:2, :2].T + T2[:2, 2]).T
    zero = np.zeros_like(x1)
    A = np.concatenate([np.hstack([x1, zero, -u[:, None] * x1]), np.hstack([zero, x1, -v[:, None] * x1])])
    H: F64 = np.linalg.eigh(A.T @ A)[1][:, 0].reshape(3, 3)
    return unit_norm(np.asarray(np.linalg.solve(T2, H @ T1)))


def homography_residuals(H: F64, xy1: F64, xy2: F64) -> F64:
    """Distances |x2 - H x1| (N,) in image 2; inf for points that H maps to infinity."""
    moved = dehomogenize(homogenize(xy1) @ H.T)
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(xy2 - moved, axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def homography_sampson_residuals(H: F64, xy1: F64, xy2: F64) -> F64:
    """Whitened residuals (N, 2) of x2 ~ H x1, px (Chum, Pajdla and Sturm, CVIU 97(1), 2005).

    Each has to first order the standard deviation of one image coordinate.
    """
    x1 = homogenize(xy1)
    u, v, w = (x1 @ H.T).T
    c = np.stack([u - w * xy2[:, 0], v - w * xy2[:, 1]], axis=1)
    J = np.zeros((len(x1), 2, 4))
    J[:, :, :2] = H[None, :2, :2] - xy2[:, :, None] * H[2, :2]
    J[:, 0, 2] = J[:, 1, 3] = -w
    # Cholesky factor of J J' (2 x 2).
    a, b, d = (np.sum(J[:, i] * J[:, j], axis=1) for i, j in ((0, 0), (0, 1), (1, 1)))
    l11 = np.sqrt(a + 1e-300)
    l21 = b / l11
    l22 = np.sqrt(np.maximum(d - l21**2, 1e-300))
    first = c[:, 0] / l11
    return np.stack([first, (c[:, 1] - l21 * first) / l22], axis=1)


def require_parallax_of_matches(
    F: F64, xy1: F64, xy2: F64, *, at_infinity: F64 | None = None, advice: str = ""
) -> None:
    """Raise ``StageFailure`` if one homography explains the N >= 4 inliers of F (section 5.5).

    F is then arbitrary and the images contain no depth: the camera only rotated, or the scene is a plane.
    ``at_infinity`` is the homography of the plane at infinity of known cameras: a plane then has parallax.
    Without it, matches that are no inliers of F are refused too, as of images in the other order.
    """
    distances = np.abs(sampson_residuals(F, xy1, xy2))
    noise, off = (float(np.quantile(distances, share)) for share in (0.9, 0.5))
    most = max(_MAX_OFF_PX, _MAX_OFF_REL * float(max(np.ptp(xy1, axis=0).max(), np.ptp(xy2, axis=0).max())))
    if at_infinity is None:
        what, residuals = "one homography", _homography_residuals(xy1, xy2)
    else:
        what, residuals = "a scene at infinity", homography_residuals(at_infinity, xy1, xy2)
    parallax = float(np.quantile(residuals, 0.9))
    fits = at_infinity is not None or off <= most
    if fits and parallax > _PARALLAX_PER_NOISE * noise + _MIN_PARALLAX_PX:
        return
    if not fits and parallax > most:
        raise StageFailure(
            "the fundamental matrix does not fit the matches",
            f"their median distance from the epipolar lines is {off:.3g} px",
            "estimate it from these matches, with the images in this order",
        )
    raise StageFailure(
        "the images show no parallax: the camera only rotated, or the scene is a plane or too far away",
        f"{what} explains 90 % of {len(xy1)} matches to {parallax:.2g} px; the noise is {noise:.2g} px",
        f"take images from positions farther apart{advice}",
    )


def _homography_residuals(xy1: F64, xy2: F64) -> F64:
    """Residuals (N,) of a least-squares homography, fitted twice more without the worst tenth of the matches.

    At least four matches remain.
    """
    inliers, residuals = np.ones(len(xy1), dtype=bool), np.zeros(len(xy1))
    for _ in range(3):
        H = homography_linear(xy1[inliers], xy2[inliers])
        residuals = homography_residuals(H, xy1, xy2)
        inliers = residuals <= np.fmax(np.quantile(residuals, 0.9), np.partition(residuals, 3)[3])
    return residuals
