"""Chapter 7, stratified: the plane at infinity from parallel lines.

Parallel lines meet in a point at infinity, which is seen as their vanishing point; three such points that are
not on a line span the plane. Directions at right angles determine the calibration as well: v_a' w v_b = 0.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from thesisrecon.errors import StageFailure
from thesisrecon.selfcalibration.frame import ReferenceFrame
from thesisrecon.selfcalibration.stratified.region import PlaneRegion
from thesisrecon.selfcalibration.stratified.scene import PlaneCandidates, ProjectiveScene
from thesisrecon.selfcalibration.stratified.segments import LineSegments
from thesisrecon.selfcalibration.stratified.vanishing_points import (
    SegmentSet,
    find_directions,
    propose_points,
    refine_plane,
    segment_set,
    triangulate_directions,
)
from thesisrecon.types import I64, Image

F64 = NDArray[np.float64]

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
    photographs: tuple[Image, ...] = field(default=(), metadata={"given": True}, repr=False)
    detector: LineSegments = field(default_factory=LineSegments)
    right_angles: bool = False
    proposals: int = 6
    directions: int = 6
    samples: int = 400
    tolerance_px: float = 1.5
    max_outside: float = 0.02
    keep: int = 5

    def with_photographs(self, photographs: Iterable[Image]) -> ParallelLines:
        """The same with the photographs to look at, one per view."""
        return replace(self, photographs=tuple(photographs))

    def locate(self, scene: ProjectiveScene, rng: np.random.Generator) -> PlaneCandidates:
        """One candidate from given points, one or more from photographs, the best supported first.

        ``StageFailure`` where there are no three directions, or they do not span a plane that keeps the scene
        on one side; ``ValueError`` where neither points nor photographs were given.
        """
        if self.points is not None:
            return self._from_points(scene.frame, self.points)
        if len(self.photographs) != len(scene.reconstruction.P):
            raise ValueError(
                f"ParallelLines needs vanishing points, or a photograph for each of the "
                f"{len(scene.reconstruction.P)} views; got {len(self.photographs)} photographs"
            )
        return self._from_photographs(scene, rng)

    def _from_points(self, frame: ReferenceFrame, given: VanishingPoints) -> PlaneCandidates:
        X = points_at_infinity(frame, given)
        plane = plane_through_points(X)
        v = X[:, :3] / np.linalg.norm(X[:, :3], axis=1, keepdims=True)
        return PlaneCandidates(plane[None], np.zeros(1), self._orthogonal(v))

    def _orthogonal(self, v: F64) -> F64:
        pairs = list(combinations(range(3), 2)) if self.right_angles else []
        return np.array([[v[a], v[b]] for a, b in pairs]).reshape(-1, 2, 3)

    def _from_photographs(self, scene: ProjectiveScene, rng: np.random.Generator) -> PlaneCandidates:
        frame = scene.frame
        pixels = [self.detector.detect(self.photographs[view].gray) for view in frame.views]
        segments = segment_set(frame, pixels)
        proposals = [
            propose_points(
                segments.subset(segments.camera == place), keep=self.proposals, samples=self.samples,
                tolerance_px=self.tolerance_px, rng=rng,
            )
            for place in range(len(frame.views))
        ]  # fmt: skip
        X, direction = find_directions(
            frame, segments, proposals, keep=self.directions, tolerance_px=self.tolerance_px
        )
        region = PlaneRegion.of(frame, scene.reconstruction, max_points=2000, rng=rng)
        return self._best_triples(frame, segments, region, X, direction)

    def _best_triples(
        self, frame: ReferenceFrame, segments: SegmentSet, region: PlaneRegion, X: F64, direction: I64
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
            if region.share_outside(plane[None])[0] <= self.max_outside:
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
        order = np.argsort(scores, kind="stable")[: 1 if self.right_angles else self.keep]
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
