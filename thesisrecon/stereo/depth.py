"""Multi-view stereo: depth maps from neighbouring views, and their consistency (thesis, section 2.6)."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike

from thesisrecon.arrays import B8, F32, F64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.imaging.on_demand import MappingOnDemand
from thesisrecon.imaging.resampling import pinhole_frame, pinhole_view
from thesisrecon.records import DepthMap, DisparityMap, Image, PinholeView, Reconstruction
from thesisrecon.stereo._depth_fusion import InverseDepth, fuse_neighbours, link_sequence, pixel_transfer
from thesisrecon.stereo._depth_kernels import count_agreement, splat_depths, surface_continuation
from thesisrecon.stereo._frustum_samples import frustum_samples, project_inside
from thesisrecon.stereo._plane_refinement import ALIKE, refine_depths, search_planes
from thesisrecon.stereo.correspondence import Correspondence, PairMatching, RectifiedPair

BEST_DEG, SIGMA_BELOW_DEG, SIGMA_ABOVE_DEG = 10.0, 3.0, 10.0
"""Triangulation angle of the greatest weight, and the decay of the weight for smaller and larger ones."""
MIN_ANGLE_DEG, MIN_POINTS = 1.0, 12
"""A neighbour has at least ``MIN_POINTS`` common points with triangulation angles of ``MIN_ANGLE_DEG``."""
MIN_SIDE = 64
"""Lower limit of the settings for the longest side of depth maps and of images for matching, in pixels."""
VIEW_BYTES = 2**29
"""Memory for undistorted views at each of the two sizes; others are computed again when they are used."""


@dataclass(frozen=True)
class SparsePoints:
    """Points of a metric reconstruction, or samples of the common frusta."""

    X: F64  #: (N, 3)
    seen: B8  #: (V, N) whether a view observes a point
    sampled: bool = False  #: samples: only those that both views show limit the disparities of a pair


def _sparse_points(reconstruction: Reconstruction) -> SparsePoints:
    """The valid points of a metric reconstruction with their inlier observations."""
    tracks = reconstruction.tracks
    seen = np.zeros((tracks.n_views, tracks.n_points), dtype=bool)
    good = reconstruction.inlier
    seen[tracks.view_index[good], tracks.point_index[good]] = True
    seen &= reconstruction.registered[:, None]
    valid = reconstruction.valid
    return SparsePoints(reconstruction.X[valid, :3] / reconstruction.X[valid, 3:], seen[:, valid])


def _shared_projections(points: SparsePoints, a: PinholeView, b: PinholeView) -> tuple[F64, F64]:
    """Pixels (N, 2) in two views of the points that at least one of them observes, if inside both images."""
    seen = points.seen[a.view], points.seen[b.view]
    X = points.X[seen[0] & seen[1] if points.sampled else seen[0] | seen[1]]
    (xy_a, inside_a), (xy_b, inside_b) = (project_inside(view, X) for view in (a, b))
    keep = inside_a & inside_b
    return xy_a[keep], xy_b[keep]


def _select_neighbours(
    points: SparsePoints, views: Mapping[int, PinholeView], view: int, max_neighbours: int = 4
) -> tuple[int, ...]:
    """Select the neighbours of a view greedily, the most useful first.

    The weight of a common point is a Gaussian of its triangulation angle. Points that earlier neighbours
    observe count less, and so does a view whose baseline has the direction of an earlier one, because views
    from other sides see surfaces that are occluded here.
    """
    own = np.flatnonzero(points.seen[view])
    points = replace(points, X=points.X[own], seen=points.seen[:, own])
    centres = {i: dehomogenize(camera_centre(views[i].P)) for i in views}
    worth: dict[int, F64] = {}
    direction: dict[int, F64] = {}
    for other in sorted(views.keys() - {view}):
        weight = _weights(points, centres, view, other)
        if weight is not None:
            worth[other] = weight
            baseline = centres[other] - centres[view]
            direction[other] = baseline / np.linalg.norm(baseline)
    served = np.zeros(len(points.X))
    chosen: list[int] = []
    while worth and len(chosen) < max_neighbours:
        gains = {
            j: float(np.sum(np.sqrt(served + w) - np.sqrt(served)))
            * 0.7 ** sum(direction[j] @ direction[c] > 0.5 for c in chosen)
            for j, w in worth.items()
        }
        best_neighbour = max(gains, key=lambda j: (gains[j], -j))
        served += worth.pop(best_neighbour)
        chosen.append(best_neighbour)
    return tuple(chosen)


def _weights(points: SparsePoints, centres: Mapping[int, F64], view: int, other: int) -> F64 | None:
    """Weights (N,) of the points that ``other`` sees too, None if it cannot be a neighbour."""
    common = points.seen[other]
    if int(common.sum()) < MIN_POINTS:
        return None
    a, b = (points.X[common] - centres[i] for i in (view, other))
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    angle = np.degrees(np.arctan2(sine, np.sum(a * b, axis=1)))
    if int(np.sum(angle >= MIN_ANGLE_DEG)) < MIN_POINTS:
        return None
    off = angle - BEST_DEG
    width = np.where(off < 0.0, SIGMA_BELOW_DEG, SIGMA_ABOVE_DEG)
    weights = np.zeros(len(points.X))
    weights[common] = np.where(angle >= MIN_ANGLE_DEG, np.exp(-0.5 * (off / width) ** 2), 0.0)
    return weights


SURE = 3.0
"""Standard deviations by which an inverse depth must exceed 0, that of infinity."""
REPROJECTION_PX, MAX_RELATIVE, MAX_SIGMAS = 1.5, 0.01, 2.0
"""Limits of the reprojection error, and of the depth difference: a share plus standard deviations."""
MIN_VIEWS = 1
"""Views that must confirm a pixel."""
MIN_REGION_RATIO, STEP = 1e-4, 0.02
"""Connected regions below this share of the pixels are removed; relative depth step in a region."""
RADIUS, GATE = 5, 2.0
"""Window of the surface continuation, and distance from its plane in standard deviations."""
MAX_SOURCES = 4
"""Largest number of views from which a depth map is completed."""
GAP_PX, SWEEPS = 1, 2
"""Size of the gaps between projected pixels that completion fills, and number of passes of its search."""


def _confirm_depths(depth_map: DepthMap, others: Sequence[DepthMap]) -> DepthMap:
    """Keep the depths that the depth maps of other views confirm.

    A pixel is projected into another view, and the depth there is projected back (Merrell et al., ICCV 2007;
    fusion in COLMAP). It is confirmed if both agree and contradicted if the other view sees through it. It is
    kept if at least ``MIN_VIEWS`` views and more than contradict it confirm it, or if none contradicts it and
    it continues the surface of confirmed pixels. ``views`` becomes the number of confirming views.
    """
    agree, contradict, joins = np.zeros((3, *depth_map.depth.shape), dtype=np.uint8)
    limits = np.array([REPROJECTION_PX, MAX_RELATIVE, MAX_SIGMAS])
    own = depth_map.depth, depth_map.std
    for other in others:
        to, back = _transfer(depth_map.P, other.P), _transfer(other.P, depth_map.P)
        count_agreement(own, to, (other.depth, other.std), back, limits, agree, contradict)
    keep = (agree >= MIN_VIEWS) & (agree > contradict)
    with np.errstate(divide="ignore"):
        rho = (1.0 / depth_map.depth).astype(np.float32)
    std = depth_map.std * rho * rho
    surface_continuation(rho, std, keep.astype(np.uint8), RADIUS, ALIKE, GATE, joins)
    keep |= (contradict == 0) & (joins > 0)
    return _without_small_regions(keep_depths(replace(depth_map, views=np.maximum(agree, 1)), keep))


def _without_small_regions(depth_map: DepthMap) -> DepthMap:
    least = MIN_REGION_RATIO * depth_map.depth.size
    return keep_depths(depth_map, _region_sizes(depth_map.depth, STEP) >= least)


def _transfer(P: F64, P_other: F64) -> F64:
    """(3, 4) from (z x, z y, z, 1) of one camera to z' (x', y', 1) of the other; z is the depth."""
    return np.column_stack(pixel_transfer(P, P_other))


