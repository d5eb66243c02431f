"""The pose of a camera that sees few points of the model, confirmed by its other matches.

Matches to registered images that are no points of the model determine the pose by epipolar geometry, except
for the length of the translation, which few points determine: a row of images continues beyond a weak link.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.triangulation import pose_from_three_points
from thesisrecon.metric._model import EARLY_SIGMAS, LATE_SIGMAS, MetricEstimate, normalized_observations

MIN_POINTS, MIN_MATCHES, MIN_SHARE = 5, 15, 0.5
"""Points, and other matches, that must agree with the pose, and the smallest share of either."""
SAMPLES = 300
LOSS_SIGMAS = 2.0


@dataclass(frozen=True)
class _Evidence:
    """Rays (., 3) of the camera: of points ``X`` and of matches to other cameras.

    ``theirs`` are the rays of the matches in the world, ``R`` and ``centres`` the poses of the other cameras.
    """

    X: F64
    of_points: F64
    of_matches: F64
    theirs: F64
    R: F64
    centres: F64

    def residuals(self, R: F64, t: F64) -> tuple[F64, F64]:
        """Lengths (M,) of the reprojection residuals, inf behind the camera, and Sampson distances (N,)."""
        Y, epipole = self.X @ R.T + t, self.centres @ R.T + t
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.linalg.norm(Y[:, :2] / Y[:, 2:] - self.of_points[:, :2], axis=1)
        lines = np.cross(epipole, self.theirs @ R.T)
        back = np.einsum("nij,nj->ni", self.R, np.cross(self.of_matches, epipole) @ R)
        squared = (lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
        distance = (self.of_matches * lines).sum(axis=1) / np.sqrt(squared + 1e-300)
        return np.where(Y[:, 2] > 0.0, off, np.inf), distance

    def in_front(self, R: F64, t: F64) -> B8:
        """Matches (N,) with a point in front of both cameras."""
        epipole, theirs = self.centres @ R.T + t, self.theirs @ R.T
        normal = np.cross(self.of_matches, theirs)
        depths = [np.cross(epipole, ray) for ray in (theirs, self.of_matches)]
        return np.asarray(np.all([(normal * depth).sum(axis=1) > 0.0 for depth in depths], axis=0))

    def cost(self, pose: tuple[F64, F64], gate: float) -> float:
        """Truncated quadratic cost of a pose."""
        return float(np.minimum((np.concatenate(self.residuals(*pose)) / gate) ** 2, 1.0).sum())

    def start(self, gate: float, rng: np.random.Generator) -> tuple[F64, F64] | None:
        """The pose of three points with the least cost."""
        chosen = rng.random((SAMPLES, len(self.X))).argpartition(2, axis=1)[:, :3]
        unit = self.of_points / np.linalg.norm(self.of_points, axis=1, keepdims=True)
        R, t, _ = pose_from_three_points(self.X[chosen], unit[chosen])
        return min(zip(R, t, strict=True), key=lambda pose: self.cost(pose, gate), default=None)

    def refined(self, pose: tuple[F64, F64], noise: float, gate: float) -> tuple[F64, F64]:
        """The pose near ``pose`` with the least robust cost."""
        R, t = pose
        length = max(float(np.median(np.linalg.norm(self.X @ R.T + t, axis=1))), 1e-300)

        def moved(step: F64) -> tuple[F64, F64]:
            turn = scipy.spatial.transform.Rotation.from_rotvec(step[:3]).as_matrix()
            return turn @ R, t + length * step[3:]

        def residuals(step: F64) -> F64:
            return np.minimum(np.concatenate(self.residuals(*moved(step))), 1.0) / noise

        found = scipy.optimize.least_squares(
            residuals, np.zeros(6), loss="soft_l1", f_scale=LOSS_SIGMAS, max_nfev=30
        )
        return min((pose, moved(found.x)), key=lambda one: self.cost(one, gate))


def confirmed_pose(
    model: MetricEstimate, view: int, rows: I64, rng: np.random.Generator
) -> tuple[F64, F64] | None:
    """R and t of the camera of observations ``rows``, None if points or other matches contradict it."""
    evidence = _evidence(model, rows)
    if len(evidence.X) < MIN_POINTS or len(evidence.theirs) < MIN_MATCHES:
        return None
    focal = model.cameras.intrinsics[model.cameras.group[view], 0]
    noise = model.gate_px / focal
    gate = EARLY_SIGMAS * noise
    pose = evidence.start(2.0 * gate, rng)
    if pose is None:
        return None
    pose = evidence.refined(pose, noise, gate)
    points, matches = (np.abs(residual) < LATE_SIGMAS * noise for residual in evidence.residuals(*pose))
    # The matches of a wrong pose intersect behind a camera, or anywhere.
    matches &= evidence.in_front(*pose)
    return pose if _agree(points, MIN_POINTS) and _agree(matches, MIN_MATCHES) else None


def _agree(agreeing: B8, fewest: int) -> bool:
    return int(agreeing.sum()) >= max(fewest, MIN_SHARE * len(agreeing))


def _evidence(model: MetricEstimate, rows: I64) -> _Evidence:
    """The points of the model that a view of observations ``rows`` sees, and its other matches."""
    t, cameras = model.tracks, model.cameras
    known, own = model.valid[t.point_index[rows]], np.full(t.n_points, -1)
    k, own[t.point_index[rows[~known]]] = rows[known], rows[~known]
    other = np.flatnonzero(model.registered[t.view_index] & (own[t.point_index] >= 0))
    rays = (
        homogenize(normalized_observations(cameras, t.view_index[i], t.xy[i]))
        for i in (k, own[t.point_index[other]], other)
    )
    of_points, of_matches, theirs = rays
    R, centres = cameras.R[t.view_index[other]], cameras.centres[t.view_index[other]]
    theirs = np.einsum("nji,nj->ni", R, theirs)
    return _Evidence(model.X[t.point_index[k]], of_points, of_matches, theirs, R, centres)
