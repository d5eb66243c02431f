"""Disparities, depths, views without distortion, surfaces and renderings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thesisrecon.types.arrays import B8, F32, F64, I64


@dataclass(frozen=True)
class DisparityMap:
    """Which pixel of the right image of a rectified pair each pixel of the left one is.

    ``disparity`` (H, W) float32: x_right = x_left - d; NaN where it is unknown or the pixel is hidden in the
    right image. ``confidence`` (H, W) float32 in [0, 1], 0 where unknown. ``sigma_px`` is the deviation of a
    confident disparity.
    """

    disparity: F32
    confidence: F32
    sigma_px: float

    def filled(self) -> F32:
        """(H, W): unknown pixels take the smaller disparity of the nearest known ones left and right in their
        row, for what is hidden is behind; a row without any stays NaN."""
        known = np.isfinite(self.disparity)
        columns = np.arange(self.disparity.shape[1])
        left = np.maximum.accumulate(np.where(known, columns, -1), axis=1)
        right = np.minimum.accumulate(np.where(known, columns, len(columns))[:, ::-1], axis=1)[:, ::-1]
        padded = np.pad(self.disparity, ((0, 0), (1, 1)), constant_values=np.nan)
        from_left = np.take_along_axis(padded, left + 1, axis=1)
        from_right = np.take_along_axis(padded, right + 1, axis=1)
        filled: F32 = np.fmin(from_left, from_right)
        return filled


@dataclass(frozen=True)
class DepthMap:
    """Depth of the pixels of one view, distortion removed.

    ``P`` = K [R t] (3, 4) projects into this map's own pixels, which may be fewer than the photograph's.
    ``depth`` (H, W) float32 is z in the camera frame, NaN where unknown; ``std`` (H, W) float32 its
    deviation; ``views`` (H, W) uint8 how many other views confirm it.
    """

    view: int
    P: F64
    depth: F32
    std: F32
    views: NDArray[np.uint8]


@dataclass(frozen=True)
class PinholeView:
    """A photograph with its distortion removed: ``P`` = K [R t] (3, 4), ``rgb`` (H, W, 3) uint8, ``seen``
    (H, W) the pixels that the photograph has."""

    view: int
    P: F64
    rgb: NDArray[np.uint8]
    seen: B8


@dataclass(frozen=True)
class TexturedMesh:
    """A triangulated surface, by itself or with colours.

    ``vertices`` (N, 3); ``faces`` (M, 3) int64, anticlockwise seen from outside. ``colors`` (N, 3) uint8 of
    the vertices, or a texture: ``texture`` (H, W, 3) uint8 with ``uv`` (M, 3, 2) of every corner of every
    face, in texels, x right, y down, (0, 0) the centre of the top-left texel. Either may be None.
    ``untextured`` (M,) marks faces that no view sees.
    """

    vertices: F64
    faces: I64
    colors: NDArray[np.uint8] | None = None
    uv: F64 | None = None
    texture: NDArray[np.uint8] | None = None
    untextured: B8 | None = None


@dataclass(frozen=True)
class RenderedView:
    """What a camera sees of a mesh: ``color`` (H, W, 3) uint8, ``depth`` (H, W) float32 (z in the camera
    frame, NaN where nothing is), ``valid`` (H, W) where there is a surface."""

    color: NDArray[np.uint8]
    depth: F32
    valid: B8


@dataclass(frozen=True)
class HeldOut:
    """A photograph that gave the model no texture, beside the model as its camera sees it.

    ``view`` its number; ``real, rendered`` (H, W, 3) uint8, the photograph without its distortion and the
    picture of the model; ``compared`` (H, W) the pixels that both have and the numbers are of; ``psnr_db``
    peak signal-to-noise ratio in dB; ``ssim`` structural similarity, 1 = the same.

    Raises
    ------
    ValueError
        where the pictures and the mask are not of one size.
    """

    view: int
    real: NDArray[np.uint8]
    rendered: NDArray[np.uint8]
    compared: B8
    psnr_db: float
    ssim: float

    def __post_init__(self) -> None:
        shapes = (self.real.shape, self.rendered.shape, (*self.compared.shape, 3))
        if len(set(shapes)) > 1:
            raise ValueError(f"a held-out comparison needs pictures and a mask of one size; got {shapes}")

    @property
    def share(self) -> float:
        """Part of the pixels that were compared."""
        return float(self.compared.mean()) if self.compared.size else 0.0
