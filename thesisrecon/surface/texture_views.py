"""What each photograph sees of a surface, and how well.

Which photograph each face takes its texture from.

A texture that is laid out and waits for its colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from thesisrecon.arrays import B8, F32, F64, I64
from thesisrecon.camera import Camera
from thesisrecon.geometry.zbuffer import rasterize, sample_texture
from thesisrecon.records import PinholeView, TexturedMesh
from thesisrecon.surface.texture_kernels import diffuse

DEPTH_TOLERANCE_PX = 3.0
"""How far behind what is seen a vertex may lie and still be seen, in pixels at its depth: the z-buffer holds
one depth a pixel, and of a slanted surface a pixel sees many."""


def view_camera(view: PinholeView) -> Camera:
    """The camera of a view with the size of its picture."""
    return Camera.from_matrix(view.P, (view.rgb.shape[1], view.rgb.shape[0]))


def project(camera: Camera, vertices: F64) -> tuple[F64, F64]:
    """Pixels (N, 2), NaN behind the camera, and depths (N,)."""
    xyz = (vertices @ camera.R.T + camera.t) @ camera.K.T
    depth = xyz[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = np.where(depth[:, None] > 0.0, xyz[:, :2] / depth[:, None], np.nan)
    return xy, depth


def _visible_vertices(mesh: TexturedMesh, view: PinholeView, xy: F64, depth: F64, *, threads: int = 1) -> B8:
    """(N,) vertices with pixels ``xy`` and ``depth`` that lie in the picture and behind nothing."""
    camera = view_camera(view)
    buffer = rasterize(mesh.vertices, mesh.faces, camera, threads=threads).depth
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


def face_quality(mesh: TexturedMesh, views: Sequence[PinholeView], *, threads: int = 1) -> F32:
    """(M, V) pixels that each face covers in each view, 0 where a view does not see all of its outside."""
    quality = np.zeros((len(mesh.faces), len(views)), dtype=np.float32)
    for v, view in enumerate(views):
        xy, depth = project(view_camera(view), mesh.vertices)
        seen = _visible_vertices(mesh, view, xy, depth, threads=threads)
        a, b, c = (xy[mesh.faces[:, k]] for k in range(3))
        # Pixels run downwards: what is anticlockwise outside has a negative area here.
        area = 0.5 * ((c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1]) - (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]))
        whole = seen[mesh.faces].all(axis=1) & (np.nan_to_num(area) > 0.0)
        quality[whole, v] = area[whole]
    return quality


def sample_view(view: PinholeView, xy: F64, image: F32 | None = None) -> F32:
    """Bilinear colours (N, 3) of a view, or of ``image`` (H, W, 3) in its place, at pixels (N, 2)."""
    color = np.zeros((1, len(xy), 3), dtype=np.float32)
    source = view.rgb.astype(np.float32) if image is None else image
    drawn = np.zeros((1, len(xy)), dtype=np.int64)
    sample_texture(source, np.ascontiguousarray(xy, dtype=np.float32)[None], drawn, color)
    sampled: F32 = color[0]
    return sampled


def color_vertices(mesh: TexturedMesh, views: Sequence[PinholeView], *, threads: int = 1) -> TexturedMesh:
    """The mesh with colours of its vertices: the mean over the views that see a vertex, nearer ones and those
    that look at it straight counting more. Grey where none does."""
    total = np.zeros((len(mesh.vertices), 3))
    weight = np.zeros(len(mesh.vertices))
    quality = face_quality(mesh, views, threads=threads)
    for v, view in enumerate(views):
        share = np.zeros(len(mesh.vertices))
        for k in range(3):
            share += np.bincount(mesh.faces[:, k], quality[:, v], minlength=len(share))
        xy = np.nan_to_num(project(view_camera(view), mesh.vertices)[0])
        total += share[:, None] * sample_view(view, xy)
        weight += share
    mean = np.where(weight[:, None] > 0.0, total / np.maximum(weight, 1e-30)[:, None], 128.0)
    return replace(mesh, colors=np.rint(mean).astype(np.uint8), uv=None, texture=None)


OWN = 0.1
"""Weight of a face's own shares against those of its neighbours."""


def choose_views(quality: F32, neighbours: I64, *, rounds: int = 40, min_chart_faces: int = 30) -> I64:
    """(M,) view of each face, -1 where none sees it.

    Each face alone would take the view that shows it largest, and the surface would be a patchwork. Shares of
    the largest are therefore spread over neighbouring faces, ``rounds`` faces far, among views that see them;
    charts of fewer than ``least_faces`` faces then join the neighbour with the longest common border that
    sees them.
    ``quality`` (M, V) pixels covered, ``neighbours`` (M, 3) across each side or -1.
    """
    if not quality.size:
        return np.full(len(quality), -1, dtype=np.int64)
    visible = quality > 0.0
    share = quality / np.maximum(quality.max(axis=1, keepdims=True), np.float32(1e-20))
    spread, other = share.copy(), np.empty_like(share)
    for _ in range(rounds):
        diffuse(share, neighbours, OWN, spread, other)
        spread, other = other, spread
    label = np.where(visible.any(axis=1), spread.argmax(axis=1), -1)
    # Where spreading left nothing of any view, the largest decides.
    lost = visible.any(axis=1) & (spread.max(axis=1) <= 0.0)
    label[lost] = share[lost].argmax(axis=1)
    for _ in range(3):
        label = _join_small(label, visible, neighbours, min_chart_faces)
    return label.astype(np.int64)


def label_charts(label: I64, neighbours: I64) -> I64:
    """(M,) number of the chart of each face: connected faces of one label."""
    face = np.repeat(np.arange(len(label)), 3)
    other = neighbours.ravel()
    same = (other >= 0) & (label[face] == label[other])
    graph = scipy.sparse.coo_array(
        (np.ones(same.sum(), dtype=np.int8), (face[same], other[same])), shape=(len(label),) * 2
    )
    return np.asarray(scipy.sparse.csgraph.connected_components(graph, directed=False)[1], dtype=np.int64)


def _join_small(label: I64, visible: np.ndarray, neighbours: I64, min_chart_faces: int) -> I64:
    chart = label_charts(label, neighbours)
    faces = np.bincount(chart)
    small = (faces[chart] < min_chart_faces) & (label >= 0)
    # A chart can take over a view that sees all of its faces.
    sees = np.ones((len(faces), visible.shape[1]), dtype=bool)
    np.logical_and.at(sees, chart[small], visible[small])
    border = np.zeros((len(faces), visible.shape[1]))
    for k in range(3):
        other = neighbours[:, k]
        crossing = small & (other >= 0) & (label[other] >= 0) & (label[other] != label)
        np.add.at(border, (chart[crossing], label[other[crossing]]), 1.0)
    border[~sees] = 0.0
    joins = small & (border[chart].max(axis=1) > 0.0)
    return np.where(joins, border[chart].argmax(axis=1), label)


@dataclass(frozen=True)
class Charts:
    """Where the M faces of a mesh lie in their texture.

    ``label`` (M,) the view that each face is cut out of, -1 for none; ``chart`` (M,) its piece; ``uv``
    (M, 3, 2) texels of its corners; ``cut_out`` (H, W, 3) uint8 the texture with the rectangle about each
    piece as its photograph has it.
    """

    label: I64
    chart: I64
    uv: F64
    cut_out: NDArray[np.uint8]
