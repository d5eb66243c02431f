"""Epipolar pencils of image pairs and extent of rectified frames.

p = (cos phi, sin phi) of an epipolar plane is imaged as the line L p with L (3, 2) per view. A pixel lies in
a half-plane: phi covers the full circle (Pollefeys, Koch and Van Gool, ICCV 1999), for any epipole.
Normalised coordinates are z = (x - centre) / unit with a unit of about one focal length.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from thesisrecon.arrays import F64, checked
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.camera_matrix import camera_centre, depth, project
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize, unit_normals
from thesisrecon.geometry.two_view import (
    canonical_cameras,
    fundamental_from_cameras,
    infinite_homography,
    quasi_euclidean_planes,
    require_parallax_of_matches,
)
from thesisrecon.optimize.bundle.partial import triangulate_points

Size = tuple[int, int]  #: width and height in pixels
_J = np.array([[0.0, -1.0], [1.0, 0.0]])
MIN_MATCHES = 8
MAX_SHRINK = 1.4  #: largest reduction of any pixel along any direction; the area is preserved on average
MAX_GROWTH = 6.0  #: largest number of pixels of the frame relative to the larger image


@dataclass(frozen=True)
class EpipolarPencil:
    """Epipolar lines of two views, parametrised by the angle phi of the epipolar plane."""

    lines: F64  #: (2, 3, 2) L of each view in normalised coordinates; matches have equal phi
    centres: F64  #: (2, 2) in pixels
    units: F64  #: (2,) in pixels
    sizes: tuple[Size, Size]
    flipped: bool = False
    """Rows run against phi and columns against the half-lines, so that larger disparities are nearer."""

    @property
    def normalization(self) -> F64:
        """Homographies (2, 3, 3) from pixels to normalised coordinates."""
        return scale_and_shift(1.0 / self.units, -self.centres / self.units[:, None])

    @property
    def fundamental(self) -> F64:
        """F (3, 3) in normalised coordinates."""
        return np.asarray(self.lines[1] @ _J.T @ self.lines[0].T)

    def normalized(self, side: int, xy: F64) -> F64:
        """Convert pixels (..., 2) to normalised coordinates."""
        return np.asarray((xy - self.centres[side]) / self.units[side])

    def pixels(self, side: int, z: F64) -> F64:
        """Convert normalised coordinates (..., 2) to pixels."""
        return np.asarray(z * self.units[side] + self.centres[side])

    def epipole(self, side: int) -> F64:
        """Homogeneous normalised coordinates (3,) of the epipole; the third is 0 at infinity."""
        return np.asarray(np.cross(self.lines[side, :, 0], self.lines[side, :, 1]))

    def planes(self, side: int, xy: F64) -> F64:
        """Half-planes of pixels (..., 2): vectors p of any positive length."""
        L = self.lines[side]
        q = self.normalized(side, xy) @ L[:2] + L[2]
        return np.stack([q[..., 1], -q[..., 0]], axis=-1)

    def angles(self, side: int, xy: F64, *, about: float = 0.0) -> F64:
        """Angles phi (...) of the half-planes of pixels (..., 2) within pi of ``about``."""
        p = self.planes(side, xy)
        c, s = np.cos(about), np.sin(about)
        return np.asarray(about + np.arctan2(c * p[..., 1] - s * p[..., 0], c * p[..., 0] + s * p[..., 1]))

    def half_lines(self, side: int, phi: F64) -> "HalfLines":
        """Half epipolar lines of angles (...)."""
        l, e = unit_normals(plane_from_angle(phi) @ self.lines[side].T), self.epipole(side)
        e = e / max(np.hypot(e[0], e[1]), abs(e[2]))
        along = np.stack([-l[..., 1], l[..., 0]], axis=-1)
        return HalfLines(-l[..., 2:] * l[..., :2], along, l[..., 2], e)

    def chords(self, side: int, phi: F64) -> "tuple[HalfLines, F64, F64]":
        """Half-lines of angles (N,), and where they enter and leave the image; entry > exit if they miss."""
        lines, last = self.half_lines(side, phi), np.array(self.sizes[side]) - 1.0
        low, high = self.normalized(side, np.zeros(2)), self.normalized(side, last)
        with np.errstate(divide="ignore", invalid="ignore"):
            one, two = (low - lines.foot) / lines.direction, (high - lines.foot) / lines.direction
        inside = (lines.foot >= low) & (lines.foot <= high)
        parallel = lines.direction == 0.0
        enter = np.where(parallel, np.where(inside, -np.inf, np.inf), np.minimum(one, two)).max(axis=1)
        leave = np.where(parallel, np.where(inside, np.inf, -np.inf), np.maximum(one, two)).min(axis=1)
        if lines.epipole[2] < 0.0:
            leave = np.minimum(leave, lines.start)
        else:
            enter = np.maximum(enter, lines.start)
        # A line beside the image that is parallel to its border would enter at infinity.
        met = leave >= enter
        return lines, np.where(met, enter, 0.0), np.where(met, leave, -1.0)

    def sweep_rate(self, side: int, phi: F64, z: F64) -> F64:
        """Motion (N,) of epipolar lines across their points z (N, 2) per radian, normalised."""
        p = plane_from_angle(phi)
        l, moving = p @ self.lines[side].T, p @ (self.lines[side] @ _J).T
        motion = np.abs(np.sum(moving[:, :2] * z, axis=1) + moving[:, 2])
        return np.asarray(motion / np.linalg.norm(l[:, :2], axis=1))


@dataclass(frozen=True)
class HalfLines:
    """Half epipolar lines of a view in normalised coordinates; d(z - e) grows along the ``direction``."""

    foot: F64  #: (..., 2) nearest to the image centre
    direction: F64  #: (..., 2) unit vectors
    distance: F64  #: (...) of the foot from the centre
    epipole: F64  #: (3,)

    @property
    def sagitta(self) -> F64:
        """(...) distance of each foot from the circle about the epipole through the centre."""
        # D (1 - cos alpha) with the epipole's distance D and the angle alpha between foot and centre,
        # evaluated without cancellation. It aligns columns of equal distance from the epipole.
        e = self.epipole
        D_w = float(np.hypot(e[0], e[1]))
        if D_w == 0.0:
            return np.zeros_like(self.distance)
        sign = -1.0 if e[2] < 0.0 else 1.0
        cosine = -(self.direction @ e[:2]) / D_w
        near = np.maximum(1.0 + cosine, 1.0)
        flat = self.distance**2 * abs(e[2]) / D_w / near
        with np.errstate(divide="ignore", invalid="ignore"):
            steep = np.where(cosine < 0.0, D_w / abs(e[2]) * (1.0 - cosine), 0.0) if e[2] else 0.0 * cosine
        return np.asarray(sign * np.where(cosine < 0.0, steep, flat))

    @property
    def start(self) -> F64:
        """(...) position of the epipole along the direction, infinite for an epipole at infinity."""
        e = self.epipole
        if e[2] == 0.0:
            return np.full_like(self.distance, -np.inf)
        return np.asarray(self.direction @ (e[:2] / e[2]))

    def on_half(self, t: F64) -> F64:
        """Whether positions (...) along the directions lie on the half-lines, not beyond the epipole."""
        return np.asarray(t < self.start if self.epipole[2] < 0.0 else t > self.start)


def plane_from_angle(phi: F64) -> F64:
    """(cos phi, sin phi) of angles."""
    return np.stack([np.cos(phi), np.sin(phi)], axis=-1)


def scale_and_shift(scale: F64 | float, shift: F64) -> F64:
    """Homographies (2, 3, 3) x' = s x + t of scales (2,) and shifts (2, 2)."""
    T = np.zeros((2, 3, 3))
    T[:, 0, 0] = T[:, 1, 1] = scale
    T[:, :2, 2] = shift
    T[:, 2, 2] = 1.0
    return T


