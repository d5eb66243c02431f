"""What the ways to the plane at infinity are given, and what they give.

Chapter 7, stratified: the planes that leave all points and camera centres on one side.

Hartley, "Chirality", IJCV 26(1), 1998, and Hartley, Hayman, de Agapito, Reid, "Camera calibration and the
search for infinity", ICCV 1999. The inequalities X'v > 0, delta C'v > 0 make a polytope, bounded in a
quasi-affine frame; the orientation delta is not known beforehand, so there are two of them, of which one is
usually empty.

Chapter 7, stratified: cheirality bounds the plane at infinity, a search in the bounds finds it (Hartley).

R. Hartley, E. Hayman, L. de Agapito, I. Reid, "Camera calibration and the search for infinity", ICCV 1999.
Each plane of a grid gives infinite homographies, these give the image of the absolute conic linearly, and the
planes whose linear equations have a solution, and one alone, are the candidates.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import NDArray

from thesisrecon.arrays import B8, F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import camera_centre, orient_signs
from thesisrecon.records import Reconstruction
from thesisrecon.selfcalibration.frame import ReferenceFrame
from thesisrecon.selfcalibration.hartley import ConicBatch, infinite_homographies, solve_conic_batch
from thesisrecon.selfcalibration.refinement import minimize_batch
from thesisrecon.selfcalibration.unknowns import ConicConstraints, square_pixel_constraints


@dataclass(frozen=True)
class ProjectiveScene:
    """A projective reconstruction, its registered cameras in a reference frame, what is assumed of them."""

    reconstruction: Reconstruction
    frame: ReferenceFrame
    knowledge: ConicConstraints


@dataclass(frozen=True)
class PlaneCandidates:
    """Planes at infinity p (B, 3), each (p, 1) in the reference frame, the best first with their ``scores``.

    ``orthogonal`` (M, 2, 3): pairs of vanishing points in the reference view, unit-free, whose directions are
    taken to be at right angles.
    """

    planes: F64
    scores: F64
    orthogonal: F64 = field(default_factory=lambda: np.zeros((0, 2, 3)))


SAME_PLANE = 1e-3
"""Planes at infinity nearer than this, relative to 1 + |p|, are one."""


@dataclass(frozen=True)
class CheiralityPolytope:
    """Planes v with ``rows`` (M, 4) v > 0, in a quasi-affine frame where all of them are (v1, v2, v3, 1).

    ``quasi_affine`` (4, 4) takes points of the reference frame there; ``box`` (3, 2) bounds of v1, v2, v3.
    """

    rows: F64
    quasi_affine: F64
    box: F64

    def contains(self, v: F64) -> B8:
        """Whether planes (B, 3) of the quasi-affine frame satisfy every inequality."""
        planes = np.column_stack([v, np.ones(len(v))])
        parts = np.array_split(planes, max(1, len(planes) // 512))
        return np.concatenate([(part @ self.rows.T > 0).all(axis=1) for part in parts])

    def reference_planes(self, v: F64) -> F64:
        """Planes p (B, 3), each (p, 1) in the reference frame, of planes (B, 3) of the quasi-affine one."""
        back = np.column_stack([v, np.ones(len(v))]) @ self.quasi_affine
        return np.asarray(back[:, :3] / np.where(back[:, 3:] == 0, 1e-12, back[:, 3:]))

    def sample(self, n: int, rng: np.random.Generator) -> F64:
        """``n`` planes (n, 3) of the quasi-affine frame inside, by hit-and-run from the origin's plane."""
        v = np.zeros((n, 3))
        for _ in range(12):
            direction = rng.normal(size=(n, 3))
            speed, room = direction @ self.rows[:, :3].T, v @ self.rows[:, :3].T + self.rows[:, 3]
            with np.errstate(divide="ignore", invalid="ignore"):
                reach = -room / speed
            far = np.where(speed < 0, reach, np.inf).min(axis=1)
            near = np.where(speed > 0, reach, -np.inf).max(axis=1)
            step = near + (far - near) * rng.random(n)
            v += np.where(np.isfinite(step), step, 0.0)[:, None] * direction
        return v


