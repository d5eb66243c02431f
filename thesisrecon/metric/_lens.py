"""The model of a lens that bends lines: equidistant with a polynomial, radial, or division."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thesisrecon.lens import ANGLE, DIVISION, PERSPECTIVE, directions_of_image
from thesisrecon.metric import _model
from thesisrecon.metric._adjustment import MetricAdjustment
from thesisrecon.metric._model import FOCAL, K1, LATE_SIGMAS, MetricEstimate, refitted_lens
from thesisrecon.optimize.bundle.projection import LENS


def with_best_lens(model: MetricEstimate, adjustment: MetricAdjustment) -> MetricEstimate:
    """The model with the lens of least cost of all observations; as it is if images are nearly straight."""
    if model.cameras.intrinsics.shape[1] == _model.WIDTH:
        return model
    models = [_settled(model, adjustment)]
    models += [_settled(with_lens(models[0], kind), adjustment) for kind in (PERSPECTIVE, DIVISION)]
    gate = LATE_SIGMAS * min(m.gate_px for m in models)
    return min(models, key=lambda m: _model.truncated_cost(m, gate))


def _settled(model: MetricEstimate, adjustment: MetricAdjustment) -> MetricEstimate:
    """Adjust all and triangulate again, until the points beyond the first view angles have joined."""
    for _ in range(3):
        model = adjustment.run(model)[0]
        model = _model.retriangulate_tracks(model, sigmas=LATE_SIGMAS)
    return model


def with_lens(model: MetricEstimate, kind: int) -> MetricEstimate:
    """The model whose equidistant lenses are those of another kind, fitted over the image."""
    rows = model.cameras.intrinsics.copy()
    for row in np.flatnonzero(rows[:, LENS] == ANGLE):
        sizes = model.sizes[model.cameras.group == row]
        radii = np.linspace(0.0, np.linalg.norm(sizes, axis=1).max() / 2.0, _model.RADII + 1)[1:]
        rays = directions_of_image(np.column_stack([radii, 0.0 * radii]) / rows[row, FOCAL], rows[row, K1:])
        known = np.isfinite(rays[:, 0]) & (rays[:, 2] > 0.0)
        rows[row] = refitted_lens(rows[row], kind, radii[known], rays[known, 0] / rays[known, 2])
    return replace(model, cameras=replace(model.cameras, intrinsics=rows))
