"""Planar rectification methods: common orientation, Hartley, Loop and Zhang, minimum distortion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import camera_centre, principal_ray
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.stereo.epipolar_pair import MIN_MATCHES, EpipolarPair
from thesisrecon.stereo.planar import (
    FrameLimits,
    PlanarRectification,
    admissible_lines,
    affine_rows,
    crop_and_scale,
    disparity_gradients,
    homographies_of_rows,
    homography_jacobians,
    pencil_rows,
    require_in_front,
    singular_values,
)

SEARCH = 96
"""Lines at infinity that are tried before the best is refined."""


@dataclass(frozen=True)
class CommonOrientationRectifier:
    """Rectification of metric cameras by rotation about their centres to a common orientation.

    H = K R (K_i R_i)^-1 with the x axis of R along the baseline. Fusiello, Trucco and Verri use the viewing
    direction of the first camera; here it is the mean of both. K is common except for the principal point, so
    a point at depth z in the new orientation has the disparity f B / z minus the difference of the origins.

    Parameters
    ----------
    limits : FrameLimits

    References
    ----------
    A. Fusiello, E. Trucco, A. Verri, "A compact algorithm for rectification of stereo pairs", MVA 12(1),
    2000.
    """

    limits: FrameLimits = field(default_factory=FrameLimits)

    def rectify(self, pair: EpipolarPair) -> PlanarRectification:
        """Compute the homographies.

        Parameters
        ----------
        pair : EpipolarPair
            The pair with metric cameras.

        Returns
        -------
        PlanarRectification

        Raises
        ------
        StageFailure
            If there are no cameras, the frame is too large or a camera looks along the baseline.
        """
        if pair.cameras is None:
            raise StageFailure("a common orientation needs metric cameras", "", "rectify from F")
        P = pair.cameras
        centres = np.stack([camera_centre(camera) for camera in P])
        baseline = np.diff(centres[:, :3] / centres[:, 3:], axis=0)[0]
        x = baseline / np.linalg.norm(baseline)
        axis = principal_ray(P).sum(axis=0)
        z = axis - (axis @ x) * x
        if not np.linalg.norm(z) > 1e-6:
            raise StageFailure("both cameras look along the baseline", "", "rectify in polar coordinates")
        z = z / np.linalg.norm(z)
        orientation = np.stack([x, np.cross(z, x), z])
        return crop_and_scale(pair, np.asarray(orientation @ np.linalg.inv(P[:, :, :3])), self.limits)


@dataclass(frozen=True)
class HartleyRectifier:
    """Hartley's projective rectification from F and matches.

    The second image is mapped by G R T: rigidly about its centre except for the projective part that sends
    the epipole to infinity along x. The homography of the first is the compatible one with the least sum of
    squared x differences of the matches. In the pencil the line at infinity is perpendicular to the line
    through epipole and centre, and the least squares are linear in the first row for any compatible initial
    homography.

    Parameters
    ----------
    limits : FrameLimits

    References
    ----------
    R. Hartley, "Theory and practice of projective rectification", IJCV 35(2), 1999.
    """

    limits: FrameLimits = field(default_factory=FrameLimits)

    def rectify(self, pair: EpipolarPair) -> PlanarRectification:
        """Compute the homographies.

        Parameters
        ----------
        pair : EpipolarPair
            The pair with at least 8 matches.

        Returns
        -------
        PlanarRectification

        Raises
        ------
        StageFailure
            If there are too few matches, or an epipole lies in an image.
        """
        if len(pair.xy1) < MIN_MATCHES:
            raise StageFailure("Hartley's rectification needs matches", f"{len(pair.xy1)} are given", "")
        low, high = admissible_lines(pair)
        middle = pair.pencil.centres[1][None]
        phi = float(pair.pencil.angles(1, middle, about=0.5 * (low + high))[0])
        rows = pencil_rows(pair, phi, infinite=_perpendicular(pair, phi))
        require_in_front(pair, rows)
        v, w = rows[1]
        # A similarity about the image centre, the origin of normalised coordinates.
        second = np.array([v[1], -v[0], 0.0])
        z1, z2 = (homogenize(pair.pencil.normalized(s, xy)) for s, xy in enumerate(pair.matches))
        design = z1 / (z1 @ rows[0, 1])[:, None]
        first = np.linalg.lstsq(design, z2 @ second / (z2 @ w), rcond=None)[0]
        return crop_and_scale(pair, homographies_of_rows(pair, np.stack([first, second]), rows), self.limits)


def _perpendicular(pair: EpipolarPair, phi: float) -> float:
    """Plane of the line through the epipole of view 2 perpendicular to that through its centre."""
    e = pair.pencil.epipole(1)
    at_infinity = abs(e[2]) < 1e-12 * np.hypot(e[0], e[1])
    # The centre is the origin. For an epipole at infinity it is the line at infinity.
    line = np.array([0.0, 0.0, 1.0] if at_infinity else [e[0], e[1], -(e[0] ** 2 + e[1] ** 2) / e[2]])
    p = np.linalg.lstsq(pair.pencil.lines[1], line, rcond=None)[0]
    return phi + float(np.mod(np.arctan2(p[1], p[0]) - phi, np.pi))


@dataclass(frozen=True)
class LoopZhangRectifier:
    """Rectification of least projective distortion.

    The line at infinity minimises the variation of the third coordinate over both images, the sum of w'PP'w /
    w'p p'w (variance of w'x over its squared mean). Similarity and shear make the affine part a similarity.
    Departures: variances are taken over the common field of view, and the one-parameter minimum is searched
    globally instead of descending from an initial guess.

    Parameters
    ----------
    limits : FrameLimits

    References
    ----------
    C. Loop, Z. Zhang, "Computing rectifying homographies for stereo vision", CVPR 1999.
    """

    limits: FrameLimits = field(default_factory=FrameLimits)

    def rectify(self, pair: EpipolarPair) -> PlanarRectification:
        """Compute the homographies.

        Parameters
        ----------
        pair : EpipolarPair

        Returns
        -------
        PlanarRectification

        Raises
        ------
        StageFailure
            If every line at infinity crosses the common field of view, or the frame is too large.
        """
        rows = pencil_rows(pair, _loop_zhang_line(pair))
        return crop_and_scale(pair, homographies_of_rows(pair, affine_rows(pair, rows), rows), self.limits)


@dataclass(frozen=True)
class MinimumDistortionRectifier:
    """Planar rectification of least ``RectificationQuality.distortion``.

    Least squares over the line at infinity and the scale and shear of both first rows (5 parameters), from
    the solution of :class:`LoopZhangRectifier`: the variance of the log singular values of both homographies,
    symmetric in enlargement and reduction, plus a quarter of the mean squared disparity gradient. Hartley
    makes the first image similar to the second, Loop and Zhang preserve each by itself; this is a compromise.

    Parameters
    ----------
    limits : FrameLimits
    max_scale : float
        Limit of the log scale along the rows.
    max_shear : float
        Limit of the shear.
    """

    limits: FrameLimits = field(default_factory=FrameLimits)
    max_scale: float = 0.05
    max_shear: float = 0.06

    def __post_init__(self) -> None:
        if not (self.max_scale > 0.0 and self.max_shear > 0.0):
            raise ValueError(
                f"max_scale and max_shear must be positive; got {self.max_scale} and {self.max_shear}"
            )

    def rectify(self, pair: EpipolarPair) -> PlanarRectification:
        """Compute the homographies.

        Parameters
        ----------
        pair : EpipolarPair

        Returns
        -------
        PlanarRectification

        Raises
        ------
        StageFailure
            If every line at infinity crosses the common field of view, or the frame is too large.
        """
        low, high = admissible_lines(pair)
        # Keep away from lines that touch the field of view, where derivatives are unbounded.
        inset = 0.01 * (high - low)
        start = np.array(
            [np.clip(_loop_zhang_line(pair), low + 2.0 * inset, high - 2.0 * inset), 0.0, 0.0, 0.0, 0.0]
        )
        bound = np.array([0.0, self.max_scale, self.max_shear, self.max_scale, self.max_shear])
        found = scipy.optimize.least_squares(
            lambda q: _distortion_residuals(pair, *_adjusted(pair, q)),
            start,
            bounds=(np.append(low + inset, -bound[1:]), np.append(high - inset, bound[1:])),
            max_nfev=40,
        )
        first, rows = _adjusted(pair, found.x)
        return crop_and_scale(pair, homographies_of_rows(pair, first, rows), self.limits)


def _adjusted(pair: EpipolarPair, q: F64) -> tuple[F64, F64]:
    """First rows (2, 3) and other rows (2, 2, 3) for phi, log scales and shears (5,)."""
    rows = pencil_rows(pair, float(q[0]))
    return np.exp(q[1::2])[:, None] * affine_rows(pair, rows) + q[2::2, None] * rows[:, 0], rows


def _distortion_residuals(pair: EpipolarPair, first: F64, rows: F64) -> F64:
    """Residuals whose sum of squares is the squared distortion of homographies in normalised coordinates."""
    H = np.concatenate([first[:, None], rows], axis=1)
    logs = []
    for side in (0, 1):
        J = homography_jacobians(H[side], pair.pencil.normalized(side, pair.regions[side]))
        logs.append(np.log(np.maximum(singular_values(J), 1e-9) / pair.pencil.units[side]).ravel())
    every = np.concatenate(logs)
    residuals = (every - every.mean()) / np.sqrt(len(every))
    if len(pair.xy1) < MIN_MATCHES:
        return np.asarray(residuals)
    moved = [homogenize(pair.pencil.normalized(s, xy)) @ H[s].T for s, xy in enumerate(pair.matches)]
    left, right = (xh[:, :2] / xh[:, 2:] for xh in moved)
    slopes = disparity_gradients(left, right)
    return np.concatenate([residuals, 0.5 * slopes.ravel() / np.sqrt(len(slopes))])


def _loop_zhang_line(pair: EpipolarPair) -> float:
    """phi of Loop and Zhang's line at infinity phi + pi/2: least variation of the third coordinate."""
    z = [homogenize(pair.pencil.normalized(s, pair.regions[s])) for s in (0, 1)]

    def variation(phi: float) -> float:
        third = [z[s] @ w for s, w in enumerate(pencil_rows(pair, phi)[:, 1])]
        return float(sum(np.var(t) / np.mean(t) ** 2 for t in third))

    phi = _search(pair, variation)
    require_in_front(pair, pencil_rows(pair, phi))
    return phi


def _search(pair: EpipolarPair, cost: Callable[[float], float]) -> float:
    """phi of least ``cost`` within :func:`admissible_lines`."""
    low, high = admissible_lines(pair)
    # At the ends the line at infinity touches the field of view.
    tried = low + (high - low) * (np.arange(SEARCH) + 0.5) / SEARCH
    with np.errstate(all="ignore"):
        costs = np.array([cost(phi) for phi in tried])
    if not np.isfinite(costs).any():
        raise StageFailure("no line can be sent to infinity", "", "rectify in polar coordinates")
    k = int(np.nanargmin(costs))
    step = (high - low) / SEARCH
    found = scipy.optimize.minimize_scalar(
        cost, bounds=(max(low, tried[k] - step), min(high, tried[k] + step)), method="bounded"
    )
    return float(found.x) if found.fun <= costs[k] else float(tried[k])
