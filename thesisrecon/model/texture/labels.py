"""Which photograph each face takes its texture from."""

from __future__ import annotations

import numpy as np
import scipy

from thesisrecon.model.texture.kernels import spread_shares
from thesisrecon.types import F32, I64

OWN = 0.1
"""Weight of a face's own shares against those of its neighbours."""


def choose_views(quality: F32, neighbours: I64, *, rounds: int = 40, least_faces: int = 30) -> I64:
    """(M,) view of each face, -1 where none sees it.

    Each face alone would take the view that shows it largest, and the surface would be a patchwork. Shares of
    the largest are therefore spread over neighbouring faces, ``rounds`` faces far, among views that see them;
    charts of fewer than ``least_faces`` faces then join the neighbour with the longest common border that
    sees them.
    ``quality`` (M, V) pixels covered, ``neighbours`` (M, 3) across each side or -1.
    """
    if not quality.size:
        return np.full(len(quality), -1, dtype=np.int64)
    visible = quality > 0.0
    share = quality / np.maximum(quality.max(axis=1, keepdims=True), np.float32(1e-20))
    spread, other = share.copy(), np.empty_like(share)
    for _ in range(rounds):
        spread_shares(share, neighbours, OWN, spread, other)
        spread, other = other, spread
    label = np.where(visible.any(axis=1), spread.argmax(axis=1), -1)
    # Where spreading left nothing of any view, the largest decides.
    lost = visible.any(axis=1) & (spread.max(axis=1) <= 0.0)
    label[lost] = share[lost].argmax(axis=1)
    for _ in range(3):
        label = _join_small(label, visible, neighbours, least_faces)
    return label.astype(np.int64)


def charts_of(label: I64, neighbours: I64) -> I64:
    """(M,) number of the chart of each face: connected faces of one label."""
    face = np.repeat(np.arange(len(label)), 3)
    other = neighbours.ravel()
    same = (other >= 0) & (label[face] == label[other])
    graph = scipy.sparse.coo_array(
        (np.ones(same.sum(), dtype=np.int8), (face[same], other[same])), shape=(len(label),) * 2
    )
    return np.asarray(scipy.sparse.csgraph.connected_components(graph, directed=False)[1], dtype=np.int64)


def _join_small(label: I64, visible: np.ndarray, neighbours: I64, least_faces: int) -> I64:
    chart = charts_of(label, neighbours)
    faces = np.bincount(chart)
    small = (faces[chart] < least_faces) & (label >= 0)
    # A chart can take over a view that sees all of its faces.
    sees = np.ones((len(faces), visible.shape[1]), dtype=bool)
    np.logical_and.at(sees, chart[small], visible[small])
    border = np.zeros((len(faces), visible.shape[1]))
    for k in range(3):
        other = neighbours[:, k]
        crossing = small & (other >= 0) & (label[other] >= 0) & (label[other] != label)
        np.add.at(border, (chart[crossing], label[other[crossing]]), 1.0)
    border[~sees] = 0.0
    joins = small & (border[chart].max(axis=1) > 0.0)
    return np.where(joins, border[chart].argmax(axis=1), label)
