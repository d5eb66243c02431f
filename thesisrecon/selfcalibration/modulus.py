"""Chapter 7, stratified: the plane at infinity by the modulus constraint.

M. Pollefeys and L. Van Gool, "Stratified self-calibration with the modulus constraint", PAMI 21(8), 1999.
Between views of one constant K the infinite homography is conjugate to a rotation times c, so its eigenvalues
have one modulus. With det(lambda H_i - H_j) = l3 lambda^3 + l2 lambda^2 + l1 lambda + l0, each affine in the
plane, this is the quartic l3 l1^3 = l2^3 l0. Both sides are third powers: -l2 / (l3 c) and l1 / (l3 c^2),
c^3 = -l0 / l3, are then the same number 1 + 2 cos(angle), and their difference is a residual of the first
degree near the solution, where the quartic itself is flat.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.selfcalibration.cheirality import (
    CheiralityRegion,
    PlaneCandidates,
    ProjectiveScene,
    distinct_planes,
)
from thesisrecon.selfcalibration.refinement import minimize_batch

_SLACK = _LOSS_SCALE = 0.05


def modulus_coefficients(A: F64, a: F64, pairs: I64) -> F64:
    """Affine coefficients (M, 4, 4): l_k(p) = c[k, :3] . p + c[k, 3], k = 0..3, for pairs (M, 2) of cameras.

    From det(lambda X - Y) = lambda^3 det X - lambda^2 tr(adj(X) Y) + lambda tr(X adj(Y)) - det Y with X =
    A_i - a_i p' and Y = A_j - a_j p'; affine since both are changed by a matrix of rank 1 with the same p.
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


def modulus_quartic(coefficients: F64, planes: F64) -> F64:
    """l3 l1^3 - l2^3 l0 (B, M), the constraint as it is published, over the squared size of its terms."""
    l0, l1, l2, l3 = np.moveaxis(_values(coefficients, planes), -1, 0)
    left, right = l3 * l1**3, l2**3 * l0
    return np.asarray((left - right) / np.maximum(np.abs(left) + np.abs(right), 1e-300))


def _values(coefficients: F64, planes: F64) -> F64:
    return np.asarray(np.einsum("mkc,bc->bmk", coefficients[..., :3], planes) + coefficients[..., 3])


def modulus_residuals(coefficients: F64, planes: F64) -> tuple[F64, F64]:
    """Residuals r = t1 - t2 (B, M) and t = (t1 + t2) / 2 (B, M) of planes (B, 3).

    t1 = -l2 / (l3 c) and t2 = l1 / (l3 c^2) are both 1 + 2 cos of the angle of the rotation where the plane
    is right; then also |t| <= 3, which is to say that two of the eigenvalues are complex.
    """
    l0, l1, l2, l3 = np.moveaxis(_values(coefficients, planes), -1, 0)
    l3 = np.where(np.abs(l3) < 1e-12, 1e-12, l3)
    cube = -l0 / l3
    c = np.cbrt(np.where(np.abs(cube) < 1e-9, 1e-9, cube))
    t1, t2 = -l2 / (l3 * c), l1 / (l3 * c**2)
    return t1 - t2, (t1 + t2) / 2.0


@dataclass(frozen=True)
class ModulusConstraint:
    """The plane at infinity as a least-squares solution of the modulus constraint of all pairs of views that
    share one constant K.

    ``starts`` planes are drawn from the cheirality bounds (of either orientation); solutions that leave the
    bounds by more than the share ``max_outside`` of points and cameras, or whose rotations have no angle, are
    dropped. Three views have up to 21 solutions, of which ``keep`` at most are handed on for the calibration
    to choose from; four or more views have one, and local minima.
    """

    starts: int = 300
    keep: int = 21
    max_wrong_side_ratio: float = 0.02
    max_points: int = 2000

    def locate(self, scene: ProjectiveScene, rng: np.random.Generator) -> PlaneCandidates:
        """Candidates, the best first; ``StageFailure`` below three views of one constant K."""
        frame = scene.frame
        pairs = pairs_of_constant_cameras(scene.knowledge.first)
        if len(pairs) < 3:
            raise StageFailure(
                "the modulus constraint needs three photographs of one camera with constant intrinsics",
                f"{counted(len(pairs), 'pair')} of views with all intrinsics in common",
                "assume a constant camera, or use another way to the plane at infinity",
            )
        region = CheiralityRegion.of(frame, scene.reconstruction, max_points=self.max_points, rng=rng)
        starts = region.sample(self.starts, rng)
        coefficients = modulus_coefficients(frame.A, frame.a, pairs)
        planes, cost = minimize_batch(
            lambda p: modulus_residuals(coefficients, p)[0], starts, iterations=60, loss_scale=_LOSS_SCALE
        )
        turning = np.abs(modulus_residuals(coefficients, planes)[1]) <= 3.0 + _SLACK
        fit = np.isfinite(cost) & (turning.mean(axis=1) >= 0.9)
        fit[fit] = region.wrong_side_ratio(planes[fit]) <= self.max_wrong_side_ratio
        planes, cost = planes[fit], cost[fit]
        kept = distinct_planes(planes, cost)[: self.keep]
        if not len(planes):
            raise StageFailure(
                "the modulus constraint has no solution that keeps the scene on one side of infinity",
                f"{len(starts)} starts over {len(pairs)} pairs of views",
                "use another way to the plane at infinity",
            )
        return PlaneCandidates(planes[kept], cost[kept])


def pairs_of_constant_cameras(first: I64) -> I64:
    """Pairs (M, 2) of places whose camera has the same constant K."""
    i, j = np.triu_indices(len(first), 1)
    same = first[i] == first[j]
    return np.column_stack([i[same], j[same]])
