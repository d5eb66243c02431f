"""COLMAP sparse models as our reconstructions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from thesisrecon.camera import compose_camera, project_camera
from thesisrecon.errors import UsageError
from thesisrecon.io._models import read_model
from thesisrecon.records import Reconstruction, Tracks


def read_colmap_model(folder: Path, names: Sequence[str]) -> Reconstruction:
    """Read a COLMAP model as a metric reconstruction in the pixels of its images.

    ``names`` number the views; those without an image are not registered. All points are valid and all
    observations inliers. ``sigma_px`` is 1.4826 times the median absolute coordinate residual. UsageError
    for missing or damaged files and for cameras other than pinholes with three radial coefficients,
    ``ValueError`` for an image not in ``names``.
    """
    model = read_model(folder)
    unknown = sorted(set(model.names) - set(names))
    if unknown:
        raise ValueError(f"names must hold each image once; missing: {unknown[:3]}")
    V, N = len(names), len(model.X)
    K, distortion, P = np.zeros((V, 3, 3)), np.zeros((V, 3)), np.zeros((V, 3, 4))
    sizes, registered = np.zeros((V, 2), np.int64), np.isin(names, model.names)
    index = np.array([names.index(name) for name in model.names], np.int64)
    residual = np.zeros((len(model.xy), 2))
    for k, (i, view) in enumerate(zip(index.tolist(), model.views, strict=True)):
        if view.K is None or view.distortion is None or view.size is None:
            raise UsageError(f"the camera of {view.name} has other distortion than three radial coefficients")
        K[i], distortion[i], sizes[i] = view.K, view.distortion, view.size
        P[i] = compose_camera(view.K, view.R, view.t)
        here = model.view_index == k
        # Points may lie in a camera's principal plane, or so far away that squares overflow.
        with np.errstate(all="ignore"):
            X = model.X[model.point_index[here]]
            seen = project_camera(view.K, view.R, view.t, X, distortion=view.distortion)
            residual[here] = np.abs(seen - model.xy[here])
    residual = residual[np.isfinite(residual)]
    order = np.lexsort((index[model.view_index], model.point_index))
    view_index, point_index = index[model.view_index][order], model.point_index[order]
    return Reconstruction(
        stratum="metric",
        P=P,
        X=np.column_stack([model.X, np.ones(N)]),
        registered=registered,
        valid=np.ones(N, dtype=np.bool_),
        inlier=np.ones(len(order), dtype=np.bool_),
        tracks=Tracks(view_index, point_index, model.xy[order], V, N),
        sizes=sizes,
        sigma_px=1.4826 * float(np.median(residual)) if len(residual) else 0.0,
        reasons=tuple("" if there else "not in the COLMAP model" for there in registered),
        K=K,
        distortion=distortion,
    )
