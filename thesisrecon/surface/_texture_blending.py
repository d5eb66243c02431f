"""Colours of a texture, blended from all images."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations

import numpy as np
import scipy

from thesisrecon.arrays import B8, F32, F64, I64, U8
from thesisrecon.geometry.zbuffer import rasterize, rasterize_corners
from thesisrecon.records import PinholeView, TexturedMesh
from thesisrecon.surface._mesh import vertex_normals
from thesisrecon.surface._texture_kernels import (
    ViewSurface,
    combine_colors,
    continue_faces,
    grow_colors,
    observe_points,
)
from thesisrecon.surface._texture_views import DEPTH_TOLERANCE_PX, view_camera

POINTS_PER_CHUNK = 1 << 17
"""Points processed at a time, which bounds the memory."""
STRIP_ROWS = 64
"""Rows of the texture processed at a time."""
RIM_TEXELS = 1
"""Texels by which a chart is extrapolated for bilinear sampling."""
BEYOND_FACE = 4.0
"""Limit of that extrapolation in sides of a face."""
GROWN_TEXELS = 3
"""Further texels that take the colours of the rim, for reduced textures."""
OUTLINE_PX = 10.0
"""Depth step in pixel sizes that marks the outline of a foreground object."""
MIN_TRUST = 1e-3
"""Weight of pixels at outlines and image borders, which count where no other image shows the point."""
GAIN_POINTS = 50_000
"""Points at which image gains are estimated."""
DARK, BRIGHT = 16.0, 240.0
"""Colours outside this range are clipped or noisy and not used for gains."""
POWER = 2.0
"""Exponent of the pixels per area: 0 weighs all images equally, large values select the best one."""
SCATTER = 20.0
"""Distance from the median colour in grey levels at which the weight is a quarter."""
FEATHER_PX = 8.0
"""Width of the border in which the weight decreases."""


def paint_texture(
    mesh: TexturedMesh, views: Sequence[PinholeView], uv: F64, cut_out: U8, *, threads: int = 1
) -> U8:
    """Compute the colours of a texture (H, W, 3) as a robust blend of all images that show a point.

    The weight of an image is its number of pixels per area, reduced towards image borders and outlines of
    foreground objects and where its colour contradicts the others (thin objects missing from the surface,
    reflections, people). Weights vary smoothly, so no seams occur. ``uv`` (M, 3, 2): corners of the faces in
    texels, NaN for faces that no view shows; other texels keep the colours of ``cut_out``.
    """
    prepared = prepare_views(mesh, views, threads=threads)
    normals = vertex_normals(mesh)
    texture = cut_out.copy()
    drawn = np.zeros(texture.shape[:2], dtype=bool)

    def work(first: int) -> None:
        rows = slice(first, min(first + STRIP_ROWS, len(texture)))
        at, points, towards = _points_of_rows(mesh, normals, uv, rows, texture.shape[1])
        color, shown = blend_colors(prepared, points, towards)
        at = at[shown]
        texture[at[:, 0], at[:, 1]] = np.clip(np.rint(color[shown]), 0, 255)
        drawn[at[:, 0], at[:, 1]] = True

    with ThreadPoolExecutor(max(threads, 1)) as pool:
        list(pool.map(work, range(0, len(texture), STRIP_ROWS)))
    for _ in range(GROWN_TEXELS):
        grow_colors(texture, drawn)
    return texture


def prepare_views(mesh: TexturedMesh, views: Sequence[PinholeView], *, threads: int = 1) -> list[ViewSurface]:
    """The surface as each view sees it, with gains that equalise the brightness of the views."""
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        prepared = list(pool.map(lambda view: _prepared(mesh, view), views))
    stride = max(1, len(mesh.vertices) // GAIN_POINTS)
    weight, color = _observe(prepared, mesh.vertices[::stride], vertex_normals(mesh)[::stride])
    gains = _equalizing_gains(weight, color)
    return [view._replace(gain=gain) for view, gain in zip(prepared, gains, strict=True)]


def _observe(views: Sequence[ViewSurface], points: F64, normals: F64) -> tuple[F32, F32]:
    """Weights (V, N) of points in all views, 0 where one does not show them, and colours (V, N, 3)."""
    weight = np.zeros((len(views), len(points)), dtype=np.float32)
    color = np.zeros((len(views), len(points), 3), dtype=np.float32)
    for v, view in enumerate(views):
        observe_points(points, normals, view, weight[v], color[v])
    return weight, color


def blend_colors(views: Sequence[ViewSurface], points: F64, normals: F64) -> tuple[F32, B8]:
    """Colours (N, 3) of points with outward normals, and whether any view shows the point."""
    out = np.zeros((len(points), 3), dtype=np.float32)
    shown = np.zeros(len(points), dtype=bool)
    for first in range(0, len(points), POINTS_PER_CHUNK):
        some = slice(first, first + POINTS_PER_CHUNK)
        weight, color = _observe(views, points[some], normals[some])
        combine_colors(weight, color, POWER, SCATTER, out[some])
        shown[some] = weight.max(axis=0, initial=0.0) > 0.0
    return out, shown


def _points_of_rows(
    mesh: TexturedMesh, normals: F64, uv: F64, rows: slice, width: int
) -> tuple[I64, F64, F64]:
    """Texels (N, 2) as row and column, points and normals (N, 3) of some rows of the texture."""
    top, bottom = uv[..., 1].min(axis=1), uv[..., 1].max(axis=1)
    # Comparisons with NaN are false: such faces are not seen.
    some = np.flatnonzero((bottom >= rows.start - RIM_TEXELS) & (top <= rows.stop + RIM_TEXELS))
    corners = np.concatenate([uv[some], np.ones((len(some), 3, 1))], axis=2)
    corners[..., 1] -= rows.start - RIM_TEXELS
    shape = (rows.stop - rows.start + 2 * RIM_TEXELS, width)
    raster = rasterize_corners(corners, 1e-3, shape)
    face, weights = raster.face, raster.weights
    for _ in range(RIM_TEXELS):
        continue_faces(corners, BEYOND_FACE, face, weights)
    face, weights = face[RIM_TEXELS:-RIM_TEXELS], weights[RIM_TEXELS:-RIM_TEXELS]
    y, x = np.nonzero(face >= 0)
    share = weights[y, x].astype(np.float64)
    share = np.column_stack([1.0 - share.sum(axis=1), share])[:, :, None]
    vertex = mesh.faces[some[face[y, x]]]
    points, towards = ((share * values[vertex]).sum(axis=1) for values in (mesh.vertices, normals))
    return np.column_stack([y + rows.start, x]), points, towards


def _prepared(mesh: TexturedMesh, view: PinholeView) -> ViewSurface:
    camera = view_camera(view)
    depth = rasterize(mesh.vertices, mesh.faces, camera).depth
    focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    # Pixels without a surface are no outline: they may be holes.
    far = scipy.ndimage.maximum_filter(np.where(np.isfinite(depth), depth, -np.inf), 3)
    near = scipy.ndimage.minimum_filter(depth, 3)
    with np.errstate(invalid="ignore"):
        outline = far - near > OUTLINE_PX / focal * near
    inside = np.pad(np.ones_like(view.seen[1:-1, 1:-1]), 1)
    distance = scipy.ndimage.distance_transform_edt(inside & view.seen & ~outline)
    trust = np.clip(distance / FEATHER_PX, MIN_TRUST, 1.0)
    # Bilinear interpolation must not use missing pixels.
    trust[scipy.ndimage.minimum_filter(view.seen, 3) == 0] = 0.0
    tolerance = DEPTH_TOLERANCE_PX / focal
    M, gain = view.P[:, :3], np.ones(3, np.float32)
    centre = np.asarray(-np.linalg.solve(M, view.P[:, 3]), np.float64)
    scale = abs(float(np.linalg.det(M)))
    return ViewSurface(view.P, centre, scale, depth, trust.astype(np.float32), tolerance, view.rgb, gain)


def _equalizing_gains(weight: F32, color: F32) -> F32:
    """Gains (V, 3) that equalise the brightness of the views, with geometric mean 1.

    Least squares over the median log ratios of all pairs of views at points that both show.
    """
    views = len(weight)
    usable = (weight[..., None] > 0.0) & (color > DARK) & (color < BRIGHT)
    log = np.log(np.maximum(color, 1.0))
    gains = np.ones((views, 3), dtype=np.float32)
    for k in range(3):
        # The constant fixes the mean to 0, which the ratios leave undetermined.
        A, b = np.full((views, views), 1e-6), np.zeros(views)
        for i, j in combinations(range(views), 2):
            both = usable[i, :, k] & usable[j, :, k]
            if both.any():
                n = float(both.sum())
                ratio = n * float(np.median(log[j, both, k] - log[i, both, k]))
                A[[i, j], [i, j]] += n
                A[[i, j], [j, i]] -= n
                b[i] += ratio
                b[j] -= ratio
        gains[:, k] = np.exp(np.linalg.lstsq(A, b, rcond=None)[0])
    return gains
