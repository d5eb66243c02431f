"""Fusion of correspondences with several views into the inverse depth of each pixel (thesis, section 2.5)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import TypeVar

import numpy as np

from thesisrecon._numba import kernel
from thesisrecon.arrays import F32, F64, U8
from thesisrecon.geometry.camera_matrix import camera_centre
from thesisrecon.imaging.resampling import bilinear_samples
from thesisrecon.records import PinholeView
from thesisrecon.stereo.correspondence import Correspondence

Correspond = Callable[[int, int], Correspondence | None]
"""Returns the correspondence of view i in view j, None if the pair fails."""

A = TypeVar("A")
B = TypeVar("B")

GATE = 3.0
"""Standard deviations within which estimates agree; limit of the innovation of the filter."""


@kernel(error_model="numpy")
def inverse_depths(xy: F32, sigma: F32, H: F64, e: F64, rho: F32, std: F32) -> None:
    """Inverse depths and standard deviations (H, W) from correspondences (H, W, 2), ``sigma`` in pixels.

    A pixel of inverse depth rho is at H (x, y, 1) + rho e in the other view; rho minimises the distance to
    the correspondence. NaN if that is unknown or behind a camera.
    """
    height, width = rho.shape
    for v in range(height):
        for u in range(width):
            rho[v, u], std[v, u] = np.nan, np.nan
            x, y = np.float64(xy[v, u, 0]), np.float64(xy[v, u, 1])
            if not (np.isfinite(x) and np.isfinite(sigma[v, u])):
                continue
            hx = H[0, 0] * u + H[0, 1] * v + H[0, 2]
            hy = H[1, 0] * u + H[1, 1] * v + H[1, 2]
            hz = H[2, 0] * u + H[2, 1] * v + H[2, 2]
            ax, ay = e[0] - x * e[2], e[1] - y * e[2]
            bx, by = x * hz - hx, y * hz - hy
            square = ax * ax + ay * ay
            value = (ax * bx + ay * by) / square
            w = hz + value * e[2]
            if value > 0.0 and w > 0.0 and square > 0.0:
                rho[v, u] = value
                std[v, u] = sigma[v, u] * w / np.sqrt(square)


@kernel(error_model="numpy")
def fuse_inverse_depths(
    rho: F32, std: F32, gate: float, out: F32, out_std: F32, support: U8, conflicts: U8
) -> None:
    """Fuse several inverse depths (K, H, W) per pixel into one.

    The estimate that most others agree with within ``gate`` standard deviations is averaged with these,
    weighted by the inverse variances; among equals the more certain one. ``support`` and ``conflicts`` (H, W)
    receive the numbers of estimates that agree and disagree.
    """
    count, height, width = rho.shape
    for v in range(height):
        for u in range(width):
            known, best, most, weight_of_best = 0, -1, 0, 0.0
            for k in range(count):
                if not np.isfinite(rho[k, v, u]):
                    continue
                known += 1
                n, weight = 0, 0.0
                for m in range(count):
                    if _agree(rho[k, v, u], std[k, v, u], rho[m, v, u], std[m, v, u], gate):
                        n += 1
                        weight += 1.0 / np.float64(std[m, v, u]) ** 2
                if n > most or (n == most and weight > weight_of_best):
                    best, most, weight_of_best = k, n, weight
            support[v, u], conflicts[v, u] = most, known - most
            if best < 0:
                out[v, u], out_std[v, u] = np.nan, np.nan
                continue
            total, weights = 0.0, 0.0
            for m in range(count):
                if _agree(rho[best, v, u], std[best, v, u], rho[m, v, u], std[m, v, u], gate):
                    w = 1.0 / np.float64(std[m, v, u]) ** 2
                    total += w * rho[m, v, u]
                    weights += w
            mean, scatter = total / weights, 0.0
            for m in range(count):
                if _agree(rho[best, v, u], std[best, v, u], rho[m, v, u], std[m, v, u], gate):
                    scatter += ((rho[m, v, u] - mean) / std[m, v, u]) ** 2
            # A scatter larger than the standard deviations enlarges the result.
            spread = scatter / (most - 1) if most > 1 else 1.0
            out[v, u], out_std[v, u] = mean, np.sqrt(max(spread, 1.0) / weights)


@kernel(error_model="numpy")
def _agree(a: float, sa: float, b: float, sb: float, gate: float) -> bool:
    # A comparison with NaN is false.
    return (a - b) * (a - b) <= gate * gate * (sa * sa + sb * sb)


@kernel(error_model="numpy")
def update_kalman(rho: F32, std: F32, new: F32, new_std: F32, gate: float, alive: U8, support: U8) -> None:
    """Update the one-dimensional Kalman filter of every pixel (H, W) in place.

    The first measurement starts the chain of a pixel; a missing measurement, or one beyond ``gate`` standard
    deviations of the innovation, ends it: ``alive`` becomes 0. ``support`` counts the measurements.
    """
    height, width = rho.shape
    for v in range(height):
        for u in range(width):
            if not alive[v, u]:
                continue
            z, s = np.float64(new[v, u]), np.float64(new_std[v, u])
            if not np.isfinite(z):
                alive[v, u] = 0
            elif not np.isfinite(rho[v, u]):
                rho[v, u], std[v, u], support[v, u] = z, s, 1
            elif _agree(rho[v, u], std[v, u], z, s, gate):
                variance = np.float64(std[v, u]) ** 2
                gain = variance / (variance + s * s)
                rho[v, u] += gain * (z - rho[v, u])
                std[v, u] = np.sqrt((1.0 - gain) * variance)
                support[v, u] += 1
            else:
                alive[v, u] = 0


@kernel(error_model="numpy")
def count_agreement(
    own: tuple[F32, F32], to: F64, other: tuple[F32, F32], back: F64, limits: F64, agree: U8, contradict: U8
) -> None:
    """Count pixels that another depth map confirms or contradicts.

    ``own`` and ``other`` are depths and standard deviations (H, W), NaN = unknown.
    A pixel is confirmed if the reprojection of the other map's depth returns within ``limits[0]`` pixels and
    the depths differ by less than ``limits[1]`` of the depth plus ``limits[2]`` standard deviations; it is
    contradicted if the other view sees through it. ``to`` (3, 4) transforms z (x, y, 1), 1 to z' (x', y', 1)
    of the other view, ``back`` the other way.
    """
    depth, std = own
    other_depth, other_std = other
    height, width = depth.shape
    rows, columns = other_depth.shape
    for v in range(height):
        for u in range(width):
            z = np.float64(depth[v, u])
            if not np.isfinite(z):
                continue
            w = z * (to[2, 0] * u + to[2, 1] * v + to[2, 2]) + to[2, 3]
            x = (z * (to[0, 0] * u + to[0, 1] * v + to[0, 2]) + to[0, 3]) / w
            y = (z * (to[1, 0] * u + to[1, 1] * v + to[1, 2]) + to[1, 3]) / w
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
                b = found * (back[2, 0] * x + back[2, 1] * y + back[2, 2]) + back[2, 3]
                dx = (found * (back[0, 0] * x + back[0, 1] * y + back[0, 2]) + back[0, 3]) / b - u
                dy = (found * (back[1, 0] * x + back[1, 1] * y + back[1, 2]) + back[1, 3]) / b - v
                if b > 0.0 and dx * dx + dy * dy <= limits[0] * limits[0]:
                    agree[v, u] += 1


@kernel(error_model="numpy")
def splat_depths(depth: F32, to: F64, out: F32) -> None:
    """Project depths to the nearest pixels of another view, keeping the smaller depth.

    ``to`` as in :func:`count_agreement`; ``out`` is updated, NaN = unknown.
    """
    rows, columns = out.shape
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = np.float64(depth[v, u])
            if not np.isfinite(z):
                continue
            w = z * (to[2, 0] * u + to[2, 1] * v + to[2, 2]) + to[2, 3]
            x = (z * (to[0, 0] * u + to[0, 1] * v + to[0, 2]) + to[0, 3]) / w
            y = (z * (to[1, 0] * u + to[1, 1] * v + to[1, 2]) + to[1, 3]) / w
            if w > 0.0 and -0.5 < x < columns - 0.5 and -0.5 < y < rows - 0.5:
                q, p = int(np.floor(y + 0.5)), int(np.floor(x + 0.5))
                # A comparison with NaN is false.
                if not out[q, p] <= w:
                    out[q, p] = w


@kernel(error_model="numpy")
def surface_continuation(
    rho: F32, std: F32, sure: U8, radius: int, alike: float, gate: float, joins: U8
) -> None:
    """Set ``joins`` (H, W) to 1 for pixels that continue the surface of ``sure`` neighbours.

    A plane is fitted to the sure pixels of the window with inverse depths that differ by at most the share
    ``alike``. They must be a quarter of the window and surround the pixel, and the plane must pass within
    ``gate`` standard deviations.
    """
    height, width = rho.shape
    least = (2 * radius + 1) ** 2 // 4
    for v in range(height):
        for u in range(width):
            joins[v, u] = 0
            here = np.float64(rho[v, u])
            if sure[v, u] or not np.isfinite(here):
                continue
            sxx, sxy, syy, sxd, syd, sx, sy, sd, n = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
            for b in range(max(v - radius, 0), min(v + radius + 1, height)):
                for a in range(max(u - radius, 0), min(u + radius + 1, width)):
                    d = np.float64(rho[b, a]) - here
                    if sure[b, a] and abs(d) <= alike * here:
                        x, y = a - u, b - v
                        sxx, sxy, syy = sxx + x * x, sxy + x * y, syy + y * y
                        sxd, syd = sxd + x * d, syd + y * d
                        sx, sy, sd, n = sx + x, sy + y, sd + d, n + 1
            if n < least:
                continue
            mx, my = sx / n, sy / n
            sxx, sxy, syy = sxx - sx * mx, sxy - sx * my, syy - sy * my
            sxd, syd = sxd - sx * sd / n, syd - sy * sd / n
            det = sxx * syy - sxy * sxy
            # Reject extrapolation: the pixel must lie within the spread of the window pixels.
            if det <= 1e-3 * sxx * syy or mx * mx + my * my > 0.5 * (sxx + syy) / n:
                continue
            gx, gy = (syy * sxd - sxy * syd) / det, (sxx * syd - sxy * sxd) / det
            if abs(sd / n - gx * mx - gy * my) <= gate * std[v, u]:
                joins[v, u] = 1


@dataclass(frozen=True)
class InverseDepth:
    """Inverse depth of the pixels of a view."""

    value: F32  #: (H, W), NaN = unknown
    std: F32  #: (H, W)
    views: U8  #: (H, W) number of other views that agree
    conflicts: U8  #: (H, W) number of other views that disagree


def fuse_neighbours(
    view: int,
    views: Mapping[int, PinholeView],
    neighbours: Sequence[int],
    correspond: Correspond,
    pool: Executor | None = None,
) -> InverseDepth:
    """Robust weighted mean of the inverse depths measured with all neighbours (2.5).

    The largest group of estimates that agree is averaged, the more certain one among equals. A measurement
    with a single neighbour is kept; the depth map of another view must confirm it.
    """
    pairs = zip(neighbours, _with_idle_threads(pool, partial(correspond, view), neighbours), strict=True)
    found = [_measured(views[view].P, views[other].P, pair) for other, pair in pairs if pair is not None]
    return _fused(views[view].seen.shape, found)


def _with_idle_threads(pool: Executor | None, function: Callable[[A], B], items: Sequence[A]) -> list[B]:
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

    Koch, Pollefeys and Van Gool, "Multi viewpoint stereo from uncalibrated video sequences", ECCV 1998. The
    disparities of consecutive pairs are chained up and down the sequence from the reference view, at most
    ``links`` in each direction. Each view of the chain measures the depth with a longer baseline, and the
    variances of the links add up. A pixel's chain ends at the first measurement outside the gate, where it is
    taken as occluded. Both directions are filtered separately and fused where they agree.
    """
    order = sorted(views)
    place = order.index(view)
    chains = order[place : place + links + 1], order[: place + 1][::-1][: links + 1]
    ends = [_filtered(chain, views, correspond) for chain in chains if len(chain) > 1]
    result = _fused(views[view].seen.shape, [(end.value, end.std) for end in ends])
    if ends:
        longest = np.maximum.reduce([end.views for end in ends])
        result.views[:] = np.where(np.isfinite(result.value), longest, 0)
    return result


