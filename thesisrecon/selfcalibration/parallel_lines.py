"""Parallel lines found in photographs: vanishing points of each, matched over all through the cameras.

Every photograph proposes vanishing points (pairs of segments, the consensus of all). A vanishing point of one
photograph and one of another make a point of projective space if they are the same direction, and that point
is seen by every other camera: the segments of all photographs that run towards it are its support. No
calibration is needed for this; the points of three directions span the plane at infinity.

Chapter 7, stratified: the plane at infinity from parallel lines.

Parallel lines meet in a point at infinity, which is seen as their vanishing point; three such points that are
not on a line span the plane. Directions at right angles determine the calibration as well: v_a' w v_b = 0.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import StageFailure
from thesisrecon.records import Image
from thesisrecon.selfcalibration.cheirality import CheiralityRegion, PlaneCandidates, ProjectiveScene
from thesisrecon.selfcalibration.frame import ReferenceFrame
from thesisrecon.selfcalibration.line_segments import LineSegments
from thesisrecon.selfcalibration.refinement import minimize_batch

NEAR = 4.0
"""Segments within this many tolerances of a direction are not offered to another one."""

NEARLY = -2

_FIRST_NOISE_PX, _LEAST_NOISE_PX = 0.5, 1e-3
_MIN_SEGMENTS = 6


@dataclass(frozen=True)
class SegmentSet:
    """Segments of all photographs in unit-free coordinates: ``camera`` (S,) place in the frame, ``middle``
    (S, 2), unit ``along`` (S, 2), ``half`` (S,) half the length in px."""

    camera: I64
    middle: F64
    along: F64
    half: F64

    def subset(self, keep: B8 | I64) -> SegmentSet:
        """The kept ones."""
        return SegmentSet(self.camera[keep], self.middle[keep], self.along[keep], self.half[keep])

    def endpoint_distances_px(self, v: F64) -> F64:
        """Distance (..., S) px by which a segment, turned about its middle to the points v (..., S, 3),
        misses its ends."""
        towards = v[..., :2] - v[..., 2:] * self.middle
        norm = np.maximum(np.linalg.norm(towards, axis=-1), 1e-300)
        across = towards[..., 0] * self.along[:, 1] - towards[..., 1] * self.along[:, 0]
        return np.asarray(across / norm * self.half)


def normalize_segments(frame: ReferenceFrame, segments: list[F64]) -> SegmentSet:
    """Pixel segments (S_i, 4) of each registered camera in the frame's coordinates."""
    parts = []
    for place, pixels in enumerate(segments):
        unit = np.linalg.inv(frame.pixel_from_unit[frame.views[place]])
        ends = pixels.reshape(-1, 2, 2) @ unit[:2, :2].T + unit[:2, 2]
        step = ends[:, 1] - ends[:, 0]
        length = np.maximum(np.linalg.norm(step, axis=1), 1e-300)
        half = 0.5 * np.linalg.norm(pixels[:, 2:] - pixels[:, :2], axis=1)
        parts.append((np.full(len(pixels), place), ends.mean(axis=1), step / length[:, None], half))
    camera, middle, along, half = (np.concatenate([part[k] for part in parts]) for k in range(4))
    return SegmentSet(camera.astype(np.int64), middle, along, half)


def support(segments: SegmentSet, v: F64, tolerance_px: float) -> F64:
    """Support (..., S) of points v (..., S, 3): length times how well it fits, 0 beyond the tolerance."""
    miss = segments.endpoint_distances_px(v) / tolerance_px
    return np.asarray(segments.half * np.maximum(1.0 - miss**2, 0.0))


