"""Colours of a texture, blended from all images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from itertools import combinations, pairwise

import numpy as np
import scipy

from thesisrecon._threads import ThreadPool
from thesisrecon.arrays import B8, F32, F64, I32, I64, U8
from thesisrecon.camera import Camera
from thesisrecon.imaging.on_demand import OnDemand
from thesisrecon.imaging.raster import rasterize, rasterize_corners
from thesisrecon.records import PinholeView, TexturedMesh
from thesisrecon.surface._mesh import components, halve_surface, vertex_normals
from thesisrecon.surface._texture_kernels import (
    MAX_BLENDED,
    ViewSurface,
    combine_colors,
    continue_faces,
    diffuse,
    grow_colors,
    keep_largest,
    observe_points,
)

DEPTH_TOLERANCE_PX = 3.0
"""Depth tolerance of visible vertices in pixel sizes: the z-buffer holds one depth per pixel."""
SMOOTH_ROUNDS = 40
"""Faces over which the choice of views is smoothed."""
MIN_CHART_FACES = 30
"""Smaller charts join a neighbour."""
OWN_WEIGHT = 0.1
"""Weight of a face's own share relative to those of its neighbours."""
BUFFER_BYTES, SURFACE_BYTES = 2**28, 2**29
"""Depth buffers, and views prepared for blending, in memory; more are made again when they are used."""


def view_camera(view: PinholeView) -> Camera:
    """The camera of a view with its image size."""
    return Camera.from_matrix(view.P, (view.rgb.shape[1], view.rgb.shape[0]))


def project_to_view(camera: Camera, vertices: F64) -> tuple[F64, F64]:
    """Pixels (N, 2) of vertices, NaN behind the camera, and depths (N,)."""
    xyz = (vertices @ camera.R.T + camera.t) @ camera.K.T
    depth = xyz[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = np.where(depth[:, None] > 0.0, xyz[:, :2] / depth[:, None], np.nan)
    return xy, depth


def depth_buffers(mesh: TexturedMesh, views: Sequence[PinholeView]) -> Sequence[F32]:
    """Depth of the surface in each view (H, W), infinite where there is none; made when it is used."""

    def depth(v: int) -> F32:
        return rasterize(mesh.vertices, mesh.faces, view_camera(views[v])).depth

    return OnDemand(len(views), depth, BUFFER_BYTES)


def _visible_vertices(view: PinholeView, buffer: F32, xy: F64, depth: F64) -> B8:
    """Vertices (N,) with pixels ``xy`` and ``depth`` that lie inside the image and are not occluded."""
    camera = view_camera(view)
    width, height = camera.size
    with np.errstate(invalid="ignore"):
        inside = (xy >= 0.0).all(axis=1) & (xy[:, 0] <= width - 1.0) & (xy[:, 1] <= height - 1.0)
    x, y = np.where(inside[:, None], xy, 0.0).astype(np.int64).T
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    places = ((y, x), (y, right), (below, x), (below, right))
    farthest = np.max([buffer[place] for place in places], axis=0)
    seen = np.all([view.seen[place] for place in places], axis=0)
    tolerance = DEPTH_TOLERANCE_PX * depth / np.sqrt(camera.K[0, 0] * camera.K[1, 1])
    return np.asarray(inside & seen & (depth <= farthest + tolerance))


def face_quality(mesh: TexturedMesh, views: Sequence[PinholeView], buffers: Sequence[F32]) -> F32:
    """Count the pixels (M, V) of each face in each view, 0 if its outside is not completely visible."""
    quality = np.zeros((len(mesh.faces), len(views)), dtype=np.float32)
    for v, view in enumerate(views):
        xy, depth = project_to_view(view_camera(view), mesh.vertices)
        seen = _visible_vertices(view, buffers[v], xy, depth)
        a, b, c = (xy[mesh.faces[:, k]] for k in range(3))
        # y points down: faces that are anticlockwise from outside have a negative area.
        area = 0.5 * ((c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1]) - (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]))
        whole = seen[mesh.faces].all(axis=1) & (np.nan_to_num(area) > 0.0)
        quality[whole, v] = area[whole]
    return quality


