"""Planar rectification: a homography for either photograph, and its frame.

Every pair of homographies that makes epipolar lines rows of equal number has, with a line at infinity
phi + pi/2 of the pencil, the rows v = -L p(phi) and w = L p(phi + pi/2), so that y = v'x / w'x is the tangent
of the angle of x less phi in both views exactly. Free are phi, one unit of length and the first rows: the
methods differ in these.

Planar rectification of two metric cameras: both turn about their centres to one common orientation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy

from thesisrecon.arrays import B8, F32, F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import camera_centre, principal_ray
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.stereo.epipolar_pair import MIN_MATCHES, EpipolarPair, plane_from_angle
from thesisrecon.stereo.resampling import require_side, warp_image

CROP_MARGIN = 1.0
"""How far disparities may go beyond those of the matches in a crop, as a share of their range."""

MOST_MATCHES = 300
"""Matches that disparities are fitted to."""


@dataclass(frozen=True)
class FrameLimits:
    """How large a rectified frame is.

    Areas keep their size on average, and no pixel shrinks by more than ``most_shrink`` along any direction
    where the frame holds it. A frame of more than ``most_growth`` times the pixels of the larger photograph
    is refused.
    """

    max_shrink: float = 1.4
    max_growth: float = 6.0

    def __post_init__(self) -> None:
        if not (self.max_shrink >= 1.0 and self.max_growth >= 1.0):
            raise ValueError(
                f"most_shrink and most_growth are at least 1; got {self.max_shrink}, {self.max_growth}"
            )

    def require(self, extent: F64, pair: EpipolarPair) -> tuple[int, int]:
        """The whole size of a frame, or ``StageFailure`` where it is too large, or has no pixels."""
        width, height = float(extent[0]), float(extent[1])
        most = self.max_growth * max(w * h for w, h in pair.sizes)
        if not width * height <= most:
            raise StageFailure(
                "the rectified photographs are too distorted",
                f"they need {width * height / 1e6:.3g} million pixels of {most / 1e6:.3g} allowed",
                "rectify in polar coordinates, or choose views of less forward motion",
            )
        if not min(width, height) >= 2.0:
            raise StageFailure(
                "the rectified photographs have nothing in common",
                f"their common frame is {width:.3g} x {height:.3g} px",
                "choose views that overlap more",
            )
        return int(np.ceil(width)), int(np.ceil(height))


@dataclass(frozen=True)
class PlanarRectification:
    """Homographies (3, 3) from either photograph to a frame of ``size`` (width, height) common to both.

    Rows are epipolar lines; x_right = x_left - d with d larger for nearer points, side 0 being the left one
    (the frame may be the photograph's turned by any angle). ``H1, H2`` are scaled such that the third
    coordinate is positive for what can be seen.
    """

    H1: F64
    H2: F64
    size: tuple[int, int]

    def homography(self, side: int) -> F64:
        """H1 for side 0, H2 for side 1, else ``ValueError``."""
        return self.H2 if require_side(side) else self.H1

    def original_from_rectified(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """Pixels (N, 2) of the photograph at places (N, 2) of the frame; NaN outside the frame and beyond
        the line sent to infinity. With ``within`` False only the latter."""
        source = _within(xy, self.size) if within else xy
        return _moved(np.asarray(np.linalg.inv(self.homography(side))), source)

    def rectified_from_original(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """The inverse of :meth:`original_from_rectified`, for pixels (N, 2) of the photograph."""
        moved = _moved(self.homography(side), xy)
        return _within(moved, self.size) if within else moved

    def lookup(self, side: int, rows: range) -> F64:
        """(len(rows), width, 2) px in the photograph for the pixels of these rows."""
        G = np.linalg.inv(self.homography(side))
        x, y = np.arange(float(self.size[0])), np.arange(rows.start, rows.stop, dtype=np.float64)
        u, v, w = (np.add.outer(row[1] * y + row[2], row[0] * x) for row in G)
        with np.errstate(divide="ignore", invalid="ignore"):
            w = np.where(w > 0.0, 1.0 / w, np.nan)
        return np.stack([u * w, v * w], axis=-1)

    def warp(self, image: F32, side: int) -> F32:
        """``image`` (H, W) or (H, W, C) in the frame: float32, NaN outside."""
        return warp_image(self, image, require_side(side))


def _moved(H: F64, xy: F64) -> F64:
    xh = homogenize(xy) @ H.T
    with np.errstate(divide="ignore", invalid="ignore"):
        moved: F64 = np.where(xh[:, 2:] > 0.0, xh[:, :2] / xh[:, 2:], np.nan)
    return moved


def _within(xy: F64, size: tuple[int, int]) -> F64:
    """``xy`` (N, 2), NaN where outside the pixels of an image of ``size``."""
    inside = np.all((xy >= -0.5) & (xy <= np.array(size) - 0.5), axis=1)
    return np.where(inside[:, None], xy, np.nan)


def pencil_rows(pair: EpipolarPair, phi: float, *, infinite: float | None = None) -> F64:
    """The second and third rows (2, 2, 3) of both homographies, in places.

    Row 0 of the frame is the plane ``phi``; the line at infinity is the plane ``infinite``, phi + pi/2 where
    that is None.
    """
    v, w = plane_from_angle(np.array([phi, phi + 0.5 * np.pi if infinite is None else infinite]))
    return np.stack([np.stack([-L @ v, L @ w]) for L in pair.pencil.lines])


def admissible_lines(pair: EpipolarPair) -> tuple[float, float]:
    """The phi whose line at infinity misses what both photographs see; ``StageFailure`` where none does."""
    low, high = pair.arc
    if not high - low < np.pi - 1e-6:
        raise StageFailure(
            "the epipoles lie in the photographs",
            "no line of the pencil passes beside what both show",
            "rectify in polar coordinates",
        )
    return high - 0.5 * np.pi, low + 0.5 * np.pi


def require_in_front(pair: EpipolarPair, rows: F64) -> None:
    """``StageFailure`` unless the line at infinity of rows (2, 2, 3) passes beside all that both see."""
    for side, (xy, samples) in enumerate(zip(pair.matches, pair.regions, strict=True)):
        third = homogenize(pair.pencil.normalized(side, np.concatenate([samples, xy]))) @ rows[side, 1]
        if not third.min() > 1e-6 * third.max():
            raise StageFailure(
                "the line sent to infinity crosses the photographs",
                "an epipole lies in one of them or at its border",
                "rectify in polar coordinates",
            )


def affine_rows(pair: EpipolarPair, rows: F64) -> F64:
    """First rows (2, 3) for which the affine part of either homography is a similarity (Loop and Zhang 1999).

    Their shear keeps the midlines of a photograph square and of equal ratio; here the midlines are those of
    what both photographs see: the best affine map of its samples (least squares) gets two perpendicular rows
    of equal length. x' = alpha x_a + beta y' with any other coordinate x_a, and the condition is linear.
    """
    first = []
    for side in (0, 1):
        z = homogenize(pair.pencil.normalized(side, pair.regions[side]))
        v, w = rows[side]
        middle = z - z.mean(axis=0)
        third = z @ w
        x_a = np.cross(v, w)
        gradients = np.linalg.lstsq(
            middle[:, :2], np.stack([z @ x_a, z @ v], axis=1) / third[:, None], rcond=None
        )[0]
        g_a, g_v = gradients.T
        # Right-handed: x' before y' as x before y.
        wanted = np.array([g_v[1], -g_v[0]])
        alpha, beta = np.linalg.solve(np.stack([g_a, g_v], axis=1), wanted)
        first.append(alpha * x_a + beta * v)
    return np.stack(first)


def homographies_of_rows(pair: EpipolarPair, first: F64, rows: F64) -> F64:
    """Homographies (2, 3, 3) of pixels with first rows (2, 3) and others (2, 2, 3) in places, turned if the
    pair is."""
    H = np.concatenate([first[:, None], rows], axis=1) @ _normalizing_transforms(pair)
    if pair.pencil.flipped:
        H[:, :2] *= -1.0
    return H


def crop_and_scale(pair: EpipolarPair, H: F64, limits: FrameLimits) -> PlanarRectification:
    """Scale, crop to what both see and origins of homographies (2, 3, 3) of pixels whose rows agree.

    Raises ``StageFailure`` where a line at infinity crosses what both see, or the frame would be too large.
    """
    samples = [_mapped(H[side], pair.regions[side]) for side in (0, 1)]
    low, high = common_crop(samples, (_mapped(H[0], pair.xy1), _mapped(H[1], pair.xy2)))
    kept = [np.all((xy >= low[side]) & (xy <= high[side]), axis=1) for side, xy in enumerate(samples)]
    scale = _scale(pair, H, kept, limits)
    width, height = limits.require(scale * (high - low).max(axis=0) + 1.0, pair)
    # Both origins share their row; what the frame is wider than a side's crop stays on the right.
    T = np.zeros((2, 3, 3))
    T[:, 0, 0] = T[:, 1, 1] = scale
    T[:, :2, 2] = -scale * low
    T[:, 2, 2] = 1.0
    H = T @ H
    return PlanarRectification(H[0], H[1], (width, height))


def _normalizing_transforms(pair: EpipolarPair) -> F64:
    p = pair.pencil
    T = np.zeros((2, 3, 3))
    T[:, 0, 0] = T[:, 1, 1] = 1.0 / p.units
    T[:, :2, 2] = -p.centres / p.units[:, None]
    T[:, 2, 2] = 1.0
    return T


def _mapped(H: F64, xy: F64) -> F64:
    xh = homogenize(xy) @ H.T
    if not (xh[:, 2] > 1e-9 * np.abs(xh[:, 2]).max(initial=0.0)).all() or np.linalg.det(H) <= 0.0:
        raise StageFailure(
            "the line sent to infinity crosses the photographs", "", "rectify in polar coordinates"
        )
    return np.asarray(xh[:, :2] / xh[:, 2:])


def common_crop(samples: list[F64], matches: tuple[F64, F64]) -> tuple[F64, F64]:
    """Least and greatest rectified coordinates (2, 2), (2, 2) of what both sides see, row: side.

    Along the rows what a side's photograph covers is cut to what the other one can show at the disparities
    of the matches; without matches it stays.
    """
    low, high = (np.stack([f(xy, axis=0) for xy in samples]) for f in (np.min, np.max))
    low[:, 1], high[:, 1] = low[:, 1].max(), high[:, 1].min()
    if len(matches[0]):
        near, far = disparity_bounds(matches[0][:, 0] - matches[1][:, 0], margin=CROP_MARGIN)
        least, most = low[:, 0].copy(), high[:, 0].copy()
        low[0, 0], high[0, 0] = max(least[0], least[1] + near), min(most[0], most[1] + far)
        low[1, 0], high[1, 0] = max(least[1], least[0] - far), min(most[1], most[0] - near)
    return low, high


def disparity_bounds(disparities: F64, *, margin: float) -> tuple[float, float]:
    """Least and greatest disparity to be expected of those of the matches (N,).

    Their 1 and 99 % quantiles, for a few matches are wrong along their lines, with a margin of ``margin``
    times their difference.
    """
    low, high = np.quantile(disparities, [0.01, 0.99])
    return float(low - margin * (high - low)), float(high + margin * (high - low))


def disparity_gradients(left: F64, right: F64) -> F64:
    """Gradients (M, 2) of x_left - x_right by the means of both places (N, 2), (N, 2), at M <= 300 of these.

    Of the quadratic polynomial that fits best: what either side is stretched, sheared and bent against the
    other on the whole, relief left out.
    """
    every = max(len(left) // MOST_MATCHES, 1)
    left, right = left[::every], right[::every]
    middle = 0.5 * (left + right)
    middle = middle - middle.mean(axis=0)
    unit = float(np.abs(middle).max(initial=1e-12))
    x, y = (middle / unit).T
    design = np.stack([x, y, x * x, x * y, y * y, np.ones_like(x)], axis=1)
    # Of few matches, or of matches on a line, the least polynomial is as good.
    c = np.linalg.lstsq(design, (left[:, 0] - right[:, 0]) / unit, rcond=1e-6)[0]
    return np.stack([c[0] + 2.0 * c[2] * x + c[3] * y, c[1] + c[3] * x + 2.0 * c[4] * y], axis=1)


def homography_jacobians(H: F64, xy: F64) -> F64:
    """Derivatives (N, 2, 2) of H (3, 3) at pixels (N, 2)."""
    xh = homogenize(xy) @ H.T
    moved = xh[:, :2] / xh[:, 2:]
    return np.asarray((H[None, :2, :2] - moved[:, :, None] * H[2, :2]) / xh[:, 2, None, None])


def singular_values(J: F64) -> F64:
    """(N, 2) singular values of (N, 2, 2), the larger first."""
    a = 0.5 * np.hypot(J[:, 0, 0] + J[:, 1, 1], J[:, 1, 0] - J[:, 0, 1])
    b = 0.5 * np.hypot(J[:, 0, 0] - J[:, 1, 1], J[:, 1, 0] + J[:, 0, 1])
    return np.stack([a + b, np.abs(a - b)], axis=1)


def _scale(pair: EpipolarPair, H: F64, kept: list[B8], limits: FrameLimits) -> float:
    """Pixels of the frame per unit of H."""
    values = [singular_values(homography_jacobians(H[s], pair.regions[s][kept[s]])) for s in (0, 1)]
    found = np.concatenate(values)
    if len(found) == 0:
        raise StageFailure(
            "the rectified photographs have nothing in common", "", "choose views that overlap more"
        )
    area = float(np.exp(-0.5 * np.mean(np.log(found[:, 0] * found[:, 1]))))
    return max(area, 1.0 / (limits.max_shrink * float(found[:, 1].min())))


@dataclass(frozen=True)
class CommonOrientationRectifier:
    """Fusiello, Trucco and Verri, "A compact algorithm for rectification of stereo pairs", MVA 12(1), 2000.

    H = K R (K_i R_i)^-1 with x of the new orientation R along the baseline. They take the first camera's
    axis for the new one's plane; here it is the mean of both, so that neither photograph is turned more than
    it must. K is common but for the principal point: with the focal length f of the frame a point at depth z
    (in the new orientation) has the disparity f B / z less the difference of both origins.
    """

    limits: FrameLimits = field(default_factory=FrameLimits)

    def rectify(self, pair: EpipolarPair) -> PlanarRectification:
        """The two homographies; ``StageFailure`` without cameras and for infinite images."""
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


SEARCH = 96
"""Lines at infinity that are tried before the best one is refined."""


@dataclass(frozen=True)
class HartleyRectifier:
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
        if len(pair.xy1) < MIN_MATCHES:
            raise StageFailure("Hartley's rectification needs matches", f"{len(pair.xy1)} are given", "")
        low, high = admissible_lines(pair)
        middle = pair.pencil.centres[1][None]
        phi = float(pair.pencil.angles(1, middle, about=0.5 * (low + high))[0])
        rows = pencil_rows(pair, phi, infinite=_perpendicular(pair, phi))
        require_in_front(pair, rows)
        v, w = rows[1]
        # With v a similarity about the centre, the origin of places.
        second = np.array([v[1], -v[0], 0.0])
        z1, z2 = (homogenize(pair.pencil.normalized(s, xy)) for s, xy in enumerate(pair.matches))
        design = z1 / (z1 @ rows[0, 1])[:, None]
        first = np.linalg.lstsq(design, z2 @ second / (z2 @ w), rcond=None)[0]
        return crop_and_scale(pair, homographies_of_rows(pair, np.stack([first, second]), rows), self.limits)


def _perpendicular(pair: EpipolarPair, phi: float) -> float:
    """The plane above phi that view 2 sees as the line through the epipole square to that to its centre."""
    e = pair.pencil.epipole(1)
    at_infinity = abs(e[2]) < 1e-12 * np.hypot(e[0], e[1])
    # The centre is the origin of places. Of an epipole at infinity it is the line at infinity itself.
    line = np.array([0.0, 0.0, 1.0] if at_infinity else [e[0], e[1], -(e[0] ** 2 + e[1] ** 2) / e[2]])
    p = np.linalg.lstsq(pair.pencil.lines[1], line, rcond=None)[0]
    return phi + float(np.mod(np.arctan2(p[1], p[0]) - phi, np.pi))


@dataclass(frozen=True)
class LoopZhangRectifier:
    """Loop and Zhang, "Computing rectifying homographies for stereo vision", CVPR 1999.

    The line at infinity is the one for which the third coordinate varies least over both images: the sum of
    w'PP'w / w'p p'w, the variance of w'x over its squared mean. The similarity and the shear then make the
    affine part square. Departures: variances are those over what both photographs see, not over all pixels;
    the minimum over the one-parameter pencil is searched over all of it, not descended to from a guess.
    """

    limits: FrameLimits = field(default_factory=FrameLimits)

    def rectify(self, pair: EpipolarPair) -> PlanarRectification:
        """The two homographies; ``StageFailure`` where they cannot be."""
        rows = pencil_rows(pair, loop_zhang_line(pair))
        return crop_and_scale(pair, homographies_of_rows(pair, affine_rows(pair, rows), rows), self.limits)


@dataclass(frozen=True)
class MinimumDistortionRectifier:
    """The planar rectification of least ``RectificationQuality.distortion``.

    Line at infinity, scale along the rows and shear of either side (5 unknowns; least squares from those of
    :class:`LoopZhang`): the variance of the log singular values of both homographies, symmetric in growing
    and shrinking, and a quarter of the mean squared gradient of the disparities. Between Hartley, who makes
    the first photograph like the second, and Loop and Zhang, who spare either by itself: ``most_scale`` (log)
    and ``most_shear`` say by how much a photograph may give up its aspect and its right angles so that both
    sides become alike.
    """

    limits: FrameLimits = field(default_factory=FrameLimits)
    max_scale: float = 0.05
    max_shear: float = 0.06

    def __post_init__(self) -> None:
        if not (self.max_scale > 0.0 and self.max_shear > 0.0):
            raise ValueError(
                f"most_scale and most_shear must be positive; got {self.max_scale} and {self.max_shear}"
            )

    def rectify(self, pair: EpipolarPair) -> PlanarRectification:
        """The two homographies; ``StageFailure`` where they cannot be."""
        low, high = admissible_lines(pair)
        # Off the lines that touch what both see, where derivatives grow without bound.
        inset = 0.01 * (high - low)
        start = np.array(
            [np.clip(loop_zhang_line(pair), low + 2.0 * inset, high - 2.0 * inset), 0.0, 0.0, 0.0, 0.0]
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
    """First rows (2, 3) and the others (2, 2, 3) of phi, log scale and shear of either side (5,)."""
    rows = pencil_rows(pair, float(q[0]))
    return np.exp(q[1::2])[:, None] * affine_rows(pair, rows) + q[2::2, None] * rows[:, 0], rows


def _distortion_residuals(pair: EpipolarPair, first: F64, rows: F64) -> F64:
    """Numbers whose sum of squares is the squared distortion of homographies in places."""
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


def loop_zhang_line(pair: EpipolarPair) -> float:
    """The phi of Loop and Zhang's line at infinity, phi + pi/2: least variation of the third coordinate.

    ``StageFailure`` where every line crosses what both photographs see.
    """
    z = [homogenize(pair.pencil.normalized(s, pair.regions[s])) for s in (0, 1)]

    def variation(phi: float) -> float:
        third = [z[s] @ w for s, w in enumerate(pencil_rows(pair, phi)[:, 1])]
        return float(sum(np.var(t) / np.mean(t) ** 2 for t in third))

    phi = _search(pair, variation)
    require_in_front(pair, pencil_rows(pair, phi))
    return phi


def _search(pair: EpipolarPair, cost: Callable[[float], float]) -> float:
    """The phi of least ``cost`` among those that :func:`planes_in_reach`."""
    low, high = admissible_lines(pair)
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