def propose_vanishing_points(
    segments: SegmentSet, *, keep: int, samples: int, tolerance_px: float, rng: np.random.Generator
) -> F64:
    """Vanishing points (K, 3) of one photograph, the best supported first: each is refined on its segments,
    which then are taken away."""
    found: list[F64] = []
    left = segments
    while len(found) < keep and len(left.half) >= 5:
        weight = left.half / left.half.sum()
        first, second = (rng.choice(len(weight), samples, p=weight) for _ in range(2))
        lines = np.cross(_homogeneous(left.middle), np.column_stack([left.along, np.zeros(len(left.half))]))
        v = np.cross(lines[first], lines[second])
        v = v[np.linalg.norm(v, axis=1) > 1e-9]
        if not len(v):
            break
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        total = support(left, v[:, None], tolerance_px).sum(axis=1)
        best = v[total.argmax()]
        mine = support(left, best[None], tolerance_px) > 0
        if mine.sum() < 4:
            break
        best = _nearest_to_lines(lines[mine], left.half[mine])
        found.append(best)
        left = left.subset(~mine & (np.abs(left.endpoint_distances_px(best[None])) > NEAR * tolerance_px))
    return np.array(found).reshape(-1, 3)


def _homogeneous(xy: F64) -> F64:
    return np.column_stack([xy, np.ones(len(xy))])


def _nearest_to_lines(lines: F64, weight: F64) -> F64:
    scaled = lines / np.linalg.norm(lines, axis=1, keepdims=True) * weight[:, None]
    return np.asarray(np.linalg.svd(scaled, full_matrices=False)[2][2])


def triangulate_directions(P: F64, v: F64) -> F64:
    """Space points (B, 4) of unit norm from image points v (B, n, 3) in cameras P (B, n, 3, 4).

    v x P X = 0 by least squares; any of them may be at infinity."""
    rows = np.cross(v[..., None], P, axisa=-2, axisb=-2, axisc=-2)
    normal = np.einsum("bnri,bnrj->bij", rows, rows)
    return np.asarray(np.linalg.eigh(normal)[1][:, :, 0])


