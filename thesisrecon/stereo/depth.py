"""Depth maps of all views: each from its neighbours, then held against the others."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
import scipy
from numpy.typing import ArrayLike

from thesisrecon.arrays import B8, F32, F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.records import DepthMap, DisparityMap, Image, PinholeView, Reconstruction
from thesisrecon.stereo.correspondence import (
    Correspondence,
    PairMatching,
    RectifiedPair,
    match_two_views,
    size_of,
)
from thesisrecon.stereo.depth_fusion import InverseDepth, RobustFusion, SequenceLinking
from thesisrecon.stereo.depth_kernels import DepthStd, count_agreement, splat_depths, surface_continuation
from thesisrecon.stereo.neighbours import (
    NeighbourSelection,
    SparsePoints,
    pinhole_view,
    shared_projections,
    sparse_points,
)
from thesisrecon.stereo.plane_refinement import ALIKE, PlaneRefinement
from thesisrecon.stereo.semi_global import match_rectified

Result = TypeVar("Result")
SURE = 3.0
"""Deviations by which an inverse depth is above that of infinity."""


@dataclass(frozen=True)
class GeometricConsistency:
    """Reprojection both ways (as Merrell et al., ICCV 2007, and COLMAP's fusion have it) and speckles.

    A pixel is taken to another view by its depth, and that view's depth brings it back. It is confirmed
    where it returns within ``reprojection_px`` and both depths differ by at most ``relative`` plus
    ``deviations`` of their deviations; it is contradicted where the other view sees through it. A pixel
    stays if at least ``least_views`` confirm it and more than contradict it, or if none contradicts it and it
    continues the surface of those about it: within ``gate`` deviations of the plane through the pixels within
    ``radius``. Connected pieces of fewer than
    ``smallest_piece`` of the pixels, across which depth changes by less than ``step`` from pixel to pixel,
    go.
    """

    reprojection_px: float = 1.5
    max_relative: float = 0.01
    max_sigmas: float = 2.0
    min_views: int = 1
    min_region_ratio: float = 1e-4
    step: float = 0.02
    radius: int = 5
    gate: float = 2.0

    def confirm(self, depth_map: DepthMap, others: Sequence[DepthMap]) -> DepthMap:
        """``depth_map`` where ``others`` confirm it, with their number in ``views``."""
        agree = np.zeros(depth_map.depth.shape, dtype=np.uint8)
        contradict = np.zeros_like(agree)
        limits = np.array([self.reprojection_px, self.max_relative, self.max_sigmas])
        for other in others:
            count_agreement(
                DepthStd(depth_map.depth, depth_map.std),
                transfer(depth_map.P, other.P),
                DepthStd(other.depth, other.std),
                transfer(other.P, depth_map.P),
                limits,
                agree,
                contradict,
            )
        keep = (agree >= self.min_views) & (agree > contradict)
        keep |= (contradict == 0) & self.continues_surface(depth_map, keep)
        return self.remove_small_regions(_kept(replace(depth_map, views=np.maximum(agree, 1)), keep))

    def continues_surface(self, depth_map: DepthMap, sure: B8) -> B8:
        """(H, W) pixels that continue the surface of those that are ``sure``."""
        with np.errstate(divide="ignore"):
            rho = (1.0 / depth_map.depth).astype(np.float32)
        joins = np.zeros(sure.shape, dtype=np.uint8)
        std = depth_map.std * rho * rho
        surface_continuation(rho, std, sure.astype(np.uint8), self.radius, ALIKE, self.gate, joins)
        return joins > 0

    def remove_small_regions(self, depth_map: DepthMap) -> DepthMap:
        """Without small pieces."""
        least = self.min_region_ratio * depth_map.depth.size
        return _kept(depth_map, region_sizes(depth_map.depth, self.step) >= least)


def transfer(P: F64, P_other: F64) -> F64:
    """(3, 4) that takes (z x, z y, z, 1) of one camera to z' (x', y', 1) of the other."""
    M = np.linalg.inv(P[:, :3])
    centre = camera_centre(P)
    return np.column_stack([P_other[:, :3] @ M, P_other @ (centre / centre[3])])


def region_sizes(depth: F32, step: float) -> F64:
    """(H, W) pixels of the connected piece that each belongs to, 0 where unknown.

    Neighbours are connected where their depths differ by at most ``step`` of either.
    """
    number = np.arange(depth.size).reshape(depth.shape)
    log = np.log(depth)
    pairs = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        # A comparison with NaN is false.
        joined = np.abs(log[a] - log[b]) <= step
        pairs.append(np.stack([number[a][joined], number[b][joined]]))
    row, column = np.concatenate(pairs, axis=1)
    graph = scipy.sparse.coo_matrix(
        (np.ones(len(row), dtype=bool), (row, column)), shape=(depth.size, depth.size)
    )
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    sizes = np.bincount(label)[label].reshape(depth.shape)
    return np.where(np.isfinite(depth), sizes, 0.0)


def _kept(depth_map: DepthMap, keep: B8) -> DepthMap:
    return replace(
        depth_map,
        depth=np.where(keep, depth_map.depth, np.float32(np.nan)),
        std=np.where(keep, depth_map.std, np.float32(np.nan)),
        views=np.where(keep, depth_map.views, np.uint8(0)),
    )


@dataclass(frozen=True)
class DepthCompletion:
    """Depths for what is hidden from all neighbours of a view but measured by others that it shares it with.

    The maps of other views are taken to a view; where it has no depth their nearest one is offered to
    the search for slanted windows, against the ``most`` photographs whose maps offer most. What the windows
    accept (the rule of :class:`PlaneRefinement`) is depth as good as any: nothing is interpolated. Gaps of
    ``gap_px`` between offered pixels are searched too, for maps differ in resolution.
    """

    max_sources: int = 4
    gap_px: int = 1
    sweeps: int = 2

    def complete(
        self,
        own: DepthMap,
        others: Sequence[DepthMap],
        views: Mapping[int, PinholeView],
        *,
        refinement: PlaneRefinement,
    ) -> DepthMap:
        """``own`` with depths of more pixels, from the maps ``others`` and the photographs ``views``."""
        unknown = np.isnan(own.depth) & views[own.view].seen
        offers = []
        for other in others:
            offer = np.full_like(own.depth, np.nan)
            splat_depths(other.depth, transfer(other.P, own.P), offer)
            offers.append(np.where(unknown, offer, np.float32(np.nan)))
        worth = [int(np.isfinite(offer).sum()) for offer in offers]
        best = [k for k in sorted(range(len(offers)), key=lambda k: (-worth[k], k)) if worth[k]][
            : self.max_sources
        ]
        if not best:
            return own
        nearest = np.fmin.reduce([offers[k] for k in best])
        wanted = unknown & scipy.ndimage.binary_dilation(np.isfinite(nearest), np.ones((3, 3)), self.gap_px)
        rho = (np.float32(1.0) / np.where(unknown, nearest, own.depth)).astype(np.float32)
        photographs = [views[others[k].view] for k in best]
        found = refinement.search(views[own.view], photographs, rho, wanted=wanted, sweeps=self.sweeps)
        return _with(own, *found)


def _with(own: DepthMap, rho: F32, std: F32, support: np.ndarray) -> DepthMap:
    """The map with inverse depths where they are known."""
    new = np.isfinite(rho)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(1.0) / rho
        std = std * depth * depth
    return replace(
        own,
        depth=np.where(new, depth, own.depth),
        std=np.where(new, std, own.std),
        views=np.where(new, support, own.views).astype(np.uint8),
    )


@dataclass(frozen=True)
class MultiViewScene:
    """What the views share: ``views`` without distortion by number, the sparse ``points``, the ``neighbours``
    of each view, the best first, and views ``matched`` at another size than that of their depth maps."""

    views: Mapping[int, PinholeView]
    points: SparsePoints
    neighbours: Mapping[int, tuple[int, ...]]
    matched: Mapping[int, PinholeView] = field(default_factory=dict)

    def subset(self, numbers: Collection[int]) -> MultiViewScene:
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
    selection: NeighbourSelection = field(default_factory=NeighbourSelection)
    linker: RobustFusion | SequenceLinking = field(default_factory=RobustFusion)
    refinement: PlaneRefinement | None = field(default_factory=PlaneRefinement)
    consistency: GeometricConsistency = field(default_factory=GeometricConsistency)
    completion: DepthCompletion | None = field(default_factory=DepthCompletion)
    min_comparison_views: int = 12
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
        chosen = {i: tuple(self.selection.select(points, views, i)) for i in views}
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
            found = found.where(~found.contradictory)
        else:
            others = [scene.views[j] for j in scene.neighbours[view]]
            found = self.refinement.refine(scene.views[view], others, found)
        return self.consistency.remove_small_regions(_depth_map(scene.views[view], found))

    def confirm(self, scene: MultiViewScene, depth_maps: Mapping[int, DepthMap], view: int) -> DepthMap:
        """The map of ``view`` with what the maps of other views confirm; see :class:`Consistency`."""
        others = [depth_maps[j] for j in self.comparison_views(scene, view) if j in depth_maps]
        own = depth_maps[view]
        if self.completion is not None and self.refinement is not None:
            own = self.completion.complete(own, others, scene.views, refinement=self.refinement)
        return self.consistency.confirm(own, others)

    def required_views(self, scene: MultiViewScene, view: int) -> frozenset[int]:
        """The views whose photographs :meth:`depth_map` and :meth:`confirm` of ``view`` look at, itself among
        them."""
        near = scene.neighbours[view]
        reached = self.linker.views_used(view, scene.views, near)
        return frozenset({view, *near, *reached, *self.comparison_views(scene, view)})

    def comparison_views(self, scene: MultiViewScene, view: int) -> tuple[int, ...]:
        """Views whose maps are held against that of ``view``: its neighbours, those it is one of, and as
        many more as make ``least_partners``, those with most points in common."""
        mutual = {j for j, chosen in scene.neighbours.items() if view in chosen}
        comparison_views = (mutual | set(scene.neighbours[view])) - {view}
        seen = scene.points.seen
        common = {
            j: int(np.sum(seen[view] & seen[j])) for j in scene.views if j not in comparison_views | {view}
        }
        order = sorted((j for j in common if common[j]), key=lambda j: (-common[j], j))
        return tuple(
            sorted(comparison_views | set(order[: max(self.min_comparison_views - len(comparison_views), 0)]))
        )

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
