"""Projective model in progress: tracks and first pair (6.2), triangulation and adjustment (6.3 to 6.7)."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse

from thesisrecon._numba import full, kernel, zeros
from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.homogeneous import pixel_from_unit, whitened_frame
from thesisrecon.geometry.triangulation import triangulate_observations
from thesisrecon.geometry.two_view import canonical_cameras, quasi_euclidean_planes
from thesisrecon.optimize.bundle.partial import refine_points, triangulate_points
from thesisrecon.optimize.bundle.projection import Observations
from thesisrecon.optimize.bundle.projective import refine_projective_bundle
from thesisrecon.optimize.least_squares import noise_from_distances
from thesisrecon.records import Reconstruction, Tracks, TwoView, with_reasons

# Homography inlier ratio beyond which a pair shows no parallax: the rest may be undetected wrong matches.
NO_PARALLAX = 0.95
_NO_PARALLAX_REASONS = {
    "pure rotation": "the camera only rotated about its centre (pure rotation)",
    "plane": (
        "all matches lie on one plane (planar scene), the camera hardly moved, or it rotated about its "
        "centre while zooming (pure rotation)"
    ),
}


def rank_initial_pairs(tracks: Tracks, pairs: Sequence[TwoView]) -> list[TwoView]:
    """Rank the accepted pairs as initial pairs, best first (6.2)."""
    # The score is the number of shared points (those seen in a third view count twice) times the share that
    # no homography explains; pairs whose matches leave F undetermined count a tenth. If one initial pair
    # fails, another one with the same view would probably fail too: each use of a view halves the score of
    # its pairs.
    table = np.zeros((tracks.n_views, tracks.n_points), dtype=bool)
    table[tracks.view_index, tracks.point_index] = True
    long = table.sum(axis=0) >= 3

    def score(pair: TwoView) -> float:
        both = table[pair.i] & table[pair.j]
        shared = float(both.sum() + (both & long).sum())
        return shared * (1.0 - pair.homography_inlier_ratio) * (0.1 if pair.undetermined else 1.0)

    left = sorted((pair for pair in pairs if pair.accepted), key=lambda pair: (pair.i, pair.j))
    scores = np.array([score(pair) for pair in left])
    views = np.array([(pair.i, pair.j) for pair in left]).reshape(-1, 2)
    uses, ranked = np.zeros(tracks.n_views), []
    for _ in range(len(left)):
        discounted = np.where(scores >= 0.0, scores * 0.5 ** uses[views].sum(axis=1), -1.0)
        best = int(np.argmax(discounted))
        ranked.append(left[best])
        uses[views[best]] += 1
        scores[best] = -1.0
    return ranked


def select_core(pairs: Sequence[TwoView], n_views: int, size: int) -> B8:
    """Select ``size`` views (V,) of most matches that no homography explains, from the best pair on."""
    tie = np.zeros((n_views, n_views))
    for pair in pairs:
        if pair.accepted:
            tie[pair.i, pair.j] = tie[pair.j, pair.i] = pair.inliers * (1.0 - pair.homography_inlier_ratio)
    core = np.zeros(n_views, dtype=bool)
    core[int(tie.max(axis=1).argmax())] = True
    for _ in range(size - 1):
        gain = np.where(core, -1.0, tie[core].sum(axis=0))
        core[int(np.argmax(gain))] |= gain.max() > 0.0
    return core


def require_pair_with_parallax(pairs: Sequence[TwoView]) -> None:
    """Raise ``StageFailure`` if every accepted pair is planar, a pure rotation or nearly a homography."""
    accepted = [pair for pair in pairs if pair.accepted]
    if not accepted:
        return
    shares = [pair.homography_inlier_ratio for pair in accepted]
    kinds = Counter(pair.configuration for pair in accepted)
    if min(shares) >= NO_PARALLAX or all(kind in _NO_PARALLAX_REASONS for kind in kinds):
        usual = "the camera only rotates, hardly moves, or sees one plane"
        meaning = _NO_PARALLAX_REASONS.get(kinds.most_common(1)[0][0], usual)
        raise StageFailure.of("no-pair-with-parallax", meaning, counted(len(shares), "pair"), min(shares))


def initial_cameras(pair: TwoView, sizes: I64) -> tuple[F64, F64]:
    """Compute initial cameras (3.42): P1 = [I | 0], P2 = [[e]x F + e pi' | e], in pixels (HZ 9.5)."""
    # The plane pi is chosen in unit-free pixels so that the left part of P2 is nearest to a rotation: the
    # frame is then nearly metric with a focal length of one long side. Of the two such planes the one with
    # fewer points beyond it is taken, and the sign of P2 that places most points in front of both cameras.
    T1, T2 = pixel_from_unit(sizes)
    F = T2.T @ pair.F @ T1
    found = []
    for plane in quasi_euclidean_planes(F):
        P1, P2 = canonical_cameras(F, plane=plane)
        P = np.stack([T1 @ P1, T2 @ P2])
        X = triangulate_points(P, np.stack([pair.xy1, pair.xy2]), method="linear")
        first, second = np.sign(X @ P[0, 2]), np.sign(X @ P[1, 2])
        side = 1.0 if np.sum(first * second) >= 0 else -1.0
        found.append((abs(float(np.sum(first * np.sign(X[:, 3])))), (P[0], side * P[1])))
    return max(found, key=lambda each: each[0])[1]


_CELLS = 8  # cells of the grid over an image, along each side


def select_tracks_with_parallax(tracks: Tracks, pairs: Sequence[TwoView]) -> B8:
    """Select tracks (N,) seen from several positions; undetermined depths of others distort the frame."""
    n, K = tracks.n_views, len(tracks.xy)
    flat = [(p.i, p.j) for p in pairs if p.accepted and p.homography_inlier_ratio >= NO_PARALLAX]
    i, j = np.array(flat, dtype=np.int64).reshape(-1, 2).T
    rows, columns = np.concatenate([i, j, np.arange(n)]), np.concatenate([j, i, np.arange(n)])
    near = scipy.sparse.csr_array((np.ones(len(rows)), (rows, columns)), (n, n))
    seen = scipy.sparse.csr_array((np.ones(K), (tracks.view_index, tracks.point_index)), (n, tracks.n_points))
    # Ordered pairs of the views of a track, less those without parallax.
    return np.asarray(seen.sum(axis=0) ** 2 > (near @ seen).multiply(seen).sum(axis=0))


def select_tracks(tracks: Tracks, usable: B8, *, points_per_view: int) -> B8:
    """Select the longest ``usable`` tracks (N,), of each cell of a grid over the image in turn."""
    t, length = select_observations(tracks, usable[tracks.point_index]), np.bincount(tracks.point_index)
    longest_first = -length[t.point_index]
    in_cell = _places(observation_cells(t), longest_first)
    keep = np.zeros(tracks.n_points, dtype=bool)
    keep[t.point_index[_places(t.view_index, longest_first, in_cell) < points_per_view]] = True
    return keep


def _places(group: I64, *keys: I64) -> I64:
    """Place (K,) of each row in its ``group`` (K,), sorted by the ``keys`` (K,), the last one first."""
    order = np.lexsort((*keys, group))
    ordered, place = group[order], np.empty(len(group), np.int64)
    place[order] = np.arange(len(order)) - np.searchsorted(ordered, ordered)
    return place


def observation_cells(tracks: Tracks) -> I64:
    """Return the grid cell (K,) of each observation in the extent of its view, consecutive over all views."""
    low, high = np.full((2, tracks.n_views, 2), np.inf)
    np.minimum.at(low, tracks.view_index, tracks.xy)
    np.minimum.at(high, tracks.view_index, -tracks.xy)
    view, extent = tracks.view_index, np.maximum(-high - low, 1e-9)
    cell = np.minimum((tracks.xy - low[view]) / extent[view] * _CELLS, _CELLS - 1).astype(np.int64)
    return np.asarray((view * _CELLS + cell[:, 0]) * _CELLS + cell[:, 1], dtype=np.int64)


def coverage_of_views(cell: I64, chosen: B8, n_views: int) -> F64:
    """Return the coverage (V,) of each view: the sum over its cells of the root of chosen observations."""
    counts = np.bincount(cell[chosen], minlength=n_views * _CELLS**2).reshape(n_views, -1)
    return np.asarray(np.sqrt(counts).sum(axis=1))


def working_tracks(tracks: Tracks, pairs: Sequence[TwoView], *, points_per_view: int) -> tuple[Tracks, B8]:
    """Return the selected tracks with parallax, renumbered in the same order, and which (N,) they are."""
    usable = select_tracks_with_parallax(tracks, pairs)
    keep = select_tracks(tracks, usable, points_per_view=points_per_view)
    t = select_observations(tracks, keep[tracks.point_index])
    number = np.cumsum(keep) - 1
    return replace(t, point_index=number[t.point_index], n_points=int(keep.sum())), keep


def select_observations(t: Tracks, k: B8) -> Tracks:
    """Some of the observations (K,); views and points keep their numbers."""
    return replace(t, view_index=t.view_index[k], point_index=t.point_index[k], xy=t.xy[k])


def expand_to_all_tracks(
    reconstruction: Reconstruction, tracks: Tracks, keep: B8, views: B8 | None = None
) -> Reconstruction:
    """Express the reconstruction of :func:`working_tracks`, all or of ``views``, in the numbers of all."""
    X, valid = np.zeros((tracks.n_points, 4)), np.zeros(tracks.n_points, dtype=bool)
    X[keep], valid[keep] = reconstruction.X, reconstruction.valid
    inlier = np.zeros(len(tracks.xy), dtype=bool)
    chosen = keep[tracks.point_index]
    inlier[chosen if views is None else chosen & views[tracks.view_index]] = reconstruction.inlier
    return replace(reconstruction, X=X, valid=valid, inlier=inlier, tracks=tracks)


LOSS_SIGMAS = 2.0  # residual beyond which the loss of bundle adjustment is linear, in noise sigmas
# Predicted gain of the cameras, relative to the square of that residual, at which an adjustment ends.
SETTLED = 1e-3
_HYPOTHESES = 10  # view pairs tried for a point with a wrong observation: all of them up to five observations
_POINT_ITERATIONS = 4


@kernel
def project_observations(P: F64, X: F64, view: I64, point: I64, xy: F64, chosen: B8) -> tuple[F64, F64]:
    """Return depths (K,), 0 if not chosen, and distances (K,) px, inf if not chosen or in the focal plane."""
    depth, distance = zeros(len(xy)), full(len(xy), np.inf)
    for k in range(len(xy)):
        if not chosen[k]:
            continue
        p, x = P[view[k]], X[point[k]]
        w = p[2, 0] * x[0] + p[2, 1] * x[1] + p[2, 2] * x[2] + p[2, 3] * x[3]
        if w == 0.0:
            continue
        u = (p[0, 0] * x[0] + p[0, 1] * x[1] + p[0, 2] * x[2] + p[0, 3] * x[3]) / w - xy[k, 0]
        v = (p[1, 0] * x[0] + p[1, 1] * x[1] + p[1, 2] * x[2] + p[1, 3] * x[3]) / w - xy[k, 1]
        depth[k] = w
        if np.isfinite(u) and np.isfinite(v):
            distance[k] = np.sqrt(u * u + v * v)
    return depth, distance


@dataclass
class ProjectiveModel:
    """Projective reconstruction in progress.

    ``P`` (V, 3, 4) and ``X`` (N, 4) are zeros if missing, signed so that depths are positive; ``inlier`` (K,)
    are observations that agree with the cameras. ``reasons`` say why a view is not registered; ``deferred``
    (V,) views failed the covariance test, ``rejected`` ones were removed as wrong. ``cell`` (K,) is the grid
    cell of each observation.
    """

    tracks: Tracks
    sizes: I64
    P: F64
    X: F64
    registered: B8
    inlier: B8
    sigma_px: float
    noise_floor_px: float
    reasons: list[str]
    deferred: B8
    rejected: B8
    cell: I64

    @staticmethod
    def empty(tracks: Tracks, sizes: I64, *, sigma_px: float, noise_floor_px: float) -> "ProjectiveModel":
        """Create a model without cameras; ``sizes`` (V, 2) are the image sizes."""
        n = tracks.n_views
        return ProjectiveModel(
            tracks, sizes, np.zeros((n, 3, 4)), np.zeros((tracks.n_points, 4)), np.zeros(n, dtype=bool),
            np.zeros(len(tracks.xy), dtype=bool), max(sigma_px, noise_floor_px), noise_floor_px,
            [""] * n, np.zeros(n, dtype=bool), np.zeros(n, dtype=bool), observation_cells(tracks),
        )  # fmt: skip

    @property
    def used(self) -> B8:
        """(K,) inlier observations of registered views."""
        return self.inlier & self.registered[self.tracks.view_index]

    @property
    def valid(self) -> B8:
        """(N,) points with at least two inlier observations."""
        return np.bincount(self.tracks.point_index[self.used], minlength=self.tracks.n_points) >= 2

    def inlier_ratios(self) -> tuple[I64, F64]:
        """Return the inliers of each view, and their share of its observations of valid points."""
        t, n = self.tracks, self.tracks.n_views
        ready = self.valid[t.point_index]
        counts = np.bincount(t.view_index[ready & self.used], minlength=n)
        return counts, counts / np.maximum(np.bincount(t.view_index[ready], minlength=n), 1)


def retriangulate_points(model: ProjectiveModel, sigmas: float, *, points: B8 | None = None) -> None:
    """Triangulate the ``points`` (N,), or all, from all registered views and update the inliers (6.3)."""
    t = model.tracks
    near = model.registered[t.view_index]
    if points is not None:
        near = near & points[t.point_index]
    _triangulate(model, near)
    update_inliers(model, sigmas)
    has_outlier = np.bincount(t.point_index[near & ~model.inlier], minlength=t.n_points) > 0
    has_outlier &= np.bincount(t.point_index[near], minlength=t.n_points) >= 3
    if has_outlier.any():
        again = near & has_outlier[t.point_index]
        _triangulate(model, again & consistent_observations(model, again, sigmas * model.sigma_px))
        update_inliers(model, sigmas)


def _triangulate(model: ProjectiveModel, chosen: B8) -> None:
    """Triangulate points from the ``chosen`` (K,) observations: linear, then least reprojection error."""
    t = model.tracks
    view, point, xy = t.view_index[chosen], t.point_index[chosen], t.xy[chosen]
    X = triangulate_observations(model.P, view, point, xy, t.n_points)
    X = refine_points(model.P, X, view, point, xy, loss_px=model.sigma_px, iterations=_POINT_ITERATIONS)
    found = np.bincount(point, minlength=t.n_points) >= 2
    model.X = np.where(found[:, None], X, model.X)


def consistent_observations(model: ProjectiveModel, chosen: B8, threshold_px: float) -> B8:
    """Return the observations (K,) of each point that agree with its best two-view triangulation."""
    # A wrong one shifts a least-squares point: least truncated squares select a pair of `chosen` ones.
    t = model.tracks
    k = np.flatnonzero(chosen)
    view, xy, every = t.view_index[k], t.xy[k], np.ones(len(k), dtype=bool)
    number, point = np.unique(t.point_index[k], return_inverse=True)
    counts = np.bincount(point)
    first, place = np.cumsum(counts) - counts, np.tile(np.arange(len(number)), 2)
    best = np.full(len(number), np.inf)
    agree = np.zeros(len(k), dtype=bool)
    for h in range(_HYPOTHESES):
        one = h % counts
        # Up to five observations all pairs are tried; of more, near and far pairs.
        apart = np.where(counts <= 5, h // counts % (counts - 1), h * (counts - 1) // _HYPOTHESES)
        pair = np.concatenate([first + one, first + (one + 1 + apart) % counts])
        X = triangulate_observations(model.P, view[pair], place, xy[pair], len(number))
        distance = project_observations(model.P, X, view, point, xy, every)[1]
        squared = np.minimum(distance / threshold_px, 1.0) ** 2
        cost = np.bincount(point, squared)
        better = cost < best
        best = np.where(better, cost, best)
        agree = np.where(better[point], squared < 1.0, agree)
    marked = np.zeros(len(t.xy), dtype=bool)
    marked[k] = agree
    return marked


def update_inliers(model: ProjectiveModel, sigmas: float) -> None:
    """Orient the points with their cameras and mark inliers: in front and within the threshold (6.5)."""
    t = model.tracks
    chosen = model.registered[t.view_index] & (np.abs(model.X).sum(axis=1) > 0)[t.point_index]
    depth, distance = project_observations(model.P, model.X, t.view_index, t.point_index, t.xy, chosen)
    flip = np.where(np.bincount(t.point_index, np.sign(depth), minlength=t.n_points) < 0, -1.0, 1.0)
    model.X = model.X * flip[:, None]
    model.inlier = (distance < sigmas * model.sigma_px) & (depth * flip[t.point_index] > 0)
    model.inlier &= model.valid[t.point_index]


def adjust_all(model: ProjectiveModel, iterations: int, sigmas: float) -> None:
    """Run bundle adjustment of everything (6.7), estimate the noise and retriangulate."""
    t, used = model.tracks, model.used
    if used.sum() < 2 * 8:
        return
    result = refine_projective_bundle(
        model.P, model.X, Observations(t.view_index[used], t.point_index[used], t.xy[used]),
        loss_px=LOSS_SIGMAS * model.sigma_px, max_iterations=iterations, settled=SETTLED,
    )  # fmt: skip
    # A well-conditioned frame: sum XX' = I over the valid points, unit norms, signs kept.
    frame = whitened_frame(result.X[model.valid])
    P, X = frame.cameras(result.P), frame.points(result.X)
    length, size = np.linalg.norm(X, axis=1, keepdims=True), np.linalg.norm(P, axis=(1, 2), keepdims=True)
    model.P, model.X = P / np.where(size > 0, size, 1.0), X / np.where(length > 0, length, 1.0)
    norm = np.asarray(np.linalg.norm(result.residual_px, axis=1))
    # Residuals of two-view points underestimate the noise: hence the floor.
    model.sigma_px = max(noise_from_distances(norm), model.noise_floor_px)
    retriangulate_points(model, sigmas)


def adjust_locally(
    model: ProjectiveModel, view: int, iterations: int, sigmas: float, *, n_views: int
) -> None:
    """Adjust a view, the ``n_views`` that share most points with it, and their points (6.6)."""
    t, used = model.tracks, model.used
    its = np.bincount(t.point_index[used & (t.view_index == view)], minlength=t.n_points) > 0
    shared = np.bincount(t.view_index[used & its[t.point_index]], minlength=t.n_views)
    free = np.zeros(t.n_views, dtype=bool)
    free[np.argsort(-shared, kind="stable")[: n_views + 1]] = True
    free &= shared > 0
    local = np.bincount(t.point_index[used & free[t.view_index]], minlength=t.n_points) > 0
    chosen = used & local[t.point_index]
    if chosen.sum() < 2 * 8:
        return
    result = refine_projective_bundle(
        model.P, model.X, Observations(t.view_index[chosen], t.point_index[chosen], t.xy[chosen]),
        loss_px=LOSS_SIGMAS * model.sigma_px, max_iterations=iterations, settled=SETTLED,
        fixed_views=~free,
    )  # fmt: skip
    model.P, model.X = result.P, result.X
    retriangulate_points(model, sigmas, points=local)


def to_reconstruction(model: ProjectiveModel, min_points: int) -> Reconstruction:
    """Return the reconstruction record, with a reason for every unregistered view."""
    valid = model.valid
    X = np.where(valid[:, None], model.X, 0.0)
    P = np.where(model.registered[:, None, None], model.P, 0.0)
    found = Reconstruction(
        "projective", P, X, model.registered, valid, model.used & valid[model.tracks.point_index],
        model.tracks, model.sizes, model.sigma_px, tuple(model.reasons),
    )  # fmt: skip
    return with_reasons(found, min_points)
