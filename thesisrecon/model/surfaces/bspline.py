"""Section 2.6: a parametric surface fitted to a depth map, robustly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from thesisrecon.model.surfaces.basis import basis
from thesisrecon.model.surfaces.pieces import Pieces, domain_of, pieces_of
from thesisrecon.model.surfaces.surface import SurfaceSample
from thesisrecon.model.surfaces.system import NormalEquations
from thesisrecon.robust.noise import MAD_FACTOR
from thesisrecon.types import B8, F64, DepthMap

HUBER, TUKEY = 1.345, 4.685
"""Where the weights begin to fall and where they end, in deviations: both 95 % efficient (Huber 1981)."""
HUBER_ROUNDS, SOFT_ROUNDS = 2, 5
"""Rounds with convex weights, and rounds with the softest spline, which tell what is an outlier."""
FAINTEST = 1e-3
"""Root of the least weight, without which a piece of wrong depths alone would be nowhere."""
SOFTEST = 1e-3
"""Stiffness in weights of a pixel of the usual deviation."""
FIRST_STEP, SHORTER = 1e3, 0.65
"""Factor by which a stiffness changes first, and the power by which the next one is smaller."""


@dataclass(frozen=True)
class BSplineSurface:
    """Cubic B-splines in inverse depth over the image, in which planes of space stay planes.

    Minimised is sum w(r) r^2 + sum s_k E_k: r are the residuals in deviations of the depth map, w Tukey's
    weights in iteratively reweighted least squares, E_k is the bending energy of the spline over cell k
    between its knots. The stiffness s_k is chosen by the discrepancy principle (Morozov 1966), cell by cell:
    as large as leaves the residuals of the ``window`` x ``window`` cells about it no larger than noise. How
    large that is the softest spline tells, for the deviations of a depth map are those of its errors, most of
    which neighbours share. Where a surface breaks both sides have coefficients of their own, and nothing is
    said of pixels without depth.

    ``knot_px``: between knots. ``rounds`` of reweighting. ``grazing_deg``: what is seen more flatly breaks.
    Connected depths fewer than the pixels between four knots are taken for errors: within ``knot_px`` of a
    surface that becomes their depth, elsewhere they have none.
    """

    knot_px: int = 4
    rounds: int = 13
    window: int = 5
    grazing_deg: float = 10.0

    def __post_init__(self) -> None:
        if self.knot_px < 2 or self.rounds < 1 or self.window < 1:
            raise ValueError(
                f"knot_px >= 2, rounds >= 1 and window >= 1 are needed; got {self.knot_px}, {self.rounds} "
                f"and {self.window}"
            )
        if not 0.0 < self.grazing_deg < 90.0:
            raise ValueError(f"0 < grazing_deg < 90 is needed; got {self.grazing_deg}")

    def fit(self, depth_map: DepthMap) -> BSplineFit:
        """The surface; it stands only before pixels of the map."""
        cell = self.knot_px
        domain = domain_of(depth_map, grazing_deg=self.grazing_deg, least=cell * cell, reach=float(cell))
        pieces = pieces_of(domain, cell)
        if not pieces.count:
            return BSplineFit(depth_map, pieces, cell, np.zeros(0))
        value, deviation = _inverse(depth_map, domain.speaks)
        coefficients = self._coefficients(NormalEquations.of(pieces, cell), value, deviation, domain.speaks)
        return BSplineFit(depth_map, pieces, cell, coefficients)

    def _coefficients(self, equations: NormalEquations, value: F64, deviation: F64, speaks: B8) -> F64:
        unit = float(np.median(deviation[speaks]))
        value, deviation = value / unit, deviation / unit
        cells = equations.pieces.cell
        weight, stiffness = np.where(speaks, 1.0, 0.0), np.full(len(cells), SOFTEST)
        noise = np.zeros(0)
        for k in range(self.rounds):
            c = equations.solve(*equations.sums(value, weight / deviation**2), stiffness)
            residual = np.where(speaks, equations.values(c) - value, 0.0) / deviation
            weight = np.where(speaks, _weights(residual, speaks, redescending=k >= HUBER_ROUNDS), 0.0)
            found = self._mean_square(equations.pieces.shape, residual, weight)
            if k < SOFT_ROUNDS:
                noise = self._allowed() * found
            else:
                step = FIRST_STEP ** (SHORTER ** (k - SOFT_ROUNDS))
                stiffness *= np.where(found <= noise, step, 1.0 / step)[cells]
        return c * unit

    def _allowed(self) -> float:
        """Up to which factor of the mean square of the softest spline's residuals others are chance.

        The n residuals of a window have n - p degrees of freedom, and what its p coefficients take up is
        known to sqrt(2 p) of them.
        """
        n, p = (self.knot_px * self.window) ** 2, self.window**2
        return float(n / (n - p) * (1.0 + np.sqrt(2.0 * p) / n))

    def _mean_square(self, cells: tuple[int, int], residual: F64, weight: F64) -> F64:
        """(rows x columns of cells,) weighted means of squared residuals in the window about each cell."""
        y, x = np.indices(residual.shape) // self.knot_px
        number = (y * cells[1] + x).ravel()
        sums = [
            scipy.ndimage.uniform_filter(
                np.bincount(number, part.ravel(), cells[0] * cells[1]).reshape(cells),
                self.window,
                mode="constant",
            )
            for part in (weight * residual**2, weight)
        ]
        return np.asarray(sums[0] / np.maximum(sums[1], 1e-12)).ravel()


def _weights(residual: F64, speaks: B8, *, redescending: bool) -> F64:
    """Weights of residuals in deviations, Huber's or Tukey's; wider where all are larger than told."""
    scale = max(1.0, MAD_FACTOR * float(np.median(np.abs(residual[speaks]))))
    r = np.abs(residual) / scale
    if redescending:
        return np.asarray(np.maximum(1.0 - (r / TUKEY) ** 2, FAINTEST) ** 2)
    return np.asarray(HUBER / np.maximum(r, HUBER))


def _inverse(depth_map: DepthMap, speaks: B8) -> tuple[F64, F64]:
    """Inverse depths and their deviations (H, W), 0 and 1 where they do not speak."""
    depth = np.where(speaks, depth_map.depth, 1.0).astype(np.float64)
    std = np.where(speaks, depth_map.std, 1.0).astype(np.float64)
    return np.where(speaks, 1.0 / depth, 0.0), std / depth**2


@dataclass(frozen=True)
class BSplineFit:
    """Coefficients of a spline in ``pieces``, ``cell`` px between knots."""

    given: DepthMap
    pieces: Pieces
    cell: int
    coefficients: F64

    @property
    def passes_through(self) -> bool:
        """False: it passes near them."""
        return False

    def evaluate(self, xy: F64) -> SurfaceSample:
        """The spline of the piece that the nearest pixel is of; nothing where that pixel is of none."""
        height, width = self.given.depth.shape
        pixel = np.rint(xy)
        inside = np.all((pixel >= 0) & (pixel <= np.array([width, height]) - 1), axis=1)
        pixel = np.where(inside[:, None], pixel, 0).astype(np.int64)
        piece = np.where(inside, self.pieces.piece[pixel[:, 1], pixel[:, 0]], -1)
        there = np.flatnonzero(piece >= 0)
        value, gradient = np.full(len(xy), np.nan), np.full((len(xy), 2), np.nan)
        c = self.coefficients[self.pieces.coefficient[piece[there]]].reshape(-1, 4, 4)
        u, v = ((xy[there] + 0.5) / self.cell - pixel[there] // self.cell).T
        value[there] = _tensor(c, basis(v), basis(u))
        gradient[there, 0] = _tensor(c, basis(v), basis(u, 1)) / self.cell
        gradient[there, 1] = _tensor(c, basis(v, 1), basis(u)) / self.cell
        return SurfaceSample(value, gradient)


def _tensor(c: F64, along_y: F64, along_x: F64) -> F64:
    return np.asarray(np.einsum("nij,ni,nj->n", c, along_y, along_x))
