"""Refinement of depth maps with slanted windows: the plane of every pixel of largest correlation."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from thesisrecon._numba import empty, full, kernel, zeros
from thesisrecon.arrays import B8, F32, F64, I64, U8, U32
from thesisrecon.records import PinholeView
from thesisrecon.stereo._depth_fusion import InverseDepth, fit_planes, pixel_transfer, surface_continuation

UNKNOWN = 4.0  #: cost of a pixel without a plane; the largest cost of a plane is 2
MAX_EXCESS_COST = 0.5  #: upper limit of the second neighbour's excess cost: the pixel may be occluded there
TEXTURE = 4.0  #: variance of the noise in squared grey levels: windows of less variance are uninformative
MIN_WINDOW_COVERAGE = 0.7  #: share of the window's weight that must lie in a neighbour's image
SAME_PLANE = 0.1  #: planes closer than this, in search steps over the window, are not tried again
SIGMA_PX = 0.4  #: standard deviation of a position in the neighbours
MIN_GAIN = 0.006  #: fall of the cost in one pass below which a plane has converged
SUMS = {"reassoc", "contract", "arcp", "nsz"}
"""Floating-point rules for sums over a window that allow vectorisation; NaN is preserved."""
RADIUS, SPACING = 4, 2  #: radius of the window, and distance of its samples, in pixels
MAX_COST, MAX_CONTINUATION_COST = 0.4, 0.6
"""Largest accepted cost, and that of pixels that are accepted if they continue a surface."""
GATE = 3.0  #: standard deviations within which plane and fused correspondences agree


class PatchSearch(NamedTuple):
    """A reference view, its K neighbours, the transfer of pixels to them, and the matching window.

    A pixel (x, y, 1) of inverse depth rho is at ``H[k]`` (x, y, 1) + rho ``e[k]`` in neighbour k.
    """

    gray: F32  #: (H, W) NaN without a pixel
    squares: U32  #: (S,) of all neighbours, see :func:`pack_squares`
    layout: I64  #: (K, 3) offset, width and height of each
    H: F64
    e: F64
    offsets: F32  #: (2, S) of the samples: whole pixels, opposite corners first and last
    weights: F32  #: (256,) by the absolute grey level difference to the centre


def pack_squares(gray: F32) -> U32:
    """Pack 2 x 2 grey levels into a word (H, W): pixel, right, lower, lower right; 0 if one is missing."""
    level = np.nan_to_num(np.clip(gray + np.float32(0.5), 1.0, 255.0)).astype(np.uint32)
    four = level[:-1, :-1], level[:-1, 1:], level[1:, :-1], level[1:, 1:]
    word = four[0] | four[1] << 8 | four[2] << 16 | four[3] << 24
    return np.pad(np.where(np.minimum.reduce(four) > 0, word, np.uint32(0)), ((0, 1), (0, 1)))


@kernel(fastmath=SUMS, forceinline=True)
def _window_samples(search: PatchSearch, u: int, v: int, samples: F32) -> float:
    """Fill ``samples`` (2, S) with normalised weights and weighted, centred grey levels; their variance."""
    gray, offsets, weights = search.gray, search.offsets, search.weights
    height, width = gray.shape
    centre = gray[v, u]
    total, mean, square = 0.0, 0.0, 0.0
    for k in range(offsets.shape[1]):
        a, b = u + int(offsets[0, k]), v + int(offsets[1, k])
        samples[0, k], samples[1, k] = 0.0, 0.0
        if 0 <= a < width and 0 <= b < height:
            level = gray[b, a] - centre
            if abs(level) < 256.0:
                weight = weights[int(abs(level))]
                samples[0, k], samples[1, k] = weight, weight * level
                total, mean, square = total + weight, mean + weight * level, square + weight * level * level
    mean /= total
    for k in range(offsets.shape[1]):
        samples[1, k] = (samples[1, k] - samples[0, k] * mean) / total
        samples[0, k] /= total
    return square / total - mean * mean


@kernel(fastmath=SUMS, forceinline=True)
def _plane_homography(H: F64, e: F64, k: int, at: tuple[int, int], plane: F64, warp: F64) -> bool:
    """Fill ``warp`` (8,) with the plane's map of offsets from ``at`` to view k; False if it is behind."""
    # (warp[0] + dx warp[1] + dy warp[2], warp[3] + dx warp[4] + dy warp[5]) / (1 + dx warp[6] + dy warp[7]).
    u, v = at
    z = H[k, 2, 0] * u + H[k, 2, 1] * v + H[k, 2, 2] + plane[0] * e[k, 2]
    if not z > 0.0:
        return False
    s = 1.0 / z
    for row in range(2):
        warp[3 * row] = s * (H[k, row, 0] * u + H[k, row, 1] * v + H[k, row, 2] + plane[0] * e[k, row])
        warp[3 * row + 1] = s * (H[k, row, 0] + plane[1] * e[k, row])
        warp[3 * row + 2] = s * (H[k, row, 1] + plane[2] * e[k, row])
    warp[6], warp[7] = s * (H[k, 2, 0] + plane[1] * e[k, 2]), s * (H[k, 2, 1] + plane[2] * e[k, 2])
    return True


