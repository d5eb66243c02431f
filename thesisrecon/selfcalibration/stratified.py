"""Stratified self-calibration (chapter 7): plane at infinity, affine upgrade, then calibration.

Vanishing points of parallel lines in two images or more are triangulated to points at infinity, three of
which span the plane (HZ 10.4.1).
"""

from dataclasses import dataclass, field, replace

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import pixel_from_unit
from thesisrecon.geometry.strata import affine_from_projective, transform
from thesisrecon.records import IntrinsicsPrior, Reconstruction, SelfCalibration
from thesisrecon.selfcalibration._frame import ProjectiveScene, projective_scene, require_cameras_of_full_rank
from thesisrecon.selfcalibration._refinement import dual_image_residuals
from thesisrecon.selfcalibration._upgrade import Candidate, as_stage_failure, select_candidate
from thesisrecon.selfcalibration.absolute_conic import FixedPlaneQuadric, LinearAbsoluteConic
from thesisrecon.selfcalibration.cheirality import CheiralitySearch, ModulusConstraint, unit_rows
from thesisrecon.selfcalibration.quadric import minimize_quadric

_MAX_REFINED = 3  # number of closed-form candidates to refine
_NEAR_INFINITY = 1e-9


@dataclass(frozen=True)
class Stratified:
    """Self-calibration in two steps as in the thesis: plane at infinity, then K given the plane.

    Parameters
    ----------
    plane : CheiralitySearch or ModulusConstraint
        Method for the plane at infinity.
    calibration : LinearAbsoluteConic or FixedPlaneQuadric
        Method for K.
    refine : bool
        Refine plane and intrinsics together by the nonlinear quadric.
    """

    plane: CheiralitySearch | ModulusConstraint = field(default_factory=CheiralitySearch)
    calibration: LinearAbsoluteConic | FixedPlaneQuadric = field(default_factory=LinearAbsoluteConic)
    refine: bool = True

    max_candidates = 1  # maximum number of candidates to return
    min_in_front_ratio = 0.5  # required share of observations with positive depth

    @as_stage_failure
    def calibrate(
        self, reconstruction: Reconstruction, *, prior: IntrinsicsPrior, rng: np.random.Generator
    ) -> SelfCalibration:
        """See `thesisrecon.config.SelfCalibrator.calibrate`."""
        scene = projective_scene(reconstruction, prior)
        candidates = self._candidates(scene, self.plane.locate(scene, rng))
        return select_candidate(
            scene.frame, reconstruction, candidates,
            max_candidates=self.max_candidates, min_in_front_ratio=self.min_in_front_ratio,
        )  # fmt: skip

    def locate(
        self, reconstruction: Reconstruction, *, prior: IntrinsicsPrior, rng: np.random.Generator
    ) -> F64:
        """Estimate the plane at infinity alone: (4,), unit norm, in the projective frame."""
        scene = projective_scene(reconstruction, prior)
        plane = np.append(self.plane.locate(scene, rng)[0], 1.0) @ scene.frame.reference_from_projective
        return np.asarray(plane / np.linalg.norm(plane))

    def _candidates(self, scene: ProjectiveScene, planes: F64) -> list[Candidate]:
        method = f"{type(self.plane).__name__}, {type(self.calibration).__name__}"
        candidates: list[Candidate] = []
        failures: list[StageFailure] = []
        for plane in planes:
            try:
                K = self.calibration.calibrations(scene, plane)
            except StageFailure as failure:
                failures.append(failure)
                continue
            r = dual_image_residuals(scene.frame, K[None], plane[None])
            candidates.append(Candidate(plane, K, float(np.mean(np.sum(r**2, axis=-1))), method))
        if not candidates:
            raise failures[0]
        if not self.refine:
            return candidates
        best = sorted(candidates, key=lambda candidate: candidate.cost)
        return [
            minimize_quadric(
                scene.frame, scene.unknown, candidate.plane,
                0.5 * np.log(candidate.K[:, 0, 0] * candidate.K[:, 1, 1]), method=f"{method}, refined",
            )
            for candidate in best[: max(self.max_candidates, _MAX_REFINED)]
        ]  # fmt: skip


