"""Large and difficult sets: calibration of a core of views, and overlapping parts.

Drift and wrong tracks bend projective reconstructions of long sequences, so that no calibration places the
points in front of all cameras. Neighbouring views still determine one; the metric stage registers the others.

Parts are independent tasks. Wrong matches between two similar places cannot deform a part that contains only
one of them, and a part that fails does not affect the others: its images are registered after the alignment.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice, product
from typing import NamedTuple

import numpy as np
import scipy

from thesisrecon._numba import code_digest
from thesisrecon.arrays import B8, F64, I64, rows_of_views
from thesisrecon.camera import compose_camera
from thesisrecon.config import PipelineConfig, SelfCalibrator
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import poses_of_model
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.strata import nearest_rotation
from thesisrecon.lens import stacked_rows
from thesisrecon.matching.pair_selection import strong_pairs
from thesisrecon.optimize.bundle.projection import MetricModel, image_points
from thesisrecon.pipeline.lens import as_imaged, straight_pair, straight_tracks
from thesisrecon.pipeline.run import Batch, Job, stream
from thesisrecon.records import (
    IntrinsicsPrior,
    Reconstruction,
    SelfCalibration,
    Similarity,
    Tracks,
    TwoView,
    Upgrade,
    common_points,
)
from thesisrecon.selfcalibration._upgrade import calibration_of_two_views

CORE_VIEWS, MAX_CORES = 5, 8  # views of a core, and number of cores that are tried
MAX_CUT, MIN_SIDE = 0.1, 0.3
"""Largest fraction of the common points of a part that a cut may sever (images of a single place have no such
cut), and smallest fraction of the views on either side."""
OVERLAP = 12  # views of each of two neighbouring parts that the other one contains too
MIN_COMMON = 3  # Common cameras that determine the similarity between two parts
MAX_OFFSET_REL, MIN_AGREEMENT = 0.005, 0.5
"""Largest distance, relative to the long side, between the projections of a point that two parts agree on,
and the fraction of the common points that must agree; otherwise two parts are not aligned."""
_IDENTITY = Similarity.scaling(1.0)


def calibrate_with_core(
    method: SelfCalibrator, projective: Reconstruction, *, prior: IntrinsicsPrior, rng: np.random.Generator
) -> SelfCalibration:
    """Calibrate all views, else the first core of them that determines the calibration; other K are zero."""
    if (known := calibration_of_two_views(projective, prior)) is not None:
        return known
    found, failures = list[SelfCalibration](), list[StageFailure]()
    for part in chain([projective], (restrict_views(projective, views) for views in _cores(projective))):
        try:
            found.append(method.calibrate(part, prior=prior, rng=rng))
        except StageFailure as failure:
            failures.append(failure)
            continue
        if part is projective or found[-1].identifiable:
            return found[-1]
    if not found:
        raise failures[0]
    return found[0]


def calibrated_part(projective: Reconstruction, calibration: SelfCalibration) -> Reconstruction:
    """The reconstruction of the views that have a calibration; itself if all have."""
    views = projective.registered & (calibration.K[:, 0, 0] > 0.0)
    return projective if (views == projective.registered).all() else restrict_views(projective, views)


def from_metric(metric: Reconstruction, calibration: SelfCalibration) -> SelfCalibration:
    """The self-calibration with the cameras of a metric reconstruction as its only candidate."""
    assert metric.K is not None
    only = Upgrade(np.eye(4), metric.K, 0.0, calibration.candidates[0].method)
    return replace(calibration, metric_from_projective=np.eye(4), K=metric.K, candidates=(only,))


def _cores(projective: Reconstruction) -> Iterator[B8]:
    """Masks (V,) of views: each view, best observed first, with those that share most points with it."""
    registered = np.flatnonzero(projective.registered)
    if len(registered) <= CORE_VIEWS:
        return
    shared = projective.common_points[np.ix_(registered, registered)]
    best_first = shared[np.argsort(-shared.diagonal(), kind="stable")]
    # A view shares most points with itself.
    nearest = np.sort(np.argsort(-best_first, axis=1, kind="stable")[:, :CORE_VIEWS], axis=1)
    for views in islice(dict.fromkeys(map(tuple, registered[nearest].tolist())), MAX_CORES):
        yield np.isin(np.arange(len(projective.registered)), views)


def restrict_views(reconstruction: Reconstruction, views: B8) -> Reconstruction:
    """The reconstruction of some registered views, with the points that two or more of them see."""
    t = reconstruction.tracks
    inlier = reconstruction.inlier & views[t.view_index]
    valid = reconstruction.valid & (np.bincount(t.point_index[inlier], minlength=t.n_points) >= 2)
    P = np.where(views[:, None, None], reconstruction.P, 0.0)
    X, inlier = np.where(valid[:, None], reconstruction.X, 0.0), inlier & valid[t.point_index]
    return replace(reconstruction, registered=views, valid=valid, inlier=inlier, P=P, X=X)


def cameras_from_parts(
    job: Job, tracks: Tracks, pairs: Sequence[TwoView], attempts: int
) -> tuple[Reconstruction | None, list[str]]:
    """Reconstruct a large set in parts and align them (None if impossible); also the keys of the parts."""
    run, config, prior, sizes = job.run, job.config, job.prior, job.sizes
    if not 0 < config.images.part_views < int((np.bincount(tracks.view_index) > 0).sum()):
        return None, []
    graph = neighbour_graph(tracks)
    own = divide_views(graph, config.images.part_views)
    if len(own) < 2:
        return None, []
    parts = overlapping_parts(graph, own)
    variants = [run.variant_key(stage) for stage in ("projective", "selfcalibration", "metric")]
    inputs = [run.logs["tracks"].keys, sizes, prior.mean, prior.std, prior.shared, prior.kind]
    keys = {
        f"part-{n}": run.key("metric", variants, code_digest(reconstruct_part), *inputs, views, run.seed)
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
    common = common_points(tracks.view_index, tracks.point_index, tracks.n_views).tocoo()
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
    """Divide the views until parts have at most ``part_views``, or each cut severs too many common points."""
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
    """The cut in reverse Cuthill-McKee order (near neighbours) that severs the smallest share of points."""
    inside = graph[views][:, views]
    order = scipy.sparse.csgraph.reverse_cuthill_mckee(inside.tocsr(), symmetric_mode=True)
    ties, place = inside.tocoo(), np.argsort(order)
    first, last = np.sort([place[ties.row], place[ties.col]], axis=0)
    # Each pair is twice in the symmetric matrix; the cuts behind first ... last - 1 sever it.
    change = np.bincount(first, ties.data, len(views)) - np.bincount(last, ties.data, len(views))
    severed = np.cumsum(change)[:-1]
    *volume, total = np.cumsum(np.asarray(inside.sum(axis=1)).ravel()[order])
    ratio = severed / np.maximum(np.minimum(volume, total - volume), 1.0)
    sides = np.arange(1, len(views))
    ratio[np.minimum(sides, len(views) - sides) < MIN_SIDE * len(views)] = np.inf
    at = int(np.argmin(ratio)) + 1
    return [np.sort(views[order[:at]]), np.sort(views[order[at:]])] if ratio[at - 1] <= MAX_CUT else None


def overlapping_parts(graph: scipy.sparse.csr_array, parts: Sequence[I64]) -> list[I64]:
    """Each part with the views of the others that are closest to it."""
    grown = []
    for views in parts:
        ties = np.asarray(graph[views].sum(axis=0)).ravel()
        others = (other for other in parts if other is not views)
        nearest = (other[np.argsort(-ties[other], kind="stable")[:OVERLAP]] for other in others)
        grown.append(np.unique(np.concatenate([views, *(near[ties[near] > 0] for near in nearest)])))
    return grown


class PartInput(NamedTuple):
    """Input of the reconstruction of some views, with views and points renumbered."""

    tracks: Tracks
    pairs: tuple[TwoView, ...]
    sizes: I64
    prior: IntrinsicsPrior


def _rows_of_part(tracks: Tracks, views: I64) -> I64:
    """The observations of some views of the points that two or more of them observe."""
    k = np.flatnonzero(np.isin(tracks.view_index, views))
    return k[(np.bincount(tracks.point_index[k]) >= 2)[tracks.point_index[k]]]


def tracks_of_part(tracks: Tracks, views: I64) -> Tracks:
    """The tracks of some views (sorted), with views and points renumbered."""
    k = _rows_of_part(tracks, views)
    points, point = np.unique(tracks.point_index[k], return_inverse=True)
    return Tracks(np.searchsorted(views, tracks.view_index[k]), point, tracks.xy[k], len(views), len(points))


def input_of_part(
    tracks: Tracks, pairs: Sequence[TwoView], sizes: I64, prior: IntrinsicsPrior, views: I64
) -> PartInput:
    """The input of a part; the pairs contain only the fields that the projective reconstruction reads."""
    number = {view: k for k, view in enumerate(views.tolist())}
    none, affine = np.zeros(0, np.int64), np.zeros((0, 2, 2))
    inside = tuple(
        replace(p, i=number[p.i], j=number[p.j], index1=none, index2=none, affine=affine)
        for p in pairs
        if p.accepted and {p.i, p.j} <= number.keys()
    )
    return PartInput(tracks_of_part(tracks, views), inside, sizes[views], prior_of_views(prior, views))


def prior_of_views(prior: IntrinsicsPrior, views: I64 | Sequence[int]) -> IntrinsicsPrior:
    """The prior of some views."""
    rows = {name: getattr(prior, name)[views] for name in ("mean", "std", "shared", "kind")}
    return replace(prior, **rows, lens=None if prior.lens is None else prior.lens[views])


def reconstruct_part(
    config: PipelineConfig, given: PartInput, number: int, seed: int, attempts: int
) -> list[Reconstruction]:
    """Reconstruct a part until the result of an initial pair is trusted, else with no camera registered.

    The model is returned without the observations, which the caller has: the result of a task is small.
    """
    tracks, sizes, prior = given.tracks, given.sizes, given.prior
    n, N = len(sizes), tracks.n_points
    model = Reconstruction(
        "metric", np.zeros((n, 3, 4)), np.zeros((N, 4)), registered=np.zeros(n, dtype=bool),
        valid=np.zeros(N, dtype=bool), inlier=np.zeros(len(tracks.xy), dtype=bool), tracks=tracks,
        sizes=sizes, sigma_px=1.0, reasons=("",) * n, K=np.zeros((n, 3, 3)), distortion=np.zeros((n, 3)),
    )  # fmt: skip
    straight, pairs = tracks, given.pairs
    if prior.lens is not None:
        straight = straight_tracks(tracks, sizes, prior.lens)
        pairs = tuple(straight_pair(pair, sizes, prior.lens) for pair in pairs)
    for attempt in range(attempts):
        rng = stream(seed, "part", number, attempt)
        try:
            projective = config.projective.reconstruct(straight, pairs, sizes, rng=rng, attempt=attempt)
            calibration = calibrate_with_core(config.selfcalibration, projective, prior=prior, rng=rng)
            start = as_imaged(calibrated_part(projective, calibration), tracks, prior)
            metric = config.metric.refine(start, calibration, prior=prior, rng=rng, threads=1)
        except StageFailure:
            continue
        if metric.trusted:
            model = metric.reconstruction
            break
    rows = np.zeros(0, np.int64)
    return [replace(model, tracks=replace(tracks, view_index=rows, point_index=rows, xy=np.zeros((0, 2))))]


class _Part(NamedTuple):
    """Views and points of a part, the rows of its observations among all, and its model."""

    views: I64
    points: I64
    rows: I64
    model: Reconstruction


def align_parts(
    tracks: Tracks, sizes: I64, own: Sequence[I64], views: Sequence[I64], models: Sequence[Reconstruction]
) -> Reconstruction | None:
    """Cameras and points of all parts that can be aligned with the largest one, in its frame, or None.

    ``own`` are the ``views`` of each part without the overlap, which take their camera from it.
    """
    parts = []
    for here, model in zip(views, models, strict=True):
        rows = _rows_of_part(tracks, here)
        model = replace(model, tracks=tracks_of_part(tracks, here))
        parts.append(_Part(here, np.unique(tracks.point_index[rows]), rows, model))
    first = max(range(len(parts)), key=lambda p: int(models[p].registered.sum()))
    if not models[first].registered.any():
        return None
    placed, links = {first: _IDENTITY}, dict[tuple[int, int], tuple[int, Similarity]]()
    while left := set(range(len(parts))) - placed.keys():
        for a, b in product(placed, left):
            if (a, b) not in links:
                links[a, b] = _align_part(parts[a], parts[b])
        a, b = max(product(placed, left), key=lambda link: links[link][0])
        agreeing, found = links[a, b]
        if not agreeing:
            break
        near = placed[a]
        placed[b] = Similarity(near.scale * found.scale, near.R @ found.R, near.apply(found.t))
    return _in_one_frame(tracks, sizes, own, {p: (parts[p], moved) for p, moved in placed.items()})


def _align_part(a: _Part, b: _Part) -> tuple[int, Similarity]:
    """The similarity that takes b to a, and the number of common points that agree; 0 if too few do."""
    _, va, vb = np.intersect1d(a.views, b.views, return_indices=True)
    both = a.model.registered[va] & b.model.registered[vb]
    if both.sum() < MIN_COMMON:
        return 0, _IDENTITY
    Ra, _, Ca = poses_of_model(a.model, va[both])
    Rb, _, Cb = poses_of_model(b.model, vb[both])
    found = _similarity_of_cameras(Ra, Ca, Rb, Cb)
    _, pa, pb = np.intersect1d(a.points, b.points, return_indices=True)
    t, view_of = a.model.tracks, np.full(a.model.tracks.n_points, -1)
    view_of[t.point_index[a.model.inlier][::-1]] = t.view_index[a.model.inlier][::-1]
    known = a.model.valid[pa] & b.model.valid[pb] & (view_of[pa] >= 0)
    pa, pb, view = pa[known], pb[known], view_of[pa[known]]
    if not len(pa):
        return 0, _IDENTITY
    Xb = homogenize(found.apply(b.model.X[pb, :3] / b.model.X[pb, 3:]))
    x = np.einsum("nij,mnj->mni", a.model.P[view], np.stack([a.model.X[pa], Xb]))
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = np.nan_to_num(x[..., :2] / x[..., 2:], nan=np.inf)
        offset = xy[0] - xy[1]
    close = np.linalg.norm(offset, axis=1) < MAX_OFFSET_REL * a.model.sizes[view].max(axis=1)
    return (int(close.sum()), found) if close.mean() >= MIN_AGREEMENT else (0, _IDENTITY)


def _similarity_of_cameras(Ra: F64, Ca: F64, Rb: F64, Cb: F64) -> Similarity:
    """The similarity from cameras b to a by their rotations, without those beyond three median errors."""
    use = np.ones(len(Ra), dtype=bool)
    for _ in range(5):
        R = nearest_rotation(np.einsum("nji,njk->ik", Ra[use], Rb[use]))
        spread = (C[use] - np.median(C[use], axis=0) for C in (Ca, Cb))
        size, other = (float(np.median(np.linalg.norm(part, axis=1))) for part in spread)
        scale = size / max(other, 1e-12)
        t = np.median((Ca - scale * Cb @ R.T)[use], axis=0)
        turned = np.linalg.norm(Ra @ R - Rb, axis=(1, 2))
        moved = np.linalg.norm(Ca - scale * Cb @ R.T - t, axis=1)
        new = (turned <= 3.0 * np.median(turned[use]) + 1e-9) & (moved <= 3.0 * np.median(moved[use]) + 1e-9)
        if new.sum() < MIN_COMMON or (new == use).all():
            break
        use = new
    return Similarity(scale, R, t)


def _in_one_frame(
    tracks: Tracks, sizes: I64, own: Sequence[I64], placed: dict[int, tuple[_Part, Similarity]]
) -> Reconstruction:
    """Cameras and points of the placed parts; inliers agree with their part and with the whole."""
    n, m = tracks.n_views, tracks.n_points
    registered, (R, K), C = np.zeros(n, dtype=bool), np.zeros((2, n, 3, 3)), np.zeros((n, 3))
    lenses = [np.zeros(3)] * n
    # Cameras of the part that owns the view, if possible.
    for inner, (p, (part, similarity)) in product((True, False), placed.items()):
        model = part.model
        free = model.registered & ~registered[part.views] & (np.isin(part.views, own[p]) | (not inner))
        views = part.views[free]
        turned, _, centres = poses_of_model(model, free)
        assert model.K is not None
        R[views], C[views], K[views] = turned @ similarity.R.T, similarity.apply(centres), model.K[free]
        if model.distortion is not None:
            for view, lens in zip(views.tolist(), model.distortion[free], strict=True):
                lenses[view] = lens
        registered[views] = True
    distortion = stacked_rows(lenses)
    # Points of the part with most inliers.
    X, support, seen = np.zeros((m, 4)), np.zeros(m, np.int64), np.zeros(len(tracks.xy), dtype=bool)
    for part, similarity in placed.values():
        points, model = part.points, part.model
        seen[part.rows[model.inlier]] = True
        count = np.bincount(model.tracks.point_index[model.inlier], minlength=len(points))
        better = model.valid & (count > support[points])
        X[points[better]] = homogenize(similarity.apply(model.X[better, :3] / model.X[better, 3:]))
        support[points[better]] = count[better]
    t, f = -np.einsum("vij,vj->vi", R, C), np.where(registered, K[:, 0, 0], 1.0)
    intrinsics = np.column_stack([K[:, 0, 0], K[:, 1, 1] / f, K[:, 0, 1:], K[:, 1, 2], distortion])
    cameras = MetricModel(R, t, intrinsics, np.arange(n), np.ascontiguousarray(X[:, :3]))
    k = np.flatnonzero(seen & registered[tracks.view_index])
    view, point = tracks.view_index[k], tracks.point_index[k]
    offset = np.linalg.norm(image_points(cameras, view, point)[0] - tracks.xy[k], axis=1)
    inlier = np.zeros(len(tracks.xy), dtype=bool)
    inlier[k] = np.nan_to_num(offset, nan=np.inf) < MAX_OFFSET_REL * sizes[view].max(axis=1)
    valid = (support > 0) & (np.bincount(tracks.point_index[inlier], minlength=m) >= 2)
    return Reconstruction(
        "metric", compose_camera(K, R, t), X, registered, valid, inlier & valid[tracks.point_index], tracks,
        sizes, sigma_px=float(np.median([part.model.sigma_px for part, _ in placed.values()])),
        reasons=("",) * n, K=K, distortion=distortion,
    )  # fmt: skip
