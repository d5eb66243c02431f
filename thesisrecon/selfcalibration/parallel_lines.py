"""Plane at infinity from parallel lines, given or detected in the images (chapter 7, stratified).

Vanishing points of a direction in two images are triangulated to a point at infinity; its support are the
segments of all images whose lines pass through its images. Three such points span the plane.

Segments: Burns, Hanson and Riseman, "Extracting straight lines", PAMI 8(4), 1986: connected pixels with
similar gradient directions support one line. The line is fitted to the subpixel edge points of its region,
found on a parabola along the gradient (Devernay, INRIA RR-2724, 1995).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import scipy

from thesisrecon.arrays import B8, F32, F64, I64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.optimize.least_squares import MAD_FACTOR
from thesisrecon.records import Image
from thesisrecon.selfcalibration._frame import (
    PlaneCandidates,
    ProjectiveScene,
    ReferenceFrame,
    require_cameras_of_full_rank,
)
from thesisrecon.selfcalibration._refinement import minimize_batch
from thesisrecon.selfcalibration.cheirality import CheiralityRegion, unit_rows

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
    bins = (np.floor(angle / width + shift).astype(np.int64) % _BINS for shift in (0.0, 0.5))
    both = [_label_bins(part, strong) for part in bins]
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
    dx, dy = (xy - mean[of]).T
    xx, xy_, yy = (np.bincount(of, p, minlength=len(regions)) / n for p in (dx * dx, dx * dy, dy * dy))
    angle = 0.5 * np.arctan2(2.0 * xy_, xx - yy)
    along = np.column_stack([np.cos(angle), np.sin(angle)])
    least = 0.5 * (xx + yy - np.hypot(xx - yy, 2.0 * xy_))
    position = dx * along[of, 0] + dy * along[of, 1]
    low, high = np.zeros(len(regions)), np.zeros(len(regions))
    np.minimum.at(low, of, position)
    np.maximum.at(high, of, position)
    ends = [mean + t[:, None] * along for t in (low, high)]
    return np.column_stack(ends), np.sqrt(np.maximum(least, 0.0))


# Largest endpoint distance of a supporting segment, and of one that is not used for another direction.
TOLERANCE_PX, _NEAR_PX = 1.5, 6.0
# Segment pairs per proposal, and maximum numbers of proposals per image and of directions.
_SAMPLES, _PROPOSALS, _MAX_DIRECTIONS = 400, 6, 6
_AMBIGUOUS = -2
_FIRST_NOISE_PX, _MIN_NOISE_PX = 0.5, 1e-3
_MIN_SEGMENTS = 6
_MIN_SPREAD = 1e-3


@dataclass(frozen=True)
class _SegmentSet:
    """Segments: camera (S,), unit-free midpoint and direction (S, 2), half the length (S,) in pixels."""

    camera: I64
    middle: F64
    along: F64
    half: F64

    def subset(self, keep: B8 | I64) -> _SegmentSet:
        """Return some of the segments."""
        return _SegmentSet(self.camera[keep], self.middle[keep], self.along[keep], self.half[keep])

    def endpoint_distances_px(self, v: F64) -> F64:
        """Return distances (..., S) of the ends from lines through the midpoints and points v (..., S, 3)."""
        towards = v[..., :2] - v[..., 2:] * self.middle
        norm = np.maximum(np.linalg.norm(towards, axis=-1), 1e-300)
        across = towards[..., 0] * self.along[:, 1] - towards[..., 1] * self.along[:, 0]
        return np.asarray(across / norm * self.half)

    def support(self, v: F64) -> F64:
        """Return the support (..., S) of points v (..., S, 3): length times fit, 0 beyond the tolerance."""
        miss = self.endpoint_distances_px(v) / TOLERANCE_PX
        return np.asarray(self.half * np.maximum(1.0 - miss**2, 0.0))


def _normalize_segments(frame: ReferenceFrame, segments: list[F64]) -> _SegmentSet:
    """Return pixel segments (S_i, 4) of each registered camera in the coordinates of the frame."""
    parts = []
    for place, pixels in enumerate(segments):
        unit = np.linalg.inv(frame.pixel_from_unit[frame.views[place]])
        ends = pixels.reshape(-1, 2, 2) @ unit[:2, :2].T + unit[:2, 2]
        step = ends[:, 1] - ends[:, 0]
        length = np.maximum(np.linalg.norm(step, axis=1), 1e-300)
        half = 0.5 * np.linalg.norm(pixels[:, 2:] - pixels[:, :2], axis=1)
        parts.append((np.full(len(pixels), place), ends.mean(axis=1), step / length[:, None], half))
    camera, middle, along, half = (np.concatenate([part[k] for part in parts]) for k in range(4))
    return _SegmentSet(camera.astype(np.int64), middle, along, half)


def _propose_vanishing_points(segments: _SegmentSet, rng: np.random.Generator) -> F64:
    """Return homogeneous vanishing points (K, 3) of one image, each from the segments left by the others."""
    found: list[F64] = []
    left = segments
    while len(found) < _PROPOSALS and len(left.half) >= 5:
        weight = left.half / left.half.sum()
        first, second = (rng.choice(len(weight), _SAMPLES, p=weight) for _ in range(2))
        lines = np.cross(homogenize(left.middle), np.column_stack([left.along, np.zeros(len(left.half))]))
        v = np.cross(lines[first], lines[second])
        v = v[np.linalg.norm(v, axis=1) > 1e-9]
        if not len(v):
            break
        v = unit_rows(v)
        best = v[left.support(v[:, None]).sum(axis=1).argmax()]
        mine = left.support(best[None]) > 0
        if mine.sum() < 4:
            break
        weighted = unit_rows(lines[mine]) * left.half[mine][:, None]
        best = np.linalg.svd(weighted, full_matrices=False)[2][2]
        found.append(best)
        left = left.subset(~mine & (np.abs(left.endpoint_distances_px(best[None])) > _NEAR_PX))
    return np.array(found).reshape(-1, 3)


def _triangulate_directions(P: F64, v: F64) -> tuple[F64, B8]:
    """Points (B, 4) with v x P X = 0, v (B, n, 3), P (B, n, 3, 4), and (B,) if some v is no epipole."""
    rows = np.cross(v[..., None], P, axisa=-2, axisb=-2, axisc=-2)
    values, vectors = np.linalg.eigh(np.einsum("bnri,bnrj->bij", rows, rows))
    return np.asarray(vectors[:, :, 0]), np.asarray(values[:, 1] > _MIN_SPREAD**2 * values[:, 3])


def _find_parallel_directions(
    P: F64, segments: _SegmentSet, proposals: list[F64], max_directions: int = _MAX_DIRECTIONS
) -> tuple[F64, I64]:
    """Points at infinity (D, 4), best supported first, in three or more cameras; direction (S,) or -1."""
    candidates = _triangulated_pairs(P, proposals)
    direction = np.full(len(segments.half), -1, dtype=np.int64)
    found: list[F64] = []
    while len(found) < max_directions and len(candidates):
        free = np.flatnonzero(direction == -1)
        left = segments.subset(free)
        parts = np.array_split(candidates, max(1, len(candidates) // 64))
        seen = (np.einsum("sij,bj->bsi", P[left.camera], part) for part in parts)
        total = np.concatenate([left.support(v).sum(axis=1) for v in seen])
        X = _refined_point(P, left, candidates[total.argmax()])
        mine = left.support((P @ X)[left.camera]) > 0
        if mine.sum() < 8 or len(np.unique(left.camera[mine])) < 3:
            break
        direction[free[mine]] = len(found)
        found.append(X)
        # Segments that nearly fit must not form another direction.
        near = np.abs(left.endpoint_distances_px((P @ X)[left.camera])) < _NEAR_PX
        direction[free[near & ~mine]] = _AMBIGUOUS
    return np.array(found).reshape(-1, 4), np.maximum(direction, -1)


def _triangulated_pairs(P: F64, proposals: list[F64]) -> F64:
    """Return points (B, 4) of all pairs of vanishing points that nearly lie on each other's epipolar line."""
    view = np.repeat(np.arange(len(P)), [len(points) for points in proposals])
    i, j = np.nonzero(view[:, None] < view)
    pair = np.column_stack([i, j])[np.lexsort((j, i, view[j], view[i]))]
    v = np.concatenate(proposals)[pair]
    v /= np.linalg.norm(v, axis=-1, keepdims=True)
    cameras = P[view[pair]]
    X, _ = _triangulate_directions(cameras, v)
    seen = np.einsum("bnij,bj->bni", cameras, X)
    sine = np.linalg.norm(np.cross(seen, v), axis=-1) / np.maximum(np.linalg.norm(seen, axis=-1), 1e-300)
    return np.asarray(X[sine.max(axis=1) < 0.1])


