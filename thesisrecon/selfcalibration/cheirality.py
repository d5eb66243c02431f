"""The plane at infinity in its cheirality bounds: Hartley's search and Pollefeys' modulus constraint.

The inequalities X'v > 0, delta C'v > 0 of planes that keep points and cameras on one side form a polytope,
bounded in a quasi-affine frame (HZ 21; R. Hartley, IJCV 26(1), 1998). The orientation delta is unknown: of
the two polytopes one is usually empty.

Modulus constraint (M. Pollefeys, L. Van Gool, PAMI 21(8), 1999; HZ 19.5): between views of one constant K the
infinite homography is conjugate to a rotation times c: its eigenvalues have equal modulus. With det(x H_i -
H_j) = l3 x^3 + l2 x^2 + l1 x + l0, each affine in the plane, this is l3 l1^3 = l2^3 l0. With
c^3 = -l0 / l3 both -l2 / (l3 c) and l1 / (l3 c^2) equal 1 + 2 cos(angle); their difference is of first degree
near the solution.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.camera_matrix import camera_centre, orient_signs
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.records import Reconstruction
from thesisrecon.selfcalibration import _frame
from thesisrecon.selfcalibration._refinement import minimize_batch
from thesisrecon.selfcalibration.absolute_conic import solve_conic_batch

MAX_POINTS = 2000  # maximum number of points in the linear programs


@dataclass(frozen=True)
class Polytope:
    """Planes (v, 1), v in a ``box`` (3, 2), with ``rows`` (M, 4) (v, 1) > 0 in a quasi-affine frame."""

    rows: F64
    quasi_affine: F64
    box: F64

    def contains(self, v: F64) -> B8:
        """Return whether planes (B, 3) of the quasi-affine frame satisfy every inequality."""
        parts = np.array_split(homogenize(v), max(1, len(v) // 512))
        return np.concatenate([(part @ self.rows.T > 0).all(axis=1) for part in parts])

    def reference_planes(self, v: F64) -> F64:
        """Return planes p (B, 3) of the reference frame from planes (B, 3) of the quasi-affine frame."""
        back = homogenize(v) @ self.quasi_affine
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
    """Oriented points (M, 4) and centres (R, 4) in the reference frame, and the non-empty polytopes."""

    points: F64
    centres: F64
    polytopes: tuple[Polytope, ...]

    @classmethod
    def of(
        cls, frame: _frame.ReferenceFrame, reconstruction: Reconstruction, rng: np.random.Generator
    ) -> "CheiralityRegion":
        """Compute the region by up to ``MAX_POINTS`` points of three views or more; no polytopes below eight.

        A wrong point of two views would exclude the true plane; points without consistent depths are omitted.
        """
        tracks, inlier = reconstruction.tracks, reconstruction.inlier
        view, point = tracks.view_index[inlier], tracks.point_index[inlier]
        views, points, _ = orient_signs(reconstruction.P, reconstruction.X, view, point)
        P, X = reconstruction.P * views[:, None, None], reconstruction.X * points[:, None]
        positive = np.einsum("kj,kj->k", P[view, 2], X[point]) > 0
        seen = np.bincount(point, minlength=len(X))
        chosen = np.flatnonzero((seen >= 3) & (np.bincount(point, positive, minlength=len(X)) == seen))
        if len(chosen) > MAX_POINTS:
            chosen = np.sort(rng.choice(chosen, MAX_POINTS, replace=False))
        T = frame.reference_from_projective
        C = unit_rows(camera_centre(P[frame.views] @ np.linalg.inv(T)) * np.sign(np.linalg.det(T)))
        X = unit_rows(X[chosen] @ T.T)
        found = [_polytope_of(X, sign * C) for sign in (1.0, -1.0)] if len(X) >= 8 else []
        return cls(X, C, tuple(part for part in found if part is not None))

    def sample(self, n: int, rng: np.random.Generator) -> F64:
        """Draw ``n`` planes p (n, 3) in equal shares; standard normal if both polytopes are empty."""
        if not self.polytopes:
            return rng.normal(size=(n, 3))
        share = -(-n // len(self.polytopes))
        return np.concatenate([p.reference_planes(p.sample(share, rng)) for p in self.polytopes])[:n]

    def wrong_side_ratio(self, planes: F64) -> F64:
        """Return the share (B,) of points and cameras on the wrong side of planes (B, 3)."""
        v, wrong, total = homogenize(planes), np.zeros(len(planes)), len(self.points) + len(self.centres)
        for part in (self.points, self.centres):
            behind = (v @ part.T <= 0).sum(axis=1)
            wrong += np.minimum(behind, len(part) - behind)
        return wrong / max(total, 1)


def _polytope_of(X: F64, C: F64) -> Polytope | None:
    """The polytope of oriented points (N, 4) and centres (R, 4); None if empty or if all points are one."""
    rows = np.concatenate([X, C])
    # The plane v with rows v >= d, |v| <= 1 and the largest d (HZ 21).
    A, bounds = np.column_stack([-rows, np.ones(len(rows))]), [(-1, 1)] * 4 + [(None, None)]
    deepest = scipy.optimize.linprog([0, 0, 0, 0, -1], A_ub=A, b_ub=np.zeros(len(rows)), bounds=bounds)
    extent = np.linalg.svd(X, compute_uv=False)
    if deepest.x is None or not deepest.x[4] > 0 or not extent[1] > 1e-12 * extent[0]:
        return None
    # The transform that sends the plane v to infinity and whitens the points.
    v = np.asarray(deepest.x[:4], dtype=np.float64)
    basis = np.linalg.svd(v[None])[2][1:]
    Y = X @ basis.T / (X @ v)[:, None]
    centre = Y.mean(axis=0)
    value, vector = np.linalg.eigh(np.cov((Y - centre).T))
    whiten = vector @ np.diag(np.maximum(value, np.finfo(np.float64).eps * value.max()) ** -0.5) @ vector.T
    T = np.concatenate([whiten @ (basis - np.outer(centre, v)), v[None]])
    rows = unit_rows(rows @ T.T)
    box = _plane_box(rows)
    return None if box is None else Polytope(rows, T, box)


def distinct_planes(planes: F64, cost: F64) -> list[int]:
    """Indices of planes (B, 3) that differ by more than 1e-3 of 1 + |p|, lowest finite cost first."""
    kept: list[int] = []
    for k in np.argsort(cost, kind="stable"):
        limit = 1e-3 * (1.0 + np.linalg.norm(planes[k]))
        if np.isfinite(cost[k]) and all(np.linalg.norm(planes[k] - planes[m]) > limit for m in kept):
            kept.append(int(k))
    return kept


def unit_rows(A: F64) -> F64:
    return np.asarray(A / np.maximum(np.linalg.norm(A, axis=1, keepdims=True), 1e-300), dtype=np.float64)


def _plane_box(rows: F64) -> F64 | None:
    """Return bounds (3, 2) of v for planes (v, 1) that satisfy the inequalities; None if unbounded."""
    box = np.zeros((3, 2))
    for k, side in np.ndindex(3, 2):
        goal = np.zeros(3)
        goal[k] = (1.0, -1.0)[side]
        solution = scipy.optimize.linprog(goal, A_ub=-rows[:, :3], b_ub=rows[:, 3], bounds=[(None, None)] * 3)
        if solution.x is None or not solution.success:
            return None
        box[k, side] = solution.x[k]
    return box


@dataclass(frozen=True)
class CheiralitySearch:
    """Grid search for the plane at infinity (R. Hartley, E. Hayman, L. de Agapito, I. Reid, ICCV 1999).

    Each plane of the grid gives infinite homographies and linear equations of the image of the conic.
    Candidates are the minima of their residual over the second singular value, 0 for the true plane.
    """

    steps = 16  # grid steps per axis of the bounding box
    max_candidates = 10  # maximum number of local minima
    refine_iterations = 15  # descent steps from each of them

    def locate(self, scene: _frame.ProjectiveScene, rng: np.random.Generator) -> F64:
        """Candidate planes at infinity (B, 3), best first; ``StageFailure`` if there is none."""
        planes, _ = self.search(scene.frame, scene.reconstruction, scene.constraints, rng)
        if not len(planes):
            raise StageFailure.of("no-cheiral-plane")
        return planes

    def search(
        self, frame: _frame.ReferenceFrame, reconstruction: Reconstruction,
        constraints: _frame.ConicConstraints, rng: np.random.Generator,
    ) -> tuple[F64, F64]:  # fmt: skip
        """Planes p (B, 3), best first, and unit-free focal lengths (B,) of the reference camera."""
        region = CheiralityRegion.of(frame, reconstruction, rng)
        parts = [self._minima(frame, constraints, polytope) for polytope in region.polytopes]
        if not parts:
            return np.zeros((0, 3)), np.zeros(0)
        planes, f2, scores = (np.concatenate(part) for part in zip(*parts, strict=True))
        kept = distinct_planes(planes, scores)[: self.max_candidates]
        return planes[kept], np.sqrt(f2[kept])

    def _minima(
        self, frame: _frame.ReferenceFrame, constraints: _frame.ConicConstraints, polytope: Polytope
    ) -> tuple[F64, F64, F64]:
        """Return planes, squared focal lengths and scores of the refined local minima of the grid."""

        def scan(v: F64) -> tuple[F64, F64]:
            H = _frame.infinite_homographies(frame, polytope.reference_planes(v))
            f2, residuals = solve_conic_batch(H, constraints)
            return f2, np.where(polytope.contains(v)[:, None], residuals, np.nan)

        def score(residuals: F64) -> F64:
            return np.asarray(np.nan_to_num(np.linalg.norm(residuals, axis=1), nan=np.inf))

        axes = [np.linspace(low, high, self.steps + 2)[1:-1] for low, high in polytope.box]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        scores = score(scan(grid.reshape(-1, 3))[1]).reshape(grid.shape[:3])
        best = _local_minima(scores)[: self.max_candidates]
        v = grid.reshape(-1, 3)[best]
        if len(v):
            # The score is flat along valleys that are not aligned with the axes of the grid.
            v = minimize_batch(lambda x: scan(x)[1], v, iterations=self.refine_iterations)[0]
        f2, residuals = scan(v)
        return polytope.reference_planes(v), f2, score(residuals)


def _local_minima(score: F64) -> I64:
    """Return flat indices of grid cells (S, S, S) not worse than their 6 neighbours, best first."""
    near = scipy.ndimage.generate_binary_structure(3, 1)
    least = scipy.ndimage.minimum_filter(score, footprint=near, mode="constant", cval=np.inf)
    minimum = np.isfinite(score) & (score <= least)
    flat = np.flatnonzero(minimum.ravel())
    return flat[np.argsort(score.ravel()[flat], kind="stable")]


def _modulus_coefficients(A: F64, a: F64, pairs: I64) -> F64:
    """Return c (M, 4, 4) with l_k(p) = c[k, :3] . p + c[k, 3] for pairs (M, 2) of cameras [A | a]."""
    # From det(lambda X - Y) = lambda^3 det X - lambda^2 tr(adj(X) Y) + lambda tr(X adj(Y)) - det Y, X = A_i -
    # a_i p', Y = A_j - a_j p'; affine, since p changes both by matrices of rank 1.
    probes = np.concatenate([np.eye(3), np.zeros((1, 3))])
    H = A[None] - a[None, :, :, None] * probes[:, None, None, :]
    X, Y = H[:, pairs[:, 0]], H[:, pairs[:, 1]]
    l2, l1 = -np.einsum("bmij,bmji->bm", _adjugate(X), Y), np.einsum("bmij,bmji->bm", X, _adjugate(Y))
    values = np.stack([-np.linalg.det(Y), l1, l2, np.linalg.det(X)], axis=-1)
    return np.asarray(np.concatenate([values[:3] - values[3], values[3:]]).transpose(1, 2, 0))


def _adjugate(M: F64) -> F64:
    rows = [np.cross(M[..., :, (k + 1) % 3], M[..., :, (k + 2) % 3]) for k in range(3)]
    return np.stack(rows, axis=-2)


def _modulus_residuals(coefficients: F64, planes: F64) -> tuple[F64, F64]:
    """Residuals -l2 / (l3 c) - l1 / (l3 c^2) (B, M) of planes (B, 3), and the mean of both terms."""
    values = np.einsum("mkc,bc->bmk", coefficients[..., :3], planes) + coefficients[..., 3]
    l0, l1, l2, l3 = np.moveaxis(values, -1, 0)
    l3 = np.where(np.abs(l3) < 1e-12, 1e-12, l3)
    cube = -l0 / l3
    c = np.cbrt(np.where(np.abs(cube) < 1e-9, 1e-9, cube))
    t1, t2 = -l2 / (l3 * c), l1 / (l3 * c**2)
    return t1 - t2, (t1 + t2) / 2.0


@dataclass(frozen=True)
class ModulusConstraint:
    """Plane at infinity by least squares of the modulus constraint over all pairs of one constant K."""

    starts = 300  # number of planes drawn from the cheirality bounds of either orientation
    max_candidates = 21  # maximum number of solutions: three views have up to 21, four or more have one
    max_wrong_side_ratio = 0.02  # largest accepted share of points and cameras on the wrong side of a plane

    def locate(self, scene: _frame.ProjectiveScene, rng: np.random.Generator) -> F64:
        """See `thesisrecon.selfcalibration.cheirality.CheiralitySearch.locate`; ``rng`` draws the starts."""
        frame = scene.frame
        pairs = _pairs_of_constant_cameras(scene.constraints.first)
        if len(pairs) < 3:
            raise StageFailure.of("few-images-of-one-camera", counted(len(pairs), "pair"))
        region = CheiralityRegion.of(frame, scene.reconstruction, rng)
        starts = region.sample(self.starts, rng)
        coefficients = _modulus_coefficients(frame.A, frame.a, pairs)
        residuals = partial(_modulus_residuals, coefficients)
        planes, cost = minimize_batch(lambda p: residuals(p)[0], starts, iterations=60, loss_scale=0.05)
        is_rotation = np.abs(residuals(planes)[1]) <= 3.05
        fit = np.isfinite(cost) & (is_rotation.mean(axis=1) >= 0.9)
        fit[fit] = region.wrong_side_ratio(planes[fit]) <= self.max_wrong_side_ratio
        planes, cost = planes[fit], cost[fit]
        kept = distinct_planes(planes, cost)[: self.max_candidates]
        if not len(planes):
            raise StageFailure.of("no-modulus-solution", len(starts), len(pairs))
        return np.asarray(planes[kept])


def _pairs_of_constant_cameras(first: I64) -> I64:
    """Return pairs (M, 2) of places whose cameras have the same constant K."""
    return np.argwhere(np.triu(first[:, None] == first, 1))
