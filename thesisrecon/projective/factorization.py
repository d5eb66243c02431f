"""Chapter 6 by factorisation: a core of views at once, then the others one by one.

The incremental way trusts one pair of views to begin with. Here many views that see the same points begin
together (:mod:`thesisrecon.projective.sturm_triggs`); only what none of them tells depends on an order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thesisrecon.errors import StageFailure, counted
from thesisrecon.geometry.cheirality import orient_signs
from thesisrecon.geometry.multiview import estimate_homography, homography_distances
from thesisrecon.projective.growing import GrowingModel, adjust, finish, retriangulate
from thesisrecon.projective.incremental import GatedIncremental
from thesisrecon.projective.initial_pair import NO_PARALLAX, rank_initial_pairs, require_parallax
from thesisrecon.projective.selection import (
    onto_all_tracks,
    select_tracks,
    subset_tracks,
    tracks_with_parallax,
)
from thesisrecon.projective.sturm_triggs import Factors, depths_from_fundamentals, factorize
from thesisrecon.robust.noise import noise_from_distances
from thesisrecon.types import B8, I64, Reconstruction, Tracks, TwoView

F64 = NDArray[np.float64]
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
    growth: GatedIncremental = field(default_factory=GatedIncremental)

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
        """As :meth:`GatedIncremental.reconstruct`; ``attempt`` grows the core from another pair."""
        ranked = rank_initial_pairs(tracks, pairs)
        require_parallax(pairs)
        if attempt >= len(ranked):
            raise StageFailure(
                "no two photographs to begin a factorisation with",
                f"accepted: {len(ranked)} of {counted(len(pairs), 'pair')}",
                "take photographs that overlap by more than half and show texture",
            )
        usable = tracks_with_parallax(tracks, pairs)
        keep = select_tracks(tracks, usable, points_per_view=self.growth.points_per_view)
        selected = subset_tracks(tracks, keep)
        model = self.begin(selected, pairs, ranked[attempt], sizes)
        self.growth.complete(model, pairs, rng)
        return onto_all_tracks(finish(model), tracks, keep)

    def begin(self, tracks: Tracks, pairs: Sequence[TwoView], start: TwoView, sizes: I64) -> GrowingModel:
        """Cameras and points of the core, adjusted.

        ``StageFailure`` where the pair ``start`` itself shares too few tracks.
        """
        xy = np.full((tracks.n_views, tracks.n_points, 2), np.nan)
        xy[tracks.view_index, tracks.point_index] = tracks.xy
        F = {(p.i, p.j): p.F for p in pairs} | {(p.j, p.i): p.F.T for p in pairs}
        tree = grow_core(np.isfinite(xy[:, :, 0]), pairs, start, least=self.core_points)
        sigma_px = max(start.sigma_px, self.growth.noise_floor_px)
        table, edges = complete_table(xy, tree)
        while len(tree) > 1 and on_one_plane(table, edges, _PLANE_SIGMAS * sigma_px):
            # Fewer views have more points in common.
            tree = tree[:-1]
            table, edges = complete_table(xy, tree)
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
    ) -> GrowingModel:
        """The core with all its points, those that only some of its views see included."""
        growth, early = self.growth, self.growth.outlier_sigmas[0]
        model = GrowingModel.empty(tracks, sizes, sigma_px=sigma_px, noise_floor_px=growth.noise_floor_px)
        # Until the bundle has done its work, the residuals are those of the factors.
        model.sigma_px = max(model.sigma_px, noise_from_distances(factors.residual_px.ravel()))
        every = np.indices(factors.depths.shape).reshape(2, -1)
        signs, _, _ = orient_signs(factors.P, factors.X, every[0], every[1])
        model.P[views] = factors.P * signs[:, None, None]
        model.registered[views] = True
        for _ in range(2):
            retriangulate(model, early)
            adjust(model, 2 * growth.bundle_iterations, early)
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
            weight[pair.i, pair.j] = weight[pair.j, pair.i] = pair.inliers * (1.0 - pair.homography_share)
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


def complete_table(xy: F64, tree: Sequence[Edge]) -> tuple[F64, list[Edge]]:
    """The tracks (V', N', 2) that all views of the tree see, of xy (V, N, 2), and its edges renumbered."""
    views = _views(tree)
    table = xy[views]
    place = {view: k for k, view in enumerate(views)}
    return table[:, np.isfinite(table).all(axis=(0, 2))], [(place[i], place[j]) for i, j in tree]


def on_one_plane(xy: F64, edges: Sequence[Edge], gate_px: float) -> bool:
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
            distance = np.linalg.norm(homography_distances(H, xy[i], xy[j]), axis=1)
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
