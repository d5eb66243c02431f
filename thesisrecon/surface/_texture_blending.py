"""Colours of a texture, blended from all images."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from itertools import combinations, pairwise, product
from typing import NamedTuple

import numpy as np
import scipy

from thesisrecon._numba import ThreadPool, empty, kernel, zeros
from thesisrecon.arrays import B8, F32, F64, I32, I64, U8
from thesisrecon.camera import Camera
from thesisrecon.imaging.on_demand import OnDemand
from thesisrecon.imaging.raster import rasterize, rasterize_rows, vertex_normals
from thesisrecon.imaging.resampling import weighted_median
from thesisrecon.records import PinholeView, TexturedMesh
from thesisrecon.surface._mesh import halve_surface

DEPTH_TOLERANCE_PX = 3.0
"""Depth tolerance of visible vertices in pixel sizes: the z-buffer holds one depth per pixel."""
BUFFER_BYTES, SURFACE_BYTES = 2**28, 2**29
"""Depth buffers, and views prepared for blending, in memory; more are made again when they are used."""


def view_camera(view: PinholeView) -> Camera:
    """The camera of a view with its image size."""
    return Camera.from_matrix(view.P, (view.rgb.shape[1], view.rgb.shape[0]))


def depth_buffers(mesh: TexturedMesh, views: Sequence[PinholeView]) -> Sequence[F32]:
    """Depth of the surface in each view (H, W), infinite where there is none; made when it is used."""

    def depth(v: int) -> F32:
        return rasterize(mesh.vertices, mesh.faces, view_camera(views[v])).depth

    return OnDemand(len(views), depth, BUFFER_BYTES)


PART_TEXELS, LARGE_PART_TEXELS, CHUNK_POINTS = 1 << 17, 1 << 19, 1 << 14
"""Texels of a part of the surface if all views are in memory, and otherwise; points of one task."""
BATCH_VIEWS, OBSERVED = 8, 1 << 22
"""Views that are used together; points times views from which the gains are estimated."""
RIM_TEXELS = 1  #: texels by which a chart is extrapolated for bilinear sampling
MAX_BLENDED = 32  #: views that are blended at a point, those of the largest weights
SCATTER = 20.0  #: distance from the median colour in grey levels at which the weight is a quarter


class ViewSurface(NamedTuple):
    """A surface seen by one view, with (u, v, 1) z = M X + p."""

    P: F64
    centre: F64
    scale: float  #: det M; pixels per area: it times the distance of ``centre`` to the tangent plane over z^3
    depth: F32  #: (H, W) inf without a surface
    trust: F32  #: (H, W) weight in 0 .. 1
    tolerance: float  #: relative depth by which visible points may lie behind ``depth``
    rgb: U8
    gain: F32  #: (3,) of the brightness


@kernel
def observe_points(points: F64, normals: F64, view: ViewSurface, weight: F32, color: F32) -> None:
    """Weights (pixels per area times trust) and colours times the gain of the points that a view shows."""
    P, centre, scale, depth, trust, tolerance, rgb, gain = view
    height, width = depth.shape
    for n in range(points.shape[0]):
        weight[n] = 0.0
        X, Y, Z = points[n]
        a, b, c = normals[n]
        towards = a * (centre[0] - X) + b * (centre[1] - Y) + c * (centre[2] - Z)
        z = P[2, 0] * X + P[2, 1] * Y + P[2, 2] * Z + P[2, 3]
        if not (z > 0.0 and towards > 0.0):
            continue
        u = (P[0, 0] * X + P[0, 1] * Y + P[0, 2] * Z + P[0, 3]) / z
        v = (P[1, 0] * X + P[1, 1] * Y + P[1, 2] * Z + P[1, 3]) / z
        if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
            continue
        x, y = int(u), int(v)
        right, below = min(x + 1, width - 1), min(y + 1, height - 1)
        farthest = max(max(depth[y, x], depth[y, right]), max(depth[below, x], depth[below, right]))
        if z * (1.0 - tolerance) > farthest:
            continue
        s, t = u - x, v - y
        upper = trust[y, x] + s * (trust[y, right] - trust[y, x])
        lower = trust[below, x] + s * (trust[below, right] - trust[below, x])
        weight[n] = np.float32((upper + t * (lower - upper)) * scale * towards / (z * z * z))
        for k in range(3):
            one, two = np.float32(rgb[y, x, k]), np.float32(rgb[y, right, k])
            three, four = np.float32(rgb[below, x, k]), np.float32(rgb[below, right, k])
            top, bottom = one + s * (two - one), three + s * (four - three)
            color[n, k] = np.float32((top + t * (bottom - top)) * gain[k])


@kernel
def _sort_weighted(values: F32, weights: F64, order: I64) -> tuple[int, float]:
    """Sort the values (V,) of positive weight by index into ``order``; return their number and weight."""
    count, total = 0, 0.0
    for v in range(len(values)):
        if weights[v] > 0.0:
            k = count
            while k > 0 and values[order[k - 1]] > values[v]:
                order[k] = order[k - 1]
                k -= 1
            order[k] = v
            count += 1
            total += weights[v]
    return count, total


@kernel
def keep_largest(one: F32, its_color: F32, weight: F32, color: F32) -> None:
    """Let the observations (N,) of one more view replace smaller ones (V, N); of equals the first stays."""
    views = weight.shape[0]
    for n in range(len(one)):
        if one[n] <= 0.0:
            continue
        least = 0
        for v in range(1, views):
            if weight[v, n] <= weight[least, n]:
                least = v
        if one[n] <= weight[least, n]:
            continue
        for v in range(least, views - 1):
            weight[v, n] = weight[v + 1, n]
            for k in range(3):
                color[v, n, k] = color[v + 1, n, k]
        weight[views - 1, n] = one[n]
        for k in range(3):
            color[views - 1, n, k] = its_color[n, k]


@kernel
def combine_colors(weight: F32, color: F32, power: float, scatter: float, out: F32) -> None:
    """Blend the colours (V, N, 3) of points; those without positive ``weight`` (V, N) stay in ``out``."""
    # Relative weight^`power` / (1 + (d / scatter)^2)^2, with the RMS distance d from the weighted median
    # colour.
    views = weight.shape[0]
    relative = empty(views)
    order = empty(views, np.int64)
    middle = empty(3)
    for n in range(weight.shape[1]):
        best = np.float32(0.0)
        for v in range(views):
            best = max(best, weight[v, n])
        if best <= 0.0:
            continue
        for v in range(views):
            relative[v] = weight[v, n] / best
        for k in range(3):
            count, sum_of_weights = _sort_weighted(color[:, n, k], relative, order)
            middle[k] = weighted_median(color[:, n, k], relative, order[:count], 0.5 * sum_of_weights)
        total = 0.0
        mean = zeros(3)
        for v in range(views):
            if relative[v] <= 0.0:
                continue
            apart = 0.0
            for k in range(3):
                apart += (color[v, n, k] - middle[k]) ** 2
            trust = 1.0 / (1.0 + apart / (3.0 * scatter * scatter))
            w = relative[v] ** power * trust * trust
            total += w
            for k in range(3):
                mean[k] += w * color[v, n, k]
        for k in range(3):
            out[n, k] = np.float32(mean[k] / total)


def continue_faces(corners: F64, farthest: float, face: I64, weights: F32) -> None:
    """Extrapolate faces to adjacent empty texels, up to barycentric coordinates of ``farthest``."""
    # `corners` (M, 3, 3): homogeneous texels; updates `face` (H, W), -1: none, and `weights` (H, W, 2).
    (height, width), before = face.shape, np.pad(face, 1, constant_values=-1)
    for top, left in ((1, 0), (1, 2), (0, 1), (2, 1)):
        beside = before[top : top + height, left : left + width]
        y, x = np.nonzero((face < 0) & (beside >= 0))
        first, second, third = corners[beside[y, x], :, :2].transpose(1, 2, 0)
        (ax, ay), (bx, by), (dx, dy) = second - first, third - first, np.stack([x, y]) - first
        area, p, q = ax * by - ay * bx, dx * by - dy * bx, ax * dy - ay * dx
        near = (np.maximum(np.abs(p), np.abs(q)) <= farthest * np.abs(area)) & (area != 0.0)
        face[y[near], x[near]] = beside[y[near], x[near]]
        weights[y[near], x[near]] = np.stack([p[near], q[near]], axis=1) / area[near, None]


def paint_texture(
    mesh: TexturedMesh, prepared: Sequence[ViewSurface], cameras: Sequence[Camera], uv: F64, cut_out: U8, *,
    threads: int = 1,
) -> U8:  # fmt: skip
    """Colours of a texture (H, W, 3) as a robust blend of all images that show a point, part by part."""
    # The weight of an image is its number of pixels per area, reduced towards image borders and outlines of
    # foreground objects and where its colour contradicts the others. Weights vary smoothly, so no seams
    # occur. `uv` (M, 3, 2): corners in texels, NaN for faces that no view shows; other texels keep the
    # colours of `cut_out`.
    prepared_bytes = 11  # Bytes of a pixel of a view that is prepared for blending
    grown_texels = 3  # Further texels that take the colours of the rim, for reduced textures
    normals = vertex_normals(mesh)
    texture = cut_out.copy()
    drawn = np.zeros(texture.shape[:2], dtype=bool)
    with ThreadPool(threads) as pool:
        pixels = sum(camera.size[0] * camera.size[1] for camera in cameras)
        texels = PART_TEXELS if prepared_bytes * pixels <= SURFACE_BYTES else LARGE_PART_TEXELS
        for at, face, weights in _surface_parts(mesh, uv, texture.shape[:2], texels, pool):
            points, towards = np.empty((2, len(face), 3))
            for first in range(0, len(face), CHUNK_POINTS):
                some = slice(first, first + CHUNK_POINTS)
                share = weights[some].astype(np.float64)
                share = np.column_stack([1.0 - share.sum(axis=1), share])[:, :, None]
                vertex = mesh.faces[face[some]]
                points[some] = (share * mesh.vertices[vertex]).sum(axis=1)
                towards[some] = (share * normals[vertex]).sum(axis=1)
            box = points.min(axis=0), points.max(axis=0)
            near = [v for v, camera in enumerate(cameras) if _may_contain(camera, *box)]
            views = OnDemand(len(near), lambda n: prepared[near[n]])  # noqa: B023
            color, shown = blend_colors(views, points, towards, pool)
            texture.reshape(-1, 3)[at[shown]] = np.clip(np.rint(color[shown]), 0, 255)
            drawn.ravel()[at[shown]] = True
    height, width = texture.shape[:2]
    for _ in range(grown_texels):
        # The drawn texels are extended by the mean of their neighbours.
        y, x = np.nonzero(scipy.ndimage.binary_dilation(drawn, np.ones((3, 3))) & ~drawn)
        total, count = np.zeros((len(y), 3)), np.zeros(len(y), np.int64)
        for dy, dx in product((-1, 0, 1), repeat=2):
            # Beyond the border a texel is its own neighbour, which is not drawn.
            inside = (y + dy >= 0) & (y + dy < height) & (x + dx >= 0) & (x + dx < width)
            place = np.where(inside, y + dy, y), np.where(inside, x + dx, x)
            total += texture[place] * drawn[place][:, None]
            count += drawn[place]
        texture[y, x] = (total / count[:, None] + 0.5).astype(np.uint8)
        drawn[y, x] = True
    return texture


def prepare_views(
    mesh: TexturedMesh, views: Sequence[PinholeView], buffers: Sequence[F32], *, threads: int = 1
) -> Sequence[ViewSurface]:
    """The surface as each view sees it, with gains that equalise the brightness; made when it is used."""
    # Maximum number of points at which image gains are estimated; fewer with more than 80 views.
    gain_points = 50_000
    prepared = OnDemand(len(views), lambda v: _prepared(views[v], buffers[v]), SURFACE_BYTES)
    stride = max(1, len(mesh.vertices) // min(gain_points, OBSERVED // max(len(views), 1)))
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
    """Colours (N, 3) of points with outward normals, and whether any view shows the point."""
    # Exponent of the pixels per area: 0 weighs all images equally, large values select the best one.
    power = 2.0
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
        combine_colors(weight, color, power, SCATTER, out[some])
        shown[some] = weight.max(axis=0, initial=0.0) > 0.0

    list(map_all(combine, chunks, *zip(*kept, strict=True)))
    return out, shown


def _no_observations(views: int, points: F64) -> tuple[F32, F32]:
    """Weights (V, N) of 0 and colours (V, N, 3) of points."""
    return np.zeros((views, len(points)), np.float32), np.zeros((views, len(points), 3), np.float32)


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
    """Numbers (N,), faces and weights (N, 2) of corners 1 and 2 of at most ``largest`` texels at a time."""
    strip_rows = 64  # Rows of the texture processed at a time
    beyond_face = 4.0  # Limit of the extrapolation to the rim in sides of a face
    top, bottom = uv[..., 1].min(axis=1) - RIM_TEXELS, uv[..., 1].max(axis=1) + RIM_TEXELS

    def texels(first: int) -> tuple[I32, I32, F32]:
        rows = slice(first, min(first + strip_rows, shape[0]))
        # Comparisons with NaN are false: such faces are not seen.
        some = np.flatnonzero((bottom >= rows.start) & (top <= rows.stop))
        corners = np.concatenate([uv[some], np.ones((len(some), 3, 1))], axis=2)
        corners[..., 1] -= rows.start - RIM_TEXELS
        raster = rasterize_rows(corners, 1e-3, (0, rows.stop - rows.start + 2 * RIM_TEXELS), shape[1])
        for _ in range(RIM_TEXELS):
            continue_faces(corners, beyond_face, raster.face, raster.weights)
        inner = raster[RIM_TEXELS:-RIM_TEXELS]
        y, x = np.nonzero(inner.face >= 0)
        at = ((y + rows.start) * shape[1] + x).astype(np.int32)
        return at, some[inner.face[y, x]].astype(np.int32), inner.weights[y, x]

    strips = list(pool.map(texels, range(0, shape[0], strip_rows)))
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


def _prepared(view: PinholeView, depth: F32) -> ViewSurface:
    outline_px = 10.0  # Depth step in pixel sizes that marks the outline of a foreground object
    # Weight of pixels at outlines and image borders, which count where no other image shows the point.
    min_trust = 1e-3
    feather_px = 8.0  # Width of the border in which the weight decreases
    camera = view_camera(view)
    focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    # Pixels without a surface are no outline: they may be holes.
    far = scipy.ndimage.maximum_filter(np.where(np.isfinite(depth), depth, -np.inf), 3)
    near = scipy.ndimage.minimum_filter(depth, 3)
    with np.errstate(invalid="ignore"):
        outline = far - near > outline_px / focal * near
    inside = np.pad(np.ones_like(view.seen[1:-1, 1:-1]), 1)
    distance = scipy.ndimage.distance_transform_edt(inside & view.seen & ~outline)
    trust = np.clip(distance / feather_px, min_trust, 1.0)
    # Bilinear interpolation must not use missing pixels.
    trust[scipy.ndimage.minimum_filter(view.seen, 3) == 0] = 0.0
    tolerance = DEPTH_TOLERANCE_PX / focal
    M, gain = view.P[:, :3], np.ones(3, np.float32)
    centre = np.asarray(-np.linalg.solve(M, view.P[:, 3]), np.float64)
    scale = abs(float(np.linalg.det(M)))
    return ViewSurface(view.P, centre, scale, depth, trust.astype(np.float32), tolerance, view.rgb, gain)


def _equalizing_gains(weight: F32, color: F32) -> F32:
    """Gains (V, 3) of geometric mean 1 that equalise the median colours of all pairs of views."""
    dark, bright = 16.0, 240.0  # Colours outside this range are clipped or noisy and not used for gains
    views = len(weight)
    usable = (weight[..., None] > 0.0) & (color > dark) & (color < bright)
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
