"""Records of a COLMAP sparse model, and the rules of a consistent one.

COLMAP's conventions: pixel (0.5, 0.5) is the centre of the top-left pixel, quaternions are (w, x, y, z),
poses are world-to-camera, and -1 marks an image point without a space point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64, I64, U8

MODEL_NUMBERS = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 1,
    "SIMPLE_RADIAL": 2,
    "RADIAL": 3,
    "OPENCV": 4,
    "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6,
    "FOV": 7,
    "SIMPLE_RADIAL_FISHEYE": 8,
    "RADIAL_FISHEYE": 9,
    "THIN_PRISM_FISHEYE": 10,
    "RAD_TAN_THIN_PRISM_FISHEYE": 11,
    "SIMPLE_DIVISION": 12,
    "DIVISION": 13,
    "SIMPLE_FISHEYE": 14,
    "FISHEYE": 15,
    "EUCM": 16,
    "EQUIRECTANGULAR": 17,
}
PARAMETER_COUNTS = dict(
    zip(MODEL_NUMBERS, (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2), strict=True)
)
MAX_ID = 2**32 - 2
NO_POINT = -1


@dataclass(frozen=True)
class ColmapCamera:
    """One camera.

    Parameters
    ----------
    camera_id : int
        Unique number.
    model : str
        A key of :data:`MODEL_NUMBERS`.
    width, height : int
        Image size (px).
    params : tuple of float
        In COLMAP's order.
    """

    camera_id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """One registered image: x_camera = R(quaternion_wxyz) X + translation.

    Parameters
    ----------
    image_id : int
        Unique number.
    quaternion_wxyz, translation : ndarray (4,) and (3,)
        Pose.
    camera_id : int
        Its camera.
    name : str
        File name.
    xy : ndarray (N, 2)
        Image points in COLMAP's pixels.
    point_ids : ndarray (N,)
        Space point of each, -1 = none.
    """

    image_id: int
    quaternion_wxyz: F64
    translation: F64
    camera_id: int
    name: str
    xy: F64
    point_ids: I64


@dataclass(frozen=True)
class ColmapPoints:
    """All space points, by columns.

    Parameters
    ----------
    ids : ndarray (N,)
        Unique numbers.
    xyz : ndarray (N, 3)
        Positions.
    rgb : ndarray (N, 3) uint8
        Colours.
    error : ndarray (N,)
        Mean reprojection error (px).
    track_start : ndarray (N + 1,)
        Point n has the track entries ``track_start[n]:track_start[n + 1]``.
    track_image, track_xy : ndarray (M,)
        Image number and row of its ``xy`` of each track entry.
    """

    ids: I64
    xyz: F64
    rgb: U8
    error: F64
    track_start: I64
    track_image: I64
    track_xy: I64


@dataclass(frozen=True)
class ColmapModel:
    """A sparse model.

    Parameters
    ----------
    cameras, images : tuple
        Records.
    points : ColmapPoints
        Space points.
    """

    cameras: tuple[ColmapCamera, ...]
    images: tuple[ColmapImage, ...]
    points: ColmapPoints


def inconsistency(model: ColmapModel) -> str:
    """Find the first rule that a model breaks.

    Numbers must be unique and in range, references must exist in both directions (image point to space point
    and back), values must be finite, and names must fit into a file.

    Parameters
    ----------
    model : ColmapModel
        Any model.

    Returns
    -------
    str
        A clause, or empty if the model is consistent.
    """
    return _camera_problem(model) or _image_problem(model) or _point_problem(model) or _track_problem(model)


def _camera_problem(model: ColmapModel) -> str:
    if len({camera.camera_id for camera in model.cameras}) < len(model.cameras):
        return "two cameras have the same number"
    for camera in model.cameras:
        what = f"camera {camera.camera_id}"
        if not 0 <= camera.camera_id <= MAX_ID:
            return f"{what} has a number out of range"
        if camera.model not in MODEL_NUMBERS:
            return f"{what} has the unknown camera model {camera.model!r}"
        needed = PARAMETER_COUNTS[camera.model]
        if len(camera.params) != needed:
            return f"{what} ({camera.model}) needs {needed} parameters, not {len(camera.params)}"
        if not np.isfinite(camera.params).all():
            return f"{what} has a parameter that is not a finite number"
        if not (0 < camera.width < 2**31 and 0 < camera.height < 2**31):
            return f"{what} has the impossible size {camera.width} x {camera.height}"
    return ""


def _image_problem(model: ColmapModel) -> str:
    if len({image.image_id for image in model.images}) < len(model.images):
        return "two images have the same number"
    known = {camera.camera_id for camera in model.cameras}
    for image in model.images:
        what = f"image {image.image_id} ({image.name!r})"
        if not 0 <= image.image_id <= MAX_ID:
            return f"{what} has a number out of range"
        if image.camera_id not in known:
            return f"{what} uses camera {image.camera_id}, which does not exist"
        if not image.name or any(mark in image.name for mark in "\0\n\r"):
            return f"{what} has an empty name or a name with a line break"
        numbers = (image.quaternion_wxyz, image.translation, image.xy)
        if [part.shape for part in numbers] != [(4,), (3,), (len(image.point_ids), 2)]:
            return f"{what} has arrays of the wrong shape"
        if not all(np.isfinite(part).all() for part in numbers):
            return f"{what} has a pose or an image point that is not finite"
        if not 1e-6 < float(np.abs(image.quaternion_wxyz).max()) < 1e6:
            return f"{what} has an invalid quaternion"
    return ""


def _point_problem(model: ColmapModel) -> str:
    points, n = model.points, len(model.points.ids)
    shapes = (points.xyz.shape, points.rgb.shape, points.error.shape, points.track_start.shape)
    if shapes != ((n, 3), (n, 3), (n,), (n + 1,)) or points.track_image.shape != points.track_xy.shape:
        return "the arrays of the points have different lengths"
    if len(np.unique(points.ids)) < n or (n and points.ids.min() < 0):
        return "two points have the same number, or one has a negative number"
    if not (np.isfinite(points.xyz).all() and np.isfinite(points.error).all()):
        return "a point has a coordinate or an error that is not finite"
    return ""


def _track_problem(model: ColmapModel) -> str:
    points, images = model.points, model.images
    lengths = np.diff(points.track_start)
    if points.track_start[0] != 0 or points.track_start[-1] != len(points.track_image) or (lengths < 0).any():
        return "the track lengths are inconsistent"
    counts = np.array([len(image.xy) for image in images], dtype=np.int64)
    start = np.concatenate([[0], np.cumsum(counts)])
    if not images:
        return "a track refers to an image that does not exist" if len(points.track_image) else ""
    ids = np.array([image.image_id for image in images], dtype=np.int64)
    order = np.argsort(ids)
    place = order[np.minimum(np.searchsorted(ids[order], points.track_image), len(ids) - 1)]
    if (ids[place] != points.track_image).any():
        return "a track refers to an image that does not exist"
    if ((points.track_xy < 0) | (points.track_xy >= counts[place])).any():
        return "a track refers to an image point that does not exist"
    owners = np.concatenate([image.point_ids for image in images])
    seen = start[place] + points.track_xy
    if (owners[seen] != np.repeat(points.ids, lengths)).any() or len(np.unique(seen)) < len(seen):
        return "a point and its image points do not refer to each other"
    if np.count_nonzero(owners != NO_POINT) != len(seen):
        return "an image point refers to a point that does not list it"
    return ""
