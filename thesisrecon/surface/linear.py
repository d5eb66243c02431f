"""Piecewise linear surfaces of depth maps (thesis, section 2.6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.camera import decompose_camera
from thesisrecon.records import DepthMap, TexturedMesh
from thesisrecon.surface._mesh import (
    FALLING,
    RISING,
    max_depth_slope,
    remove_unused_vertices,
    triangulate_grid,
)

GRAZING_DEG = 10.0
"""Surfaces break where they are seen at a smaller angle."""


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
        """See `thesisrecon.surface.bspline.BSplineSurface.smooth`; the map is unchanged."""
        return depth_map
