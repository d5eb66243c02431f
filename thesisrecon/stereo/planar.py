"""Planar rectification: homographies that map epipolar lines to common rows.

All such homographies have, with the line at infinity at phi + pi/2 of the pencil, the rows v = -L p(phi) and
w = L p(phi + pi/2), so that y = v'x / w'x is the tangent of the angle of x minus phi in both views. Free
parameters are phi, a unit of length and the first rows; the methods differ in their choice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import B8, F32, F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.stereo.epipolar_pair import EpipolarPair, plane_from_angle
from thesisrecon.stereo.resampling import require_side, warp_image

CROP_MARGIN = 1.0
"""Margin of the disparity range that limits the crop, as a share of the range of the matches."""

MAX_MATCHES = 300
"""Limit of the number of matches to which disparity gradients are fitted."""


@dataclass(frozen=True)
class FrameLimits:
    """Limits of the size of a rectified frame.

    The area is preserved on average.

    Parameters
    ----------
    max_shrink : float
        Largest reduction of any pixel along any direction.
    max_growth : float
        Largest number of pixels of the frame relative to the larger image.
    """

    max_shrink: float = 1.4
    max_growth: float = 6.0

    def __post_init__(self) -> None:
        if not (self.max_shrink >= 1.0 and self.max_growth >= 1.0):
            raise ValueError(
                f"max_shrink and max_growth must be at least 1; got {self.max_shrink}, {self.max_growth}"
            )

    def require(self, extent: F64, pair: EpipolarPair) -> tuple[int, int]:
        """Check the size of a frame.

        Parameters
        ----------
        extent : ndarray (2,)
            Width and height.
        pair : EpipolarPair

        Returns
        -------
        tuple of int
            (width, height), rounded up.

        Raises
        ------
        StageFailure
            If the frame is too large or smaller than 2 x 2 px.
        """
        width, height = float(extent[0]), float(extent[1])
        most = self.max_growth * max(w * h for w, h in pair.sizes)
        if not width * height <= most:
            raise StageFailure(
                "the rectified images are too distorted",
                f"they need {width * height / 1e6:.3g} million pixels, the limit is {most / 1e6:.3g}",
                "rectify in polar coordinates, or choose views with less forward motion",
            )
        if not min(width, height) >= 2.0:
            raise StageFailure(
                "the rectified images do not overlap",
                f"their common frame is {width:.3g} x {height:.3g} px",
                "choose views that overlap more",
            )
        return int(np.ceil(width)), int(np.ceil(height))


@dataclass(frozen=True)
class PlanarRectification:
    """Two homographies to a common rectified frame.

    Rows are epipolar lines; x_right = x_left - d with larger d for nearer points, side 0 is the left image.
    The frame may be rotated against the images. The homographies are scaled so that the third coordinate of
    visible points is positive.

    Attributes
    ----------
    H1, H2 : ndarray (3, 3)
        Homographies from the images to the frame.
    size : tuple of int
        (width, height) of the frame.
    """

    H1: F64
    H2: F64
    size: tuple[int, int]

    def homography(self, side: int) -> F64:
        """Return the homography of one image.

        Parameters
        ----------
        side : {0, 1}

        Returns
        -------
        ndarray (3, 3)
            H1 or H2.
        """
        return self.H2 if require_side(side) else self.H1

    def original_from_rectified(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """Map positions of the frame to pixels of an image.

        Parameters
        ----------
        side : {0, 1}
        xy : ndarray (N, 2)
        within : bool
            Return NaN outside the frame too.

        Returns
        -------
        ndarray (N, 2)
            Pixels of the image, NaN beyond the line sent to infinity.
        """
        source = _within(xy, self.size) if within else xy
        return _moved(np.asarray(np.linalg.inv(self.homography(side))), source)

    def rectified_from_original(self, side: int, xy: F64, *, within: bool = True) -> F64:
        """Map pixels of an image to the frame.

        Parameters
        ----------
        side : {0, 1}
        xy : ndarray (N, 2)
        within : bool
            Return NaN outside the frame too.

        Returns
        -------
        ndarray (N, 2)
            Positions in the frame, NaN beyond the line sent to infinity.
        """
        moved = _moved(self.homography(side), xy)
        return _within(moved, self.size) if within else moved

    def lookup(self, side: int, rows: range) -> F64:
        """Return the image positions of some rows of the frame.

        Parameters
        ----------
        side : {0, 1}
        rows : range

        Returns
        -------
        ndarray (len(rows), width, 2)
        """
        G = np.linalg.inv(self.homography(side))
        x, y = np.arange(float(self.size[0])), np.arange(rows.start, rows.stop, dtype=np.float64)
        u, v, w = (np.add.outer(row[1] * y + row[2], row[0] * x) for row in G)
        with np.errstate(divide="ignore", invalid="ignore"):
            w = np.where(w > 0.0, 1.0 / w, np.nan)
        return np.stack([u * w, v * w], axis=-1)

    def warp(self, image: F32, side: int) -> F32:
        """Resample an image into the frame.

        Parameters
        ----------
        image : ndarray (H, W) or (H, W, C)
        side : {0, 1}

        Returns
        -------
        ndarray float32
            The rectified image, NaN outside.
        """
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
    """Return the second and third rows of both homographies in normalised coordinates.

    Parameters
    ----------
    pair : EpipolarPair
    phi : float
        Plane that becomes row 0 of the frame.
    infinite : float, optional
        Plane whose line is sent to infinity; default phi + pi/2.

    Returns
    -------
    ndarray (2, 2, 3)
    """
    v, w = plane_from_angle(np.array([phi, phi + 0.5 * np.pi if infinite is None else infinite]))
    return np.stack([np.stack([-L @ v, L @ w]) for L in pair.pencil.lines])


def admissible_lines(pair: EpipolarPair) -> tuple[float, float]:
    """Return the interval of phi whose line at infinity misses the common field of view.

    Parameters
    ----------
    pair : EpipolarPair

    Returns
    -------
    tuple of float
        Limits of phi.

    Raises
    ------
    StageFailure
        If there is none.
    """
    low, high = pair.arc
    if not high - low < np.pi - 1e-6:
        raise StageFailure(
            "the epipoles lie inside the images",
            "every epipolar line crosses the common field of view",
            "rectify in polar coordinates",
        )
    return high - 0.5 * np.pi, low + 0.5 * np.pi


def require_in_front(pair: EpipolarPair, rows: F64) -> None:
    """Check that the line at infinity misses the common field of view.

    Parameters
    ----------
    pair : EpipolarPair
    rows : ndarray (2, 2, 3)
        Rows of :func:`pencil_rows`.

    Raises
    ------
    StageFailure
        If it does not.
    """
    for side, (xy, samples) in enumerate(zip(pair.matches, pair.regions, strict=True)):
        third = homogenize(pair.pencil.normalized(side, np.concatenate([samples, xy]))) @ rows[side, 1]
        if not third.min() > 1e-6 * third.max():
            raise StageFailure(
                "the line sent to infinity crosses the images",
                "an epipole lies inside an image or at its border",
                "rectify in polar coordinates",
            )


def affine_rows(pair: EpipolarPair, rows: F64) -> F64:
    """Return the first rows that make the affine part of each homography a similarity (Loop and Zhang 1999).

    Their shear keeps the image midlines perpendicular and of equal ratio. Here the best affine approximation
    over the common field of view (least squares) gets two perpendicular rows of equal length; with x' = alpha
    x_a + beta y' and any other coordinate x_a the condition is linear.

    Parameters
    ----------
    pair : EpipolarPair
    rows : ndarray (2, 2, 3)
        Rows of :func:`pencil_rows`.

    Returns
    -------
    ndarray (2, 3)
        First rows.
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
        # Preserve the orientation.
        wanted = np.array([g_v[1], -g_v[0]])
        alpha, beta = np.linalg.solve(np.stack([g_a, g_v], axis=1), wanted)
        first.append(alpha * x_a + beta * v)
    return np.stack(first)


