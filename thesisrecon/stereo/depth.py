"""Multi-view stereo: depth maps from neighbouring views, and their consistency (thesis, section 2.6)."""

from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import scipy
from numpy.typing import ArrayLike

from thesisrecon.arrays import B8, F64
from thesisrecon.errors import StageFailure, require_range
from thesisrecon.geometry.camera_matrix import camera_centre, project
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.imaging.on_demand import MappingOnDemand
from thesisrecon.imaging.pinholes import pinhole_frame, pinhole_numbers, pinhole_view
from thesisrecon.records import DepthMap, DisparityMap, Image, PinholeView, Reconstruction
from thesisrecon.stereo import _depth_fusion
from thesisrecon.stereo._plane_refinement import refine_depths, search_planes
from thesisrecon.stereo._postprocessing import remove_speckles
from thesisrecon.stereo.correspondence import Correspondence, PairMatching, RectifiedPair

VIEW_BYTES = 2**29
"""Memory for undistorted views at each of the two sizes; others are computed again when they are used."""


@dataclass(frozen=True)
class SparsePoints:
    """Points of a metric reconstruction, or samples of the common frusta."""

    X: F64  #: (N, 3)
    seen: B8  #: (V, N) whether a view observes a point
    sampled: bool = False  #: samples: only those that both views show limit the disparities of a pair


def _sparse_points(reconstruction: Reconstruction, frames: Mapping[int, PinholeView]) -> SparsePoints:
    """The valid points of a metric reconstruction with their inlier observations in each of the views."""
    tracks = reconstruction.tracks
    seen = np.zeros((tracks.n_views, tracks.n_points), dtype=bool)
    good = reconstruction.inlier
    seen[tracks.view_index[good], tracks.point_index[good]] = True
    seen &= reconstruction.registered[:, None]
    valid = reconstruction.valid
    X, n = reconstruction.X[valid, :3] / reconstruction.X[valid, 3:], tracks.n_views
    of_views = np.zeros((max(frames, default=0) + 1, len(X)), dtype=bool)
    divided = {i % n for i in frames if i >= n}
    for i, frame in frames.items():
        of_views[i] = seen[i % n, valid]
        if i % n in divided:
            of_views[i] &= project_inside(frame, X)[1]
    return SparsePoints(X, of_views)


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
    """Select the neighbours of a view greedily, the most useful first."""
    # The weight of a common point is a Gaussian of its triangulation angle. Points that earlier neighbours
    # observe count less, and so does a view in the direction of an earlier one: other sides see what is
    # occluded here.
    # Triangulation angle of the greatest weight, and the decay of the weight for smaller and larger ones.
    best_deg, sigma_below_deg, sigma_above_deg = 10.0, 3.0, 10.0
    # A neighbour has this many common points with at least this triangulation angle.
    min_angle_deg, min_points = 1.0, 12
    own = np.flatnonzero(points.seen[view])
    X, seen = points.X[own], points.seen[:, own]
    centres = {i: dehomogenize(camera_centre(views[i].P)) for i in views}
    worth: dict[int, F64] = {}
    for other in sorted(views.keys() - {view}):
        common = np.flatnonzero(seen[other])
        angle = _angles_deg(X[common] - centres[view], X[common] - centres[other])
        if int(np.sum(angle >= min_angle_deg)) >= min_points:
            off = angle - best_deg
            width = np.where(off < 0.0, sigma_below_deg, sigma_above_deg)
            worth[other] = np.zeros(len(X))
            worth[other][common] = np.where(angle >= min_angle_deg, np.exp(-0.5 * (off / width) ** 2), 0.0)
    baseline = {j: centres[j] - centres[view] for j in worth}
    direction = {j: along / np.linalg.norm(along) for j, along in baseline.items()}
    served = np.zeros(len(X))
    chosen: list[int] = []
    while worth and len(chosen) < max_neighbours:
        gains = {
            j: float(np.sum(np.sqrt(served + w) - np.sqrt(served)))
            * 0.7 ** sum(direction[j] @ direction[c] > 0.5 for c in chosen)
            for j, w in worth.items()
        }
        chosen.append(max(gains, key=lambda j: (gains[j], -j)))
        served += worth.pop(chosen[-1])
    return tuple(chosen)


def _confirm_depths(depth_map: DepthMap, others: Sequence[DepthMap]) -> DepthMap:
    """Keep the depths that the depth maps of other views confirm (Merrell et al., ICCV 2007)."""
    # A pixel is projected into another view, and the depth there is projected back. It is confirmed if both
    # agree and contradicted if the other view sees through it. It is kept if more views confirm than
    # contradict it, or if none contradicts it and it continues the surface of confirmed pixels.
    # Limits of the reprojection error, and of the depth difference: a share plus standard deviations.
    reprojection_px, max_relative, max_sigmas = 1.5, 0.01, 2.0
    # Window of the surface continuation, and distance from its plane in standard deviations.
    radius, gate = 5, 2.0
    agree, contradict = np.zeros((2, *depth_map.depth.shape), dtype=np.uint8)
    limits = np.array([reprojection_px, max_relative, max_sigmas])
    own = depth_map.depth, depth_map.std
    for other in others:
        to, back = _transfer(depth_map.P, other.P), _transfer(other.P, depth_map.P)
        _depth_fusion.count_agreement(own, to, (other.depth, other.std), back, limits, agree, contradict)
    keep = agree > contradict
    with np.errstate(divide="ignore"):
        rho = (1.0 / depth_map.depth).astype(np.float32)
    std = depth_map.std * rho * rho
    keep |= (contradict == 0) & _depth_fusion.surface_continuation(rho, std, keep, radius, gate)
    return _without_small_regions(keep_depths(replace(depth_map, views=np.maximum(agree, 1)), keep))


