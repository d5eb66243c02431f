"""Rectification of image pairs by the method of least distortion (thesis, section 2.5).

All homographies that map epipolar lines to common rows have, with the line at infinity at phi + pi/2 of the
pencil, the rows v = -L p(phi) and w = L p(phi + pi/2): y = v'x / w'x is the tangent of the angle of x minus
phi in both views. The methods differ in phi, the unit of length and the first rows. Polar frames (Pollefeys,
Koch and Van Gool, ICCV 1999) have half epipolar lines as rows; they allow epipoles anywhere.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy

from thesisrecon.arrays import F32, F64, U8, Record, resizing_transform
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
    Size,
    common_crop,
    disparity_bounds,
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


@dataclass(frozen=True, eq=False)
class PlanarRectification(Rectification):
    """Homographies ``H`` (2, 3, 3) to a common rectified frame, with a positive third coordinate."""

    H: F64
    size: tuple[int, int]

    def reduced(self, scale: float) -> "PlanarRectification":
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
    """Rotate metric cameras to a common orientation: H = K R (K_i R_i)^-1, x axis of R along the baseline.

    Fusiello, Trucco and Verri (MVA 2000) use the viewing direction of the first camera; here it is the mean.
    """
    if pair.cameras is None:
        raise StageFailure.of("orientation-without-cameras")
    orientation = rotation_along_baseline(pair.cameras)
    return _crop_and_scale(pair, np.asarray(orientation @ np.linalg.inv(pair.cameras[:, :, :3])))


def rotation_along_baseline(P: F64) -> F64:
    """Rotation (3, 3) with the x axis along the baseline of two cameras (2, 3, 4) and z near both views."""
    baseline = np.diff(dehomogenize(camera_centre(P)), axis=0)[0]
    x = baseline / np.linalg.norm(baseline)
    axis = principal_ray(P).sum(axis=0)
    z = axis - (axis @ x) * x
    if not np.linalg.norm(z) > 1e-6:
        raise StageFailure.of("views-along-baseline")
    z = z / np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z])


def hartley(pair: EpipolarPair) -> PlanarRectification:
    """Rectify from F and matches (2.5; Hartley, IJCV 1999).

    The second image is mapped by G R T: rigidly about its centre except for the projective part that sends
    the epipole to infinity along x. That of the first is the compatible one with the least squared x
    differences of the matches, linear in its first row; the line at infinity is perpendicular to that through
    epipole and centre.
    """
    if len(pair.matches[0]) < MIN_MATCHES:
        raise StageFailure(Notice("rectification-without-matches"), f"{len(pair.matches[0])} are given")
    low, high = _admissible_lines(pair)
    middle = pair.pencil.centres[1][None]
    phi = float(pair.pencil.angles(1, middle, about=0.5 * (low + high))[0])
    # The line through the epipole perpendicular to that through the centre, which is the origin; for an
    # epipole at infinity it is the line at infinity.
    x, y, z = pair.pencil.epipole(1)
    line = np.array([0.0, 0.0, 1.0] if abs(z) < 1e-12 * np.hypot(x, y) else [x, y, -(x**2 + y**2) / z])
    p = np.linalg.lstsq(pair.pencil.lines[1], line, rcond=None)[0]
    rows = _pencil_rows(pair, phi, phi + float(np.mod(np.arctan2(p[1], p[0]) - phi, np.pi)))
    _require_in_front(pair, rows)
    v, w = rows[1]
    # A similarity about the image centre, the origin of normalised coordinates.
    second = np.array([v[1], -v[0], 0.0])
    z1, z2 = (homogenize(pair.pencil.normalized(s, xy)) for s, xy in enumerate(pair.matches))
    design = z1 / (z1 @ rows[0, 1])[:, None]
    first = np.linalg.lstsq(design, z2 @ second / (z2 @ w), rcond=None)[0]
    return _crop_and_scale(pair, _homographies_of_rows(pair, np.stack([first, second]), rows))


def loop_zhang(pair: EpipolarPair) -> PlanarRectification:
    """Rectify with least projective distortion (2.5; Loop and Zhang, CVPR 1999).

    The line at infinity minimises the sum of w'PP'w / w'p p'w (variance of w'x over its squared mean) of both
    images, here over the common field of view and globally. The affine part is made a similarity by a shear.
    """
    rows = _pencil_rows(pair, _loop_zhang_line(pair))
    return _crop_and_scale(pair, _homographies_of_rows(pair, _affine_rows(pair, rows), rows))


def minimum_distortion(pair: EpipolarPair) -> PlanarRectification:
    """Rectify with the least distortion (`RectificationQuality`), by least squares from :func:`loop_zhang`.

    Over the line at infinity and the scale and shear of both first rows: the variance of the log singular
    values of both homographies, plus a quarter of the mean squared disparity gradient.
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
        raise StageFailure.of("no-line-to-infinity")
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
        raise StageFailure.of("epipoles-inside")
    return high - 0.5 * np.pi, low + 0.5 * np.pi


def _require_in_front(pair: EpipolarPair, rows: F64) -> None:
    """Check that the line at infinity of rows (2, 2, 3) misses the common field of view."""
    for side, (xy, samples) in enumerate(zip(pair.matches, pair.regions, strict=True)):
        third = homogenize(pair.pencil.normalized(side, np.concatenate([samples, xy]))) @ rows[side, 1]
        if not third.min() > 1e-6 * third.max():
            evidence = "an epipole lies inside an image or at its border"
            raise StageFailure.of("infinite-line-inside", evidence)


def _affine_rows(pair: EpipolarPair, rows: F64) -> F64:
    """First rows (2, 3) that make the affine part of each homography a similarity (Loop and Zhang 1999)."""
    # The best affine approximation over the common field of view gets two perpendicular rows of equal length;
    # with x' = alpha x_a + beta y' and any other coordinate x_a the condition is linear.
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
        raise StageFailure.of("no-rectified-overlap", "")
    area = float(np.exp(-0.5 * np.mean(np.log(found[:, 0] * found[:, 1]))))
    scale = max(area, 1.0 / (MAX_SHRINK * float(found[:, 1].min())))
    size = frame_size(scale * (high - low).max(axis=0) + 1.0, pair)
    # Both origins have the same row; the narrower image leaves columns at the right empty.
    return PlanarRectification(scale_and_shift(scale, -scale * low) @ H, size)


def _mapped(H: F64, xy: F64) -> F64:
    xh = homogenize(xy) @ H.T
    if not (xh[:, 2] > 1e-9 * np.abs(xh[:, 2]).max(initial=0.0)).all() or np.linalg.det(H) <= 0.0:
        raise StageFailure.of("infinite-line-inside", "")
    return np.asarray(xh[:, :2] / xh[:, 2:])


@dataclass(frozen=True, eq=False)
class PolarRectification(Rectification):
    """Polar maps: row r shows the half-plane ``angles[r]``, with linear interpolation between rows.

    The point s px farther from the epipole than the image centre (nearer if the pencil is flipped) has the
    column ``scales[side]`` s + ``shears[side]`` r - ``origins[side]``.
    """

    pencil: EpipolarPencil
    angles: F64
    scales: F64
    shears: F64
    origins: F64
    size: tuple[int, int]

    def _original(self, side: int, xy: F64) -> F64:
        columns, rows = xy.T
        phi = np.interp(rows, *self._knots, left=np.nan, right=np.nan)
        return self._on_lines(side, phi, columns, rows)

    def _on_lines(self, side: int, phi: F64, columns: F64, rows: F64) -> F64:
        lines = self.pencil.half_lines(side, phi)
        along = (columns + self.origins[side] - self.shears[side] * rows) / self.scales[side]
        t = self._sign * along / self.pencil.units[side] + lines.sagitta
        pixels = self.pencil.pixels(side, lines.foot + t[..., None] * lines.direction)
        return np.where(lines.on_half(t)[..., None], pixels, np.nan)

    def _rectified(self, side: int, xy: F64) -> F64:
        phi = self.pencil.angles(side, xy, about=0.5 * float(self.angles[0] + self.angles[-1]))
        lines, (numbers, angles) = self.pencil.half_lines(side, phi), self._knots
        rows = np.interp(self._sign * phi, self._sign * angles, numbers, left=np.nan, right=np.nan)
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


def polar(pair: EpipolarPair, *, aligned: bool = True) -> PolarRectification:
    """Rectify in polar coordinates (2.5); ``aligned`` reduces the disparity gradients by shear and scale.

    Adjacent rows are at most one pixel apart in the middle of each half-line, and closer where its end would
    be reduced by more than ``MAX_SHRINK`` (1: no pixel is lost, as in the paper).
    """
    pencil, sign = pair.pencil, -1 if pair.pencil.flipped else 1
    # Half-planes over the arc, including those of the image corners, where the row spacing is extreme.
    samples, (start, end) = 4096, pair.arc
    corners, about = [image_corners(size) for size in pencil.sizes], 0.5 * (start + end)
    peaks = np.concatenate([pencil.angles(side, xy, about=about) for side, xy in enumerate(corners)])
    peaks = peaks[(peaks > start) & (peaks < end)]
    phi = np.unique(np.concatenate([np.linspace(start, end, samples), peaks]))
    both = [pencil.chords(side, phi) for side in (0, 1)]
    # Images of unequal resolution meet halfway, as in planar frames.
    unit = max(float(np.sqrt(pencil.units.prod())), float(pencil.units.max()) / MAX_SHRINK)
    scales = unit / pencil.units
    angles = _rows_of(pencil, phi, both, scales)[::sign]
    frame = PolarRectification(pencil, angles, scales, np.zeros(2), np.zeros(2), (1, len(angles)))
    left, right = matches_in_frame(frame, pair.matches, within=False)
    if aligned and len(left) >= MIN_MATCHES:
        max_log_scale, max_shear = 0.1, 0.06  # Limits of the alignment of the disparities along the rows
        # The disparity slope is the difference of the scales along x and of the shears along y.
        slope = disparity_gradients(left, right).mean(axis=0)
        scale = np.exp(np.clip(-slope[0], -max_log_scale, max_log_scale))
        shear = np.clip(-0.5 * slope[1], -max_shear, max_shear)
        scales = frame.scales * [max(scale, 1.0), max(1.0 / scale, 1.0)]
        frame = replace(frame, scales=scales, shears=np.array([shear, -shear]))
    ends = []
    for side, (lines, enter, leave) in enumerate(both):
        met = leave >= enter
        rim = [(lines.foot + t[:, None] * lines.direction)[met] for t in (enter, leave)]
        xy = frame.rectified_from_original(side, pencil.pixels(side, np.concatenate(rim)), within=False)
        ends.append(xy[np.isfinite(xy).all(axis=1)])
    low, high = common_crop(ends, matches_in_frame(frame, pair.matches, within=False))
    extent = np.array([(high - low)[:, 0].max() + 1.0, len(angles)])
    return replace(frame, origins=low[:, 0].copy(), size=frame_size(extent, pair))


def _rows_of(pencil: EpipolarPencil, phi: F64, both: list[tuple[HalfLines, F64, F64]], scales: F64) -> F64:
    """Angles of the rows, increasing (H,)."""
    per_radian = np.zeros(len(phi))
    for side, (lines, enter, leave) in enumerate(both):
        met = leave >= enter
        for t, shrink in ((0.5 * (enter + leave), 1.0), (enter, MAX_SHRINK), (leave, MAX_SHRINK)):
            at = np.where(met, t, 0.0)[:, None]
            sweep_rate = pencil.sweep_rate(side, phi, lines.foot + at * lines.direction) * pencil.units[side]
            # The ends of an image that is reduced as a whole keep their bound.
            sweep_rate = sweep_rate * (scales[side] if shrink == 1.0 else max(scales[side], 1.0))
            per_radian = np.maximum(per_radian, np.where(met, sweep_rate / shrink, 0.0))
    # The maximum of both ends bounds the reduction between the samples.
    each = np.maximum(per_radian[:-1], per_radian[1:]) * np.diff(phi)
    rows = np.concatenate([[0.0], np.cumsum(np.maximum(each, 1e-12))])
    count = max(int(np.ceil(rows[-1])) + 1, 2)
    return np.interp(np.linspace(0.0, rows[-1], count), rows, phi)


BENDING = 0.03  #: penalty of polar frames, which bend straight lines

Method = Callable[[EpipolarPair], Rectification]
PLANAR: tuple[Method, ...] = (hartley, loop_zhang, minimum_distortion)  #: methods from F with homographies
METHODS: tuple[Method, ...] = (*PLANAR, polar, common_orientation, partial(polar, aligned=False))
"""All methods; the common orientation needs cameras."""


@dataclass(frozen=True, eq=False)
class RectifiedImages(Record):
    """Two images whose rows correspond: x_right = x_left - d with disparities d >= 0."""

    left: F32  #: (H, W, 3) NaN outside the originals, as is ``right``
    right: F32
    max_disparity_px: float  #: largest disparity of the matches, with a margin
    frame: Rectification  #: maps between the images and the rectified frame
    shift: int  #: columns by which the right image was moved to the right or, if negative, the left one

    @classmethod
    def of(
        cls, frame: Rectification, images: tuple[U8 | F32, U8 | F32], disparities: tuple[int, int]
    ) -> "RectifiedImages":
        """Resample two images; one moves to the right by whole columns so that disparities begin at 0."""
        shift, (width, height) = disparities[0], frame.size
        moved = np.full((2, height, width + max(-shift, 0), 3), np.nan, dtype=np.float32)
        for side, image in enumerate(images):
            # Columns of the right image that are cut off correspond to none of the left one.
            place = moved[side, :, _moved_by(side, shift) :]
            # Cubic convolution exceeds the range of the levels.
            levels = np.clip(frame.warp(image.astype(np.float32), side), 0.0, 255.0)
            place[:, :width] = levels[:, : place.shape[1]]
        return cls(moved[0], moved[1], float(disparities[1] - shift), frame, shift)

    def rectified_from_original(self, side: int, xy: F64) -> F64:
        """Map pixels of an image (side 0 or 1) to the rectified one."""
        moved = self.frame.rectified_from_original(side, xy, within=False)
        return np.asarray(moved + np.array([_moved_by(side, self.shift), 0]))

    def original_from_rectified(self, side: int, xy: F64) -> F64:
        """Map pixels of a rectified image (side 0 or 1) to the original one."""
        places = np.asarray(xy - np.array([_moved_by(side, self.shift), 0]))
        return self.frame.original_from_rectified(side, places, within=False)


def _moved_by(side: int, shift: int) -> int:
    """Columns by which an image is moved: the right one by ``shift``, or the left one if it is negative."""
    return max(shift if side else -shift, 0)


@dataclass(frozen=True)
class RectificationQuality:
    """Distortion measures of a rectified pair; pairs of numbers refer to both images."""

    orthogonality_deg: tuple[float, float]  #: angle of the mapped image midlines
    aspect: tuple[float, float]  #: ratio of their lengths relative to the original
    size_ratio: float  #: pixels of the frame relative to the larger image
    min_scale: float  #: least local scale along any direction
    stretch: float  #: exp of the standard deviation of the log singular values, 1 for similarities
    disparity_slope: float  #: RMS gradient of the fitted disparities, NaN with fewer than 3 matches

    @property
    def distortion(self) -> float:
        """Root of the sum of squares of ``log stretch`` and half the ``disparity_slope``."""
        slope = self.disparity_slope if np.isfinite(self.disparity_slope) else 0.0
        return float(np.hypot(np.log(self.stretch), 0.5 * slope))


def measure_quality(rectification: Rectification, pair: EpipolarPair) -> RectificationQuality:
    """Measure the distortion of a rectification over the common field of view of a pair."""
    values, midlines = [], []
    for side, samples in enumerate(pair.regions):
        inside = np.isfinite(rectification.rectified_from_original(side, samples)).all(axis=1)
        J = jacobians(rectification, side, samples[inside])
        values.append(singular_values(J[np.isfinite(J).all(axis=(1, 2))]))
        midlines.append(_midlines(rectification, side, pair.pencil.sizes[side]))
    found = np.concatenate(values)
    found = found if len(found) else np.full((1, 2), np.nan)
    angles, aspects = zip(*midlines, strict=True)
    width, height = rectification.size
    left, right = matches_in_frame(rectification, pair.matches)
    slopes = disparity_gradients(left, right) if len(left) >= 3 else np.full((1, 2), np.nan)
    return RectificationQuality(
        orthogonality_deg=angles,
        aspect=aspects,
        size_ratio=width * height / max(w * h for w, h in pair.pencil.sizes),
        min_scale=float(found[:, 1].min()),
        stretch=float(np.exp(np.std(np.log(np.maximum(found, 1e-12))))),
        disparity_slope=float(np.sqrt(np.mean(np.sum(slopes**2, axis=1)))),
    )


def jacobians(rectification: Rectification, side: int, xy: F64) -> F64:
    """Numerical derivatives (N, 2, 2) of the map from pixels (N, 2) of an image to the frame."""
    step_px = 0.01  # Half step of numerical derivatives
    columns = []
    for axis in np.eye(2):
        ahead = rectification.rectified_from_original(side, xy + step_px * axis, within=False)
        step = ahead - rectification.rectified_from_original(side, xy - step_px * axis, within=False)
        # A full circle of half-lines has a cut, across which neighbours are far apart.
        step[np.abs(step[:, 1]) > 0.5 * rectification.size[1]] = np.nan
        columns.append(step / (2.0 * step_px))
    return np.stack(columns, axis=-1)


def _midlines(rectification: Rectification, side: int, size: Size) -> tuple[float, float]:
    """Angle in degrees of the mapped midlines, and the ratio of their lengths relative to the original."""
    w, h = size[0] - 1.0, size[1] - 1.0
    ends = np.array([[0.0, h / 2.0], [w, h / 2.0], [w / 2.0, 0.0], [w / 2.0, h]])
    a, b, c, d = rectification.rectified_from_original(side, ends, within=False)
    across, down = b - a, d - c
    lengths = float(np.hypot(*across)), float(np.hypot(*down))
    with np.errstate(invalid="ignore"):
        angle = float(np.degrees(np.arccos(np.clip(across @ down / (lengths[0] * lengths[1]), -1.0, 1.0))))
    return angle, lengths[0] / lengths[1] * h / w


def rectify(pair: EpipolarPair, methods: Sequence[Method] = METHODS) -> Rectification:
    """Return the rectification of least distortion, first of those within the angle and aspect limits."""
    found, failure = list[Rectification](), StageFailure(Notice("no-rectification-method"))
    for method in methods:
        try:
            found.append(method(pair))
        except StageFailure as reason:
            failure = reason
    if not found:
        raise failure
    return min(found, key=lambda frame: _cost(frame, measure_quality(frame, pair)))


def _cost(found: Rectification, quality: RectificationQuality) -> tuple[bool, float]:
    # Limits of the midline angle's deviation from 90 degrees, and of the change of the aspect ratio.
    max_turn_deg, max_aspect = 5.0, 0.1
    size_weight = 0.05  # Weight of the log of the relative frame size, which costs time
    # A midline through the epipole of a polar frame has no angle.
    turned = max((abs(a - 90.0) for a in quality.orthogonality_deg if np.isfinite(a)), default=0.0)
    aspect = max((abs(a - 1.0) for a in quality.aspect if np.isfinite(a)), default=0.0)
    bent = BENDING if isinstance(found, PolarRectification) else 0.0
    cost = quality.distortion + bent + size_weight * np.log(quality.size_ratio)
    return turned > max_turn_deg or aspect > max_aspect, float(cost)


def disparity_range(
    rectification: Rectification, xy1: F64, xy2: F64, *, margin: float = 0.15
) -> tuple[int, int]:
    """First and last disparity to search, from matches; ``StageFailure`` if none is in the frame."""
    left, right = matches_in_frame(rectification, (xy1, xy2))
    if len(left) == 0:
        raise StageFailure.of("unknown-disparity-range")
    low, high = disparity_bounds(left[:, 0] - right[:, 0], margin=margin)
    return int(np.floor(low)) - 2, int(np.ceil(high)) + 2
