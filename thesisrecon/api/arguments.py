"""Cameras, sizes, points, pixels and meshes as a user passes them, checked, in the shapes of the records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from thesisrecon.arrays import (
    F64,
    I64,
    require_calibration,
    require_finite,
    require_rotations,
    require_shapes,
)
from thesisrecon.camera import Camera, compose_camera, decompose_camera
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.optimize.bundle.partial import triangulate_points
from thesisrecon.records import Reconstruction

CameraInput = Sequence[Camera] | tuple[F64, F64, F64] | Mapping[str, Camera] | Reconstruction
"""Cameras, (K, R, t), cameras by image name, or a metric reconstruction."""


def checked_sizes(caller: str, sizes: I64, n: int) -> I64:
    """Image sizes (n, 2) of (n, 2) or (2,) whole numbers above 0."""
    given = np.asarray(sizes)
    if given.shape not in ((2,), (n, 2)) or not np.isin(given.dtype.kind, ("i", "u", "f")):
        raise ValueError(f"{caller} needs sizes (V, 2) or (2,), width and height; got {given.shape}, V = {n}")
    if not (np.isfinite(given).all() and (given >= 1).all() and (given == np.round(given)).all()):
        raise ValueError(f"{caller} needs sizes of whole numbers above 0; got {given.tolist()}")
    return np.broadcast_to(given, (n, 2)).astype(np.int64)


def checked_cameras(cameras: Sequence[F64], sizes: I64, *, metric: bool) -> tuple[F64, F64 | None, I64]:
    """P (V, 3, 4), K (V, 3, 3) of a metric frame, and sizes (V, 2), of P alone or of K, R and t."""
    caller = "reconstruction_from_cameras"
    arrays = [np.asarray(array, dtype=np.float64) for array in cameras]
    if len(arrays) == 1:
        require_shapes(caller, P=(arrays[0], ("V", 3, 4)))
        require_finite(caller, *arrays)
        P, K = arrays[0], None
        if metric:
            parts = [decompose_camera(camera) for camera in P]
            P, K = np.stack([compose_camera(*part) for part in parts]), np.stack([part[0] for part in parts])
    elif len(arrays) == 3 and metric:
        K, R, t = arrays
        K = np.broadcast_to(K, (len(R), 3, 3)) if K.ndim == 2 else K
        require_shapes(caller, K=(K, ("V", 3, 3)), R=(R, ("V", 3, 3)), t=(t, ("V", 3)))
        require_finite(caller, K, R, t)
        for one in K:
            require_calibration(caller, one)
        require_rotations(caller, R)
        P = compose_camera(K, R, t)
    else:
        raise ValueError(f"{caller} needs P, or K, R and t of a metric frame; got {len(arrays)} arrays")
    return P, K, checked_sizes(caller, sizes, len(P))


def require_inside(view: I64, xy: F64, sizes: I64) -> None:
    """Raise ``ValueError`` if pixels (K, 2) lie far outside the images of their views; ``sizes`` (V, 2)."""
    size = sizes[view]
    reach = (np.maximum(-xy, xy - size) / size.max(axis=1, keepdims=True)).max(axis=1)
    # Pixels this far outside show that the size is wrong, for example height x width.
    if len(reach) and reach.max() > 0.1:
        k = int(reach.argmax())
        raise ValueError(
            f"pixels of view {view[k]} lie outside its size {tuple(size[k].tolist())} by {reach[k]:.0%} of "
            "the long side; sizes are (width, height)"
        )


def checked_points(
    P: F64, sizes: I64, X: F64 | None, xy: F64 | None, *, finite: bool
) -> tuple[F64, I64, I64, F64]:
    """Points (N, 4), zeros where unknown, and view, point and pixels (K,), (K,), (K, 2) of observations."""
    caller = "reconstruction_from_cameras"
    if xy is None:
        xy = np.full((len(P), 0 if X is None else len(X), 2), np.nan)
    xy = np.asarray(xy, dtype=np.float64)
    require_shapes(caller, P=(P, ("V", 3, 4)), xy=(xy, ("V", "N", 2)))
    point, views = np.nonzero(np.isfinite(xy).all(axis=2).T)
    require_inside(views, xy[views, point], sizes)
    if X is None:
        X = triangulate_points(P, xy) if xy.shape[1] else np.zeros((0, 4))
    X = np.asarray(X)
    X = homogenize(X.astype(np.float64)) if X.ndim == 2 and X.shape[1] == 3 else X.astype(np.float64)
    require_shapes(caller, X=(X, ("N", 4)), xy=(xy[0], ("N", 2)))
    require_finite(caller, X)
    if finite:
        near = np.abs(X[:, 3:]) > 1e-12 * np.linalg.norm(X, axis=1, keepdims=True)
        X = np.where(near, X / np.where(near, X[:, 3:], 1.0), 0.0)
    return X, views, point, xy[views, point]


def as_cameras(
    caller: str, cameras: CameraInput, sizes: I64 | None = None, names: Sequence[str] = ()
) -> list[Camera]:
    """The cameras in order; the registered ones of a reconstruction; of a mapping those of ``names``."""
    if isinstance(cameras, Reconstruction):
        return _of_reconstruction(caller, cameras)
    if isinstance(cameras, Mapping):
        missing = [name for name in names if name not in cameras]
        if missing:
            first = next(iter(cameras), None)
            raise ValueError(f"{caller} got no camera for {missing[0]}; the first camera is that of {first}")
        return [cameras[name] for name in names or cameras]
    given: list[Any] = list(cameras) if isinstance(cameras, Sequence) else []
    if given and all(isinstance(one, Camera) for one in given):
        return given
    if len(given) != 3 or any(isinstance(one, Camera | str) for one in given):
        kinds = "cameras as thesisrecon.Camera, result.reconstruction, or a tuple (K, R, t) of arrays"
        raise ValueError(f"{caller} needs {kinds}; got a {type(cameras).__name__}")
    if sizes is None:
        raise ValueError(f"{caller} needs sizes (V, 2) or (2,), width and height, with (K, R, t)")
    K, R, t = (np.asarray(one, dtype=np.float64) for one in given)
    K = np.broadcast_to(K, (len(R), 3, 3)) if K.ndim == 2 else K
    require_shapes(caller, K=(K, ("V", 3, 3)), R=(R, ("V", 3, 3)), t=(t, ("V", 3)))
    return [Camera(*one) for one in zip(K, R, t, checked_sizes(caller, sizes, len(R)), strict=True)]


def _of_reconstruction(caller: str, r: Reconstruction) -> list[Camera]:
    if r.stratum != "metric" or r.K is None:
        raise ValueError(f"{caller} needs a metric reconstruction with K; got {r.stratum}")
    views = []
    for i in np.flatnonzero(r.registered):
        Rt = np.linalg.solve(r.K[i], r.P[i])
        size = int(r.sizes[i][0]), int(r.sizes[i][1])
        views.append(
            Camera(r.K[i], Rt[:, :3], Rt[:, 3], size, None if r.distortion is None else r.distortion[i])
        )
    return views


def radial_coefficients(caller: str, views: Sequence[Camera]) -> F64:
    """Distortion k1, k2, k3 (V, 3) of cameras; ``ValueError`` if one has further coefficients."""
    table = np.zeros((len(views), 3))
    for row, view in zip(table, views, strict=True):
        lens = np.zeros(0) if view.distortion is None else view.distortion
        if np.any(lens[3:]):
            raise ValueError(f"{caller} takes distortion by k1, k2, k3; got {len(lens)} coefficients")
        row[: len(lens[:3])] = lens[:3]
    return table