def _without_small_regions(depth_map: DepthMap) -> DepthMap:
    """Remove connected regions of less than 1e-4 of the pixels; depths in a region differ by at most 2 %."""
    log = np.log(depth_map.depth)
    least = int(np.ceil(1e-4 * log.size))
    remove_speckles(log, np.ones(log.shape, dtype=bool), np.float32(0.02), least)
    return keep_depths(depth_map, np.isfinite(log))


def _transfer(P: F64, P_other: F64) -> F64:
    """(3, 4) from (z x, z y, z, 1) of one camera to z' (x', y', 1) of the other; z is the depth."""
    return np.column_stack(_depth_fusion.pixel_transfer(P, P_other))


def keep_depths(depth_map: DepthMap, keep: B8) -> DepthMap:
    """Return the depth map with unknown depths outside a mask."""
    depth, std = (np.where(keep, part, np.float32(np.nan)) for part in (depth_map.depth, depth_map.std))
    return replace(depth_map, depth=depth, std=std, views=np.where(keep, depth_map.views, np.uint8(0)))


def _complete_depths(own: DepthMap, others: Sequence[DepthMap], views: Mapping[int, PinholeView]) -> DepthMap:
    """Complete a depth map with surfaces that only the depth maps of other views contain."""
    # The nearest of their projections initialise the plane search against the images that contribute most
    # pixels. Accepted planes (by the rule of :func:`refine_depths`) are measured depths: nothing is
    # interpolated.
    max_sources = 4  # Largest number of views from which a depth map is completed
    # Size of the gaps between projected pixels that completion fills, and number of passes of its search.
    gap_px, sweeps = 1, 2
    unknown = np.isnan(own.depth) & views[own.view].seen
    offers = []
    for other in others:
        offer = np.full_like(own.depth, np.nan)
        _depth_fusion.splat_depths(other.depth, _transfer(other.P, own.P), offer)
        offers.append(np.where(unknown, offer, np.float32(np.nan)))
    worth = [int(np.isfinite(offer).sum()) for offer in offers]
    order = sorted(range(len(offers)), key=lambda k: (-worth[k], k))
    best = [k for k in order if worth[k]][:max_sources]
    if not best:
        return own
    nearest = np.fmin.reduce([offers[k] for k in best])
    wanted = unknown & scipy.ndimage.binary_dilation(np.isfinite(nearest), np.ones((3, 3)), gap_px)
    rho = (np.float32(1.0) / np.where(unknown, nearest, own.depth)).astype(np.float32)
    images = [views[others[k].view] for k in best]
    found, std, support = search_planes(views[own.view], images, rho, wanted=wanted, sweeps=sweeps)
    new = np.isfinite(found)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(1.0) / found
        std = np.where(new, std * depth * depth, own.std)
    completed = np.where(new, support, own.views).astype(np.uint8)
    return replace(own, depth=np.where(new, depth, own.depth), std=std, views=completed)


def frustum_samples(
    views: Mapping[int, PinholeView], n_views: int, depth_range: F64 | None = None
) -> tuple[F64, B8]:
    """Sample the common frusta: points (N, 3), and whether each of ``n_views`` shows them (V, N).

    On the rays of a grid of pixels of each view, at the depths of ``depth_range`` (V, 2) of its image;
    without it another view shows a point only at a triangulation angle from 0.5 to 40 degrees. Points of one
    view are left out.
    """
    min_angle_deg, max_angle_deg = 0.5, 40.0
    # Depths between given limits, evenly in inverse depth; ratio of successive depths without limits.
    depths, ratio = 12, 1.25
    grid = (8, 6)  # Samples along the width and the height of an image
    centres = {i: dehomogenize(camera_centre(view.P)) for i, view in views.items()}
    points, shown = [np.zeros((0, 3))], [np.zeros((n_views, 0), dtype=bool)]
    for i, view in views.items():
        away = [float(np.linalg.norm(centres[j] - centres[i])) for j in views if j != i]
        # Views of one image have one centre, to rounding.
        away = [distance for distance in away if distance > 1e-9 * max(away)]
        if depth_range is not None:
            first, last = 1.0 / depth_range[i % len(depth_range)]
            depth = 1.0 / np.linspace(first, last, depths)
        elif away:
            nearest = 0.5 * min(away) / np.tan(np.radians(max_angle_deg))
            farthest = max(away) / np.tan(np.radians(min_angle_deg))
            depth = np.geomspace(nearest, farthest, 2 + int(np.log(farthest / nearest) / np.log(ratio)))
        else:
            continue
        sides = zip(grid, view.seen.shape[::-1], strict=True)
        x, y = (np.linspace(0.02, 0.98, n) * (side - 1.0) for n, side in sides)
        xh = np.stack([*(a.ravel() for a in np.meshgrid(x, y)), np.ones(grid[0] * grid[1])])
        # The third row of P has unit norm: the rays have depth 1.
        rays = np.linalg.solve(view.P[:, :3], xh).T
        X = (centres[i] + depth[:, None, None] * rays).reshape(-1, 3)
        seen = np.zeros((n_views, len(X)), dtype=bool)
        for j in views:
            if j != i:
                seen[j] = project_inside(views[j], X)[1]
                if depth_range is None:
                    angle = _angles_deg(X - centres[i], X - centres[j])
                    seen[j] &= (angle >= min_angle_deg) & (angle <= max_angle_deg)
        kept = seen.any(axis=0)
        seen[i] = True
        points.append(X[kept])
        shown.append(seen[:, kept])
    return np.concatenate(points), np.concatenate(shown, axis=1)


