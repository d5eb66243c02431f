"""Chains of matches over many views: which corners belong together, and the maps along them."""

from __future__ import annotations

import numpy as np
from numba import njit

from thesisrecon.types import F64, I64


@njit(cache=True, nogil=True)
def unite(edges: I64, view_of: I64, n_views: int) -> I64:
    """(N,) the first corner of each corner's set, after uniting along ``edges`` (E, 2) in their order.

    An edge between two sets that share a view is refused. ``view_of`` (N,) is the view of each corner. Sets
    that share a view are known by the views of the smaller one alone, so that an edge costs the same however
    many photographs there are.
    """
    count = len(view_of)
    parent = np.arange(count)
    # Sets are lists linked through ``following``, the smaller one joins the larger.
    following, last, size = np.full(count, -1, np.int64), np.arange(count), np.ones(count, np.int64)
    # Which views the set of a root has: root times views plus view.
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
    first = np.full(count, -1, np.int64)
    root = np.empty(count, np.int64)
    for n in range(count):
        a = n
        while parent[a] != a:
            a = parent[a]
        if first[a] < 0:
            first[a] = n
        root[n] = first[a]
    return root


@njit(cache=True, nogil=True)
def chain_maps(edges: I64, xy1: F64, xy2: F64, affine: F64, xy: F64, middle: I64) -> tuple[F64, F64]:
    """Breadth-first from the middle observation of every track: x2 = xy2 + A (x1 - xy1) along each edge.

    ``edges`` (E, 2) observations; ``middle`` (T,). Returns the place (K, 2) of the middle's point in every
    observation's view and the map (K, 2, 2) to it; an observation out of reach keeps its own corner.
    """
    count = len(xy)
    place, maps = xy.copy(), np.zeros((count, 2, 2))
    maps[:, 0, 0] = 1.0
    maps[:, 1, 1] = 1.0
    start = np.zeros(count + 1, np.int64)
    for e in range(len(edges)):
        start[edges[e, 0] + 1] += 1
        start[edges[e, 1] + 1] += 1
    start = np.cumsum(start)
    fill = start[:-1].copy()
    incident = np.empty(2 * len(edges), np.int64)
    for e in range(len(edges)):
        for side in range(2):
            incident[fill[edges[e, side]]] = e
            fill[edges[e, side]] += 1
    reached = np.zeros(count, np.bool_)
    queue = np.empty(count, np.int64)
    head, tail = 0, 0
    for t in range(len(middle)):
        queue[tail] = middle[t]
        reached[middle[t]] = True
        tail += 1
    inverse = np.empty((2, 2))
    while head < tail:
        k = queue[head]
        head += 1
        for at in range(start[k], start[k + 1]):
            e = incident[at]
            forward = edges[e, 0] == k
            other = edges[e, 1] if forward else edges[e, 0]
            if reached[other]:
                continue
            a = affine[e]
            if forward:
                place[other] = xy2[e] + a @ (place[k] - xy1[e])
                maps[other] = a @ maps[k]
            else:
                determinant = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
                if abs(determinant) < 1e-6:
                    continue
                inverse[0, 0], inverse[0, 1] = a[1, 1] / determinant, -a[0, 1] / determinant
                inverse[1, 0], inverse[1, 1] = -a[1, 0] / determinant, a[0, 0] / determinant
                place[other] = xy1[e] + inverse @ (place[k] - xy2[e])
                maps[other] = inverse @ maps[k]
            reached[other] = True
            queue[tail] = other
            tail += 1
    return place, maps
