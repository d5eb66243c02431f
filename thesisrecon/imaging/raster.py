"""Z-buffer: the mesh face that each pixel of a camera sees, exact in perspective.

A camera with a lens has the faces at the nearest pixels of pinhole views, and the exact places of its rays on
them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from thesisrecon._numba import ThreadPool, empty, kernel
from thesisrecon.arrays import B8, F32, F64, I64, U8
from thesisrecon.camera import Camera, viewing_rays
from thesisrecon.imaging.pinholes import FACES
from thesisrecon.records import TexturedMesh

EVERY_WAY = (*FACES.values(), np.diag([-1.0, 1.0, -1.0]))
"""Rotations from the axes of a camera to those of the pinhole views of 90 x 90 degrees all around it."""
GRID = 65  # rays along a side of an image, next to all on its border, that show which parts of views are seen
CHUNK = 2**16  # rays that are intersected at a time
_SLACK = 1e-7  #: margin of a triangle's edges, px, so that rounding leaves no gap between neighbours


@kernel
def _inverse(p: F64, inverse: F64) -> bool:
    """Invert the matrix whose columns are the rows of p (3, 3); False if it is singular."""
    for i in range(3):
        a, b = p[(i + 1) % 3], p[(i + 2) % 3]
        inverse[i, 0] = a[1] * b[2] - a[2] * b[1]
        inverse[i, 1] = a[2] * b[0] - a[0] * b[2]
        inverse[i, 2] = a[0] * b[1] - a[1] * b[0]
    determinant = p[0, 0] * inverse[0, 0] + p[0, 1] * inverse[0, 1] + p[0, 2] * inverse[0, 2]
    size = 0.0
    for i in range(3):
        size = max(size, abs(p[0, i] * inverse[0, i]))
    if abs(determinant) <= 1e-14 * size:
        return False
    for i in range(3):
        for k in range(3):
            inverse[i, k] /= determinant
    return True


@kernel
def _row_span(inverse: F64, near: float, y: float, width: int) -> tuple[int, int]:
    """Return the first and last + 1 pixel of row y with positive barycentric coordinates and depth."""
    low, high = 0.0, width - 1.0
    slope_sum, constant_sum = 0.0, 0.0
    for i in range(4):
        if i < 3:
            slope, constant = inverse[i, 0], inverse[i, 1] * y + inverse[i, 2]
            slope_sum += slope
            constant_sum += constant
        else:
            slope, constant = -slope_sum, 1.0 / near - constant_sum
        if slope > 0.0:
            low = max(low, -constant / slope - _SLACK)
        elif slope < 0.0:
            high = min(high, -constant / slope + _SLACK)
        elif constant < 0.0:
            return 0, 0
    if not low <= high:
        return 0, 0
    return int(np.ceil(low)), int(np.floor(high)) + 1


@kernel
def _rasterize_rows(
    corners: F64, near: float, rows: tuple[int, int], depth: F32, face: I64, weights: F32
) -> None:
    """Draw triangles ``corners`` (M, 3, 3) into a z-buffer of some rows; the first of equal depths stays."""
    # With the image points of a face as columns of M, M^-1 (x, y, 1) are its barycentric coordinates, each
    # over the depth: no clipping at the near plane (Olano and Greer, "2D homogeneous coordinates", 1997).
    width = depth.shape[1]
    inverse = empty((3, 3))
    top_row = rows[0]
    for m in range(corners.shape[0]):
        p = corners[m]
        first, last = rows
        if p[0, 2] <= near and p[1, 2] <= near and p[2, 2] <= near:
            continue
        if p[0, 2] > near and p[1, 2] > near and p[2, 2] > near:
            y0, y1, y2 = p[0, 1] / p[0, 2], p[1, 1] / p[1, 2], p[2, 1] / p[2, 2]
            top, bottom = min(y0, y1, y2), max(y0, y1, y2)
            if bottom < first - _SLACK or top > last:
                continue
            x0, x1, x2 = p[0, 0] / p[0, 2], p[1, 0] / p[1, 2], p[2, 0] / p[2, 2]
            if max(x0, x1, x2) < -_SLACK or min(x0, x1, x2) > width:
                continue
            first = max(first, int(np.ceil(top - _SLACK)))
            last = min(last, int(np.floor(bottom + _SLACK)) + 1)
            if first >= last:
                continue
        if not _inverse(p, inverse):
            continue
        for y in range(first, last):
            start, stop = _row_span(inverse, near, float(y), width)
            for x in range(start, stop):
                w1 = inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]
                w2 = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
                over_depth = w1 + w2 + inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]
                if over_depth <= 0.0:
                    continue
                z = np.float32(1.0 / over_depth)
                i = y - top_row
                if z < depth[i, x]:
                    depth[i, x] = z
                    face[i, x] = m
                    weights[i, x, 0] = np.float32(w1 / over_depth)
                    weights[i, x, 1] = np.float32(w2 / over_depth)


@kernel
def sample_texture(texture: F32 | U8, uv: F32, drawn: I64, out: F32) -> None:
    """Sample a texture bilinearly, clamped to its border, at ``uv`` (H, W, 2) where ``drawn`` >= 0."""
    height, width = texture.shape[:2]
    for y in range(uv.shape[0]):
        for x in range(uv.shape[1]):
            if drawn[y, x] < 0:
                continue
            u = min(max(uv[y, x, 0], np.float32(0.0)), np.float32(width - 1))
            v = min(max(uv[y, x, 1], np.float32(0.0)), np.float32(height - 1))
            left, top = int(u), int(v)
            right, below = min(left + 1, width - 1), min(top + 1, height - 1)
            s, t = u - np.float32(left), v - np.float32(top)
            for k in range(3):
                # Differences of unsigned integers would wrap around.
                a, b = np.float32(texture[top, left, k]), np.float32(texture[top, right, k])
                c, d = np.float32(texture[below, left, k]), np.float32(texture[below, right, k])
                upper, lower = a + s * (b - a), c + s * (d - c)
                out[y, x, k] = upper + t * (lower - upper)


@dataclass(frozen=True)
class Raster:
    """Visible faces (-1 for none), their depth (inf) and barycentric coordinates of corners 1 and 2."""

    depth: F32
    face: I64
    weights: F32

    @classmethod
    def empty(cls, height: int, width: int) -> "Raster":
        """Return a raster without faces."""
        depth, weights = (
            np.full((height, width), np.inf, np.float32),
            np.zeros((height, width, 2), np.float32),
        )
        return cls(depth, np.full((height, width), -1, dtype=np.int64), weights)

    def interpolate(self, values: F64 | F32, faces: I64 | None = None) -> F32:
        """Values (H, W, C) of mesh vertices (N, C), or of face corners (M, 3, C), at each pixel; else 0."""
        if faces is None:
            faces, values = np.arange(3 * len(values)).reshape(-1, 3), values.reshape(-1, values.shape[2])
        out, hit = np.zeros((*self.face.shape, values.shape[1]), dtype=np.float32), self.face >= 0
        b, c = self.weights[hit].T[:, :, None]
        i, j, k = values.astype(np.float32)[faces[self.face[hit]].T]
        out[hit] = (np.float32(1.0) - b - c) * i + b * j + c * k
        return out

    def __getitem__(self, rows: slice) -> "Raster":
        """Return some rows, without a copy."""
        return Raster(self.depth[rows], self.face[rows], self.weights[rows])


def rasterize(vertices: F64, faces: I64, camera: Camera) -> Raster:
    """Find the face, seen from any side, at the centre of each pixel of a camera without distortion."""
    width, height = camera.size
    return rasterize_rows(*image_corners(vertices, faces, camera), (0, height), width)


def image_corners(vertices: F64, faces: I64, camera: Camera) -> tuple[F64, float]:
    """Image points K (R X + t) (M, 3, 3) of the corners of faces, and the nearest depth that is drawn."""
    _near = 1e-6  # Nearest depth that is drawn, relative to the depth of the farthest corner of a face
    if not camera.is_pinhole:
        raise ValueError("Rendering needs a camera without distortion: undistort the image first")
    # Vertices that no face uses may not be finite.
    with np.errstate(invalid="ignore"):
        seen = (vertices @ camera.R.T + camera.t) @ (camera.K / camera.K[2, 2]).T
    corners = np.ascontiguousarray(seen[faces])
    return corners, _near * max(float(np.abs(corners[..., 2]).max(initial=0.0)), 1e-300)


def rasterize_rows(corners: F64, near: float, rows: tuple[int, int], width: int) -> Raster:
    """Find the face at the pixels of rows (first, last + 1) from the image points (M, 3, 3) of corners."""
    raster = Raster.empty(rows[1] - rows[0], width)
    _rasterize_rows(np.ascontiguousarray(corners), near, rows, raster.depth, raster.face, raster.weights)
    return raster


def raster_of_camera(
    vertices: F64, faces: I64, camera: Camera, threads: int = 1
) -> Callable[[tuple[int, int]], Raster]:
    """A function that finds the faces at the pixels of rows (first, last + 1) of a camera with any lens."""
    width, height = camera.size
    if camera.is_pinhole:
        corners, near = image_corners(vertices, faces, camera)
        return lambda rows: rasterize_rows(corners, near, rows, width)
    K, lens = camera.K, camera.lens_row
    x, y = (np.linspace(0.0, side - 1.0, GRID) for side in (width, height))
    edges = [np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2) for axes in (
        (x, y), (np.arange(width), y[[0, -1]]), (x[[0, -1]], np.arange(height)),
    )]  # fmt: skip
    some = viewing_rays(K, np.concatenate(edges), lens)
    views = [_view_of_rays(vertices, faces, camera, turn, some, threads) for turn in EVERY_WAY]
    with np.errstate(invalid="ignore"):
        points = vertices @ camera.R.T + camera.t

    def find(rows: tuple[int, int]) -> Raster:
        raster, step = Raster.empty(rows[1] - rows[0], width), max(CHUNK // width, 1)
        for first in range(0, rows[1] - rows[0], step):
            part = raster[first : first + step]
            across = np.arange(rows[0] + first, rows[0] + first + len(part.face))
            xy = np.stack(np.meshgrid(np.arange(width), across), axis=-1).reshape(-1, 2).astype(np.float64)
            rays = viewing_rays(K, xy, lens)
            found = np.full(len(rays), -1)
            for view in views:
                if view is not None:
                    mine = np.flatnonzero(_looks_into(rays, view[1]) & (found < 0))
                    xh = rays[mine] @ view[0].T
                    x, y = np.rint(xh[:, :2] / xh[:, 2:]).astype(np.int64).T
                    here = np.clip(y, 0, len(view[2]) - 1), np.clip(x, 0, view[2].shape[1] - 1)
                    found[mine] = view[2][here]
            hit = np.flatnonzero(found >= 0)
            corners, rays = points[faces[found[hit]]], rays[hit]
            # The ray is a sum of the corners with these weights: their signs are equal inside the face.
            weights = np.einsum("nkc,nc->nk", np.cross(corners[:, [1, 2, 0]], corners[:, [2, 0, 1]]), rays)
            side = np.einsum("nc,nc->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
            weights = np.maximum(weights * np.sign(side)[:, None], 0.0)
            weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
            part.face.reshape(-1)[hit] = found[hit]
            part.depth.reshape(-1)[hit] = np.einsum("nk,nk->n", weights, corners[:, :, 2])
            part.weights.reshape(-1, 2)[hit] = weights[:, 1:]
        return raster

    return find


_View = tuple[F64, F64, I64] | None
"""Of a pinhole view: K times its rotation, the rotation, and the faces at its pixels; None: unseen."""


def _view_of_rays(vertices: F64, faces: I64, camera: Camera, turn: F64, rays: F64, threads: int) -> _View:
    """The part of a pinhole view of 90 x 90 degrees that some rays of an image, near all others, show."""
    mine, focal = rays[_looks_into(rays, turn)] @ turn.T, float(max(int(camera.K[0, 0]), 8))
    if not len(mine):
        return None
    places, margin = focal * mine[:, :2] / mine[:, 2:], 8.0 * focal / GRID
    low = np.floor(np.maximum(places.min(axis=0) - margin, -focal))
    high = np.ceil(np.minimum(places.max(axis=0) + margin, focal))
    size = (int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1)
    K = np.array([[focal, 0.0, -low[0]], [0.0, focal, -low[1]], [0.0, 0.0, 1.0]])
    corners, near = image_corners(vertices, faces, Camera(K, turn @ camera.R, turn @ camera.t, size))
    found = np.empty(size[::-1], dtype=np.int64)

    def work(rows: tuple[int, int]) -> None:
        found[slice(*rows)] = rasterize_rows(corners, near, rows, size[0]).face

    run_in_strips(work, size[1], threads)
    return K @ turn, turn, found


def _looks_into(rays: F64, turn: F64) -> B8:
    """Whether rays (N,) lie in a pinhole view of 90 x 90 degrees; NaN: in none."""
    across = rays @ turn.T
    return np.asarray(across[:, 2] >= (1.0 - 1e-12) * np.abs(across[:, :2]).max(axis=1))


def vertex_normals(mesh: TexturedMesh) -> F64:
    """Unit vertex normals (N, 3), the area-weighted mean of the face normals."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    total = np.zeros_like(mesh.vertices)
    for k in range(3):
        for d in range(3):
            total[:, d] += np.bincount(mesh.faces[:, k], normal[:, d], len(total))
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300))


def run_in_strips(work: Callable[[tuple[int, int]], None], height: int, threads: int) -> None:
    """Call a function for strips (first row, last + 1) of rows in parallel."""
    edges = np.linspace(0, height, max(threads, 1) + 1).round().astype(int)
    with ThreadPool(threads) as pool:
        list(pool.map(work, pairwise(edges.tolist())))