def _region_sizes(depth: F32, step: float) -> F64:
    """(H, W) pixels of each pixel's region of depths that differ by at most the share ``step``, 0 if none."""
    number = np.arange(depth.size).reshape(depth.shape)
    log = np.log(depth)
    pairs = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        # A comparison with NaN is false.
        joined = np.abs(log[a] - log[b]) <= step
        pairs.append(np.stack([number[a][joined], number[b][joined]]))
    row, column = np.concatenate(pairs, axis=1)
    edges = np.ones(len(row), dtype=bool)
    graph = scipy.sparse.coo_matrix((edges, (row, column)), shape=(depth.size, depth.size))
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    sizes = np.bincount(label)[label].reshape(depth.shape)
    return np.where(np.isfinite(depth), sizes, 0.0)


def keep_depths(depth_map: DepthMap, keep: B8) -> DepthMap:
    """Return the depth map with unknown depths outside a mask.

    Parameters
    ----------
    depth_map : DepthMap
        Depths of a view.
    keep : ndarray (H, W) of bool
        The pixels whose depths remain.

    Returns
    -------
    DepthMap
    """
    depth, std = (np.where(keep, part, np.float32(np.nan)) for part in (depth_map.depth, depth_map.std))
    return replace(depth_map, depth=depth, std=std, views=np.where(keep, depth_map.views, np.uint8(0)))