def _refined_point(P: F64, segments: _SegmentSet, X: F64) -> F64:
    """Return X (4,) refined to minimum distances of its segments, which are selected again each time."""
    for _ in range(3):
        mine = segments.subset(segments.support((P @ X)[segments.camera]) > 0)
        if len(mine.half) < 4:
            break
        tangent = np.linalg.svd(X[None])[2][1:]

        def residuals(step: F64, X: F64 = X, tangent: F64 = tangent, mine: _SegmentSet = mine) -> F64:
            return mine.endpoint_distances_px(np.einsum("sij,bj->bsi", P[mine.camera], X + step @ tangent))

        step = minimize_batch(residuals, np.zeros((1, 3)), iterations=10, loss_scale=TOLERANCE_PX / 2.0)[0][0]
        X = X + step @ tangent
        X = X / np.linalg.norm(X)
    return X


def _refine_plane(
    frame: ReferenceFrame, segments: _SegmentSet, direction: I64, plane: F64, v: F64
) -> tuple[F64, F64, float]:
    """Return plane p (3,) and vanishing points v (D, 3) fitted to all segments, and the noise (px).

    A direction at v in the reference view is at H_i v in view i. In each of four passes segments beyond 2.5
    times the robust noise are left out.
    """
    kept, noise = direction >= 0, _FIRST_NOISE_PX
    for _ in range(4):
        plane, v = _fit_plane(frame, segments.subset(kept), direction[kept], (plane, v), noise)
        residuals = _plane_residuals(frame, segments, np.maximum(direction, 0), plane[None], v[None])
        distances = np.abs(residuals[0])
        noise = max(MAD_FACTOR * float(np.median(distances[direction >= 0])), _MIN_NOISE_PX)
        trimmed = (direction >= 0) & (distances <= 2.5 * noise)
        if np.bincount(direction[trimmed], minlength=len(v)).min() < _MIN_SEGMENTS:
            break
        kept = trimmed
    return plane, v, noise


