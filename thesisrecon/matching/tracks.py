"""From pairs to scene points: chains of verified matches, each aligned towards its middle view."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from thesisrecon.matching.alignment import align_corners
from thesisrecon.matching.linking import Chains, link_matches, maps_to_views
from thesisrecon.matching.prepared import PreparedView
from thesisrecon.types import B8, F64, I64, Tracks, TwoView
from thesisrecon.visits import order_of_visits


@dataclass(frozen=True)
class PlainTracks:
    """Tracks as the matches give them: each observation stands at its corner."""

    def build(
        self, prepared: Sequence[PreparedView], pairs: Sequence[TwoView], rng: np.random.Generator
    ) -> Tracks:
        """Scene points seen in at least two views; a track never has two corners in one view."""
        del rng
        corners = [p.features.xy for p in prepared]
        chains = link_matches([len(xy) for xy in corners], [p for p in pairs if p.accepted])
        xy = np.concatenate([*corners, np.empty((0, 2))])[chains.node]
        return _tracks(chains, xy, np.ones(len(xy), np.bool_), len(prepared))


@dataclass(frozen=True)
class AlignedTracks:
    """Tracks whose observations are aligned by least squares with the window of their middle view.

    Parameters
    ----------
    least_correlation : after alignment; an observation below it is dropped.
    affine_std : prior standard deviation of an affine coefficient in the alignment.
    largest_shift : in pixels of the corner's scale.
    """

    least_correlation: float = 0.8
    affine_std: float = 0.02
    largest_shift: float = 3.0

    def build(
        self, prepared: Sequence[PreparedView], pairs: Sequence[TwoView], rng: np.random.Generator
    ) -> Tracks:
        """Scene points seen in at least two views, every observation of a track at the same sub-pixel spot.

        The middle view of a track is the one with most direct matches in it; the local maps to the other
        views are chained along the matches.
        """
        del rng
        accepted = [p for p in pairs if p.accepted]
        corners = [p.features.xy for p in prepared]
        chains = link_matches([len(xy) for xy in corners], accepted)
        start, affine, middle = maps_to_views(chains, corners, accepted)
        xy, kept = start.copy(), np.ones(len(start), np.bool_)
        for i, j, group in _groups(chains.view[middle], chains.view, len(prepared)):
            view1, view2 = prepared[i], prepared[j]
            corner = chains.corner[middle[group]]
            found, _, score = align_corners(
                view1,
                view2,
                (view1.features.xy[corner], view1.features.scale[corner], start[group], affine[group]),
                affine_std=self.affine_std,
                largest_shift=self.largest_shift,
            )
            xy[group], kept[group] = found, score >= self.least_correlation
        return _tracks(chains, xy, kept, len(prepared))


def _groups(first: I64, second: I64, views: int) -> Iterator[tuple[int, int, I64]]:
    """The observations of each two different views (i, j), found by one sort and not by a search per pair,
    in an order in which what is prepared of a view serves again."""
    pair = first * views + second
    order = np.flatnonzero(first != second)
    order = order[np.argsort(pair[order], kind="stable")]
    numbers, starts = np.unique(pair[order], return_index=True)
    groups = np.split(order, starts[1:]) if len(numbers) else []
    i, j = np.divmod(numbers, views)
    for k in order_of_visits(i, j):
        yield int(i[k]), int(j[k]), groups[k]


def _tracks(chains: Chains, xy: F64, kept: B8, n_views: int) -> Tracks:
    """Observations of the tracks that still have two views, tracks numbered anew."""
    sizes = np.bincount(chains.track[kept], minlength=chains.count)
    use = kept & (sizes[chains.track] >= 2)
    number = np.cumsum(sizes >= 2) - 1
    point, view, place = number[chains.track[use]], chains.view[use], xy[use]
    order = np.lexsort((view, point))
    return Tracks(
        view_index=view[order].astype(np.int64),
        point_index=point[order].astype(np.int64),
        xy=np.ascontiguousarray(place[order]),
        n_views=n_views,
        n_points=int((sizes >= 2).sum()),
    )