def homographies_of_rows(pair: EpipolarPair, first: F64, rows: F64) -> F64:
    """Assemble homographies of pixels from their rows in normalised coordinates.

    Parameters
    ----------
    pair : EpipolarPair
    first : ndarray (2, 3)
        First rows.
    rows : ndarray (2, 2, 3)
        Second and third rows.

    Returns
    -------
    ndarray (2, 3, 3)
        Homographies, rotated by 180 degrees if the pencil is flipped.
    """
    H = np.concatenate([first[:, None], rows], axis=1) @ _normalizing_transforms(pair)
    if pair.pencil.flipped:
        H[:, :2] *= -1.0
    return H


def crop_and_scale(pair: EpipolarPair, H: F64, limits: FrameLimits) -> PlanarRectification:
    """Scale homographies and crop the frame to the common field of view.

    Parameters
    ----------
    pair : EpipolarPair
    H : ndarray (2, 3, 3)
        Homographies of pixels with corresponding rows.
    limits : FrameLimits

    Returns
    -------
    PlanarRectification

    Raises
    ------
    StageFailure
        If a line at infinity crosses the common field of view or the frame would be too large.
    """
    samples = [_mapped(H[side], pair.regions[side]) for side in (0, 1)]
    low, high = common_crop(samples, (_mapped(H[0], pair.xy1), _mapped(H[1], pair.xy2)))
    kept = [np.all((xy >= low[side]) & (xy <= high[side]), axis=1) for side, xy in enumerate(samples)]
    scale = _scale(pair, H, kept, limits)
    width, height = limits.require(scale * (high - low).max(axis=0) + 1.0, pair)
    # Both origins have the same row; the narrower image leaves columns at the right empty.
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
        raise StageFailure("the line sent to infinity crosses the images", "", "rectify in polar coordinates")
    return np.asarray(xh[:, :2] / xh[:, 2:])


