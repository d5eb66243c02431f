"""Fusion of correspondences with several views into the inverse depth of each pixel (thesis, section 2.5)."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np

from thesisrecon._numba import kernel, zeros
from thesisrecon.arrays import B8, F32, F64, U8
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.imaging.resampling import bilinear_samples
from thesisrecon.records import PinholeView
from thesisrecon.stereo.correspondence import Correspondence

Correspond = Callable[[int, int], Correspondence | None]
"""Returns the correspondence of view i in view j, None if the pair fails."""

A = TypeVar("A")
B = TypeVar("B")

ALIKE = 0.03  #: largest relative difference of inverse depths on one surface
GATE = 3.0  #: standard deviations within which estimates agree; limit of the innovation of the filter


def inverse_depths(P: F64, P_other: F64, pair: Correspondence) -> tuple[F32, F32]:
    """Inverse depths, std (H, W) that bring H (x, y, 1) + rho e nearest to the correspondence, or NaN."""
    H, e = pixel_transfer(P, P_other)
    v, u = np.nonzero(np.isfinite(pair.xy[..., 0]) & np.isfinite(pair.sigma))
    xy, h = pair.xy[v, u].astype(np.float64), np.stack([u, v, np.ones_like(u)], axis=1) @ H.T
    a, b = e[:2] - xy * e[2], xy * h[:, 2:] - h[:, :2]
    square = np.sum(a * a, axis=1)
    rho, std = np.full((2, *pair.sigma.shape), np.nan, dtype=np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.sum(a * b, axis=1) / square
        w = h[:, 2] + value * e[2]
        good = (value > 0.0) & (w > 0.0) & (square > 0.0)
        rho[v, u] = np.where(good, value, np.nan)
        std[v, u] = np.where(good, pair.sigma[v, u] * w / np.sqrt(square), np.nan)
    return rho, std


def fuse_inverse_depths(found: Sequence[tuple[F32, F32]], shape: tuple[int, ...]) -> "InverseDepth":
    """Average the largest group of inverse depths (H, W) that agree, by inverse variances."""
    none = np.full(shape, np.nan, dtype=np.float32)
    rho, std = (np.stack(part) for part in zip(*(found or [(none, none)]), strict=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = 1.0 / std.astype(np.float64) ** 2
        agree = np.stack([_agree(one, its_std, rho, std) for one, its_std in zip(rho, std, strict=True)])
        votes, certainty = agree.sum(axis=1), np.where(agree, weight, 0.0).sum(axis=1)
        best = np.where(votes == votes.max(axis=0), certainty, -1.0).argmax(axis=0)
        group = np.take_along_axis(agree, best[None, None], axis=0)[0]
        number, weights = votes.max(axis=0), np.where(group, weight, 0.0).sum(axis=0)
        mean = np.where(group, weight * rho, 0.0).sum(axis=0) / weights
        scatter = np.where(group, ((rho - mean) / std) ** 2, 0.0).sum(axis=0)
        # A scatter larger than the standard deviations enlarges the result.
        spread = np.maximum(scatter / np.maximum(number - 1, 1), 1.0)
        fused = mean.astype(np.float32), np.sqrt(spread / weights).astype(np.float32)
    conflicts = np.isfinite(rho).sum(axis=0) - number
    known = number > 0
    value, error = (np.where(known, part, np.float32(np.nan)) for part in fused)
    return InverseDepth(value, error, number.astype(np.uint8), conflicts.astype(np.uint8))


def _agree(a: F32, sa: F32, b: F32, sb: F32) -> B8:
    # A comparison with NaN is false.
    return np.asarray((a - b) ** 2 <= np.float64(GATE) ** 2 * (sa * sa + sb * sb))


def update_kalman(state: "InverseDepth", new: tuple[F32, F32], alive: B8) -> None:
    """Update the one-dimensional Kalman filter of every pixel (H, W) in place; ``views`` are measurements."""
    # A missing measurement, or an innovation beyond `GATE` standard deviations, ends a chain: `alive` =
    # False.
    first = np.isnan(state.value)
    alive &= np.isfinite(new[0]) & (first | _agree(state.value, state.std, *new))
    z, s, variance = new[0][alive], new[1][alive], state.std[alive].astype(np.float64) ** 2
    gain = np.where(first[alive], 1.0, variance / (variance + s.astype(np.float64) ** 2))
    before = np.where(first[alive], np.float32(0.0), state.value[alive])
    state.value[alive] = before + gain * (z - before)
    state.std[alive] = np.where(first[alive], s, np.sqrt((1.0 - gain) * variance))
    state.views[alive] += 1


@kernel
def _projected(to: F64, u: float, v: float, z: float) -> tuple[float, float, float]:
    """Pixel and depth in another view of a pixel at depth z."""
    w = z * (to[2, 0] * u + to[2, 1] * v + to[2, 2]) + to[2, 3]
    x = (z * (to[0, 0] * u + to[0, 1] * v + to[0, 2]) + to[0, 3]) / w
    y = (z * (to[1, 0] * u + to[1, 1] * v + to[1, 2]) + to[1, 3]) / w
    return x, y, w


@kernel(error_model="numpy")
def count_agreement(
    own: tuple[F32, F32], to: F64, other: tuple[F32, F32], back: F64, limits: F64, agree: U8, contradict: U8
) -> None:
    """Count pixels that another depth map confirms or contradicts, which sees through them."""
    # `own`, `other`: depths and standard deviations (H, W), NaN = unknown. Confirmed: the other depth returns
    # within `limits[0]` px, and depths differ by less than `limits[1]` of the depth plus `limits[2]` standard
    # deviations. `to`, `back` (3, 4): from z (x, y, 1), 1 to z' (x', y', 1) of the other view and vice versa.
    depth, std = own
    other_depth, other_std = other
    height, width = depth.shape
    rows, columns = other_depth.shape
    for v in range(height):
        for u in range(width):
            z = np.float64(depth[v, u])
            if not np.isfinite(z):
                continue
            x, y, w = _projected(to, u, v, z)
            if not (w > 0.0 and -0.5 < x < columns - 0.5 and -0.5 < y < rows - 0.5):
                continue
            q, p = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
            found = np.float64(other_depth[q, p])
            if not np.isfinite(found):
                continue
            bound = limits[1] * w + limits[2] * np.sqrt(
                (np.float64(std[v, u]) * w / z) ** 2 + np.float64(other_std[q, p]) ** 2
            )
            if found > w + bound:
                contradict[v, u] += 1
            elif found >= w - bound:
                # Depth of the nearest pixel on the ray of this pixel.
                a, b, ahead = _projected(back, x, y, found)
                if ahead > 0.0 and (a - u) ** 2 + (b - v) ** 2 <= limits[0] ** 2:
                    agree[v, u] += 1


@kernel(error_model="numpy")
def splat_depths(depth: F32, to: F64, out: F32) -> None:
    """Project depths by ``to``, see :func:`count_agreement`, to pixels of ``out``; the nearest stays."""
    rows, columns = out.shape
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = np.float64(depth[v, u])
            if not np.isfinite(z):
                continue
            x, y, w = _projected(to, u, v, z)
            if w > 0.0 and -0.5 < x < columns - 0.5 and -0.5 < y < rows - 0.5:
                q, p = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
                # A comparison with NaN is false.
                if not out[q, p] <= w:
                    out[q, p] = w


@kernel
def _window_plane(
    rho: F32, used: B8, at: tuple[int, int], radius: int
) -> tuple[int, tuple[float, float, float], float, tuple[float, float], bool]:
    """Fit a plane to the inverse depths of a window that are ``used`` and similar to the centre's."""
    # Returns the number of pixels, the means of x, y and inverse depth relative to the centre, sum of the
    # variances of x and y, gradient, and whether it is determined.
    v, u = at
    here = np.float64(rho[at])
    sxx, sxy, syy, sxd, syd, sx, sy, sd, n = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
    for b in range(max(v - radius, 0), min(v + radius + 1, rho.shape[0])):
        for a in range(max(u - radius, 0), min(u + radius + 1, rho.shape[1])):
            d = np.float64(rho[b, a]) - here
            # A comparison with NaN is false.
            if used[b, a] and abs(d) <= ALIKE * here:
                x, y = a - u, b - v
                sxx, sxy, syy = sxx + x * x, sxy + x * y, syy + y * y
                sxd, syd = sxd + x * d, syd + y * d
                sx, sy, sd, n = sx + x, sy + y, sd + d, n + 1
    mx, my, md = sx / n, sy / n, sd / n
    sxx, sxy, syy, sxd, syd = sxx - sx * mx, sxy - sx * my, syy - sy * my, sxd - sx * md, syd - sy * md
    det = sxx * syy - sxy * sxy
    gradient = (syy * sxd - sxy * syd) / det, (sxx * syd - sxy * sxd) / det
    return n, (mx, my, md), (sxx + syy) / n, gradient, det > 1e-3 * sxx * syy


