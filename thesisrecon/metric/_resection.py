"""Registration of the cameras that the projective stage left out, by P3P, RANSAC and refinement.

The pose of a camera that sees few points of the model is confirmed by its other matches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64, rows_of_views
from thesisrecon.errors import Notice, counted
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.triangulation import pose_from_three_points
from thesisrecon.metric import _model
from thesisrecon.metric._adjustment import MIN_OBSERVATIONS, MetricAdjustment
from thesisrecon.metric._model import EARLY_SIGMAS, LATE_SIGMAS, MANY_VIEWS, MetricEstimate, restrict_points
from thesisrecon.optimize.bundle.partial import refine_pose
from thesisrecon.optimize.ransac import Budget, draw_samples, resect_calibrated

WITHOUT_K2_K3 = np.arange(_model.LENS_WIDTH) <= _model.K1
"""k1 is free from the start: with k1 fixed, gates wide enough for right points would accept wrong ones."""
MIN_POINTS = 15  # points of the model that a missing camera must see, unless other matches confirm its pose
FEWEST_POINTS, MIN_MATCHES, AGREEING = 5, 15, 0.5
"""Points, and other matches, that must agree with a confirmed pose, and the smallest share of either."""
MIN_INLIER_RATIO = 0.5
FEW_SAMPLES = Budget(confidence=0.9999, max_samples=2000)
"""Half of the points of a view are right, or it is not registered."""


def _pose_and_focal(
    model: MetricEstimate, k: I64, row: int, threshold_px: float, zooms: tuple[float, ...],
    rng: np.random.Generator,
) -> tuple[F64, F64, F64, B8] | None:  # fmt: skip
    """R, t, intrinsics and inliers with most support of observations ``k`` over the tried focal lengths."""
    t, best = model.tracks, None
    for zoom in zooms:
        table = model.cameras.intrinsics.copy()
        table[row, 0] *= zoom
        cameras = replace(model.cameras, intrinsics=table)
        normalized = _model.normalized_observations(cameras, t.view_index[k], t.xy[k])
        threshold = threshold_px / table[row, 0]
        # The nearest of the tried focals may be some per cent off: widen the gate.
        threshold = max(threshold, 0.01) if len(zooms) > 1 else threshold
        pose, inlier, _ = resect_calibrated(
            model.X[t.point_index[k]], normalized, threshold=threshold, budget=FEW_SAMPLES, rng=rng
        )
        if pose is not None and (best is None or inlier.sum() > best[3].sum()):
            best = pose[:, :3], pose[:, 3], table[row], inlier
    return best


def register_missing_cameras(
    model: MetricEstimate, adjustment: MetricAdjustment, rng: np.random.Generator
) -> tuple[MetricEstimate, dict[int, str]]:
    """Register missing and inconsistent cameras; return the model, and the reasons of those that failed."""
    model, rejected = _grow(model, adjustment, rng, np.ones(len(model.registered), dtype=bool))
    suspects = model.registered & (_model.inlier_ratios(model) < MIN_INLIER_RATIO)
    if not suspects.any() or (model.registered & ~suspects).sum() < 3:
        return model, rejected
    # The rest is adjusted without the suspects, which are then registered again if they fit.
    none = np.zeros(len(suspects), dtype=bool)
    inlier = model.inlier & ~suspects[model.tracks.view_index]
    model = replace(model, registered=model.registered & ~suspects, inlier=inlier)
    model, _ = _grow(model, adjustment, rng, none)
    model, rejected = _grow(model, adjustment, rng, ~none)
    share = _model.inlier_ratios(model)
    wrong = model.registered & (share < MIN_INLIER_RATIO)
    if wrong.any():
        for view in np.flatnonzero(wrong):
            rejected[int(view)] = Notice("contradicted-by-others", share[view])
        model = replace(model, registered=model.registered & ~wrong)
        model = _model.retriangulate_tracks(model, sigmas=LATE_SIGMAS)
    return model, rejected


def _grow(
    model: MetricEstimate, adjustment: MetricAdjustment, rng: np.random.Generator, allowed: B8
) -> tuple[MetricEstimate, dict[int, str]]:
    """Triangulate, resect ``allowed`` views and adjust until the inlier ratio stops growing."""
    model = _model.retriangulate_tracks(model, sigmas=EARLY_SIGMAS)
    rows = rows_of_views(model.tracks.view_index, model.tracks.n_views)
    share, rounds, adjusted = 0.0, 0, model.registered
    while True:
        before = model.registered
        model, rejected = register_next(model, rng, allowed, rows)
        joined = model.registered & ~before
        # Of many views everything is adjusted when the number of cameras has grown by a fifth.
        grown = model.registered.sum() > 1.2 * adjusted.sum()
        if joined.any() and not grown and adjusted.sum() > MANY_VIEWS:
            model = adjust_window(model, adjustment, joined)
            continue
        if joined.any():
            model = _model.retriangulate_tracks(model, sigmas=EARLY_SIGMAS)
        iterations = 12 if model.registered.sum() > MANY_VIEWS else 6
        model = adjustment.run(model, free=WITHOUT_K2_K3, iterations=iterations)[0]
        # A wide gate in the first round readmits observations that a wrong model had excluded.
        model = _model.retriangulate_tracks(model, sigmas=LATE_SIGMAS if rounds else EARLY_SIGMAS)
        now = float(model.inlier.mean())
        rounds, gain, share, adjusted = rounds + 1, now - share, now, model.registered
        if not joined.any() and rounds > 1 and (gain < 0.003 or rounds >= 6):
            return model, rejected


def adjust_window(model: MetricEstimate, adjustment: MetricAdjustment, views: B8) -> MetricEstimate:
    """Triangulate the points of some views and adjust both; other cameras and shared intrinsics are fixed."""
    t, cameras = model.tracks, model.cameras
    points = np.unique(t.point_index[views[t.view_index]])
    part = _model.retriangulate_tracks(restrict_points(model, points), sigmas=EARLY_SIGMAS)
    if part.inlier.sum() < MIN_OBSERVATIONS:
        return model
    inside, outside = (cameras.shared[cameras.group[model.registered & v]] for v in (views, ~views))
    own = np.array([not np.isin(a, b).any() for a, b in zip(inside.T, outside.T, strict=True)])
    part = adjustment.run(part, free=WITHOUT_K2_K3[: len(own)] & own, fixed=~views, iterations=6)[0]
    part = _model.retriangulate_tracks(
        replace(part, sigma_px=model.sigma_px, loss_sigmas=model.loss_sigmas, tail=model.tail),
        sigmas=LATE_SIGMAS,
    )
    X, valid, inlier = model.X.copy(), model.valid.copy(), model.inlier.copy()
    X[points], valid[points] = part.X, part.valid
    inlier[np.isin(t.point_index, points)] = part.inlier
    return replace(model, cameras=part.cameras, X=X, valid=valid, inlier=inlier)


def register_next(
    model: MetricEstimate, rng: np.random.Generator, allowed: B8, rows: list[I64]
) -> tuple[MetricEstimate, dict[int, str]]:
    """Register every ``allowed`` view that sees enough, those of few points if no other is registered."""
    t = model.tracks
    counts = np.bincount(t.view_index[model.valid[t.point_index]], minlength=t.n_views)
    missing = allowed & ~model.registered
    # In large sets, views with few of their points in the model may show another place with repeated
    # structure: they are registered last.
    reached = missing & (counts >= 0.2 * np.array([len(k) for k in rows]))
    rejected: dict[int, str] = {}
    few = missing & (counts < MIN_POINTS)
    parts = (reached, missing & ~reached) if _model.seen_views(t) > MANY_VIEWS else (missing,)
    for views in (*(part & ~few for part in parts), few):
        for view in sorted(np.flatnonzero(views).tolist(), key=lambda v: -counts[v]):
            added = _register(model, view, rows[view], rng)
            if isinstance(added, str):
                rejected[view] = added
            else:
                model = added
        if (missing & model.registered).any():
            break
    return model, rejected


def _register(model: MetricEstimate, view: int, rows: I64, rng: np.random.Generator) -> MetricEstimate | str:
    """Add the camera of observations ``rows`` to the model; otherwise return the reason against it."""
    t, cameras = model.tracks, model.cameras
    k = rows[model.valid[t.point_index[rows]]]
    row = int(cameras.group[view])
    focals = cameras.shared[:, 0]
    alone = not model.registered[focals[cameras.group] == focals[row]].any()
    zooms = (1.0, 0.8, 1.25, 0.64, 1.56) if alone else (1.0,)
    gate, enough = 2.0 * EARLY_SIGMAS * model.gate_px, len(k) >= MIN_POINTS
    found = _pose_and_focal(model, k, row, gate, zooms, rng) if enough else None
    support = 0 if found is None else int(found[3].sum())
    Rs, ts, intrinsics = cameras.R.copy(), cameras.t.copy(), cameras.intrinsics.copy()
    if found is not None and support >= MIN_POINTS and support >= 0.3 * len(k):
        R, translation, start, inlier = found
        pose = refine_pose(
            R, translation, start, model.X[t.point_index[k]][inlier], t.xy[k][inlier],
            free=(np.arange(len(start)) == 0) & alone, loss_px=2.0 * model.sigma_px, iterations=20,
        )  # fmt: skip
        Rs[view], ts[view], intrinsics[row] = pose.R, pose.t, pose.intrinsics
    elif not alone and (confirmed := confirmed_pose(model, view, rows, rng)) is not None:
        Rs[view], ts[view] = confirmed
    elif enough:
        return Notice("resection-inliers", support, counted(len(k), "point"))
    else:
        # The number of points is counted at the end.
        return ""
    registered = model.registered | (np.arange(len(Rs)) == view)
    return replace(model, cameras=replace(cameras, R=Rs, t=ts, intrinsics=intrinsics), registered=registered)


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

    def cost(self, pose: tuple[F64, F64], gate: float) -> float:
        """Truncated quadratic cost of a pose."""
        return float(np.minimum((np.concatenate(self.residuals(*pose)) / gate) ** 2, 1.0).sum())

    def refined(self, pose: tuple[F64, F64], noise: float, gate: float) -> tuple[F64, F64]:
        """The pose near ``pose`` with the least robust cost."""
        R, t = pose
        length = max(float(np.median(np.linalg.norm(self.X @ R.T + t, axis=1))), 1e-300)

        def moved(step: F64) -> tuple[F64, F64]:
            turn = scipy.spatial.transform.Rotation.from_rotvec(step[:3]).as_matrix()
            return turn @ R, t + length * step[3:]

        def residuals(step: F64) -> F64:
            return np.minimum(np.concatenate(self.residuals(*moved(step))), 1.0) / noise

        found = scipy.optimize.least_squares(residuals, np.zeros(6), loss="soft_l1", f_scale=2.0, max_nfev=30)
        return min((pose, moved(found.x)), key=lambda one: self.cost(one, gate))


def confirmed_pose(
    model: MetricEstimate, view: int, rows: I64, rng: np.random.Generator
) -> tuple[F64, F64] | None:
    """R and t of a camera that sees few points of the model, None if points or other matches contradict it.

    Its other matches determine the pose up to the length of the translation, which needs few points only.
    """
    t, cameras = model.tracks, model.cameras
    known, own = model.valid[t.point_index[rows]], np.full(t.n_points, -1)
    k, own[t.point_index[rows[~known]]] = rows[known], rows[~known]
    other = np.flatnonzero(model.registered[t.view_index] & (own[t.point_index] >= 0))
    if len(k) < FEWEST_POINTS or len(other) < MIN_MATCHES:
        return None
    of_points, of_matches, theirs = (
        homogenize(_model.normalized_observations(cameras, t.view_index[i], t.xy[i]))
        for i in (k, own[t.point_index[other]], other)
    )
    R, centres = cameras.R[t.view_index[other]], cameras.centres[t.view_index[other]]
    theirs = np.einsum("nji,nj->ni", R, theirs)
    evidence = _Evidence(model.X[t.point_index[k]], of_points, of_matches, theirs, R, centres)
    noise = model.gate_px / cameras.intrinsics[cameras.group[view], 0]
    gate = EARLY_SIGMAS * noise
    # From the best pose of three points.
    chosen = draw_samples(rng, 300, len(k), 3)
    unit = of_points / np.linalg.norm(of_points, axis=1, keepdims=True)
    poses = [(p[:, :3], p[:, 3]) for p in pose_from_three_points(evidence.X[chosen], unit[chosen])]
    if not poses:
        return None
    start = min(poses, key=lambda one: evidence.cost(one, 2.0 * gate))
    pose = evidence.refined(start, noise, gate)
    points, matches = (np.abs(residual) < LATE_SIGMAS * noise for residual in evidence.residuals(*pose))
    # The matches of a wrong pose intersect behind a camera, or anywhere.
    epipole, theirs = centres @ pose[0].T + pose[1], theirs @ pose[0].T
    normal = np.cross(of_matches, theirs)
    for ray in (theirs, of_matches):
        matches &= (normal * np.cross(epipole, ray)).sum(axis=1) > 0.0
    agree = ((points, FEWEST_POINTS), (matches, MIN_MATCHES))
    return pose if all(a.sum() >= max(fewest, AGREEING * len(a)) for a, fewest in agree) else None
