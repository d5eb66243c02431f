"""Registration of the cameras that the projective stage left out, by P3P, RANSAC and refinement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thesisrecon.arrays import B8, F64, I64, rows_of_views
from thesisrecon.errors import Notice, counted
from thesisrecon.metric._adjustment import MIN_OBSERVATIONS, MetricAdjustment
from thesisrecon.metric._confirmed_pose import confirmed_pose
from thesisrecon.metric._model import (
    EARLY_SIGMAS,
    K1,
    LATE_SIGMAS,
    MANY_VIEWS,
    WIDTH,
    MetricEstimate,
    inlier_ratios,
    normalized_observations,
    restrict_points,
    retriangulate_tracks,
    seen_views,
)
from thesisrecon.optimize.bundle.partial import refine_pose
from thesisrecon.optimize.robust_resection import resect_calibrated

ZOOMS = (1.0, 0.8, 1.25, 0.64, 1.56)
"""Factors tried on the focal length of a camera that shares it with no registered view."""
WITHOUT_K2_K3 = np.arange(WIDTH) <= K1
"""k1 is free from the start: with k1 fixed, gates wide enough for right points would accept wrong ones."""
MIN_POINTS = 15
"""Points of the model that a missing camera must see, unless other matches confirm its pose."""
MIN_SHARE = 0.2
"""In large sets, views with a smaller fraction of their points in the model are registered last: they may
show another place with repeated structure."""
MAX_ROUNDS = 6
MIN_GAIN = 0.003
"""Increase of the inlier ratio below which the rounds end."""
MIN_INLIER_RATIO = 0.5
GLOBAL_GROWTH, ITERATIONS = 1.2, 12
"""For more than ``MANY_VIEWS`` views, everything is adjusted when the number of cameras has grown by this."""


def _pose_and_focal(
    model: MetricEstimate,
    k: I64,
    row: int,
    threshold_px: float,
    zooms: tuple[float, ...],
    rng: np.random.Generator,
) -> tuple[F64, F64, F64, B8] | None:
    """R, t, intrinsics and inliers with most support of observations ``k`` over the tried focal lengths."""
    t, best = model.tracks, None
    for zoom in zooms:
        table = model.cameras.intrinsics.copy()
        table[row, 0] *= zoom
        cameras = replace(model.cameras, intrinsics=table)
        normalized = normalized_observations(cameras, t.view_index[k], t.xy[k])
        threshold = threshold_px / table[row, 0]
        # The nearest of the tried focals may be some per cent off: widen the gate.
        threshold = max(threshold, 0.01) if len(zooms) > 1 else threshold
        pose = resect_calibrated(model.X[t.point_index[k]], normalized, threshold=threshold, rng=rng)
        if pose is not None and (best is None or pose[2].sum() > best[3].sum()):
            best = pose[0], pose[1], table[row], pose[2]
    return best


def register_missing_cameras(
    model: MetricEstimate, adjustment: MetricAdjustment, rng: np.random.Generator
) -> tuple[MetricEstimate, dict[int, str]]:
    """Register missing and inconsistent cameras; return the model, and the reasons of those that failed."""
    model, rejected = _grow(model, adjustment, rng, np.ones(len(model.registered), dtype=bool))
    suspects = model.registered & (inlier_ratios(model) < MIN_INLIER_RATIO)
    if suspects.any() and (model.registered & ~suspects).sum() >= 3:
        model, rejected = _register_again(model, adjustment, rng, suspects)
    return model, rejected


def _grow(
    model: MetricEstimate, adjustment: MetricAdjustment, rng: np.random.Generator, allowed: B8
) -> tuple[MetricEstimate, dict[int, str]]:
    """Triangulate, resect ``allowed`` views and adjust until the inlier ratio stops growing."""
    model = retriangulate_tracks(model, sigmas=EARLY_SIGMAS)
    rows = rows_of_views(model.tracks.view_index, model.tracks.n_views)
    share, rounds, adjusted = 0.0, 0, model.registered
    while True:
        before = model.registered
        model, rejected = _register_missing(model, rng, allowed, rows)
        joined = model.registered & ~before
        grown = model.registered.sum() > GLOBAL_GROWTH * adjusted.sum()
        if joined.any() and not grown and adjusted.sum() > MANY_VIEWS:
            model = _adjust_window(model, adjustment, joined)
            continue
        if joined.any():
            model = retriangulate_tracks(model, sigmas=EARLY_SIGMAS)
        iterations = ITERATIONS if model.registered.sum() > MANY_VIEWS else 6
        model = adjustment.run(model, free=WITHOUT_K2_K3, iterations=iterations)[0]
        # A wide gate in the first round readmits observations that a wrong model had excluded.
        model = retriangulate_tracks(model, sigmas=LATE_SIGMAS if rounds else EARLY_SIGMAS)
        now = float(model.inlier.mean())
        rounds, gain, share, adjusted = rounds + 1, now - share, now, model.registered
        if not joined.any() and rounds > 1 and (gain < MIN_GAIN or rounds >= MAX_ROUNDS):
            return model, rejected


def _adjust_window(model: MetricEstimate, adjustment: MetricAdjustment, views: B8) -> MetricEstimate:
    """Triangulate the points of some views and adjust both; other cameras and shared intrinsics are fixed."""
    t, cameras = model.tracks, model.cameras
    points = np.unique(t.point_index[views[t.view_index]])
    part = retriangulate_tracks(restrict_points(model, points), sigmas=EARLY_SIGMAS)
    if part.inlier.sum() < MIN_OBSERVATIONS:
        return model
    assert cameras.shared is not None
    inside, outside = (cameras.shared[cameras.group[model.registered & v]] for v in (views, ~views))
    own = np.array([not np.isin(a, b).any() for a, b in zip(inside.T, outside.T, strict=True)])
    part = adjustment.run(part, free=WITHOUT_K2_K3 & own, fixed=~views, iterations=6)[0]
    part = retriangulate_tracks(
        replace(part, sigma_px=model.sigma_px, loss_sigmas=model.loss_sigmas, tail=model.tail),
        sigmas=LATE_SIGMAS,
    )
    X, valid, inlier = model.X.copy(), model.valid.copy(), model.inlier.copy()
    X[points], valid[points] = part.X, part.valid
    inlier[np.isin(t.point_index, points)] = part.inlier
    return replace(model, cameras=part.cameras, X=X, valid=valid, inlier=inlier)


def _register_missing(
    model: MetricEstimate, rng: np.random.Generator, allowed: B8, rows: list[I64]
) -> tuple[MetricEstimate, dict[int, str]]:
    """Register every ``allowed`` view that sees enough, those of few points if no other is registered."""
    t = model.tracks
    counts = np.bincount(t.view_index[model.valid[t.point_index]], minlength=t.n_views)
    missing = allowed & ~model.registered
    reached = missing & (counts >= MIN_SHARE * np.array([len(k) for k in rows]))
    rejected: dict[int, str] = {}
    few = missing & (counts < MIN_POINTS)
    parts = (reached, missing & ~reached) if seen_views(t) > MANY_VIEWS else (missing,)
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
    assert cameras.shared is not None
    focals = cameras.shared[:, 0]
    alone = not model.registered[focals[cameras.group] == focals[row]].any()
    zooms = ZOOMS if alone else (1.0,)
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


def _register_again(
    model: MetricEstimate, adjustment: MetricAdjustment, rng: np.random.Generator, suspects: B8
) -> tuple[MetricEstimate, dict[int, str]]:
    """Remove suspects, adjust the rest without them, then register them again if they fit."""
    none = np.zeros(len(suspects), dtype=bool)
    inlier = model.inlier & ~suspects[model.tracks.view_index]
    model = replace(model, registered=model.registered & ~suspects, inlier=inlier)
    model, _ = _grow(model, adjustment, rng, none)
    model, rejected = _grow(model, adjustment, rng, ~none)
    share = inlier_ratios(model)
    wrong = model.registered & (share < MIN_INLIER_RATIO)
    if wrong.any():
        for view in np.flatnonzero(wrong):
            rejected[int(view)] = Notice("contradicted-by-others", share[view])
        model = replace(model, registered=model.registered & ~wrong)
        model = retriangulate_tracks(model, sigmas=LATE_SIGMAS)
    return model, rejected
