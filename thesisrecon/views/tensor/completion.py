"""Where the pixels are that only one of two photographs shows.

What the other one does not see is hidden behind what it sees: of the surfaces around such a pixel the nearest
one is taken that would not stand in front of anything there.
"""

from __future__ import annotations

import numpy as np

from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import dehomogenize
from thesisrecon.geometry.zbuffer import in_strips
from thesisrecon.types import B8, F32, F64
from thesisrecon.views.tensor.kernels import guess_rows, transfer_rows
from thesisrecon.views.tensor.pair import CalibratedPair
from thesisrecon.views.tensor.seed import VirtualTensor, seed_of_first
from thesisrecon.views.warping import DIRECTIONS
from thesisrecon.views.warping.kernels import distances_to_known

Both32 = tuple[F32, F32]

SURFACE_PX = 1.0
"""Neighbours whose disparities between the photographs differ by more are not of one surface."""
SPARSE = 16
"""Every sixteenth pixel of every sixteenth row suffices for a median."""


def complete_places(pair: CalibratedPair, places: Both32, *, agree_px: float) -> tuple[Both32, tuple[B8, B8]]:
    """Places of all pixels in the other photograph, and which of them are known, not guessed.

    Parameters
    ----------
    pair : the cameras.
    places : two (H, W, 2) px of the other photograph, NaN = unknown.
    agree_px : a place is known where the way there and back ends no farther off; inf believes all there are.

    Returns
    -------
    Two (H, W, 2) float32 and two (H, W).

    Raises
    ------
    StageFailure : where nothing of a photograph is known in the other.
    """
    known = _agreeing(places[0], places[1], agree_px), _agreeing(places[1], places[0], agree_px)
    for side in (0, 1):
        if not known[side].any():
            raise StageFailure(
                "the photographs have no dense correspondence",
                f"no pixel of photograph {side + 1} is known in the other one",
                "choose photographs that overlap more",
            )
    pairs = pair, pair.swapped()
    sure = [np.where(known[side][..., None], places[side], np.nan) for side in (0, 1)]
    own = [seed_of_first(one) for one in pairs]
    nearness = [transfer_grid(own[side], sure[side])[1] for side in (0, 1)]
    steps = [surface_step(own[side], sure[side]) for side in (0, 1)]
    complete = [
        _completed(pairs[side], sure[side], (nearness[side], nearness[1 - side]), steps[1 - side])
        for side in (0, 1)
    ]
    return (complete[0], complete[1]), known


def transfer_grid(virtual: VirtualTensor, places: F32, *, threads: int = 1) -> tuple[F64, F32]:
    """:meth:`VirtualTensor.transfer` of all pixels with matches ``places`` (H, W, 2); (H, W, 2), (H, W)."""
    xy, nearness = np.empty(places.shape), np.empty(places.shape[:2], dtype=np.float32)

    def work(rows: tuple[int, int]) -> None:
        part = slice(*rows)
        transfer_rows(virtual.T, virtual.P2, places[part], rows[0], xy[part], nearness[part])

    in_strips(work, len(places), threads)
    return xy, nearness


def surface_step(virtual: VirtualTensor, places: F32) -> float:
    """``SURFACE_PX`` in units of a camera's nearness, for the middle one of the pixels of view 1."""
    known = np.isfinite(places[::SPARSE, ::SPARSE]).all(axis=2)
    y, x = (SPARSE * index for index in np.nonzero(known))
    pixels = np.stack([x, y], axis=1).astype(np.float64)
    found = virtual.disparity_per_nearness(pixels, places[y, x].astype(np.float64))
    found = found[np.isfinite(found)]
    return SURFACE_PX / float(np.median(found)) if len(found) else np.inf


def _agreeing(places: F32, others: F32, agree_px: float) -> B8:
    """(H, W) where the partner's partner is the pixel."""
    if np.isinf(agree_px):
        return np.asarray(np.isfinite(places).all(axis=2))
    height, width = others.shape[:2]
    at = np.rint(places)
    inside = np.all((at >= 0) & (at <= np.array([width - 1, height - 1])), axis=2)
    x, y = np.where(inside[..., None], at, 0).astype(np.int64).transpose(2, 0, 1)
    own = np.indices(places.shape[:2])[::-1].transpose(1, 2, 0)
    # A comparison with NaN is false.
    return np.asarray(inside & (np.linalg.norm(others[y, x] - own, axis=2) <= agree_px))


def _completed(pair: CalibratedPair, places: F32, nearness: tuple[F32, F32], step: float) -> F32:
    """``places`` (H, W, 2) with guesses where NaN; ``nearness`` of this photograph and the other, ``step`` of
    the other one's surfaces."""
    own = nearness[0]
    distance = np.empty((len(DIRECTIONS), *own.shape), dtype=np.int16)
    distances_to_known(own, DIRECTIONS, distance)
    guessed = np.empty_like(own)
    guess_rows(nearness, np.ascontiguousarray(pair.P2), DIRECTIONS, distance, step, guessed)
    y, x = np.nonzero(np.isnan(own))
    X = np.stack([x, y, np.ones_like(x), guessed[y, x]], axis=1).astype(np.float64)
    complete = places.copy()
    complete[y, x] = dehomogenize(X @ pair.P2.T)
    return complete
