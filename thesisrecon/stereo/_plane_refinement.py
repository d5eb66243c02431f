"""Refinement of depth maps with slanted windows (PatchMatch multi-view stereo)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thesisrecon.arrays import B8, F32, U8
from thesisrecon.records import PinholeView
from thesisrecon.stereo._depth_fusion import InverseDepth, pixel_transfer
from thesisrecon.stereo._depth_kernels import surface_continuation
from thesisrecon.stereo._plane_kernels import (
    UNKNOWN,
    PatchViews,
    PatchWindow,
    begin_planes,
    fit_planes,
    pack_squares,
    rate_planes,
    sweep_planes,
)

ALIKE = 0.03
"""Largest relative difference of inverse depths on one surface."""
SWEEPS = 4
"""Passes over the image, alternating in direction."""
FIRST_STEP_PX = 0.5
"""Perturbation of the first pass; it is halved in every pass."""
RADIUS, SPACING = 4, 2
"""Radius of the window, and distance of its samples, in pixels."""
INTENSITY_SCALE = 15.0
"""Grey level difference to the centre at which the weight of a sample is 1/e."""
MAX_COST, MAX_CONTINUATION_COST = 0.4, 0.6
"""Largest accepted cost, and that of pixels that are accepted if they continue a surface."""
CONVERGED_COST = 0.1
"""Planes up to this cost are not changed."""
GATE = 3.0
"""Standard deviations within which plane and fused correspondences agree."""
SIGMA_PX = 0.4
"""Standard deviation of a position in the neighbours."""


def refine_depths(reference: PinholeView, others: Sequence[PinholeView], found: InverseDepth) -> InverseDepth:
    """Refine and extend the inverse depths of a view by propagation and refinement of a plane per pixel.

    Stereo matching of rectified images assumes fronto-parallel windows and loses slanted surfaces. A plane in
    space is linear in inverse depth, so each pixel has an inverse depth and its gradient. Its window is
    transferred to the neighbours by the plane's homography and compared by weighted normalised correlation
    (Bleyer, Rhemann and Rother, "PatchMatch stereo", BMVC 2011; Schönberger et al., ECCV 2016). The search is
    deterministic: it starts from the fused correspondences. The cost is 1 - correlation.

    A pixel is kept if two neighbours have at most ``MAX_COST``, one has at most half of it, or two of the
    fused correspondences agree.

    Parameters
    ----------
    reference : PinholeView
        The view.
    others : sequence of PinholeView
        Its neighbours.
    found : InverseDepth
        Fused correspondences.

    Returns
    -------
    InverseDepth
        Refined inverse depths.
    """
    if not others or not np.isfinite(found.value).any():
        return found
    search = _PlaneSearch.of(reference, others)
    planes = _planes(found.value)
    search.sweep(planes, search.begin(planes), SWEEPS)
    rho = planes[..., 0]
    least, support, slope = search.rate(planes, MAX_COST)
    seen = _is_supported(least, support)
    joining, std = _continuing_surfaces(search, planes, seen, least)
    with np.errstate(divide="ignore", invalid="ignore"):
        std = np.where(joining, std, SIGMA_PX / slope).astype(np.float32)
        near = np.abs(rho - found.value) <= GATE * np.hypot(found.std, std)
    seen |= joining
    matched = ~seen & (found.views >= 2)
    # Without texture the fused correspondences are kept.
    with np.errstate(invalid="ignore"):
        both = seen & near & (found.views >= 2)
    value = np.where(seen, rho, np.where(matched, found.value, np.nan)).astype(np.float32)
    std = np.where(seen, std, np.where(matched, found.std, np.nan)).astype(np.float32)
    views = np.where(both, np.maximum(support, found.views), np.where(seen, support, found.views))
    views = np.where(joining, np.maximum(views, 1), views)
    return InverseDepth(value, std, np.where(np.isfinite(value), views, 0).astype(np.uint8), found.conflicts)


def search_planes(
    reference: PinholeView, others: Sequence[PinholeView], rho: F32, *, wanted: B8, sweeps: int
) -> tuple[F32, F32, U8]:
    """Search planes of selected pixels from given inverse depths.

    Parameters
    ----------
    reference : PinholeView
        The view.
    others : sequence of PinholeView
        Its neighbours.
    rho : ndarray (H, W) float32
        Initial inverse depths.
    wanted : ndarray (H, W) bool
        Pixels to search; the planes of other pixels stay.
    sweeps : int
        Passes over the image.

    Returns
    -------
    tuple of ndarray (H, W)
        Inverse depth, its standard deviation, and number of supporting views; NaN where no plane is
        accepted.
    """
    search = _PlaneSearch.of(reference, others)
    planes = _planes(rho)
    begun = np.where(wanted[..., None], planes, np.float32(np.nan))
    # Cost 0 excludes the other pixels from the search.
    cost = np.where(wanted, search.begin(begun), np.float32(0.0))
    search.sweep(planes, cost, sweeps)
    planes[~wanted] = np.nan
    least, support, slope = search.rate(planes, MAX_COST)
    seen = _is_supported(least, support)
    with np.errstate(divide="ignore"):
        std = (SIGMA_PX / slope).astype(np.float32)
    unknown = np.float32(np.nan)
    return np.where(seen, planes[..., 0], unknown), np.where(seen, std, unknown), support * seen


def _planes(rho: F32) -> F32:
    """(H, W, 3) inverse depths and their gradients."""
    gradients = np.empty((2, *rho.shape), dtype=np.float32)
    fit_planes(rho, RADIUS, ALIKE, gradients[0], gradients[1])
    return np.stack([rho, gradients[0], gradients[1]], axis=-1)


def _is_supported(least: F32, support: U8) -> B8:
    """(H, W) planes that two neighbours support, or one clearly."""
    return np.asarray((support >= 2) | ((support == 1) & (least <= 0.5 * MAX_COST)))


def _continuing_surfaces(search: _PlaneSearch, planes: F32, seen: B8, least: F32) -> tuple[B8, F32]:
    """(H, W) doubtful planes that continue the surface of accepted ones; standard deviations."""
    doubtful = ~seen & (least <= MAX_CONTINUATION_COST)
    slope = search.rate(np.where(doubtful[..., None], planes, np.float32(np.nan)), MAX_CONTINUATION_COST)[2]
    with np.errstate(divide="ignore"):
        std = (SIGMA_PX / slope).astype(np.float32)
    joins = np.zeros(seen.shape, dtype=np.uint8)
    rho = np.where(seen | doubtful, planes[..., 0], np.float32(np.nan))
    surface_continuation(rho, std, seen.astype(np.uint8), RADIUS + 1, ALIKE, GATE, joins)
    return joins > 0, std


@dataclass(frozen=True)
class _PlaneSearch:
    """Kernel arguments of a view and its neighbours."""

    views: PatchViews
    window: PatchWindow

    @classmethod
    def of(cls, reference: PinholeView, others: Sequence[PinholeView]) -> _PlaneSearch:
        gray = [_gray(view) for view in (reference, *others)]
        layout = np.array([(0, *one.shape[::-1]) for one in gray[1:]], dtype=np.int64)
        layout[1:, 0] = np.cumsum([one.size for one in gray[1:]])[:-1]
        squares = [np.empty(one.shape, dtype=np.uint32) for one in gray[1:]]
        for one, words in zip(gray[1:], squares, strict=True):
            pack_squares(one, words)
        H, e = map(np.stack, zip(*(pixel_transfer(reference.P, other.P) for other in others), strict=True))
        table = np.exp(-np.arange(256.0) / INTENSITY_SCALE).astype(np.float32)
        steps = SPACING * np.arange(-(RADIUS // SPACING), RADIUS // SPACING + 1)
        offsets = np.stack(np.meshgrid(steps, steps)).reshape(2, -1).astype(np.float32)
        packed = np.concatenate([words.ravel() for words in squares])
        return cls(PatchViews(gray[0], packed, layout, H, e), PatchWindow(offsets, table))

    def begin(self, planes: F32) -> F32:
        """Cost (H, W) of planes (H, W, 3)."""
        cost = np.empty(planes.shape[:2], dtype=np.float32)
        begin_planes(self.views, self.window, planes, cost)
        return cost

    def sweep(self, planes: F32, cost: F32, sweeps: int) -> None:
        """Propagate and perturb planes (H, W, 3) of cost (H, W) in place."""
        for k in range(sweeps):
            step = FIRST_STEP_PX * 0.5**k
            sweep_planes(self.views, self.window, step, CONVERGED_COST, k % 2 == 1, planes, cost)

    def rate(self, planes: F32, max_cost: float) -> tuple[F32, U8, F32]:
        """Smallest cost, support and slope (H, W) of planes (H, W, 3)."""
        shape = planes.shape[:2]
        least, slope = np.full(shape, UNKNOWN, dtype=np.float32), np.zeros(shape, dtype=np.float32)
        support = np.zeros(shape, dtype=np.uint8)
        rate_planes(self.views, self.window, planes, max_cost, least, support, slope)
        return least, support, slope


def _gray(view: PinholeView) -> F32:
    """(H, W) grey levels, NaN outside the original image."""
    gray = view.rgb.astype(np.float32) @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
    return np.where(view.seen, gray, np.float32(np.nan)).astype(np.float32)
