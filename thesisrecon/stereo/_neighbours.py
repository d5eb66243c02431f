"""Views for multi-view stereo: undistorted images, sparse points, and the choice of neighbouring views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import B8, F64
from thesisrecon.geometry.camera_matrix import camera_centre, distort, project
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.records import Image, PinholeView, Reconstruction
from thesisrecon.stereo._resampling import warp_image

BEST_DEG, SIGMA_BELOW_DEG, SIGMA_ABOVE_DEG = 10.0, 3.0, 10.0
"""Triangulation angle of the greatest weight, and the decay of the weight for smaller and larger ones."""
MIN_ANGLE_DEG, MIN_POINTS = 1.0, 12
"""A neighbour has at least so many common points of at least this angle."""


@dataclass(frozen=True)
class SparsePoints:
    """Points of a metric reconstruction."""

    X: F64  #: (N, 3)
    seen: B8  #: (V, N) whether a view observes a point


def sparse_points(reconstruction: Reconstruction) -> SparsePoints:
    """The valid points of a metric reconstruction with their inlier observations."""
    tracks = reconstruction.tracks
    seen = np.zeros((tracks.n_views, tracks.n_points), dtype=bool)
    good = reconstruction.inlier
    seen[tracks.view_index[good], tracks.point_index[good]] = True
    seen &= reconstruction.registered[:, None]
    valid = reconstruction.valid
    return SparsePoints(reconstruction.X[valid, :3] / reconstruction.X[valid, 3:], seen[:, valid])


def shared_projections(points: SparsePoints, a: PinholeView, b: PinholeView) -> tuple[F64, F64]:
    """Pixels (N, 2) in two views of the points that one of them observes, if inside both images.

    Points that only one view observes count too: the depth range must cover the whole visible scene.
    """
    X = points.X[points.seen[a.view] | points.seen[b.view]]
    keep = np.ones(len(X), dtype=bool)
    places = []
    for view in (a, b):
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = project(view.P, X)
        size = np.array(view.seen.shape[::-1])
        keep &= (X @ view.P[2, :3] + view.P[2, 3] > 0.0) & np.all((xy >= 0.0) & (xy <= size - 1.0), axis=1)
        places.append(xy)
    return places[0][keep], places[1][keep]


def select_neighbours(
    points: SparsePoints, views: Mapping[int, PinholeView], view: int, max_neighbours: int = 4
) -> tuple[int, ...]:
    """Select the neighbours of a view greedily, the most useful first.

    The weight of a common point is a Gaussian of its triangulation angle. Points that earlier neighbours
    observe count less, and so does a view whose baseline has the direction of an earlier one, because views
    from other sides see what is occluded.
    """
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
    """Weights (N,) of the points seen with ``other``, None if it cannot be a neighbour."""
    common = points.seen[view] & points.seen[other]
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


def pinhole_view(
    image: Image, reconstruction: Reconstruction, view: int, *, max_side: int = 1536
) -> PinholeView:
    """Undistort an image of a metric reconstruction, its longest side at most ``max_side`` pixels.

    The third coordinate of its camera is the depth. Pixels outside the original image are black and not
    ``seen``.
    """
    K = reconstruction.K
    if reconstruction.stratum != "metric" or K is None:
        raise ValueError("undistorted views need a metric reconstruction with K")
    if tuple(reconstruction.sizes[view]) != image.size:
        raise ValueError(f"image {image.name} must be {reconstruction.sizes[view]} px; got {image.size}")
    shrink = min(1.0, max_side / max(image.size))
    size = (max(round(image.size[0] * shrink), 1), max(round(image.size[1] * shrink), 1))
    sx, sy = np.array(size) / np.array(image.size)
    # (x + 0.5) s - 0.5 along either side.
    S = np.array([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5], [0.0, 0.0, 1.0]])
    distortion = np.zeros(3) if reconstruction.distortion is None else reconstruction.distortion[view]
    P = reconstruction.P[view]
    P = S @ (P * np.sign(np.linalg.det(P[:, :3])) / np.linalg.norm(P[2, :3]))
    if not distortion.any() and size == image.size:
        return PinholeView(view, P, image.rgb, np.ones(image.rgb.shape[:2], dtype=bool))
    inverse = np.linalg.inv(S @ K[view])

    def lookup(rows: range) -> F64:
        x, y = np.meshgrid(np.arange(float(size[0])), np.arange(float(rows.start), float(rows.stop)))
        rays = homogenize(np.stack([x, y], axis=-1).reshape(-1, 2)) @ inverse.T
        xy = distort(dehomogenize(rays), distortion) @ K[view, :2, :2].T + K[view, :2, 2]
        return np.asarray(xy.reshape(*x.shape, 2))

    pixels = warp_image(image.rgb.astype(np.float32), lookup, size)
    seen = np.asarray(np.isfinite(pixels).all(axis=2))
    rgb = np.clip(np.rint(np.where(seen[:, :, None], pixels, 0.0)), 0.0, 255.0).astype(np.uint8)
    return PinholeView(view, P, rgb, seen)
