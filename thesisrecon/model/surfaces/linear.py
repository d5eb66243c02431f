"""Section 2.6: the surface that is linear between the pixels of a depth map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thesisrecon.model.depth_surface import Squares, split_squares, steepest_slope
from thesisrecon.model.surfaces.surface import SurfaceSample
from thesisrecon.types import F64, DepthMap


@dataclass(frozen=True)
class LinearSurface:
    """Every depth as it is, and triangles between: :func:`~thesisrecon.model.surface_from_depth`, in between.

    ``grazing_deg``: what is seen more flatly breaks.
    """

    grazing_deg: float = 10.0

    def __post_init__(self) -> None:
        if not 0.0 < self.grazing_deg < 90.0:
            raise ValueError(f"0 < grazing_deg < 90 is needed; got {self.grazing_deg}")

    def fit(self, depth_map: DepthMap) -> LinearFit:
        """The surface through all pixels of the map."""
        # A row and a column of nothing give every pixel a square of its own.
        depth, std = (
            np.pad(part.astype(np.float64), ((0, 1), (0, 1)), constant_values=np.nan)
            for part in (depth_map.depth, depth_map.std)
        )
        slope = steepest_slope(depth_map.P, self.grazing_deg)
        return LinearFit(depth_map, 1.0 / depth, split_squares(depth, std, slope))


@dataclass(frozen=True)
class LinearFit:
    """Inverse depths (H + 1, W + 1), the last row and column nothing, and the triangles between them: planes
    of space are linear in them."""

    given: DepthMap
    inverse_depth: F64
    squares: Squares

    @property
    def passes_through(self) -> bool:
        """True."""
        return True

    def evaluate(self, xy: F64) -> SurfaceSample:
        """Linear within each whole triangle; at pixels their own inverse depth, whole triangles or not."""
        height, width = self.given.depth.shape
        inside = np.all((xy >= -1e-9) & (xy <= np.array([width, height]) - 1.0 + 1e-9), axis=1)
        at = np.where(inside[:, None], xy, 0.0)
        x, y = np.floor(at + 1e-9).astype(np.int64).T
        u, v = (at - np.stack([x, y], axis=1)).T
        a, b, c, d = (self.inverse_depth[y + j, x + i] for j, i in ((0, 0), (0, 1), (1, 0), (1, 1)))
        rising = self.squares.rising[y, x]
        second = np.where(rising, u + v > 1.0, u > v)
        along_x = np.where(rising == second, d - c, b - a)
        along_y = np.where(second, d - b, c - a)
        value = np.where(
            rising & second, d - (1.0 - u) * along_x - (1.0 - v) * along_y, a + u * along_x + v * along_y
        )
        whole = inside & self.squares.whole[y, x, second.astype(np.int64)]
        pixel = inside & (np.maximum(np.abs(u), np.abs(v)) < 1e-6)
        value = np.where(whole, value, np.where(pixel, a, np.nan))
        return SurfaceSample(value, np.where(whole[:, None], np.stack([along_x, along_y], axis=1), np.nan))
