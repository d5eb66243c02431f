"""Depth maps of all views: each from its neighbours, then held against the others."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from thesisrecon.arrays import F64
from thesisrecon.errors import StageFailure
from thesisrecon.records import DepthMap, DisparityMap, Image, PinholeView, Reconstruction
from thesisrecon.stereo.consistency import Completion, Consistency
from thesisrecon.stereo.correspondence import (
    Correspondence,
    PairMatching,
    RectifiedPair,
    match_two_views,
    size_of,
)
from thesisrecon.stereo.depth_fusion import InverseDepth, RobustFusion, SequenceLinking
from thesisrecon.stereo.neighbours import (
    NeighbourChoice,
    SparsePoints,
    pinhole_view,
    shared_projections,
    sparse_points,
)
from thesisrecon.stereo.plane_refinement import PlaneRefinement
from thesisrecon.stereo.semi_global import match_rectified

Result = TypeVar("Result")
SURE = 3.0
"""Deviations by which an inverse depth is above that of infinity."""


@dataclass(frozen=True)
class MultiViewScene:
    """What the views share: ``views`` without distortion by number, the sparse ``points``, the ``neighbours``
    of each view, the best first, and views ``matched`` at another size than that of their depth maps."""

    views: Mapping[int, PinholeView]
    points: SparsePoints
    neighbours: Mapping[int, tuple[int, ...]]
    matched: Mapping[int, PinholeView] = field(default_factory=dict)

    def part(self, numbers: Collection[int]) -> MultiViewScene:
        """The photographs of these views alone, and the points that they see: enough for the map of a view
        with its :meth:`MultiViewStereo.surroundings`, and much less to send."""
        views, matched = (
            {i: view for i, view in given.items() if i in numbers} for given in (self.views, self.matched)
        )
        seen = self.points.seen[sorted(numbers)].any(axis=0)
        points = SparsePoints(self.points.X[seen], self.points.seen[:, seen])
        return MultiViewScene(views, points, self.neighbours, matched)


@dataclass(frozen=True)
class MultiViewStereo:
    """Depth maps from undistorted views (thesis, section 2.6: dense depth from all photographs).

    ``pairs`` finds correspondences, ``choice`` the neighbours, ``linker`` makes one inverse depth of what
    they say, ``refinement`` (None: none) makes it agree with the photographs, ``consistency`` holds the maps
    of at least ``least_partners`` views, as far as there are, against each other once ``completion`` (None:
    none) has taken from them what a view lacks. ``max_side`` px bounds the size of the depth maps,
    ``match_side`` px that at which pairs are matched: windows that do not slant find less in larger
    pictures, and the refinement works out what the smaller ones lack. One view's map depends on
    nothing but the photographs and cameras, so views can be done in any order, by any number of threads and
    in several runs: :meth:`prepare`, :meth:`depth_map` of each, :meth:`confirm` of each.
    """

    pairs: PairMatching = field(default_factory=PairMatching)
    choice: NeighbourChoice = field(default_factory=NeighbourChoice)
    linker: RobustFusion | SequenceLinking = field(default_factory=RobustFusion)
    refinement: PlaneRefinement | None = field(default_factory=PlaneRefinement)
    consistency: Consistency = field(default_factory=Consistency)
    completion: Completion | None = field(default_factory=Completion)
    least_partners: int = 12
    max_side: int = 1024
    match_side: int = 640

    def match_rectified(self, left: ArrayLike, right: ArrayLike, *, max_disparity_px: float) -> DisparityMap:
        """Disparities of a rectified pair of arrays by the matcher of ``pairs``."""
        return match_rectified(left, right, max_disparity_px=max_disparity_px, matcher=self.pairs.matcher)

    def match_two_views(
        self, image1: Image, image2: Image, F: F64, xy1: F64, xy2: F64, *, planar: bool = False
    ) -> RectifiedPair:
        """Dense correspondence of two photographs with F and its inliers; see :func:`match_two_views`."""
        return match_two_views(image1.rgb, image2.rgb, F, xy1, xy2, pairs=self.pairs, planar=planar)

    def prepare(self, images: Sequence[Image], reconstruction: Reconstruction) -> MultiViewScene:
        """Undistorted views, sparse points and neighbours of V photographs with a metric reconstruction.

        Raises ``ValueError`` for reconstructions that are not metric or of other photographs.
        """
        if len(images) != len(reconstruction.P):
            raise ValueError(f"{len(reconstruction.P)} cameras need as many photographs; got {len(images)}")
        points = sparse_points(reconstruction)
        views, matched = (
            {
                i: pinhole_view(image, reconstruction, i, max_side=side)
                for i, image in enumerate(images)
                if reconstruction.registered[i]
            }
            for side in (self.max_side, min(self.match_side, self.max_side))
        )
        chosen = {i: tuple(self.choice.choose(points, views, i)) for i in views}
        return MultiViewScene(views, points, chosen, matched)

    def depth_map(self, scene: MultiViewScene, view: int) -> DepthMap:
        """Depths of one view from its neighbours, before other depth maps are asked.

        NaN where unknown; nothing but NaN for a view without neighbours or whose pairs all fail. ``views``
        counts the neighbours that agree. ``ValueError`` for a view without a camera.
        """
        if view not in scene.views:
            raise ValueError(f"view {view} has no camera; those with one are {sorted(scene.views)}")

        def correspond(i: int, j: int) -> Correspondence | None:
            a, b = (scene.matched.get(k, scene.views[k]) for k in (i, j))
            sizes = size_of(scene.views[i]), size_of(scene.views[j])
            try:
                return self.pairs.correspond(a, b, *shared_projections(scene.points, a, b), sizes=sizes)
            except StageFailure:
                return None

        found = self.linker.link(view, scene.views, scene.neighbours[view], correspond)
        if self.refinement is None:
            found = found.where(~found.divided)
        else:
            others = [scene.views[j] for j in scene.neighbours[view]]
            found = self.refinement.refine(scene.views[view], others, found)
        return self.consistency.clean(_depth_map(scene.views[view], found))

    def confirm(self, scene: MultiViewScene, depth_maps: Mapping[int, DepthMap], view: int) -> DepthMap:
        """The map of ``view`` with what the maps of other views confirm; see :class:`Consistency`."""
        others = [depth_maps[j] for j in self.partners(scene, view) if j in depth_maps]
        own = depth_maps[view]
        if self.completion is not None and self.refinement is not None:
            own = self.completion.complete(own, others, scene.views, refinement=self.refinement)
        return self.consistency.confirm(own, others)

    def surroundings(self, scene: MultiViewScene, view: int) -> frozenset[int]:
        """The views whose photographs :meth:`depth_map` and :meth:`confirm` of ``view`` look at, itself among
        them."""
        near = scene.neighbours[view]
        reached = self.linker.reach(view, scene.views, near)
        return frozenset({view, *near, *reached, *self.partners(scene, view)})

    def partners(self, scene: MultiViewScene, view: int) -> tuple[int, ...]:
        """Views whose maps are held against that of ``view``: its neighbours, those it is one of, and as
        many more as make ``least_partners``, those with most points in common."""
        mutual = {j for j, chosen in scene.neighbours.items() if view in chosen}
        partners = (mutual | set(scene.neighbours[view])) - {view}
        seen = scene.points.seen
        common = {j: int(np.sum(seen[view] & seen[j])) for j in scene.views if j not in partners | {view}}
        order = sorted((j for j in common if common[j]), key=lambda j: (-common[j], j))
        return tuple(sorted(partners | set(order[: max(self.least_partners - len(partners), 0)])))

    def map_all(
        self, images: Sequence[Image], reconstruction: Reconstruction, *, threads: int = 1
    ) -> dict[int, DepthMap]:
        """Confirmed depth maps of all registered views by number; the same whatever the number of threads."""
        scene = self.prepare(images, reconstruction)
        order = sorted(scene.views)
        found = dict(zip(order, _run(lambda i: self.depth_map(scene, i), order, threads), strict=True))
        return dict(zip(order, _run(lambda i: self.confirm(scene, found, i), order, threads), strict=True))


def _depth_map(view: PinholeView, found: InverseDepth) -> DepthMap:
    """Depths of inverse depths; those that cannot be told from infinity are none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        known = (found.value > SURE * found.std) & view.seen
        depth = np.where(known, 1.0 / found.value, np.nan).astype(np.float32)
        std = np.where(known, found.std * depth * depth, np.nan).astype(np.float32)
    return DepthMap(view.view, view.P, depth, std, np.where(known, found.views, 0).astype(np.uint8))


def _run(work: Callable[[int], Result], items: Iterable[int], threads: int) -> list[Result]:
    if threads < 2:
        return [work(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, items))