def _complete_depths(own: DepthMap, others: Sequence[DepthMap], views: Mapping[int, PinholeView]) -> DepthMap:
    """Complete a depth map with surfaces that only the depth maps of other views contain.

    The depths of other views are projected into the view. Where it has none, the nearest of these initialise
    the plane search against the ``MAX_SOURCES`` images that contribute most pixels. Accepted planes (by the
    rule of :func:`refine_depths`) are measured depths: nothing is interpolated.
    """
    unknown = np.isnan(own.depth) & views[own.view].seen
    offers = []
    for other in others:
        offer = np.full_like(own.depth, np.nan)
        splat_depths(other.depth, _transfer(other.P, own.P), offer)
        offers.append(np.where(unknown, offer, np.float32(np.nan)))
    worth = [int(np.isfinite(offer).sum()) for offer in offers]
    order = sorted(range(len(offers)), key=lambda k: (-worth[k], k))
    best = [k for k in order if worth[k]][:MAX_SOURCES]
    if not best:
        return own
    nearest = np.fmin.reduce([offers[k] for k in best])
    wanted = unknown & scipy.ndimage.binary_dilation(np.isfinite(nearest), np.ones((3, 3)), GAP_PX)
    rho = (np.float32(1.0) / np.where(unknown, nearest, own.depth)).astype(np.float32)
    images = [views[others[k].view] for k in best]
    found, std, support = search_planes(views[own.view], images, rho, wanted=wanted, sweeps=SWEEPS)
    new = np.isfinite(found)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(1.0) / found
        std = np.where(new, std * depth * depth, own.std)
    completed = np.where(new, support, own.views).astype(np.uint8)
    return replace(own, depth=np.where(new, depth, own.depth), std=std, views=completed)


