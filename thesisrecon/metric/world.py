"""The frame of a metric result: a similarity to known positions of cameras, which may constrain it, too."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import scipy

from thesisrecon import records
from thesisrecon.arrays import B8, F32, F64, I64
from thesisrecon.camera import viewing_rays
from thesisrecon.errors import UsageError
from thesisrecon.geometry.camera_matrix import poses_of_model
from thesisrecon.geometry.strata import estimate_similarity, transform, upgrade_points
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.optimize.bundle.knowledge import PositionPrior

MAX_ROLL_DEG = 15.0
"""Root mean square roll of the cameras beyond which they do not tell where up is."""
MIN_GRADIENT, MAX_WIDTH, MIN_LENGTH = 4.0, 1.4, 0.04
"""Grey levels per pixel of an edge, px RMS across it, and its length as a share of the long side."""
ALIGNED = np.sin(np.radians(1.0))
"""A line is vertical if its plane with the camera centre deviates by less from the direction."""
CONE, MIN_SHARE, MIN_IMAGES, MAX_STD_DEG = np.radians(15.0), 0.4, 3, 0.5
"""Angle about the direction expected, share of the lines in it that agree, by length, and images with them:
of buildings they are 0.5 to 0.7, of objects and trees below 0.3."""
MOST = 40  # images of which edges are read
_INLIER_SIGMAS = 3.37  # 99 % of the lengths of three-dimensional normal residuals are shorter


class Placed(NamedTuple):
    """A result in the frame of positions; ``residual`` (V, 3) centre minus position, NaN where unknown.

    ``used`` (V,) are the positions that determined the frame, ``sigma`` is the noise of a coordinate.
    """

    result: records.MetricResult
    residual: F64
    used: B8
    sigma: float


def centres_of(r: records.Reconstruction) -> F64:
    """Camera centres (V, 3), NaN where not registered."""
    centres = np.full((len(r.P), 3), np.nan)
    centres[r.registered] = poses_of_model(r, r.registered)[2]
    return centres


def moved(result: records.MetricResult, move: records.Similarity) -> records.MetricResult:
    """A result in another world, y = scale R x + t."""
    r, H, std = result.reconstruction, move.matrix, result.pose_std
    P = np.where(r.registered[:, None, None], move.scale * transform(H, r.P, "cameras"), 0.0)
    X = transform(H, r.X, "points")
    X = np.where(r.valid[:, None], X / np.where(r.valid, X[:, 3], 1.0)[:, None], 0.0)
    if std is not None:
        # Variances along other axes, without the correlations of those.
        std = np.column_stack([std[:, :3], move.scale * np.sqrt(std[:, 3:] ** 2 @ (move.R**2).T)])
    return replace(result, reconstruction=replace(r, P=P, X=X), pose_std=std)


def up_direction(R: F64) -> tuple[F64, float]:
    """Direction up (3,) of cameras (V, 3, 3) that are held level or upright, and their RMS roll in degrees.

    The side of an image that is nearly horizontal is perpendicular to it. ``UsageError`` if the sides have
    one direction only, or the cameras were rolled.
    """
    # Perpendicular to the x axes of two images, and nearly to those of most: few images are turned.
    first = R[:: max(len(R) // 40, 1), 0]
    normals = np.cross(first[:, None], first[None]).reshape(-1, 3)
    normals = normals[np.linalg.norm(normals, axis=1) > 0.1]
    if not len(normals):
        raise UsageError("the images have one horizontal direction; up is undetermined")
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cost = np.sort(np.abs(normals @ R[:, 0].T), axis=1)[:, : len(R) // 2 + 1].sum(axis=1)
    sides, u = R[:, 0], normals[int(cost.argmin())]
    for _ in range(10):
        # Images turned by 90 degrees have their y axis level.
        sides = np.where((np.abs(R[:, 0] @ u) > 0.7)[:, None], R[:, 1], R[:, 0])
        off = np.maximum(np.abs(sides @ u), 0.02)
        values, vectors = np.linalg.eigh(np.einsum("vi,v,vj->ij", sides, 1.0 / off, sides))
        before, u = u, vectors[:, 0]
        if abs(before @ u) > 1.0 - 1e-12:
            break
    roll = float(np.degrees(np.sqrt(np.mean(np.arcsin(np.clip(sides @ u, -1.0, 1.0)) ** 2))))
    if values[1] < 0.01 * values[2]:
        raise UsageError("the images have one horizontal direction; up is undetermined")
    if roll > MAX_ROLL_DEG:
        raise UsageError(f"the cameras were rolled by {roll:.0f} degrees (RMS); up is undetermined")
    # Up is against the y axes of the images, or against the viewing directions if cameras look down.
    return (u if float(np.sum((R[:, 1] + R[:, 2]) @ u)) < 0.0 else -u), roll


def upright(
    result: records.MetricResult, images: Sequence[records.Image]
) -> tuple[records.MetricResult, dict[str, Any]]:
    """A result with z up by vertical lines, else by :func:`up_direction`, and how up was found."""
    r = result.reconstruction
    u, roll = up_direction(poses_of_model(r, r.registered)[0])
    found: dict[str, Any] = {"axes": "z up", "by": "level sides of the images", "roll_rms_deg": roll}
    if lines := vertical_of_lines(r, images, u):
        level, (u, std, count) = u, lines
        off = float(np.degrees(np.arccos(min(float(u @ level), 1.0))))
        found |= {"by": "vertical lines", "std_deg": std, "images": count, "off_level_deg": off}
    turn = scipy.spatial.transform.Rotation.align_vectors([[0.0, 0.0, 1.0]], [u])[0].as_matrix()
    return moved(result, records.Similarity(1.0, turn, np.zeros(3))), found


def vertical_of_lines(
    model: records.Reconstruction, images: Sequence[records.Image], expected: F64
) -> tuple[F64, float, int] | None:
    """Unit vector to which most nearly vertical lines point, its standard deviation (degrees), and images.

    None if few of the lines within 15 degrees of the ``expected`` direction agree. The deviation is that of
    the jackknife over the images, since errors of one image are common to its lines.
    """
    normals, weights, views = list[F64](), list[F64](), list[int]()
    assert model.K is not None
    here = np.flatnonzero(model.registered)
    here = here[:: 1 + len(here) // MOST]
    for v, R in zip(here.tolist(), poses_of_model(model, here)[0], strict=True):
        ends = straight_edges(images[v].gray, images[v].mask)
        lens = np.zeros(1) if model.distortion is None else model.distortion[v]
        across = np.cross(*(viewing_rays(model.K[v], ends[:, k], lens) @ R for k in (0, 1)))
        length = np.linalg.norm(across, axis=1)
        near = np.abs(across @ expected) < np.sin(CONE) * length
        normals.append(across[near] / length[near, None])
        weights.append(length[near])
        views += [v] * int(near.sum())
    if len(views) < 10 or len(set(views)) < MIN_IMAGES:
        return None
    n, w, view = np.concatenate(normals), np.concatenate(weights), np.array(views)
    rng = np.random.default_rng(0)
    first = rng.integers(0, len(n), 4000)
    second = (first + rng.integers(1, len(n), 4000)) % len(n)
    c = np.cross(n[first], n[second])
    length = np.linalg.norm(c, axis=1)
    c = c[(length > ALIGNED) & (np.abs(c @ expected) > np.cos(CONE) * length)]
    c /= np.linalg.norm(c, axis=1, keepdims=True)
    if not len(c):
        return None
    u = c[int(((np.abs(c @ n.T) < ALIGNED) @ w).argmax())]

    def refined(keep: B8) -> F64:
        one = u
        for _ in range(10):
            off = np.abs(n[keep] @ one)
            weight = w[keep] * (off < 2.0 * ALIGNED) / np.maximum(off, 0.2 * ALIGNED)
            one = np.linalg.eigh(np.einsum("vi,v,vj->ij", n[keep], weight, n[keep]))[1][:, 0]
        return np.asarray(one * np.sign(one @ expected))

    u = refined(np.ones(len(n), bool))
    agree = np.abs(n @ u) < ALIGNED
    seen = np.unique(view[agree])
    if w[agree].sum() < MIN_SHARE * w.sum() or len(seen) < MIN_IMAGES:
        return None
    without = np.array([refined(view != v) for v in seen])
    spread = np.sum((without - without.mean(axis=0)) ** 2) * (len(seen) - 1) / len(seen)
    std = float(np.degrees(np.sqrt(spread)))
    return (u, std, len(seen)) if std < MAX_STD_DEG else None


def straight_edges(gray: F32, mask: B8 | None = None) -> F64:
    """End points (N, 2, 2) of straight edges: regions of one gradient direction that are long and thin."""
    smooth = scipy.ndimage.gaussian_filter(gray.astype(np.float64), 1.0)
    gy, gx = np.gradient(smooth)
    strength, found = np.hypot(gx, gy), list[F64]()
    strong = strength > MIN_GRADIENT
    if mask is not None:
        strong &= scipy.ndimage.binary_erosion(mask, iterations=3)
    # Two sets of directions: those at the border of one are in the middle of the other.
    for shift in (0.0, 0.5):
        sector = (np.arctan2(gy, gx) * (8.0 / np.pi) + shift) // 1.0 % 16.0
        label, count = np.zeros(gray.shape, np.int64), 0
        for k in range(16):
            part, number = scipy.ndimage.label(strong & (sector == k), np.ones((3, 3)))
            label += np.where(part > 0, part + count, 0)
            count += number
        row, column = np.nonzero(label > 0)
        own, weight = label[row, column] - 1, strength[row, column]
        total = np.bincount(own, weight, count)

        def mean(x: F64 | I64) -> F64:
            return np.bincount(own, weight * x, count) / total  # noqa: B023

        middle = np.column_stack([mean(column), mean(row)])
        dx, dy = column - middle[own, 0], row - middle[own, 1]
        xx, xy, yy = mean(dx * dx), mean(dx * dy), mean(dy * dy)
        angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
        c, s = np.cos(angle), np.sin(angle)
        along, each = dx * c[own] + dy * s[own], np.arange(count)
        ends = np.column_stack([getattr(scipy.ndimage, f)(along, own, each) for f in ("minimum", "maximum")])
        straight = yy * c**2 + xx * s**2 - 2.0 * xy * c * s < MAX_WIDTH**2
        long = straight & (np.ptp(ends, axis=1) > MIN_LENGTH * max(gray.shape))
        found.append((middle[:, None] + ends[:, :, None] * np.column_stack([c, s])[:, None])[long])
    return np.concatenate(found)


def placed(result: records.MetricResult, positions: F64) -> Placed:
    """Move a result to the positions (V, 3) of its cameras, NaN: unknown; ``UsageError`` if impossible."""
    centres = centres_of(result.reconstruction)
    known = np.isfinite(positions).all(axis=1) & result.reconstruction.registered
    if known.sum() < 3:
        raise UsageError(f"only {known.sum()} registered images have a position; three are needed")
    require_width(centres[known], "camera centres", 0.0)
    move, inlier, sigma = robust_similarity(centres[known], positions[known], 0)
    require_width(positions[known][inlier], "positions", sigma)
    used = known.copy()
    used[known] = inlier
    residual = np.where(known[:, None], move.apply(np.nan_to_num(centres)) - positions, np.nan)
    return Placed(moved(result, move), residual, used, sigma)


def constrained(
    found: Placed, positions: F64, std: float, *, refiner: MetricRefinement, prior: records.IntrinsicsPrior,
    rng: np.random.Generator, threads: int = 1,
) -> Placed:  # fmt: skip
    """Adjust a placed result again, with the positions that it used as observations of deviation ``std``.

    They also bound what the images hardly determine, such as the doming of a flat block (Wu, 2014).
    """
    r = found.result.reconstruction
    assert r.K is not None
    spread = upgrade_points(r.X, r.valid, np.eye(4))[2]
    unit = moved(found.result, records.Similarity.scaling(1.0 / spread)).reconstruction
    start = records.calibration_of_metric(r.K, "positions")
    # Positions that a domed model contradicts may be right.
    for _ in range(3):
        index = np.flatnonzero(found.used)
        roots = np.tile(np.eye(3) * spread / std, (len(index), 1, 1))
        centres = PositionPrior(index, positions[index] / spread, roots)
        result = refiner.refine(unit, start, prior=prior, rng=rng, threads=threads, centres=centres)
        result = moved(result, records.Similarity.scaling(spread))
        residual = centres_of(result.reconstruction) - positions
        used = np.nan_to_num(np.linalg.norm(residual, axis=1), nan=np.inf) < _INLIER_SIGMAS * std
        before, found = found.used, Placed(result, residual, used | found.used, found.sigma)
        if (found.used == before).all():
            break
    return found


def require_width(points: F64, what: str, sigma: float) -> None:
    """Require points off a line by more than their noise: the rotation about the line is free otherwise."""
    along, across = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[:2] / math.sqrt(len(points))
    if across <= max(1e-3 * along, sigma):
        spread = f"RMS {across:.3g} across the line, {along:.3g} along it, noise {sigma:.2g}"
        raise UsageError(
            f"the {what} of the {len(points)} images lie on one line ({spread}), which leaves the rotation "
            "about it undetermined; add positions off the line, or use only the scale (--scale)"
        )


def robust_similarity(source: F64, target: F64, seed: int) -> tuple[records.Similarity, B8, float]:
    """Similarity, inliers and noise of one coordinate."""
    n = len(source)
    # Residuals below are rounding.
    floor = 1e-9 * float(np.linalg.norm(target - target.mean(axis=0), axis=1).max())

    def distances(found: records.Similarity) -> F64:
        return np.asarray(np.linalg.norm(found.apply(source) - target, axis=1))

    # A triple fits itself, so that the quantile of Rousseeuw counts three positions more than half.
    rank = (n + 4) // 2
    best, least = None, math.inf
    # All up to 18 positions; of 1000, about 125 are right even if half of the positions are wrong.
    triples: Iterable[Any] = combinations(range(n), 3)
    if math.comb(n, 3) > 1000:
        rng = np.random.default_rng(seed)
        triples = (rng.choice(n, 3, replace=False) for _ in range(1000))
    for triple in map(list, triples):
        try:
            found = estimate_similarity(source[triple], target[triple])
        except ValueError:
            continue
        quantile = float(np.partition(distances(found), rank - 1)[rank - 1])
        if quantile < least:
            best, least = found, quantile
    if best is None:
        require_width(target, "positions", 0.0)
        best = estimate_similarity(source, target)
    # Rousseeuw's correction for few points, and the quantile of the lengths of normal residuals.
    normal = math.sqrt(2.0 * scipy.special.gammaincinv(1.5, rank / (n + 1)))
    sigma = least * (1.0 + 5.0 / max(n - 3, 1)) / normal
    inlier = distances(best) <= _INLIER_SIGMAS * max(sigma, floor)
    for _ in range(20):
        require_width(target[inlier], "positions", 0.0)
        best = estimate_similarity(source[inlier], target[inlier])
        free = 3 * int(inlier.sum()) - 7
        sigma = math.sqrt(float(np.sum(distances(best)[inlier] ** 2)) / free)
        before, inlier = inlier, distances(best) <= _INLIER_SIGMAS * max(sigma, floor)
        if inlier.sum() < 3 or (inlier == before).all():
            inlier = before
            break
    return best, inlier, sigma
