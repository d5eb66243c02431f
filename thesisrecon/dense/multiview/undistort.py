"""Photographs without their lens distortion, at the size that depth is worked out at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.dense.rectification.sampling import warp_image
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera import distort
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.types import F64, Image, PinholeView, Reconstruction


def pinhole_view(
    image: Image, reconstruction: Reconstruction, view: int, *, max_side: int = 1536
) -> PinholeView:
    """Photograph ``view`` as a camera without distortion would have taken it.

    Parameters
    ----------
    image : the photograph at the size that the reconstruction's pixels are of.
    reconstruction : metric, with ``K`` and the coefficients of the lens in ``radial`` (None: no distortion).
    max_side : px; a photograph whose longer side is greater is made smaller (cubic, no aliasing).

    Returns
    -------
    The frame is the photograph's; pixels the lens does not reach are not ``seen`` and black. ``P`` is in this
    frame's pixels and scaled such that the third coordinate is the depth.

    Raises
    ------
    ValueError
        Where the reconstruction is not metric, or the photograph is of another size.
    StageFailure
        Where the view has no camera.
    """
    K = reconstruction.K
    if reconstruction.stratum != "metric" or K is None:
        raise ValueError("undistorted views need a metric reconstruction with K")
    if tuple(reconstruction.sizes[view]) != image.size:
        raise ValueError(f"view {view} is {tuple(reconstruction.sizes[view])} px; got {image.size}")
    if max_side < 2:
        raise ValueError(f"max_side is at least 2 px; got {max_side}")
    if not reconstruction.registered[view]:
        raise StageFailure(f"view {view} has no camera", reconstruction.reasons[view], "")
    shrink = min(1.0, max_side / max(image.size))
    size = (max(round(image.size[0] * shrink), 1), max(round(image.size[1] * shrink), 1))
    S = _resizing(image.size, size)
    radial = np.zeros(3) if reconstruction.radial is None else reconstruction.radial[view]
    P = S @ _depth_scaled(reconstruction.P[view])
    if not radial.any() and size == image.size:
        return PinholeView(view, P, image.rgb, np.ones(image.rgb.shape[:2], dtype=bool))
    pixels = warp_image(_Lens(K[view], radial, S, size), image.rgb.astype(np.float32), 0)
    seen = np.asarray(np.isfinite(pixels).all(axis=2))
    rgb = np.clip(np.rint(np.where(seen[:, :, None], pixels, 0.0)), 0.0, 255.0).astype(np.uint8)
    return PinholeView(view, P, rgb, seen)


@dataclass(frozen=True)
class _Lens:
    """Where the pixels of a frame of ``size`` without distortion are in the photograph."""

    K: F64
    radial: F64
    S: F64
    size: tuple[int, int]

    def lookup(self, side: int, rows: range) -> F64:  # noqa: ARG002 - there is but one photograph
        """(len(rows), width, 2) px in the photograph."""
        x, y = np.meshgrid(np.arange(float(self.size[0])), np.arange(float(rows.start), float(rows.stop)))
        rays = homogenize(np.stack([x, y], axis=-1).reshape(-1, 2)) @ np.linalg.inv(self.S @ self.K).T
        xy = distort(dehomogenize(rays), self.radial) @ self.K[:2, :2].T + self.K[:2, 2]
        return np.asarray(xy.reshape(*x.shape, 2))


def _resizing(size: tuple[int, int], wanted: tuple[int, int]) -> F64:
    """(3, 3): (x + 0.5) s - 0.5 along either side."""
    sx, sy = wanted[0] / size[0], wanted[1] / size[1]
    return np.array([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5], [0.0, 0.0, 1.0]])


def _depth_scaled(P: F64) -> F64:
    return np.asarray(P * np.sign(np.linalg.det(P[:, :3])) / np.linalg.norm(P[2, :3]))
