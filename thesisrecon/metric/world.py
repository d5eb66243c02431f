"""The frame of a metric result: a similarity to known positions of cameras, which may constrain it, too."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64
from thesisrecon.errors import UsageError
from thesisrecon.geometry.camera_matrix import pose_of_camera
from thesisrecon.geometry.strata import estimate_similarity, transform, upgrade_points
from thesisrecon.metric.refinement import MetricRefinement
from thesisrecon.metric.vertical_lines import vertical_of_lines
from thesisrecon.optimize.bundle.knowledge import PositionPrior
from thesisrecon.records import (
    Image,
    IntrinsicsPrior,
    MetricResult,
    Reconstruction,
    Similarity,
    calibration_of_metric,
)

MAX_ROLL_DEG = 15.0
"""Root mean square roll of the cameras beyond which they do not tell where up is."""
_INLIER_SIGMAS = 3.37  # 99 % of the lengths of three-dimensional normal residuals are shorter


class Placed(NamedTuple):
    """A result in the frame of positions; ``residual`` (V, 3) centre minus position, NaN where unknown.

    ``used`` (V,) are the positions that determined the frame, ``sigma`` is the noise of a coordinate.
    """

    result: MetricResult
    residual: F64
    used: B8
    sigma: float


def centres_of(r: Reconstruction) -> F64:
    """Camera centres (V, 3), NaN where not registered."""
    assert r.K is not None
    views, centres = np.flatnonzero(r.registered), np.full((len(r.P), 3), np.nan)
    centres[views] = -np.einsum("vba,vb->va", *pose_of_camera(r.K[views], r.P[views]))
    return centres


def moved(result: MetricResult, move: Similarity) -> MetricResult:
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


def upright(result: MetricResult, images: Sequence[Image]) -> tuple[MetricResult, dict[str, Any]]:
    """A result with z up by vertical lines, else by :func:`up_direction`, and how up was found."""
    r = result.reconstruction
    assert r.K is not None
    u, roll = up_direction(pose_of_camera(r.K[r.registered], r.P[r.registered])[0])
    found: dict[str, Any] = {"axes": "z up", "by": "level sides of the images", "roll_rms_deg": roll}
    if lines := vertical_of_lines(r, images, u):
        level, (u, std, count) = u, lines
        off = float(np.degrees(np.arccos(min(float(u @ level), 1.0))))
        found |= {"by": "vertical lines", "std_deg": std, "images": count, "off_level_deg": off}
    turn = scipy.spatial.transform.Rotation.align_vectors([[0.0, 0.0, 1.0]], [u])[0].as_matrix()
    return moved(result, Similarity(1.0, turn, np.zeros(3))), found


def placed(result: MetricResult, positions: F64) -> Placed:
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
    found: Placed, positions: F64, std: float, *, refiner: MetricRefinement, prior: IntrinsicsPrior,
    rng: np.random.Generator, threads: int = 1,
) -> Placed:  # fmt: skip
    """Adjust a placed result again, with the positions that it used as observations of deviation ``std``.

    They also bound what the images hardly determine, such as the doming of a flat block (Wu, 2014).
    """
    r = found.result.reconstruction
    assert r.K is not None
    spread = upgrade_points(r.X, r.valid, np.eye(4))[2]
    unit = moved(found.result, Similarity.scaling(1.0 / spread)).reconstruction
    start = calibration_of_metric(r.K, "positions")
    # Positions that a domed model contradicts may be right.
    for _ in range(3):
        index = np.flatnonzero(found.used)
        roots = np.tile(np.eye(3) * spread / std, (len(index), 1, 1))
        centres = PositionPrior(index, positions[index] / spread, roots)
        result = refiner.refine(unit, start, prior=prior, rng=rng, threads=threads, centres=centres)
        result = moved(result, Similarity.scaling(spread))
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


def robust_similarity(source: F64, target: F64, seed: int) -> tuple[Similarity, B8, float]:
    """Similarity, inliers and noise of one coordinate."""
    n = len(source)
    # Residuals below are rounding.
    floor = 1e-9 * float(np.linalg.norm(target - target.mean(axis=0), axis=1).max())

    def distances(found: Similarity) -> F64:
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
