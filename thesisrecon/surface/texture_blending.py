"""The colour of each point of a surface from all photographs that show it.

What a photograph shows of a point counts by how many pixels it spends there, less towards its border and
towards the outline of whatever stands in front, and hardly at all where it contradicts the others: something
thin that the surface lacks, a reflection, a person. Since these shares change gradually over the surface, no
seam is left between photographs.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy

from thesisrecon.arrays import B8, F32, F64, I64, U8
from thesisrecon.geometry.zbuffer import rasterize, rasterize_rows
from thesisrecon.records import PinholeView, TexturedMesh
from thesisrecon.surface.mesh import vertex_normals
from thesisrecon.surface.texture_kernels import (
    SeenSurface,
    combine_colors,
    continue_faces,
    grow_colors,
    observe_points,
)
from thesisrecon.surface.texture_views import TOLERANCE_PX, Charts, camera_of

CHUNK = 1 << 17
"""Points at a time, so that memory stays bounded."""

STRIP = 64
"""Rows of the texture at a time."""

RIM = 1
"""Texels beyond its outline that continue a piece as a surface: bilinear sampling reaches there."""

BEYOND_FACE = 4.0
"""How far beyond a face that may be, in its sides."""

BEYOND = 3
"""Texels around that which take the colours at the rim, for pictures that are drawn smaller."""

OUTLINE_PX = 10.0
"""A step in depth of so many pixels' widths between neighbours is the outline of something in front."""

FAINT = 1e-3
"""Trust in a pixel at an outline or the border of the photograph, where no other shows the place."""

GAIN_POINTS = 50_000
"""Points at which photographs are compared to find their gains."""

DARK, BRIGHT = 16.0, 240.0
"""Colours outside are clipped or nothing but noise, and say nothing of gains."""