@dataclass(frozen=True)
class EpipolarPair:
    """An image pair prepared for rectification."""

    pencil: EpipolarPencil
    matches: tuple[F64, F64]  #: (N, 2) pixels, possibly none
    arc: tuple[float, float]  #: interval of phi that both images see
    regions: tuple[F64, F64]  #: (M, 2) pixels of each image inside the arc, first the corners of that polygon
    cameras: F64 | None = None  #: (2, 3, 4) metric, if known


def pair_of_fundamental(F: F64, xy1: F64, xy2: F64, size1: Size, size2: Size) -> EpipolarPair:
    """Prepare two images with known F and matches for rectification."""
    matches = _checked_call(xy1, xy2, size1, size2)
    F = np.asarray(F, dtype=np.float64)
    if F.shape != (3, 3) or not np.isfinite(F).all() or not F.any():
        raise ValueError(f"rectification needs a finite F (3, 3) that is not zero; got shape {F.shape}")
    if len(xy1) < MIN_MATCHES:
        evidence = f"{counted(len(xy1), 'match')}, at least {MIN_MATCHES} are needed"
        raise StageFailure.of("few-matches-to-rectify", evidence)
    pencil, ratio = _pencil_of_fundamental(F, (size1, size2))
    if not ratio > 1e-9:
        evidence = f"the ratio of its singular values is {ratio:.1g}"
        raise StageFailure.of("fundamental-of-rank-one", evidence)
    require_parallax_of_matches(F, *matches, advice=", or rectify from cameras if the scene is a plane")
    return _complete(pencil, matches, None)