def find_parallel_directions(
    frame: ReferenceFrame,
    segments: SegmentSet,
    vanishing_points_per_image: list[F64],
    *,
    keep: int,
    tolerance_px: float,
) -> tuple[F64, I64]:
    """Points at infinity (D, 4) in the reference frame, the best supported first, and the direction (S,) of
    every segment, -1 for none.

    ``proposals`` are the vanishing points (K_i, 3) of each camera. A point needs support in three cameras,
    so that the third confirms what two made.
    """
    P = np.concatenate([frame.A, frame.a[:, :, None]], axis=2)
    candidates = _triangulated_pairs(P, vanishing_points_per_image)
    direction = np.full(len(segments.half), -1, dtype=np.int64)
    found: list[F64] = []
    while len(found) < keep and len(candidates):
        free = np.flatnonzero(direction == -1)
        left = segments.subset(free)
        total = np.concatenate([
            support(left, np.einsum("sij,bj->bsi", P[left.camera], part), tolerance_px).sum(axis=1)
            for part in np.array_split(candidates, max(1, len(candidates) // 64))
        ])  # fmt: skip
        X = _refined_point(P, left, candidates[total.argmax()], tolerance_px)
        mine = support(left, (P @ X)[left.camera], tolerance_px) > 0
        if mine.sum() < 8 or len(np.unique(left.camera[mine])) < 3:
            break
        direction[free[mine]] = len(found)
        found.append(X)
        # What nearly fits belongs to it too; left over, it would come up again as a direction of its own.
        near = np.abs(left.endpoint_distances_px((P @ X)[left.camera])) < NEAR * tolerance_px
        direction[free[near & ~mine]] = NEARLY
    return np.array(found).reshape(-1, 4), np.maximum(direction, -1)


def _triangulated_pairs(P: F64, vanishing_points_per_image: list[F64]) -> F64:
    """Points (B, 4) of every two vanishing points of different cameras that lie on each other's epipolar
    line to a few degrees."""
    i, j, v1, v2 = [], [], [], []
    for a in range(len(P)):
        for b in range(a + 1, len(P)):
            first, second = np.indices(
                (len(vanishing_points_per_image[a]), len(vanishing_points_per_image[b]))
            ).reshape(2, -1)
            i.append(np.full(len(first), a))
            j.append(np.full(len(first), b))
            v1.append(vanishing_points_per_image[a][first])
            v2.append(vanishing_points_per_image[b][second])
    pair = np.column_stack([np.concatenate(i), np.concatenate(j)])
    v = np.stack([np.concatenate(v1), np.concatenate(v2)], axis=1)
    v /= np.linalg.norm(v, axis=-1, keepdims=True)
    X = triangulate_directions(P[pair], v)
    seen = np.einsum("bnij,bj->bni", P[pair], X)
    sine = np.linalg.norm(np.cross(seen, v), axis=-1) / np.maximum(np.linalg.norm(seen, axis=-1), 1e-300)
    return np.asarray(X[sine.max(axis=1) < 0.1])


def _refined_point(P: F64, segments: SegmentSet, X: F64, tolerance_px: float) -> F64:
    """X (4,) moved to least misses of its segments, whose choice widens with the better point."""
    for _ in range(3):
        mine = segments.subset(support(segments, (P @ X)[segments.camera], tolerance_px) > 0)
        if len(mine.half) < 4:
            break
        tangent = np.linalg.svd(X[None])[2][1:]

        def endpoint_distances_px(
            step: F64, X: F64 = X, tangent: F64 = tangent, mine: SegmentSet = mine
        ) -> F64:
            return mine.endpoint_distances_px(np.einsum("sij,bj->bsi", P[mine.camera], X + step @ tangent))

        step = minimize_batch(
            endpoint_distances_px, np.zeros((1, 3)), iterations=10, loss_scale=tolerance_px / 2.0
        )[0][0]
        X = X + step @ tangent
        X = X / np.linalg.norm(X)
    return X


def refine_plane(
    frame: ReferenceFrame, segments: SegmentSet, direction: I64, plane: F64, v: F64
) -> tuple[F64, F64, float]:
    """Plane p (3,) and vanishing points v (D, 3) in the reference view that fit all segments together.

    A direction seen at v in the reference view is seen at H_i v in view i, so plane and directions share the
    least squares over the segments of every photograph (``direction`` (S,), -1 for none). After each of four
    passes the noise is estimated, robustly, and segments beyond 2.5 times it are left out of the next.
    Returns also the noise in px.
    """
    kept, noise = direction >= 0, _FIRST_NOISE_PX
    for _ in range(4):
        plane, v = _fit_plane(frame, segments.subset(kept), direction[kept], (plane, v), noise)
        endpoint_distances_px = np.abs(
            _plane_misses(frame, segments, np.maximum(direction, 0), plane[None], v[None])[0]
        )
        noise = max(1.4826 * float(np.median(endpoint_distances_px[direction >= 0])), _LEAST_NOISE_PX)
        trimmed = (direction >= 0) & (endpoint_distances_px <= 2.5 * noise)
        counts = np.bincount(direction[trimmed], minlength=len(v))
        if counts.min() < _MIN_SEGMENTS:
            break
        kept = trimmed
    return plane, v, noise


def _plane_misses(frame: ReferenceFrame, segments: SegmentSet, of: I64, plane: F64, v: F64) -> F64:
    """Misses (B, S) px of segments of directions ``of`` (S,) under planes (B, 3) and points v (B, D, 3)."""
    w, camera = v[:, of], segments.camera
    depth = np.einsum("bsi,bi->bs", w, plane)
    return segments.endpoint_distances_px(
        np.einsum("sij,bsj->bsi", frame.A[camera], w) - frame.a[camera] * depth[..., None]
    )


def _fit_plane(
    frame: ReferenceFrame, segments: SegmentSet, of: I64, start: tuple[F64, F64], noise: float
) -> tuple[F64, F64]:
    plane, v = start
    tangents = np.stack([np.linalg.svd(row[None])[2][1:] for row in v])

    def moved(x: F64) -> F64:
        return np.asarray(v + np.einsum("bdk,dki->bdi", x[:, 3:].reshape(len(x), len(v), 2), tangents))

    x, _ = minimize_batch(
        lambda x: _plane_misses(frame, segments, of, plane + x[:, :3], moved(x)),
        np.zeros((1, 3 + 2 * len(v))), iterations=30, loss_scale=noise,
    )  # fmt: skip
    points = moved(x)[0]
    return plane + x[0, :3], points / np.linalg.norm(points, axis=1, keepdims=True)


_MIN_SPREAD = 1e-3


@dataclass(frozen=True)
class VanishingPoints:
    """Vanishing points that somebody knows: ``view`` (M,) number, ``direction`` (M,) number of the parallel
    lines, ``xyh`` (M, 3) homogeneous pixels (third coordinate 0 for one at infinity)."""

    view: I64
    direction: I64
    xyh: F64


@dataclass(frozen=True)
class ParallelLines:
    """The plane at infinity through the vanishing points of three or more directions.

    ``points`` are given ones, each direction in two views or more; without them directions are found in the
    ``photographs`` (one per view), by ``detector`` for the segments, up to ``proposals`` vanishing points a
    photograph and ``directions`` in all, with a tolerance of ``tolerance_px`` at the ends of a segment. With
    ``right_angles`` the three best supported directions (of given points: the first three) are taken to be
    at right angles, and help the calibration. Planes that leave more than the share ``max_outside`` of the
    scene on the wrong side are dropped, ``keep`` at most are handed on.
    """

    points: VanishingPoints | None = field(default=None, metadata={"given": True})
    images: tuple[Image, ...] = field(default=(), metadata={"given": True}, repr=False)
    detector: LineSegments = field(default_factory=LineSegments)
    orthogonal_directions: bool = False
    vanishing_points_per_image: int = 6
    max_directions: int = 6
    samples: int = 400
    tolerance_px: float = 1.5
    max_wrong_side_ratio: float = 0.02
    keep: int = 5

    def with_images(self, images: Iterable[Image]) -> ParallelLines:
        """The same with the photographs to look at, one per view."""
        return replace(self, images=tuple(images))

    def locate(self, scene: ProjectiveScene, rng: np.random.Generator) -> PlaneCandidates:
        """One candidate from given points, one or more from photographs, the best supported first.

        ``StageFailure`` where there are no three directions, or they do not span a plane that keeps the scene
        on one side; ``ValueError`` where neither points nor photographs were given.
        """
        if self.points is not None:
            return self._from_points(scene.frame, self.points)
        if len(self.images) != len(scene.reconstruction.P):
            raise ValueError(
                f"ParallelLines needs vanishing points, or a photograph for each of the "
                f"{len(scene.reconstruction.P)} views; got {len(self.images)} photographs"
            )
        return self._from_photographs(scene, rng)

    def _from_points(self, frame: ReferenceFrame, given: VanishingPoints) -> PlaneCandidates:
        X = points_at_infinity(frame, given)
        plane = plane_through_points(X)
        v = X[:, :3] / np.linalg.norm(X[:, :3], axis=1, keepdims=True)
        return PlaneCandidates(plane[None], np.zeros(1), self._orthogonal(v))

    def _orthogonal(self, v: F64) -> F64:
        pairs = list(combinations(range(3), 2)) if self.orthogonal_directions else []
        return np.array([[v[a], v[b]] for a, b in pairs]).reshape(-1, 2, 3)

    def _from_photographs(self, scene: ProjectiveScene, rng: np.random.Generator) -> PlaneCandidates:
        frame = scene.frame
        pixels = [self.detector.detect(self.images[view].gray) for view in frame.views]
        segments = normalize_segments(frame, pixels)
        vanishing_points_per_image = [
            propose_vanishing_points(
                segments.subset(segments.camera == place), keep=self.vanishing_points_per_image, samples=self.samples,
                tolerance_px=self.tolerance_px, rng=rng,
            )
            for place in range(len(frame.views))
        ]  # fmt: skip
        X, direction = find_parallel_directions(
            frame,
            segments,
            vanishing_points_per_image,
            keep=self.max_directions,
            tolerance_px=self.tolerance_px,
        )
        region = CheiralityRegion.of(frame, scene.reconstruction, max_points=2000, rng=rng)
        return self._best_triples(frame, segments, region, X, direction)

    def _best_triples(
        self, frame: ReferenceFrame, segments: SegmentSet, region: CheiralityRegion, X: F64, direction: I64
    ) -> PlaneCandidates:
        """Planes of triples of directions that keep the scene on one side, the best supported triple first;
        each refined on all its segments."""
        counts = np.bincount(direction[direction >= 0], minlength=len(X))
        planes, scores, points = [], [], []
        for triple in combinations(range(len(X)), 3):
            chosen = list(triple)
            try:
                plane = plane_through_points(X[chosen])
            except StageFailure:
                continue
            v = X[chosen, :3] / np.linalg.norm(X[chosen, :3], axis=1, keepdims=True)
            renumbered = np.full(len(direction), -1)
            for k, old in enumerate(chosen):
                renumbered[direction == old] = k
            plane, v, _ = refine_plane(frame, segments, renumbered, plane, v)
            if region.wrong_side_ratio(plane[None])[0] <= self.max_wrong_side_ratio:
                planes.append(plane)
                scores.append(1.0 / float(counts[chosen].min()))
                points.append(v)
        if not planes:
            raise StageFailure(
                "no three directions of parallel lines were found whose plane keeps the scene on one side",
                f"{len(X)} directions, with {', '.join(str(c) for c in counts) or 'no'} segments, in "
                f"{len(frame.views)} photographs",
                "give vanishing points, or use another way to the plane at infinity",
            )
        order = np.argsort(scores, kind="stable")[: 1 if self.orthogonal_directions else self.keep]
        return PlaneCandidates(
            np.array(planes)[order], np.array(scores)[order], self._orthogonal(points[order[0]])
        )


def points_at_infinity(frame: ReferenceFrame, given: VanishingPoints) -> F64:
    """Points (D, 4) in the reference frame of given vanishing points, triangulated; D in order of direction.

    ``StageFailure`` for fewer than three directions seen in two registered views each.
    """
    place = {int(view): k for k, view in enumerate(frame.views)}
    P = np.concatenate([frame.A, frame.a[:, :, None]], axis=2)
    unit = np.linalg.inv(frame.pixel_from_unit)
    found = []
    for d in np.unique(given.direction):
        mine = [m for m in np.flatnonzero(given.direction == d) if int(given.view[m]) in place]
        if len(mine) < 2:
            continue
        v = np.array([unit[given.view[m]] @ given.xyh[m] for m in mine])
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        found.append(triangulate_directions(P[[place[int(given.view[m])] for m in mine]][None], v[None])[0])
    if len(found) < 3:
        raise StageFailure(
            "the plane at infinity needs three directions of parallel lines",
            f"{len(found)} have vanishing points in two registered photographs",
            "give the vanishing points of a third direction",
        )
    return np.array(found)


def plane_through_points(X: F64) -> F64:
    """p (3,) of the plane (p, 1) nearest to points (D, 4) at infinity, D >= 3, by SVD.

    ``StageFailure`` where they lie on a line: directions parallel to one plane do not fix it.
    """
    _, s, Vt = np.linalg.svd(X / np.linalg.norm(X, axis=1, keepdims=True))
    plane = Vt[-1]
    if not s[2] > _MIN_SPREAD * s[0] or abs(plane[3]) < 1e-9:
        raise StageFailure(
            "the directions of the parallel lines lie in one plane, so their vanishing points do not fix the "
            "plane at infinity",
            f"the third singular value is {s[2] / s[0]:.1e} of the first",
            "give lines of a direction out of that plane",
        )
    return np.asarray(plane[:3] / plane[3])