@dataclass(frozen=True)
class BlendedViews:
    """Colours from all views that show a point.

    ``power`` of the pixels that a view spends on a point: 0 counts all alike, much more than 1 leaves the
    nearest view alone. ``scatter``: grey levels from the median of all at which a view's say is a quarter.
    ``feather_px``: width of the border along which the say of a photograph fades. ``level``: photographs are
    made equally bright first.
    """

    power: float = 2.0
    scatter: float = 20.0
    feather_px: float = 8.0
    level: bool = True

    def __post_init__(self) -> None:
        if not (self.power >= 0.0 and self.scatter > 0.0 and self.feather_px > 0.0):
            raise ValueError(
                "power >= 0, scatter > 0 and feather_px > 0 are needed; got "
                f"{self.power}, {self.scatter} and {self.feather_px}"
            )

    def paint(
        self, mesh: TexturedMesh, views: Sequence[PinholeView], charts: Charts, *, threads: int = 1
    ) -> U8:
        """The texture (H, W, 3); what no view shows well stays as it was cut out.

        The result does not depend on ``threads``.
        """
        prepared = self.prepare(mesh, views, threads=threads)
        normals = vertex_normals(mesh)
        texture = charts.cut_out.copy()
        drawn = np.zeros(texture.shape[:2], dtype=bool)

        def work(first: int) -> None:
            rows = slice(first, min(first + STRIP, len(texture)))
            at, points, towards = _points_of_rows(mesh, normals, charts, rows)
            color, shown = prepared.colors(points, towards)
            at = at[shown]
            texture[at[:, 0], at[:, 1]] = np.clip(np.rint(color[shown]), 0, 255)
            drawn[at[:, 0], at[:, 1]] = True

        with ThreadPoolExecutor(max(threads, 1)) as pool:
            list(pool.map(work, range(0, len(texture), STRIP)))
        for _ in range(BEYOND):
            grow_colors(texture, drawn)
        return texture

    def prepare(
        self, mesh: TexturedMesh, views: Sequence[PinholeView], *, threads: int = 1
    ) -> PreparedBlending:
        """What the views show of ``mesh``, ready for :meth:`PreparedBlending.colors`."""
        with ThreadPoolExecutor(max(threads, 1)) as pool:
            prepared = list(pool.map(lambda view: _prepared(mesh, view, self.feather_px), views))
        gains = np.ones((len(views), 3), dtype=np.float32)
        blending = PreparedBlending(self, tuple(prepared), gains)
        if not self.level:
            return blending
        stride = max(1, len(mesh.vertices) // GAIN_POINTS)
        normals = vertex_normals(mesh)
        weight, color = blending.observe(mesh.vertices[::stride], normals[::stride])
        return PreparedBlending(self, tuple(prepared), equalizing_gains(weight, color))


def _points_of_rows(mesh: TexturedMesh, normals: F64, charts: Charts, rows: slice) -> tuple[I64, F64, F64]:
    """Texels (N, 2) as row and column, points (N, 3) and normals (N, 3) of what is drawn in some rows."""
    uv = charts.uv
    top, bottom = uv[..., 1].min(axis=1), uv[..., 1].max(axis=1)
    some = np.flatnonzero((charts.label >= 0) & (bottom >= rows.start - RIM) & (top <= rows.stop + RIM))
    corners = np.concatenate([uv[some], np.ones((len(some), 3, 1))], axis=2)
    corners[..., 1] -= rows.start - RIM
    shape = (rows.stop - rows.start + 2 * RIM, charts.cut_out.shape[1])
    depth = np.full(shape, np.inf, dtype=np.float32)
    face = np.full(shape, -1, dtype=np.int64)
    weights = np.zeros((*shape, 2), dtype=np.float32)
    rasterize_rows(corners, 1e-3, (0, shape[0]), depth, face, weights)
    for _ in range(RIM):
        continue_faces(corners, BEYOND_FACE, face, weights)
    face, weights = face[RIM:-RIM], weights[RIM:-RIM]
    y, x = np.nonzero(face >= 0)
    share = weights[y, x].astype(np.float64)
    share = np.column_stack([1.0 - share.sum(axis=1), share])[:, :, None]
    vertex = mesh.faces[some[face[y, x]]]
    points, towards = ((share * values[vertex]).sum(axis=1) for values in (mesh.vertices, normals))
    return np.column_stack([y + rows.start, x]), points, towards


@dataclass(frozen=True)
class PreparedView:
    """A view with the nearest depth and the trust (H, W) of each pixel."""

    view: PinholeView
    depth: F32
    clear: F32
    slack: float


@dataclass(frozen=True)
class PreparedBlending:
    """Views of one surface with the gains (V, 3) that make them equally bright."""

    blending: BlendedViews
    views: tuple[PreparedView, ...]
    gains: F32

    def observe(self, points: F64, normals: F64) -> tuple[F32, F32]:
        """Weights (V, N), 0 where a view does not show a point, and colours (V, N, 3)."""
        weight = np.zeros((len(self.views), len(points)), dtype=np.float32)
        color = np.zeros((len(self.views), len(points), 3), dtype=np.float32)
        for v, one in enumerate(self.views):
            seen = SeenSurface(one.view.P, one.depth, one.clear, one.slack, one.view.rgb, self.gains[v])
            observe_points(points, normals, seen, weight[v], color[v])
        return weight, color

    def colors(self, points: F64, normals: F64) -> tuple[F32, B8]:
        """Colours (N, 3) of points (N, 3) with outer normals (N, 3), and which of them any view shows."""
        out = np.zeros((len(points), 3), dtype=np.float32)
        shown = np.zeros(len(points), dtype=bool)
        for first in range(0, len(points), CHUNK):
            some = slice(first, first + CHUNK)
            weight, color = self.observe(points[some], normals[some])
            combine_colors(weight, color, self.blending.power, self.blending.scatter, out[some])
            shown[some] = weight.max(axis=0, initial=0.0) > 0.0
        return out, shown


def _prepared(mesh: TexturedMesh, view: PinholeView, feather_px: float) -> PreparedView:
    camera = camera_of(view)
    depth = rasterize(mesh.vertices, mesh.faces, camera).depth
    focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    # Pixels without a surface say nothing: something may stand there, or there is only a hole.
    far = scipy.ndimage.maximum_filter(np.where(np.isfinite(depth), depth, -np.inf), 3)
    near = scipy.ndimage.minimum_filter(depth, 3)
    with np.errstate(invalid="ignore"):
        outline = far - near > OUTLINE_PX / focal * near
    inside = np.pad(np.ones_like(view.seen[1:-1, 1:-1]), 1)
    distance = scipy.ndimage.distance_transform_edt(inside & view.seen & ~outline)
    clear = np.clip(distance / feather_px, FAINT, 1.0)
    # Between pixels, colours are mixed: none of the four may be one that the photograph lacks.
    clear[scipy.ndimage.minimum_filter(view.seen, 3) == 0] = 0.0
    return PreparedView(view, depth, clear.astype(np.float32), TOLERANCE_PX / focal)


def equalizing_gains(weight: F32, color: F32) -> F32:
    """(V, 3) factors that make V views equally bright at common points, their geometric mean 1.

    Least squares over the medians of the logarithm of the ratio of every two views. ``weight`` (V, N) 0 where
    a view does not show a point, ``color`` (V, N, 3).
    """
    views = len(weight)
    usable = (weight[..., None] > 0.0) & (color > DARK) & (color < BRIGHT)
    log = np.log(np.maximum(color, 1.0))
    gains = np.ones((views, 3), dtype=np.float32)
    for k in range(3):
        # The constant ties the mean to 0, which the ratios leave open.
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
