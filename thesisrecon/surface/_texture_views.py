"""Visibility of a surface in the images, and the choice of one image for each face."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thesisrecon.arrays import B8, F32, F64, I64
from thesisrecon.camera import Camera
from thesisrecon.geometry.zbuffer import rasterize
from thesisrecon.records import PinholeView, TexturedMesh
from thesisrecon.surface._mesh import components
from thesisrecon.surface._texture_kernels import diffuse

DEPTH_TOLERANCE_PX = 3.0
"""Depth tolerance of visible vertices in pixel sizes: the z-buffer holds one depth per pixel."""
SMOOTH_ROUNDS = 40
"""Faces over which the choice of views is smoothed."""
MIN_CHART_FACES = 30
"""Smaller charts join a neighbour."""
OWN_WEIGHT = 0.1
"""Weight of a face's own share relative to those of its neighbours."""


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


def _visible_vertices(mesh: TexturedMesh, view: PinholeView, xy: F64, depth: F64, *, threads: int = 1) -> B8:
    """Vertices (N,) with pixels ``xy`` and ``depth`` that lie inside the image and are not occluded."""
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
    """Count the pixels (M, V) of each face in each view, 0 if its outside is not completely visible."""
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


def choose_views(quality: F32, neighbours: I64) -> I64:
    """Choose the view (M,) from which each face is textured, -1 if no view sees it.

    Choosing the best view of each face alone would give many small charts. Shares of the best quality are
    therefore diffused over faces among the views that see them; small charts then join the
    neighbour with the longest common border.
    """
    if not quality.size:
        return np.full(len(quality), -1, dtype=np.int64)
    visible = quality > 0.0
    share = quality / np.maximum(quality.max(axis=1, keepdims=True), np.float32(1e-20))
    spread, other = share.copy(), np.empty_like(share)
    for _ in range(SMOOTH_ROUNDS):
        diffuse(share, neighbours, OWN_WEIGHT, spread, other)
        spread, other = other, spread
    label = np.where(visible.any(axis=1), spread.argmax(axis=1), -1)
    # Faces that the diffusion left without shares take their best view.
    lost = visible.any(axis=1) & (spread.max(axis=1) <= 0.0)
    label[lost] = share[lost].argmax(axis=1)
    for _ in range(3):
        label = _join_small(label, visible, neighbours)
    return label.astype(np.int64)


def label_charts(label: I64, neighbours: I64) -> I64:
    """Label the connected faces of one view."""
    face = np.repeat(np.arange(len(label)), 3)
    other = neighbours.ravel()
    same = (other >= 0) & (label[face] == label[other])
    return components(face[same], other[same], len(label))


def _join_small(label: I64, visible: B8, neighbours: I64) -> I64:
    chart = label_charts(label, neighbours)
    faces = np.bincount(chart)
    small = (faces[chart] < MIN_CHART_FACES) & (label >= 0)
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
