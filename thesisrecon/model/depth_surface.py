"""Section 2.6: a depth map as a triangulated surface, linear between its points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.geometry.camera import decompose_camera
from thesisrecon.model.mesh import without_unused_vertices
from thesisrecon.types import B8, F64, DepthMap, TexturedMesh


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
    squares = split_squares(depth, std, step * steepest_slope(depth_map.P, grazing_deg))
    index = np.arange(depth.size).reshape(depth.shape)
    corners = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]], axis=-1)
    faces = []
    for rising, triples in ((True, RISING), (False, FALLING)):
        for k, triple in enumerate(triples):
            faces.append(corners[(squares.rising == rising) & squares.whole[..., k]][:, triple])
    order = np.concatenate(faces)
    order = order[np.lexsort(order.T[::-1])]
    return without_unused_vertices(TexturedMesh(back_project(depth_map.P, depth, step), order))


RISING, FALLING = ((0, 2, 1), (1, 2, 3)), ((0, 2, 3), (0, 3, 1))
"""Corners (0 1 above, 2 3 below) of the triangles of a square by its diagonal, the one at the left first."""


@dataclass(frozen=True)
class Squares:
    """How the squares between pixels (H - 1, W - 1) are made of triangles: ``rising``, whether the diagonal
    runs from the lower left to the upper right, and ``whole`` (H - 1, W - 1, 2), which triangles are."""

    rising: B8
    whole: B8


def steepest_slope(P: F64, grazing_deg: float) -> float:
    """Largest step in depth from a pixel to the next, in units of depth, on a surface seen no more flatly."""
    K = decompose_camera(P)[0]
    return float(1.0 / (np.sqrt(K[0, 0] * K[1, 1]) * np.tan(np.radians(grazing_deg))))


def split_squares(depth: F64, std: F64, slope: float) -> Squares:
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
    return Squares(rising, whole)


def _whole(z: F64, spread: F64, slope: float) -> B8:
    """Triangles (..., 3) with no side along which the surface breaks, and no corner without depth."""
    with np.errstate(invalid="ignore"):
        joined = one_surface(
            z, np.roll(z, 1, axis=-1), spread, np.roll(spread, 1, axis=-1), np.sqrt(2.0) * slope
        )
    return np.asarray(joined.all(axis=-1))


def one_surface(z1: F64, z2: F64, std1: F64, std2: F64, slope: float | F64) -> B8:
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
