"""Calibrated cameras with radial distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import F64, I64


@dataclass(frozen=True)
class MetricCameras:
    """Calibrated cameras with shared or separate intrinsics.

    A normalised point (x, y) is distorted to (x, y) (1 + k1 r^2 + k2 r^4 + k3 r^6) and multiplied by
    K = [[f, skew, cx], [0, aspect f, cy], [0, 0, 1]].

    Parameters
    ----------
    R, t : ndarray (V, 3, 3), (V, 3)
        Poses, world-to-camera.
    intrinsics : ndarray (G, C)
        Rows [focal_px, aspect fy/fx, skew_px, cx_px, cy_px, k1], and k2, k3 if C = 8.
    group : ndarray (V,) of int
        Row of each view.
    shared : ndarray (G, C) of int, optional
        Rows with equal numbers in a column have one value there; by default every row has its own.
    """

    R: F64
    t: F64
    intrinsics: F64
    group: I64
    shared: I64 | None = None

    @property
    def K(self) -> F64:
        """Calibration matrices (V, 3, 3)."""
        f, aspect, skew, cx, cy = self.intrinsics[self.group].T[:5]
        zero, one = np.zeros_like(f), np.ones_like(f)
        rows = [f, skew, cx, zero, aspect * f, cy, zero, zero, one]
        return np.stack(rows, axis=-1).reshape(-1, 3, 3)

    @property
    def P(self) -> F64:
        """Cameras before distortion, K [R t]; (V, 3, 4)."""
        return np.asarray(self.K @ np.concatenate([self.R, self.t[:, :, None]], axis=2))
