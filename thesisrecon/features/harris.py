"""Section 4.2.1: the corner detector of Harris and Stephens with a surface fit and spatial selection.

C. Harris and M. Stephens, "A combined corner and edge detector", Alvey Vision Conference, 1988.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import scipy

from thesisrecon._numba import FAST, empty, full, kernel, zeros
from thesisrecon.arrays import F32, F64, I64
from thesisrecon.errors import require_range
from thesisrecon.imaging.resampling import gaussian_taps, smooth
from thesisrecon.records import Features, Image


def corner_response(gray: F32, sigma_px: float, trace_weight: float) -> F32:
    """Compute the corner response R (H, W) of section 4.2.1, zero where windows leave the image.

    M holds the products of the gradients, smoothed by a Gaussian; ``trace_weight``: 0 for det M / trace M,
    else k of det M - k (trace M)^2.
    """
    gx, gy = np.zeros((2, *gray.shape), np.float32)
    gx[:, 1:-1] = np.float32(0.5) * (gray[:, 2:] - gray[:, :-2])
    gy[1:-1] = np.float32(0.5) * (gray[2:] - gray[:-2])
    moments = [smooth(p * q, sigma_px) for p, q in ((gx, gx), (gx, gy), (gy, gy))]
    response: F32 = _measure(np.stack(moments), trace_weight, len(gaussian_taps(sigma_px)) // 2 + 1)
    return response


@kernel(fastmath=FAST)
def _measure(moments: F32, trace_weight: float, border: int) -> F32:
    """R (H, W) of the entries of M (3, H, W), zero in the border."""
    _, height, width = moments.shape
    response = zeros((height, width), np.float32)
    moment = empty((3, width), np.float32)
    for y in range(border, height - border):
        moment[:] = moments[:, y]
        _measure_row(moment[:, border:], width - 2 * border, trace_weight, response[y, border:])
    return response


@kernel(fastmath=FAST, forceinline=True)
def _measure_row(moment: F32, count: int, trace_weight: float, out: F32) -> None:
    a, b, c = moment[0], moment[1], moment[2]
    if trace_weight == 0.0:
        for x in range(count):
            out[x] = (a[x] * c[x] - b[x] * b[x]) / (a[x] + c[x] + np.float32(1e-6))
    else:
        for x in range(count):
            trace = a[x] + c[x]
            out[x] = a[x] * c[x] - b[x] * b[x] - trace_weight * trace * trace


def fit_maxima(response: F32, threshold: float, subpixel: bool = True) -> tuple[F64, F32]:
    """Local maxima of R: positions (N, 2) refined by least-squares quadratic surfaces, and responses (N,)."""
    height, width = response.shape
    beside = [response[k // 3 : height - 2 + k // 3, k % 3 : width - 2 + k % 3] for k in range(9)]
    # > before and >= after the pixel: a plateau of two pixels gives one corner.
    highest = beside[4] > np.float32(threshold)
    for k, other in enumerate(beside):
        highest &= beside[4] > other if k < 4 else beside[4] >= other
    y, x = np.nonzero(highest)
    xy = np.stack([x, y], axis=1).astype(np.float64) + 1.0
    around = np.stack([each[y, x] for each in beside]).reshape(3, 3, -1)
    if subpixel:
        xy += _surface_maximum(around)
    return xy, around[1, 1]


def _surface_maximum(around: F32) -> F64:
    """Maximum (N, 2) of the surface of least squares through responses (3, 3, N); 0 if it is not beside."""
    wide = around.astype(np.float64)
    gx = ((around[:, 2] - around[:, 0]).astype(np.float64) / 6.0).sum(axis=0)
    gy = ((around[2] - around[0]).astype(np.float64) / 6.0).sum(axis=0)
    gxx = ((wide[:, 0] - 2.0 * wide[:, 1] + wide[:, 2]) / 3.0).sum(axis=0)
    gyy = ((wide[0] - 2.0 * wide[1] + wide[2]) / 3.0).sum(axis=0)
    gxy = (around[2, 2] + around[0, 0] - around[0, 2] - around[2, 0]).astype(np.float64) / 4.0
    determinant = gxx * gyy - gxy * gxy
    with np.errstate(divide="ignore", invalid="ignore"):
        step = -np.stack([gyy * gx - gxy * gy, gxx * gy - gxy * gx], axis=1) / determinant[:, None]
        inside = (gxx < 0.0) & (determinant > 1e-12 * gxx * gxx) & (np.abs(step) <= 1.0).all(axis=1)
    return np.where(inside[:, None], step, 0.0)


@kernel(fastmath=FAST)
def squared_suppression_radii(xy: F32, response: F32, robustness: float) -> F32:
    """Squared distances (N,) to the nearest corner whose response times robustness is larger."""
    n = len(xy)
    x, y = xy[:, 0].copy(), xy[:, 1].copy()
    out = full(n, np.inf, np.float32)
    stronger = 0
    for i in range(n):
        while stronger < i and robustness * response[stronger] > response[i]:
            stronger += 1
        best = np.float32(3.4e38)
        for j in range(stronger):
            dx, dy = x[j] - x[i], y[j] - y[i]
            best = min(best, dx * dx + dy * dy)
        if stronger > 0:
            out[i] = best
    return out


def enforce_spacing(xy: F64, distance: float) -> I64:
    """Rows, in order, of the positions (N, 2) at least ``distance`` from all that are kept before."""
    keep = np.ones(len(xy), np.bool_)
    near = scipy.spatial.cKDTree(xy).query_pairs(np.nextafter(distance, 0.0)) if len(xy) else ()
    for a, b in sorted(near):
        keep[b] &= not keep[a]
    return np.flatnonzero(keep)


@dataclass(frozen=True)
class CornerMeasure:
    """The corner response R of section 4.2.1 and its parameters.

    M (2 x 2; the thesis' "4 x 4" is a slip) holds the products of the image gradient, smoothed by a Gaussian.
    The thesis' formula for R lost two signs: M and (M11 + M22) fit both det M / trace M (Noble 1988) and det
    M - k (trace M)^2 (Harris and Stephens 1988); both are available.
    """

    formula: Literal["noble", "harris"] = "noble"  #: det / trace, or det - k trace^2
    integration_sigma_px: float = 1.5  #: Gaussian of M, three sigma to each side; the thesis has sigma 1
    subpixel: bool = True  #: fit a quadratic surface to the 3 x 3 pixels of each maximum, else keep the pixel

    # k of Harris and Stephens.
    harris_k = 0.04
    # det / trace (grey levels squared) below which corners are quantisation and compression noise.
    noise_response = 0.05
    # Gaussian before the derivative.
    derivative_sigma_px = 1.0

    def __post_init__(self) -> None:
        require_range(self, integration_sigma_px="(0, inf)")

    def _find(self, gray: F32) -> tuple[F64, F32]:
        """Corners (N, 2) above the noise and their responses (N,), strongest first; none in tiny images."""
        if min(gray.shape) < 2 * len(gaussian_taps(self.integration_sigma_px)):
            return np.empty((0, 2)), np.empty(0, np.float32)
        limit, weight = self.noise_response, 0.0
        if self.formula == "harris":
            # R of an isotropic corner with this det / trace.
            limit, weight = (2.0 * limit) ** 2 * (1.0 - 4.0 * self.harris_k), self.harris_k
        smoothed = smooth(gray, self.derivative_sigma_px)
        response = corner_response(smoothed, self.integration_sigma_px, weight)
        xy, value = fit_maxima(response, limit, self.subpixel)
        # Equal responses keep the reading order.
        order = np.argsort(-value, kind="stable")
        return xy[order], value[order]


@dataclass(frozen=True)
class HarrisCorners:
    """The thesis' detector: one scale, a threshold on R, the strongest corners with spatial selection."""

    max_corners: int = 2000  #: maximum number of corners
    threshold_rel: float = 0.002  #: minimum response relative to the largest one; 0 for all above the noise
    selection: Literal["spacing", "spread"] = "spacing"
    """Drop corners too near to a stronger one, or use :func:`select_spread`."""
    measure: CornerMeasure = field(default_factory=CornerMeasure)  #: response and its parameters

    # Minimum distance of two corners for "spacing", relative to the long side.
    spacing_rel = 0.004

    def __post_init__(self) -> None:
        require_range(self, max_corners="[1, inf)", threshold_rel="[0, 1]")

    def detect(self, image: Image) -> Features:
        """See `thesisrecon.config.Detector.detect`."""
        xy, response = self.measure._find(image.gray)
        if len(xy):
            strong = response >= self.threshold_rel * float(response[0])
            xy, response = xy[strong], response[strong]
        if self.selection == "spread":
            kept = select_spread(xy, response, self.max_corners)
        else:
            kept = enforce_spacing(xy, self.spacing_rel * max(image.size))[: self.max_corners]
        return Features(xy=xy[kept], scale=np.ones(len(kept), np.float32), response=response[kept])


def select_spread(xy: F64, response: F32, count: int) -> I64:
    """Indices (M,), strongest first, of ``count`` corners that cover the image (M. Brown et al., CVPR 2005).

    Of corners (N, 2), strongest first: among the 1.7 ``count`` strongest those farthest from any clearly
    stronger one. A cell of a sixth of the long side gives at most 1.5 times as many of these as in an even
    distribution.
    """
    pool, members = int(1.7 * count), np.arange(len(xy), dtype=np.int64)
    if len(xy) > pool:
        span = float(np.ptp(xy, axis=0).max()) + 1.0
        part = np.floor(6.0 * (xy - xy.min(axis=0)) / span).astype(np.int64)
        cell = 6 * part[:, 1] + part[:, 0]
        by_cell = np.argsort(cell, kind="stable")
        cells, start, size = np.unique(cell[by_cell], return_index=True, return_counts=True)
        rank = np.empty(len(xy), np.int64)
        rank[by_cell] = np.arange(len(xy)) - np.repeat(start, size)
        members = np.flatnonzero(rank < max(1, int(1.5 * pool / len(cells))))[:pool].astype(np.int64)
    if len(members) <= count:
        return members
    radii = squared_suppression_radii(xy[members].astype(np.float32), response[members], 0.9)
    return members[np.sort(np.argsort(-radii, kind="stable")[:count])]