@kernel(fastmath=SUMS, inline="always", forceinline=True)
def _cost_inside(
    squares: U32, start: int, width: int, warp: F64, offsets: F32, samples: F32, variance: float
) -> float:
    """1 - weighted NCC of a window that lies inside the other view, -1 if a pixel of it is unknown."""
    x0, x1, x2 = np.float32(warp[0]), np.float32(warp[1]), np.float32(warp[2])
    y0, y1, y2 = np.float32(warp[3]), np.float32(warp[4]), np.float32(warp[5])
    z1, z2, one, byte = np.float32(warp[6]), np.float32(warp[7]), np.float32(1.0), np.uint32(255)
    sb, sbb, sab, unknown = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.int32(0)
    for k in range(offsets.shape[1]):
        dx, dy = offsets[0, k], offsets[1, k]
        scale = one / (one + dx * z1 + dy * z2)
        x, y = (x0 + dx * x1 + dy * x2) * scale, (y0 + dx * y1 + dy * y2) * scale
        i, j = np.int32(x), np.int32(y)
        fx, fy = x - np.float32(i), y - np.float32(j)
        # An unsigned index (no wrap-around test) and a single load allow vectorisation.
        square = squares[np.uint32(np.int32(start) + j * np.int32(width) + i)]
        if square == 0:
            unknown += np.int32(1)
        a = np.float32(np.int32(square & byte))
        b = np.float32(np.int32((square >> np.uint32(8)) & byte))
        c = np.float32(np.int32((square >> np.uint32(16)) & byte))
        d = np.float32(np.int32(square >> np.uint32(24)))
        top, bottom = a + fx * (b - a), c + fx * (d - c)
        level = top + fy * (bottom - top)
        sb += samples[0, k] * level
        sbb += samples[0, k] * level * level
        sab += samples[1, k] * level
    if unknown > 0:
        return -1.0
    cost: float = _cost_of(variance, float(sbb - sb * sb), float(sab))
    return cost


@kernel(inline="always")
def _cost_of(variance: float, other_variance: float, covariance: float) -> float:
    spread = (max(variance, 0.0) + TEXTURE) * (max(other_variance, 0.0) + TEXTURE)
    return float(max(1.0 - covariance / np.sqrt(spread), 0.0))


@kernel
def _cost_at_border(
    squares: U32, start: int, size: tuple[int, int], warp: F64, offsets: F32, samples: F32
) -> float:
    """1 - weighted NCC of the part of a window inside the other view, -1 if that is too small."""
    width, height = size
    held, sa, sb, saa, sbb, sab = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(offsets.shape[1]):
        dx, dy, w = offsets[0, k], offsets[1, k], np.float64(samples[0, k])
        z = 1.0 + dx * warp[6] + dy * warp[7]
        if not z > 0.0:
            return -1.0
        x, y = (warp[0] + dx * warp[1] + dy * warp[2]) / z, (warp[3] + dx * warp[4] + dy * warp[5]) / z
        if not (w > 0.0 and 0.0 <= x < width - 1 and 0.0 <= y < height - 1):
            continue
        i, j = int(x), int(y)
        square = np.int64(squares[start + j * width + i])
        if square == 0:
            continue
        fx, fy = x - i, y - j
        top = (square & 255) + fx * (((square >> 8) & 255) - (square & 255))
        bottom = ((square >> 16) & 255) + fx * ((square >> 24) - ((square >> 16) & 255))
        a, b = samples[1, k] / w, top + fy * (bottom - top)
        held += w
        sa, sb = sa + w * a, sb + w * b
        saa, sbb, sab = saa + w * a * a, sbb + w * b * b, sab + w * a * b
    if held < MIN_WINDOW_COVERAGE:
        return -1.0
    sa, sb = sa / held, sb / held
    return _cost_of(saa / held - sa * sa, sbb / held - sb * sb, sab / held - sa * sb)