def upgrade_to_affine(reconstruction: Reconstruction, plane: F64) -> Reconstruction:
    """Upgrade a projective reconstruction to an affine one (3.4.3): P G^-1, G X by the table of 3.3.

    Parallelism and ratios of lengths on parallel lines are correct, angles are not. In the affine frame the
    camera with most observations is K [I | 0] with a nominal K (focal length of one long side), and its
    points have a median depth of 1 and X4 = 1; points on the plane at infinity become invalid.
    """
    if reconstruction.stratum != "projective":
        raise ValueError(f"upgrade_to_affine takes a projective reconstruction; got {reconstruction.stratum}")
    G = affine_from_projective(np.asarray(plane, dtype=np.float64))
    X = transform(G, reconstruction.X, "points")
    size = np.linalg.norm(X, axis=1)
    valid = reconstruction.valid & (np.abs(X[:, 3]) > _NEAR_INFINITY * np.maximum(size, 1e-300))
    X[~valid] = 0.0
    X[valid] /= X[valid, 3:]
    P = np.where(reconstruction.registered[:, None, None], transform(G, reconstruction.P, "cameras"), 0.0)
    affine = replace(reconstruction, stratum="affine", P=P, X=X, valid=valid)
    affine = replace(affine, P=_facing(affine))
    tracks, keep = affine.tracks, affine.inlier & valid[affine.tracks.point_index]
    seen = np.bincount(tracks.view_index[keep], minlength=len(affine.P)) * affine.registered
    view, T = int(np.argmax(seen)), np.eye(4)
    T[:3] = np.linalg.solve(pixel_from_unit(affine.sizes)[view], affine.P[view])
    T[:3] /= max(float(np.linalg.norm(T[:3, :3])), 1e-300)
    if not seen[view] or abs(np.linalg.det(T)) < _NEAR_INFINITY:
        return affine
    depth = X[tracks.point_index[keep & (tracks.view_index == view)]] @ T[2]
    T[:3] /= max(float(np.median(depth)), 1e-300)
    X[valid] = transform(T, X[valid], "points")
    return replace(affine, P=transform(T, affine.P, "cameras"), X=X)


def _facing(affine: Reconstruction) -> F64:
    """Return cameras (V, 3, 4) with the signs that give the points positive depths."""
    tracks, keep = affine.tracks, affine.inlier & affine.valid[affine.tracks.point_index]
    view, point = tracks.view_index[keep], tracks.point_index[keep]
    depth = np.einsum("kj,kj->k", affine.P[view, 2], affine.X[point])
    balance = np.bincount(view, np.sign(depth), minlength=len(affine.P))
    return affine.P * np.where(balance < 0.0, -1.0, 1.0)[:, None, None]


_MIN_SPREAD = 1e-3


def plane_from_vanishing_points(P: F64, xyh: F64, unit: F64) -> F64:
    """The unit plane at infinity (4,) from vanishing points xyh (V, D, 3), NaN where not seen."""
    require_cameras_of_full_rank(P)
    cameras = np.linalg.inv(unit) @ P
    cameras = cameras / np.linalg.norm(cameras, axis=(1, 2), keepdims=True)
    # In this frame of space the rows of the cameras are orthonormal.
    M = np.linalg.qr(cameras.reshape(-1, 4))[1]
    X = _points_at_infinity(cameras @ np.linalg.inv(M), np.einsum("vij,vdj->vdi", np.linalg.inv(unit), xyh))
    _, s, Vt = np.linalg.svd(unit_rows(X))
    if not s[2] / s[0] > _MIN_SPREAD:
        raise StageFailure.of("directions-in-one-plane", s[2] / s[0])
    plane = M.T @ Vt[-1]
    return np.asarray(plane / np.linalg.norm(plane))


def _points_at_infinity(P: F64, v: F64) -> F64:
    """Triangulated points (D', 4), v x P X = 0, from vanishing points v (V, D, 3)."""
    v = v / np.linalg.norm(v, axis=2, keepdims=True)
    seen = np.asarray(np.isfinite(v).all(axis=2))
    found = []
    for d in np.flatnonzero(seen.sum(axis=0) >= 2):
        rows = np.cross(v[seen[:, d], d, :, None], P[seen[:, d]], axisa=-2, axisb=-2, axisc=-2)
        values, vectors = np.linalg.eigh(np.einsum("nri,nrj->ij", rows, rows))
        # Epipoles determine nothing.
        if values[1] > _MIN_SPREAD**2 * values[3]:
            found.append(vectors[:, 0])
    if len(found) < 3:
        raise StageFailure.of("few-parallel-directions", len(found))
    return np.stack(found)
