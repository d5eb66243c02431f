"""Our cameras and depth maps in Open3D's types."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import decompose_camera
from thesisrecon.records import DepthMap


def camera_of(P: F64, *, shift: float = 0.0) -> tuple[F64, F64]:
    """K (3, 3) with its principal point moved by ``shift`` px, and the world-to-camera matrix (4, 4).

    Raises ``ValueError`` for skew, which Open3D does not support.
    """
    K, R, t = decompose_camera(P)
    if abs(K[0, 1]) > 1e-6 * K[0, 0]:
        raise ValueError(f"Open3D does not support skew; got {K[0, 1]:.3g} px")
    K = np.array([[K[0, 0], 0.0, K[0, 2] + shift], [0.0, K[1, 1], K[1, 2] + shift], [0.0, 0.0, 1.0]])
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = R, t
    return K, world


def median_footprint(depth_maps: Sequence[DepthMap]) -> float:
    """Width of a pixel at its depth, the median over all pixels of all maps."""
    widths = []
    for one in depth_maps:
        K = decompose_camera(one.P)[0]
        widths.append(one.depth[np.isfinite(one.depth)] / np.sqrt(K[0, 0] * K[1, 1]))
    return float(np.median(np.concatenate(widths)))
