"""Sections 6.3 to 6.7 on a reconstruction that grows: its points, its outliers, its adjustment."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thesisrecon.geometry.triangulation import triangulate_observations
from thesisrecon.optimize.conditioning import whitening_transform
from thesisrecon.optimize.projective_bundle import refine_projective_bundle
from thesisrecon.optimize.triangulation_refine import refine_points
from thesisrecon.projective.kernels import project_observations
from thesisrecon.projective.selection import grid_cells
from thesisrecon.robust.noise import noise_from_distances
from thesisrecon.types import B8, I64, Reconstruction, Tracks

F64 = NDArray[np.float64]

# The bundle's loss turns from squares to distances here, in noise sigmas.
LOSS_SIGMAS = 2.0
# Pairs of views tried for a point one of whose observations is wrong: all of them up to five observations.
HYPOTHESES = 10
POINT_ITERATIONS = 4


@dataclass
class GrowingModel:
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
    ok: B8
    sigma_px: float
    noise_floor_px: float
    reasons: list[str] = field(default_factory=list)
    postponed: B8 = field(default_factory=lambda: np.zeros(0, dtype=bool))
    barred: B8 = field(default_factory=lambda: np.zeros(0, dtype=bool))
    cell: I64 = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @staticmethod
    def empty(tracks: Tracks, sizes: I64, *, sigma_px: float, noise_floor_px: float) -> GrowingModel:
        """A model without cameras."""
        n = tracks.n_views
        return GrowingModel(
            tracks, sizes, np.zeros((n, 3, 4)), np.zeros((tracks.n_points, 4)), np.zeros(n, dtype=bool),
            np.zeros(len(tracks.xy), dtype=bool), max(sigma_px, noise_floor_px), noise_floor_px,
            [""] * n, np.zeros(n, dtype=bool), np.zeros(n, dtype=bool), grid_cells(tracks),
        )  # fmt: skip

    @property
    def used(self) -> B8:
        """(K,) observations of registered views that are explained."""
        return self.ok & self.registered[self.tracks.view_index]

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


def retriangulate(model: GrowingModel, sigmas: float, *, points: B8 | None = None) -> None:
    """Points afresh from all observations in registered views (all, or those of ``points`` (N,) bool), then
    the gate of ``sigmas`` noise sigmas; a point with a wrong observation once more from those that agree.
    """
    t = model.tracks
    near = model.registered[t.view_index]
    if points is not None:
        near = near & points[t.point_index]
    _triangulate(model, near)
    mark(model, sigmas)
    spoiled = np.bincount(t.point_index[near & ~model.ok], minlength=t.n_points) > 0
    spoiled &= np.bincount(t.point_index[near], minlength=t.n_points) >= 3
    if spoiled.any():
        again = near & spoiled[t.point_index]
        _triangulate(model, again & agreeing_observations(model, again, sigmas * model.sigma_px))
        mark(model, sigmas)


def _triangulate(model: GrowingModel, chosen: B8) -> None:
    """Linear, then least reprojection, of the points with two of the ``chosen`` (K,) observations."""
    t = model.tracks
    view, point, xy = t.view_index[chosen], t.point_index[chosen], t.xy[chosen]
    X = triangulate_observations(model.P, view, point, xy, t.n_points)
    X = refine_points(model.P, X, view, point, xy, loss_px=model.sigma_px, iterations=POINT_ITERATIONS)
    found = np.bincount(point, minlength=t.n_points) >= 2
    model.X = np.where(found[:, None], X, model.X)


def agreeing_observations(model: GrowingModel, chosen: B8, gate_px: float) -> B8:
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


def mark(model: GrowingModel, sigmas: float) -> None:
    """Signs of the points made those of their cameras, then ``ok`` = in front and within the gate (6.5)."""
    t = model.tracks
    chosen = model.registered[t.view_index] & (np.abs(model.X).sum(axis=1) > 0)[t.point_index]
    depth, distance = project_observations(model.P, model.X, t.view_index, t.point_index, t.xy, chosen)
    flip = np.where(np.bincount(t.point_index, np.sign(depth), minlength=t.n_points) < 0, -1.0, 1.0)
    model.X = model.X * flip[:, None]
    model.ok = (distance < sigmas * model.sigma_px) & (depth * flip[t.point_index] > 0)
    model.ok &= model.valid[t.point_index]


def adjust(model: GrowingModel, iterations: int, sigmas: float) -> None:
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
    retriangulate(model, sigmas)


def adjust_around(model: GrowingModel, view: int, iterations: int, sigmas: float, *, neighbours: int) -> None:
    """Bundle adjustment of one view, the ``neighbours`` that share most points with it, and their points.

    The other cameras that see these points are held and hold the frame.
    """
    t, used = model.tracks, model.used
    its = np.zeros(t.n_points, dtype=bool)
    its[t.point_index[used & (t.view_index == view)]] = True
    shared = np.bincount(t.view_index[used & its[t.point_index]], minlength=t.n_views)
    free = np.zeros(t.n_views, dtype=bool)
    free[np.argsort(-shared, kind="stable")[: neighbours + 1]] = True
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
    retriangulate(model, sigmas, points=local)


def _whitened(P: F64, X: F64, model: GrowingModel) -> tuple[F64, F64]:
    """Keep the frame well-conditioned: sum XX' = I over the valid points, unit norms, signs kept."""
    T = whitening_transform(X[model.valid])
    X = X @ T.T
    P = P @ np.linalg.inv(T)
    length = np.linalg.norm(X, axis=1, keepdims=True)
    norm = np.linalg.norm(P, axis=(1, 2), keepdims=True)
    return P / np.where(norm > 0, norm, 1.0), X / np.where(length > 0, length, 1.0)


def finish(model: GrowingModel) -> Reconstruction:
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