@kernel
def fit_planes(rho: F32, radius: int) -> F32:
    """Inverse depths and their gradients (H, W, 3) at known pixels, gradient 0 with too few around."""
    known, planes = np.isfinite(rho), zeros((*rho.shape, 3), np.float32)
    for v in range(rho.shape[0]):
        for u in range(rho.shape[1]):
            planes[v, u, 0] = rho[v, u]
            if known[v, u]:
                n, _, _, (gx, gy), determined = _window_plane(rho, known, (v, u), radius)
                if n >= 6 and determined:
                    planes[v, u, 1], planes[v, u, 2] = gx, gy
    return planes


@kernel
def surface_continuation(rho: F32, std: F32, sure: B8, radius: int, gate: float) -> B8:
    """Pixels (H, W) near the plane of ``sure`` ones around, a quarter of the window; ``gate`` in std."""
    joins = zeros(rho.shape, np.bool_)
    for v in range(rho.shape[0]):
        for u in range(rho.shape[1]):
            if sure[v, u] or not np.isfinite(rho[v, u]):
                continue
            n, (mx, my, md), spread, (gx, gy), determined = _window_plane(rho, sure, (v, u), radius)
            # Reject extrapolation: the pixel must lie within the spread of the window pixels.
            if n >= (2 * radius + 1) ** 2 // 4 and determined and mx * mx + my * my <= 0.5 * spread:
                joins[v, u] = abs(md - gx * mx - gy * my) <= gate * std[v, u]
    return joins


