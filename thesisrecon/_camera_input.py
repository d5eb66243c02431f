"""Cameras as a user passes them: records, plain arrays, a reconstruction or a table by image name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from thesisrecon.arrays import F64, I64
from thesisrecon.camera import Camera
from thesisrecon.records import Reconstruction

CameraInput = Sequence[Camera] | tuple[F64, F64, F64] | Mapping[str, Camera] | Reconstruction
"""Cameras, (K, R, t), cameras by image name, or a metric reconstruction."""


def as_cameras(
    caller: str, cameras: CameraInput, sizes: I64 | None = None, names: Sequence[str] = ()
) -> list[Camera]:
    """The cameras in order, of a reconstruction the registered ones; with ``names`` those of these images."""
    if isinstance(cameras, Reconstruction):
        return _of_reconstruction(caller, cameras)
    if isinstance(cameras, Mapping):
        missing = [name for name in names if name not in cameras]
        if missing:
            raise ValueError(
                f"{caller} has no camera for {missing[0]}; the first of them is {next(iter(cameras), None)}"
            )
        return [cameras[name] for name in names or cameras]
    given = list(cameras)
    if all(isinstance(one, Camera) for one in given):
        return given  # type: ignore[return-value]
    if len(given) != 3 or any(isinstance(one, Camera) for one in given):
        raise ValueError(f"{caller} needs cameras as thesisrecon.Camera, or a tuple (K, R, t) of arrays")
    if sizes is None:
        raise ValueError(f"{caller} needs sizes (V, 2) or (2,), width and height, with (K, R, t)")
    K, R, t = (np.asarray(one, dtype=np.float64) for one in given)
    return _of_reconstruction(caller, Reconstruction.from_cameras(K, R, t, sizes=sizes))


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
