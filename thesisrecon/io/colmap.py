"""Conversion between reconstructions and COLMAP sparse models: the only place with COLMAP's conventions.

COLMAP puts the centre of the top-left pixel at (0.5, 0.5), numbers from 1, and separates cameras from images.
Its SIMPLE_RADIAL distortion is the one used here, x (1 + k1 r^2) on normalized points; FULL_OPENCV adds
k2 and k3.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from thesisrecon.arrays import F64, I64, U8
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
    colors: U8,
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
        For another stratum, a K with skew (COLMAP has no camera for it), or a P that is not K [R t].
    """
    r = reconstruction
    if r.stratum != "metric" or r.K is None:
        raise ValueError(f"colmap_from_reconstruction needs a metric reconstruction with K; got {r.stratum}")
    if not (np.isfinite(scales).all() and (scales > 0).all()):
        raise ValueError("colmap_from_reconstruction needs finite scales above 0")
    scales = np.broadcast_to(scales.reshape(len(names), -1), (len(names), 2))
    view, point = r.tracks.view_index, r.tracks.point_index
    kept = r.inlier & r.registered[view] & r.valid[point]
    kept &= np.bincount(point[kept], minlength=len(r.X))[point] >= 2
    view, point, xy = view[kept], point[kept], r.tracks.xy[kept]
    sizes = np.rint(r.sizes * scales).astype(np.int64) if original_sizes is None else original_sizes
    lens = np.zeros((len(r.P), 3)) if r.distortion is None else r.distortion
    # One camera per group and set of intrinsics.
    cameras: dict[tuple[object, ...], ColmapCamera] = {}
    images, row, distance = [], np.zeros(len(view), dtype=np.int64), np.zeros(len(view))
    for i in np.flatnonzero(r.registered).tolist():
        width, height = (int(size) for size in sizes[i])
        model, params = _camera_params(r.K[i], lens[i], scales[i])
        key = (int(groups[i]), width, height, params)
        camera = cameras.setdefault(key, ColmapCamera(len(cameras) + 1, model, width, height, params))
        R, t = _pose(r.K[i], r.P[i], i)
        here = np.flatnonzero(view == i)
        row[here] = np.arange(len(here))
        seen = project_camera(r.K[i], R, t, _points(r.X[point[here]]), distortion=lens[i])
        distance[here] = np.linalg.norm((seen - xy[here]) * scales[i], axis=1)
        quaternion = np.roll(scipy.spatial.transform.Rotation.from_matrix(R).as_quat(canonical=True), 1)
        original_xy = (xy[here] + _PIXEL_CENTRE) * scales[i]
        images.append(
            ColmapImage(i + 1, quaternion, t, camera.camera_id, names[i], original_xy, point[here] + 1)
        )
    order = np.lexsort((view, point))
    used, counts = np.unique(point, return_counts=True)
    points = ColmapPoints(
        ids=used + 1,
        xyz=_points(r.X[used]),
        rgb=colors[used],
        error=np.bincount(point, weights=distance, minlength=len(r.X))[used] / counts,
        track_start=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        track_image=view[order] + 1,
        track_xy=row[order],
    )
    return ColmapModel(tuple(cameras.values()), tuple(images), points)


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
    """
    K = reconstruction.K
    assert K is not None
    return np.flatnonzero(reconstruction.registered & (np.abs(K[:, 0, 1]) > _SKEW_REL * K[:, 0, 0]))


def _points(Xh: F64) -> F64:
    return Xh[:, :3] / Xh[:, 3:]


def _pose(K: F64, P: F64, i: int) -> tuple[F64, F64]:
    """R (3, 3) and t (3,) of P = s K [R t] with s > 0."""
    pose = np.asarray(np.linalg.solve(K, P), dtype=np.float64)
    pose /= np.cbrt(np.linalg.det(pose[:, :3]))
    if not np.allclose(pose[:, :3] @ pose[:, :3].T, np.eye(3), atol=1e-6):
        raise ValueError(f"P of view {i} is not K [R t]: inv(K) P contains no rotation")
    return pose[:, :3], pose[:, 3]


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
    tracks = _tracks(model, names)
    K, distortion = np.zeros((len(names), 3, 3)), np.zeros((len(names), 3))
    P, sizes = np.zeros((len(names), 3, 4)), np.zeros((len(names), 2), dtype=np.int64)
    registered = np.array([name in by_name for name in names], dtype=np.bool_)
    residual = np.zeros((len(tracks.xy), 2))
    for i in np.flatnonzero(registered).tolist():
        image = by_name[names[i]]
        camera = cameras[image.camera_id]
        K[i], distortion[i] = _intrinsics(camera)
        wxyz = image.quaternion_wxyz
        R = scipy.spatial.transform.Rotation.from_quat(np.roll(wxyz, -1)).as_matrix()
        P[i], sizes[i] = compose_camera(K[i], R, image.translation), (camera.width, camera.height)
        here = tracks.view_index == i
        X = model.points.xyz[tracks.point_index[here]]
        # Foreign models may hold points in a camera's principal plane, or so distant that squares overflow.
        with np.errstate(all="ignore"):
            seen = project_camera(K[i], R, image.translation, X, distortion=distortion[i])
            residual[here] = np.abs(seen - tracks.xy[here])
    residual = residual[np.isfinite(residual)]
    return Reconstruction(
        stratum="metric",
        P=P,
        X=np.column_stack([model.points.xyz, np.ones(len(model.points.ids))]),
        registered=registered,
        valid=np.ones(len(model.points.ids), dtype=np.bool_),
        inlier=np.ones(len(tracks.xy), dtype=np.bool_),
        tracks=tracks,
        sizes=sizes,
        sigma_px=1.4826 * float(np.median(residual)) if len(residual) else 0.0,
        reasons=tuple("" if known else "not in the COLMAP model" for known in registered),
        K=K,
        distortion=distortion,
    )


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
    what, params = f"camera {camera.camera_id} of the COLMAP model has", camera.params
    advice = (
        "only three radial coefficients are supported",
        "undistort the images, or reconstruct with SIMPLE_RADIAL",
    )
    single = camera.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
    if not single and camera.model not in ("PINHOLE", "OPENCV", "FULL_OPENCV"):
        raise StageFailure(f"{what} the model {camera.model}", *advice)
    focal, rest = ((params[0], params[0]), params[1:]) if single else ((params[0], params[1]), params[2:])
    coefficients = (*rest[2:], *[0.0] * 8)
    distortion = np.array([coefficients[0], coefficients[1], 0.0 if single else coefficients[4]])
    if any(coefficients[2:4]) or any(coefficients[5:]):
        raise StageFailure(f"{what} the distortion {rest[2:]}", *advice)
    if min(focal) <= 0:
        raise StageFailure(f"{what} a focal length that is not positive")
    x, y = (value - _PIXEL_CENTRE for value in rest[:2])
    return np.array([[focal[0], 0.0, x], [0.0, focal[1], y], [0.0, 0.0, 1.0]]), distortion