@dataclass(frozen=True)
class InverseDepth:
    """Inverse depth of the pixels of a view."""

    value: F32  #: (H, W), NaN = unknown
    std: F32  #: (H, W)
    views: U8  #: (H, W) number of other views that agree
    conflicts: U8  #: (H, W) number of other views that disagree


def with_idle_threads(pool: Executor | None, function: Callable[[A], B], items: Sequence[A]) -> list[B]:
    """Map a function in this thread; threads of ``pool`` without other work take items that are not begun."""
    if pool is None:
        return [function(item) for item in items]
    offers = [pool.submit(function, item) for item in items]
    own = {n: function(items[n]) for n, offer in enumerate(offers) if offer.cancel()}
    return [own[n] if n in own else offer.result() for n, offer in enumerate(offers)]


def link_sequence(
    view: int, views: Mapping[int, PinholeView], links: int, correspond: Correspond
) -> InverseDepth:
    """Link correspondences through the views in order of their numbers with a Kalman filter per pixel (2.5).

    Koch, Pollefeys and Van Gool, ECCV 1998: disparities of consecutive pairs are chained up and down from the
    view, at most ``links`` each way; variances add up, and a chain ends where it is occluded.
    """
    order = sorted(views)
    place = order.index(view)
    chains = order[place : place + links + 1], order[: place + 1][::-1][: links + 1]
    ends = [_filtered(chain, views, correspond) for chain in chains if len(chain) > 1]
    result = fuse_inverse_depths([(end.value, end.std) for end in ends], views[view].seen.shape)
    if ends:
        longest = np.maximum.reduce([end.views for end in ends])
        result.views[:] = np.where(np.isfinite(result.value), longest, 0)
    return result


def _filtered(chain: Sequence[int], views: Mapping[int, PinholeView], correspond: Correspond) -> InverseDepth:
    """Kalman filter of the first view of a chain."""
    reference = views[chain[0]]
    unknown = np.full((2, *reference.seen.shape), np.nan, dtype=np.float32)
    state = InverseDepth(*unknown, *np.zeros((2, *reference.seen.shape), dtype=np.uint8))
    alive = np.ones(reference.seen.shape, dtype=bool)
    linked: Correspondence | None = None
    for previous, following in pairwise(chain):
        step = correspond(previous, following)
        if step is None:
            break
        linked = step if linked is None else _concatenated(linked, step)
        update_kalman(state, inverse_depths(reference.P, views[following].P, linked), alive)
    return state


def _concatenated(first: Correspondence, second: Correspondence) -> Correspondence:
    """Correspondence of view i in k from those of i in j and of j in k; variances add up."""
    consistent_px = 3.0  # Range of the positions of four neighbours up to which they are interpolated
    limits = np.array(second.sigma.shape[::-1])
    inside = np.all((first.xy > -0.5) & (first.xy < limits - 0.5), axis=2)
    place = np.where(inside[..., None], first.xy, 0.0).astype(np.float32)
    xy, spread = bilinear_samples(second.xy, place[..., 0], place[..., 1])
    near = np.clip(np.rint(place).astype(np.int64), 0, limits - 1)
    nearest = near[..., 1], near[..., 0]
    consistent = np.max(spread, axis=2, keepdims=True) <= consistent_px
    xy = np.where(consistent, xy, second.xy[nearest] + (place - near))
    sigma = np.where(inside, np.hypot(first.sigma, second.sigma[nearest]), np.nan)
    xy = np.where(np.isfinite(sigma)[..., None], xy, np.nan)
    return Correspondence(xy.astype(np.float32), sigma.astype(np.float32))


def pixel_transfer(P: F64, P_other: F64) -> tuple[F64, F64]:
    """H (3, 3) and e (3,) that take a pixel (x, y, 1) of inverse depth rho to H (x, y, 1) + rho e."""
    centre = camera_centre(P)
    return P_other[:, :3] @ np.linalg.inv(P[:, :3]), P_other @ (centre / centre[3])
