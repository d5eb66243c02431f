"""Surfaces of single depth maps: triangulation and fitted surfaces (thesis, section 2.6)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from thesisrecon.arrays import B8, F64
from thesisrecon.geometry.camera_matrix import decompose_camera
from thesisrecon.records import DepthMap, TexturedMesh
from thesisrecon.surface.mesh import remove_unused_vertices

RISING, FALLING = ((0, 2, 1), (1, 2, 3)), ((0, 2, 3), (0, 3, 1))
"""Corners (0 1 above, 2 3 below) of the triangles of a square by its diagonal, the left one first."""


def surface_from_depth(depth_map: DepthMap, *, step: int = 1, grazing_deg: float = 10.0) -> TexturedMesh:
    """Triangulate a depth map.

    Two pixels belong to one surface if the line between their points deviates from the rays by more than
    ``grazing_deg``, or if their depths differ by less than three standard deviations: true surfaces at
    smaller angles are hardly ever matched, whereas the line across an occluding edge runs along the rays. Of
    the two diagonals of a square the one with the smaller depth step is used.

    Parameters
    ----------
    depth_map : DepthMap
    step : int
        Row and column step, at least 1.
    grazing_deg : float
        Smallest viewing angle of a surface, in (0, 90).

    Returns
    -------
    TexturedMesh
        Mesh without colours; faces are anticlockwise seen from the camera, all vertices are used.

    Raises
    ------
    ValueError
        If ``step`` or ``grazing_deg`` is out of range.
    """
    if step < 1 or not 0.0 < grazing_deg < 90.0:
        raise ValueError(f"step must be >= 1 and grazing_deg in (0, 90); got {step} and {grazing_deg}")
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
    return remove_unused_vertices(TexturedMesh(points_of_depth_map(depth_map.P, depth, step), order))


@dataclass(frozen=True)
class GridTriangles:
    """Triangles of a grid of depths.

    Attributes
    ----------
    rising : ndarray (H - 1, W - 1) bool
        Whether the diagonal of a square runs from the lower left to the upper right.
    whole : ndarray (H - 1, W - 1, 2) bool
        Which of its triangles exist.
    """

    rising: B8
    whole: B8


def max_depth_slope(P: F64, grazing_deg: float) -> float:
    """Return the largest relative depth step between adjacent pixels on a surface.

    Parameters
    ----------
    P : ndarray (3, 4)
        Camera.
    grazing_deg : float
        Smallest viewing angle of a surface.

    Returns
    -------
    float
        Depth step per pixel, relative to the depth.
    """
    K = decompose_camera(P)[0]
    return float(1.0 / (np.sqrt(K[0, 0] * K[1, 1]) * np.tan(np.radians(grazing_deg))))


def triangulate_grid(depth: F64, std: F64, slope: float) -> GridTriangles:
    """Divide the squares of a grid of depths into triangles.

    Parameters
    ----------
    depth, std : ndarray (H, W)
        Depths and standard deviations, NaN = unknown.
    slope : float
        Largest relative depth step on a surface.

    Returns
    -------
    GridTriangles
        Diagonals and existing triangles.
    """
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
    """Triangles (..., 3) with known corners and no surface break along a side."""
    with np.errstate(invalid="ignore"):
        joined = same_surface(
            z, np.roll(z, 1, axis=-1), spread, np.roll(spread, 1, axis=-1), np.sqrt(2.0) * slope
        )
    return np.asarray(joined.all(axis=-1))


def same_surface(z1: F64, z2: F64, std1: F64, std2: F64, slope: float | F64) -> B8:
    """Test whether two depths may belong to one surface.

    Parameters
    ----------
    z1, z2, std1, std2 : ndarray
        Depths and standard deviations.
    slope : float or ndarray
        Largest relative depth step.

    Returns
    -------
    ndarray bool
        True if they differ by at most ``slope`` of the smaller, or three standard deviations.
    """
    limit = np.maximum(slope * np.minimum(z1, z2), 3.0 * np.hypot(std1, std2))
    return np.asarray(np.abs(z1 - z2) <= limit)


def points_of_depth_map(P: F64, depth: F64, step: int = 1) -> F64:
    """Back-project a depth map to points.

    Parameters
    ----------
    P : ndarray (3, 4)
        Camera K [R t].
    depth : ndarray (H, W)
    step : int
        Pixels between rows and columns of ``depth``.

    Returns
    -------
    ndarray (H W, 3)
        Points, NaN where unknown.
    """
    K, R, t = decompose_camera(P)
    y, x = np.indices(depth.shape) * step
    rays = np.stack([x.ravel(), y.ravel(), np.ones(depth.size)], axis=1) @ np.linalg.inv(K).T
    return np.asarray((rays * depth.reshape(-1, 1) - t) @ R)


@dataclass(frozen=True)
class SurfaceSample:
    """Values of a surface at pixels of its view.

    Attributes
    ----------
    inverse_depth : ndarray (N,)
        Inverse depth, NaN where there is no surface.
    gradient : ndarray (N, 2)
        Its derivatives along x and y per pixel.
    """

    inverse_depth: F64
    gradient: F64


class FittedSurface(Protocol):
    """Surface in front of the pixels of a depth map."""

    @property
    def depth_map(self) -> DepthMap:
        """The depth map it was fitted to."""

    @property
    def interpolates(self) -> bool:
        """Whether the surface contains the depths of the map exactly."""

    def evaluate(self, xy: F64) -> SurfaceSample:
        """Evaluate the surface at pixels ``xy`` (N, 2)."""


class DepthSurface(Protocol):
    """Method that fits a surface to a depth map."""

    def fit(self, depth_map: DepthMap) -> FittedSurface:
        """Fit the surface; NaN where there are no depths."""


def surface_normals(surface: FittedSurface, xy: F64) -> F64:
    """Compute the normals of a surface.

    Near a pixel the surface is the plane a . (x, y, 1) = 1 / z, with the normal -K' a in the camera frame.

    Parameters
    ----------
    surface : FittedSurface
    xy : ndarray (N, 2)

    Returns
    -------
    ndarray (N, 3)
        Unit normals in the world frame towards the camera, NaN where there is no surface.
    """
    K, R, _ = decompose_camera(surface.depth_map.P)
    sample = surface.evaluate(xy)
    offset = sample.inverse_depth - np.sum(sample.gradient * xy, axis=1)
    normal = -np.column_stack([sample.gradient, offset]) @ K @ R
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def resample_surface(surface: FittedSurface, scale: float = 1.0) -> DepthMap:
    """Sample a surface as a depth map.

    Parameters
    ----------
    surface : FittedSurface
    scale : float
        Size relative to the original depth map.

    Returns
    -------
    DepthMap
        Depths of the surface; standard deviations and view counts are those of the nearest original pixel,
        because a fit cannot reveal errors that neighbours share.

    Raises
    ------
    ValueError
        If ``scale`` is not positive.
    """
    if not scale > 0.0:
        raise ValueError(f"scale must be positive; got {scale}")
    depth_map = surface.depth_map
    if scale == 1.0 and surface.interpolates:
        return depth_map
    shape = tuple(max(round(n * scale), 1) for n in depth_map.depth.shape)
    places = [(np.arange(n) + 0.5) / scale - 0.5 for n in shape]
    xy = np.stack(np.meshgrid(places[1], places[0]), axis=-1).reshape(-1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = surface.evaluate(xy).inverse_depth.reshape(shape)
        depth = np.where(rho > 0.0, 1.0 / rho, np.nan).astype(np.float32)
    nearest = np.ix_(
        *(
            np.clip(np.rint(at), 0, n - 1).astype(np.int64)
            for at, n in zip(places, depth_map.depth.shape, strict=True)
        )
    )
    known = np.isfinite(depth)
    zoom = np.array([[scale, 0.0, 0.5 * scale - 0.5], [0.0, scale, 0.5 * scale - 0.5], [0.0, 0.0, 1.0]])
    return replace(
        depth_map,
        P=zoom @ depth_map.P,
        depth=depth,
        std=np.where(known, depth_map.std[nearest], np.float32(np.nan)),
        views=np.where(known, depth_map.views[nearest], np.uint8(0)),
    )


def triangulate_surface(
    surface: FittedSurface, scale: float = 1.0, *, grazing_deg: float = 10.0
) -> TexturedMesh:
    """Triangulate a surface, see :func:`surface_from_depth`.

    Parameters
    ----------
    surface : FittedSurface
    scale : float
        Vertices per pixel along rows and columns.
    grazing_deg : float
        Smallest viewing angle of a surface.

    Returns
    -------
    TexturedMesh
        Mesh without colours.
    """
    return surface_from_depth(resample_surface(surface, scale), grazing_deg=grazing_deg)


@dataclass(frozen=True)
class LinearSurface:
    """Piecewise linear surface through all depths, see :func:`surface_from_depth`.

    Parameters
    ----------
    grazing_deg : float
        Surfaces break where they are seen at a smaller angle.
    """

    grazing_deg: float = 10.0

    def __post_init__(self) -> None:
        if not 0.0 < self.grazing_deg < 90.0:
            raise ValueError(f"grazing_deg must be in (0, 90); got {self.grazing_deg}")

    def fit(self, depth_map: DepthMap) -> LinearFit:
        """Triangulate the pixels of a depth map.

        Parameters
        ----------
        depth_map : DepthMap

        Returns
        -------
        LinearFit
        """
        # Padding gives every pixel its own square.
        depth, std = (
            np.pad(part.astype(np.float64), ((0, 1), (0, 1)), constant_values=np.nan)
            for part in (depth_map.depth, depth_map.std)
        )
        slope = max_depth_slope(depth_map.P, self.grazing_deg)
        return LinearFit(depth_map, 1.0 / depth, triangulate_grid(depth, std, slope))


@dataclass(frozen=True)
class LinearFit:
    """Piecewise linear surface of a depth map; planes in space are linear in inverse depth.

    Attributes
    ----------
    depth_map : DepthMap
        The map it was fitted to.
    inverse_depth : ndarray (H + 1, W + 1)
        Inverse depths, the last row and column NaN.
    triangles : GridTriangles
        Triangles between the pixels.
    """

    depth_map: DepthMap
    inverse_depth: F64
    triangles: GridTriangles

    @property
    def interpolates(self) -> bool:
        """True."""
        return True

    def evaluate(self, xy: F64) -> SurfaceSample:
        """Interpolate linearly within the triangles.

        Parameters
        ----------
        xy : ndarray (N, 2)

        Returns
        -------
        SurfaceSample
            Inverse depth and gradient; the inverse depth of a pixel is also known outside triangles.
        """
        height, width = self.depth_map.depth.shape
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
