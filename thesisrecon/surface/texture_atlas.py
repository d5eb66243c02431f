"""Texture atlas of a mesh: charts in the geometry of an image, packed into one texture.

A chart consists of connected faces that are assigned to one image and has the outline and resolution of that
image. Its colours are blended from all images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import F64, I64, U8, resizing_transform
from thesisrecon.camera import Camera
from thesisrecon.errors import Notice, StageFailure
from thesisrecon.imaging.filters import resample, smooth
from thesisrecon.imaging.on_demand import OnDemand
from thesisrecon.records import PinholeView, TexturedMesh
from thesisrecon.surface._mesh import connected_parts, face_neighbours, select_faces
from thesisrecon.surface._texture_blending import (
    choose_views,
    depth_buffers,
    label_charts,
    paint_texture,
    prepare_views,
    project_to_view,
    shows_part,
)

CHART_MARGIN = 2
"""Pixels around each chart, so that reduced textures do not mix charts."""
SWATCH = 3
"""Texels per side of the patch of unseen faces of similar colour."""
COLOR_STEP = 16
"""Grey levels of a channel that share a patch."""
MIN_SCALE = 0.05
"""Smallest reduction of the images."""
REDUCED_BYTES = 2**28
"""Reduced images in memory; more are made again when they are used."""


@dataclass(frozen=True)
class TextureAtlas:
    """Texture at the resolution of the view that shows each part of the surface best (2.6).

    Parameters
    ----------
    max_texels : int
        Limit of the texture size; images are reduced to fit.
    """

    max_texels: int = 4096 * 4096

    def __post_init__(self) -> None:
        if self.max_texels < 1:
            raise ValueError(f"max_texels must be >= 1; got {self.max_texels}")

    def texture(self, mesh: TexturedMesh, views: Sequence[PinholeView], *, threads: int = 1) -> TexturedMesh:
        """Texture a mesh.

        Parameters
        ----------
        mesh, views : TexturedMesh, sequence of PinholeView
            Surface, and undistorted images with their cameras.
        threads : int
            Number of threads; the result does not depend on it.

        Returns
        -------
        TexturedMesh
            The mesh with a texture; unseen faces get the colour of their surroundings.

        Raises
        ------
        StageFailure
            If no view shows a face completely, or the atlas is too large even with images reduced to
            ``MIN_SCALE``.
        """
        neighbours = face_neighbours(mesh.faces)
        frames = [(view.P, (view.rgb.shape[1], view.rgb.shape[0])) for view in views]
        buffers = depth_buffers(mesh, views)
        label = choose_views(mesh, views, buffers, neighbours, threads=threads)
        if not (label >= 0).any():
            if shows_part(mesh, views):
                evidence = "images show parts of faces, but none shows a face completely"
                raise StageFailure("the surface has no texture", evidence, "subdivide the mesh")
            raise StageFailure(Notice("no-texture"), "no image shows any part of it")
        chart = label_charts(label, neighbours)
        scale = 1.0
        while True:
            cameras = [_reduced_camera(P, size, scale) for P, size in frames]
            xy = _corners(mesh, cameras, label)
            rectangles = _rectangles(xy, label, chart, cameras)
            offsets, size = _pack_rectangles(rectangles[:, 2:] - rectangles[:, :2])
            if size[0] * size[1] <= self.max_texels:
                break
            if scale <= MIN_SCALE:
                texels = size[0] * size[1]
                raise StageFailure(
                    "the texture is too large",
                    f"{len(rectangles)} charts need {texels} texels, the limit is {self.max_texels}",
                    "increase max_texels",
                )
            scale = max(0.95 * scale * np.sqrt(self.max_texels / (size[0] * size[1])), MIN_SCALE)
        uv = xy + (offsets - rectangles[:, :2])[chart][:, None, :]
        if scale < 1.0:
            given = views
            views = OnDemand(len(given), lambda v: _reduced(given[v], scale), REDUCED_BYTES)
            buffers = depth_buffers(mesh, views)
        cut_out = _fill(views, label[np.unique(chart, return_index=True)[1]], rectangles, offsets, size)
        seen_uv = np.where((label >= 0)[:, None, None], uv, np.nan)
        prepared = prepare_views(mesh, views, buffers, threads=threads)
        texture = paint_texture(mesh, prepared, cameras, seen_uv, cut_out, threads=threads)
        uv, texture = _swatches(neighbours, label, uv, texture)
        return replace(mesh, uv=uv, texture=texture, colors=None, untextured=label < 0)


def _scaling(size: tuple[int, int], scale: float) -> tuple[F64, tuple[int, int]]:
    """Matrix (3, 3) from pixels of an image to those of the reduced one, and its (width, height)."""
    width, height = (max(1, round(scale * n)) for n in size)
    return resizing_transform(np.divide((width, height), size)), (width, height)


def _reduced_camera(P: F64, size: tuple[int, int], scale: float) -> Camera:
    if scale >= 1.0:
        return Camera.from_matrix(P, size)
    S, reduced = _scaling(size, scale)
    return Camera.from_matrix(S @ P, reduced)


def _reduced(view: PinholeView, scale: float) -> PinholeView:
    """The view with ``scale`` < 1 times as many pixels per side."""
    S, (width, height) = _scaling((view.rgb.shape[1], view.rgb.shape[0]), scale)
    blur = 0.5 * np.sqrt(max(1.0 / scale**2 - 1.0, 1e-6))
    planes = [resample(smooth(view.rgb[..., k].astype(np.float32), blur), width, height) for k in range(3)]
    seen = resample(view.seen.astype(np.float32), width, height) > 0.999
    rgb = np.clip(np.rint(np.stack(planes, axis=-1)), 0, 255).astype(np.uint8)
    return PinholeView(view.view, S @ view.P, rgb, seen)


def _corners(mesh: TexturedMesh, cameras: Sequence[Camera], label: I64) -> F64:
    """(M, 3, 2) corners of each face in its view in pixels, 0 without a view."""
    xy = np.zeros((len(mesh.faces), 3, 2))
    for v, camera in enumerate(cameras):
        mine = label == v
        xy[mine] = project_to_view(camera, mesh.vertices)[0][mesh.faces[mine]]
    return xy


def _rectangles(xy: F64, label: I64, chart: I64, cameras: Sequence[Camera]) -> I64:
    """(C, 4) left, top, right, bottom of each chart in its image, the last two exclusive."""
    charts = int(chart.max()) + 1
    low = np.full((charts, 2), np.iinfo(np.int64).max)
    high = np.full((charts, 2), -1)
    view = np.zeros(charts, dtype=np.int64)
    seen = label >= 0
    view[chart[seen]] = label[seen]
    np.minimum.at(low, chart[seen], np.floor(xy[seen].min(axis=1)).astype(np.int64))
    np.maximum.at(high, chart[seen], np.ceil(xy[seen].max(axis=1)).astype(np.int64) + 1)
    sizes = np.array([camera.size for camera in cameras])[view]
    low = np.where(high < 0, 0, np.maximum(low - CHART_MARGIN, 0))
    high = np.where(high < 0, 0, np.minimum(high + CHART_MARGIN, sizes))
    return np.concatenate([low, high], axis=1)


def _pack_rectangles(sizes: I64) -> tuple[I64, tuple[int, int]]:
    """Positions (C, 2) of rectangles on shelves of decreasing height, and (width, height) of their box."""
    width = max(
        int(np.ceil(1.05 * np.sqrt(float(sizes.prod(axis=1).sum())))), int(sizes[:, 0].max(initial=1))
    )
    places = np.zeros_like(sizes)
    x, y, shelf, widest = 0, 0, 0, 1
    for c in np.lexsort((np.arange(len(sizes)), -sizes[:, 0], -sizes[:, 1])):
        w, h = sizes[c]
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        places[c] = x, y
        x, shelf, widest = x + w, max(shelf, h), max(widest, x + w)
    return places, (int(widest), int(max(y + shelf, 1)))


def _fill(
    views: Sequence[PinholeView], label: I64, rectangles: I64, offsets: I64, size: tuple[int, int]
) -> U8:
    """Texture (H, W, 3): the rectangle of each chart, copied from view ``label`` to its place."""
    texture = np.full((size[1], size[0], 3), 128, dtype=np.uint8)
    # View by view, so that each is made once.
    for c in np.argsort(label, kind="stable"):
        (left, top, right, bottom), (x, y) = rectangles[c], offsets[c]
        if label[c] >= 0:
            rgb = views[label[c]].rgb
            texture[y : y + bottom - top, x : x + right - left] = rgb[top:bottom, left:right]
    return texture


def cut_tile(mesh: TexturedMesh, faces: I64) -> TexturedMesh:
    """Cut the faces (K,), in increasing order, out of a mesh, with the part of the texture that they show.

    Every texel is the one of the whole texture, and corners on the cut keep their places, so that tiles fit.
    """
    keep = np.zeros(len(mesh.faces), dtype=bool)
    keep[faces] = True
    tile = select_faces(mesh, keep)
    if tile.uv is None or tile.texture is None:
        return tile
    # Faces with a common corner in the texture are one chart.
    corners = np.column_stack([tile.faces.ravel(), tile.uv.reshape(-1, 2)])
    number = np.unique(corners, axis=0, return_inverse=True)[1].reshape(-1, 3)
    chart = connected_parts(number, int(number.max(initial=-1)) + 1)
    size = np.array(tile.texture.shape[1::-1])
    low = np.full((int(chart.max(initial=-1)) + 1, 2), np.inf)
    high = np.full_like(low, -np.inf)
    np.minimum.at(low, chart, tile.uv.min(axis=1))
    np.maximum.at(high, chart, tile.uv.max(axis=1))
    first = np.clip(np.floor(low).astype(np.int64) - CHART_MARGIN, 0, size - 1)
    last = np.clip(np.ceil(high).astype(np.int64) + 1 + CHART_MARGIN, 1, size)
    offsets, (width, height) = _pack_rectangles(last - first)
    texture = np.full((height, width, 3), 128, dtype=np.uint8)
    for (left, top), (right, bottom), (x, y) in zip(first, last, offsets, strict=True):
        texture[y : y + bottom - top, x : x + right - left] = tile.texture[top:bottom, left:right]
    return replace(tile, uv=tile.uv + (offsets - first)[chart][:, None, :], texture=texture)


def _swatches(neighbours: I64, label: I64, uv: F64, texture: U8) -> tuple[F64, U8]:
    """Append patches with the colours of unseen faces: those of the nearest seen faces along the surface."""
    unseen = np.flatnonzero(label < 0)
    if not len(unseen):
        return uv, texture
    color = _surroundings(neighbours, label, uv, texture)[unseen]
    code, patch = np.unique(color // COLOR_STEP @ (1 << 16, 1 << 8, 1), return_inverse=True)
    size = np.bincount(patch)
    shades = np.stack([np.rint(np.bincount(patch, color[:, k]) / size) for k in range(3)], axis=1)
    columns = max(texture.shape[1] // SWATCH, 1)
    rows = -(-len(code) // columns)
    strip = np.full((rows * SWATCH, texture.shape[1], 3), 128, dtype=np.uint8)
    row, column = np.divmod(np.arange(len(code)), columns)
    for dy in range(SWATCH):
        for dx in range(min(SWATCH, texture.shape[1])):
            strip[row * SWATCH + dy, column * SWATCH + dx] = shades
    uv = uv.copy()
    middle = np.stack([column * SWATCH + SWATCH // 2, texture.shape[0] + row * SWATCH + SWATCH // 2], axis=1)
    uv[unseen] = middle[patch][:, None, :]
    return uv, np.concatenate([texture, strip])


def _surroundings(neighbours: I64, label: I64, uv: F64, texture: U8) -> U8:
    """(M, 3) uint8 colours of seen faces, propagated from face to face to unseen ones."""
    x, y = np.clip(np.rint(uv.mean(axis=1)).astype(np.int64), 0, np.array(texture.shape[1::-1]) - 1).T
    known = label >= 0
    color = np.where(known[:, None], texture[y, x], 0).astype(np.float64)
    while not known.all():
        open_ = np.flatnonzero(~known)
        around = neighbours[open_]
        known_side = (around >= 0) & known[around]
        reached = known_side.any(axis=1)
        if not reached.any():
            color[~known] = color[known].mean(axis=0)
            break
        weights = known_side[reached].astype(np.float64)
        mean = (color[around[reached]] * weights[..., None]).sum(axis=1) / weights.sum(axis=1)[:, None]
        color[open_[reached]] = mean
        known[open_[reached]] = True
    return np.rint(color).astype(np.uint8)