def pair_of_cameras(
    P1: F64, P2: F64, size1: Size, size2: Size, *, xy1: F64 | None = None, xy2: F64 | None = None
) -> EpipolarPair:
    """Prepare two undistorted images with known metric cameras for rectification."""
    none = np.empty((0, 2))
    matches = _checked_call(none if xy1 is None else xy1, none if xy2 is None else xy2, size1, size2)
    P = np.stack([P1, P2])
    P = P * np.sign(np.linalg.det(P[:, :, :3]))[:, None, None]
    centres = dehomogenize(camera_centre(P))
    apart = float(np.linalg.norm(centres[1] - centres[0]))
    if not apart > 1e-12 * (1.0 + float(np.abs(centres).max())):
        raise StageFailure.of("one-centre", apart)
    F = fundamental_from_cameras(P[0], P[1])
    if len(matches[0]) >= MIN_MATCHES:
        require_parallax_of_matches(F, *matches, at_infinity=infinite_homography(P[0], P[1]))
    return _complete(_pencil_of_fundamental(F, (size1, size2))[0], matches, P)


def _checked_call(xy1: F64, xy2: F64, size1: Size, size2: Size) -> tuple[F64, F64]:
    if min(*size1, *size2) < 2:
        raise ValueError(f"an image must have at least 2 x 2 px; got {size1} and {size2}")
    xy1, xy2 = checked("rectification, for its matches,", xy1=(xy1, ("N", 2)), xy2=(xy2, ("N", 2)))
    return xy1, xy2


def _pencil_of_fundamental(F: F64, sizes: tuple[Size, Size]) -> tuple[EpipolarPencil, float]:
    """Unoriented pencil of F (3, 3), and the ratio of the singular values of the normalised F."""
    # Unit of normalised coordinates relative to the longer image side: the focal length of a usual lens.
    focal_per_side = 1.2
    units = focal_per_side * np.array([max(size) for size in sizes], dtype=np.float64)
    centres = (np.array(sizes, dtype=np.float64) - 1.0) / 2.0
    T = scale_and_shift(units, centres)
    U, s, Vt = np.linalg.svd(T[1].T @ F @ T[0])
    # F z1 = U S V'z1, and V'z1 = J p with p the plane of z1.
    lines = np.stack([Vt[:2].T, (U[:, :2] * s[:2]) @ _J / s[0]])
    return EpipolarPencil(lines, centres, units, sizes), float(s[1] / s[0])


