"""Straight line segments of an image, for vanishing points.

Burns, Hanson and Riseman, "Extracting straight lines", PAMI 8(4), 1986: connected pixels with similar
gradient directions support one line. The line is fitted to the subpixel edge points of its region, found on a
parabola along the gradient (Devernay, INRIA RR-2724, 1995).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon.arrays import B8, F32, F64, I64

_BINS = 8
_ANY_NEIGHBOUR = np.ones((3, 3), dtype=np.int64)


@dataclass(frozen=True)
class LineSegments:
    """Detector of straight line segments."""

    sigma_px: float = 1.0  #: smoothing before the gradient
    min_gradient: float = 3.0  #: least gradient of an edge, grey levels per pixel
    min_length: float = 0.02  #: least length, as a share of the long side
    max_rms_px: float = 0.5  #: largest RMS distance of the edge points from the segment

    def detect(self, gray: F32) -> F64:
        """Return segments (S, 4) x1, y1, x2, y2 in pixels of a grey image (H, W), longest first."""
        gx, gy = (scipy.ndimage.gaussian_filter(gray, self.sigma_px, order=o) for o in ((0, 1), (1, 0)))
        size = np.hypot(gx, gy)
        region = _support_regions(np.arctan2(gy, gx), size > self.min_gradient)
        xy, of = _edge_points(gx, gy, size, region)
        segments, rms = _fit_segments(xy, of)
        length = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
        good = (length >= self.min_length * max(gray.shape)) & (rms <= self.max_rms_px)
        order = np.argsort(-length[good], kind="stable")
        return np.asarray(segments[good][order])


def _support_regions(angle: F32, strong: B8) -> I64:
    """Line-support region (H, W) of each strong pixel, from 1; 0 for none.

    Regions are connected pixels of one of eight bins of gradient angle, for two partitions half a bin apart.
    A pixel votes for the larger of its two regions; regions with most of their votes are kept.
    """
    width = 2.0 * np.pi / _BINS
    both = [
        _label_bins(np.floor(angle / width + shift).astype(np.int64) % _BINS, strong) for shift in (0.0, 0.5)
    ]
    offset = int(both[0].max())
    both[1] = np.where(both[1] > 0, both[1] + offset, 0)
    sizes = np.bincount(np.concatenate([part.ravel() for part in both]))
    first = sizes[both[0]] >= sizes[both[1]]
    vote = np.where(first, both[0], both[1])
    votes = np.bincount(vote.ravel(), minlength=len(sizes))
    kept = 2 * votes > sizes
    kept[0] = False
    return np.where(kept[vote], vote, 0)


def _label_bins(bins: I64, strong: B8) -> I64:
    labels = np.zeros(bins.shape, dtype=np.int64)
    count = 0
    for b in range(_BINS):
        mine, n = scipy.ndimage.label(strong & (bins == b), structure=_ANY_NEIGHBOUR)
        labels += np.where(mine > 0, mine + count, 0)
        count += int(n)
    return labels


def _edge_points(gx: F32, gy: F32, size: F32, region: I64) -> tuple[F64, I64]:
    """Edge points (E, 2) px, maxima along the gradient between pixels, with their region numbers."""
    h, w = region.shape
    y, x = np.nonzero(region)
    inside = (x > 0) & (y > 0) & (x < w - 1) & (y < h - 1)
    x, y = x[inside], y[inside]
    eighth = np.round(np.arctan2(gy[y, x], gx[y, x]) / (np.pi / 4.0)) * (np.pi / 4.0)
    dx, dy = np.rint(np.cos(eighth)).astype(np.int64), np.rint(np.sin(eighth)).astype(np.int64)
    before, here, after = size[y - dy, x - dx], size[y, x], size[y + dy, x + dx]
    peak = (here >= before) & (here > after)
    x, y, dx, dy = x[peak], y[peak], dx[peak], dy[peak]
    left, middle, right = (part[peak].astype(np.float64) for part in (before, here, after))
    shift = 0.5 * (left - right) / np.minimum(left - 2.0 * middle + right, -1e-12)
    return np.column_stack([x + shift * dx, y + shift * dy]), region[y, x]


def _fit_segments(xy: F64, region: I64) -> tuple[F64, F64]:
    """Total-least-squares segments (S, 4) of regions of five points or more, and their rms distances (S,)."""
    n = np.bincount(region)
    regions = np.flatnonzero(n >= 5)
    place = np.full(len(n), -1)
    place[regions] = np.arange(len(regions))
    keep = place[region] >= 0
    xy, of, n = xy[keep], place[region[keep]], n[regions].astype(np.float64)
    mean = np.column_stack([np.bincount(of, xy[:, k], minlength=len(regions)) for k in (0, 1)]) / n[:, None]
    d = xy - mean[of]
    xx, xy_, yy = (
        np.bincount(of, d[:, a] * d[:, b], minlength=len(regions)) / n for a, b in ((0, 0), (0, 1), (1, 1))
    )
    angle = 0.5 * np.arctan2(2.0 * xy_, xx - yy)
    along = np.column_stack([np.cos(angle), np.sin(angle)])
    least = 0.5 * (xx + yy - np.hypot(xx - yy, 2.0 * xy_))
    position = np.sum(d * along[of], axis=1)
    low, high = np.zeros(len(regions)), np.zeros(len(regions))
    np.minimum.at(low, of, position)
    np.maximum.at(high, of, position)
    ends = [mean + t[:, None] * along for t in (low, high)]
    return np.column_stack(ends), np.sqrt(np.maximum(least, 0.0))