def _plane_residuals(frame: ReferenceFrame, segments: _SegmentSet, of: I64, plane: F64, v: F64) -> F64:
    """Return endpoint distances (B, S) px: directions ``of`` (S,), planes (B, 3), points v (B, D, 3)."""
    w, camera = v[:, of], segments.camera
    depth = np.einsum("bsi,bi->bs", w, plane)
    seen = np.einsum("sij,bsj->bsi", frame.A[camera], w) - frame.a[camera] * depth[..., None]
    return segments.endpoint_distances_px(seen)


def _fit_plane(
    frame: ReferenceFrame, segments: _SegmentSet, of: I64, start: tuple[F64, F64], noise: float
) -> tuple[F64, F64]:
    plane, v = start
    tangents = np.stack([np.linalg.svd(row[None])[2][1:] for row in v])

    def moved(x: F64) -> F64:
        return np.asarray(v + np.einsum("bdk,dki->bdi", x[:, 3:].reshape(len(x), len(v), 2), tangents))

    x, _ = minimize_batch(
        lambda x: _plane_residuals(frame, segments, of, plane + x[:, :3], moved(x)),
        np.zeros((1, 3 + 2 * len(v))), iterations=30, loss_scale=noise,
    )  # fmt: skip
    return plane + x[0, :3], unit_rows(moved(x)[0])


