"""Projective factorization: cameras and points of a complete table of matches at once.

With the right projective depths w the matrix of all w (u, v, 1) has rank 4 (P. Sturm, B. Triggs, ECCV 1996;
HZ 18.4). Fundamental matrices give w, or iterations do (J. Oliensis, R. Hartley, PAMI 29(12), 2007).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import Notice, StageFailure, counted, require_at_least
from thesisrecon.geometry.camera_matrix import orient_signs
from thesisrecon.geometry.homogeneous import homogenize, normalizing_transform
from thesisrecon.geometry.two_view import epipoles, homography_linear, homography_sampson_residuals
from thesisrecon.optimize.least_squares import noise_from_distances
from thesisrecon.projective import _model
from thesisrecon.projective.incremental import IncrementalProjective
from thesisrecon.records import Reconstruction, Tracks, TwoView

_BALANCING_ITERATIONS = 10
_MIN_GAIN_REL = 1e-4  # relative gain of an iteration below which the factors have converged
_MIN_POINTS = 16  # minimum number of complete tracks
_MAX_ROUNDS = 5
_PLANE_SIGMAS = 3.0  # distances from a homography, in noise sigmas, of the points that it explains

Edge = tuple[int, int]


def depths_from_fundamentals(xy: F64, F: Mapping[Edge, F64], tree: Sequence[Edge]) -> F64:
    """Projective depths (V, N) of xy (V, N, 2) from F[i, j], x_j' F x_i = 0, along a tree of edges (i, j).

    w_i F x_i = w_j (e_j x x_j) in least squares (Sturm and Triggs, eq. 3), from 1 in the first view on.
    """
    x = homogenize(xy)
    depths = np.ones(xy.shape[:2])
    for i, j in tree:
        e_cross_x = np.cross(epipoles(F[i, j])[1], x[j])
        squared = np.maximum(np.sum(e_cross_x**2, axis=1), 1e-300)
        depths[j] = depths[i] * np.sum(e_cross_x * (x[i] @ F[i, j].T), axis=1) / squared
    return depths


def _balance_depths(depths: F64, sizes: F64) -> F64:
    """Depths (V, N) scaled by views and points to equal weights; ``sizes`` (V, N) are of their vectors."""
    views, points = depths.shape
    squared = (depths * sizes) ** 2
    a, b = np.ones(views), np.ones(points)
    for _ in range(_BALANCING_ITERATIONS):
        b = np.sqrt(views / np.maximum(a**2 @ squared, 1e-300))
        a = np.sqrt(points / np.maximum(squared @ b**2, 1e-300))
    return np.asarray(depths * a[:, None] * b)


def factorize(xy: F64, depths: F64 | None = None, *, iterations: int = 0) -> tuple[F64, F64, F64]:
    """Factorize N >= 8 matches xy (V, N, 2) into cameras, unit points and reprojection distances (V, N).

    Initial depths are equal by default, as for affine cameras. At most ``iterations`` updates, 0 as
    published, end when the rank-4 residual of the balanced matrix, which approximates the reprojection error,
    no longer falls.
    """
    depths = np.ones(xy.shape[:2]) if depths is None else depths
    T = np.stack([normalizing_transform(view) for view in xy])
    x = np.einsum("vab,vnb->vna", T, homogenize(xy))
    sizes = np.linalg.norm(x, axis=2)
    least, best = np.inf, depths
    for _ in range(iterations + 1):
        depths = _balance_depths(depths, sizes)
        fitted, residual = _rank_four(depths[:, :, None] * x)
        if residual < least:
            best = depths
        if not residual < least * (1.0 - _MIN_GAIN_REL):
            break
        least = residual
        depths = np.einsum("vna,vna->vn", fitted, x) / sizes**2
    U, s, Vt = np.linalg.svd(_measurements(best[:, :, None] * x), full_matrices=False)
    # Whitens the points approximately.
    P, X = np.linalg.solve(T, U[:, :4].reshape(-1, 3, 4)), Vt[:4].T * s[:4]
    lengths = np.linalg.norm(X, axis=1, keepdims=True)
    X = X / np.where(lengths > 0.0, lengths, 1.0)
    xh = np.einsum("vab,nb->vna", P, X)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.linalg.norm(xh[..., :2] / xh[..., 2:] - xy, axis=2)
    return P, X, np.nan_to_num(distance, nan=np.inf)


def _measurements(wx: F64) -> F64:
    """Return (3 V, N) from (V, N, 3)."""
    return np.asarray(wx.swapaxes(1, 2).reshape(-1, wx.shape[1]))


def _rank_four(wx: F64) -> tuple[F64, float]:
    """Return the nearest matrix of rank 4 as (V, N, 3), and its squared distance."""
    W = _measurements(wx)
    basis = np.linalg.eigh(W @ W.T)[1][:, -4:]
    fitted = basis @ (basis.T @ W)
    residual = float(np.sum((W - fitted) ** 2))
    return fitted.reshape(len(wx), 3, -1).swapaxes(1, 2), residual


@dataclass(frozen=True)
class Factorization:
    """Projective factorization of a core of views; the others are added by resection (6.2).

    Parameters
    ----------
    iterations, growth : int, IncrementalProjective
        Maximum number of depth updates, 0 for the published algorithm of Sturm and Triggs; and the method
        that adds the other views.
    """

    iterations: int = 50
    growth: IncrementalProjective = field(default_factory=IncrementalProjective)

    core_points = 100  # minimum number of tracks seen in all views of the core

    def __post_init__(self) -> None:
        require_at_least(self, iterations=0)

    def reconstruct(
        self, tracks: Tracks, pairs: Sequence[TwoView], sizes: I64, *, rng: Generator, attempt: int = 0
    ) -> Reconstruction:
        """See `thesisrecon.config.ProjectiveReconstructor.reconstruct`."""
        ranked = _model.rank_initial_pairs(tracks, pairs)
        _model.require_pair_with_parallax(pairs)
        if attempt >= len(ranked):
            raise StageFailure.of("no-pair-for-factorization", len(ranked), counted(len(pairs), "image pair"))
        selected, keep = _model.working_tracks(tracks, pairs, points_per_view=self.growth.points_per_view)
        model = self._core(selected, pairs, ranked[attempt], sizes)
        self.growth.complete(model, pairs, rng)
        return _model.expand_to_all_tracks(
            _model.to_reconstruction(model, self.growth.min_points), tracks, keep
        )

    def _core(
        self, tracks: Tracks, pairs: Sequence[TwoView], start: TwoView, sizes: I64
    ) -> _model.ProjectiveModel:
        """Reconstruct the core that grows from ``start`` by factorization and adjust it."""
        xy = np.full((tracks.n_views, tracks.n_points, 2), np.nan)
        xy[tracks.view_index, tracks.point_index] = tracks.xy
        F = {(p.i, p.j): p.F for p in pairs} | {(p.j, p.i): p.F.T for p in pairs}
        tree = _grow_core(np.isfinite(xy[:, :, 0]), pairs, start, min_tracks=self.core_points)
        sigma_px = max(start.sigma_px, self.growth.noise_floor_px)
        table, edges = _complete_tracks(xy, tree)
        while len(tree) > 1 and _is_planar(table, edges, _PLANE_SIGMAS * sigma_px):
            # Fewer views have more common points.
            tree = tree[:-1]
            table, edges = _complete_tracks(xy, tree)
        if table.shape[1] < _MIN_POINTS:
            few = f"{table.shape[1]} tracks, at least {_MIN_POINTS} are needed"
            raise StageFailure(Notice("few-common-tracks"), few)
        depths = depths_from_fundamentals(table, {e: F[v] for e, v in zip(edges, tree, strict=True)}, edges)
        growth, early, views = self.growth, self.growth.outlier_sigmas[0], _tree_views(tree)
        P, X, residual_px = _factorize_robustly(table, depths, growth.outlier_sigmas[1], self.iterations)
        model = _model.ProjectiveModel.empty(
            tracks, sizes, sigma_px=sigma_px, noise_floor_px=growth.noise_floor_px
        )
        # Before bundle adjustment the residuals are those of the factors.
        model.sigma_px = max(model.sigma_px, noise_from_distances(residual_px.ravel()))
        every = np.indices(residual_px.shape).reshape(2, -1)
        signs, _, _ = orient_signs(P, X, every[0], every[1])
        model.P[views] = P * signs[:, None, None]
        model.registered[views] = True
        for _ in range(2):
            _model.retriangulate_points(model, early)
            _model.adjust_all(model, 2 * growth.bundle_iterations, early)
        return model


def _tree_views(tree: Sequence[Edge]) -> list[int]:
    return [tree[0][0], *(j for _, j in tree)]


def _grow_core(seen: B8, pairs: Sequence[TwoView], start: TwoView, *, min_tracks: int) -> list[Edge]:
    """The tree (i, j) of views that share ``min_tracks``, by most common tracks, then non-planar matches."""
    tree, views = [(start.i, start.j)], {start.i, start.j}
    weight: dict[Edge, float] = {}
    for p in pairs:
        if p.accepted and not p.undetermined:
            weight[p.i, p.j] = weight[p.j, p.i] = p.inliers * (1.0 - p.homography_inlier_ratio)
    common = seen[start.i] & seen[start.j]
    while True:
        edges = [(i, j) for i, j in weight if i in views and j not in views]
        counts = {j: int((common & seen[j]).sum()) for _, j in edges}
        view = max(counts, key=lambda j: (counts[j], -j), default=-1)
        if view < 0 or counts[view] < min_tracks:
            return tree
        tree.append(max((e for e in edges if e[1] == view), key=lambda e: (weight[e], -e[0])))
        views.add(view)
        common &= seen[view]


def _complete_tracks(xy: F64, tree: Sequence[Edge]) -> tuple[F64, list[Edge]]:
    """Return the tracks (V', N', 2) that all views of the tree see, and its edges renumbered."""
    views = _tree_views(tree)
    table = xy[views]
    place = {view: k for k, view in enumerate(views)}
    return table[:, np.isfinite(table).all(axis=(0, 2))], [(place[i], place[j]) for i, j in tree]


def _is_planar(xy: F64, edges: Sequence[Edge], threshold_px: float) -> bool:
    """Whether a homography explains nearly all points (V, N, 2) in every pair: rank 4 would fit noise."""
    if xy.shape[1] < _MIN_POINTS:
        return False
    shares = []
    for i, j in edges:
        within = np.ones(xy.shape[1], dtype=bool)
        for _ in range(3):
            H = homography_linear(xy[i, within], xy[j, within])
            distance = np.linalg.norm(homography_sampson_residuals(H, xy[i], xy[j]), axis=1)
            within = distance <= max(threshold_px, 2.0 * float(np.median(distance)))
        shares.append(np.mean(distance <= threshold_px))
    return bool(min(shares) >= _model.NO_PARALLAX)


def _factorize_robustly(xy: F64, depths: F64, sigmas: float, iterations: int) -> tuple[F64, F64, F64]:
    """Factorize, remove points with residuals beyond ``sigmas`` times the noise, factorize the rest again."""
    kept = np.ones(xy.shape[1], dtype=bool)
    for _ in range(_MAX_ROUNDS):
        P, X, residual_px = factorize(xy[:, kept], depths[:, kept], iterations=iterations)
        within = residual_px.max(axis=0) <= sigmas * noise_from_distances(residual_px.ravel())
        if within.all() or within.sum() < _MIN_POINTS:
            break
        kept[np.flatnonzero(kept)[~within]] = False
    return P, X, residual_px
