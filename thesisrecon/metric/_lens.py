"""The lens that bends lines: equidistant with a polynomial, radial, or division; decentred or not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thesisrecon.arrays import B8
from thesisrecon.lens import ANGLE, DIVISION, directions_of_image
from thesisrecon.metric import _model
from thesisrecon.metric._adjustment import MetricAdjustment, predicts_better
from thesisrecon.metric._model import BASES, FOCAL, K1, LATE_SIGMAS, MetricEstimate, refitted_lens
from thesisrecon.optimize.bundle.projection import LENS


def with_best_lens(
    model: MetricEstimate, adjustment: MetricAdjustment
) -> tuple[MetricEstimate, MetricAdjustment]:
    """The model with the lens that the user sets, or of least cost; radial if images are nearly straight.

    A lens that is not given is decentred if that predicts held-out observations better.
    """
    if model.cameras.intrinsics.shape[1] == _model.WIDTH:
        return model, adjustment
    given = adjustment.prior.lens_model
    start, bends = _settled(model, adjustment), model.cameras.intrinsics[:, LENS] == ANGLE
    if given != "auto":
        bends = np.ones_like(bends)
    models = [_settled(with_lens(start, bends, base), adjustment) for base in BASES[given]]
    gate = LATE_SIGMAS * min(m.gate_px for m in models)
    best = min(models, key=lambda m: _model.truncated_cost(m, gate))
    if given not in ("auto", "brown") or (best.cameras.intrinsics[:, LENS] == DIVISION).any():
        return best, adjustment
    free = replace(adjustment, decentred=True)
    decentred = _settled(best, free)
    if given == "brown" or predicts_better((best, adjustment), (decentred, free)):
        return decentred, free
    return best, adjustment


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