@kernel(fastmath=SUMS, forceinline=True)
def _view_cost(
    squares: U32, layout: I64, k: int, warp: F64, offsets: F32, samples: F32, variance: float
) -> float:
    """1 - weighted NCC of a window with its image in view ``k``, -1 if it is not visible there."""
    start, width, height = layout[k, 0], layout[k, 1], layout[k, 2]
    # The first and last sample are opposite corners of the window.
    reach = -offsets[0, 0]
    sx, sy = reach * (abs(warp[1]) + abs(warp[2])), reach * (abs(warp[4]) + abs(warp[5]))
    sz = 1.0 - reach * (abs(warp[6]) + abs(warp[7]))
    inside = sz > 0.5 and sx <= warp[0] and sy <= warp[3]
    if inside and warp[0] + sx < sz * (width - 1.01) and warp[3] + sy < sz * (height - 1.01):
        cost: float = _cost_inside(squares, start, width, warp, offsets, samples, variance)
        if cost >= 0.0:
            return cost
    return _cost_at_border(squares, start, (width, height), warp, offsets, samples)


@kernel(inline="always")
def _mean_cost(first: float, second: float) -> float:
    """Mean of two costs, the larger at most ``MAX_EXCESS_COST`` above the smaller."""
    return float(min(first, second) + 0.5 * min(abs(second - first), MAX_EXCESS_COST))


@kernel(fastmath=SUMS, forceinline=True)
def _plane_cost(
    search: PatchSearch, at: tuple[int, int], plane: F64, samples: F32, variance: float, limit: float,
    work: tuple[F64, F64, I64],
) -> float:  # fmt: skip
    """Mean of the two smallest costs, the second at most ``MAX_EXCESS_COST`` above the first (occlusion)."""
    # `work`: work space (8,), (K,), and the order (K,) of the neighbours; the best two become its first two.
    # If these cost `limit` or more, the others are not tried.
    _, squares, layout, H, e, offsets, _ = search
    warp, costs, order = work
    n_views = layout.shape[0]
    if not plane[0] > 0.0:
        return UNKNOWN
    for n in range(n_views):
        if n == 2 and _mean_cost(costs[0], costs[1]) >= limit:
            return UNKNOWN
        k = order[n]
        costs[n] = UNKNOWN
        if _plane_homography(H, e, k, at, plane, warp):
            cost = _view_cost(squares, layout, k, warp, offsets, samples, variance)
            if cost >= 0.0:
                costs[n] = cost
    for n in range(min(n_views, 2)):
        least = n
        for m in range(n + 1, n_views):
            if costs[m] < costs[least]:
                least = m
        costs[n], costs[least] = costs[least], costs[n]
        order[n], order[least] = order[least], order[n]
    return _mean_cost(costs[0], costs[1] if n_views > 1 else UNKNOWN) if costs[0] < UNKNOWN else UNKNOWN


@kernel(fastmath=SUMS, forceinline=True)
def _motion_px(H: F64, e: F64, k: int, at: tuple[int, int], rho: float) -> float:
    """Motion of the projection in view ``k`` in pixels per unit of inverse depth."""
    u, v = at
    z = H[k, 2, 0] * u + H[k, 2, 1] * v + H[k, 2, 2] + rho * e[k, 2]
    x = (H[k, 0, 0] * u + H[k, 0, 1] * v + H[k, 0, 2] + rho * e[k, 0]) / z
    y = (H[k, 1, 0] * u + H[k, 1, 1] * v + H[k, 1, 2] + rho * e[k, 1]) / z
    dx, dy = (e[k, 0] - x * e[k, 2]) / z, (e[k, 1] - y * e[k, 2]) / z
    return float(np.sqrt(dx * dx + dy * dy))


@kernel(fastmath=SUMS, forceinline=True)
def _step(H: F64, e: F64, at: tuple[int, int], rho: float, px: float) -> float:
    """Step of inverse depth that moves the projection by at most ``px`` in any view."""
    most = 0.0
    for k in range(H.shape[0]):
        most = max(most, _motion_px(H, e, k, at, rho))
    return px / most


