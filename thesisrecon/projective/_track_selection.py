"""Track selection for projective reconstruction: with parallax, long, spread over every image (6.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.projective._initial_pair import NO_PARALLAX
from thesisrecon.records import Reconstruction, Tracks, TwoView

# Cells of the grid over an image, along each side.
_CELLS = 8


def select_tracks_with_parallax(tracks: Tracks, pairs: Sequence[TwoView]) -> B8:
    """Select tracks (N,) that are seen from more than one position.

    A pair that a homography explains shows its points without parallax or on one plane: their depths are free
    and would distort the frame in which cameras are tested. The metric stage adds them again.
    """
    apart = np.ones((tracks.n_views, tracks.n_views), dtype=np.float32)
    np.fill_diagonal(apart, 0.0)
    for pair in pairs:
        if pair.accepted and pair.homography_inlier_ratio >= NO_PARALLAX:
            apart[pair.i, pair.j] = apart[pair.j, pair.i] = 0.0
    seen = np.zeros((tracks.n_views, tracks.n_points), dtype=np.float32)
    seen[tracks.view_index, tracks.point_index] = 1.0
    return np.asarray(((apart @ seen) * seen).any(axis=0))


def select_tracks(tracks: Tracks, usable: B8, *, points_per_view: int) -> B8:
    """Select the longest of the ``usable`` tracks (N,), spread over each image.

    Each image is divided into a grid over the extent of its points; longest tracks come first within a cell,
    and all cells contribute in turn.
    """
    length = np.bincount(tracks.point_index, minlength=tracks.n_points)
    keep = np.zeros(tracks.n_points, dtype=bool)
    for view in range(tracks.n_views):
        k = np.flatnonzero((tracks.view_index == view) & usable[tracks.point_index])
        keep[tracks.point_index[k][_by_cell_and_length(tracks, k, length)[:points_per_view]]] = True
    return keep


def _by_cell_and_length(tracks: Tracks, k: I64, length: I64) -> I64:
    """Return the order of the observations k: one of each cell in turn, longest tracks first."""
    if len(k) == 0:
        return k
    xy = tracks.xy[k]
    low, high = xy.min(axis=0), xy.max(axis=0)
    cell = np.minimum((xy - low) / np.maximum(high - low, 1e-9) * _CELLS, _CELLS - 1).astype(np.int64)
    cell_number = cell[:, 0] * _CELLS + cell[:, 1]
    by_length = np.lexsort((k, -length[tracks.point_index[k]], cell_number))
    sorted_cells = cell_number[by_length]
    start = np.searchsorted(sorted_cells, sorted_cells)
    rank = np.arange(len(k)) - start
    return by_length[np.lexsort((by_length, -length[tracks.point_index[k]][by_length], rank))]


def observation_cells(tracks: Tracks) -> I64:
    """Return the grid cell (K,) of each observation in the extent of its view, consecutive over all views."""
    low, high = np.full((2, tracks.n_views, 2), np.inf)
    np.minimum.at(low, tracks.view_index, tracks.xy)
    np.minimum.at(high, tracks.view_index, -tracks.xy)
    view, extent = tracks.view_index, np.maximum(-high - low, 1e-9)
    cell = np.minimum((tracks.xy - low[view]) / extent[view] * _CELLS, _CELLS - 1).astype(np.int64)
    return np.asarray((view * _CELLS + cell[:, 0]) * _CELLS + cell[:, 1], dtype=np.int64)


def coverage_of_views(cell: I64, chosen: B8, n_views: int) -> F64:
    """Return the coverage (V,) of each view: the sum over its cells of the root of chosen observations."""
    counts = np.bincount(cell[chosen], minlength=n_views * _CELLS**2).reshape(n_views, -1)
    return np.asarray(np.sqrt(counts).sum(axis=1))


def working_tracks(tracks: Tracks, pairs: Sequence[TwoView], *, points_per_view: int) -> tuple[Tracks, B8]:
    """Return the selected tracks with parallax, renumbered in the same order, and which (N,) they are."""
    usable = select_tracks_with_parallax(tracks, pairs)
    keep = select_tracks(tracks, usable, points_per_view=points_per_view)
    chosen = keep[tracks.point_index]
    point = (np.cumsum(keep) - 1)[tracks.point_index[chosen]]
    return Tracks(tracks.view_index[chosen], point, tracks.xy[chosen], tracks.n_views, int(keep.sum())), keep


def expand_to_all_tracks(reconstruction: Reconstruction, tracks: Tracks, keep: B8) -> Reconstruction:
    """Express the reconstruction of :func:`working_tracks` in the numbers of all tracks."""
    X = np.zeros((tracks.n_points, 4))
    X[keep] = reconstruction.X
    valid = np.zeros(tracks.n_points, dtype=bool)
    valid[keep] = reconstruction.valid
    inlier = np.zeros(len(tracks.xy), dtype=bool)
    inlier[keep[tracks.point_index]] = reconstruction.inlier
    return replace(reconstruction, X=X, valid=valid, inlier=inlier, tracks=tracks)