def common_crop(samples: list[F64], matches: tuple[F64, F64]) -> tuple[F64, F64]:
    """Return the bounds of the rectified coordinates that both images see.

    Along the rows each image is cut to what the other can show at the disparities of the matches.

    Parameters
    ----------
    samples : list of ndarray (M, 2)
        Rectified samples of both images.
    matches : tuple of ndarray (N, 2)
        Rectified matches, possibly none.

    Returns
    -------
    tuple of ndarray (2, 2)
        Least and greatest coordinates, one row per image.
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
    """Return a robust disparity range.

    Parameters
    ----------
    disparities : ndarray (N,)
        Disparities of matches.
    margin : float
        Widening at both ends, as a share of the range.

    Returns
    -------
    tuple of float
        1 % and 99 % quantiles with the margin; a few matches are wrong along their epipolar lines.
    """
    low, high = np.quantile(disparities, [0.01, 0.99])
    return float(low - margin * (high - low)), float(high + margin * (high - low))


def disparity_gradients(left: F64, right: F64) -> F64:
    """Fit a quadratic polynomial to the disparities and return its gradients.

    They measure the relative stretch, shear and bending of both images without relief.

    Parameters
    ----------
    left, right : ndarray (N, 2)
        Rectified matches.

    Returns
    -------
    ndarray (M, 2)
        Gradients of x_left - x_right by the mean position at M <= 300 matches.
    """
    every = max(len(left) // MAX_MATCHES, 1)
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
    """Return the derivatives of a homography.

    Parameters
    ----------
    H : ndarray (3, 3)
    xy : ndarray (N, 2)

    Returns
    -------
    ndarray (N, 2, 2)
    """
    xh = homogenize(xy) @ H.T
    moved = xh[:, :2] / xh[:, 2:]
    return np.asarray((H[None, :2, :2] - moved[:, :, None] * H[2, :2]) / xh[:, 2, None, None])


def singular_values(J: F64) -> F64:
    """Return the singular values of 2 x 2 matrices.

    Parameters
    ----------
    J : ndarray (N, 2, 2)

    Returns
    -------
    ndarray (N, 2)
        Singular values, the larger first.
    """
    a = 0.5 * np.hypot(J[:, 0, 0] + J[:, 1, 1], J[:, 1, 0] - J[:, 0, 1])
    b = 0.5 * np.hypot(J[:, 0, 0] - J[:, 1, 1], J[:, 1, 0] + J[:, 0, 1])
    return np.stack([a + b, np.abs(a - b)], axis=1)


def _scale(pair: EpipolarPair, H: F64, kept: list[B8], limits: FrameLimits) -> float:
    """Pixels of the frame per unit of H."""
    values = [singular_values(homography_jacobians(H[s], pair.regions[s][kept[s]])) for s in (0, 1)]
    found = np.concatenate(values)
    if len(found) == 0:
        raise StageFailure("the rectified images do not overlap", "", "choose views that overlap more")
    area = float(np.exp(-0.5 * np.mean(np.log(found[:, 0] * found[:, 1]))))
    return max(area, 1.0 / (limits.max_shrink * float(found[:, 1].min())))
