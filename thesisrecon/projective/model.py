"""What is asked of all observations after every camera.

Which tracks take part while the cameras are found: long ones, spread over every view.

Sections 6.3 to 6.7 on a reconstruction that grows: its points, its outliers, its adjustment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.geometry.homogeneous import whitening_transform
from thesisrecon.geometry.triangulation import triangulate_observations
from thesisrecon.numerics.noise import noise_from_distances
from thesisrecon.numerics.partial_bundle import refine_points
from thesisrecon.numerics.projective_bundle import refine_projective_bundle
from thesisrecon.projective.initial_pair import NO_PARALLAX
from thesisrecon.records import Reconstruction, Tracks, TwoView


@njit(cache=True, nogil=True)
def project_observations(P: F64, X: F64, view: I64, point: I64, xy: F64, chosen: B8) -> tuple[F64, F64]:
    """Of the ``chosen`` (K,) observations the depth w and the distance px of (u, v) / w from ``xy`` (K, 2).

    (u, v, w) = P (V, 3, 4) of the view times X (N, 4) of the point. Of others, and in the focal plane, the
    depth is 0 and the distance infinite.
    """
    depth, distance = np.zeros(len(xy)), np.full(len(xy), np.inf)
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


CELLS = 8
"""Of the grid over a view, along each side."""


def select_tracks_with_parallax(tracks: Tracks, pairs: Sequence[TwoView], *, most: float = NO_PARALLAX) -> B8:
    """Tracks that are not seen from one standpoint only; -> (n_points,) bool.

    Two views whose matches one homography explains to the share ``most`` show a point without parallax, or on
    one plane: it may lie anywhere along its ray, and a crowd of such points bends the frame in which cameras
    are judged. They come back in the metric stage where a ray of another view fixes them.
    """
    apart = np.ones((tracks.n_views, tracks.n_views), dtype=np.float32)
    np.fill_diagonal(apart, 0.0)
    for pair in pairs:
        if pair.accepted and pair.homography_inlier_ratio >= most:
            apart[pair.i, pair.j] = apart[pair.j, pair.i] = 0.0
    seen = np.zeros((tracks.n_views, tracks.n_points), dtype=np.float32)
    seen[tracks.view_index, tracks.point_index] = 1.0
    return np.asarray(((apart @ seen) * seen).any(axis=0))


def select_tracks(tracks: Tracks, usable: B8, *, points_per_view: int, cells: int = CELLS) -> B8:
    """The longest ``usable`` tracks, until each view has about ``points_per_view``; -> (n_points,) bool.

    Every view's points are spread over a grid of ``cells`` x ``cells`` of its own extent: within a cell the
    longest tracks come first, and all cells get their turn before a cell gets its next, so that detail in a
    corner of the picture is not starved by a textured middle.
    """
    length = np.bincount(tracks.point_index, minlength=tracks.n_points)
    keep = np.zeros(tracks.n_points, dtype=bool)
    for view in range(tracks.n_views):
        k = np.flatnonzero((tracks.view_index == view) & usable[tracks.point_index])
        keep[tracks.point_index[k][_first_in_turn(tracks, k, length, cells)[:points_per_view]]] = True
    return keep


def _first_in_turn(tracks: Tracks, k: I64, length: I64, cells: int) -> I64:
    if len(k) == 0:
        return k
    xy = tracks.xy[k]
    low, high = xy.min(axis=0), xy.max(axis=0)
    cell = np.minimum((xy - low) / np.maximum(high - low, 1e-9) * cells, cells - 1).astype(np.int64)
    cell_number = cell[:, 0] * cells + cell[:, 1]
    by_length = np.lexsort((k, -length[tracks.point_index[k]], cell_number))
    sorted_cells = cell_number[by_length]
    start = np.searchsorted(sorted_cells, sorted_cells)
    turn = np.arange(len(k)) - start
    return by_length[np.lexsort((by_length, -length[tracks.point_index[k]][by_length], turn))]


def observation_cells(tracks: Tracks, *, cells: int = CELLS) -> I64:
    """(K,) the cell of each observation in a grid of ``cells`` x ``cells`` of its view's extent, the cells of
    all views counted through."""
    low, high = np.full((2, tracks.n_views, 2), np.inf)
    np.minimum.at(low, tracks.view_index, tracks.xy)
    np.minimum.at(high, tracks.view_index, -tracks.xy)
    view, extent = tracks.view_index, np.maximum(-high - low, 1e-9)
    cell = np.minimum((tracks.xy - low[view]) / extent[view] * cells, cells - 1).astype(np.int64)
    return np.asarray((view * cells + cell[:, 0]) * cells + cell[:, 1], dtype=np.int64)


def coverage_of_views(cell: I64, chosen: B8, n_views: int, *, cells: int = CELLS) -> F64:
    """How much of each view its ``chosen`` (K,) observations hold, from :func:`observation_cells`; -> (V,).

    The sum over the grid of the root of their number in the cell: many points count, and points all over the
    picture count more than a crowd in a corner.
    """
    counts = np.bincount(cell[chosen], minlength=n_views * cells * cells).reshape(n_views, -1)
    return np.asarray(np.sqrt(counts).sum(axis=1))


def subset_tracks(tracks: Tracks, keep: B8) -> Tracks:
    """The tracks marked in ``keep`` (n_points,) bool, numbered anew in the same order."""
    chosen = keep[tracks.point_index]
    number = np.cumsum(keep) - 1
    return Tracks(
        tracks.view_index[chosen],
        number[tracks.point_index[chosen]],
        tracks.xy[chosen],
        tracks.n_views,
        int(keep.sum()),
    )


def expand_to_all_tracks(reconstruction: Reconstruction, tracks: Tracks, keep: B8) -> Reconstruction:
    """A reconstruction of the tracks marked in ``keep``, told in the numbers of all ``tracks``."""
    X = np.zeros((tracks.n_points, 4))
    X[keep] = reconstruction.X
    valid = np.zeros(tracks.n_points, dtype=bool)
    valid[keep] = reconstruction.valid
    inlier = np.zeros(len(tracks.xy), dtype=bool)
    inlier[keep[tracks.point_index]] = reconstruction.inlier
    return replace(reconstruction, X=X, valid=valid, inlier=inlier, tracks=tracks)


# The bundle's loss turns from squares to distances here, in noise sigmas.
LOSS_SIGMAS = 2.0
# Pairs of views tried for a point one of whose observations is wrong: all of them up to five observations.
HYPOTHESES = 10
POINT_ITERATIONS = 4


@dataclass
class ProjectiveModel:
    """The reconstruction while it grows.

    ``P`` (V, 3, 4) and ``X`` (N, 4), zeros where there is none yet, their signs such that depths are
    positive; ``ok`` (K,) marks the observations that the current cameras explain. ``reasons`` says of each
    view why it waits; the gate ``postponed`` it, or it was in the model, proved wrong, and is ``barred``.
    ``cell`` (K,) is the observation's cell in a grid of its view.
    """

    tracks: Tracks
    sizes: I64
    P: F64
    X: F64
    registered: B8
    inlier: B8
    sigma_px: float
    noise_floor_px: float
    reasons: list[str] = field(default_factory=list)
    deferred: B8 = field(default_factory=lambda: np.zeros(0, dtype=bool))
    rejected: B8 = field(default_factory=lambda: np.zeros(0, dtype=bool))
    cell: I64 = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @staticmethod
    def empty(tracks: Tracks, sizes: I64, *, sigma_px: float, noise_floor_px: float) -> ProjectiveModel:
        """A model without cameras."""
        n = tracks.n_views
        return ProjectiveModel(
            tracks, sizes, np.zeros((n, 3, 4)), np.zeros((tracks.n_points, 4)), np.zeros(n, dtype=bool),
            np.zeros(len(tracks.xy), dtype=bool), max(sigma_px, noise_floor_px), noise_floor_px,
            [""] * n, np.zeros(n, dtype=bool), np.zeros(n, dtype=bool), observation_cells(tracks),
        )  # fmt: skip

    @property
    def used(self) -> B8:
        """(K,) observations of registered views that are explained."""
        return self.inlier & self.registered[self.tracks.view_index]

    @property
    def valid(self) -> B8:
        """(N,) points with at least two explained observations."""
        return np.bincount(self.tracks.point_index[self.used], minlength=self.tracks.n_points) >= 2

    def explained(self) -> tuple[I64, F64]:
        """Per view the explained observations, and their share of its observations of valid points."""
        t, n = self.tracks, self.tracks.n_views
        ready = self.valid[t.point_index]
        counts = np.bincount(t.view_index[ready & self.used], minlength=n)
        return counts, counts / np.maximum(np.bincount(t.view_index[ready], minlength=n), 1)


def retriangulate_points(model: ProjectiveModel, sigmas: float, *, points: B8 | None = None) -> None:
    """Points afresh from all observations in registered views (all, or those of ``points`` (N,) bool), then
    the gate of ``sigmas`` noise sigmas; a point with a wrong observation once more from those that agree.
    """
    t = model.tracks
    near = model.registered[t.view_index]
    if points is not None:
        near = near & points[t.point_index]
    _triangulate(model, near)
    update_inliers(model, sigmas)
    spoiled = np.bincount(t.point_index[near & ~model.inlier], minlength=t.n_points) > 0
    spoiled &= np.bincount(t.point_index[near], minlength=t.n_points) >= 3
    if spoiled.any():
        again = near & spoiled[t.point_index]
        _triangulate(model, again & consistent_observations(model, again, sigmas * model.sigma_px))
        update_inliers(model, sigmas)


def _triangulate(model: ProjectiveModel, chosen: B8) -> None:
    """Linear, then least reprojection, of the points with two of the ``chosen`` (K,) observations."""
    t = model.tracks
    view, point, xy = t.view_index[chosen], t.point_index[chosen], t.xy[chosen]
    X = triangulate_observations(model.P, view, point, xy, t.n_points)
    X = refine_points(model.P, X, view, point, xy, loss_px=model.sigma_px, iterations=POINT_ITERATIONS)
    found = np.bincount(point, minlength=t.n_points) >= 2
    model.X = np.where(found[:, None], X, model.X)


def consistent_observations(model: ProjectiveModel, chosen: B8, gate_px: float) -> B8:
    """Of the ``chosen`` (K,) observations those that agree with the best of ``HYPOTHESES`` two-view points.

    A wrong observation spoils a least-squares point, sometimes so far that its right ones look wrong: each
    point is triangulated from pairs of its observations, and the pair that most others agree with (truncated
    squares) tells which are right.
    """
    t = model.tracks
    k = np.flatnonzero(chosen)
    view, xy, P = t.view_index[k], t.xy[k], model.P[t.view_index[k]]
    number, point = np.unique(t.point_index[k], return_inverse=True)
    counts = np.bincount(point)
    first, place = np.cumsum(counts) - counts, np.tile(np.arange(len(number)), 2)
    best = np.full(len(number), np.inf)
    agree = np.zeros(len(k), dtype=bool)
    for h in range(HYPOTHESES):
        one = h % counts
        # Up to five observations every pair has its turn; of more, pairs near and far.
        apart = np.where(counts <= 5, h // counts % (counts - 1), h * (counts - 1) // HYPOTHESES)
        pair = np.concatenate([first + one, first + (one + 1 + apart) % counts])
        X = triangulate_observations(model.P, view[pair], place, xy[pair], len(number))
        squared = np.minimum(_residuals(P, X[point], xy) / gate_px, 1.0) ** 2
        cost = np.bincount(point, squared)
        better = cost < best
        best = np.where(better, cost, best)
        agree = np.where(better[point], squared < 1.0, agree)
    marked = np.zeros(len(t.xy), dtype=bool)
    marked[k] = agree
    return marked


def _residuals(P: F64, X: F64, xy: F64) -> F64:
    """Distances (K,) px of the images of X (K, 4) by P (K, 3, 4) from xy; infinite in the focal plane."""
    xh = np.einsum("kab,kb->ka", P, X)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        distance = np.linalg.norm(xh[:, :2] / xh[:, 2:] - xy, axis=1)
    return np.asarray(np.nan_to_num(distance, nan=np.inf))


def update_inliers(model: ProjectiveModel, sigmas: float) -> None:
    """Signs of the points made those of their cameras, then ``ok`` = in front and within the gate (6.5)."""
    t = model.tracks
    chosen = model.registered[t.view_index] & (np.abs(model.X).sum(axis=1) > 0)[t.point_index]
    depth, distance = project_observations(model.P, model.X, t.view_index, t.point_index, t.xy, chosen)
    flip = np.where(np.bincount(t.point_index, np.sign(depth), minlength=t.n_points) < 0, -1.0, 1.0)
    model.X = model.X * flip[:, None]
    model.inlier = (distance < sigmas * model.sigma_px) & (depth * flip[t.point_index] > 0)
    model.inlier &= model.valid[t.point_index]


def adjust_all(model: ProjectiveModel, iterations: int, sigmas: float) -> None:
    """Bundle adjustment of everything (6.7), the noise estimated afresh, all points anew under the gate."""
    t, used = model.tracks, model.used
    if used.sum() < 2 * 8:
        return
    result = refine_projective_bundle(
        model.P, model.X, t.view_index[used], t.point_index[used], t.xy[used],
        loss_px=LOSS_SIGMAS * model.sigma_px, max_iterations=iterations,
    )  # fmt: skip
    model.P, model.X = _whitened(result.P, result.X, model)
    norm = np.asarray(np.linalg.norm(result.residual_px, axis=1))
    # Two-view points carry less residual than noise: hence the floor.
    model.sigma_px = max(noise_from_distances(norm), model.noise_floor_px)
    retriangulate_points(model, sigmas)


def adjust_locally(
    model: ProjectiveModel, view: int, iterations: int, sigmas: float, *, local_bundle_views: int
) -> None:
    """Bundle adjustment of one view, the ``neighbours`` that share most points with it, and their points.

    The other cameras that see these points are held and hold the frame.
    """
    t, used = model.tracks, model.used
    its = np.zeros(t.n_points, dtype=bool)
    its[t.point_index[used & (t.view_index == view)]] = True
    shared = np.bincount(t.view_index[used & its[t.point_index]], minlength=t.n_views)
    free = np.zeros(t.n_views, dtype=bool)
    free[np.argsort(-shared, kind="stable")[: local_bundle_views + 1]] = True
    free &= shared > 0
    local = np.zeros(t.n_points, dtype=bool)
    local[t.point_index[used & free[t.view_index]]] = True
    chosen = used & local[t.point_index]
    if chosen.sum() < 2 * 8:
        return
    result = refine_projective_bundle(
        model.P, model.X, t.view_index[chosen], t.point_index[chosen], t.xy[chosen],
        loss_px=LOSS_SIGMAS * model.sigma_px, max_iterations=iterations, fixed_views=~free,
    )  # fmt: skip
    model.P, model.X = result.P, result.X
    retriangulate_points(model, sigmas, points=local)


def _whitened(P: F64, X: F64, model: ProjectiveModel) -> tuple[F64, F64]:
    """Keep the frame well-conditioned: sum XX' = I over the valid points, unit norms, signs kept."""
    T = whitening_transform(X[model.valid])
    X = X @ T.T
    P = P @ np.linalg.inv(T)
    length = np.linalg.norm(X, axis=1, keepdims=True)
    norm = np.linalg.norm(P, axis=(1, 2), keepdims=True)
    return P / np.where(norm > 0, norm, 1.0), X / np.where(length > 0, length, 1.0)


def to_reconstruction(model: ProjectiveModel) -> Reconstruction:
    """The record of a grown model, with a reason for every view that is not in it."""
    for view in np.flatnonzero(~model.registered):
        if not model.reasons[view]:
            model.reasons[view] = "shares no points with the model"
    valid = model.valid
    X = np.where(valid[:, None], model.X, 0.0)
    P = np.where(model.registered[:, None, None], model.P, 0.0)
    return Reconstruction(
        "projective", P, X, model.registered, valid, model.used & valid[model.tracks.point_index],
        model.tracks, model.sizes, model.sigma_px, tuple(model.reasons),
    )  # fmt: skip