@dataclass(frozen=True)
class ParallelLines:
    """Plane at infinity through the vanishing points of three or more directions.

    Parameters
    ----------
    points : ndarray (V, D, 3), optional
        Vanishing points of D directions in homogeneous pixels, each in at least two views, NaN where not
        seen; otherwise directions are detected in the images.
    images : tuple of Image
        One image per view.
    orthogonal_directions : bool
        The three best supported (of given points: first) directions are orthogonal: v_a' w v_b = 0 (HZ 8.6).
    """

    points: F64 | None = field(default=None, metadata={"given": True})
    images: tuple[Image, ...] = field(default=(), metadata={"given": True}, repr=False)
    orthogonal_directions: bool = False

    max_wrong_side_ratio = 0.02  # largest accepted share of points and cameras on the wrong side of a plane
    max_candidates = 5  # maximum number of planes
    detector = LineSegments()

    def locate(self, scene: ProjectiveScene, rng: np.random.Generator) -> PlaneCandidates:
        """See `thesisrecon.selfcalibration.cheirality.CheiralitySearch.locate`; one plane of given points."""
        frame = scene.frame
        if self.points is not None:
            unit = np.linalg.inv(frame.pixel_from_unit[frame.views])
            X = _points_at_infinity(frame.P, np.einsum("vij,vdj->vdi", unit, self.points[frame.views]))
            return PlaneCandidates(_plane_through_points(X)[None], self._orthogonal(unit_rows(X[:, :3])))
        if len(self.images) != len(scene.reconstruction.P):
            views, needed = len(scene.reconstruction.P), "vanishing points, or an image for each of the"
            raise ValueError(f"ParallelLines needs {needed} {views} views; got {len(self.images)} images")
        pixels = [self.detector.detect(self.images[view].gray) for view in frame.views]
        segments = _normalize_segments(frame, pixels)
        of_view = (segments.subset(segments.camera == place) for place in range(len(frame.views)))
        proposals = [_propose_vanishing_points(mine, rng) for mine in of_view]
        X, direction = _find_parallel_directions(frame.P, segments, proposals)
        region = CheiralityRegion.of(frame, scene.reconstruction, rng)
        return self._best_triples(frame, segments, region, X, direction)

    def _orthogonal(self, v: F64) -> F64 | None:
        return v[[(0, 1), (0, 2), (1, 2)]] if self.orthogonal_directions else None

    def _best_triples(
        self, frame: ReferenceFrame, segments: _SegmentSet, region: CheiralityRegion, X: F64, direction: I64
    ) -> PlaneCandidates:
        """Return planes of triples of directions with the scene on one side, refined on their segments."""
        counts = np.bincount(direction[direction >= 0], minlength=len(X))
        planes, scores, points = [], [], []
        for triple in combinations(range(len(X)), 3):
            chosen = list(triple)
            try:
                plane = _plane_through_points(X[chosen])
            except StageFailure:
                continue
            # The place of each direction in the triple.
            place = np.array([chosen.index(d) if d in chosen else -1 for d in range(-1, len(X))])
            v = unit_rows(X[chosen, :3])
            plane, v, _ = _refine_plane(frame, segments, place[direction + 1], plane, v)
            if region.wrong_side_ratio(plane[None])[0] <= self.max_wrong_side_ratio:
                planes.append(plane)
                scores.append(1.0 / float(counts[chosen].min()))
                points.append(v)
        if not planes:
            raise StageFailure.of(
                "no-plane-of-directions", len(X), ", ".join(str(c) for c in counts) or "no", len(frame.views)
            )
        order = np.argsort(scores, kind="stable")[: 1 if self.orthogonal_directions else self.max_candidates]
        return PlaneCandidates(np.array(planes)[order], self._orthogonal(points[order[0]]))


def _points_at_infinity(P: F64, v: F64) -> F64:
    """Triangulated points (D', 4) of the directions that vanishing points v (V, D, 3) in P determine."""
    v = v / np.linalg.norm(v, axis=2, keepdims=True)
    seen: B8 = np.asarray(np.isfinite(v).all(axis=2))
    used = np.flatnonzero(seen.sum(axis=0) >= 2)
    found = [_triangulate_directions(P[None, seen[:, d]], v[None, seen[:, d], d]) for d in used]
    X = [point for points, determined in found for point in points[determined]]
    if len(X) < 3:
        raise StageFailure.of("few-parallel-directions", len(X))
    return np.stack(X)


def plane_from_vanishing_points(P: F64, xyh: F64, unit: F64) -> F64:
    """The unit plane at infinity (4,) from vanishing points xyh (V, D, 3), NaN where not seen."""
    require_cameras_of_full_rank(P)
    cameras = np.linalg.inv(unit) @ P
    cameras = cameras / np.linalg.norm(cameras, axis=(1, 2), keepdims=True)
    # In this frame of space the rows of the cameras are orthonormal.
    M = np.linalg.qr(cameras.reshape(-1, 4))[1]
    X = _points_at_infinity(cameras @ np.linalg.inv(M), np.einsum("vij,vdj->vdi", np.linalg.inv(unit), xyh))
    plane = M.T @ _null_plane(X)
    return np.asarray(plane / np.linalg.norm(plane))


def _null_plane(X: F64, *, finite: bool = False) -> F64:
    """Return the plane (4,) through three or more points (D, 4); ``finite``: not through the origin."""
    _, s, Vt = np.linalg.svd(unit_rows(X))
    ratio = float(s[2] / s[0]) if not finite or abs(Vt[-1, 3]) > 1e-9 else 0.0
    if not ratio > _MIN_SPREAD:
        raise StageFailure.of("directions-in-one-plane", ratio)
    return np.asarray(Vt[-1])


def _plane_through_points(X: F64) -> F64:
    """Return p (3,) of the plane (p, 1) through three or more points (D, 4)."""
    plane = _null_plane(X, finite=True)
    return np.asarray(plane[:3] / plane[3])
