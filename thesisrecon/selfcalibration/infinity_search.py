"""Hartley's way: cheirality bounds the plane at infinity, a search finds it.

R. Hartley, E. Hayman, L. de Agapito, I. Reid, "Camera calibration and the search for infinity", ICCV 1999.
The plane at infinity leaves all points and all camera centres on one side; these inequalities make a bounded
polytope in a quasi-affine frame, which is searched on a grid. Each candidate plane gives infinite
homographies, and these give the image of the absolute conic linearly (de Agapito, Hartley and Hayman, CVPR
1999).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from thesisrecon.geometry.camera import camera_centre
from thesisrecon.geometry.cheirality import orient_signs
from thesisrecon.selfcalibration.frame import ReferenceFrame
from thesisrecon.types import Reconstruction

F64 = NDArray[np.float64]


def cheirality_inequalities(
    frame: ReferenceFrame, reconstruction: Reconstruction, *, max_points: int, rng: np.random.Generator
) -> tuple[F64, F64]:
    """Oriented points (N, 4) and camera centres (R, 4) in the reference frame, unit norm.

    Only points of three or more views take part: one wrong two-view point, which nothing contradicts, would
    cut the true plane away. Points that the orientation cannot satisfy in every view are left out.
    """
    tracks, keep = reconstruction.tracks, reconstruction.inlier
    view, point = tracks.view_index[keep], tracks.point_index[keep]
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
    answer = linprog(
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
            answer = linprog(goal, A_ub=-rows[:, :3], b_ub=rows[:, 3], bounds=[(None, None)] * 3)
            if answer.x is None or not answer.success:
                return None
            box[k, side] = answer.x[k]
    return box


def image_conic_from_homographies(H: F64) -> tuple[F64, F64]:
    """Image of the absolute conic in the reference view from infinite homographies H (B, R, 3, 3), linearly.

    Each view j has w_j = H_j^-T w H_j^-1; no skew, square pixels and a centred principal point are four
    equations in the six entries of w. Returns the squared unit-free focal (B,), NaN where w is not positive,
    and the score (B,): smallest over second smallest singular value.
    """
    det = np.linalg.det(H)
    Hn = H / np.cbrt(np.where(np.abs(det) < 1e-12, 1e-12, det))[..., None, None]
    G = np.linalg.inv(np.where(np.abs(det)[..., None, None] < 1e-12, np.eye(3), Hn))
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]

    def rows(a: int, b: int) -> F64:
        x, y = G[..., :, a], G[..., :, b]
        terms = [x[..., i] * y[..., j] + (x[..., j] * y[..., i] if i != j else 0.0) for i, j in pairs]
        return np.stack(terms, axis=-1)

    A = np.stack([rows(0, 1), rows(0, 2), rows(1, 2), (rows(0, 0) - rows(1, 1)) / 2.0], axis=2)
    A = A.reshape(len(H), -1, 6)
    value, vector = np.linalg.eigh(np.einsum("bri,brj->bij", A, A))
    w = vector[:, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        f2 = 2.0 * w[:, 5] / (w[:, 0] + w[:, 3])
        score = np.sqrt(np.maximum(value[:, 0], 0.0) / np.maximum(value[:, 1], 1e-300))
    bad = ~(f2 > 0) | ~np.isfinite(f2) | (w[:, 0] * w[:, 3] <= 0)
    return np.where(bad, np.nan, f2), np.where(bad, np.inf, score)


@dataclass(frozen=True)
class InfinitySearch:
    """Grid search for the plane at infinity inside the cheirality bounds.

    ``steps`` per axis of the box, ``keep`` local minima at most, ``max_points`` in the linear programs.
    """

    steps: int = 16
    keep: int = 10
    max_points: int = 2000

    def search(
        self, frame: ReferenceFrame, reconstruction: Reconstruction, rng: np.random.Generator
    ) -> tuple[F64, F64]:
        """Planes p (B, 3) and reference focals (B,) in the reference frame, best score first; both
        orientations
        are tried, and either may have no plane at all."""
        X, C = cheirality_inequalities(frame, reconstruction, max_points=self.max_points, rng=rng)
        found = [self._search_side(frame, X, sign * C) for sign in (1.0, -1.0)] if len(X) >= 8 else []
        planes = np.concatenate([f[0] for f in found]) if found else np.zeros((0, 3))
        focals = np.concatenate([f[1] for f in found]) if found else np.zeros(0)
        scores = np.concatenate([f[2] for f in found]) if found else np.zeros(0)
        order = np.argsort(scores, kind="stable")[: self.keep]
        return planes[order], focals[order]

    def _search_side(self, frame: ReferenceFrame, X: F64, C: F64) -> tuple[F64, F64, F64]:
        nothing = np.zeros((0, 3)), np.zeros(0), np.zeros(0)
        v = deepest_plane(X, C)
        if v is None:
            return nothing
        T = quasi_affine_frame(X, v)
        rows_X = _unit_rows(X @ T.T)
        rows_C = _unit_rows(C @ T.T)
        box = plane_box(rows_X, rows_C)
        if box is None:
            return nothing
        axes = [np.linspace(low, high, self.steps + 2)[1:-1] for low, high in box]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        planes = np.concatenate([grid.reshape(-1, 3), np.ones((self.steps**3, 1))], axis=1)
        rows = np.concatenate([rows_X, rows_C])
        inside = np.concatenate([(part @ rows.T > 0).all(axis=1) for part in np.array_split(planes, 16)])
        back = planes @ T
        p = back[:, :3] / np.where(back[:, 3:] == 0, 1e-12, back[:, 3:])
        H = frame.A[None] - frame.a[None, :, :, None] * p[:, None, None, :]
        f2, score = image_conic_from_homographies(H)
        score = np.where(inside, score, np.inf)
        best = _local_minima(score.reshape(grid.shape[:3]))[: self.keep]
        best = best[np.isfinite(score[best])]
        return p[best], np.sqrt(f2[best]), score[best]


def _local_minima(score: F64) -> NDArray[np.int64]:
    """Flat indices of cells not worse than their 6 neighbours, best first."""
    padded = np.pad(score, 1, constant_values=np.inf)
    core = padded[1:-1, 1:-1, 1:-1]
    minimum = np.isfinite(core)
    for axis in range(3):
        for shift in (-1, 1):
            minimum &= core <= np.roll(padded, shift, axis=axis)[1:-1, 1:-1, 1:-1]
    flat = np.flatnonzero(minimum.ravel())
    return flat[np.argsort(score.ravel()[flat], kind="stable")]