def _complete(pencil: EpipolarPencil, matches: tuple[F64, F64], P: F64 | None) -> EpipolarPair:
    """Determine orientation, direction of disparities, and common field of view."""
    seen, P_z = (matches, None) if P is None else _virtual_matches(pencil, P)
    # The sign of the second view is that which most matches support: at least this share of them lies on
    # corresponding half-lines; half of the wrong matches are there by chance.
    min_same_half = 0.8
    share = float(np.mean(np.sum(pencil.planes(0, seen[0]) * pencil.planes(1, seen[1]), axis=1) > 0.0))
    if max(share, 1.0 - share) < min_same_half:
        raise StageFailure.of("opposite-half-lines", 100.0 * max(share, 1.0 - share), len(seen[0]))
    if share < 0.5:
        pencil = replace(pencil, lines=pencil.lines * [[[1.0]], [[-1.0]]])
    P_z = _quasi_euclidean(pencil, *matches) if P_z is None else P_z
    pencil = replace(pencil, flipped=not _depth_increases_along_half_lines(pencil, P_z, *seen))
    arc = _common_arc(pencil, matches[0])
    return EpipolarPair(pencil, matches, arc, (_region(pencil, 0, arc), _region(pencil, 1, arc)), P)


def _virtual_matches(pencil: EpipolarPencil, P: F64) -> tuple[tuple[F64, F64], F64]:
    """Pixels of points at many depths in front of both cameras, and the cameras in normalised coordinates."""
    C = dehomogenize(camera_centre(P))
    rays = np.linalg.solve(P[0, :, :3], homogenize(_image_grid(pencil.sizes[0], 7)).T).T
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    steps = np.linalg.norm(C[1] - C[0]) * np.array([0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 64.0, 256.0])
    X = (C[0] + steps[:, None, None] * rays).reshape(-1, 3)
    X = X[homogenize(X) @ P[1, 2] > 0.0]
    if len(X) == 0:
        raise StageFailure.of("no-point-in-front")
    return (project(P[0], X), project(P[1], X)), pencil.normalization @ P


def _quasi_euclidean(pencil: EpipolarPencil, xy1: F64, xy2: F64) -> F64:
    """Normalised cameras (2, 3, 4) of the pencil: the candidate with most points in front."""
    z, F = np.stack([pencil.normalized(0, xy1), pencil.normalized(1, xy2)]), pencil.fundamental

    def points_in_front(P: F64) -> int:
        X = triangulate_points(P, z, method="linear")
        with np.errstate(divide="ignore", invalid="ignore"):
            return int(np.sum((depth(P[0], X) > 0.0) & (depth(P[1], X) > 0.0)))

    choices = product(quasi_euclidean_planes(F), (1.0, -1.0))
    candidates = [np.stack(canonical_cameras(F, plane=plane, scale=scale)) for plane, scale in choices]
    return max(candidates, key=points_in_front)


def _depth_increases_along_half_lines(pencil: EpipolarPencil, P: F64, xy1: F64, xy2: F64) -> bool:
    """Whether points that recede along their rays of view 1 move along the half-lines of view 2."""
    z = np.stack([pencil.normalized(0, xy1), pencil.normalized(1, xy2)])
    X = triangulate_points(P, z, method="linear")
    with np.errstate(divide="ignore", invalid="ignore"):
        point, C = dehomogenize(X), dehomogenize(camera_centre(P[0]))
        moved = project(P[1], C + 1.001 * (point - C)) - project(P[1], point)
        direction = pencil.half_lines(1, pencil.angles(1, xy2)).direction
        steps = np.sum(moved * direction, axis=1)
    return bool(np.nansum(np.sign(steps)) >= 0.0)


def _common_arc(pencil: EpipolarPencil, xy1: F64) -> tuple[float, float]:
    """Interval of phi that both images see; a full circle starts in the widest gap between matches."""
    arcs = [arc for arc in (_arc(pencil, side) for side in (0, 1)) if arc is not None]
    if len(arcs) == 1:
        return arcs[0]
    if not arcs:
        phi = np.sort(pencil.angles(0, xy1)) if len(xy1) else np.array([-2.0 * np.pi])
        gaps = np.diff(phi, append=phi[0] + 2.0 * np.pi)
        k = int(np.argmax(gaps))
        start = float(phi[k] + 0.5 * gaps[k])
        return start, start + 2.0 * np.pi
    (a, b), (c, d) = arcs
    turn = 2.0 * np.pi * np.round((0.5 * (a + b) - 0.5 * (c + d)) / (2.0 * np.pi))
    low, high = max(a, c + turn), min(b, d + turn)
    if not high > low:
        raise StageFailure.of("no-common-epipolar-line")
    return low, high


