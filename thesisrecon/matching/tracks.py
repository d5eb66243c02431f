"""Tracks: chains of verified matches over many views, optionally aligned with their middle view."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import scipy

from thesisrecon._numba import empty, full, kernel
from thesisrecon.arrays import B8, F64, I64, rows_of_views
from thesisrecon.errors import require_range
from thesisrecon.matching._prepared import MapAll, PreparedImage, select_found
from thesisrecon.matching.track_alignment import AFFINE_STD, MIN_CORRELATION, align_corners
from thesisrecon.optimize.bundle.projection import cached_pair_order
from thesisrecon.records import Matches, Tracks, TwoView

MERGE_PX = 1.0  # default distance up to which positions become one corner: their noise from pair to pair
Pair = TypeVar("Pair", Matches, TwoView)


@kernel
def _union_corners(edges: I64, view_of: I64, n_views: int) -> I64:
    """First corner (N,) of the set of each corner along ``edges`` (E, 2); no set sees a view twice."""
    count = len(view_of)
    # Sets are lists linked through ``following``; the smaller one joins the larger.
    parent, last, size = empty(count, np.int64), empty(count, np.int64), full(count, 1, np.int64)
    following, edge_of_view = full(count, -1, np.int64), full(n_views, -1, np.int64)
    for n in range(count):
        parent[n] = last[n] = n
    for e in range(len(edges)):
        a, b = edges[e, 0], edges[e, 1]
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        while parent[b] != b:
            parent[b] = parent[parent[b]]
            b = parent[b]
        if a == b:
            continue
        if size[b] > size[a]:
            a, b = b, a
        n = b
        while n >= 0:
            edge_of_view[view_of[n]] = e
            n = following[n]
        n = a
        while n >= 0 and edge_of_view[view_of[n]] != e:
            n = following[n]
        if n >= 0:
            continue
        parent[b] = a
        following[last[a]] = b
        last[a] = last[b]
        size[a] += size[b]
    first = full(count, -1, np.int64)
    root = empty(count, np.int64)
    for n in range(count):
        a = n
        while parent[a] != a:
            a = parent[a]
        if first[a] < 0:
            first[a] = n
        root[n] = first[a]
    return root


def _chain_affines(edges: I64, xy1: F64, xy2: F64, affine: F64, xy: F64, middle: I64) -> tuple[F64, F64]:
    """Chain x2 = xy2 + A (x1 - xy1) along the edges, breadth-first from the ``middle`` observations (T,)."""
    # `edges` (E, 2). Returns the middle's point (K, 2) in the view of each observation and the map (K, 2, 2)
    # to it.
    position, maps = xy.copy(), np.tile(np.eye(2), (len(xy), 1, 1))
    order, reached = np.full(len(xy), -1), len(middle)
    order[middle] = np.arange(reached)
    backward = np.abs(np.linalg.det(affine)) >= 1e-6
    left = np.concatenate([np.arange(len(edges)), len(edges) + np.flatnonzero(backward)])
    source, target = (np.concatenate([edges[:, a], edges[:, 1 - a]]) for a in (0, 1))
    while len(left := left[order[target[left]] < 0]):
        k = left[order[source[left]] >= 0]
        if not len(k):
            break
        # Of each new observation, the edge from the one that was reached first.
        k = k[np.lexsort((k % len(edges), order[source[k]]))]
        k = k[np.sort(np.unique(target[k], return_index=True)[1])]
        here, there, e, forward = source[k], target[k], k % len(edges), (k < len(edges))[:, None]
        order[there] = reached + np.arange(len(k))
        reached += len(k)
        A = affine[e]
        A[~forward[:, 0]] = np.linalg.inv(A[~forward[:, 0]])
        away = position[here] - np.where(forward, xy1[e], xy2[e])
        position[there] = np.where(forward, xy2[e], xy1[e]) + np.einsum("kab,kb->ka", A, away)
        maps[there] = A @ maps[here]
    return position, maps


@dataclass(frozen=True)
class _Chains:
    """Corners sorted by track and view, (K,) each, and the two observations (E, 2) of each match."""

    view: I64
    corner: I64
    track: I64
    xy: F64
    edges: I64
    count: int


def _link_matches(corners: Sequence[F64], pairs: Sequence[TwoView]) -> _Chains:
    """Unite the matches of all pairs in their order; a track that would see a view twice splits there."""
    counts = [len(xy) for xy in corners]
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    view_of = np.repeat(np.arange(len(corners)), counts).astype(np.int64)
    ends = [np.stack([first[p.i] + p.index1, first[p.j] + p.index2], 1) for p in pairs]
    edges = np.concatenate([np.empty((0, 2), np.int64), *ends])
    parent = _union_corners(edges, view_of, len(corners))
    node = np.flatnonzero(np.bincount(parent, minlength=len(parent))[parent] >= 2)
    node = node[np.argsort(parent[node], kind="stable")]
    root, track = np.unique(parent[node], return_inverse=True)
    xy = np.concatenate([*corners, np.empty((0, 2))])[node]
    observation = np.full(first[-1], -1, np.int64)
    observation[node] = np.arange(len(node))
    return _Chains(view_of[node], node - first[view_of[node]], track, xy, observation[edges], len(root))


def _affines_from_middle_view(chains: _Chains, pairs: Sequence[TwoView]) -> tuple[F64, F64, I64]:
    """Position (K, 2) px, map (K, 2, 2) and middle (K,), of most matches in the track, of observations."""
    xy, edges = chains.xy, chains.edges
    if not len(edges):
        return xy, np.tile(np.eye(2), (len(xy), 1, 1)), np.arange(len(xy))
    inside = chains.track[edges[:, 0]] == chains.track[edges[:, 1]]
    edges = edges[inside]
    # Pair by pair: all matches of hundreds of images need gigabytes.
    used = np.split(inside, np.cumsum([len(p.xy1) for p in pairs])[:-1])
    xy1, xy2, affine = (
        np.concatenate([getattr(p, name)[rows] for p, rows in zip(pairs, used, strict=True)])
        for name in ("xy1", "xy2", "affine")
    )
    degree = np.bincount(edges.ravel(), minlength=len(xy))
    best = np.lexsort((np.arange(len(xy)), -degree, chains.track))
    middle_of = best[np.searchsorted(chains.track[best], np.arange(chains.count))]
    start, maps = _chain_affines(edges, xy1, xy2, affine, xy, middle_of)
    return start, maps, middle_of[chains.track]


@dataclass(frozen=True)
class PlainTracks:
    """Tracks with every observation at its corner."""

    merge_px: float = MERGE_PX
    """Distance up to which positions of one view become one corner, px at working size; used only for matches
    without corners."""

    def __post_init__(self) -> None:
        require_range(self, merge_px="[0, inf)")

    def build(
        self, prepared: Sequence[Any], pairs: Sequence[TwoView], *, map_all: MapAll, rng: np.random.Generator
    ) -> Tracks:
        """See `thesisrecon.config.TrackBuilder.build`."""
        del map_all, rng
        accepted = _best_first(pairs)
        features = [getattr(p, "features", None) for p in prepared] if _numbered(accepted) else [None]
        corners = [found.xy for found in features if found is not None]
        if len(corners) < len(prepared):
            corners, accepted = corners_from_matches(accepted, len(prepared), self.merge_px)
        return tracks_of_corners(corners, accepted)


@dataclass(frozen=True)
class AlignedTracks:
    """Tracks whose observations are aligned by least squares with the window of their middle view.

    The middle view of a track is the one with most matches in it; local maps to the other views are chained
    along the matches. Matches without corners, and views that another matcher has prepared, give
    :class:`PlainTracks`.
    """

    def build(
        self, prepared: Sequence[Any], pairs: Sequence[TwoView], *, map_all: MapAll, rng: np.random.Generator
    ) -> Tracks:
        """See `thesisrecon.config.TrackBuilder.build`."""
        accepted = _best_first(pairs)
        if not (_numbered(accepted) and isinstance(prepared[0], PreparedImage)):
            logging.getLogger(__name__).warning("tracks are not aligned: the matcher prepares no windows")
            return PlainTracks().build(prepared, pairs, map_all=map_all, rng=rng)
        chains = _link_matches([p.features.xy for p in prepared], accepted)
        start, affine, middle = _affines_from_middle_view(chains, accepted)
        xy, kept = start.copy(), np.ones(len(start), np.bool_)

        def align(some: I64) -> None:
            for k in some.tolist():
                i, j, group = int(first[k]), int(second[k]), groups[k]
                corner = select_found(prepared[i].features, chains.corner[middle[group]])
                matches = corner.xy, corner.scale, start[group], affine[group]
                found, _, score = align_corners(prepared[i], prepared[j], matches, affine_std=AFFINE_STD)
                xy[group], kept[group] = found, score >= MIN_CORRELATION

        # Observations of each two different views, in an order that reuses prepared images.
        pair = chains.view[middle] * len(prepared) + chains.view
        rows = np.flatnonzero(chains.view[middle] != chains.view)
        rows = rows[np.argsort(pair[rows], kind="stable")]
        numbers, starts = np.unique(pair[rows], return_index=True)
        groups, (first, second) = np.split(rows, starts[1:]), np.divmod(numbers, len(prepared))
        # A thread aligns 256 groups at a time, which share views.
        order = cached_pair_order(first, second)
        map_all(align, np.split(order, np.arange(256, len(order), 256)))
        return _tracks(chains, xy, kept, len(prepared))


def tracks_of_corners(corners: Sequence[F64], pairs: Sequence[TwoView]) -> Tracks:
    """Return the tracks of accepted pairs that match corners, each observation at its corner."""
    chains = _link_matches(corners, _best_first(pairs))
    return _tracks(chains, chains.xy, np.ones(len(chains.xy), np.bool_), len(corners))


def _numbered(pairs: Sequence[TwoView]) -> bool:
    """Whether all matches are between corners."""
    return not any((p.index1 < 0).any() or (p.index2 < 0).any() for p in pairs)


def corners_from_matches(
    pairs: Sequence[Pair], n_views: int, merge_px: float = MERGE_PX
) -> tuple[list[F64], list[Pair]]:
    """Number the positions of matches that have no corners, as matchers without a detector give them.

    Positions of one view within ``merge_px`` of a common centre become one corner, at their mean; centres are
    at least ``merge_px`` apart, the most frequent first. Returns the corners (N_i, 2) of every view, whatever
    the order of pairs, and the pairs with ``index1`` and ``index2``: of matches of one corner the nearest one
    stays.
    """
    ends: list[F64] = [xy for p in pairs for xy in (p.xy1, p.xy2)]
    lengths = [len(xy) for xy in ends]
    view = np.repeat(np.array([i for p in pairs for i in (p.i, p.j)], dtype=np.int64), lengths)
    xy, number = np.concatenate([np.empty((0, 2)), *ends]), np.empty(len(view), np.int64)
    corners = []
    for rows in rows_of_views(view, n_views):
        found, number[rows] = _merge_positions(xy[rows], merge_px)
        corners.append(found)
    index, numbered = np.split(number, np.cumsum(lengths)), []
    for pair, index1, index2 in zip(pairs, index[::2], index[1::2], strict=False):
        off1, off2 = pair.xy1 - corners[pair.i][index1], pair.xy2 - corners[pair.j][index2]
        rows = np.argsort((off1**2 + off2**2).sum(axis=1), kind="stable")
        for ends_of in (index1, index2):
            rows = rows[np.sort(np.unique(ends_of[rows], return_index=True)[1])]
        rows = np.sort(rows)
        names = ["xy1", "xy2", "affine"] + ["score"] * isinstance(pair, Matches)
        kept = {name: getattr(pair, name)[rows] for name in names}
        numbered.append(replace(pair, index1=index1[rows], index2=index2[rows], **kept))
    return corners, numbered


def _merge_positions(xy: F64, merge_px: float) -> tuple[F64, I64]:
    """Corners (C, 2) of the positions (N, 2) of one view, and the corner (N,) of each."""
    if not len(xy):
        return xy, np.empty(0, np.int64)
    places, place_of, count = np.unique(xy, axis=0, return_inverse=True, return_counts=True)
    rank = np.empty(len(places), np.int64)
    rank[np.argsort(-count, kind="stable")] = np.arange(len(places))
    near = scipy.spatial.cKDTree(places).query_pairs(merge_px, output_type="ndarray")
    is_centre, open_ = np.zeros(len(places), np.bool_), np.ones(len(places), np.bool_)
    # Rounds of one vectorised step each give the centres of a greedy selection in the order of the ranks.
    while len(near):
        lowest = np.full(len(places), len(places))
        np.minimum.at(lowest, near, rank[near[:, ::-1]])
        new = open_ & (rank < lowest)
        is_centre |= new
        open_ &= ~new
        open_[near[new[near[:, ::-1]]]] = False
        near = near[open_[near].all(axis=1)]
    centres = places[is_centre | open_]
    _, nearest = scipy.spatial.cKDTree(centres).query(places)
    offset = (places - centres[nearest]) * count[:, None]
    total = np.bincount(nearest, weights=count)
    mean = np.stack([np.bincount(nearest, weights=offset[:, a]) for a in (0, 1)], axis=1) / total[:, None]
    return centres + mean, nearest[place_of.reshape(-1)]


def _best_first(pairs: Sequence[TwoView]) -> list[TwoView]:
    """Accepted pairs, those with more verified matches first."""
    return sorted((p for p in pairs if p.accepted), key=lambda p: (-p.inliers, p.i, p.j))


def _tracks(chains: _Chains, xy: F64, kept: B8, n_views: int) -> Tracks:
    """Renumbered tracks of the observations that remain in at least two views."""
    sizes = np.bincount(chains.track[kept], minlength=chains.count)
    use = kept & (sizes[chains.track] >= 2)
    number = np.cumsum(sizes >= 2) - 1
    # Chains are sorted by track and view.
    return Tracks(chains.view[use], number[chains.track[use]], xy[use], n_views, int((sizes >= 2).sum()))
