"""Section 2.6: a depth map as a triangulated surface, linear between its points.

What surfaces of depth maps have in common: inverse depth with its gradient, normals, maps and meshes.

Section 2.6: the surface that is linear between the pixels of a depth map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from thesisrecon.arrays import B8, F64
from thesisrecon.geometry.camera_matrix import decompose_camera
from thesisrecon.records import DepthMap, TexturedMesh
from thesisrecon.surface.mesh import remove_unused_vertices


def surface_from_depth(depth_map: DepthMap, *, step: int = 1, grazing_deg: float = 10.0) -> TexturedMesh:
    """Every pixel a vertex, neighbours joined by triangles unless the surface breaks between them.

    Two pixels are taken for one surface where the line between their points leaves the rays by more than
    ``grazing_deg``: seen so flatly a true surface is hardly ever matched, while at the edge of something in
    front the line runs along the rays. Differences within three deviations of the depths do not break a
    surface. Of the two diagonals of a square the one with the smaller step in depth is taken.

    Parameters
    ----------
    depth_map : with NaN where unknown.
    step : every ``step``-th row and column, at least 1.
    grazing_deg : in (0, 90).

    Returns
    -------
    TexturedMesh : without colours, faces anticlockwise as the camera sees them, only vertices in use.
    """
    if step < 1 or not 0.0 < grazing_deg < 90.0:
        raise ValueError(f"step >= 1 and 0 < grazing_deg < 90 are needed; got {step} and {grazing_deg}")
    depth = depth_map.depth[::step, ::step].astype(np.float64)
    std = depth_map.std[::step, ::step].astype(np.float64)
    triangles = triangulate_grid(depth, std, step * max_depth_slope(depth_map.P, grazing_deg))
    index = np.arange(depth.size).reshape(depth.shape)
    corners = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]], axis=-1)
    faces = []
    for rising, triples in ((True, RISING), (False, FALLING)):
        for k, triple in enumerate(triples):
            faces.append(corners[(triangles.rising == rising) & triangles.whole[..., k]][:, triple])
    order = np.concatenate(faces)
    order = order[np.lexsort(order.T[::-1])]
    return remove_unused_vertices(TexturedMesh(back_project(depth_map.P, depth, step), order))


RISING, FALLING = ((0, 2, 1), (1, 2, 3)), ((0, 2, 3), (0, 3, 1))
"""Corners (0 1 above, 2 3 below) of the triangles of a square by its diagonal, the one at the left first."""


@dataclass(frozen=True)
class GridTriangles:
    """How the squares between pixels (H - 1, W - 1) are made of triangles: ``rising``, whether the diagonal
    runs from the lower left to the upper right, and ``whole`` (H - 1, W - 1, 2), which triangles are."""

    rising: B8
    whole: B8


def max_depth_slope(P: F64, grazing_deg: float) -> float:
    """Largest step in depth from a pixel to the next, in units of depth, on a surface seen no more flatly."""
    K = decompose_camera(P)[0]
    return float(1.0 / (np.sqrt(K[0, 0] * K[1, 1]) * np.tan(np.radians(grazing_deg))))


def triangulate_grid(depth: F64, std: F64, slope: float) -> GridTriangles:
    """Triangles of a grid of depths (H, W) with deviations; ``slope``: the largest step in units of depth."""
    corner = [np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:]]
    z, spread = (np.stack([values[c] for c in corner], axis=-1) for values in (depth, std))
    falling_step = np.abs(z[..., 0] - z[..., 3])
    rising = (np.abs(z[..., 1] - z[..., 2]) < falling_step) | np.isnan(falling_step)
    whole = np.empty((*rising.shape, 2), dtype=bool)
    for k in range(2):
        triple = np.where(rising[..., None], RISING[k], FALLING[k])
        at, std_at = (np.take_along_axis(values, triple, axis=-1) for values in (z, spread))
        whole[..., k] = _whole(at, std_at, slope)
    return GridTriangles(rising, whole)


def _whole(z: F64, spread: F64, slope: float) -> B8:
    """Triangles (..., 3) with no side along which the surface breaks, and no corner without depth."""
    with np.errstate(invalid="ignore"):
        joined = same_surface(
            z, np.roll(z, 1, axis=-1), spread, np.roll(spread, 1, axis=-1), np.sqrt(2.0) * slope
        )
    return np.asarray(joined.all(axis=-1))


def same_surface(z1: F64, z2: F64, std1: F64, std2: F64, slope: float | F64) -> B8:
    """Whether two depths may be of one surface: at most ``slope`` of the smaller, or three deviations,
    apart."""
    limit = np.maximum(slope * np.minimum(z1, z2), 3.0 * np.hypot(std1, std2))
    return np.asarray(np.abs(z1 - z2) <= limit)


def back_project(P: F64, depth: F64, step: int = 1) -> F64:
    """Points (H W, 3) of pixels (step column, step row) at depths (H, W) of the camera P (3, 4) = K [R t];
    NaN stays NaN."""
    K, R, t = decompose_camera(P)
    y, x = np.indices(depth.shape) * step
    rays = np.stack([x.ravel(), y.ravel(), np.ones(depth.size)], axis=1) @ np.linalg.inv(K).T
    return np.asarray((rays * depth.reshape(-1, 1) - t) @ R)


@dataclass(frozen=True)
class SurfaceSample:
    """A surface at places of its view: ``inverse_depth`` (N,) and its ``gradient`` (N, 2) per px along x and
    y; NaN where there is no surface."""

    inverse_depth: F64
    gradient: F64


class FittedSurface(Protocol):
    """A surface in front of the pixels of the depth map ``given`` that it was made from."""

    @property
    def given(self) -> DepthMap: ...

    @property
    def interpolates(self) -> bool:
        """Whether the depths of ``given`` are on the surface as they are."""

    def evaluate(self, xy: F64) -> SurfaceSample:
        """The surface at places ``xy`` (N, 2) px, between pixels too."""


class DepthSurface(Protocol):
    """A way of making a surface of a depth map."""

    def fit(self, depth_map: DepthMap) -> FittedSurface:
        """The surface; NaN wherever it would have to be made up."""


def surface_normals(surface: FittedSurface, xy: F64) -> F64:
    """Unit normals (N, 3) in the world at ``xy`` (N, 2) px, towards the camera; NaN where no surface is.

    Near a pixel the surface is the plane a . (x, y, 1) = 1 / z, whose normal in the camera is -K' a.
    """
    K, R, _ = decompose_camera(surface.given.P)
    sample = surface.evaluate(xy)
    offset = sample.inverse_depth - np.sum(sample.gradient * xy, axis=1)
    normal = -np.column_stack([sample.gradient, offset]) @ K @ R
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def resample_surface(surface: FittedSurface, scale: float = 1.0) -> DepthMap:
    """The surface as a depth map of ``scale`` times as many rows and columns, 1 for those it was made from.

    Deviations and counts of views are those of the nearest pixel that was given: what neighbouring pixels
    share of their errors no fit can tell. Raises ``ValueError`` where ``scale`` is not positive.
    """
    if not scale > 0.0:
        raise ValueError(f"scale must be positive; got {scale}")
    given = surface.given
    if scale == 1.0 and surface.interpolates:
        return given
    shape = tuple(max(round(n * scale), 1) for n in given.depth.shape)
    places = [(np.arange(n) + 0.5) / scale - 0.5 for n in shape]
    xy = np.stack(np.meshgrid(places[1], places[0]), axis=-1).reshape(-1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = surface.evaluate(xy).inverse_depth.reshape(shape)
        depth = np.where(rho > 0.0, 1.0 / rho, np.nan).astype(np.float32)
    nearest = np.ix_(
        *(
            np.clip(np.rint(at), 0, n - 1).astype(np.int64)
            for at, n in zip(places, given.depth.shape, strict=True)
        )
    )
    known = np.isfinite(depth)
    zoom = np.array([[scale, 0.0, 0.5 * scale - 0.5], [0.0, scale, 0.5 * scale - 0.5], [0.0, 0.0, 1.0]])
    return replace(
        given,
        P=zoom @ given.P,
        depth=depth,
        std=np.where(known, given.std[nearest], np.float32(np.nan)),
        views=np.where(known, given.views[nearest], np.uint8(0)),
    )


def triangulate_surface(
    surface: FittedSurface, scale: float = 1.0, *, grazing_deg: float = 10.0
) -> TexturedMesh:
    """The surface in triangles, ``scale`` of them along the side of a pixel; it breaks where
    :func:`~thesisrecon.surface.linear.surface_from_depth` says."""
    return surface_from_depth(resample_surface(surface, scale), grazing_deg=grazing_deg)


@dataclass(frozen=True)
class LinearSurface:
    """Every depth as it is, and triangles between: :func:`~thesisrecon.surface.linear.surface_from_depth`, in between.

    ``grazing_deg``: what is seen more flatly breaks.
    """

    grazing_deg: float = 10.0

    def __post_init__(self) -> None:
        if not 0.0 < self.grazing_deg < 90.0:
            raise ValueError(f"0 < grazing_deg < 90 is needed; got {self.grazing_deg}")

    def fit(self, depth_map: DepthMap) -> LinearFit:
        """The surface through all pixels of the map."""
        # A row and a column of nothing give every pixel a square of its own.
        depth, std = (
            np.pad(part.astype(np.float64), ((0, 1), (0, 1)), constant_values=np.nan)
            for part in (depth_map.depth, depth_map.std)
        )
        slope = max_depth_slope(depth_map.P, self.grazing_deg)
        return LinearFit(depth_map, 1.0 / depth, triangulate_grid(depth, std, slope))


@dataclass(frozen=True)
class LinearFit:
    """Inverse depths (H + 1, W + 1), the last row and column nothing, and the triangles between them: planes
    of space are linear in them."""

    given: DepthMap
    inverse_depth: F64
    triangles: GridTriangles

    @property
    def interpolates(self) -> bool:
        """True."""
        return True

    def evaluate(self, xy: F64) -> SurfaceSample:
        """Linear within each whole triangle; at pixels their own inverse depth, whole triangles or not."""
        height, width = self.given.depth.shape
        inside = np.all((xy >= -1e-9) & (xy <= np.array([width, height]) - 1.0 + 1e-9), axis=1)
        at = np.where(inside[:, None], xy, 0.0)
        x, y = np.floor(at + 1e-9).astype(np.int64).T
        u, v = (at - np.stack([x, y], axis=1)).T
        a, b, c, d = (self.inverse_depth[y + j, x + i] for j, i in ((0, 0), (0, 1), (1, 0), (1, 1)))
        rising = self.triangles.rising[y, x]
        second = np.where(rising, u + v > 1.0, u > v)
        along_x = np.where(rising == second, d - c, b - a)
        along_y = np.where(second, d - b, c - a)
        value = np.where(
            rising & second, d - (1.0 - u) * along_x - (1.0 - v) * along_y, a + u * along_x + v * along_y
        )
        whole = inside & self.triangles.whole[y, x, second.astype(np.int64)]
        pixel = inside & (np.maximum(np.abs(u), np.abs(v)) < 1e-6)
        value = np.where(whole, value, np.where(pixel, a, np.nan))
        return SurfaceSample(value, np.where(whole[:, None], np.stack([along_x, along_y], axis=1), np.nan))
