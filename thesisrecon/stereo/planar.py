"""Planar rectification: a homography for either photograph, and its frame.

Every pair of homographies that makes epipolar lines rows of equal number has, with a line at infinity
phi + pi/2 of the pencil, the rows v = -L p(phi) and w = L p(phi + pi/2), so that y = v'x / w'x is the tangent
of the angle of x less phi in both views exactly. Free are phi, one unit of length and the first rows: the
methods differ in these.

Planar rectification of two metric cameras: both turn about their centres to one common orientation.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from thesisrecon.arrays import B8, F32, F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import camera_centre, principal_ray
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.stereo.epipolar_pair import EpipolarPair, plane_of
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

    most_shrink: float = 1.4
    most_growth: float = 6.0

    def __post_init__(self) -> None:
        if not (self.most_shrink >= 1.0 and self.most_growth >= 1.0):
            raise ValueError(
                f"most_shrink and most_growth are at least 1; got {self.most_shrink}, {self.most_growth}"
            )

    def require(self, extent: F64, pair: EpipolarPair) -> tuple[int, int]:
        """The whole size of a frame, or ``StageFailure`` where it is too large, or has no pixels."""
        width, height = float(extent[0]), float(extent[1])
        most = self.most_growth * max(w * h for w, h in pair.sizes)
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
    v, w = plane_of(np.array([phi, phi + 0.5 * np.pi if infinite is None else infinite]))
    return np.stack([np.stack([-L @ v, L @ w]) for L in pair.pencil.lines])


def planes_in_reach(pair: EpipolarPair) -> tuple[float, float]:
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
        third = homogenize(pair.pencil.places(side, np.concatenate([samples, xy]))) @ rows[side, 1]
        if not third.min() > 1e-6 * third.max():
            raise StageFailure(
                "the line sent to infinity crosses the photographs",
                "an epipole lies in one of them or at its border",
                "rectify in polar coordinates",
            )


def undistorting_rows(pair: EpipolarPair, rows: F64) -> F64:
    """First rows (2, 3) for which the affine part of either homography is a similarity (Loop and Zhang 1999).

    Their shear keeps the midlines of a photograph square and of equal ratio; here the midlines are those of
    what both photographs see: the best affine map of its samples (least squares) gets two perpendicular rows
    of equal length. x' = alpha x_a + beta y' with any other coordinate x_a, and the condition is linear.
    """
    first = []
    for side in (0, 1):
        z = homogenize(pair.pencil.places(side, pair.regions[side]))
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
    H = np.concatenate([first[:, None], rows], axis=1) @ _to_places(pair)
    if pair.pencil.turned:
        H[:, :2] *= -1.0
    return H


def frame(pair: EpipolarPair, H: F64, limits: FrameLimits) -> PlanarRectification:
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


def _to_places(pair: EpipolarPair) -> F64:
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
    return max(area, 1.0 / (limits.most_shrink * float(found[:, 1].min())))


@dataclass(frozen=True)
class CommonOrientation:
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
        return frame(pair, np.asarray(orientation @ np.linalg.inv(P[:, :, :3])), self.limits)
