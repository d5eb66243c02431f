"""Random transforms of the four strata of section 3.4."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from thesisrecon.arrays import F64
from thesisrecon.geometry.strata import Group


def random_transform(group: Group, rng: np.random.Generator) -> F64:
    """Draw a well-conditioned transform (4, 4) that belongs to no smaller group."""
    if group == "projective":
        return np.eye(4) + _shift_of_norm(rng, (4, 4), 0.5)
    G = np.eye(4)
    G[:3, 3], scale = rng.normal(size=3), float(np.exp(rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 1.0)))
    if group == "affine":
        G[:3, :3] = scale * (np.eye(3) + _shift_of_norm(rng, (3, 3), 0.5))
    else:
        R = Rotation.random(random_state=rng).as_matrix()
        G[:3, :3] = scale * R if group == "metric" else R
    return G


def _shift_of_norm(rng: np.random.Generator, shape: tuple[int, int], norm: float) -> F64:
    """Noise whose norm below 1 keeps the identity plus it invertible."""
    noise = rng.normal(size=shape)
    return np.asarray(norm * noise / np.linalg.norm(noise))
