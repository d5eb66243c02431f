"""Projective factorisation: all cameras and points of a complete table of matches at once.

Sturm and Triggs, "A factorization based algorithm for multi-image projective structure and motion", ECCV
1996: with the right projective depths w the matrix of all w (u, v, 1) has rank 4, and its factors are the
cameras and the points. Fundamental matrices give the depths; or one begins anywhere and takes them from the
factors, over and over (Triggs, CVPR 1996; Oliensis and Hartley, PAMI 29(12), 2007, on when that converges).

Chapter 6 by factorisation: a core of views at once, then the others one by one.

The incremental way trusts one pair of views to begin with. Here many views that see the same points begin
together (:mod:`thesisrecon.projective.factorization`); only what none of them tells depends on an order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.camera_matrix import orient_signs
from thesisrecon.geometry.homogeneous import homogenize, normalizing_transform, require_finite
from thesisrecon.geometry.two_view import epipoles, estimate_homography, homography_sampson_residuals
from thesisrecon.numerics.noise import noise_from_distances
from thesisrecon.projective.incremental import IncrementalProjective
from thesisrecon.projective.initial_pair import NO_PARALLAX, rank_initial_pairs, require_pair_with_parallax
from thesisrecon.projective.model import (
    ProjectiveModel,
    adjust_all,
    expand_to_all_tracks,
    retriangulate_points,
    select_tracks,
    select_tracks_with_parallax,
    subset_tracks,
    to_reconstruction,
)
from thesisrecon.records import Reconstruction, Tracks, TwoView

_BALANCING = 10
_AT_REST = 1e-4
"""Relative gain of an iteration below which the factors rest."""


@dataclass(frozen=True)
class Factors:
    """Cameras ``P`` (V, 3, 4) for pixels and points ``X`` (N, 4) of unit norm, found with the balance_depths
    ``depths`` (V, N); ``residual_px`` (V, N) distances of the projections from the matches.

    ``gap`` is the fifth singular value over the fourth: 0 for exact matches and right depths.
    """

    P: F64
    X: F64
    depths: F64
    residual_px: F64
    gap: float
    iterations: int

    @property
    def rms_px(self) -> float:
        """Root of the mean squared residual."""
        return float(np.sqrt(np.mean(self.residual_px**2)))


def depths_from_fundamentals(
    xy: F64, F: Mapping[tuple[int, int], F64], tree: Sequence[tuple[int, int]]
) -> F64:
    """Projective depths (V, N) of matches xy (V, N, 2) px from fundamental matrices along a ``tree``.

    Of an edge (i, j), i reached before j: w_i F x_i = w_j (e_j x x_j) in every point, whose least-squares
    solution is w_j = w_i (e_j x x_j) . (F x_i) / |e_j x x_j|^2 (Sturm and Triggs, eq. 3). ``F[i, j]`` (3, 3)
    has x_j' F x_i = 0; its scale and sign are those of a whole view. The first view of the tree has depth 1.
    Points near an epipole get bad depths. Raises ``ValueError`` for a tree that does not reach every view,
    each once, from its first.
    """
    x = homogenize(xy)
    depths = np.full(xy.shape[:2], np.nan)
    depths[tree[0][0] if tree else 0] = 1.0
    for i, j in tree:
        if np.isnan(depths[i]).any() or not np.isnan(depths[j]).all():
            raise ValueError(f"depths_from_fundamentals needs a tree that grows from view {tree[0][0]}")
        turned = np.cross(epipoles(F[i, j])[1], x[j])
        squared = np.maximum(np.sum(turned**2, axis=1), 1e-300)
        depths[j] = depths[i] * np.sum(turned * (x[i] @ F[i, j].T), axis=1) / squared
    if np.isnan(depths).any():
        raise ValueError("depths_from_fundamentals needs a tree that reaches every view")
    return depths


def balance_depths(depths: F64, sizes: F64) -> F64:
    """Depths (V, N) rescaled by views and by points until every view and every point weighs the same.

    ``sizes`` (V, N) are the norms of the vectors that the depths multiply. Scales of views are those of
    cameras, scales of points those of points, so nothing is changed but the weights of the residuals.
    """
    views, points = depths.shape
    squared = (depths * sizes) ** 2
    a, b = np.ones(views), np.ones(points)
    for _ in range(_BALANCING):
        b = np.sqrt(views / np.maximum(a**2 @ squared, 1e-300))
        a = np.sqrt(points / np.maximum(squared @ b**2, 1e-300))
    return np.asarray(depths * a[:, None] * b)


def factorize(xy: F64, depths: F64 | None = None, *, iterations: int = 0) -> Factors:
    """Cameras and points of matches seen in every view, xy (V, N, 2) px, by a rank-4 factorisation.

    Parameters
    ----------
    depths : (V, N) projective depths to begin with (:func:`depths_from_fundamentals`); all equal where None,
        which is the affine camera and needs ``iterations``.
    iterations : most times that the depths are taken anew from the factors; 0 is Sturm and Triggs' own
        algorithm. It ends when the rank-4 residual of the balance_depths matrix, an approximation of the
        reprojection error, falls no more.

    Raises ``ValueError`` for fewer than two views or eight points, other shapes, and values that are not
    finite. All pixels of a view may not be equal.
    """
    if xy.ndim != 3 or xy.shape[2] != 2 or xy.shape[0] < 2 or xy.shape[1] < 8:
        raise ValueError(f"factorize needs xy (V >= 2, N >= 8, 2); got {xy.shape}")
    depths = np.ones(xy.shape[:2]) if depths is None else depths
    if depths.shape != xy.shape[:2]:
        raise ValueError(f"factorize needs depths {xy.shape[:2]}; got {depths.shape}")
    require_finite("factorize", xy, depths)
    T = np.stack([normalizing_transform(view) for view in xy])
    x = np.einsum("vab,vnb->vna", T, homogenize(xy))
    sizes = np.linalg.norm(x, axis=2)
    least, best, done = np.inf, depths, -1
    while done < iterations:
        done += 1
        depths = balance_depths(depths, sizes)
        fitted, residual = _rank_four(depths[:, :, None] * x)
        if residual < least:
            best = depths
        if not residual < least * (1.0 - _AT_REST):
            break
        least = residual
        depths = np.einsum("vna,vna->vn", fitted, x) / sizes**2
    return _factors(xy, x, T, best, done)


def _measurements(wx: F64) -> F64:
    """(V, N, 3) -> (3 V, N)."""
    return np.asarray(wx.swapaxes(1, 2).reshape(-1, wx.shape[1]))


def _rank_four(wx: F64) -> tuple[F64, float]:
    """The nearest matrix of rank 4, as (V, N, 3), and its squared distance."""
    W = _measurements(wx)
    basis = np.linalg.eigh(W @ W.T)[1][:, -4:]
    fitted = basis @ (basis.T @ W)
    residual = float(np.sum((W - fitted) ** 2))
    return fitted.reshape(len(wx), 3, -1).swapaxes(1, 2), residual


def _factors(xy: F64, x: F64, T: F64, depths: F64, iterations: int) -> Factors:
    U, s, Vt = np.linalg.svd(_measurements(depths[:, :, None] * x), full_matrices=False)
    # Equal shares of the singular values whiten the points as far as they go.
    P, X = np.linalg.solve(T, U[:, :4].reshape(-1, 3, 4)), Vt[:4].T * s[:4]
    lengths = np.linalg.norm(X, axis=1, keepdims=True)
    X = X / np.where(lengths > 0.0, lengths, 1.0)
    xh = np.einsum("vab,nb->vna", P, X)
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = np.linalg.norm(xh[..., :2] / xh[..., 2:] - xy, axis=2)
    gap = float(s[4] / s[3]) if s[3] > 0.0 else 1.0
    return Factors(P, X, depths, np.nan_to_num(residual, nan=np.inf), gap, iterations)


Edge = tuple[int, int]

_LEAST_POINTS = 16
"""Complete tracks below which a table says too little to be factorised."""
_ROUNDS = 5
_PLANE_SIGMAS = 3.0
"""Whitened distances from a homography, in noise sigmas, of the points that it explains."""


@dataclass(frozen=True)
class Factorization:
    """Projective factorisation of a core of views, the other views joined by resection.

    Parameters
    ----------
    core_points : views join the core as long as this many tracks are seen in all of it.
    iterations : most times that the projective depths are taken anew from the factors; 0 is Sturm and Triggs'
        algorithm as published, whose depths are those of the fundamental matrices.
    growth : what adds the other views, adjusts and discards; its own parameters say how.
    """

    core_points: int = 100
    iterations: int = 50
    growth: IncrementalProjective = field(default_factory=IncrementalProjective)

    def __post_init__(self) -> None:
        if self.core_points < _LEAST_POINTS or self.iterations < 0:
            raise ValueError(
                f"a factorisation needs core_points >= {_LEAST_POINTS} and iterations >= 0; got "
                f"{self.core_points} and {self.iterations}"
            )

    def reconstruct(
        self,
        tracks: Tracks,
        pairs: Sequence[TwoView],
        sizes: I64,
        *,
        rng: np.random.Generator,
        attempt: int = 0,
    ) -> Reconstruction:
        """As :meth:`IncrementalProjective.reconstruct`; ``attempt`` grows the core from another pair."""
        ranked = rank_initial_pairs(tracks, pairs)
        require_pair_with_parallax(pairs)
        if attempt >= len(ranked):
            raise StageFailure(
                "no two photographs to begin a factorisation with",
                f"accepted: {len(ranked)} of {counted(len(pairs), 'pair')}",
                "take photographs that overlap by more than half and show texture",
            )
        usable = select_tracks_with_parallax(tracks, pairs)
        keep = select_tracks(tracks, usable, points_per_view=self.growth.points_per_view)
        selected = subset_tracks(tracks, keep)
        model = self.begin(selected, pairs, ranked[attempt], sizes)
        self.growth.complete(model, pairs, rng)
        return expand_to_all_tracks(to_reconstruction(model), tracks, keep)

    def begin(self, tracks: Tracks, pairs: Sequence[TwoView], start: TwoView, sizes: I64) -> ProjectiveModel:
        """Cameras and points of the core, adjusted.

        ``StageFailure`` where the pair ``start`` itself shares too few tracks.
        """
        xy = np.full((tracks.n_views, tracks.n_points, 2), np.nan)
        xy[tracks.view_index, tracks.point_index] = tracks.xy
        F = {(p.i, p.j): p.F for p in pairs} | {(p.j, p.i): p.F.T for p in pairs}
        tree = grow_core(np.isfinite(xy[:, :, 0]), pairs, start, least=self.core_points)
        sigma_px = max(start.sigma_px, self.growth.noise_floor_px)
        table, edges = complete_tracks(xy, tree)
        while len(tree) > 1 and is_planar(table, edges, _PLANE_SIGMAS * sigma_px):
            # Fewer views have more points in common.
            tree = tree[:-1]
            table, edges = complete_tracks(xy, tree)
        if table.shape[1] < _LEAST_POINTS:
            raise StageFailure(
                "the photographs to begin with share too few tracks for a factorisation",
                f"{table.shape[1]} of {_LEAST_POINTS}",
            )
        depths = depths_from_fundamentals(table, {e: F[v] for e, v in zip(edges, tree, strict=True)}, edges)
        factors, _ = factorize_robustly(table, depths, self.growth.outlier_sigmas[1], self.iterations)
        return self._adjusted(tracks, sizes, _views(tree), factors, sigma_px)

    def _adjusted(
        self, tracks: Tracks, sizes: I64, views: list[int], factors: Factors, sigma_px: float
    ) -> ProjectiveModel:
        """The core with all its points, those that only some of its views see included."""
        growth, early = self.growth, self.growth.outlier_sigmas[0]
        model = ProjectiveModel.empty(tracks, sizes, sigma_px=sigma_px, noise_floor_px=growth.noise_floor_px)
        # Until the bundle has done its work, the residuals are those of the factors.
        model.sigma_px = max(model.sigma_px, noise_from_distances(factors.residual_px.ravel()))
        every = np.indices(factors.depths.shape).reshape(2, -1)
        signs, _, _ = orient_signs(factors.P, factors.X, every[0], every[1])
        model.P[views] = factors.P * signs[:, None, None]
        model.registered[views] = True
        for _ in range(2):
            retriangulate_points(model, early)
            adjust_all(model, 2 * growth.bundle_iterations, early)
        return model


def _views(tree: Sequence[Edge]) -> list[int]:
    return [tree[0][0], *(j for _, j in tree)]


def grow_core(seen: B8, pairs: Sequence[TwoView], start: TwoView, *, least: int) -> list[Edge]:
    """The tree of views (i, j), i before j, that share at least ``least`` tracks; it begins with ``start``.

    ``seen`` (V, N). The next view is the one that leaves most tracks common to all, as long as an accepted
    pair ties it; of such pairs the one that most matches off a plane determine.
    """
    tree, views = [(start.i, start.j)], {start.i, start.j}
    weight: dict[Edge, float] = {}
    for pair in pairs:
        if pair.accepted and not pair.undetermined:
            weight[pair.i, pair.j] = weight[pair.j, pair.i] = pair.inliers * (
                1.0 - pair.homography_inlier_ratio
            )
    common = seen[start.i] & seen[start.j]
    while True:
        edges = [(i, j) for i, j in weight if i in views and j not in views]
        counts = {j: int((common & seen[j]).sum()) for _, j in edges}
        view = max(counts, key=lambda j: (counts[j], -j), default=-1)
        if view < 0 or counts[view] < least:
            return tree
        tree.append(max((e for e in edges if e[1] == view), key=lambda e: (weight[e], -e[0])))
        views.add(view)
        common &= seen[view]


def complete_tracks(xy: F64, tree: Sequence[Edge]) -> tuple[F64, list[Edge]]:
    """The tracks (V', N', 2) that all views of the tree see, of xy (V, N, 2), and its edges renumbered."""
    views = _views(tree)
    table = xy[views]
    place = {view: k for k, view in enumerate(views)}
    return table[:, np.isfinite(table).all(axis=(0, 2))], [(place[i], place[j]) for i, j in tree]


def is_planar(xy: F64, edges: Sequence[Edge], gate_px: float) -> bool:
    """Whether a homography explains nearly all points of xy (V, N, 2) in every pair of views of ``edges``.

    Then they lie on one plane (or the camera only turned), which determines no projective camera: rank 4
    would be made of noise.
    """
    if xy.shape[1] < _LEAST_POINTS:
        return False
    shares = []
    for i, j in edges:
        within = np.ones(xy.shape[1], dtype=bool)
        for _ in range(3):
            H = estimate_homography(xy[i, within], xy[j, within])
            distance = np.linalg.norm(homography_sampson_residuals(H, xy[i], xy[j]), axis=1)
            within = distance <= max(gate_px, 2.0 * float(np.median(distance)))
        shares.append(np.mean(distance <= gate_px))
    return bool(min(shares) >= NO_PARALLAX)


def factorize_robustly(xy: F64, depths: F64, sigmas: float, iterations: int) -> tuple[Factors, B8]:
    """Factors of xy (V, N, 2) without the points that disagree, and which are kept (N,).

    A point with a residual beyond ``sigmas`` times the noise is left out and the rest factorised anew, until
    no further one is, or too few would be left.
    """
    kept = np.ones(xy.shape[1], dtype=bool)
    for _ in range(_ROUNDS):
        factors = factorize(xy[:, kept], depths[:, kept], iterations=iterations)
        worst = factors.residual_px.max(axis=0)
        within = worst <= sigmas * noise_from_distances(factors.residual_px.ravel())
        if within.all() or within.sum() < _LEAST_POINTS:
            break
        kept[np.flatnonzero(kept)[~within]] = False
    return factors, kept
