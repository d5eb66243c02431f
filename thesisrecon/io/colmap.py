"""Conversion between reconstructions and COLMAP sparse models: the only place with COLMAP's conventions.

COLMAP puts the centre of the top-left pixel at (0.5, 0.5), numbers from 1, and separates cameras from images.
Its SIMPLE_RADIAL distortion is the one used here, x (1 + k1 r^2) on normalized points; FULL_OPENCV adds
k2 and k3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from thesisrecon.arrays import F64, I64
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import compose_camera, project_camera
from thesisrecon.io.colmap_model import NO_POINT, ColmapCamera, ColmapImage, ColmapModel, ColmapPoints
from thesisrecon.records import Reconstruction, Tracks

_PIXEL_CENTRE = 0.5
_SKEW_REL = 1e-9
"""Skew below this fraction of the focal length is rounding."""


def colmap_from_reconstruction(
    reconstruction: Reconstruction,
    names: Sequence[str],
    *,
    colors: NDArray[np.uint8],
    groups: I64,
    scales: F64,
    original_sizes: I64 | None = None,
) -> ColmapModel:
    """Convert a metric reconstruction to a COLMAP model in original pixels.

    It contains the registered views and the valid points with at least two inlier observations in them; view
    i is image i + 1 and point j is point j + 1. The error of a point is its mean distance in original pixels.

    Parameters
    ----------
    reconstruction : Reconstruction
        Metric, with K; its sizes (V, 2) are (width, height) at working size.
    names : sequence of str
        V file names.
    colors : ndarray (N, 3) uint8
        RGB of the points.
    groups : ndarray (V,)
        Views of one group share a camera if their intrinsics and sizes are equal.
    scales : ndarray (V,) or (V, 2)
        Original over working size, for x and y.
    original_sizes : ndarray (V, 2), optional
        (width, height) of the originals; by default working size times scale, which can miss a cut last row.

    Returns
    -------
    ColmapModel
        A consistent model.

    Raises
    ------
    ValueError
        For another stratum, arrays of other lengths, a K with skew (COLMAP has no camera for it), or a P that
        is not K [R t].
    """
    _check_export(reconstruction, names, colors, groups, scales)
    scales = np.broadcast_to(scales.reshape(len(names), -1), (len(names), 2))
    view, point, xy = _kept_observations(reconstruction)
    sizes = (
        np.rint(reconstruction.sizes * scales).astype(np.int64) if original_sizes is None else original_sizes
    )
    cameras, camera_ids = _cameras(reconstruction, groups, scales, sizes)
    poses = {int(i): _pose(reconstruction, int(i)) for i in np.flatnonzero(reconstruction.registered)}
    seen = _reproject(reconstruction, poses, view, point)
    distance = np.linalg.norm((seen - xy) * scales[view], axis=1)
    images, row = _images(names, poses, camera_ids, (view, point, (xy + _PIXEL_CENTRE) * scales[view]))
    return ColmapModel(cameras, images, _points(reconstruction.X, colors, (view, point, row), distance))


def skewed_views(reconstruction: Reconstruction) -> I64:
    """Find the registered views whose K has skew, for which COLMAP has no camera.

    Parameters
    ----------
    reconstruction : Reconstruction
        Metric, with K.

    Returns
    -------
    ndarray (S,)
        Numbers of the views.

    Raises
    ------
    ValueError
        If the reconstruction has no K.
    """
    if reconstruction.K is None:
        raise ValueError(f"skewed_views needs K; this {reconstruction.stratum} reconstruction has none")
    K = reconstruction.K
    return np.flatnonzero(reconstruction.registered & (np.abs(K[:, 0, 1]) > _SKEW_REL * K[:, 0, 0]))


def _check_export(
    reconstruction: Reconstruction, names: Sequence[str], colors: NDArray[np.uint8], groups: I64, scales: F64
) -> None:
    n_views, n_points = len(reconstruction.P), len(reconstruction.X)
    if reconstruction.stratum != "metric" or reconstruction.K is None:
        raise ValueError(
            f"colmap_from_reconstruction needs a metric reconstruction with K; got {reconstruction.stratum}"
        )
    if len(names) != n_views or groups.shape != (n_views,) or scales.shape not in ((n_views,), (n_views, 2)):
        raise ValueError(
            f"colmap_from_reconstruction needs a name, group and scale for each of {n_views} views"
        )
    if colors.shape != (n_points, 3) or colors.dtype != np.uint8:
        raise ValueError(
            f"colmap_from_reconstruction needs ({n_points}, 3) uint8 colours; got {colors.shape}"
        )
    if not (np.isfinite(scales).all() and (scales > 0).all()):
        raise ValueError("colmap_from_reconstruction needs finite scales above 0")


def _kept_observations(reconstruction: Reconstruction) -> tuple[I64, I64, F64]:
    tracks = reconstruction.tracks
    view, point = tracks.view_index, tracks.point_index
    kept = reconstruction.inlier & reconstruction.registered[view] & reconstruction.valid[point]
    kept &= np.bincount(point[kept], minlength=len(reconstruction.X))[point] >= 2
    return view[kept], point[kept], tracks.xy[kept]


def _pose(reconstruction: Reconstruction, i: int) -> tuple[F64, F64]:
    """R (3, 3) and t (3,) of P = s K [R t] with s > 0."""
    assert reconstruction.K is not None
    pose = np.linalg.solve(reconstruction.K[i], reconstruction.P[i])
    pose /= np.cbrt(np.linalg.det(pose[:, :3]))
    if not np.allclose(pose[:, :3] @ pose[:, :3].T, np.eye(3), atol=1e-6):
        raise ValueError(f"P of view {i} is not K [R t]: inv(K) P contains no rotation")
    return pose[:, :3], pose[:, 3]


def _reproject(
    reconstruction: Reconstruction, poses: dict[int, tuple[F64, F64]], view: I64, point: I64
) -> F64:
    xy = np.empty((len(view), 2))
    assert reconstruction.K is not None
    lens = _lens(reconstruction)
    for i, (R, t) in poses.items():
        here = view == i
        Xh = reconstruction.X[point[here]]
        xy[here] = project_camera(reconstruction.K[i], R, t, Xh[:, :3] / Xh[:, 3:], distortion=lens[i])
    return xy


def _lens(reconstruction: Reconstruction) -> F64:
    return (
        np.zeros((len(reconstruction.P), 3))
        if reconstruction.distortion is None
        else reconstruction.distortion
    )


def _cameras(
    reconstruction: Reconstruction, groups: I64, scales: F64, sizes: I64
) -> tuple[tuple[ColmapCamera, ...], dict[int, int]]:
    """One camera per group and set of intrinsics, and the camera number of each view."""
    assert reconstruction.K is not None
    lens = _lens(reconstruction)
    cameras: dict[tuple[object, ...], ColmapCamera] = {}
    numbers = {}
    for i in np.flatnonzero(reconstruction.registered).tolist():
        width, height = (int(size) for size in sizes[i])
        model, params = _camera_params(reconstruction.K[i], lens[i], scales[i])
        key = (int(groups[i]), width, height, params)
        camera = cameras.setdefault(key, ColmapCamera(len(cameras) + 1, model, width, height, params))
        numbers[i] = camera.camera_id
    return tuple(cameras.values()), numbers


def _camera_params(K: F64, distortion: F64, scale: F64) -> tuple[str, tuple[float, ...]]:
    """Return the smallest COLMAP camera model for K and (k1, k2, k3), with parameters in original pixels."""
    if abs(K[0, 1]) > _SKEW_REL * K[0, 0]:
        raise ValueError(
            f"COLMAP has no camera model with skew; K has {K[0, 1]:.3g} px, set it to 0 before the export"
        )
    fx, fy = float(K[0, 0] * scale[0]), float(K[1, 1] * scale[1])
    centre = tuple(float(value) for value in (K[:2, 2] + _PIXEL_CENTRE) * scale)
    k1, k2, k3 = distortion.tolist()
    if k2 or k3:
        return "FULL_OPENCV", (fx, fy, *centre, k1, k2, 0.0, 0.0, k3, 0.0, 0.0, 0.0)
    # One focal length for both moves no pixel by more than rounding.
    same_focal = abs(fx - fy) <= 1e-12 * fx
    if same_focal:
        return ("SIMPLE_RADIAL", (fx, *centre, k1)) if k1 else ("SIMPLE_PINHOLE", (fx, *centre))
    return ("OPENCV", (fx, fy, *centre, k1, 0.0, 0.0, 0.0)) if k1 else ("PINHOLE", (fx, fy, *centre))


def _images(
    names: Sequence[str],
    poses: dict[int, tuple[F64, F64]],
    camera_ids: dict[int, int],
    observations: tuple[I64, I64, F64],
) -> tuple[tuple[ColmapImage, ...], I64]:
    """Return the images, and the row of each observation in its image."""
    view, point, xy = observations
    row = np.zeros(len(view), dtype=np.int64)
    images = []
    for i, (R, t) in poses.items():
        here = np.flatnonzero(view == i)
        row[here] = np.arange(len(here))
        quaternion = np.roll(scipy.spatial.transform.Rotation.from_matrix(R).as_quat(canonical=True), 1)
        images.append(ColmapImage(i + 1, quaternion, t, camera_ids[i], names[i], xy[here], point[here] + 1))
    return tuple(images), row


def _points(
    X: F64, colors: NDArray[np.uint8], observations: tuple[I64, I64, I64], distance: F64
) -> ColmapPoints:
    view, point, row = observations
    order = np.lexsort((view, point))
    used, counts = np.unique(point, return_counts=True)
    return ColmapPoints(
        ids=used + 1,
        xyz=X[used, :3] / X[used, 3:],
        rgb=colors[used],
        error=np.bincount(point, weights=distance, minlength=len(X))[used] / counts,
        track_start=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        track_image=view[order] + 1,
        track_xy=row[order],
    )


def reconstruction_from_colmap(model: ColmapModel, *, names: Sequence[str] | None = None) -> Reconstruction:
    """Convert a COLMAP model to a metric reconstruction in the pixels of its images.

    Parameters
    ----------
    model : ColmapModel
        Consistent, with pinhole cameras and at most three radial coefficients.
    names : sequence of str, optional
        File names that number the views; those without an image are not registered. By default the images of
        the model, sorted by name.

    Returns
    -------
    Reconstruction
        Points in the order of the model, all valid; all observations inliers. If an image sees a point twice,
        the first observation is used. ``sigma_px`` is 1.4826 times the median absolute coordinate residual.

    Raises
    ------
    StageFailure
        For an unsupported camera model or distortion, or two images of one name.
    ValueError
        If an image of the model is not among ``names``.
    """
    by_name = {image.name: image for image in model.images}
    if len(by_name) < len(model.images):
        raise StageFailure(
            "two images of the COLMAP model have the same name", advice="give every image its own name"
        )
    names = sorted(by_name) if names is None else names
    unknown = sorted(set(by_name) - set(names))
    if unknown or len(set(names)) < len(names):
        raise ValueError(
            f"names must hold each image of the model once; missing or repeated: {unknown[:3] or names[:3]}"
        )
    cameras = {camera.camera_id: camera for camera in model.cameras}
    K, distortion = np.zeros((len(names), 3, 3)), np.zeros((len(names), 3))
    P, sizes = np.zeros((len(names), 3, 4)), np.zeros((len(names), 2), dtype=np.int64)
    poses = {}
    for i, name in enumerate(names):
        if name in by_name:
            image = by_name[name]
            camera = cameras[image.camera_id]
            K[i], distortion[i] = _intrinsics(camera)
            poses[i] = (
                scipy.spatial.transform.Rotation.from_quat(np.roll(image.quaternion_wxyz, -1)).as_matrix(),
                image.translation,
            )
            P[i], sizes[i] = compose_camera(K[i], *poses[i]), (camera.width, camera.height)
    return _with_observations(model, names, (P, K, distortion, sizes), poses)


def _with_observations(
    model: ColmapModel,
    names: Sequence[str],
    cameras: tuple[F64, F64, F64, I64],
    poses: dict[int, tuple[F64, F64]],
) -> Reconstruction:
    P, K, distortion, sizes = cameras
    registered = np.isin(np.arange(len(names)), list(poses))
    tracks = _tracks(model, names)
    reconstruction = Reconstruction(
        stratum="metric",
        P=P,
        X=np.column_stack([model.points.xyz, np.ones(len(model.points.ids))]),
        registered=registered,
        valid=np.ones(len(model.points.ids), dtype=np.bool_),
        inlier=np.ones(len(tracks.xy), dtype=np.bool_),
        tracks=tracks,
        sizes=sizes,
        sigma_px=0.0,
        reasons=tuple("" if known else "not in the COLMAP model" for known in registered),
        K=K,
        distortion=distortion,
    )
    # Foreign models may hold points in a camera's principal plane, or so distant that squares overflow.
    with np.errstate(all="ignore"):
        seen = _reproject(reconstruction, poses, tracks.view_index, tracks.point_index)
        size = np.abs(seen - tracks.xy)
    size = size[np.isfinite(size)]
    return replace(reconstruction, sigma_px=1.4826 * float(np.median(size)) if len(size) else 0.0)


def _tracks(model: ColmapModel, names: Sequence[str]) -> Tracks:
    view_of_name = {name: i for i, name in enumerate(names)}
    views, points, xy = [], [], []
    order = np.argsort(model.points.ids, kind="stable")
    for image in model.images:
        seen = image.point_ids != NO_POINT
        place = order[np.searchsorted(model.points.ids[order], image.point_ids[seen])]
        points.append(place.astype(np.int64))
        views.append(np.full(len(place), view_of_name[image.name], dtype=np.int64))
        xy.append(image.xy[seen] - _PIXEL_CENTRE)
    view = np.concatenate([*views, np.zeros(0, dtype=np.int64)])
    point = np.concatenate([*points, np.zeros(0, dtype=np.int64)])
    _, first = np.unique(point * len(names) + view, return_index=True)
    positions = np.concatenate([*xy, np.zeros((0, 2))])[first]
    return Tracks(view[first], point[first], positions, len(names), len(model.points.ids))


def _intrinsics(camera: ColmapCamera) -> tuple[F64, F64]:
    """K (3, 3) and (k1, k2, k3) in our pixels; any other nonzero distortion is refused."""
    params = camera.params
    single = camera.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
    if not single and camera.model not in ("PINHOLE", "OPENCV", "FULL_OPENCV"):
        raise StageFailure(
            f"camera {camera.camera_id} of the COLMAP model has the model {camera.model}",
            "only three radial coefficients are supported",
            "undistort the images, or reconstruct with SIMPLE_RADIAL",
        )
    focal, rest = ((params[0], params[0]), params[1:]) if single else ((params[0], params[1]), params[2:])
    centre, coefficients = rest[:2], (*rest[2:], *[0.0] * 8)
    distortion = np.array([coefficients[0], coefficients[1], 0.0 if single else coefficients[4]])
    if any(coefficients[2:4]) or any(coefficients[5:]):
        raise StageFailure(
            f"camera {camera.camera_id} of the COLMAP model has the distortion {rest[2:]}",
            "only three radial coefficients are supported",
            "undistort the images, or reconstruct with SIMPLE_RADIAL",
        )
    if min(focal) <= 0:
        raise StageFailure(
            f"camera {camera.camera_id} of the COLMAP model has a focal length that is not positive"
        )
    x, y = (value - _PIXEL_CENTRE for value in centre)
    return np.array([[focal[0], 0.0, x], [0.0, focal[1], y], [0.0, 0.0, 1.0]]), distortion