@dataclass(frozen=True)
class CheiralityRegion:
    """The polytopes of both orientations that are not empty, and the inequalities of all points (M, 4) and
    centres (R, 4) in the reference frame."""

    points: F64
    centres: F64
    polytopes: tuple[CheiralityPolytope, ...]

    @classmethod
    def of(
        cls,
        frame: ReferenceFrame,
        reconstruction: Reconstruction,
        *,
        max_points: int,
        rng: np.random.Generator,
    ) -> CheiralityRegion:
        """The region of a reconstruction; without polytopes where fewer than eight points are of use."""
        X, C = cheirality_inequalities(frame, reconstruction, max_points=max_points, rng=rng)
        found = [polytope_of(X, sign * C) for sign in (1.0, -1.0)] if len(X) >= 8 else []
        return cls(X, C, tuple(part for part in found if part is not None))

    def sample(self, n: int, rng: np.random.Generator) -> F64:
        """``n`` planes p (n, 3) in the reference frame: from the polytopes in equal shares, or where both are
        empty from a broad distribution about no perspective at all."""
        if not self.polytopes:
            return rng.normal(size=(n, 3))
        share = -(-n // len(self.polytopes))
        return np.concatenate([p.reference_planes(p.sample(share, rng)) for p in self.polytopes])[:n]

    def wrong_side_ratio(self, planes: F64) -> F64:
        """Share (B,) of points and cameras on the wrong side of planes p (B, 3), for the better signs."""
        v = np.column_stack([planes, np.ones(len(planes))])
        behind = (v @ self.points.T <= 0).sum(axis=1), (v @ self.centres.T <= 0).sum(axis=1)
        n, m = len(self.points), len(self.centres)
        wrong = np.minimum(behind[0], n - behind[0]) + np.minimum(behind[1], m - behind[1])
        return np.asarray(wrong / max(n + m, 1))


def polytope_of(X: F64, C: F64) -> CheiralityPolytope | None:
    """The polytope of oriented points (N, 4) and centres (R, 4), by linear programs; None where empty."""
    v = deepest_plane(X, C)
    if v is None:
        return None
    T = quasi_affine_frame(X, v)
    rows = _unit_rows(np.concatenate([X, C]) @ T.T)
    box = plane_box(rows[: len(X)], rows[len(X) :])
    return None if box is None else CheiralityPolytope(rows, T, box)


def distinct_planes(planes: F64, cost: F64) -> list[int]:
    """Indices of planes p (B, 3) that differ and whose cost (B,) is finite, the least cost first."""
    kept: list[int] = []
    for k in np.argsort(cost, kind="stable"):
        limit = SAME_PLANE * (1.0 + np.linalg.norm(planes[k]))
        if np.isfinite(cost[k]) and all(np.linalg.norm(planes[k] - planes[m]) > limit for m in kept):
            kept.append(int(k))
    return kept


def cheirality_inequalities(
    frame: ReferenceFrame, reconstruction: Reconstruction, *, max_points: int, rng: np.random.Generator
) -> tuple[F64, F64]:
    """Oriented points (N, 4) and camera centres (R, 4) in the reference frame, unit norm.

    Only points of three or more views take part: one wrong two-view point, which nothing contradicts, would
    cut the true plane away. Points that the orientation cannot satisfy in every view are left out.
    """
    tracks, max_candidates = reconstruction.tracks, reconstruction.inlier
    view, point = tracks.view_index[max_candidates], tracks.point_index[max_candidates]
    views, points, _ = orient_signs(reconstruction.P, reconstruction.X, view, point)
    P = reconstruction.P * views[:, None, None]
    X = reconstruction.X * points[:, None]
    positive = np.einsum("kj,kj->k", P[view, 2], X[point]) > 0
    seen = np.bincount(point, minlength=len(X))
    usable = (seen >= 3) & (np.bincount(point, positive, minlength=len(X)) == seen)
    chosen = np.flatnonzero(usable)
    if len(chosen) > max_points:
        chosen = np.sort(rng.choice(chosen, max_points, replace=False))
    T = frame.reference_from_projective
    sign = np.sign(np.linalg.det(T))
    X_reference = X[chosen] @ T.T
    P_reference = P[frame.views] @ np.linalg.inv(T)
    C = camera_centre(P_reference) * sign
    return _unit_rows(X_reference), _unit_rows(C)


def _unit_rows(A: F64) -> F64:
    return np.asarray(A / np.maximum(np.linalg.norm(A, axis=1, keepdims=True), 1e-300), dtype=np.float64)


def deepest_plane(X: F64, C: F64) -> F64 | None:
    """Plane v with X v >= d, C v >= d, |v| <= 1 and the largest d (a linear program); None where no d > 0
    exists."""
    rows = np.concatenate([X, C])
    A = np.column_stack([-rows, np.ones(len(rows))])
    answer = scipy.optimize.linprog(
        [0, 0, 0, 0, -1], A_ub=A, b_ub=np.zeros(len(rows)), bounds=[(-1, 1)] * 4 + [(None, None)]
    )
    if answer.x is None or not answer.x[4] > 0:
        return None
    return np.asarray(answer.x[:4], dtype=np.float64)


def quasi_affine_frame(X: F64, v: F64) -> F64:
    """Transform (4, 4) that sends the plane v to infinity and makes the points' centroid 0 and covariance
    1."""
    basis = np.linalg.svd(v[None])[2][1:]
    Y = X @ basis.T / (X @ v)[:, None]
    centre = Y.mean(axis=0)
    value, vector = np.linalg.eigh(np.cov((Y - centre).T))
    whiten = vector @ np.diag(np.maximum(value, 1e-18 * value.max()) ** -0.5) @ vector.T
    T = np.zeros((4, 4))
    T[:3] = whiten @ (basis - np.outer(centre, v))
    T[3] = v
    return T


def plane_box(X: F64, C: F64) -> F64 | None:
    """Bounds (3, 2) of v for planes (v, 1) that satisfy the inequalities (six linear programs); None if
    unbounded."""
    rows = np.concatenate([X, C])
    box = np.zeros((3, 2))
    for k in range(3):
        for side, sign in enumerate((1.0, -1.0)):
            goal = np.zeros(3)
            goal[k] = sign
            answer = scipy.optimize.linprog(
                goal, A_ub=-rows[:, :3], b_ub=rows[:, 3], bounds=[(None, None)] * 3
            )
            if answer.x is None or not answer.success:
                return None
            box[k, side] = answer.x[k]
    return box


@dataclass(frozen=True)
class CheiralitySearch:
    """Grid search for the plane at infinity inside the cheirality bounds.

    ``steps`` per axis of the box; ``keep`` local minima at most; ``descent`` steps that follow each of
    them to where it ends, 0 for the grid alone; ``max_points`` in the linear programs.
    """

    steps: int = 16
    max_candidates: int = 10
    refine_iterations: int = 15
    max_points: int = 2000

    def locate(self, scene: ProjectiveScene, rng: np.random.Generator) -> PlaneCandidates:
        """Candidates, the best first; ``StageFailure`` where the inequalities leave no plane with a conic."""
        planes, _, scores = self._search(scene.frame, scene.reconstruction, scene.knowledge, rng)
        if not len(planes):
            raise StageFailure(
                "Hartley's search found no plane at infinity",
                "no plane leaves all points and cameras on one side with a real image of the absolute conic",
                "use the default preset, which does not depend on every single point being right",
            )
        return PlaneCandidates(planes, scores)

    def search(
        self, frame: ReferenceFrame, reconstruction: Reconstruction, rng: np.random.Generator
    ) -> tuple[F64, F64]:
        """Planes p (B, 3) and reference focals (B,) for square pixels, best first; possibly none."""
        planes, focals, _ = self._search(frame, reconstruction, square_pixel_constraints(frame), rng)
        return planes, focals

    def _search(
        self,
        frame: ReferenceFrame,
        reconstruction: Reconstruction,
        knowledge: ConicConstraints,
        rng: np.random.Generator,
    ) -> tuple[F64, F64, F64]:
        region = CheiralityRegion.of(frame, reconstruction, max_points=self.max_points, rng=rng)
        parts = [self._minima(frame, knowledge, polytope) for polytope in region.polytopes]
        if not parts:
            return np.zeros((0, 3)), np.zeros(0), np.zeros(0)
        planes, f2, scores = (np.concatenate(part) for part in zip(*parts, strict=True))
        kept = distinct_planes(planes, scores)[: self.max_candidates]
        return planes[kept], np.sqrt(f2[kept]), scores[kept]

    def _minima(
        self, frame: ReferenceFrame, knowledge: ConicConstraints, polytope: CheiralityPolytope
    ) -> tuple[F64, F64, F64]:
        """Local minima of the score over the grid, each followed to where it ends."""

        def scan(v: F64) -> ConicBatch:
            found = solve_conic_batch(infinite_homographies(frame, polytope.reference_planes(v)), knowledge)
            outside = ~polytope.contains(v)
            return ConicBatch(found.f2, np.where(outside[:, None], np.nan, found.residuals))

        axes = [np.linspace(low, high, self.steps + 2)[1:-1] for low, high in polytope.box]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        best = local_minima(scan(grid.reshape(-1, 3)).score.reshape(grid.shape[:3]))[: self.max_candidates]
        v = grid.reshape(-1, 3)[best]
        if len(v):
            # The score is flat along valleys that no finer grid along the axes would follow.
            v = minimize_batch(lambda x: scan(x).residuals, v, iterations=self.refine_iterations)[0]
        found = scan(v)
        return polytope.reference_planes(v), found.f2, found.score


def local_minima(score: F64) -> NDArray[np.int64]:
    """Flat indices of cells of a grid (S, S, S) not worse than their 6 neighbours, best first."""
    padded = np.pad(score, 1, constant_values=np.inf)
    core = padded[1:-1, 1:-1, 1:-1]
    minimum = np.isfinite(core)
    for axis in range(3):
        for shift in (-1, 1):
            minimum &= core <= np.roll(padded, shift, axis=axis)[1:-1, 1:-1, 1:-1]
    flat = np.flatnonzero(minimum.ravel())
    return flat[np.argsort(score.ravel()[flat], kind="stable")]
