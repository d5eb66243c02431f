"""Cheirality bounds on the plane at infinity, and Hartley's search within them (HZ 21).

R. Hartley, "Chirality", IJCV 26(1), 1998; R. Hartley, E. Hayman, L. de Agapito, I. Reid, "Camera calibration
and the search for infinity", ICCV 1999. The inequalities X'v > 0, delta C'v > 0 form a polytope, bounded in a
quasi-affine frame. The orientation delta is unknown: of the two polytopes one is usually empty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import camera_centre, orient_signs
from thesisrecon.records import Reconstruction
from thesisrecon.selfcalibration._frame import (
    ConicConstraints,
    PlaneCandidates,
    ProjectiveScene,
    ReferenceFrame,
    square_pixel_constraints,
)
from thesisrecon.selfcalibration._refinement import minimize_batch
from thesisrecon.selfcalibration.absolute_conic import ConicBatch, infinite_homographies, solve_conic_batch

# Planes closer than this, relative to 1 + |p|, are the same.
_SAME_PLANE = 1e-3


@dataclass(frozen=True)
class _Polytope:
    """Planes (v, 1) with ``rows`` (M, 4) (v, 1) > 0 in a quasi-affine frame.

    ``quasi_affine`` (4, 4) transforms points of the reference frame there; ``box`` (3, 2) bounds v.
    """

    rows: F64
    quasi_affine: F64
    box: F64

    def contains(self, v: F64) -> B8:
        """Return whether planes (B, 3) of the quasi-affine frame satisfy every inequality."""
        planes = np.column_stack([v, np.ones(len(v))])
        parts = np.array_split(planes, max(1, len(planes) // 512))
        return np.concatenate([(part @ self.rows.T > 0).all(axis=1) for part in parts])

    def reference_planes(self, v: F64) -> F64:
        """Return planes p (B, 3) of the reference frame from planes (B, 3) of the quasi-affine frame."""
        back = np.column_stack([v, np.ones(len(v))]) @ self.quasi_affine
        return np.asarray(back[:, :3] / np.where(back[:, 3:] == 0, 1e-12, back[:, 3:]))

    def sample(self, n: int, rng: np.random.Generator) -> F64:
        """Return ``n`` planes (n, 3) inside, by hit-and-run from the plane of the origin."""
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
    """Planes that keep all points and camera centres on one side.

    Parameters
    ----------
    points, centres : ndarray (M, 4), (R, 4)
        Inequalities of the points and centres in the reference frame.
    polytopes : tuple
        Non-empty polytopes of both orientations.
    """

    points: F64
    centres: F64
    polytopes: tuple[_Polytope, ...]

    @classmethod
    def of(
        cls,
        frame: ReferenceFrame,
        reconstruction: Reconstruction,
        *,
        max_points: int,
        rng: np.random.Generator,
    ) -> CheiralityRegion:
        """Compute the region of a reconstruction.

        Parameters
        ----------
        frame, reconstruction : ReferenceFrame, Reconstruction
            Cameras, and the projective reconstruction.
        max_points, rng : int, numpy.random.Generator
            Maximum number of points in the linear programs, and their random selection.

        Returns
        -------
        CheiralityRegion
            The region, without polytopes below eight usable points.
        """
        X, C = _cheirality_inequalities(frame, reconstruction, max_points=max_points, rng=rng)
        found = [_polytope_of(X, sign * C) for sign in (1.0, -1.0)] if len(X) >= 8 else []
        return cls(X, C, tuple(part for part in found if part is not None))

    def sample(self, n: int, rng: np.random.Generator) -> F64:
        """Draw planes from the polytopes in equal shares.

        Parameters
        ----------
        n, rng : int, numpy.random.Generator
            Number of planes, and source of randomness.

        Returns
        -------
        ndarray (n, 3)
            Planes p of the reference frame; standard normal if both polytopes are empty.
        """
        if not self.polytopes:
            return rng.normal(size=(n, 3))
        share = -(-n // len(self.polytopes))
        return np.concatenate([p.reference_planes(p.sample(share, rng)) for p in self.polytopes])[:n]

    def wrong_side_ratio(self, planes: F64) -> F64:
        """Return the share of points and cameras on the wrong side of planes.

        Parameters
        ----------
        planes : ndarray (B, 3)
            Planes p of the reference frame.

        Returns
        -------
        ndarray (B,)
            Shares for the better choice of signs.
        """
        v = np.column_stack([planes, np.ones(len(planes))])
        behind = (v @ self.points.T <= 0).sum(axis=1), (v @ self.centres.T <= 0).sum(axis=1)
        n, m = len(self.points), len(self.centres)
        wrong = np.minimum(behind[0], n - behind[0]) + np.minimum(behind[1], m - behind[1])
        return np.asarray(wrong / max(n + m, 1))


def _polytope_of(X: F64, C: F64) -> _Polytope | None:
    """Return the polytope of oriented points (N, 4) and centres (R, 4) by linear programs; None if empty."""
    v = _deepest_plane(X, C)
    if v is None:
        return None
    T = _quasi_affine_frame(X, v)
    rows = _unit_rows(np.concatenate([X, C]) @ T.T)
    box = _plane_box(rows[: len(X)], rows[len(X) :])
    return None if box is None else _Polytope(rows, T, box)


def distinct_planes(planes: F64, cost: F64) -> list[int]:
    """Select planes that differ, lowest cost first.

    Parameters
    ----------
    planes, cost : ndarray (B, 3), (B,)
        Planes p with their costs; non-finite costs are rejected.

    Returns
    -------
    list of int
        Indices of the selected planes.
    """
    kept: list[int] = []
    for k in np.argsort(cost, kind="stable"):
        limit = _SAME_PLANE * (1.0 + np.linalg.norm(planes[k]))
        if np.isfinite(cost[k]) and all(np.linalg.norm(planes[k] - planes[m]) > limit for m in kept):
            kept.append(int(k))
    return kept


def _cheirality_inequalities(
    frame: ReferenceFrame, reconstruction: Reconstruction, *, max_points: int, rng: np.random.Generator
) -> tuple[F64, F64]:
    """Return oriented points (N, 4) and camera centres (R, 4) in the reference frame, unit norm.

    Only points of at least three views take part: one wrong two-view point, which nothing contradicts, would
    cut the true plane away. Points whose depths have no consistent sign are omitted.
    """
    tracks, inlier = reconstruction.tracks, reconstruction.inlier
    view, point = tracks.view_index[inlier], tracks.point_index[inlier]
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


def _deepest_plane(X: F64, C: F64) -> F64 | None:
    """Return the plane v with X v >= d, C v >= d, |v| <= 1 and the largest d (HZ 21); None unless d > 0."""
    rows = np.concatenate([X, C])
    A = np.column_stack([-rows, np.ones(len(rows))])
    solution = scipy.optimize.linprog(
        [0, 0, 0, 0, -1], A_ub=A, b_ub=np.zeros(len(rows)), bounds=[(-1, 1)] * 4 + [(None, None)]
    )
    if solution.x is None or not solution.x[4] > 0:
        return None
    return np.asarray(solution.x[:4], dtype=np.float64)


def _quasi_affine_frame(X: F64, v: F64) -> F64:
    """Return the transform (4, 4) that sends the plane v to infinity and whitens the points."""
    basis = np.linalg.svd(v[None])[2][1:]
    Y = X @ basis.T / (X @ v)[:, None]
    centre = Y.mean(axis=0)
    value, vector = np.linalg.eigh(np.cov((Y - centre).T))
    whiten = vector @ np.diag(np.maximum(value, 1e-18 * value.max()) ** -0.5) @ vector.T
    T = np.zeros((4, 4))
    T[:3] = whiten @ (basis - np.outer(centre, v))
    T[3] = v
    return T


def _plane_box(X: F64, C: F64) -> F64 | None:
    """Return bounds (3, 2) of v for planes (v, 1) that satisfy the inequalities; None if unbounded."""
    rows = np.concatenate([X, C])
    box = np.zeros((3, 2))
    for k in range(3):
        for side, sign in enumerate((1.0, -1.0)):
            goal = np.zeros(3)
            goal[k] = sign
            solution = scipy.optimize.linprog(
                goal, A_ub=-rows[:, :3], b_ub=rows[:, 3], bounds=[(None, None)] * 3
            )
            if solution.x is None or not solution.success:
                return None
            box[k, side] = solution.x[k]
    return box


@dataclass(frozen=True)
class CheiralitySearch:
    """Grid search for the plane at infinity within the cheirality bounds (Hartley et al., ICCV 1999; HZ 21).

    Each plane of the grid gives infinite homographies and, linearly, the image of the absolute conic; planes
    whose equations have exactly one solution are the candidates.

    Parameters
    ----------
    steps : int
        Grid steps per axis of the bounding box.
    max_candidates : int
        Maximum number of local minima.
    refine_iterations : int
        Descent steps from each of them; 0 for the grid alone.
    max_points : int
        Maximum number of points in the linear programs.
    """

    steps: int = 16
    max_candidates: int = 10
    refine_iterations: int = 15
    max_points: int = 2000

    def locate(self, scene: ProjectiveScene, rng: np.random.Generator) -> PlaneCandidates:
        """Find candidate planes at infinity, best first.

        Parameters
        ----------
        scene : ProjectiveScene
            Cameras, points and prior.
        rng : numpy.random.Generator
            Selects the points.

        Returns
        -------
        PlaneCandidates
            The planes.

        Raises
        ------
        StageFailure
            If no plane within the bounds gives a real image of the absolute conic.
        """
        planes, _ = self.search(scene.frame, scene.reconstruction, rng, scene.constraints)
        if not len(planes):
            raise StageFailure(
                "the cheirality search found no plane at infinity",
                "no plane keeps points and cameras on one side and gives a real image of the absolute conic",
                "use the default preset, which tolerates wrong points",
            )
        return PlaneCandidates(planes)

    def search(
        self,
        frame: ReferenceFrame,
        reconstruction: Reconstruction,
        rng: np.random.Generator,
        constraints: ConicConstraints | None = None,
    ) -> tuple[F64, F64]:
        """Find planes and focal lengths.

        Parameters
        ----------
        frame, reconstruction : ReferenceFrame, Reconstruction
            Cameras, and the projective reconstruction.
        rng : numpy.random.Generator
            Selects the points.
        constraints : ConicConstraints, optional
            Prior knowledge of the cameras; by default square pixels and a central principal point.

        Returns
        -------
        planes, focals : ndarray (B, 3), (B,)
            Planes p, best first, possibly none, and unit-free focal lengths of the reference camera.
        """
        if constraints is None:
            constraints = square_pixel_constraints(frame)
        region = CheiralityRegion.of(frame, reconstruction, max_points=self.max_points, rng=rng)
        parts = [self._minima(frame, constraints, polytope) for polytope in region.polytopes]
        if not parts:
            return np.zeros((0, 3)), np.zeros(0)
        planes, f2, scores = (np.concatenate(part) for part in zip(*parts, strict=True))
        kept = distinct_planes(planes, scores)[: self.max_candidates]
        return planes[kept], np.sqrt(f2[kept])

    def _minima(
        self, frame: ReferenceFrame, constraints: ConicConstraints, polytope: _Polytope
    ) -> tuple[F64, F64, F64]:
        """Return planes, squared focal lengths and scores of the refined local minima of the grid."""

        def scan(v: F64) -> ConicBatch:
            found = solve_conic_batch(infinite_homographies(frame, polytope.reference_planes(v)), constraints)
            outside = ~polytope.contains(v)
            return ConicBatch(found.f2, np.where(outside[:, None], np.nan, found.residuals))

        axes = [np.linspace(low, high, self.steps + 2)[1:-1] for low, high in polytope.box]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        best = _local_minima(scan(grid.reshape(-1, 3)).score.reshape(grid.shape[:3]))[: self.max_candidates]
        v = grid.reshape(-1, 3)[best]
        if len(v):
            # The score is flat along valleys that are not aligned with the axes of the grid.
            v = minimize_batch(lambda x: scan(x).residuals, v, iterations=self.refine_iterations)[0]
        found = scan(v)
        return polytope.reference_planes(v), found.f2, found.score


def _local_minima(score: F64) -> I64:
    """Return flat indices of grid cells (S, S, S) not worse than their 6 neighbours, best first."""
    padded = np.pad(score, 1, constant_values=np.inf)
    core = padded[1:-1, 1:-1, 1:-1]
    minimum = np.isfinite(core)
    for axis in range(3):
        for shift in (-1, 1):
            minimum &= core <= np.roll(padded, shift, axis=axis)[1:-1, 1:-1, 1:-1]
    flat = np.flatnonzero(minimum.ravel())
    return flat[np.argsort(score.ravel()[flat], kind="stable")]