def _arc(pencil: EpipolarPencil, side: int) -> tuple[float, float] | None:
    """Interval of phi that an image sees, None for the full circle (epipole inside)."""
    corners = image_corners(pencil.sizes[side])
    e = pencil.epipole(side)
    if abs(e[2]) > 1e-12 * np.hypot(e[0], e[1]):
        inside = pencil.pixels(side, e[:2] / e[2])
        if (inside >= 0.0).all() and (inside <= corners[2]).all():
            return None
    # If the epipole is outside, the half-lines through the convex image span less than 180 degrees.
    about = float(pencil.angles(side, pencil.centres[side][None])[0])
    phi = pencil.angles(side, corners, about=about)
    return float(phi.min()), float(phi.max())


def _region(pencil: EpipolarPencil, side: int, arc: tuple[float, float]) -> F64:
    """Samples of the part of an image within the arc: the corners of that polygon, then a grid."""
    samples = 16  # Samples along each image side at which distortion is measured
    grid = _image_grid(pencil.sizes[side], samples)
    middle, half = 0.5 * (arc[0] + arc[1]), 0.5 * (arc[1] - arc[0])
    # The tolerance keeps the corners that bound the arc despite rounding.
    inside = np.abs(pencil.angles(side, grid, about=middle) - middle) <= half + 1e-9
    rim, enter, leave = pencil.chords(side, np.array(arc))
    met = leave >= enter
    ends = [pencil.pixels(side, rim.foot + t[:, None] * rim.direction)[met] for t in (enter, leave)]
    corner = [0, samples - 1, -samples, -1]
    corners = grid[corner][inside[corner]]
    return np.concatenate([*ends, corners, grid[inside]])


def _image_grid(size: Size, count: int) -> F64:
    """Pixels (N, 2) of a grid over an image."""
    x, y = (np.linspace(0.0, length - 1.0, count) for length in size)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def image_corners(size: Size) -> F64:
    """Corner pixels (4, 2) of an image."""
    w, h = size
    return np.array([[0.0, 0.0], [w - 1.0, 0.0], [w - 1.0, h - 1.0], [0.0, h - 1.0]])


def frame_size(extent: F64, pair: EpipolarPair) -> tuple[int, int]:
    """(width, height) of a frame of some extent (2,), rounded up; ``StageFailure`` if too large or empty."""
    width, height = extent.tolist()
    most = MAX_GROWTH * max(w * h for w, h in pair.pencil.sizes)
    if not width * height <= most:
        evidence = f"they need {width * height / 1e6:.3g} million pixels, the limit is {most / 1e6:.3g}"
        raise StageFailure.of("distorted-rectification", evidence)
    if not min(width, height) >= 2.0:
        evidence = f"their common frame is {width:.3g} x {height:.3g} px"
        raise StageFailure.of("no-rectified-overlap", evidence)
    return int(np.ceil(width)), int(np.ceil(height))


def common_crop(samples: Sequence[F64], matches: Sequence[F64]) -> tuple[F64, F64]:
    """Least and greatest rectified coordinates (2, 2) that both images see, one row per image."""
    # Margin of the disparity range that limits the crop, as a share of the range of the matches.
    crop_margin = 1.0
    low, high = (np.stack([f(xy, axis=0) for xy in samples]) for f in (np.min, np.max))
    low[:, 1], high[:, 1] = low[:, 1].max(), high[:, 1].min()
    if len(matches[0]):
        near, far = disparity_bounds(matches[0][:, 0] - matches[1][:, 0], margin=crop_margin)
        least, most = low[:, 0].copy(), high[:, 0].copy()
        low[0, 0], high[0, 0] = max(least[0], least[1] + near), min(most[0], most[1] + far)
        low[1, 0], high[1, 0] = max(least[1], least[0] - far), min(most[1], most[0] - near)
    return low, high


def disparity_bounds(disparities: F64, *, margin: float) -> tuple[float, float]:
    """1 % and 99 % quantiles of disparities (N,), widened at both ends by a share of the range."""
    low, high = np.quantile(disparities, [0.01, 0.99])
    return float(low - margin * (high - low)), float(high + margin * (high - low))
