"""Refinement of depth maps with slanted windows (PatchMatch multi-view stereo)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from thesisrecon.arrays import B8, F32, U8
from thesisrecon.records import PinholeView
from thesisrecon.stereo._depth_fusion import InverseDepth, pixel_transfer, surface_continuation
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
RADIUS, SPACING = 4, 2
"""Radius of the window, and distance of its samples, in pixels."""
MAX_COST, MAX_CONTINUATION_COST = 0.4, 0.6
"""Largest accepted cost, and that of pixels that are accepted if they continue a surface."""
GATE = 3.0
"""Standard deviations within which plane and fused correspondences agree."""

_Search = tuple[PatchViews, PatchWindow]


def refine_depths(reference: PinholeView, others: Sequence[PinholeView], found: InverseDepth) -> InverseDepth:
    """Refine and extend the inverse depths of a view by propagating and refining a plane per pixel (2.6).

    Stereo matching of rectified images assumes fronto-parallel windows and loses slanted surfaces. A plane in
    space is linear in inverse depth, so each pixel has an inverse depth and its gradient. Its window is
    transferred to the neighbours by the plane's homography and compared by weighted normalised correlation
    (Bleyer, Rhemann and Rother, "PatchMatch stereo", BMVC 2011; Schönberger et al., ECCV 2016). The search is
    deterministic: it starts from the fused correspondences. The cost is 1 - correlation.

    A pixel is kept if two neighbours have at most ``MAX_COST``, one has at most half of it, or two of the
    fused correspondences ``found`` agree.
    """
    sweeps = 4  # Passes over the image, alternating in direction
    if not others or not np.isfinite(found.value).any():
        return found
    search = _search_arguments(reference, others)
    planes = _planes(found.value)
    _sweep(search, planes, _begin_cost(search, planes), sweeps)
    rho = planes[..., 0]
    least, support, std = _rate(search, planes, MAX_COST)
    seen = _is_supported(least, support)
    joining, joining_std = _continuing_surfaces(search, planes, seen, least)
    std = np.where(joining, joining_std, std)
    seen |= joining
    # Without texture the fused correspondences are kept.
    matched = ~seen & (found.views >= 2)
    near = np.abs(rho - found.value) <= GATE * np.hypot(found.std, std)
    both = seen & near & (found.views >= 2)
    value = np.where(seen, rho, np.where(matched, found.value, np.nan)).astype(np.float32)
    std = np.where(seen, std, np.where(matched, found.std, np.nan)).astype(np.float32)
    views = np.where(both, np.maximum(support, found.views), np.where(seen, support, found.views))
    views = np.where(joining, np.maximum(views, 1), views)
    return InverseDepth(value, std, np.where(np.isfinite(value), views, 0).astype(np.uint8), found.conflicts)


def search_planes(
    reference: PinholeView, others: Sequence[PinholeView], rho: F32, *, wanted: B8, sweeps: int
) -> tuple[F32, F32, U8]:
    """Search the planes of ``wanted`` pixels; return inverse depths, their std and support, (H, W) each."""
    search, unknown = _search_arguments(reference, others), np.float32(np.nan)
    # Planes start and arrive from pixels at most one away.
    near = scipy.ndimage.binary_dilation(wanted, np.ones((3, 3)), RADIUS + 1)
    planes = _planes(np.where(near, rho, unknown))
    # Cost 0 excludes the other pixels from the search.
    begun = _begin_cost(search, np.where(wanted[..., None], planes, unknown))
    _sweep(search, planes, np.where(wanted, begun, np.float32(0.0)), sweeps)
    planes[~wanted] = np.nan
    least, support, std = _rate(search, planes, MAX_COST)
    seen = _is_supported(least, support)
    return np.where(seen, planes[..., 0], unknown), np.where(seen, std, unknown), support * seen


def _planes(rho: F32) -> F32:
    """(H, W, 3) inverse depths and their gradients."""
    gradients = np.empty((2, *rho.shape), dtype=np.float32)
    fit_planes(rho, RADIUS, ALIKE, gradients[0], gradients[1])
    return np.stack([rho, gradients[0], gradients[1]], axis=-1)


def _is_supported(least: F32, support: U8) -> B8:
    """(H, W) planes that two neighbours support, or one clearly."""
    return np.asarray((support >= 2) | ((support == 1) & (least <= 0.5 * MAX_COST)))


def _continuing_surfaces(search: _Search, planes: F32, seen: B8, least: F32) -> tuple[B8, F32]:
    """(H, W) planes of higher cost that continue the surface of accepted ones, and standard deviations."""
    doubtful = ~seen & (least <= MAX_CONTINUATION_COST)
    std = _rate(search, np.where(doubtful[..., None], planes, np.float32(np.nan)), MAX_CONTINUATION_COST)[2]
    joins = np.zeros(seen.shape, dtype=np.uint8)
    rho = np.where(seen | doubtful, planes[..., 0], np.float32(np.nan))
    surface_continuation(rho, std, seen.astype(np.uint8), RADIUS + 1, ALIKE, GATE, joins)
    return joins > 0, std


def _search_arguments(reference: PinholeView, others: Sequence[PinholeView]) -> _Search:
    """Kernel arguments of a view and its neighbours."""
    intensity_scale = 15.0  # Grey level difference to the centre at which the weight of a sample is 1/e
    gray = [_gray(view) for view in others]
    squares = [np.empty(one.shape, dtype=np.uint32) for one in gray]
    for one, words in zip(gray, squares, strict=True):
        pack_squares(one, words)
    starts = np.cumsum([0, *(one.size for one in gray[:-1])])
    layout = np.array([(k, *one.shape[::-1]) for k, one in zip(starts, gray, strict=True)], dtype=np.int64)
    H, e = map(np.stack, zip(*(pixel_transfer(reference.P, other.P) for other in others), strict=True))
    packed = np.concatenate([words.ravel() for words in squares])
    steps = SPACING * np.arange(-(RADIUS // SPACING), RADIUS // SPACING + 1)
    offsets = np.stack(np.meshgrid(steps, steps)).reshape(2, -1).astype(np.float32)
    weights = np.exp(-np.arange(256.0) / intensity_scale).astype(np.float32)
    return PatchViews(_gray(reference), packed, layout, H, e), PatchWindow(offsets, weights)


def _gray(view: PinholeView) -> F32:
    """(H, W) grey levels, NaN outside the original image."""
    gray = view.rgb.astype(np.float32) @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
    return np.where(view.seen, gray, np.float32(np.nan)).astype(np.float32)


def _begin_cost(search: _Search, planes: F32) -> F32:
    """Cost (H, W) of planes (H, W, 3)."""
    cost = np.empty(planes.shape[:2], dtype=np.float32)
    begin_planes(*search, planes, cost)
    return cost


def _sweep(search: _Search, planes: F32, cost: F32, sweeps: int) -> None:
    """Propagate and perturb planes (H, W, 3) of cost (H, W) in place."""
    first_step_px = 0.5  # Perturbation of the first pass; it is halved in every pass
    converged_cost = 0.1  # Planes up to this cost are not changed
    active = np.ones(cost.shape, dtype=np.uint8)
    for k in range(sweeps):
        sweep_planes(*search, first_step_px * 0.5**k, converged_cost, k % 2 == 1, planes, cost, active)


def _rate(search: _Search, planes: F32, max_cost: float) -> tuple[F32, U8, F32]:
    """Smallest cost, support and standard deviation (H, W) of planes (H, W, 3)."""
    sigma_px = 0.4  # Standard deviation of a position in the neighbours
    shape = planes.shape[:2]
    least, slope = np.full(shape, UNKNOWN, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    support = np.zeros(shape, dtype=np.uint8)
    rate_planes(*search, planes, max_cost, least, support, slope)
    with np.errstate(divide="ignore"):
        return least, support, (sigma_px / slope).astype(np.float32)
