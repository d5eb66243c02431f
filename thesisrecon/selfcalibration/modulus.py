"""Plane at infinity by the modulus constraint (chapter 7, stratified; HZ 19.5).

M. Pollefeys, L. Van Gool, PAMI 21(8), 1999. Between views of one constant K the infinite homography is
conjugate to a rotation times c: its eigenvalues have equal modulus. With det(lambda H_i - H_j) = l3 lambda^3
+ l2 lambda^2 + l1 lambda + l0, each affine in the plane, this is l3 l1^3 = l2^3 l0. With c^3 = -l0 / l3 both
-l2 / (l3 c) and l1 / (l3 c^2) equal 1 + 2 cos(angle); their difference is of first degree near the solution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.selfcalibration._frame import PlaneCandidates, ProjectiveScene
from thesisrecon.selfcalibration._refinement import minimize_batch
from thesisrecon.selfcalibration.cheirality import CheiralityRegion, distinct_planes

_SLACK = _LOSS_SCALE = 0.05


def _modulus_coefficients(A: F64, a: F64, pairs: I64) -> F64:
    """Return c (M, 4, 4) with l_k(p) = c[k, :3] . p + c[k, 3] for pairs (M, 2) of cameras [A | a].

    From det(lambda X - Y) = lambda^3 det X - lambda^2 tr(adj(X) Y) + lambda tr(X adj(Y)) - det Y, X = A_i -
    a_i p', Y = A_j - a_j p'; affine, since p changes both by matrices of rank 1.
    """
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

    # Number of planes drawn from the cheirality bounds of either orientation.
    starts = 300
    # Maximum number of solutions: three views have up to 21, four or more have one.
    max_candidates = 21
    # Largest accepted share of points and cameras on the wrong side of a plane.
    max_wrong_side_ratio = 0.02
    # Maximum number of points in the linear programs.
    max_points = 2000

    def locate(self, scene: ProjectiveScene, rng: np.random.Generator) -> PlaneCandidates:
        """See `thesisrecon.selfcalibration.cheirality.CheiralitySearch.locate`; ``rng`` draws the starts."""
        frame = scene.frame
        pairs = _pairs_of_constant_cameras(scene.constraints.first)
        if len(pairs) < 3:
            raise StageFailure(
                "the modulus constraint needs three images of one camera with constant intrinsics",
                f"{counted(len(pairs), 'pair')} of views share all intrinsics",
                "set constant intrinsics, or use another method for the plane at infinity",
            )
        region = CheiralityRegion.of(frame, scene.reconstruction, max_points=self.max_points, rng=rng)
        starts = region.sample(self.starts, rng)
        coefficients = _modulus_coefficients(frame.A, frame.a, pairs)
        planes, cost = minimize_batch(
            lambda p: _modulus_residuals(coefficients, p)[0], starts, iterations=60, loss_scale=_LOSS_SCALE
        )
        is_rotation = np.abs(_modulus_residuals(coefficients, planes)[1]) <= 3.0 + _SLACK
        fit = np.isfinite(cost) & (is_rotation.mean(axis=1) >= 0.9)
        fit[fit] = region.wrong_side_ratio(planes[fit]) <= self.max_wrong_side_ratio
        planes, cost = planes[fit], cost[fit]
        kept = distinct_planes(planes, cost)[: self.max_candidates]
        if not len(planes):
            raise StageFailure(
                "the modulus constraint has no solution with the scene on one side of the plane at infinity",
                f"{len(starts)} starts over {len(pairs)} pairs of views",
                "use another method for the plane at infinity",
            )
        return PlaneCandidates(planes[kept])


def _pairs_of_constant_cameras(first: I64) -> I64:
    """Return pairs (M, 2) of places whose cameras have the same constant K."""
    i, j = np.triu_indices(len(first), 1)
    same = first[i] == first[j]
    return np.column_stack([i[same], j[same]])
