"""Which tracks take part while the cameras are found: long ones, spread over every view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from thesisrecon.projective.initial_pair import NO_PARALLAX
from thesisrecon.types import B8, F64, I64, Reconstruction, Tracks, TwoView

CELLS = 8
"""Of the grid over a view, along each side."""


def tracks_with_parallax(tracks: Tracks, pairs: Sequence[TwoView], *, most: float = NO_PARALLAX) -> B8:
    """Tracks that are not seen from one standpoint only; -> (n_points,) bool.

    Two views whose matches one homography explains to the share ``most`` show a point without parallax, or on
    one plane: it may lie anywhere along its ray, and a crowd of such points bends the frame in which cameras
    are judged. They come back in the metric stage where a ray of another view fixes them.
    """
    apart = np.ones((tracks.n_views, tracks.n_views), dtype=np.float32)
    np.fill_diagonal(apart, 0.0)
    for pair in pairs:
        if pair.accepted and pair.homography_share >= most:
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


def grid_cells(tracks: Tracks, *, cells: int = CELLS) -> I64:
    """(K,) the cell of each observation in a grid of ``cells`` x ``cells`` of its view's extent, the cells of
    all views counted through."""
    low, high = np.full((2, tracks.n_views, 2), np.inf)
    np.minimum.at(low, tracks.view_index, tracks.xy)
    np.minimum.at(high, tracks.view_index, -tracks.xy)
    view, extent = tracks.view_index, np.maximum(-high - low, 1e-9)
    cell = np.minimum((tracks.xy - low[view]) / extent[view] * cells, cells - 1).astype(np.int64)
    return np.asarray((view * cells + cell[:, 0]) * cells + cell[:, 1], dtype=np.int64)


def spread_of_views(cell: I64, chosen: B8, n_views: int, *, cells: int = CELLS) -> F64:
    """How much of each view its ``chosen`` (K,) observations hold, from :func:`grid_cells`; -> (V,).

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


def onto_all_tracks(reconstruction: Reconstruction, tracks: Tracks, keep: B8) -> Reconstruction:
    """A reconstruction of the tracks marked in ``keep``, told in the numbers of all ``tracks``."""
    X = np.zeros((tracks.n_points, 4))
    X[keep] = reconstruction.X
    valid = np.zeros(tracks.n_points, dtype=bool)
    valid[keep] = reconstruction.valid
    inlier = np.zeros(len(tracks.xy), dtype=bool)
    inlier[keep[tracks.point_index]] = reconstruction.inlier
    return replace(reconstruction, X=X, valid=valid, inlier=inlier, tracks=tracks)