@dataclass(frozen=True)
class MultiViewScene:
    """Input of multi-view stereo."""

    views: Mapping[int, PinholeView]  #: undistorted views by number, in the size of their depth maps
    points: SparsePoints  #: points of the reconstruction
    neighbours: Mapping[int, tuple[int, ...]]  #: neighbours of each view, the most useful first
    matched: Mapping[int, PinholeView] = field(default_factory=dict)  #: in the size used for stereo matching

    def subset(self, numbers: Collection[int]) -> MultiViewScene:
        """Restrict the scene to some views, which reduces the data sent to a worker.

        Parameters
        ----------
        numbers : collection of int
            Views, e.g. those of :meth:`MultiViewStereo.required_views`.

        Returns
        -------
        MultiViewScene
        """
        views, matched = (
            {i: given[i] for i in given if i in numbers} for given in (self.views, self.matched)
        )
        seen = self.points.seen[sorted(numbers)].any(axis=0)
        points = replace(self.points, X=self.points.X[seen], seen=self.points.seen[:, seen])
        return MultiViewScene(views, points, self.neighbours, matched)


@dataclass(frozen=True)
class MultiViewStereo:
    """Depth maps of undistorted views (thesis, section 2.6: dense depth from all images).

    The depth map of a view depends on images and cameras only, so views can be processed in any order and in
    parallel: :meth:`prepare`, then :meth:`depth_map` of each view, then :meth:`confirm` of each view.
    """

    pairs: PairMatching = field(default_factory=PairMatching)  #: dense correspondence of two views
    max_neighbours: int = 4  #: largest number of neighbouring views
    sequence_links: int = 0
    """0: fuse the correspondences with all neighbours; else number of views linked in each direction of the
    sequence."""
    refinement: bool = True
    """Refine depth maps with slanted windows, and complete them from those of other views."""
    max_side: int = 1024  #: longest side of the depth maps in pixels
    match_side: int = 640
    """Longest side of the images for stereo matching; fronto-parallel windows find less in larger images."""

    # Number of depth maps to compare with, if there are as many.
    min_comparison_views = 12

    def __post_init__(self) -> None:
        if self.sequence_links < 0:
            raise ValueError(f"sequence_links must not be negative; got {self.sequence_links}")
        if self.max_neighbours < 1:
            raise ValueError(f"max_neighbours must be at least 1; got {self.max_neighbours}")
        if min(self.max_side, self.match_side) < MIN_SIDE:
            sides = f"{self.max_side} and {self.match_side}"
            raise ValueError(f"max_side and match_side must be at least {MIN_SIDE} px; got {sides}")

    def match_rectified(self, left: ArrayLike, right: ArrayLike, *, max_disparity_px: float) -> DisparityMap:
        """See `thesisrecon.config.DepthEstimator.match_rectified`."""
        if not 0.0 <= max_disparity_px < np.inf:
            raise ValueError(f"max_disparity_px must be finite and not negative; got {max_disparity_px}")
        return self.pairs.matcher.match(left, right, disparity_range=(0, int(np.ceil(max_disparity_px))))

    def match_two_views(
        self, image1: Image, image2: Image, F: F64, xy1: F64, xy2: F64, *, planar: bool = False
    ) -> RectifiedPair:
        """See `thesisrecon.config.DepthEstimator.match_two_views`."""
        return self.pairs.match_two_views(image1, image2, F, xy1, xy2, planar=planar)

    def prepare(
        self,
        images: Sequence[Image],
        reconstruction: Reconstruction,
        *,
        depth_range: F64 | None = None,
        threads: int = 1,  # noqa: ARG002
    ) -> MultiViewScene:
        """See `thesisrecon.config.DepthEstimator.prepare`."""
        if len(images) != len(reconstruction.P):
            raise ValueError(f"{len(reconstruction.P)} cameras need as many images; got {len(images)}")
        registered = np.flatnonzero(reconstruction.registered).tolist()

        def undistorted(side: int) -> Mapping[int, PinholeView]:
            def make(view: int) -> PinholeView:
                return pinhole_view(images[view], reconstruction, view, max_side=side)

            return MappingOnDemand(registered, make, VIEW_BYTES)

        frames = {i: pinhole_frame(images[i], reconstruction, i, max_side=self.max_side) for i in registered}
        views = undistorted(self.max_side)
        side = min(self.match_side, self.max_side)
        longest = max((max(frame.seen.shape) for frame in frames.values()), default=0)
        matched = undistorted(side) if longest > side else views
        if depth_range is None and len(reconstruction.tracks.xy):
            points = _sparse_points(reconstruction)
        else:
            points = SparsePoints(*frustum_samples(frames, len(images), depth_range), sampled=True)
        chosen = {i: _select_neighbours(points, frames, i, self.max_neighbours) for i in frames}
        return MultiViewScene(views, points, chosen, matched)

    def depth_map(self, scene: MultiViewScene, view: int, *, pool: Executor | None = None) -> DepthMap:
        """See `thesisrecon.config.DepthEstimator.depth_map`."""
        if view not in scene.views:
            raise ValueError(f"view {view} has no camera; those with one are {sorted(scene.views)}")

        def correspond(i: int, j: int) -> Correspondence | None:
            a, b = (scene.matched[k] if k in scene.matched else scene.views[k] for k in (i, j))
            shapes = scene.views[i].seen.shape, scene.views[j].seen.shape
            try:
                return self.pairs.correspond(a, b, *_shared_projections(scene.points, a, b), shapes=shapes)
            except StageFailure:
                return None

        if self.sequence_links:
            found = link_sequence(view, scene.views, self.sequence_links, correspond)
        else:
            found = fuse_neighbours(view, scene.views, scene.neighbours[view], correspond, pool)
        keep = scene.views[view].seen
        if self.refinement:
            found = refine_depths(scene.views[view], [scene.views[j] for j in scene.neighbours[view]], found)
        else:
            # Several contradictory measurements are not kept.
            keep = keep & ~((found.views < 2) & (found.conflicts > 0))
        return _without_small_regions(_depth_map(scene.views[view], found, keep))

    def confirm(self, scene: MultiViewScene, depth_maps: Mapping[int, DepthMap], view: int) -> DepthMap:
        """See `thesisrecon.config.DepthEstimator.confirm`."""
        others = [depth_maps[j] for j in self._comparison_views(scene, view) if j in depth_maps]
        own = depth_maps[view]
        if self.refinement:
            own = _complete_depths(own, others, scene.views)
        return _confirm_depths(own, others)

    def required_views(self, scene: MultiViewScene, view: int) -> frozenset[int]:
        """See `thesisrecon.config.DepthEstimator.required_views`."""
        order = sorted(scene.views)
        place = order.index(view)
        linked = order[max(place - self.sequence_links, 0) : place + self.sequence_links + 1]
        return frozenset({*linked, *scene.neighbours[view], *self._comparison_views(scene, view)})

    def _comparison_views(self, scene: MultiViewScene, view: int) -> list[int]:
        """Neighbours of a view, views that it is a neighbour of, and those with the most common points."""
        mutual = {j for j, chosen in scene.neighbours.items() if view in chosen}
        near = (mutual | set(scene.neighbours[view])) - {view}
        seen = scene.points.seen
        both = seen[:, np.flatnonzero(seen[view])].sum(axis=1)
        common = {j: int(both[j]) for j in scene.views if j not in near | {view}}
        order = sorted((j for j in common if common[j]), key=lambda j: (-common[j], j))
        return sorted(near | set(order[: max(self.min_comparison_views - len(near), 0)]))


def _depth_map(view: PinholeView, found: InverseDepth, keep: B8) -> DepthMap:
    """Convert inverse depths to depths; those not kept or not significantly above 0 are unknown."""
    with np.errstate(divide="ignore", invalid="ignore"):
        known = (found.value > SURE * found.std) & keep
        depth = np.where(known, 1.0 / found.value, np.nan).astype(np.float32)
        std = np.where(known, found.std * depth * depth, np.nan).astype(np.float32)
    return DepthMap(view.view, view.P, depth, std, np.where(known, found.views, 0).astype(np.uint8))
