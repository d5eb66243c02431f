"""A richer camera model (intrinsics per image) where the images contradict shared intrinsics.

Optical stabilisation and crops move the principal point, focus and zoom change the focal length. Shared
values that the images contradict are replaced by one value per image. The richer model is kept if it predicts
held-out observations far better.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.errors import Notice
from thesisrecon.geometry.strata import estimate_similarity
from thesisrecon.metric._adjustment import MetricAdjustment
from thesisrecon.metric._model import CENTRE, FOCAL, MetricEstimate, camera_rows, reproject_observations
from thesisrecon.optimize.bundle.scatter import point_blocks
from thesisrecon.records import IntrinsicsPrior

FOLDS = 5
"""In each view one of this number of blocks of the scene is held out."""
MIN_HELD_OUT = 30
MAX_REMAINING = 0.25
"""Largest cost of held-out observations of a richer model that is adopted, relative to the simple one."""
MAX_CHANGE = 0.05
"""Relative change of centres and focal lengths up to which the simpler model is accurate enough."""

RICHER: tuple[tuple[int, ...], ...] = (CENTRE, (FOCAL,), (FOCAL, *CENTRE))
"""Columns of intrinsics with one value per image, from the simplest model on."""


def richer_models(contradicted: B8, prior: IntrinsicsPrior) -> Iterator[tuple[int, ...]]:
    """Columns to free: every model that frees all ``contradicted`` (8,) columns; known values stay known."""
    if not contradicted.any():
        return
    unknown = np.flatnonzero((prior.std > 0.0).any(axis=0))
    # Without known columns two models may be the same.
    for columns in dict.fromkeys(tuple(c for c in columns if c in unknown) for columns in RICHER):
        if np.isin(np.flatnonzero(contradicted), columns).all():
            yield columns


def with_own_values(
    model: MetricEstimate, adjustment: MetricAdjustment, columns: tuple[int, ...]
) -> tuple[MetricEstimate, MetricAdjustment]:
    """The model with one value per image in some columns of the intrinsics, without hierarchical prior."""
    shared = adjustment.prior.shared.copy()
    shared[:, columns] = np.arange(len(shared))[:, None]
    prior = replace(adjustment.prior, shared=shared)
    group, table = camera_rows(prior)
    first = np.unique(group, return_index=True)[1]
    intrinsics = model.cameras.intrinsics[model.cameras.group[first]]
    cameras = replace(model.cameras, intrinsics=intrinsics, group=group, shared=table)
    return replace(model, cameras=cameras), replace(adjustment, prior=prior, hierarchical=None, inflation=1.0)


def held_out_observations(model: MetricEstimate) -> I64:
    """Inliers of every ``FOLDS``-th block of neighbouring points, other blocks in each view.

    Correlated errors would carry over from the nearest neighbours; points keep two or more observations.
    """
    t = model.tracks
    count = np.bincount(t.point_index[model.inlier], minlength=t.n_points)
    block = point_blocks(model.X, count > 0)
    held = model.inlier & ((block[t.point_index] + t.view_index) % FOLDS == 0)
    left = count - np.bincount(t.point_index[held], minlength=t.n_points)
    return np.flatnonzero(held & (left >= 2)[t.point_index])


def remaining_cost(
    simple: tuple[MetricEstimate, MetricAdjustment], rich: tuple[MetricEstimate, MetricAdjustment]
) -> float:
    """Cost of held-out observations, richer over simple model; 1 if there are few."""
    model = simple[0]
    held = held_out_observations(replace(model, inlier=model.inlier & rich[0].inlier))
    if len(held) < MIN_HELD_OUT:
        return 1.0
    return float(_held_out_cost(*rich, held, model).mean() / _held_out_cost(*simple, held, model).mean())


def _held_out_cost(
    model: MetricEstimate, adjustment: MetricAdjustment, held: I64, unit: MetricEstimate
) -> F64:
    """Huber's loss of held-out observations, in the noise and the loss of the model ``unit``."""
    inlier = model.inlier.copy()
    inlier[held] = False
    model = adjustment.run(replace(model, inlier=inlier))[0]
    t = model.tracks
    xy, _ = reproject_observations(model, t.view_index[held], t.point_index[held])
    size = np.linalg.norm(np.nan_to_num(xy, nan=np.inf) - t.xy[held], axis=1) / unit.sigma_px
    size, loss = np.minimum(size, 100.0), unit.loss_sigmas
    return np.asarray(np.where(size < loss, 0.5 * size**2, loss * (size - 0.5 * loss)))


def differences_of_images(model: MetricEstimate, columns: tuple[int, ...]) -> str:
    """A sentence on the richer model and how much its values differ between images."""
    views = np.flatnonzero(model.registered)
    rows = model.cameras.intrinsics[model.cameras.group[views]]
    longest = model.sizes[views].max(axis=1, keepdims=True)
    centre = (rows[:, CENTRE] - (model.sizes[views] - 1) / 2) / longest
    apart = f"principal points up to {np.ptp(centre, axis=0).max():.1%} of the long side apart"
    if FOCAL not in columns:
        return Notice("own-centre", apart)
    focal = rows[:, FOCAL] / longest[:, 0]
    return Notice("own-intrinsics", focal.max() / focal.min() - 1.0, apart)


@dataclass(frozen=True)
class CameraDifferences:
    """Largest differences of the cameras between two camera models.

    ``centre`` relative to the RMS radius of the camera path, ``focal`` relative, ``principal_point`` over the
    focal length.
    """

    centre: float
    focal: float
    principal_point: float

    @property
    def harmless(self) -> bool:
        """Whether centres and focal lengths hardly depend on the camera model."""
        return max(self.centre, self.focal) < MAX_CHANGE


def camera_differences(a: MetricEstimate, b: MetricEstimate) -> CameraDifferences:
    """Differences between the cameras of two estimates after a similarity alignment of their centres."""
    v = np.flatnonzero(a.registered & b.registered)
    A, B = (m.cameras.centres[v] for m in (a, b))
    move = estimate_similarity(B, A)
    off = np.linalg.norm(A - move.apply(B), axis=1)
    radius = np.sqrt(np.mean(np.sum((A - A.mean(axis=0)) ** 2, axis=1)))
    f, g = (m.cameras.intrinsics[m.cameras.group[v], FOCAL] for m in (a, b))
    c, d = (m.cameras.intrinsics[m.cameras.group[v]][:, CENTRE] for m in (a, b))
    moved = float((np.abs(d - c) / f[:, None]).max())
    return CameraDifferences(float(off.max() / radius), float(np.abs(np.log(g / f)).max()), moved)