def project_inside(view: PinholeView, X: F64) -> tuple[F64, B8]:
    """Pixels (N, 2) of points in a view, and whether they are in front of it and inside the image."""
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = project(view.P, X)
    size = np.array(view.seen.shape[::-1])
    inside = np.all((xy >= 0.0) & (xy <= size - 1.0), axis=1)
    return xy, np.asarray((X @ view.P[2, :3] + view.P[2, 3] > 0.0) & inside)


def _angles_deg(a: F64, b: F64) -> F64:
    """Angles (N,) between vectors (N, 3)."""
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    return np.asarray(np.degrees(np.arctan2(sine, np.sum(a * b, axis=1))))


@dataclass(frozen=True)
class MultiViewScene:
    """Input of multi-view stereo."""

    views: Mapping[int, PinholeView]  #: pinhole views by number, in the size of their depth maps
    points: SparsePoints  #: points of the reconstruction
    neighbours: Mapping[int, tuple[int, ...]]  #: neighbours of each view, the most useful first
    matched: Mapping[int, PinholeView] = field(default_factory=dict)  #: in the size used for stereo matching

    def subset(self, numbers: Collection[int]) -> "MultiViewScene":
        """Restrict the scene to some views, which reduces the data sent to a worker."""
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
        require_range(self, sequence_links="[0, inf)", max_neighbours="[1, inf)")
        require_range(self, max_side="[64, inf)", match_side="[64, inf)")

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
        images: Sequence[Image], reconstruction: Reconstruction, *, depth_range: F64 | None = None,
        threads: int = 1,  # noqa: ARG002
    ) -> MultiViewScene:  # fmt: skip
        """See `thesisrecon.config.DepthEstimator.prepare`."""
        if len(images) != len(reconstruction.P):
            raise ValueError(f"{len(reconstruction.P)} cameras need as many images; got {len(images)}")
        numbers, n = pinhole_numbers(reconstruction), len(images)

        def undistorted(side: int) -> Mapping[int, PinholeView]:
            return MappingOnDemand(
                numbers, lambda i: pinhole_view(images[i % n], reconstruction, i, max_side=side), VIEW_BYTES
            )

        frames = {i: pinhole_frame(images[i % n], reconstruction, i, max_side=self.max_side) for i in numbers}
        views = undistorted(self.max_side)
        side = min(self.match_side, self.max_side)
        longest = max((max(frame.seen.shape) for frame in frames.values()), default=0)
        matched = undistorted(side) if longest > side else views
        if depth_range is None and len(reconstruction.tracks.xy):
            points = _sparse_points(reconstruction, frames)
        else:
            samples = frustum_samples(frames, max(numbers, default=0) + 1, depth_range)
            points = SparsePoints(*samples, sampled=True)
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
            found = _depth_fusion.link_sequence(view, scene.views, self.sequence_links, correspond)
        else:
            # Robust weighted mean of the inverse depths measured with all neighbours (2.5).
            near, P = scene.neighbours[view], scene.views[view].P
            pairs = _depth_fusion.with_idle_threads(pool, partial(correspond, view), near)
            each = [(scene.views[j].P, pair) for j, pair in zip(near, pairs, strict=True) if pair is not None]
            measured = [_depth_fusion.inverse_depths(P, *one) for one in each]
            found = _depth_fusion.fuse_inverse_depths(measured, scene.views[view].seen.shape)
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


def _depth_map(view: PinholeView, found: _depth_fusion.InverseDepth, keep: B8) -> DepthMap:
    """Convert inverse depths to depths; those not kept or not significantly above 0 are unknown."""
    sure = 3.0  # Standard deviations by which an inverse depth must exceed 0, that of infinity
    with np.errstate(divide="ignore", invalid="ignore"):
        known = (found.value > sure * found.std) & keep
        depth = np.where(known, 1.0 / found.value, np.nan).astype(np.float32)
        std = np.where(known, found.std * depth * depth, np.nan).astype(np.float32)
    return DepthMap(view.view, view.P, depth, std, np.where(known, found.views, 0).astype(np.uint8))
