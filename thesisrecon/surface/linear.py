"""Piecewise linear surfaces of depth maps (thesis, section 2.6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import B8, F64
from thesisrecon.geometry.camera_matrix import decompose_camera
from thesisrecon.records import DepthMap, TexturedMesh
from thesisrecon.surface._mesh import remove_unused_vertices

RISING, FALLING = ((0, 2, 1), (1, 2, 3)), ((0, 2, 3), (0, 3, 1))
"""Corners (0 1 above, 2 3 below) of the triangles of a square by its diagonal, the left one first."""
GRAZING_DEG = 10.0
"""Surfaces break where they are seen at a smaller angle."""


def max_depth_slope(P: F64, grazing_deg: float) -> float:
    """Largest relative depth step between adjacent pixels of a surface seen at ``grazing_deg`` or more.

    Parameters
    ----------
    P, grazing_deg : ndarray (3, 4), float
        Camera of the depth map; least angle between surface and ray.

    Returns
    -------
    float
        Relative depth step per pixel.
    """
    K = decompose_camera(P)[0]
    return float(1.0 / (np.sqrt(K[0, 0] * K[1, 1]) * np.tan(np.radians(grazing_deg))))


def triangulate_grid(depth: F64, std: F64, slope: float) -> tuple[B8, B8]:
    """Divide the squares of depths into triangles without surface break along a side.

    Parameters
    ----------
    depth, std, slope : ndarray (H, W), ndarray (H, W), float
        Depths, their standard deviations, and the largest relative depth step.

    Returns
    -------
    rising : ndarray (H - 1, W - 1) of bool
        Whether the diagonal, that of the smaller depth step, runs from the lower left to the upper right.
    whole : ndarray (H - 1, W - 1, 2) of bool
        Which of the two triangles exist.
    """
    corner = [np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:]]
    z, spread = (np.stack([values[c] for c in corner], axis=-1) for values in (depth, std))
    falling_step = np.abs(z[..., 0] - z[..., 3])
    rising = (np.abs(z[..., 1] - z[..., 2]) < falling_step) | np.isnan(falling_step)
    whole = np.empty((*rising.shape, 2), dtype=bool)
    for k in range(2):
        triple = np.where(rising[..., None], RISING[k], FALLING[k])
        at, std_at = (np.take_along_axis(values, triple, axis=-1) for values in (z, spread))
        before, std_before = (np.roll(values, 1, axis=-1) for values in (at, std_at))
        with np.errstate(invalid="ignore"):
            whole[..., k] = same_surface(at, before, std_at, std_before, np.sqrt(2.0) * slope).all(axis=-1)
    return rising, whole


def same_surface(z1: F64, z2: F64, std1: F64, std2: F64, slope: float | F64) -> B8:
    """Whether two depths differ by at most ``slope`` of the smaller, or three standard deviations.

    Parameters
    ----------
    z1, z2, std1, std2 : ndarray
        Depths and their standard deviations.
    slope : float or ndarray
        Largest relative depth step.

    Returns
    -------
    ndarray of bool
        Whether the depths can belong to one surface.
    """
    limit = np.maximum(slope * np.minimum(z1, z2), 3.0 * np.hypot(std1, std2))
    return np.asarray(np.abs(z1 - z2) <= limit)


def surface_from_depth(
    depth_map: DepthMap, *, step: int = 1, grazing_deg: float = GRAZING_DEG
) -> TexturedMesh:
    """Triangulate a depth map.

    Two pixels belong to one surface if the line between their points deviates from the rays by more than
    ``grazing_deg``, or if their depths differ by less than three standard deviations.

    Parameters
    ----------
    depth_map, step : DepthMap, int
        Depths of one view, and row and column step.
    grazing_deg : float
        Smallest viewing angle of a surface, in (0, 90).

    Returns
    -------
    TexturedMesh
        Mesh without colours; faces are anticlockwise seen from the camera, all vertices are used.
    """
    depth = depth_map.depth[::step, ::step].astype(np.float64)
    std = depth_map.std[::step, ::step].astype(np.float64)
    diagonal, whole = triangulate_grid(depth, std, step * max_depth_slope(depth_map.P, grazing_deg))
    index = np.arange(depth.size).reshape(depth.shape)
    corners = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]], axis=-1)
    faces = [
        corners[(diagonal == rising) & whole[..., k]][:, triple]
        for rising, triples in ((True, RISING), (False, FALLING))
        for k, triple in enumerate(triples)
    ]
    order = np.concatenate(faces)
    order = order[np.lexsort(order.T[::-1])]
    K, R, t = decompose_camera(depth_map.P)
    y, x = np.indices(depth.shape) * step
    rays = np.stack([x.ravel(), y.ravel(), np.ones(depth.size)], axis=1) @ np.linalg.inv(K).T
    X = np.asarray((rays * depth.reshape(-1, 1) - t) @ R)
    return remove_unused_vertices(TexturedMesh(X, order))


@dataclass(frozen=True)
class LinearSurface:
    """Piecewise linear surface through all depths: :func:`surface_from_depth` of the map itself."""

    def smooth(self, depth_map: DepthMap) -> DepthMap:
        """Return the map unchanged.

        Parameters
        ----------
        depth_map : DepthMap
            Depths of one view.

        Returns
        -------
        DepthMap
        """
        return depth_map
