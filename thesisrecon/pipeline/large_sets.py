"""Large and difficult sets: calibration of a core of views, overlapping parts, and a second pass.

Drift and wrong tracks bend projective reconstructions of long sequences, so that no calibration places the
points in front of all cameras. Neighbouring views still determine one; the metric stage registers the others.

Parts are independent tasks. Wrong matches between two similar places cannot deform a part that contains only
one of them, and a part that fails does not affect the others: its images are registered after the alignment.

A few matches are not enough to verify the epipolar geometry of a pair. If they lead to points of the model, a
camera must explain them with twice as many equations: the second pass uses them for missing images only.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from thesisrecon._numba import code_digest
from thesisrecon.arrays import B8, F64, I64, rows_of_views
from thesisrecon.camera import project_camera
from thesisrecon.config import PipelineConfig, SelfCalibrator
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.strata import nearest_rotation
from thesisrecon.geometry.triangulation import triangulate_observations
from thesisrecon.matching.pair_selection import reject_repeated_structure, strong_pairs
from thesisrecon.pipeline.job import Job
from thesisrecon.pipeline.run import Batch, stream
from thesisrecon.records import (
    IntrinsicsPrior,
    MetricResult,
    Reconstruction,
    SelfCalibration,
    Similarity,
    Tracks,
    TwoView,
    Upgrade,
)

CORE_VIEWS, MAX_CORES = 5, 8
"""Views of a core, and number of cores that are tried."""
MAX_CUT = 0.1
"""Largest fraction of the common points of a part that a cut may sever; images of a single place have no such
cut."""
MIN_SIDE = 0.3
"""Smallest fraction of the views on either side of a cut."""
OVERLAP = 12
"""Views of each of two neighbouring parts that the other one contains too."""
MIN_COMMON = 3
"""Common cameras that determine the similarity between two parts."""
MAX_OFFSET_REL = 0.005
"""Largest distance, relative to the long side, between the projections of a point that two parts agree on."""
MIN_AGREEMENT = 0.5
"""Fraction of the common points that must agree, otherwise two parts are not aligned."""
_Part = tuple[I64, I64, Reconstruction]
"""Views, points and model of a part."""


def calibrate_with_core(
    method: SelfCalibrator, projective: Reconstruction, *, prior: IntrinsicsPrior, rng: np.random.Generator
) -> SelfCalibration:
    """Calibrate all views, or a core of them if that fails: the first core that determines the calibration.

    ``K`` is zero for the views that are not in the core. Raises the failure of all views if no core succeeds.
    """
    try:
        return method.calibrate(projective, prior=prior, rng=rng)
    except StageFailure as failure:
        found = list[SelfCalibration]()
        for views in _cores(projective):
            try:
                found.append(method.calibrate(restrict_views(projective, views), prior=prior, rng=rng))
            except StageFailure:
                continue
            if found[-1].identifiable:
                return found[-1]
        if not found:
            raise failure from None
        return found[0]


def calibrated_part(projective: Reconstruction, calibration: SelfCalibration) -> Reconstruction:
    """The reconstruction of the views that have a calibration; itself if all have."""
    views = projective.registered & (calibration.K[:, 0, 0] > 0.0)
    return projective if (views == projective.registered).all() else restrict_views(projective, views)


def _cores(projective: Reconstruction) -> Iterator[B8]:
    """Masks (V,) of views: each view, best observed first, with those that share most points with it."""
    registered = np.flatnonzero(projective.registered)
    if len(registered) <= CORE_VIEWS:
        return
    shared = projective.common_points[np.ix_(registered, registered)]
    tried = set[bytes]()
    for first in np.argsort(-shared.diagonal(), kind="stable"):
        # A view shares most points with itself.
        nearest = np.argsort(-shared[first], kind="stable")[:CORE_VIEWS]
        views = np.isin(np.arange(len(projective.registered)), registered[nearest])
        if views.tobytes() not in tried:
            tried.add(views.tobytes())
            yield views
        if len(tried) == MAX_CORES:
            return


def restrict_views(reconstruction: Reconstruction, views: B8) -> Reconstruction:
    """The reconstruction of some registered views, with the points that two or more of them see."""
    t = reconstruction.tracks
    inlier = reconstruction.inlier & views[t.view_index]
    valid = reconstruction.valid & (np.bincount(t.point_index[inlier], minlength=t.n_points) >= 2)
    return replace(
        reconstruction,
        registered=views,
        valid=valid,
        inlier=inlier & valid[t.point_index],
        P=np.where(views[:, None, None], reconstruction.P, 0.0),
        X=np.where(valid[:, None], reconstruction.X, 0.0),
    )


def cameras_from_parts(
    job: Job, tracks: Tracks, pairs: Sequence[TwoView], attempts: int
) -> tuple[Reconstruction | None, list[str]]:
    """Reconstruct a large set in parts and align them; None if it is not divided or no part succeeds.

    A part is stored when it is finished. Also returns the keys of the parts.
    """
    run, config = job.run, job.config
    if not 0 < config.images.part_views < int((np.bincount(tracks.view_index) > 0).sum()):
        return None, []
    graph = neighbour_graph(tracks)
    own = divide_views(graph, config.images.part_views)
    if len(own) < 2:
        return None, []
    parts = overlapping_parts(graph, own)
    variants = [run.variant_key(stage) for stage in ("projective", "selfcalibration", "metric")]
    code, upstream = code_digest(reconstruct_part), run.logs["tracks"].keys
    prior, sizes = job.prior, job.sizes
    inputs = [sizes, prior.mean, prior.std, prior.shared, prior.kind]
    keys = {
        f"part-{n}": run.key("metric", variants, code, upstream, *inputs, views, run.seed)
        for n, views in enumerate(parts)
    }

    def batches(missing: Sequence[int]) -> Iterator[Batch]:
        for n in missing:
            given = input_of_part(tracks, pairs, sizes, prior, parts[n])
            yield [n], (config, given, n, run.seed, attempts)

    models: Sequence[Reconstruction] = run.map_cached("metric", keys, reconstruct_part, batches)
    aligned = align_parts(tracks, sizes, own, parts, models)
    return aligned, [] if aligned is None else list(run.logs["metric"].keys.values())


def neighbour_graph(tracks: Tracks) -> scipy.sparse.csr_array:
    """Numbers of common points of neighbouring views (V, V), without those of weak pairs."""
    ones = np.ones(len(tracks.xy))
    seen = scipy.sparse.coo_array(
        (ones, (tracks.view_index, tracks.point_index)), (tracks.n_views, tracks.n_points)
    )
    common = (seen.tocsr() @ seen.tocsr().T).tocoo()
    apart = common.row != common.col
    row, column, count = common.row[apart], common.col[apart], common.data[apart]
    strong = strong_pairs(row, column, count, tracks.n_views)
    return scipy.sparse.coo_array((count[strong], (row[strong], column[strong])), common.shape).tocsr()


def has_narrow_cut(tracks: Tracks) -> bool:
    """Whether few common points hold the largest connected group of views together, as in a street."""
    graph = neighbour_graph(tracks)
    views = max(_connected_views(graph), key=len)
    return len(views) > 2 and _best_cut(graph, views) is not None


def _connected_views(graph: scipy.sparse.csr_array) -> list[I64]:
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    return rows_of_views(label, label.max() + 1)


def divide_views(graph: scipy.sparse.csr_array, part_views: int) -> list[I64]:
    """Divide the views until a part has at most ``part_views``, or every cut severs too many common points.

    The views of a part are numbered such that neighbours are close (reverse Cuthill-McKee); the cut between
    consecutive numbers with the smallest fraction of severed points divides it.
    """
    left, parts = _connected_views(graph), list[I64]()
    while left:
        views = left.pop()
        halves = _best_cut(graph, views) if len(views) > part_views else None
        if halves is None:
            parts.append(views)
        else:
            left += halves
    return sorted(parts, key=lambda views: int(views[0]))


def _best_cut(graph: scipy.sparse.csr_array, views: I64) -> list[I64] | None:
    inside = graph[views][:, views]
    order = scipy.sparse.csgraph.reverse_cuthill_mckee(inside.tocsr(), symmetric_mode=True)
    place = np.empty(len(views), np.int64)
    place[order] = np.arange(len(views))
    ties = inside.tocoo()
    first, last = np.minimum(place[ties.row], place[ties.col]), np.maximum(place[ties.row], place[ties.col])
    # Each pair is twice in the symmetric matrix; the cuts behind first ... last - 1 sever it.
    change = np.bincount(first, ties.data, len(views)) - np.bincount(last, ties.data, len(views))
    severed = np.cumsum(change)[:-1]
    *volume, total = np.cumsum(np.asarray(inside.sum(axis=1)).ravel()[order])
    ratio = severed / np.maximum(np.minimum(volume, total - volume), 1.0)
    sides = np.arange(1, len(views))
    ratio[np.minimum(sides, len(views) - sides) < MIN_SIDE * len(views)] = np.inf
    at = int(np.argmin(ratio))
    return (
        [np.sort(views[order[: at + 1]]), np.sort(views[order[at + 1 :]])] if ratio[at] <= MAX_CUT else None
    )


def overlapping_parts(graph: scipy.sparse.csr_array, parts: Sequence[I64]) -> list[I64]:
    """Each part with the views of the others that are closest to it."""
    grown = []
    for views in parts:
        ties = np.asarray(graph[views].sum(axis=0)).ravel()
        added = [views]
        for other in parts:
            if other is not views:
                nearest = other[np.argsort(-ties[other], kind="stable")[:OVERLAP]]
                added.append(nearest[ties[nearest] > 0])
        grown.append(np.unique(np.concatenate(added)))
    return grown


@dataclass(frozen=True)
class PartInput:
    """Input of the reconstruction of some views, with views and points renumbered."""

    tracks: Tracks
    pairs: tuple[TwoView, ...]
    sizes: I64
    prior: IntrinsicsPrior


def points_of_part(tracks: Tracks, views: I64) -> I64:
    """The points that two or more of the views observe, sorted."""
    seen = np.isin(tracks.view_index, views)
    return np.flatnonzero(np.bincount(tracks.point_index[seen], minlength=tracks.n_points) >= 2)


def _rows_of_part(tracks: Tracks, views: I64, points: I64) -> I64:
    """The observations of a part, in the order of its own tracks."""
    return np.flatnonzero(np.isin(tracks.view_index, views) & np.isin(tracks.point_index, points))


def tracks_of_part(tracks: Tracks, views: I64) -> Tracks:
    """The tracks of some views, with views and points renumbered."""
    points = points_of_part(tracks, views)
    view, point = np.full(tracks.n_views, -1), np.full(tracks.n_points, -1)
    view[views], point[points] = np.arange(len(views)), np.arange(len(points))
    k = _rows_of_part(tracks, views, points)
    return Tracks(
        view[tracks.view_index[k]], point[tracks.point_index[k]], tracks.xy[k], len(views), len(points)
    )


def input_of_part(
    tracks: Tracks, pairs: Sequence[TwoView], sizes: I64, prior: IntrinsicsPrior, views: I64
) -> PartInput:
    """The input of a part; the pairs contain only the fields that the projective reconstruction reads."""
    view = np.full(tracks.n_views, -1)
    view[views] = np.arange(len(views))
    none, affine = np.zeros(0, np.int64), np.zeros((0, 2, 2))
    inside = [p for p in pairs if p.accepted and view[p.i] >= 0 and view[p.j] >= 0]
    renumbered = tuple(
        replace(p, i=int(view[p.i]), j=int(view[p.j]), index1=none, index2=none, affine=affine)
        for p in inside
    )
    return PartInput(tracks_of_part(tracks, views), renumbered, sizes[views], prior_of_views(prior, views))


def prior_of_views(prior: IntrinsicsPrior, views: I64 | Sequence[int]) -> IntrinsicsPrior:
    """The prior of some views."""
    rows = {name: getattr(prior, name)[views] for name in ("mean", "std", "shared", "kind")}
    return replace(prior, **rows)


def reconstruct_part(
    config: PipelineConfig, given: PartInput, number: int, seed: int, attempts: int
) -> list[Reconstruction]:
    """Reconstruct a part, from one initial pair after another until the result is trusted.

    If no result is trusted, no camera is registered: the views are then registered with the other parts.
    """
    for attempt in range(attempts):
        rng = stream(seed, "part", number, attempt)
        try:
            projective = config.projective.reconstruct(
                given.tracks, given.pairs, given.sizes, rng=rng, attempt=attempt
            )
            calibration = calibrate_with_core(config.selfcalibration, projective, prior=given.prior, rng=rng)
            start = calibrated_part(projective, calibration)
            metric = config.metric.refine(start, calibration, prior=given.prior, rng=rng, threads=1)
        except StageFailure:
            continue
        if metric.trusted:
            return [_without_observations(metric.reconstruction)]
    return [_without_observations(_no_cameras(given))]


def _without_observations(model: Reconstruction) -> Reconstruction:
    """The model without the observations, which the caller has: the result of a task is small."""
    none = np.zeros(0, np.int64)
    return replace(
        model, tracks=replace(model.tracks, view_index=none, point_index=none, xy=np.zeros((0, 2)))
    )


def _no_cameras(given: PartInput) -> Reconstruction:
    n, t = len(given.sizes), given.tracks
    none, empty = np.zeros(n, dtype=bool), np.zeros((t.n_points, 4))
    P, K, valid, inlier = np.zeros((n, 3, 4)), np.zeros((n, 3, 3)), empty[:, 0] > 0.0, none[t.view_index]
    return Reconstruction("metric", P, empty, none, valid, inlier, t, given.sizes, 1.0, ("",) * n, K, K[:, 0])


def align_parts(
    tracks: Tracks, sizes: I64, own: Sequence[I64], parts: Sequence[I64], models: Sequence[Reconstruction]
) -> Reconstruction | None:
    """Cameras and points of all parts that can be aligned with the largest one, in its frame, or None.

    ``own`` are the views of each part without the overlap, which take their camera from it. The observations
    of the ``models`` are those of ``tracks``.
    """
    models = [
        replace(model, tracks=tracks_of_part(tracks, views))
        for model, views in zip(models, parts, strict=True)
    ]
    order = sorted(range(len(parts)), key=lambda p: -int(models[p].registered.sum()))
    if not models[order[0]].registered.any():
        return None
    points = [points_of_part(tracks, views) for views in parts]
    placed = {order[0]: Similarity(1.0, np.eye(3), np.zeros(3))}
    links: dict[tuple[int, int], tuple[int, Similarity]] = {}
    while True:
        best: tuple[int, int, Similarity] | None = None
        for a in placed:
            for b in set(order) - placed.keys():
                if (a, b) not in links:
                    links[a, b] = _align_part(
                        (parts[a], points[a], models[a]), (parts[b], points[b], models[b])
                    )
                agreeing, found = links[a, b]
                if agreeing and (best is None or agreeing > best[0]):
                    near = placed[a]
                    t = near.apply(found.t)
                    best = agreeing, b, Similarity(near.scale * found.scale, near.R @ found.R, t)
        if best is None:
            break
        placed[best[1]] = best[2]
    return _in_one_frame(tracks, sizes, own, list(zip(parts, points, models, strict=True)), placed)


def _align_part(a: _Part, b: _Part) -> tuple[int, Similarity]:
    """The similarity that takes b to a, and the number of common points that agree; 0 if too few do."""
    identity = Similarity(1.0, np.eye(3), np.zeros(3))
    (views_a, points_a, model_a), (views_b, points_b, model_b) = a, b
    _, va, vb = np.intersect1d(views_a, views_b, return_indices=True)
    both = model_a.registered[va] & model_b.registered[vb]
    if both.sum() < MIN_COMMON:
        return 0, identity
    (Ra, Ca), (Rb, Cb) = _poses(model_a, va[both]), _poses(model_b, vb[both])
    found = _similarity_of_cameras(Ra, Ca, Rb, Cb)
    _, pa, pb = np.intersect1d(points_a, points_b, return_indices=True)
    known = model_a.valid[pa] & model_b.valid[pb]
    pa, pb = pa[known], pb[known]
    t = model_a.tracks
    view_of = np.full(t.n_points, -1)
    view_of[t.point_index[model_a.inlier][::-1]] = t.view_index[model_a.inlier][::-1]
    seen = view_of[pa] >= 0
    pa, pb = pa[seen], pb[seen]
    if not len(pa):
        return 0, identity
    P = model_a.P[view_of[pa]]
    Xb = found.apply(model_b.X[pb, :3] / model_b.X[pb, 3:])
    offset = _project_each(P, model_a.X[pa]) - _project_each(P, np.column_stack([Xb, np.ones(len(Xb))]))
    close = np.linalg.norm(offset, axis=1) < MAX_OFFSET_REL * model_a.sizes[view_of[pa]].max(axis=1)
    return (int(close.sum()), found) if close.mean() >= MIN_AGREEMENT else (0, identity)


def _project_each(P: F64, X: F64) -> F64:
    x = np.einsum("nij,nj->ni", P, X)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.nan_to_num(x[:, :2] / x[:, 2:], nan=np.inf))


def _poses(model: Reconstruction, views: I64) -> tuple[F64, F64]:
    """Rotations (N, 3, 3) and centres (N, 3)."""
    assert model.K is not None
    M = np.linalg.inv(model.K[views]) @ model.P[views]
    return M[:, :, :3], -np.einsum("nji,nj->ni", M[:, :, :3], M[:, :, 3])


def _similarity_of_cameras(Ra: F64, Ca: F64, Rb: F64, Cb: F64) -> Similarity:
    """The similarity from cameras b to the same cameras a; its rotation follows from the camera rotations.

    It is therefore determined for collinear centres, too. Cameras with more than three times the median error
    are left out in each round.
    """
    use = np.ones(len(Ra), dtype=bool)
    for _ in range(5):
        R = nearest_rotation(np.einsum("nji,njk->ik", Ra[use], Rb[use]))
        a, b = Ca - np.median(Ca[use], axis=0), (Cb - np.median(Cb[use], axis=0)) @ R.T
        scale = float(
            np.median(np.linalg.norm(a[use], axis=1)) / max(np.median(np.linalg.norm(b[use], axis=1)), 1e-12)
        )
        t = np.median((Ca - scale * Cb @ R.T)[use], axis=0)
        turned = np.linalg.norm(Ra @ R - Rb, axis=(1, 2))
        moved = np.linalg.norm(Ca - scale * Cb @ R.T - t, axis=1)
        new = (turned <= 3.0 * np.median(turned[use]) + 1e-9) & (moved <= 3.0 * np.median(moved[use]) + 1e-9)
        if new.sum() < MIN_COMMON or (new == use).all():
            break
        use = new
    return Similarity(scale, R, t)


def _in_one_frame(
    tracks: Tracks,
    sizes: I64,
    own: Sequence[I64],
    parts: Sequence[_Part],
    placed: dict[int, Similarity],
) -> Reconstruction:
    """Cameras and points of the placed parts; inliers agree with their part and with the whole."""
    registered, P, K, distortion = _cameras_in_one_frame(tracks.n_views, own, parts, placed)
    X, support, seen = _points_in_one_frame(tracks, parts, placed)
    sigma = float(np.median([parts[p][2].sigma_px for p in placed]))
    found = (registered, support > 0, seen, tracks, sizes, sigma, ("",) * tracks.n_views, K, distortion)
    merged = Reconstruction("metric", P, X, *found)
    close = _reprojection_px(merged) < MAX_OFFSET_REL * sizes[tracks.view_index].max(axis=1)
    inlier = seen & registered[tracks.view_index] & close
    valid = (support > 0) & (np.bincount(tracks.point_index[inlier], minlength=tracks.n_points) >= 2)
    return replace(merged, inlier=inlier & valid[tracks.point_index], valid=valid)


def _cameras_in_one_frame(
    n_views: int, own: Sequence[I64], parts: Sequence[_Part], placed: dict[int, Similarity]
) -> tuple[B8, F64, F64, F64]:
    """Registered views (V,), P, K and distortion, from the part that owns a view if it has its camera."""
    registered, distortion = np.zeros(n_views, dtype=bool), np.zeros((n_views, 3))
    P, K = np.zeros((n_views, 3, 4)), np.zeros((n_views, 3, 3))
    for inner in (True, False):
        for p, similarity in placed.items():
            views, _, model = parts[p]
            free = model.registered & ~registered[views] & (np.isin(views, own[p]) | (not inner))
            here = np.flatnonzero(free)
            R, C = _poses(model, here)
            R, C = R @ similarity.R.T, similarity.apply(C)
            assert model.K is not None
            K[views[here]] = model.K[here]
            P[views[here]] = model.K[here] @ np.concatenate([R, -(R @ C[:, :, None])], axis=2)
            distortion[views[here]] = 0.0 if model.distortion is None else model.distortion[here]
            registered[views[here]] = True
    return registered, P, K, distortion


def _points_in_one_frame(
    tracks: Tracks, parts: Sequence[_Part], placed: dict[int, Similarity]
) -> tuple[F64, I64, B8]:
    """Points (M, 4) of the part with most inliers, their numbers of inliers, and inliers (K,) of any part."""
    m = tracks.n_points
    X, support, seen = np.zeros((m, 4)), np.zeros(m, np.int64), np.zeros(len(tracks.xy), dtype=bool)
    for p, similarity in placed.items():
        views, points, model = parts[p]
        seen[_rows_of_part(tracks, views, points)[model.inlier]] = True
        count = np.bincount(model.tracks.point_index[model.inlier], minlength=len(points))
        better = model.valid & (count > support[points])
        moved = similarity.apply(model.X[better, :3] / model.X[better, 3:])
        X[points[better]] = np.column_stack([moved, np.ones(len(moved))])
        support[points[better]] = count[better]
    return X, support, seen


def _reprojection_px(model: Reconstruction) -> F64:
    """Distance (K,) of each observation from its projected point; large without a camera or a point."""
    t, distance = model.tracks, np.full(len(model.tracks.xy), np.inf)
    assert model.K is not None
    assert model.distortion is not None
    for view, rows in enumerate(rows_of_views(t.view_index, t.n_views)):
        if model.registered[view]:
            rows = rows[model.X[t.point_index[rows], 3] != 0.0]
            K, X = model.K[view], model.X[t.point_index[rows], :3]
            Rt = np.linalg.solve(K, model.P[view])
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                xy = project_camera(K, Rt[:, :3], Rt[:, 3], X, distortion=model.distortion[view])
            distance[rows] = np.nan_to_num(np.linalg.norm(xy - t.xy[rows], axis=1), nan=np.inf)
    return distance


def pairs_of_missing(pairs: Sequence[TwoView], missing: B8) -> list[TwoView]:
    """The accepted pairs, and the rejected ones of missing images whose matches mostly agree with one F.

    Pairs that were rejected as repeated structure stay rejected.
    """

    def of_use(pair: TwoView) -> bool:
        agree = pair.inliers >= 0.5 * pair.candidates
        return bool(pair.configuration) and agree and bool(missing[pair.i] or missing[pair.j])

    more = [
        p if p.accepted else replace(p, accepted=True, reason="") for p in pairs if p.accepted or of_use(p)
    ]
    return [pair for pair in reject_repeated_structure(more, len(missing)) if pair.accepted]


def register_more(
    job: Job,
    views: Sequence[Any],
    pairs: Sequence[TwoView],
    calibration: SelfCalibration,
    metric: MetricResult,
    attempt: int,
) -> MetricResult:
    """Register missing images; return the old model if none is added or the new one is not trusted."""
    run, more = job.run, pairs_of_missing(pairs, ~metric.reconstruction.registered)
    if len(more) <= sum(pair.accepted for pair in pairs):
        return metric

    def register() -> MetricResult:
        rng, workers, old = stream(run.seed, "metric", attempt, 1), run.workers, metric.reconstruction
        tracks = job.config.tracks.build(views, more, map_all=workers.map_all, rng=rng)
        start, known = cameras_on_tracks(old, tracks), from_metric(old, calibration)
        try:
            new = job.config.metric.refine(start, known, prior=job.prior, rng=rng, threads=workers.threads)
        except StageFailure:
            return metric
        return better_model(metric, new)

    key = run.key(
        "metric", run.logs["metric"].keys[f"attempt-{attempt}"], run.variant_key("tracks"), run.seed
    )
    found: MetricResult = run.cached("metric", f"attempt-{attempt}-more", key, register)
    return found


def better_model(old: MetricResult, new: MetricResult) -> MetricResult:
    """``new`` if it has more images, all of the old ones, and is as trusted; otherwise ``old``."""
    before, after = old.reconstruction.registered, new.reconstruction.registered
    joined = after.sum() > before.sum() and (before <= after).all()
    return new if joined and new.trusted >= old.trusted else old


def cameras_on_tracks(metric: Reconstruction, tracks: Tracks) -> Reconstruction:
    """Metric cameras with the points of other tracks, triangulated without distortion."""
    seen = metric.registered[tracks.view_index]
    view, point, xy = tracks.view_index[seen], tracks.point_index[seen], tracks.xy[seen]
    X = triangulate_observations(metric.P, view, point, xy, tracks.n_points)
    valid = np.bincount(point, minlength=tracks.n_points) >= 2
    inlier = seen & valid[tracks.point_index]
    return replace(metric, X=X, valid=valid, inlier=inlier, tracks=tracks)


def from_metric(metric: Reconstruction, calibration: SelfCalibration) -> SelfCalibration:
    """The self-calibration with the cameras of a metric reconstruction as its only candidate."""
    assert metric.K is not None
    only = Upgrade(np.eye(4), metric.K, 0.0, calibration.candidates[0].method)
    return replace(calibration, metric_from_projective=np.eye(4), K=metric.K, candidates=(only,))
