"""Section 2.6: a depth map as a triangulated surface, linear between its points."""

from __future__ import annotations

import numpy as np

from thesisrecon.geometry.camera import decompose_camera
from thesisrecon.model.mesh import without_unused_vertices
from thesisrecon.types import B8, F64, I64, DepthMap, TexturedMesh


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
    K = decompose_camera(depth_map.P)[0]
    # Largest step in depth between points a pixel apart, in units of depth.
    slope = step / (np.sqrt(K[0, 0] * K[1, 1]) * np.tan(np.radians(grazing_deg)))
    index = np.arange(depth.size).reshape(depth.shape)
    a, b, c, d = (depth[:-1, :-1], depth[:-1, 1:], depth[1:, :-1], depth[1:, 1:])
    corners = [index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]]
    other = np.abs(b - c) < np.abs(a - d)
    other |= np.isnan(a) | np.isnan(d)
    faces = []
    for triple, chosen in (((0, 2, 1), other), ((1, 2, 3), other), ((0, 2, 3), ~other), ((0, 3, 1), ~other)):
        triangle = np.stack([corners[k] for k in triple], axis=-1)[chosen]
        faces.append(triangle[_whole(triangle, depth.ravel(), std.ravel(), slope)])
    order = np.concatenate(faces)
    order = order[np.lexsort(order.T[::-1])]
    return without_unused_vertices(TexturedMesh(back_project(depth_map.P, depth, step), order))


def _whole(triangle: I64, depth: F64, std: F64, slope: float) -> B8:
    """(M,) triangles with no side along which the surface breaks, and no corner without depth."""
    with np.errstate(invalid="ignore"):
        z, spread = depth[triangle], std[triangle]
        jump = np.abs(z - np.roll(z, 1, axis=1))
        allowed = slope * np.sqrt(2.0) * np.minimum(z, np.roll(z, 1, axis=1))
        noise = 3.0 * np.hypot(spread, np.roll(spread, 1, axis=1))
        return np.asarray((jump <= np.maximum(allowed, noise)).all(axis=1))


def back_project(P: F64, depth: F64, step: int = 1) -> F64:
    """Points (H W, 3) of pixels (step column, step row) at depths (H, W) of the camera P (3, 4) = K [R t];
    NaN stays NaN."""
    K, R, t = decompose_camera(P)
    y, x = np.indices(depth.shape) * step
    rays = np.stack([x.ravel(), y.ravel(), np.ones(depth.size)], axis=1) @ np.linalg.inv(K).T
    return np.asarray((rays * depth.reshape(-1, 1) - t) @ R)