def shows_part(mesh: TexturedMesh, views: Sequence[PinholeView]) -> bool:
    """Whether any view shows a part of the outside of a face."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    for view in views:
        camera = view_camera(view)
        drawn = rasterize(mesh.vertices, mesh.faces, camera).face[view.seen]
        drawn = drawn[drawn >= 0]
        if np.any(np.sum(normal[drawn] * (camera.centre - a[drawn]), axis=1) > 0.0):
            return True
    return False


def choose_views(
    mesh: TexturedMesh,
    views: Sequence[PinholeView],
    buffers: Sequence[F32],
    neighbours: I64,
    *,
    threads: int = 1,
) -> I64:
    """Choose the view (M,) from which each face is textured, -1 if no view sees it.

    The best view of each face alone would give many small charts. Therefore the quality of each view relative
    to the best one is diffused over the faces that it sees, and small charts join the neighbour with the
    longest common border. Eight views are in memory at a time.
    """
    visible = np.zeros((len(mesh.faces), -(-len(views) // 8)), dtype=np.uint8)
    label = np.full(len(mesh.faces), -1, dtype=np.int64)
    best, most = np.zeros((2, len(mesh.faces)), dtype=np.float32)

    def see(first: int) -> tuple[F32, I64]:
        quality = face_quality(mesh, views[first : first + 8], buffers[first : first + 8])
        visible[:, first // 8] = np.packbits(quality > 0.0, axis=1)[:, 0]
        return quality.max(axis=1), first + quality.argmax(axis=1)

    def spread_shares(first: int) -> tuple[F32, I64]:
        share = face_quality(mesh, views[first : first + 8], buffers[first : first + 8])
        share /= np.maximum(best, np.float32(1e-20))[:, None]
        spread, other = share.copy(), np.empty_like(share)
        for _ in range(SMOOTH_ROUNDS):
            diffuse(share, neighbours, OWN_WEIGHT, spread, other)
            spread, other = other, spread
        return spread.max(axis=1), first + spread.argmax(axis=1)

    with ThreadPool(threads) as pool:
        # Faces that the diffusion leaves without shares keep their best view.
        for highest, work in ((best, see), (most, spread_shares)):
            for value, view in pool.map(work, range(0, len(views), 8)):
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
    chart = label_charts(label, neighbours)
    faces = np.bincount(chart)
    small = (faces[chart] < MIN_CHART_FACES) & (label >= 0)
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


PART_TEXELS, LARGE_PART_TEXELS, CHUNK_POINTS = 1 << 17, 1 << 19, 1 << 14
"""Texels of a part of the surface if all views are in memory, and otherwise; points of one task."""
PREPARED_BYTES = 11
"""Bytes of a pixel of a view that is prepared for blending."""
BATCH_VIEWS, OBSERVED = 8, 1 << 22
"""Views that are used together; points times views from which the gains are estimated."""
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
"""Maximum number of points at which image gains are estimated; fewer with more than 80 views."""
DARK, BRIGHT = 16.0, 240.0
"""Colours outside this range are clipped or noisy and not used for gains."""
POWER = 2.0
"""Exponent of the pixels per area: 0 weighs all images equally, large values select the best one."""
SCATTER = 20.0
"""Distance from the median colour in grey levels at which the weight is a quarter."""
FEATHER_PX = 8.0
"""Width of the border in which the weight decreases."""


def paint_texture(
    mesh: TexturedMesh,
    prepared: Sequence[ViewSurface],
    cameras: Sequence[Camera],
    uv: F64,
    cut_out: U8,
    *,
    threads: int = 1,
) -> U8:
    """Compute the colours of a texture (H, W, 3) as a robust blend of all images that show a point.

    The weight of an image is its number of pixels per area, reduced towards image borders and outlines of
    foreground objects and where its colour contradicts the others (thin objects missing from the surface,
    reflections, people). Weights vary smoothly, so no seams occur. ``uv`` (M, 3, 2): corners of the faces in
    texels, NaN for faces that no view shows; other texels keep the colours of ``cut_out``. The surface is
    painted part by part, each with the views whose image can contain it.
    """
    normals = vertex_normals(mesh)
    texture = cut_out.copy()
    drawn = np.zeros(texture.shape[:2], dtype=bool)
    with ThreadPool(threads) as pool:
        pixels = sum(camera.size[0] * camera.size[1] for camera in cameras)
        texels = PART_TEXELS if PREPARED_BYTES * pixels <= SURFACE_BYTES else LARGE_PART_TEXELS
        for at, face, weights in _surface_parts(mesh, uv, texture.shape[:2], texels, pool):
            points, towards = _points_on_faces(mesh, normals, face, weights)
            box = points.min(axis=0), points.max(axis=0)
            near = [v for v, camera in enumerate(cameras) if _may_contain(camera, *box)]
            views = OnDemand(len(near), lambda n: prepared[near[n]])  # noqa: B023
            color, shown = blend_colors(views, points, towards, pool)
            texture.reshape(-1, 3)[at[shown]] = np.clip(np.rint(color[shown]), 0, 255)
            drawn.ravel()[at[shown]] = True
    for _ in range(GROWN_TEXELS):
        grow_colors(texture, drawn)
    return texture


def prepare_views(
    mesh: TexturedMesh, views: Sequence[PinholeView], buffers: Sequence[F32], *, threads: int = 1
) -> Sequence[ViewSurface]:
    """The surface as each view sees it, with gains that equalise the brightness; made when it is used."""
    prepared = OnDemand(len(views), lambda v: _prepared(views[v], buffers[v]), SURFACE_BYTES)
    stride = max(1, len(mesh.vertices) // min(GAIN_POINTS, OBSERVED // max(len(views), 1)))
    points, normals = (np.ascontiguousarray(a[::stride]) for a in (mesh.vertices, vertex_normals(mesh)))
    weight, color = _no_observations(len(views), points)

    def observe(v: int) -> None:
        observe_points(points, normals, prepared[v], weight[v], color[v])

    with ThreadPool(threads) as pool:
        list(pool.map(observe, range(len(views))))
    gains = _equalizing_gains(weight, color)
    return OnDemand(len(views), lambda v: prepared[v]._replace(gain=gains[v]))


def blend_colors(
    views: Sequence[ViewSurface], points: F64, normals: F64, pool: Executor | None = None
) -> tuple[F32, B8]:
    """Colours (N, 3) of points with outward normals, and whether any view shows the point.

    The views are used one after the other, and the observations of ``MAX_BLENDED`` are kept for each point.
    """
    slots = min(len(views), MAX_BLENDED)
    out, shown = np.zeros((len(points), 3), dtype=np.float32), np.zeros(len(points), dtype=bool)
    chunks = [slice(n, min(n + CHUNK_POINTS, len(points))) for n in range(0, len(points), CHUNK_POINTS)]
    kept = [_no_observations(slots, points[some]) for some in chunks]
    map_all = map if pool is None else pool.map
    for first in range(0, len(views), BATCH_VIEWS):
        numbers = range(first, min(first + BATCH_VIEWS, len(views)))
        batch = dict(zip(numbers, map_all(views.__getitem__, numbers), strict=True))

        def observe(some: slice, weight: F32, color: F32) -> None:
            for v, view in batch.items():  # noqa: B023
                if v < slots:
                    observe_points(points[some], normals[some], view, weight[v], color[v])
                else:
                    (one,), (its_color,) = _no_observations(1, points[some])
                    observe_points(points[some], normals[some], view, one, its_color)
                    keep_largest(one, its_color, weight, color)

        list(map_all(observe, chunks, *zip(*kept, strict=True)))
        # The next batch is made without this one in memory.
        batch.clear()

    def combine(some: slice, weight: F32, color: F32) -> None:
        combine_colors(weight, color, POWER, SCATTER, out[some])
        shown[some] = weight.max(axis=0, initial=0.0) > 0.0

    list(map_all(combine, chunks, *zip(*kept, strict=True)))
    return out, shown


def _no_observations(views: int, points: F64) -> tuple[F32, F32]:
    """Weights (V, N) of 0 and colours (V, N, 3) of points."""
    return np.zeros((views, len(points)), np.float32), np.zeros((views, len(points), 3), np.float32)


def _points_on_faces(mesh: TexturedMesh, normals: F64, face: I32, weights: F32) -> tuple[F64, F64]:
    """Points and normals (N, 3) on faces (N,) with ``weights`` (N, 2) of corners 1 and 2."""
    points, towards = np.empty((2, len(face), 3))
    for first in range(0, len(face), CHUNK_POINTS):
        some = slice(first, first + CHUNK_POINTS)
        share = weights[some].astype(np.float64)
        share = np.column_stack([1.0 - share.sum(axis=1), share])[:, :, None]
        vertex = mesh.faces[face[some]]
        points[some] = (share * mesh.vertices[vertex]).sum(axis=1)
        towards[some] = (share * normals[vertex]).sum(axis=1)
    return points, towards


def _may_contain(camera: Camera, low: F64, high: F64) -> bool:
    """Whether an image may contain points of a box: it is not completely outside one of its sides."""
    box = np.array([[(low, high)[k >> d & 1][d] for d in range(3)] for k in range(8)])
    x, y, z = camera.K @ (camera.R @ box.T + camera.t[:, None])
    width, height = camera.size
    outside = (z <= 0.0, x < -z, y < -z, x > width * z, y > height * z)
    return not any(side.all() for side in outside)


def _surface_parts(
    mesh: TexturedMesh, uv: F64, shape: tuple[int, int], largest: int, pool: Executor
) -> Iterator[tuple[I32, I32, F32]]:
    """The texels of parts of the surface, of at most ``largest`` ones each.

    Returns their numbers (N,), faces (N,), and weights (N, 2) of corners 1 and 2.
    """
    top, bottom = uv[..., 1].min(axis=1) - RIM_TEXELS, uv[..., 1].max(axis=1) + RIM_TEXELS

    def texels(first: int) -> tuple[I32, I32, F32]:
        rows = slice(first, min(first + STRIP_ROWS, shape[0]))
        # Comparisons with NaN are false: such faces are not seen.
        some = np.flatnonzero((bottom >= rows.start) & (top <= rows.stop))
        return _texels_of_rows((some, uv[some]), rows, shape[1])

    strips = list(pool.map(texels, range(0, shape[0], STRIP_ROWS)))
    at, face, weights = (np.concatenate(kind) for kind in zip(*strips, strict=True))
    del strips
    count = np.bincount(face, minlength=len(uv))
    part = halve_surface(mesh, count, largest)[face]
    # Small integers are sorted in linear time.
    order = np.argsort(part.astype(np.uint16) if part.max(initial=0) < 2**16 else part, kind="stable")
    ends = np.cumsum(np.bincount(part)).tolist()
    for first, last in pairwise([0, *ends]):
        some = order[first:last]
        if len(some):
            yield at[some], face[some], weights[some]


def _texels_of_rows(faces: tuple[I64, F64], rows: slice, width: int) -> tuple[I32, I32, F32]:
    """Numbers (N,), faces (N,) and weights (N, 2) of the texels of some rows, and of the ``faces`` there."""
    some, uv = faces
    corners = np.concatenate([uv, np.ones((len(some), 3, 1))], axis=2)
    corners[..., 1] -= rows.start - RIM_TEXELS
    shape = (rows.stop - rows.start + 2 * RIM_TEXELS, width)
    raster = rasterize_corners(corners, 1e-3, shape)
    face, weights = raster.face, raster.weights
    for _ in range(RIM_TEXELS):
        continue_faces(corners, BEYOND_FACE, face, weights)
    face, weights = face[RIM_TEXELS:-RIM_TEXELS], weights[RIM_TEXELS:-RIM_TEXELS]
    y, x = np.nonzero(face >= 0)
    at = ((y + rows.start) * width + x).astype(np.int32)
    return at, some[face[y, x]].astype(np.int32), weights[y, x]


def _prepared(view: PinholeView, depth: F32) -> ViewSurface:
    camera = view_camera(view)
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
    """Gains (V, 3) of geometric mean 1 that equalise the median colours of all pairs of views."""
    views = len(weight)
    usable = (weight[..., None] > 0.0) & (color > DARK) & (color < BRIGHT)
    log = np.maximum(color, 1.0)
    np.log(log, out=log)
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
