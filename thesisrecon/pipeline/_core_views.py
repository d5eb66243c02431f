"""Self-calibration from a few well-connected views if all views together have no solution.

Drift and wrong tracks bend projective reconstructions of long sequences, so that no calibration places the
points in front of all cameras. Neighbouring views still determine one; the metric stage registers the others.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from thesisrecon.arrays import B8
from thesisrecon.config import SelfCalibrator
from thesisrecon.errors import StageFailure
from thesisrecon.intrinsics import IntrinsicsPrior
from thesisrecon.records import Reconstruction, SelfCalibration

CORE_VIEWS = 5
MAX_CORES = 8


def calibrate_with_core(
    method: SelfCalibrator, projective: Reconstruction, *, prior: IntrinsicsPrior, rng: np.random.Generator
) -> SelfCalibration:
    """Calibrate all views, or a core of them if that fails: the first core that determines the calibration.

    ``K`` is zero for the views that are not in the core. Raises the failure of all views if no core succeeds.
    """
    try:
        return method.calibrate(projective, prior=prior, rng=rng)
    except StageFailure as failure:
        found = list[SelfCalibration]()
        for views in _cores(projective):
            try:
                found.append(method.calibrate(restrict_views(projective, views), prior=prior, rng=rng))
            except StageFailure:
                continue
            if found[-1].identifiable:
                return found[-1]
        if not found:
            raise failure from None
        return found[0]


def calibrated_part(projective: Reconstruction, calibration: SelfCalibration) -> Reconstruction:
    """The reconstruction of the views that have a calibration; itself if all have."""
    views = projective.registered & (calibration.K[:, 0, 0] > 0.0)
    return projective if (views == projective.registered).all() else restrict_views(projective, views)


def _cores(projective: Reconstruction) -> Iterator[B8]:
    """Masks (V,) of views: each view, best observed first, with those that share most points with it."""
    registered = np.flatnonzero(projective.registered)
    if len(registered) <= CORE_VIEWS:
        return
    shared = projective.common_points[np.ix_(registered, registered)]
    tried = set[bytes]()
    for first in np.argsort(-shared.diagonal(), kind="stable"):
        # A view shares most points with itself.
        nearest = np.argsort(-shared[first], kind="stable")[:CORE_VIEWS]
        views = np.isin(np.arange(len(projective.registered)), registered[nearest])
        if views.tobytes() not in tried:
            tried.add(views.tobytes())
            yield views
        if len(tried) == MAX_CORES:
            return


def restrict_views(reconstruction: Reconstruction, views: B8) -> Reconstruction:
    """The reconstruction of some registered views, with the points that two or more of them see."""
    t = reconstruction.tracks
    inlier = reconstruction.inlier & views[t.view_index]
    valid = reconstruction.valid & (np.bincount(t.point_index[inlier], minlength=t.n_points) >= 2)
    return replace(
        reconstruction,
        registered=views,
        valid=valid,
        inlier=inlier & valid[t.point_index],
        P=np.where(views[:, None, None], reconstruction.P, 0.0),
        X=np.where(valid[:, None], reconstruction.X, 0.0),
    )