@kernel(fastmath=SUMS)
def sweep_planes(
    search: PatchSearch, step_px: float, converged_cost: float, backward: bool, planes: F32, cost: F32,
    active: U8,
) -> None:  # fmt: skip
    """Propagate and perturb the planes (H, W, 3) of all pixels in one pass (PatchMatch stereo)."""
    # Each pixel tries the planes of the two neighbours visited before, and its own shifted by `step_px` in
    # the neighbours and tilted by as much at the border of the window. Planes up to `converged_cost` stay, as
    # do those not `active` (H, W) beside no active one; a fall of the `cost` by `MIN_GAIN` keeps a pixel
    # active.
    gray, H, e, offsets = search.gray, search.H, search.e, search.offsets
    height, width = gray.shape
    samples, plane, trial = empty((2, offsets.shape[1]), np.float32), empty(3), empty(3)
    work = empty(8), empty(len(H)), np.arange(len(H))
    reach = -float(offsets[0, 0])
    back = -1 if backward else 1
    for row in range(height):
        v = height - 1 - row if backward else row
        for column in range(width):
            u = width - 1 - column if backward else column
            if not np.isfinite(gray[v, u]) or cost[v, u] <= converged_cost:
                active[v, u] = 0
                continue
            a, b = min(max(u - back, 0), width - 1), min(max(v - back, 0), height - 1)
            if not (active[v, u] or active[v, a] or active[b, u]):
                continue
            variance = _window_samples(search, u, v, samples)
            plane[:] = planes[v, u]
            least = float(cost[v, u])
            move = _step(H, e, (u, v), plane[0], step_px) if least < UNKNOWN else 0.0
            shifted = False
            for k in range(8):
                if k < 2:
                    # The plane of a neighbour, evaluated here.
                    p, q = u - back * (1 - k), v - back * k
                    if not (0 <= p < width and 0 <= q < height) or not np.isfinite(planes[q, p, 0]):
                        continue
                    trial[0] = planes[q, p, 0] + (u - p) * planes[q, p, 1] + (v - q) * planes[q, p, 2]
                    trial[1], trial[2] = planes[q, p, 1], planes[q, p, 2]
                    tilt = abs(trial[1] - plane[1]) + abs(trial[2] - plane[2])
                    if abs(trial[0] - plane[0]) + reach * tilt <= SAME_PLANE * move:
                        continue
                else:
                    if least == UNKNOWN:
                        break
                    if k == 2:
                        move = _step(H, e, (u, v), plane[0], step_px)
                    # Back from an accepted step is the plane before it.
                    if k % 2 == 1 and shifted:
                        continue
                    by = move if k % 2 == 0 else -move
                    trial[:] = plane
                    trial[k // 2 - 1] += by if k < 4 else by / reach
                # The first step ranks the neighbours for the others.
                limit = np.inf if k <= 2 else least
                tried = _plane_cost(search, (u, v), trial, samples, variance, limit, work)
                shifted = tried < least
                if shifted:
                    least = tried
                    plane[:] = trial
            planes[v, u] = plane
            active[v, u] = cost[v, u] - least >= MIN_GAIN
            cost[v, u] = least


@kernel(fastmath=SUMS)
def rate_planes(search: PatchSearch, planes: F32, max_cost: float) -> tuple[F32, U8, F32]:
    """Smallest cost of planes (H, W, 3), number of those up to ``max_cost``, and std."""
    gray, squares, layout, H, e, offsets, _ = search
    height, width = gray.shape
    samples, warp, plane = empty((2, offsets.shape[1]), np.float32), empty(8), empty(3)
    least, std = full((height, width), UNKNOWN, np.float32), full((height, width), np.inf, np.float32)
    support = zeros((height, width), np.uint8)
    for v in range(height):
        for u in range(width):
            if not (np.isfinite(gray[v, u]) and planes[v, u, 0] > 0.0):
                continue
            variance = _window_samples(search, u, v, samples)
            plane[:] = planes[v, u]
            total = 0.0
            for k in range(layout.shape[0]):
                if not _plane_homography(H, e, k, (u, v), plane, warp):
                    continue
                one = _view_cost(squares, layout, k, warp, offsets, samples, variance)
                if 0.0 <= one < least[v, u]:
                    least[v, u] = one
                if 0.0 <= one <= max_cost:
                    support[v, u] += 1
                    total += _motion_px(H, e, k, (u, v), plane[0]) ** 2
            std[v, u] = np.float32(SIGMA_PX) / np.float32(np.sqrt(total))
    return least, support, std


@kernel(fastmath=SUMS)
def begin_planes(search: PatchSearch, planes: F32) -> F32:
    """Cost (H, W) of planes (H, W, 3), ``UNKNOWN`` without one."""
    gray = search.gray
    height, width = gray.shape
    samples, plane = empty((2, search.offsets.shape[1]), np.float32), empty(3)
    n, cost = len(search.H), full((height, width), UNKNOWN, np.float32)
    work = empty(8), empty(n), np.arange(n)
    for v in range(height):
        for u in range(width):
            if np.isfinite(gray[v, u]) and planes[v, u, 0] > 0.0:
                variance = _window_samples(search, u, v, samples)
                plane[:] = planes[v, u]
                cost[v, u] = _plane_cost(search, (u, v), plane, samples, variance, np.inf, work)
    return cost


def refine_depths(reference: PinholeView, others: Sequence[PinholeView], found: InverseDepth) -> InverseDepth:
    """Refine and extend the inverse depths of a view by propagating and refining a plane per pixel (2.6)."""
    # A plane in space is linear in inverse depth; each window is transferred by its homography and compared
    # by weighted correlation (Bleyer, Rhemann and Rother, "PatchMatch stereo", BMVC 2011; Schönberger et al.,
    # ECCV 2016), from the fused correspondences `found` on. A pixel is kept if two neighbours have at most
    # `MAX_COST`, one has at most half of it, or two of the fused correspondences agree.
    sweeps = 4  # Passes over the image, alternating in direction
    if not others or not np.isfinite(found.value).any():
        return found
    search = _search_arguments(reference, others)
    planes = fit_planes(found.value, RADIUS)
    _sweep(search, planes, begin_planes(search, planes), sweeps)
    rho = planes[..., 0]
    least, support, std = rate_planes(search, planes, MAX_COST)
    seen = _is_supported(least, support)
    # Planes of higher cost stay if they continue the surface of accepted ones.
    unknown, doubtful = np.float32(np.nan), ~seen & (least <= MAX_CONTINUATION_COST)
    unsure = np.where(doubtful[..., None], planes, unknown)
    joining_std = rate_planes(search, unsure, MAX_CONTINUATION_COST)[2]
    known = np.where(seen | doubtful, rho, unknown)
    joining = surface_continuation(known, joining_std, seen, RADIUS + 1, GATE)
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
    planes = fit_planes(np.where(near, rho, unknown), RADIUS)
    # Cost 0 excludes the other pixels from the search.
    begun = begin_planes(search, np.where(wanted[..., None], planes, unknown))
    _sweep(search, planes, np.where(wanted, begun, np.float32(0.0)), sweeps)
    planes[~wanted] = np.nan
    least, support, std = rate_planes(search, planes, MAX_COST)
    seen = _is_supported(least, support)
    return np.where(seen, planes[..., 0], unknown), np.where(seen, std, unknown), support * seen


def _is_supported(least: F32, support: U8) -> B8:
    """(H, W) planes that two neighbours support, or one clearly."""
    return np.asarray((support >= 2) | ((support == 1) & (least <= 0.5 * MAX_COST)))


def _search_arguments(reference: PinholeView, others: Sequence[PinholeView]) -> PatchSearch:
    """Kernel arguments of a view and its neighbours."""
    intensity_scale = 15.0  # Grey level difference to the centre at which the weight of a sample is 1/e
    gray = [_gray(view) for view in others]
    starts = np.cumsum([0, *(one.size for one in gray[:-1])])
    layout = np.array([(k, *one.shape[::-1]) for k, one in zip(starts, gray, strict=True)], dtype=np.int64)
    H, e = map(np.stack, zip(*(pixel_transfer(reference.P, other.P) for other in others), strict=True))
    packed = np.concatenate([pack_squares(one).ravel() for one in gray])
    steps = SPACING * np.arange(-(RADIUS // SPACING), RADIUS // SPACING + 1)
    offsets = np.stack(np.meshgrid(steps, steps)).reshape(2, -1).astype(np.float32)
    weights = np.exp(-np.arange(256.0) / intensity_scale).astype(np.float32)
    return PatchSearch(_gray(reference), packed, layout, H, e, offsets, weights)


def _gray(view: PinholeView) -> F32:
    """(H, W) grey levels, NaN outside the original image."""
    gray = view.rgb.astype(np.float32) @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
    return np.where(view.seen, gray, np.float32(np.nan)).astype(np.float32)


def _sweep(search: PatchSearch, planes: F32, cost: F32, sweeps: int) -> None:
    """Propagate and perturb planes (H, W, 3) of cost (H, W) in place."""
    first_step_px = 0.5  # Perturbation of the first pass; it is halved in every pass
    converged_cost = 0.1  # Planes up to this cost are not changed
    active = np.ones(cost.shape, dtype=np.uint8)
    for k in range(sweeps):
        sweep_planes(search, first_step_px * 0.5**k, converged_cost, k % 2 == 1, planes, cost, active)
