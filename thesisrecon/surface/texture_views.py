"""Visibility of a surface in the images, and the choice of one image for each face."""

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
"""Depth tolerance of visible vertices in pixel sizes: the z-buffer holds one depth per pixel."""
OWN_WEIGHT = 0.1
"""Weight of a face's own share relative to those of its neighbours."""


def view_camera(view: PinholeView) -> Camera:
    """Return the camera of a view.

    Parameters
    ----------
    view : PinholeView

    Returns
    -------
    Camera
        Camera with the image size.
    """
    return Camera.from_matrix(view.P, (view.rgb.shape[1], view.rgb.shape[0]))


def project_to_view(camera: Camera, vertices: F64) -> tuple[F64, F64]:
    """Project vertices.

    Parameters
    ----------
    camera : Camera
    vertices : ndarray (N, 3)

    Returns
    -------
    tuple of ndarray (N, 2), (N,)
        Pixels, NaN behind the camera, and depths.
    """
    xyz = (vertices @ camera.R.T + camera.t) @ camera.K.T
    depth = xyz[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = np.where(depth[:, None] > 0.0, xyz[:, :2] / depth[:, None], np.nan)
    return xy, depth


def _visible_vertices(mesh: TexturedMesh, view: PinholeView, xy: F64, depth: F64, *, threads: int = 1) -> B8:
    """(N,) vertices with pixels ``xy`` and ``depth`` that lie inside the image and are not occluded."""
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
    """Count the pixels that each face covers in each view.

    Parameters
    ----------
    mesh : TexturedMesh
    views : sequence of PinholeView
    threads : int

    Returns
    -------
    ndarray (M, V) float32
        Pixels, 0 if the outside of the face is not completely visible.
    """
    quality = np.zeros((len(mesh.faces), len(views)), dtype=np.float32)
    for v, view in enumerate(views):
        xy, depth = project_to_view(view_camera(view), mesh.vertices)
        seen = _visible_vertices(mesh, view, xy, depth, threads=threads)
        a, b, c = (xy[mesh.faces[:, k]] for k in range(3))
        # y points down: faces that are anticlockwise from outside have a negative area.
        area = 0.5 * ((c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1]) - (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]))
        whole = seen[mesh.faces].all(axis=1) & (np.nan_to_num(area) > 0.0)
        quality[whole, v] = area[whole]
    return quality


def sample_view(view: PinholeView, xy: F64, image: F32 | None = None) -> F32:
    """Sample colours bilinearly.

    Parameters
    ----------
    view : PinholeView
    xy : ndarray (N, 2)
    image : ndarray (H, W, 3) float32, optional
        Image used instead of that of the view.

    Returns
    -------
    ndarray (N, 3) float32
        Colours.
    """
    color = np.zeros((1, len(xy), 3), dtype=np.float32)
    source = view.rgb.astype(np.float32) if image is None else image
    drawn = np.zeros((1, len(xy)), dtype=np.int64)
    sample_texture(source, np.ascontiguousarray(xy, dtype=np.float32)[None], drawn, color)
    sampled: F32 = color[0]
    return sampled


def color_vertices(mesh: TexturedMesh, views: Sequence[PinholeView], *, threads: int = 1) -> TexturedMesh:
    """Colour the vertices of a mesh.

    Parameters
    ----------
    mesh : TexturedMesh
    views : sequence of PinholeView
    threads : int

    Returns
    -------
    TexturedMesh
        Vertex colours averaged over the views by covered pixels; grey where no view sees the vertex.
    """
    total = np.zeros((len(mesh.vertices), 3))
    weight = np.zeros(len(mesh.vertices))
    quality = face_quality(mesh, views, threads=threads)
    for v, view in enumerate(views):
        share = np.zeros(len(mesh.vertices))
        for k in range(3):
            share += np.bincount(mesh.faces[:, k], quality[:, v], minlength=len(share))
        xy = np.nan_to_num(project_to_view(view_camera(view), mesh.vertices)[0])
        total += share[:, None] * sample_view(view, xy)
        weight += share
    mean = np.where(weight[:, None] > 0.0, total / np.maximum(weight, 1e-30)[:, None], 128.0)
    return replace(mesh, colors=np.rint(mean).astype(np.uint8), uv=None, texture=None)


def choose_views(quality: F32, neighbours: I64, *, rounds: int = 40, min_chart_faces: int = 30) -> I64:
    """Choose the view from which each face is textured.

    Choosing the best view of each face alone would give many small charts. Shares of the best quality are
    therefore diffused over ``rounds`` faces among the views that see them; small charts then join the
    neighbour with the longest common border.

    Parameters
    ----------
    quality : ndarray (M, V) float32
        Pixels covered by each face in each view.
    neighbours : ndarray (M, 3)
        Adjacent faces, -1 for none.
    rounds : int
        Diffusion steps.
    min_chart_faces : int
        Faces of the smallest chart.

    Returns
    -------
    ndarray (M,)
        View of each face, -1 if no view sees it.
    """
    if not quality.size:
        return np.full(len(quality), -1, dtype=np.int64)
    visible = quality > 0.0
    share = quality / np.maximum(quality.max(axis=1, keepdims=True), np.float32(1e-20))
    spread, other = share.copy(), np.empty_like(share)
    for _ in range(rounds):
        diffuse(share, neighbours, OWN_WEIGHT, spread, other)
        spread, other = other, spread
    label = np.where(visible.any(axis=1), spread.argmax(axis=1), -1)
    # Faces that the diffusion left without shares take their best view.
    lost = visible.any(axis=1) & (spread.max(axis=1) <= 0.0)
    label[lost] = share[lost].argmax(axis=1)
    for _ in range(3):
        label = _join_small(label, visible, neighbours, min_chart_faces)
    return label.astype(np.int64)


def label_charts(label: I64, neighbours: I64) -> I64:
    """Label the connected faces of one view.

    Parameters
    ----------
    label : ndarray (M,)
        View of each face.
    neighbours : ndarray (M, 3)
        Adjacent faces, -1 for none.

    Returns
    -------
    ndarray (M,)
        Chart of each face.
    """
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
    """Layout of a texture.

    Attributes
    ----------
    label : ndarray (M,)
        View of each face, -1 for none.
    chart : ndarray (M,)
        Chart of each face.
    uv : ndarray (M, 3, 2)
        Corners in texels.
    cut_out : ndarray (H, W, 3) uint8
        Texture with the image rectangle of each chart.
    """

    label: I64
    chart: I64
    uv: F64
    cut_out: NDArray[np.uint8]
