"""Tracks: chains of verified matches over many views, optionally aligned with their middle view."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.kernels import empty, full, kernel, zeros
from thesisrecon.matching._alignment import AFFINE_STD, MIN_CORRELATION, align_corners
from thesisrecon.matching._prepared import PreparedImage
from thesisrecon.numerics.observations import morton_pair_order
from thesisrecon.records import Tracks, TwoView


@kernel
def _union_corners(edges: I64, view_of: I64, n_views: int) -> I64:
    """First corner (N,) of the set of each corner after uniting along ``edges`` (E, 2) in their order.

    An edge between two sets that share a view is rejected. ``view_of`` (N,) is the view of each corner. Only
    the views of the smaller set are compared, so that the cost of an edge does not grow with the number of
    images.
    """
    count = len(view_of)
    parent = np.arange(count)
    # Sets are lists linked through ``following``; the smaller one joins the larger.
    following, last, size = full(count, -1, np.int64), np.arange(count), full(count, 1, np.int64)
    # Views of the set of a root: root times views plus view.
    has = {np.int64(-1)}
    for n in range(count):
        has.add(n * n_views + view_of[n])
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
        while n >= 0 and a * n_views + view_of[n] not in has:
            n = following[n]
        if n >= 0:
            continue
        n = b
        while n >= 0:
            has.discard(b * n_views + view_of[n])
            has.add(a * n_views + view_of[n])
            n = following[n]
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


@kernel
def _chain_affines(edges: I64, xy1: F64, xy2: F64, affine: F64, xy: F64, middle: I64) -> tuple[F64, F64]:
    """Chain x2 = xy2 + A (x1 - xy1) along the edges, breadth-first from the middle observations.

    ``edges`` (E, 2) observations; ``middle`` (T,). Returns the position (K, 2) of the middle's point in the
    view of every observation and the map (K, 2, 2) to it; an unreachable observation keeps its own corner.
    """
    count = len(xy)
    position, maps = xy.copy(), zeros((count, 2, 2))
    maps[:, 0, 0] = 1.0
    maps[:, 1, 1] = 1.0
    start = zeros(count + 1, np.int64)
    for e in range(len(edges)):
        start[edges[e, 0] + 1] += 1
        start[edges[e, 1] + 1] += 1
    fill = empty(count, np.int64)
    for k in range(count):
        fill[k] = start[k]
        start[k + 1] += start[k]
    incident = empty(2 * len(edges), np.int64)
    for e in range(len(edges)):
        for side in range(2):
            incident[fill[edges[e, side]]] = e
            fill[edges[e, side]] += 1
    reached = zeros(count, np.bool_)
    queue = empty(count, np.int64)
    head, tail = 0, 0
    for t in range(len(middle)):
        queue[tail] = middle[t]
        reached[middle[t]] = True
        tail += 1
    while head < tail:
        k = queue[head]
        head += 1
        for at in range(start[k], start[k + 1]):
            e = incident[at]
            forward = edges[e, 0] == k
            other = edges[e, 1] if forward else edges[e, 0]
            if reached[other]:
                continue
            a, b, c, d = affine[e, 0, 0], affine[e, 0, 1], affine[e, 1, 0], affine[e, 1, 1]
            here, there = xy1[e], xy2[e]
            if not forward:
                determinant = a * d - b * c
                if abs(determinant) < 1e-6:
                    continue
                a, b, c, d = d / determinant, -b / determinant, -c / determinant, a / determinant
                here, there = there, here
            dx, dy = position[k, 0] - here[0], position[k, 1] - here[1]
            position[other, 0] = there[0] + (a * dx + b * dy)
            position[other, 1] = there[1] + (c * dx + d * dy)
            for side in range(2):
                u, v = maps[k, 0, side], maps[k, 1, side]
                maps[other, 0, side], maps[other, 1, side] = a * u + b * v, c * u + d * v
            reached[other] = True
            queue[tail] = other
            tail += 1
    return position, maps


@dataclass(frozen=True)
class _Chains:
    """Corners ``view, corner, track`` (K,), ``xy`` (K, 2), sorted by track and view.

    ``edges`` (E, 2) are the two observations of each match, ``count`` is the number of tracks.
    """

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
    used, size = np.unique(parent, return_counts=True)
    root = used[size >= 2]
    node = np.flatnonzero(np.isin(parent, root))
    track = np.searchsorted(root, parent[node])
    order = np.lexsort((node, track))
    node, track = node[order], track[order]
    xy = np.concatenate([*corners, np.empty((0, 2))])[node]
    observation = np.full(first[-1], -1, np.int64)
    observation[node] = np.arange(len(node))
    return _Chains(view_of[node], node - first[view_of[node]], track, xy, observation[edges], len(root))


def _affines_from_middle_view(chains: _Chains, pairs: Sequence[TwoView]) -> tuple[F64, F64, I64]:
    """Position (K, 2) px and map (K, 2, 2) of observations, chained from the middle one of their track (K,).

    The middle observation has most matches in the track.
    """
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

    def build(
        self, prepared: Sequence[PreparedImage], pairs: Sequence[TwoView], rng: np.random.Generator
    ) -> Tracks:
        """See `thesisrecon.config.TrackBuilder.build`."""
        del rng
        chains = _link_matches([p.features.xy for p in prepared], _best_first(pairs))
        return _tracks(chains, chains.xy, np.ones(len(chains.xy), np.bool_), len(prepared))


@dataclass(frozen=True)
class AlignedTracks:
    """Tracks whose observations are aligned by least squares with the window of their middle view.

    The middle view of a track has most direct matches in it; local maps to the other views are chained along
    the matches.
    """

    def build(
        self, prepared: Sequence[PreparedImage], pairs: Sequence[TwoView], rng: np.random.Generator
    ) -> Tracks:
        """See `thesisrecon.config.TrackBuilder.build`."""
        del rng
        accepted = _best_first(pairs)
        chains = _link_matches([p.features.xy for p in prepared], accepted)
        start, affine, middle = _affines_from_middle_view(chains, accepted)
        xy, kept = start.copy(), np.ones(len(start), np.bool_)
        for i, j, group in _groups(chains.view[middle], chains.view, len(prepared)):
            view1, corner = prepared[i], chains.corner[middle[group]]
            matches = (view1.features.xy[corner], view1.features.scale[corner], start[group], affine[group])
            found, _, score = align_corners(view1, prepared[j], matches, affine_std=AFFINE_STD)
            xy[group], kept[group] = found, score >= MIN_CORRELATION
        return _tracks(chains, xy, kept, len(prepared))


def _best_first(pairs: Sequence[TwoView]) -> list[TwoView]:
    """Accepted pairs, those with more verified matches first."""
    return sorted((p for p in pairs if p.accepted), key=lambda p: (-p.inliers, p.i, p.j))


def _groups(first: I64, second: I64, views: int) -> Iterator[tuple[int, int, I64]]:
    """Observations of each two different views (i, j), in an order that reuses prepared images."""
    pair = first * views + second
    order = np.flatnonzero(first != second)
    order = order[np.argsort(pair[order], kind="stable")]
    numbers, starts = np.unique(pair[order], return_index=True)
    groups = np.split(order, starts[1:]) if len(numbers) else []
    i, j = np.divmod(numbers, views)
    for k in morton_pair_order(i, j):
        yield int(i[k]), int(j[k]), groups[k]


def _tracks(chains: _Chains, xy: F64, kept: B8, n_views: int) -> Tracks:
    """Renumbered tracks of the observations that remain in at least two views."""
    sizes = np.bincount(chains.track[kept], minlength=chains.count)
    use = kept & (sizes[chains.track] >= 2)
    number = np.cumsum(sizes >= 2) - 1
    point, view, position = number[chains.track[use]], chains.view[use], xy[use]
    order = np.lexsort((view, point))
    return Tracks(
        view_index=view[order].astype(np.int64),
        point_index=point[order].astype(np.int64),
        xy=np.ascontiguousarray(position[order]),
        n_views=n_views,
        n_points=int((sizes >= 2).sum()),
    )
