"""A camera without distortion, with the size of its picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import compose_camera, decompose_camera


@dataclass(frozen=True)
class Camera:
    """A camera without distortion (3.21): K, R (3, 3), t (3,), ``size`` (width, height) in px.

    Raises ``ValueError`` for other shapes, a size below one pixel, and numbers that are not finite.
    """

    K: F64
    R: F64
    t: F64
    size: tuple[int, int]

    def __post_init__(self) -> None:
        shapes = (np.shape(self.K), np.shape(self.R), np.shape(self.t))
        if shapes != ((3, 3), (3, 3), (3,)):
            raise ValueError(f"Camera needs K (3, 3), R (3, 3), t (3,); got {shapes}")
        if min(self.size) < 1:
            raise ValueError(f"Camera needs a size of at least 1 x 1; got {self.size}")
        if not all(np.isfinite(a).all() for a in (self.K, self.R, self.t)):
            raise ValueError("Camera needs finite K, R and t")

    @classmethod
    def from_matrix(cls, P: F64, size: tuple[int, int]) -> Camera:
        """The camera of P (3, 4) of any scale and sign; ``ValueError`` for a camera at infinity."""
        return cls(*decompose_camera(P), size)

    @property
    def P(self) -> F64:
        """K [R t] (3, 4)."""
        return compose_camera(self.K, self.R, self.t)

    @property
    def centre(self) -> F64:
        """-R' t (3,)."""
        return np.asarray(-self.R.T @ self.t)

    def resized(self, factor: float) -> Camera:
        """The same view with ``factor`` times as many pixels a side (x goes to (x + 0.5) factor - 0.5)."""
        width, height = (max(1, round(side * factor)) for side in self.size)
        S = np.diag([width / self.size[0], height / self.size[1], 1.0])
        S[:2, 2] = (np.diag(S)[:2] - 1.0) / 2.0
        return Camera(S @ self.K, self.R, self.t, (width, height))
