"""Our cameras, points and observations as a COLMAP model in memory, and back: pixels, poses, indices.

COLMAP's pixels have their origin at the corner of the first one, ours in its centre; its poses are
world-to-camera as ours; views, rows of intrinsics and points count from 1 in it.
"""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.numerics.metric_cameras import MetricCameras
from thesisrecon.numerics.observations import Observations
from validation.references.libraries import pycolmap


def colmap_model(
    cameras: MetricCameras, X: F64, seen: Observations, size: tuple[int, int]
) -> pycolmap.Reconstruction:
    """A COLMAP model with SIMPLE_RADIAL cameras; views, rows of intrinsics and points count from 1 in it."""
    model = pycolmap.Reconstruction()
    for g, (f, _, _, cx, cy, k1) in enumerate(cameras.intrinsics):
        camera = pycolmap.Camera(
            model="SIMPLE_RADIAL",
            width=size[0],
            height=size[1],
            params=[f, cx + 0.5, cy + 0.5, k1],
            camera_id=g + 1,
        )
        model.add_camera_with_trivial_rig(camera)
    order = np.lexsort((seen.point_index, seen.view_index))
    view, point, xy = seen.view_index[order], seen.point_index[order], seen.xy[order] + 0.5
    first = np.searchsorted(view, np.arange(len(cameras.R) + 1))
    for v in range(len(cameras.R)):
        image = pycolmap.Image(
            name=f"{v}.png",
            keypoints=xy[first[v] : first[v + 1]],
            camera_id=int(cameras.group[v]) + 1,
            image_id=v + 1,
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(cameras.R[v]), cameras.t[v])
        model.add_image_with_trivial_frame(image, pose)
    place = np.arange(len(view)) - first[view]
    by_point = np.argsort(point, kind="stable")
    bounds = np.searchsorted(point[by_point], np.arange(len(X) + 1))
    for j in range(len(X)):
        k = by_point[bounds[j] : bounds[j + 1]]
        if len(k):
            track = pycolmap.Track([pycolmap.TrackElement(int(view[i]) + 1, int(place[i])) for i in k])
            model.add_point3D(X[j], track, np.zeros(3, dtype=np.uint8))
    return model


def cameras_from_colmap(model: pycolmap.Reconstruction, like: MetricCameras) -> tuple[MetricCameras, F64]:
    """The cameras of :func:`colmap_model` and its points in their order."""
    poses = [model.images[v + 1].cam_from_world() for v in range(len(like.R))]
    rows = []
    for g in range(len(like.intrinsics)):
        f, cx, cy, k = model.cameras[g + 1].params
        rows.append([f, 1.0, 0.0, cx - 0.5, cy - 0.5, k])
    R = np.array([pose.rotation.matrix() for pose in poses])
    t = np.array([pose.translation for pose in poses])
    X = np.array([model.points3D[j].xyz for j in sorted(model.points3D)])
    return MetricCameras(R, t, np.array(rows), like.group, like.shared), X
