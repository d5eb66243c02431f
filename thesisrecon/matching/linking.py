"""Chains of matches: union of the pairs without two corners in one view, and local maps along a chain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thesisrecon.matching.kernels import chain_maps, unite
from thesisrecon.types import F64, I64, TwoView


@dataclass(frozen=True)
class Chains:
    """Corners that belong together: ``view, corner, track`` (K,), sorted by track, then view; ``count``
    tracks.

    ``node`` (K,) the corner's number when all corners of all views are counted through.
    """

    view: I64
    corner: I64
    track: I64
    node: I64
    count: int


def link_matches(corners: Sequence[int], pairs: Sequence[TwoView]) -> Chains:
    """Unite the matches of all pairs, the best pairs first; a union that would put two corners of one view
    into one track is refused, so the weaker link breaks and the track splits."""
    first = np.concatenate([[0], np.cumsum(corners)]).astype(np.int64)
    view_of = np.repeat(np.arange(len(corners)), corners).astype(np.int64)
    edges = _edges(first, pairs)
    parent = unite(edges, view_of, len(corners))
    used, size = np.unique(parent, return_counts=True)
    root = used[size >= 2]
    node = np.flatnonzero(np.isin(parent, root))
    track = np.searchsorted(root, parent[node])
    order = np.lexsort((node, track))
    node, track = node[order], track[order]
    return Chains(view_of[node], node - first[view_of[node]], track, node, len(root))


def _edges(first: I64, pairs: Sequence[TwoView]) -> I64:
    """(E, 2) corner numbers of all matches; pairs with more verified matches, the more certain ones, come
    first."""
    order = sorted(range(len(pairs)), key=lambda n: (-pairs[n].inliers, pairs[n].i, pairs[n].j))
    if not order:
        return np.empty((0, 2), np.int64)
    return np.concatenate(
        [
            np.stack([first[pairs[n].i] + pairs[n].index1, first[pairs[n].j] + pairs[n].index2], 1)
            for n in order
        ]
    )


def maps_to_views(chains: Chains, corners: Sequence[F64], pairs: Sequence[TwoView]) -> tuple[F64, F64, I64]:
    """Where the corner of each track's middle view lies in the other views, by chaining the matches' local
    maps.

    Returns the place (K, 2) px, the map from the middle view (K, 2, 2) and the observation (K,) that is the
    middle of its track: the one with most matches in the track, the first of equals.
    """
    counts = [len(c) for c in corners]
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    observation = np.full(first[-1], -1, np.int64)
    observation[chains.node] = np.arange(len(chains.node))
    order = sorted(range(len(pairs)), key=lambda n: (-pairs[n].inliers, pairs[n].i, pairs[n].j))
    edges = observation[_edges(first, pairs)]
    xy = np.concatenate([*corners, np.empty((0, 2))])[chains.node]
    if not len(edges):
        return xy, np.tile(np.eye(2), (len(xy), 1, 1)), np.arange(len(xy))
    inside = chains.track[edges[:, 0]] == chains.track[edges[:, 1]]
    edges = edges[inside]
    # Pair by pair: all matches of hundreds of photographs are gigabytes.
    used = np.split(inside, np.cumsum([len(pairs[n].xy1) for n in order])[:-1])
    xy1 = np.concatenate([pairs[n].xy1[rows] for n, rows in zip(order, used, strict=True)])
    xy2 = np.concatenate([pairs[n].xy2[rows] for n, rows in zip(order, used, strict=True)])
    affine = np.concatenate([pairs[n].affine[rows] for n, rows in zip(order, used, strict=True)])
    degree = np.bincount(edges.ravel(), minlength=len(xy))
    best = np.lexsort((np.arange(len(xy)), -degree, chains.track))
    middle_of = best[np.searchsorted(chains.track[best], np.arange(chains.count))]
    start, maps = chain_maps(edges, xy1, xy2, affine, xy, middle_of)
    return start, maps, middle_of[chains.track]