def _filtered(chain: Sequence[int], views: Mapping[int, PinholeView], correspond: Correspond) -> InverseDepth:
    """Kalman filter of the first view of a chain."""
    reference = views[chain[0]]
    state = _unknown(reference.seen.shape)
    alive = np.ones(reference.seen.shape, dtype=np.uint8)
    linked: Correspondence | None = None
    for previous, following in pairwise(chain):
        step = correspond(previous, following)
        if step is None:
            break
        linked = step if linked is None else _concatenated(linked, step)
        new = _measured(reference.P, views[following].P, linked)
        update_kalman(state.value, state.std, *new, GATE, alive, state.views)
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


def _measured(P: F64, P_other: F64, pair: Correspondence) -> tuple[F32, F32]:
    """Inverse depth and standard deviation (H, W) from the correspondence with another camera."""
    rho, std = np.empty_like(pair.sigma), np.empty_like(pair.sigma)
    inverse_depths(pair.xy, pair.sigma, *pixel_transfer(P, P_other), rho, std)
    return rho, std


def pixel_transfer(P: F64, P_other: F64) -> tuple[F64, F64]:
    """H (3, 3) and e (3,) that take a pixel (x, y, 1) of inverse depth rho to H (x, y, 1) + rho e."""
    centre = camera_centre(P)
    return P_other[:, :3] @ np.linalg.inv(P[:, :3]), P_other @ (centre / centre[3])


def _fused(shape: tuple[int, ...], found: Sequence[tuple[F32, F32]]) -> InverseDepth:
    """Fusion of inverse depths and standard deviations (H, W)."""
    result = _unknown(shape)
    if found:
        rho, std = (np.stack(part) for part in zip(*found, strict=True))
        fuse_inverse_depths(rho, std, GATE, result.value, result.std, result.views, result.conflicts)
    return result


def _unknown(shape: tuple[int, ...]) -> InverseDepth:
    unknown, counts = np.full((2, *shape), np.nan, dtype=np.float32), np.zeros((2, *shape), dtype=np.uint8)
    return InverseDepth(unknown[0], unknown[1], counts[0], counts[1])
