"""Rectified frames of a pair: homographies (planar), and half epipolar lines as rows (polar).

All homographies that map epipolar lines to common rows have, with the line at infinity at phi + pi/2 of the
pencil, the rows v = -L p(phi) and w = L p(phi + pi/2), so that y = v'x / w'x is the tangent of the angle of x
minus phi in both views. Free parameters are phi, a unit of length and the first rows; the methods differ in
their choice. Polar frames (Pollefeys, Koch and Van Gool, "A simple and efficient rectification method for
general motion", ICCV 1999) allow epipoles anywhere, and their size is bounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from thesisrecon.arrays import F64, resizing_transform
from thesisrecon.errors import Notice, StageFailure
from thesisrecon.geometry.camera_matrix import camera_centre, principal_ray
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize, map_in_front
from thesisrecon.imaging.resampling import Rectification
from thesisrecon.stereo._epipolar_pair import (
    MAX_SHRINK,
    MIN_MATCHES,
    EpipolarPair,
    EpipolarPencil,
    HalfLines,
    common_crop,
    frame_size,
    image_corners,
    plane_from_angle,
    scale_and_shift,
)


def matches_in_frame(
    rectification: Rectification, matches: Sequence[F64], *, within: bool = True
) -> tuple[F64, F64]:
    """Positions in the frame (M, 2) of the matches, two arrays (N, 2), that are mapped in both images."""
    mapped = rectification.rectified_from_original
    left, right = (mapped(side, xy, within=within) for side, xy in enumerate(matches))
    seen = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
    return left[seen], right[seen]


def disparity_gradients(left: F64, right: F64) -> F64:
    """Gradients (M, 2) of a quadratic polynomial fitted to the disparities of matches (N, 2), M <= 300."""
    max_matches = 300  # Limit of the number of matches to which disparity gradients are fitted
    every = max(len(left) // max_matches, 1)
    left, right = left[::every], right[::every]
    middle = 0.5 * (left + right)
    middle = middle - middle.mean(axis=0)
    unit = float(np.abs(middle).max(initial=1e-12))
    x, y = (middle / unit).T
    design = np.stack([x, y, x * x, x * y, y * y, np.ones_like(x)], axis=1)
    # Minimum-norm solution for few or collinear matches.
    c = np.linalg.lstsq(design, (left[:, 0] - right[:, 0]) / unit, rcond=1e-6)[0]
    return np.stack([c[0] + 2.0 * c[2] * x + c[3] * y, c[1] + c[3] * x + 2.0 * c[4] * y], axis=1)


def homography_jacobians(H: F64, xy: F64) -> F64:
    """Derivatives (N, 2, 2) of a homography at positions (N, 2)."""
    xh = homogenize(xy) @ H.T
    moved = xh[:, :2] / xh[:, 2:]
    return np.asarray((H[None, :2, :2] - moved[:, :, None] * H[2, :2]) / xh[:, 2, None, None])


def singular_values(J: F64) -> F64:
    """Singular values (N, 2) of 2 x 2 matrices, the larger first."""
    a = 0.5 * np.hypot(J[:, 0, 0] + J[:, 1, 1], J[:, 1, 0] - J[:, 0, 1])
    b = 0.5 * np.hypot(J[:, 0, 0] - J[:, 1, 1], J[:, 1, 0] + J[:, 0, 1])
    return np.stack([a + b, np.abs(a - b)], axis=1)


@dataclass(frozen=True)
class PlanarRectification(Rectification):
    """Homographies ``H`` (2, 3, 3) to a common rectified frame, with a positive third coordinate."""

    H: F64
    size: tuple[int, int]

    def reduced(self, scale: float) -> PlanarRectification:
        width, height = (max(2, int(np.ceil(scale * side))) for side in self.size)
        return PlanarRectification(resizing_transform(scale) @ self.H, (width, height))

    def _original(self, side: int, xy: F64) -> F64:
        return map_in_front(np.linalg.inv(self.H[side]), xy)

    def _rectified(self, side: int, xy: F64) -> F64:
        return map_in_front(self.H[side], xy)

    def _lookup(self, side: int, rows: range) -> F64:
        G = np.linalg.inv(self.H[side])
        x, y = np.arange(float(self.size[0])), np.arange(rows.start, rows.stop, dtype=np.float64)
        u, v, w = (np.add.outer(row[1] * y + row[2], row[0] * x) for row in G)
        with np.errstate(divide="ignore", invalid="ignore"):
            w = np.where(w > 0.0, 1.0 / w, np.nan)
        return np.stack([u * w, v * w], axis=-1)


def common_orientation(pair: EpipolarPair) -> PlanarRectification:
    """Rotate metric cameras about their centres to a common orientation.

    H = K R (K_i R_i)^-1 with the x axis of R along the baseline. Fusiello, Trucco and Verri (MVA 2000) use
    the viewing direction of the first camera; here it is the mean of both. K is common except for the
    principal point, so a point at depth z in the new orientation has the disparity f B / z minus the
    difference of the origins.
    """
    if pair.cameras is None:
        raise StageFailure("a common orientation needs metric cameras", advice="rectify from F")
    P = pair.cameras
    baseline = np.diff(dehomogenize(camera_centre(P)), axis=0)[0]
    x = baseline / np.linalg.norm(baseline)
    axis = principal_ray(P).sum(axis=0)
    z = axis - (axis @ x) * x
    if not np.linalg.norm(z) > 1e-6:
        raise StageFailure("both cameras look along the baseline", advice="rectify in polar coordinates")
    z = z / np.linalg.norm(z)
    orientation = np.stack([x, np.cross(z, x), z])
    return _crop_and_scale(pair, np.asarray(orientation @ np.linalg.inv(P[:, :, :3])))


def hartley(pair: EpipolarPair) -> PlanarRectification:
    """Rectify from F and matches (2.5; Hartley, IJCV 1999).

    The second image is mapped by G R T: rigidly about its centre except for the projective part that sends
    the epipole to infinity along x. The homography of the first is the compatible one with the least sum of
    squared x differences of the matches. In the pencil the line at infinity is perpendicular to the line
    through epipole and centre, and the least squares are linear in the first row.
    """
    if len(pair.matches[0]) < MIN_MATCHES:
        raise StageFailure(Notice("rectification-without-matches"), f"{len(pair.matches[0])} are given")
    low, high = _admissible_lines(pair)
    middle = pair.pencil.centres[1][None]
    phi = float(pair.pencil.angles(1, middle, about=0.5 * (low + high))[0])
    rows = _pencil_rows(pair, phi, _perpendicular(pair, phi))
    _require_in_front(pair, rows)
    v, w = rows[1]
    # A similarity about the image centre, the origin of normalised coordinates.
    second = np.array([v[1], -v[0], 0.0])
    z1, z2 = (homogenize(pair.pencil.normalized(s, xy)) for s, xy in enumerate(pair.matches))
    design = z1 / (z1 @ rows[0, 1])[:, None]
    first = np.linalg.lstsq(design, z2 @ second / (z2 @ w), rcond=None)[0]
    return _crop_and_scale(pair, _homographies_of_rows(pair, np.stack([first, second]), rows))


def _perpendicular(pair: EpipolarPair, phi: float) -> float:
    """Plane of the line through the epipole of view 2 perpendicular to that through its centre."""
    e = pair.pencil.epipole(1)
    at_infinity = abs(e[2]) < 1e-12 * np.hypot(e[0], e[1])
    # The centre is the origin. For an epipole at infinity it is the line at infinity.
    line = np.array([0.0, 0.0, 1.0] if at_infinity else [e[0], e[1], -(e[0] ** 2 + e[1] ** 2) / e[2]])
    p = np.linalg.lstsq(pair.pencil.lines[1], line, rcond=None)[0]
    return phi + float(np.mod(np.arctan2(p[1], p[0]) - phi, np.pi))


def loop_zhang(pair: EpipolarPair) -> PlanarRectification:
    """Rectify with least projective distortion (2.5; Loop and Zhang, CVPR 1999).

    The line at infinity minimises the variation of the third coordinate over both images, the sum of w'PP'w /
    w'p p'w (variance of w'x over its squared mean). Similarity and shear make the affine part a similarity.
    Departures: variances are taken over the common field of view, and the one-parameter minimum is searched
    globally instead of descending from an initial guess.
    """
    rows = _pencil_rows(pair, _loop_zhang_line(pair))
    return _crop_and_scale(pair, _homographies_of_rows(pair, _affine_rows(pair, rows), rows))


def minimum_distortion(pair: EpipolarPair) -> PlanarRectification:
    """Rectify with the least distortion (`thesisrecon.stereo.rectification.RectificationQuality`).

    Least squares over the line at infinity and the scale and shear of both first rows (5 parameters), from
    the solution of :func:`loop_zhang`: the variance of the log singular values of both homographies,
    symmetric in enlargement and reduction, plus a quarter of the mean squared disparity gradient. Hartley
    makes the first image similar to the second, Loop and Zhang preserve each by itself; this is a compromise.
    """
    precision = 1e-4  # Relative change of the distortion and of its parameters at which the descent ends
    max_log_scale, max_shear = 0.05, 0.06  # Limits of the least-squares adjustment of the first rows
    low, high = _admissible_lines(pair)
    # Keep away from lines that touch the field of view, where derivatives are unbounded.
    inset = 0.01 * (high - low)
    start = np.zeros(5)
    start[0] = np.clip(_loop_zhang_line(pair), low + 2.0 * inset, high - 2.0 * inset)
    bound = np.array([max_log_scale, max_shear, max_log_scale, max_shear])
    found = scipy.optimize.least_squares(
        lambda q: _distortion_residuals(pair, *_adjusted(pair, q)),
        start,
        bounds=(np.append(low + inset, -bound), np.append(high - inset, bound)),
        max_nfev=40,
        ftol=precision,
        xtol=precision,
    )
    return _crop_and_scale(pair, _homographies_of_rows(pair, *_adjusted(pair, found.x)))


def _adjusted(pair: EpipolarPair, q: F64) -> tuple[F64, F64]:
    """First rows (2, 3) and other rows (2, 2, 3) for phi, log scales and shears (5,)."""
    rows = _pencil_rows(pair, float(q[0]))
    return np.exp(q[1::2])[:, None] * _affine_rows(pair, rows) + q[2::2, None] * rows[:, 0], rows


def _distortion_residuals(pair: EpipolarPair, first: F64, rows: F64) -> F64:
    """Residuals whose sum of squares is the squared distortion of homographies in normalised coordinates."""
    H = np.concatenate([first[:, None], rows], axis=1)
    logs = []
    for side in (0, 1):
        J = homography_jacobians(H[side], pair.pencil.normalized(side, pair.regions[side]))
        logs.append(np.log(np.maximum(singular_values(J), 1e-9) / pair.pencil.units[side]).ravel())
    every = np.concatenate(logs)
    residuals = (every - every.mean()) / np.sqrt(len(every))
    if len(pair.matches[0]) < MIN_MATCHES:
        return np.asarray(residuals)
    moved = [homogenize(pair.pencil.normalized(s, xy)) @ H[s].T for s, xy in enumerate(pair.matches)]
    left, right = (xh[:, :2] / xh[:, 2:] for xh in moved)
    slopes = disparity_gradients(left, right)
    return np.concatenate([residuals, 0.5 * slopes.ravel() / np.sqrt(len(slopes))])


def _loop_zhang_line(pair: EpipolarPair) -> float:
    """phi of Loop and Zhang's line at infinity phi + pi/2: least variation of the third coordinate."""
    search = 96  # Lines at infinity that are tried before the best is refined
    z = [homogenize(pair.pencil.normalized(s, pair.regions[s])) for s in (0, 1)]

    def variation(phi: F64) -> F64:
        w = plane_from_angle(phi + 0.5 * np.pi)
        third = [z[s] @ (pair.pencil.lines[s] @ w.T) for s in (0, 1)]
        return np.asarray(sum(np.var(t, axis=0) / np.mean(t, axis=0) ** 2 for t in third))

    low, high = _admissible_lines(pair)
    # At the ends the line at infinity touches the field of view.
    tried = low + (high - low) * (np.arange(search) + 0.5) / search
    with np.errstate(all="ignore"):
        costs = variation(tried)
    if not np.isfinite(costs).any():
        raise StageFailure("no line can be sent to infinity", advice="rectify in polar coordinates")
    k, step = int(np.nanargmin(costs)), (high - low) / search
    bounds = max(low, tried[k] - step), min(high, tried[k] + step)
    found = scipy.optimize.minimize_scalar(variation, bounds=bounds, method="bounded")
    phi = float(found.x) if found.fun <= costs[k] else float(tried[k])
    _require_in_front(pair, _pencil_rows(pair, phi))
    return phi


def _pencil_rows(pair: EpipolarPair, phi: float, infinite: float | None = None) -> F64:
    """Rows 1 and 2 (2, 2, 3) of both homographies; the line of ``infinite`` is sent to infinity."""
    v, w = plane_from_angle(np.array([phi, phi + 0.5 * np.pi if infinite is None else infinite]))
    return np.stack([np.stack([-L @ v, L @ w]) for L in pair.pencil.lines])


def _admissible_lines(pair: EpipolarPair) -> tuple[float, float]:
    """Interval of phi whose line at infinity misses the common field of view."""
    low, high = pair.arc
    if not high - low < np.pi - 1e-6:
        evidence = "every epipolar line crosses the common field of view"
        raise StageFailure("the epipoles lie inside the images", evidence, "rectify in polar coordinates")
    return high - 0.5 * np.pi, low + 0.5 * np.pi


def _require_in_front(pair: EpipolarPair, rows: F64) -> None:
    """Check that the line at infinity of rows (2, 2, 3) misses the common field of view."""
    for side, (xy, samples) in enumerate(zip(pair.matches, pair.regions, strict=True)):
        third = homogenize(pair.pencil.normalized(side, np.concatenate([samples, xy]))) @ rows[side, 1]
        if not third.min() > 1e-6 * third.max():
            reason = "the line sent to infinity crosses the images"
            evidence = "an epipole lies inside an image or at its border"
            raise StageFailure(reason, evidence, "rectify in polar coordinates")


def _affine_rows(pair: EpipolarPair, rows: F64) -> F64:
    """First rows (2, 3) that make the affine part of each homography a similarity (Loop and Zhang 1999).

    Their shear keeps the image midlines perpendicular and of equal ratio. Here the best affine approximation
    over the common field of view (least squares) gets two perpendicular rows of equal length; with x' = alpha
    x_a + beta y' and any other coordinate x_a the condition is linear.
    """
    first = []
    for side in (0, 1):
        z = homogenize(pair.pencil.normalized(side, pair.regions[side]))
        v, w = rows[side]
        middle = z - z.mean(axis=0)
        third = z @ w
        x_a = np.cross(v, w)
        mapped = np.stack([z @ x_a, z @ v], axis=1) / third[:, None]
        g_a, g_v = np.linalg.lstsq(middle[:, :2], mapped, rcond=None)[0].T
        # Preserve the orientation.
        alpha, beta = np.linalg.solve(np.stack([g_a, g_v], axis=1), np.array([g_v[1], -g_v[0]]))
        first.append(alpha * x_a + beta * v)
    return np.stack(first)


def _homographies_of_rows(pair: EpipolarPair, first: F64, rows: F64) -> F64:
    """Homographies of pixels (2, 3, 3) from first rows (2, 3) and other rows (2, 2, 3), normalised."""
    H = np.concatenate([first[:, None], rows], axis=1) @ pair.pencil.normalization
    if pair.pencil.flipped:
        H[:, :2] *= -1.0
    return H


def _crop_and_scale(pair: EpipolarPair, H: F64) -> PlanarRectification:
    """Scale homographies of pixels (2, 3, 3) and crop the frame to the common field of view."""
    samples = [_mapped(H[side], xy) for side, xy in enumerate(pair.regions)]
    low, high = common_crop(samples, [_mapped(H[side], xy) for side, xy in enumerate(pair.matches)])
    values = []
    for side, xy in enumerate(samples):
        inside = np.all((xy >= low[side]) & (xy <= high[side]), axis=1)
        values.append(singular_values(homography_jacobians(H[side], pair.regions[side][inside])))
    found = np.concatenate(values)
    if len(found) == 0:
        raise StageFailure("the rectified images do not overlap", advice="choose views that overlap more")
    area = float(np.exp(-0.5 * np.mean(np.log(found[:, 0] * found[:, 1]))))
    scale = max(area, 1.0 / (MAX_SHRINK * float(found[:, 1].min())))
    size = frame_size(scale * (high - low).max(axis=0) + 1.0, pair)
    # Both origins have the same row; the narrower image leaves columns at the right empty.
    return PlanarRectification(scale_and_shift(scale, -scale * low) @ H, size)


def _mapped(H: F64, xy: F64) -> F64:
    xh = homogenize(xy) @ H.T
    if not (xh[:, 2] > 1e-9 * np.abs(xh[:, 2]).max(initial=0.0)).all() or np.linalg.det(H) <= 0.0:
        reason = "the line sent to infinity crosses the images"
        raise StageFailure(reason, advice="rectify in polar coordinates")
    return np.asarray(xh[:, :2] / xh[:, 2:])


@dataclass(frozen=True)
class PolarRectification(Rectification):
    """Polar maps of two images to a common rectified frame.

    Row r shows the half-plane ``angles[r]``, with linear interpolation between rows. The point s px farther
    from the epipole than the image centre (nearer if the pencil is flipped) has the column ``scales[side]`` s
    + ``shears[side]`` r - ``origins[side]``.
    """

    pencil: EpipolarPencil
    angles: F64
    scales: F64
    shears: F64
    origins: F64
    size: tuple[int, int]

    def _original(self, side: int, xy: F64) -> F64:
        columns, rows = xy.T
        return self._on_lines(side, self._angle_of(rows), columns, rows)

    def _on_lines(self, side: int, phi: F64, columns: F64, rows: F64) -> F64:
        lines = self.pencil.half_lines(side, phi)
        along = (columns + self.origins[side] - self.shears[side] * rows) / self.scales[side]
        t = self._sign * along / self.pencil.units[side] + lines.sagitta
        pixels = self.pencil.pixels(side, lines.foot + t[..., None] * lines.direction)
        return np.where(lines.on_half(t)[..., None], pixels, np.nan)

    def _rectified(self, side: int, xy: F64) -> F64:
        phi = self.pencil.angles(side, xy, about=0.5 * float(self.angles[0] + self.angles[-1]))
        lines, rows = self.pencil.half_lines(side, phi), self._row_of(phi)
        t = np.sum(self.pencil.normalized(side, xy) * lines.direction, axis=1)
        along = self._sign * self.pencil.units[side] * (t - lines.sagitta)
        columns = self.scales[side] * along + self.shears[side] * rows - self.origins[side]
        return np.stack([columns, rows], axis=1)

    def _lookup(self, side: int, rows: range) -> F64:
        phi, number = self.angles[rows.start : rows.stop, None], np.array(rows, dtype=np.float64)[:, None]
        return self._on_lines(side, phi, np.arange(float(self.size[0])), number)

    @property
    def _sign(self) -> float:
        return -1.0 if self.pencil.flipped else 1.0

    @property
    def _knots(self) -> tuple[F64, F64]:
        """Numbers and angles of the rows, continued by half a row at both ends; not defined beyond."""
        a, count = self.angles, len(self.angles)
        ends = 1.5 * a[[0, -1]] - 0.5 * a[[1, -2]]
        return np.clip(np.arange(-1.0, count + 1.0), -0.5, count - 0.5), np.array([ends[0], *a, ends[1]])

    def _angle_of(self, rows: F64) -> F64:
        """Angles of rows (N,), which may be fractional."""
        return np.interp(rows, *self._knots, left=np.nan, right=np.nan)

    def _row_of(self, phi: F64) -> F64:
        rows, angles = self._knots
        return np.interp(self._sign * phi, self._sign * angles, rows, left=np.nan, right=np.nan)


def polar(pair: EpipolarPair, *, aligned: bool = True) -> PolarRectification:
    """Rectify in polar coordinates with bounded reduction (2.5).

    Adjacent rows are at most one pixel apart in the middle of each half-line, and closer where its end would
    be reduced by more than ``MAX_SHRINK`` (1: no pixel is lost, as in the paper). The row spacing is a
    function of the angle whose integral counts the rows, instead of walking from line to line.

    ``aligned`` reduces the disparity gradients of the matches by shear and scale along the rows.
    """
    pencil, sign = pair.pencil, -1 if pair.pencil.flipped else 1
    phi = _half_planes(pair)
    both = [pencil.chords(side, phi) for side in (0, 1)]
    angles = _rows_of(pencil, phi, both)[::sign]
    frame = PolarRectification(pencil, angles, np.ones(2), np.zeros(2), np.zeros(2), (1, len(angles)))
    frame = _align_disparities(frame, pair) if aligned else frame
    ends = []
    for side, (lines, enter, leave) in enumerate(both):
        met = leave >= enter
        rim = [(lines.foot + t[:, None] * lines.direction)[met] for t in (enter, leave)]
        xy = frame.rectified_from_original(side, pencil.pixels(side, np.concatenate(rim)), within=False)
        ends.append(xy[np.isfinite(xy).all(axis=1)])
    low, high = common_crop(ends, matches_in_frame(frame, pair.matches, within=False))
    extent = np.array([(high - low)[:, 0].max() + 1.0, len(angles)])
    return replace(frame, origins=low[:, 0].copy(), size=frame_size(extent, pair))


def _align_disparities(frame: PolarRectification, pair: EpipolarPair) -> PolarRectification:
    max_log_scale, max_shear = 0.1, 0.06  # Limits of the alignment of the disparities along the rows
    left, right = matches_in_frame(frame, pair.matches, within=False)
    if len(left) < MIN_MATCHES:
        return frame
    # The disparity slope is the difference of the scales along x and of the shears along y.
    slope = disparity_gradients(left, right).mean(axis=0)
    scale = np.exp(np.clip(-slope[0], -max_log_scale, max_log_scale))
    shear = np.clip(-0.5 * slope[1], -max_shear, max_shear)
    scales = np.array([max(scale, 1.0), max(1.0 / scale, 1.0)])
    return replace(frame, scales=scales, shears=np.array([shear, -shear]))


def _half_planes(pair: EpipolarPair) -> F64:
    """Angles over the arc, including those of the image corners, where the row spacing is extreme."""
    angles = 4096  # Number of half-planes at which the row spacing is computed
    low, high = pair.arc
    corners, about = [image_corners(size) for size in pair.pencil.sizes], 0.5 * (low + high)
    peaks = np.concatenate([pair.pencil.angles(side, xy, about=about) for side, xy in enumerate(corners)])
    return np.unique(np.concatenate([np.linspace(low, high, angles), peaks[(peaks > low) & (peaks < high)]]))


def _rows_of(pencil: EpipolarPencil, phi: F64, both: list[tuple[HalfLines, F64, F64]]) -> F64:
    """Angles of the rows, increasing (H,)."""
    per_radian = np.zeros(len(phi))
    for side, (lines, enter, leave) in enumerate(both):
        met = leave >= enter
        for t, shrink in ((0.5 * (enter + leave), 1.0), (enter, MAX_SHRINK), (leave, MAX_SHRINK)):
            at = np.where(met, t, 0.0)[:, None]
            sweep_rate = pencil.sweep_rate(side, phi, lines.foot + at * lines.direction) * pencil.units[side]
            per_radian = np.maximum(per_radian, np.where(met, sweep_rate / shrink, 0.0))
    # The maximum of both ends bounds the reduction between the samples.
    each = np.maximum(per_radian[:-1], per_radian[1:]) * np.diff(phi)
    rows = np.concatenate([[0.0], np.cumsum(np.maximum(each, 1e-12))])
    count = max(int(np.ceil(rows[-1])) + 1, 2)
    return np.interp(np.linspace(0.0, rows[-1], count), rows, phi)
