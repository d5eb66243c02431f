"""True poses of synthetic cameras, from operations that IEEE 754 rounds exactly (+ - * / sqrt)."""

from __future__ import annotations

import numpy as np

from thesisrecon.arrays import F64


def look_at(C: F64, target: F64, tan_half_roll: float) -> F64:
    """R (3, 3) world-to-camera of a camera at C towards a target, z up in the world, turned about its own
    axis.

    The roll is given as the tangent of its half, so that no library's sine decides the last bit.
    """
    forward = _unit(target - C)
    right = _unit(np.array([forward[1], -forward[0], 0.0]))
    down = np.array(
        [
            forward[1] * right[2] - forward[2] * right[1],
            forward[2] * right[0] - forward[0] * right[2],
            forward[0] * right[1] - forward[1] * right[0],
        ]
    )
    t = tan_half_roll
    c, s = (1.0 - t * t) / (1.0 + t * t), 2.0 * t / (1.0 + t * t)
    return np.stack([c * right + s * down, c * down - s * right, forward])


def _unit(a: F64) -> F64:
    return np.asarray(a / np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]), dtype=np.float64)
