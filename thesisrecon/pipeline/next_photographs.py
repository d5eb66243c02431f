"""Which photographs would join the images that a model lacks, by its accepted and rejected pairs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from thesisrecon.errors import Notice, counted
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.matching.pair_selection import connected_groups
from thesisrecon.records import Reconstruction, TwoView

MOST = 3  # parts of the set for which a photograph is named, the largest first
CHANCE = 2.0
"""A rejected pair tells which images are close if it has so many times the verified matches of most rejected
pairs; else the order of the names does."""


def next_photographs(
    model: Reconstruction, pairs: Sequence[TwoView], names: Sequence[str]
) -> Iterator[Notice]:
    """Between which images photographs join each part that is left out, and the angle from each."""
    here, t = model.registered, model.tracks
    accepted = [p for p in pairs if p.accepted]
    C, X, middle = np.zeros((len(here), 3)), dehomogenize(model.X), np.zeros((len(here), 3))
    C[here] = dehomogenize(camera_centre(model.P[here]))
    view, point = t.view_index[model.used], t.point_index[model.used]
    for v in np.unique(view):
        middle[v] = np.median(X[point[view == v]], axis=0)
    joined = [p for p in accepted if here[p.i] and here[p.j]]
    if not joined or here.all():
        return
    a, b = np.array([C[[p.i, p.j]] - middle[p.i] for p in joined]).swapaxes(0, 1)
    angles = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("pi,pi->p", a, b)))
    usual = np.quantile([p.inliers for p in joined], 0.1)
    label = connected_groups(len(here), [(p.i, p.j) for p in accepted if not (here[p.i] or here[p.j])])
    chance = np.median([p.inliers for p in pairs if not p.accepted] or [0])
    parts = sorted(np.unique(label[~here]), key=lambda part: -np.count_nonzero(label == part))
    for part in parts[:MOST]:
        inside = label == part
        links = [p for p in pairs if (inside[p.i] and here[p.j]) or (here[p.i] and inside[p.j])]
        best = max(links, key=lambda p: p.inliers, default=None)
        # Matched like images of the model: their reasons tell why they are left out.
        if best is not None and best.accepted and best.inliers >= usual:
            continue
        if best is not None and best.inliers > CHANCE * max(chance, 1.0):
            ends, why = (best.i, best.j), f"{best.inliers} of their matches agree, too few to join them"
        else:
            a, b = np.flatnonzero(inside), np.flatnonzero(here)
            nearest = np.abs(a[:, None] - b)
            i, j = np.unravel_index(int(nearest.argmin()), nearest.shape)
            ends, why = (a[i], b[j]), "they are next to each other by name"
        first, second = (names[k] for k in sorted(ends))
        most = np.quantile(angles, 0.95)
        count = counted(int(inside.sum()), "image")
        yield Notice("photograph-next", count, first, second, float(np.median(angles)), why, most)
