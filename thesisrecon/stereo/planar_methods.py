"""Planar rectification from F and matches alone: Hartley's way, Loop and Zhang's, and the least distorted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.stereo.epipolar_pair import LEAST_MATCHES, EpipolarPair
from thesisrecon.stereo.planar import (
    FrameLimits,
    PlanarRectification,
    disparity_gradients,
    frame,
    homographies_of_rows,
    homography_jacobians,
    pencil_rows,
    planes_in_reach,
    require_in_front,
    singular_values,
    undistorting_rows,
)

SEARCH = 96
"""Lines at infinity that are tried before the best one is refined."""


@dataclass(frozen=True)
class Hartley:
    """Hartley, "Theory and practice of projective rectification", IJCV 35(2), 1999.

    The second photograph is mapped by G R T: rigidly about its centre but for what sends the epipole to
    infinity along x. The first one's homography is the compatible one whose x differ least from the second's
    (sum of squares over the matches). In the pencil: the line at infinity is the one perpendicular to the
    line through epipole and centre, and the least squares are linear in the first row, whatever compatible
    homography one begins with.
    """

    limits: FrameLimits = field(default_factory=FrameLimits)

    def rectify(self, pair: EpipolarPair) -> PlanarRectification:
        """The two homographies; ``StageFailure`` where they cannot be."""
        if len(pair.xy1) < LEAST_MATCHES:
            raise StageFailure("Hartley's rectification needs matches", f"{len(pair.xy1)} are given", "")
        low, high = planes_in_reach(pair)
        middle = pair.pencil.centres[1][None]
        phi = float(pair.pencil.angles(1, middle, about=0.5 * (low + high))[0])
        rows = pencil_rows(pair, phi, infinite=_perpendicular(pair, phi))
        require_in_front(pair, rows)
        v, w = rows[1]
        # With v a similarity about the centre, the origin of places.
        second = np.array([v[1], -v[0], 0.0])
        z1, z2 = (homogenize(pair.pencil.places(s, xy)) for s, xy in enumerate(pair.matches))
        design = z1 / (z1 @ rows[0, 1])[:, None]
        first = np.linalg.lstsq(design, z2 @ second / (z2 @ w), rcond=None)[0]
        return frame(pair, homographies_of_rows(pair, np.stack([first, second]), rows), self.limits)


def _perpendicular(pair: EpipolarPair, phi: float) -> float:
    """The plane above phi that view 2 sees as the line through the epipole square to that to its centre."""
    e = pair.pencil.epipole(1)
    at_infinity = abs(e[2]) < 1e-12 * np.hypot(e[0], e[1])
    # The centre is the origin of places. Of an epipole at infinity it is the line at infinity itself.
    line = np.array([0.0, 0.0, 1.0] if at_infinity else [e[0], e[1], -(e[0] ** 2 + e[1] ** 2) / e[2]])
    p = np.linalg.lstsq(pair.pencil.lines[1], line, rcond=None)[0]
    return phi + float(np.mod(np.arctan2(p[1], p[0]) - phi, np.pi))


@dataclass(frozen=True)
class LoopZhang:
    """Loop and Zhang, "Computing rectifying homographies for stereo vision", CVPR 1999.

    The line at infinity is the one for which the third coordinate varies least over both images: the sum of
    w'PP'w / w'p p'w, the variance of w'x over its squared mean. The similarity and the shear then make the
    affine part square. Departures: variances are those over what both photographs see, not over all pixels;
    the minimum over the one-parameter pencil is searched over all of it, not descended to from a guess.
    """

    limits: FrameLimits = field(default_factory=FrameLimits)

    def rectify(self, pair: EpipolarPair) -> PlanarRectification:
        """The two homographies; ``StageFailure`` where they cannot be."""
        rows = pencil_rows(pair, calmest_line(pair))
        return frame(pair, homographies_of_rows(pair, undistorting_rows(pair, rows), rows), self.limits)


@dataclass(frozen=True)
class LeastDistortion:
    """The planar rectification of least ``RectificationQuality.distortion``.

    Line at infinity, scale along the rows and shear of either side (5 unknowns; least squares from those of
    :class:`LoopZhang`): the variance of the log singular values of both homographies, symmetric in growing
    and shrinking, and a quarter of the mean squared gradient of the disparities. Between Hartley, who makes
    the first photograph like the second, and Loop and Zhang, who spare either by itself: ``most_scale`` (log)
    and ``most_shear`` say by how much a photograph may give up its aspect and its right angles so that both
    sides become alike.
    """

    limits: FrameLimits = field(default_factory=FrameLimits)
    most_scale: float = 0.05
    most_shear: float = 0.06

    def __post_init__(self) -> None:
        if not (self.most_scale > 0.0 and self.most_shear > 0.0):
            raise ValueError(
                f"most_scale and most_shear must be positive; got {self.most_scale} and {self.most_shear}"
            )

    def rectify(self, pair: EpipolarPair) -> PlanarRectification:
        """The two homographies; ``StageFailure`` where they cannot be."""
        low, high = planes_in_reach(pair)
        # Off the lines that touch what both see, where derivatives grow without bound.
        inset = 0.01 * (high - low)
        start = np.array(
            [np.clip(calmest_line(pair), low + 2.0 * inset, high - 2.0 * inset), 0.0, 0.0, 0.0, 0.0]
        )
        bound = np.array([0.0, self.most_scale, self.most_shear, self.most_scale, self.most_shear])
        found = scipy.optimize.least_squares(
            lambda q: _distortion_residuals(pair, *_adjusted(pair, q)),
            start,
            bounds=(np.append(low + inset, -bound[1:]), np.append(high - inset, bound[1:])),
            max_nfev=40,
        )
        first, rows = _adjusted(pair, found.x)
        return frame(pair, homographies_of_rows(pair, first, rows), self.limits)


def _adjusted(pair: EpipolarPair, q: F64) -> tuple[F64, F64]:
    """First rows (2, 3) and the others (2, 2, 3) of phi, log scale and shear of either side (5,)."""
    rows = pencil_rows(pair, float(q[0]))
    return np.exp(q[1::2])[:, None] * undistorting_rows(pair, rows) + q[2::2, None] * rows[:, 0], rows


def _distortion_residuals(pair: EpipolarPair, first: F64, rows: F64) -> F64:
    """Numbers whose sum of squares is the squared distortion of homographies in places."""
    H = np.concatenate([first[:, None], rows], axis=1)
    logs = []
    for side in (0, 1):
        J = homography_jacobians(H[side], pair.pencil.places(side, pair.regions[side]))
        logs.append(np.log(np.maximum(singular_values(J), 1e-9) / pair.pencil.units[side]).ravel())
    every = np.concatenate(logs)
    residuals = (every - every.mean()) / np.sqrt(len(every))
    if len(pair.xy1) < LEAST_MATCHES:
        return np.asarray(residuals)
    moved = [homogenize(pair.pencil.places(s, xy)) @ H[s].T for s, xy in enumerate(pair.matches)]
    left, right = (xh[:, :2] / xh[:, 2:] for xh in moved)
    slopes = disparity_gradients(left, right)
    return np.concatenate([residuals, 0.5 * slopes.ravel() / np.sqrt(len(slopes))])


def calmest_line(pair: EpipolarPair) -> float:
    """The phi of Loop and Zhang's line at infinity, phi + pi/2: least variation of the third coordinate.

    ``StageFailure`` where every line crosses what both photographs see.
    """
    z = [homogenize(pair.pencil.places(s, pair.regions[s])) for s in (0, 1)]

    def variation(phi: float) -> float:
        third = [z[s] @ w for s, w in enumerate(pencil_rows(pair, phi)[:, 1])]
        return float(sum(np.var(t) / np.mean(t) ** 2 for t in third))

    phi = _search(pair, variation)
    require_in_front(pair, pencil_rows(pair, phi))
    return phi


def _search(pair: EpipolarPair, cost: Callable[[float], float]) -> float:
    """The phi of least ``cost`` among those that :func:`planes_in_reach`."""
    low, high = planes_in_reach(pair)
    # At the ends the line at infinity touches what both see.
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
