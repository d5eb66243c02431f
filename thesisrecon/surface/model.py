"""Textured surface model of a scene from all depth maps (thesis, section 2.6), and its texture atlas.

A chart consists of connected faces assigned to one image, at its resolution; colours are blended from all.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from thesisrecon._numba import ThreadPool
from thesisrecon.arrays import B8, F32, F64, I64, U8, resizing_transform
from thesisrecon.camera import Camera
from thesisrecon.errors import Notice, StageFailure, require_range
from thesisrecon.imaging.on_demand import OnDemand
from thesisrecon.imaging.resampling import resample, smooth
from thesisrecon.records import DepthMap, PinholeView, TexturedMesh
from thesisrecon.surface import _texture_blending
from thesisrecon.surface._mesh import components, face_neighbours
from thesisrecon.surface.bspline import BSplineSurface
from thesisrecon.surface.fusion import DepthSheets, VolumetricFusion

CHART_MARGIN = 2  #: pixels around each chart, so that reduced textures do not mix charts
MAX_TEXELS = 4096 * 4096
REDUCED_BYTES = 2**28  #: reduced images in memory; more are made again when they are used


def texture_mesh(
    mesh: TexturedMesh, views: Sequence[PinholeView], *, max_texels: int = MAX_TEXELS, threads: int = 1,
) -> TexturedMesh:  # fmt: skip
    """Texture a mesh at the resolution of the best view of each part, up to ``max_texels`` (2.6)."""
    min_scale = 0.05  # Smallest reduction of the images
    neighbours = face_neighbours(mesh.faces)
    given = [_texture_blending.view_camera(view) for view in views]
    buffers = _texture_blending.depth_buffers(mesh, views)
    label = choose_views(mesh, views, buffers, neighbours, threads=threads)
    if not (label >= 0).any():
        raise StageFailure(Notice("no-texture"), "no image shows the outside of a face completely")
    chart = label_charts(label, neighbours)
    scale = 1.0
    while True:
        cameras = [camera.scaled(scale) for camera in given] if scale < 1.0 else given
        xy = _corners(mesh, cameras, label)
        rectangles = _rectangles(xy, label, chart, np.array([camera.size for camera in cameras]))
        offsets, size = _pack_rectangles(rectangles[:, 2:] - rectangles[:, :2])
        if size[0] * size[1] <= max_texels:
            break
        if scale <= min_scale:
            raise StageFailure.of("large-texture", len(rectangles), size[0] * size[1], max_texels)
        scale = max(0.95 * scale * np.sqrt(max_texels / (size[0] * size[1])), min_scale)
    uv = xy + (offsets - rectangles[:, :2])[chart][:, None, :]
    if scale < 1.0:
        whole = views
        views = OnDemand(len(whole), lambda v: _reduced(whole[v], scale), REDUCED_BYTES)
        buffers = _texture_blending.depth_buffers(mesh, views)
    # The rectangle of each chart is copied from its view, view by view, so that each is made once.
    cut_out, view_of = np.full((*size[::-1], 3), 128, np.uint8), label[np.unique(chart, return_index=True)[1]]
    for c in np.argsort(view_of, kind="stable"):
        (left, top, right, bottom), (x, y) = rectangles[c], offsets[c]
        if view_of[c] >= 0:
            rgb = views[int(view_of[c])].rgb
            cut_out[y : y + bottom - top, x : x + right - left] = rgb[top:bottom, left:right]
    seen_uv = np.where((label >= 0)[:, None, None], uv, np.nan)
    prepared = _texture_blending.prepare_views(mesh, views, buffers, threads=threads)
    texture = _texture_blending.paint_texture(mesh, prepared, cameras, seen_uv, cut_out, threads=threads)
    uv, texture = _swatches(neighbours, label, uv, texture)
    return replace(mesh, uv=uv, texture=texture, colors=None, untextured=label < 0)


def project_to_view(camera: Camera, vertices: F64) -> tuple[F64, F64]:
    """Pixels (N, 2) of vertices, NaN behind the camera, and depths (N,)."""
    xyz = (vertices @ camera.R.T + camera.t) @ camera.K.T
    depth = xyz[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = np.where(depth[:, None] > 0.0, xyz[:, :2] / depth[:, None], np.nan)
    return xy, depth


def face_quality(mesh: TexturedMesh, views: Sequence[PinholeView], buffers: Sequence[F32]) -> F32:
    """Count the pixels (M, V) of each face in each view, 0 if its outside is not completely visible."""
    quality = np.zeros((len(mesh.faces), len(views)), dtype=np.float32)
    for v, view in enumerate(views):
        camera, buffer = _texture_blending.view_camera(view), buffers[v]
        xy, depth = project_to_view(camera, mesh.vertices)
        # Vertices inside the image that are not occluded.
        last = np.array(camera.size) - 1
        with np.errstate(invalid="ignore"):
            inside: B8 = np.asarray(((xy >= 0.0) & (xy <= last)).all(axis=1))
        x, y = near = np.where(inside[:, None], xy, 0.0).astype(np.int64).T
        right, below = np.minimum(near + 1, last[:, None])
        places = ((y, x), (y, right), (below, x), (below, right))
        farthest = np.max([buffer[place] for place in places], axis=0)
        tolerance = _texture_blending.DEPTH_TOLERANCE_PX * depth / np.sqrt(camera.K[0, 0] * camera.K[1, 1])
        seen = inside & (depth <= farthest + tolerance)
        seen &= np.all([view.seen[place] for place in places], axis=0)
        a, b, c = (xy[mesh.faces[:, k]] for k in range(3))
        # y points down: faces that are anticlockwise from outside have a negative area.
        area = 0.5 * ((c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1]) - (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]))
        whole = seen[mesh.faces].all(axis=1) & (np.nan_to_num(area) > 0.0)
        quality[whole, v] = area[whole]
    return quality


def choose_views(
    mesh: TexturedMesh, views: Sequence[PinholeView], buffers: Sequence[F32], neighbours: I64, *,
    threads: int = 1,
) -> I64:  # fmt: skip
    """Choose the view (M,) from which each face is textured, -1 if no view sees it.

    Quality relative to the best view is diffused over the faces that a view sees, and small charts join the
    neighbour with the longest common border: few charts. Eight views are in memory at a time.
    """
    smooth_rounds = 40  # Faces over which the choice of views is smoothed
    own_weight = np.float32(0.1)  # Weight of a face's own share relative to those of its neighbours
    face, side = np.nonzero(neighbours >= 0)
    part = (1.0 - own_weight) / np.bincount(face, minlength=len(mesh.faces))[face]
    every = (part.astype(np.float32), (face, neighbours[face, side]))
    across = scipy.sparse.csr_array(every, shape=(len(mesh.faces), len(mesh.faces)))
    visible = np.zeros((len(mesh.faces), -(-len(views) // 8)), dtype=np.uint8)
    label = np.full(len(mesh.faces), -1, dtype=np.int64)
    best, most = np.zeros((2, len(mesh.faces)), dtype=np.float32)

    def quality_of_eight(first: int) -> F32:
        return face_quality(mesh, views[first : first + 8], buffers[first : first + 8])

    def best_of_eight(first: int) -> tuple[F32, I64]:
        quality = quality_of_eight(first)
        visible[:, first // 8] = np.packbits(quality > 0.0, axis=1)[:, 0]
        return quality.max(axis=1), first + quality.argmax(axis=1)

    def smoothest_of_eight(first: int) -> tuple[F32, I64]:
        share = np.asarray(quality_of_eight(first) / np.maximum(best, 1e-20)[:, None], dtype=np.float32)
        spread = share
        for _ in range(smooth_rounds):
            spread = np.where(share > 0.0, own_weight * share + across @ spread, np.float32(0.0))
        return spread.max(axis=1), first + spread.argmax(axis=1)

    with ThreadPool(threads) as pool:
        # Faces that the diffusion leaves without shares keep their best view.
        for highest, of_eight in ((best, best_of_eight), (most, smoothest_of_eight)):
            for value, view in pool.map(of_eight, range(0, len(views), 8)):
                higher = value > highest
                highest[higher], label[higher] = value[higher], view[higher]
    for _ in range(3):
        label = _join_small(label, visible, neighbours)
    return label


def label_charts(label: I64, neighbours: I64) -> I64:
    """Label the connected faces of one view."""
    face = np.repeat(np.arange(len(label)), 3)
    other = neighbours.ravel()
    same = (other >= 0) & (label[face] == label[other])
    return components(face[same], other[same], len(label))


def _join_small(label: I64, visible: U8, neighbours: I64) -> I64:
    """Join small charts to a neighbour; the bits of ``visible`` (M, V / 8) are the views that see a face."""
    min_chart_faces = 30  # Smaller charts join a neighbour
    chart = label_charts(label, neighbours)
    faces = np.bincount(chart)
    small = (faces[chart] < min_chart_faces) & (label >= 0)
    # A chart can take over a view that sees all of its faces.
    sees = np.full((len(faces), visible.shape[1]), 255, dtype=np.uint8)
    np.bitwise_and.at(sees, chart[small], visible[small])
    face, side = np.nonzero(small[:, None] & (neighbours >= 0))
    view = label[neighbours[face, side]]
    crossing = (view >= 0) & (view != label[face])
    borders, length = np.unique(
        np.column_stack([chart[face[crossing]], view[crossing]]), axis=0, return_counts=True
    )
    common = (sees[borders[:, 0], borders[:, 1] // 8] >> (7 - borders[:, 1] % 8)) & 1 > 0
    (chart_of, view_of), length = borders[common].T, length[common]
    # The last assignment counts: the longest border, of equal ones the first view.
    order = np.lexsort((-view_of, length))
    joined = np.full(len(faces), -1)
    joined[chart_of[order]] = view_of[order]
    return np.where(small & (joined[chart] >= 0), joined[chart], label)


def _reduced(view: PinholeView, scale: float) -> PinholeView:
    """The view with ``scale`` < 1 times as many pixels per side."""
    width, height = _texture_blending.view_camera(view).scaled(scale).size
    S = resizing_transform(np.divide((width, height), view.rgb.shape[1::-1]))
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


def _rectangles(xy: F64, label: I64, chart: I64, sizes: I64) -> I64:
    """(C, 4) left, top, right, bottom of each chart in its view of ``sizes`` (V, 2), the last exclusive."""
    charts = int(chart.max(initial=-1)) + 1
    low, high = np.full((charts, 2), np.inf), np.full((charts, 2), -np.inf)
    view, seen = np.zeros(charts, dtype=np.int64), label >= 0
    view[chart[seen]] = label[seen]
    np.minimum.at(low, chart[seen], xy[seen].min(axis=1))
    np.maximum.at(high, chart[seen], xy[seen].max(axis=1))
    shown = np.isfinite(low)
    low = np.clip(np.floor(np.where(shown, low, 0.0)).astype(np.int64) - CHART_MARGIN, 0, sizes[view] - 1)
    high = np.clip(np.ceil(np.where(shown, high, 0.0)).astype(np.int64) + 1 + CHART_MARGIN, 1, sizes[view])
    low, high = np.where(shown, low, 0), np.where(shown, high, 0)
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


def _swatches(neighbours: I64, label: I64, uv: F64, texture: U8) -> tuple[F64, U8]:
    """Append patches with the colours of unseen faces: those of the nearest seen faces along the surface."""
    swatch = 3  # Texels per side of the patch of unseen faces of similar colour
    color_step = 16  # Grey levels of a channel that share a patch
    unseen = np.flatnonzero(label < 0)
    if not len(unseen):
        return uv, texture
    # Colours of seen faces are propagated from face to face to unseen ones.
    x, y = np.clip(np.rint(uv.mean(axis=1)).astype(np.int64), 0, np.array(texture.shape[1::-1]) - 1).T
    known = label >= 0
    every = np.where(known[:, None], texture[y, x], 0).astype(np.float64)
    while not known.all():
        open_ = np.flatnonzero(~known)
        around = neighbours[open_]
        known_side = (around >= 0) & known[around]
        reached = known_side.any(axis=1)
        if not reached.any():
            every[~known] = every[known].mean(axis=0)
            break
        weights = known_side[reached].astype(np.float64)
        mean = (every[around[reached]] * weights[..., None]).sum(axis=1) / weights.sum(axis=1)[:, None]
        every[open_[reached]] = mean
        known[open_[reached]] = True
    color = np.rint(every).astype(np.uint8)[unseen]
    code, patch = np.unique(color // color_step @ (1 << 16, 1 << 8, 1), return_inverse=True)
    size = np.bincount(patch)
    shades = np.stack([np.rint(np.bincount(patch, color[:, k]) / size) for k in range(3)], axis=1)
    columns = max(texture.shape[1] // swatch, 1)
    rows = -(-len(code) // columns)
    strip = np.full((rows * swatch, texture.shape[1], 3), 128, dtype=np.uint8)
    row, column = np.divmod(np.arange(len(code)), columns)
    for dy in range(swatch):
        for dx in range(min(swatch, texture.shape[1])):
            strip[row * swatch + dy, column * swatch + dx] = shades
    uv = uv.copy()
    middle = np.stack([column * swatch + swatch // 2, texture.shape[0] + row * swatch + swatch // 2], axis=1)
    uv[unseen] = middle[patch][:, None, :]
    return uv, np.concatenate([texture, strip])


@dataclass(frozen=True)
class LinearSurface:
    """Piecewise linear surface through all depths: the map itself."""

    def smooth(self, depth_map: DepthMap) -> DepthMap:
        """See `thesisrecon.surface.bspline.BSplineSurface.smooth`; the map is unchanged."""
        return depth_map


@dataclass(frozen=True)
class SurfaceModel:
    """Fit, fuse and texture the surfaces of depth maps."""

    surface: LinearSurface | BSplineSurface = field(default_factory=LinearSurface)
    """Surface fitted to each depth map."""
    fusion: VolumetricFusion | DepthSheets = field(default_factory=VolumetricFusion)
    """Fusion of these surfaces."""
    max_glb_mb: float = 50.0
    """Largest size of model.glb in megabytes, at least 5; the mesh of a larger one is reduced, and
    model-full.glb holds all of it."""

    def __post_init__(self) -> None:
        require_range(self, max_glb_mb="[5, inf]")

    def build(
        self, depth_maps: Sequence[DepthMap], views: Sequence[PinholeView], *, threads: int = 1
    ) -> TexturedMesh:
        """See `thesisrecon.config.ModelBuilder.build`."""
        return self.color(self.surface_of(depth_maps, threads=threads), views, threads=threads)

    def surface_of(self, depth_maps: Sequence[DepthMap], *, threads: int = 1) -> TexturedMesh:
        """Build the surface without colours."""
        if isinstance(self.surface, BSplineSurface):
            with ThreadPool(threads) as pool:
                depth_maps = list(pool.map(self.surface.smooth, depth_maps))
        return self.fusion.fuse(depth_maps, threads=threads)

    def color(self, surface: TexturedMesh, views: Sequence[PinholeView], *, threads: int = 1) -> TexturedMesh:
        """See `thesisrecon.config.ModelBuilder.color`."""
        return texture_mesh(surface, views, threads=threads)
