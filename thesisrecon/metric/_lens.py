"""The lens that bends lines: equidistant with a polynomial, radial, or division; decentred or not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from thesisrecon.arrays import B8, F64
from thesisrecon.camera import angles_of_view
from thesisrecon.errors import Notice
from thesisrecon.lens import ANGLE, DIVISION, directions_of_image
from thesisrecon.metric import _model
from thesisrecon.metric._adjustment import MetricAdjustment, best_predictors, predicts_better
from thesisrecon.metric._model import BASES, FOCAL, K1, LATE_SIGMAS, MetricEstimate, refitted_lens
from thesisrecon.optimize.bundle.identifiability import TOLERANCES
from thesisrecon.optimize.bundle.projection import LENS
from thesisrecon.records import IntrinsicInterval

MAX_CORNER_STD = 0.03
"""Standard deviation of the angle of the corners from the axis, over the angle, of a determined lens."""
MIN_REACH = 0.8  # of the half diagonal, within which 99 % of the points of a determined lens do not lie
FORWARD = float(np.cos(np.radians(10.0)))  # cosine of the angle of a forward motion from the optical axis


def with_best_lens(
    model: MetricEstimate, adjustment: MetricAdjustment
) -> tuple[MetricEstimate, MetricAdjustment]:
    """The model with the lens that the user sets, or that predicts best; radial if images hardly bend lines.

    A lens that is not given is decentred if that predicts held-out observations better.
    """
    if model.cameras.intrinsics.shape[1] == _model.WIDTH:
        return model, adjustment
    given = adjustment.prior.lens_model
    start, bends = _settled(model, adjustment), model.cameras.intrinsics[:, LENS] == ANGLE
    if given != "auto":
        bends = np.ones_like(bends)
    models = [_settled(with_lens(start, bends, base), adjustment) for base in BASES[given]]
    best, *equal = best_predictors(models, adjustment)
    changes = [np.abs(_angles(other) - _angles(best)).max(axis=0) for other in equal]
    if changes := [change for change in changes if np.isfinite(change).all()]:
        view, corner = np.max(changes, axis=0).tolist()
        adjustment = replace(adjustment, lens_change=(view, corner))
    if given not in ("auto", "brown") or (best.cameras.intrinsics[:, LENS] == DIVISION).any():
        return best, adjustment
    free = replace(adjustment, decentred=True)
    decentred = _settled(best, free)
    if given == "brown" or predicts_better((best, adjustment), (decentred, free)):
        return decentred, free
    return best, adjustment


def _angles(model: MetricEstimate) -> F64:
    """Angles of view (V, 2) of the registered images."""
    rows, K = model.cameras.intrinsics[model.cameras.group], model.cameras.K
    return np.array([
        angles_of_view(K[v], (int(model.sizes[v, 0]), int(model.sizes[v, 1])), rows[v, K1:])
        for v in np.flatnonzero(model.registered)
    ])  # fmt: skip


def _settled(model: MetricEstimate, adjustment: MetricAdjustment) -> MetricEstimate:
    """Adjust all and triangulate again, until the points beyond the first view angles have joined."""
    for _ in range(3):
        model = adjustment.run(model)[0]
        model = _model.retriangulate_tracks(model, sigmas=LATE_SIGMAS)
    return model


def with_lens(model: MetricEstimate, rows: B8, base: int) -> MetricEstimate:
    """The model whose lenses in some rows have another base, fitted over the image."""
    table = model.cameras.intrinsics.copy()
    for row in np.flatnonzero(rows & (table[:, LENS] != base)):
        sizes = model.sizes[model.cameras.group == row]
        radii = np.linspace(0.0, np.linalg.norm(sizes, axis=1).max() / 2.0, _model.RADII + 1)[1:]
        rays = directions_of_image(np.column_stack([radii, 0.0 * radii]) / table[row, FOCAL], table[row, K1:])
        known = np.isfinite(rays[:, 0]) & (rays[:, 2] > 0.0)
        table[row] = refitted_lens(table[row], base, radii[known], rays[known, 0] / rays[known, 2])
    return replace(model, cameras=replace(model.cameras, intrinsics=table))


def undetermined_lens(
    model: MetricEstimate, intervals: Sequence[Mapping[str, IntrinsicInterval]], motion: Mapping[str, float]
) -> tuple[str, ...]:
    """A sentence if the rays of the corners are uncertain, with what leaves the lens undetermined."""
    where = "its model images nothing at the corners"
    if all("corner_deg" in own for own in intervals if own):
        corners = [own["corner_deg"] for own in intervals if own]
        worst = max(corners, key=lambda corner: corner.std / corner.value)
        if worst.std <= MAX_CORNER_STD * worst.value:
            return ()
        where = f"the corners are {worst.value:.1f} ± {worst.std:.1f} degrees from the axis"
    # Points in the middle, parallel views of a plane, or forward motion.
    flat, parallel = (
        motion[name] < TOLERANCES[name] for name in ("scene_planarity_ratio", "infinity_shift_beyond_roll")
    )
    views, reach = np.flatnonzero(model.registered), reach_of_points(model)
    steps = np.diff(model.cameras.centres[views], axis=0)
    along = np.abs(np.einsum("va,va->v", steps, model.cameras.R[views[:-1], 2]))
    why = "add images that turn the camera, with the same points in the middle and at the corners"
    if reach < MIN_REACH:
        why = (
            f"99 % of the points lie within {reach:.0%} of the half diagonal. Fill the images with the scene"
        )
    elif flat and parallel:
        why = "parallel views of a flat scene exchange its relief and the lens (Wu, 2014). Tilt the camera"
    elif np.median(along / np.maximum(np.linalg.norm(steps, axis=1), 1e-300)) > FORWARD:
        why = "the camera moved along its axis. Add images from the sides"
    return (Notice("lens-undetermined", where, why),)


def reach_of_points(model: MetricEstimate) -> float:
    """Distance from the image centre, over the half diagonal, within which 99 % of the points lie."""
    t = model.tracks
    sizes = model.sizes[t.view_index[model.inlier]]
    off = 2.0 * t.xy[model.inlier] - (sizes - 1.0)
    return float(np.quantile(np.linalg.norm(off, axis=1) / np.linalg.norm(sizes, axis=1), 0.99))
