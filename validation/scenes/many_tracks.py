"""Tracks and verified pairs of arbitrarily many views, simulated from known geometry: no image is matched.

One place is the courtyard with its true depths, so that walls hide points; a street is a row of facades.
Corners repeat by chance within an angle and a scale, have noise, and some are wrong.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from thesisrecon.arrays import F32, F64, I64
from thesisrecon.epipolar.verification import homography_inlier_ratio
from thesisrecon.geometry.homogeneous import cross_matrix
from thesisrecon.geometry.two_view import sampson_residuals
from thesisrecon.records import Tracks, TwoView
from validation.scenes.courtyard import build_courtyard
from validation.scenes.many_views import FOCAL_REL, walk
from validation.scenes.pose import Pose, look_at
from validation.scenes.raycast import trace

SIZE, MARGIN_PX = (480, 360), 3
CORNERS, REPEATED, ANGLE_DEG, SCALE = 2500, 0.55, 28.0, 1.6
NOISE_PX, WIDE, WRONG, WRONG_PX = 0.25, 2.5, 0.03, 12.0
"""A tenth of the corners have ``WIDE`` times the noise; ``WRONG`` is the share of wrong ones."""
NEIGHBOURS, MIN_COMMON, GATE_PX = 40, 30, 1.5
Kind = Literal["place", "street"]


@dataclass(frozen=True)
class ManyTracks:
    """Tracks, verified pairs and true cameras."""

    tracks: Tracks
    pairs: list[TwoView]
    poses: list[Pose]

    @property
    def sizes(self) -> I64:
        """(V, 2) width and height of the images."""
        return np.tile(np.array(SIZE, dtype=np.int64), (len(self.poses), 1))


def make_tracks(kind: Kind, count: int, *, seed: int = 7) -> ManyTracks:
    """Simulate ``count`` views of one place or along a street, some 3500 corners each."""
    rng = np.random.default_rng(seed)
    poses, X, first, depths = (_place if kind == "place" else _street)(count, rng)
    seen = [_observe(pose, X, first, depths, k, rng) for k, pose in enumerate(poses)]
    view = np.repeat(np.arange(count), [len(point) for point, _ in seen])
    point, xy = np.concatenate([p for p, _ in seen]), np.concatenate([x for _, x in seen])
    often = np.bincount(point, minlength=len(X))[point] >= 2
    view, xy, (used, point) = view[often], xy[often], np.unique(point[often], return_inverse=True)
    spread = NOISE_PX * np.where(rng.random(len(xy)) < 0.1, WIDE, 1.0)
    spread = np.where(rng.random(len(xy)) < WRONG, WRONG_PX, spread)
    xy = xy + spread[:, None] * rng.normal(size=xy.shape)
    order = np.lexsort((view, point))
    tracks = Tracks(view[order], point[order].astype(np.int64), xy[order], count, len(used))
    return ManyTracks(tracks, _pairs(tracks, poses, rng), poses)


_Scene = tuple[list[Pose], F64, F64, F32 | None]
"""Cameras, points, the camera centres that the corners were found from, and depths (V, H, W)."""


def _place(count: int, rng: np.random.Generator) -> _Scene:
    poses, world, (width, height) = walk(count, SIZE), build_courtyard(), SIZE
    with ThreadPoolExecutor(2) as pool:
        maps = pool.map(lambda pose: trace(world, pose, SIZE, shade=False)[1].astype(np.float32), poses)
        depths = np.array(list(maps))
    each = int(np.clip(CORNERS / min(0.2 * REPEATED * count, 20.0), 60, CORNERS))
    X, first = list[F64](), list[F64]()
    for pose, depth in zip(poses, depths, strict=True):
        u, v = rng.integers(0, width, each), rng.integers(0, height, each)
        z = depth[v, u].astype(np.float64)
        rays = np.stack([u, v, np.ones(each)])[:, z > 0] * z[z > 0]
        X.append((np.linalg.inv(pose.K) @ rays).T @ pose.R + pose.C)
        first.append(np.tile(pose.C, (len(X[-1]), 1)))
    return poses, np.concatenate(X), np.concatenate(first), depths


def _street(count: int, rng: np.random.Generator, *, step: float = 0.5) -> _Scene:
    width, height = SIZE
    focal = FOCAL_REL * width
    K = np.array([[focal, 0.0, 0.51 * width], [0.0, focal, 0.48 * height], [0.0, 0.0, 1.0]])

    def bend(x: F64) -> F64:
        return np.asarray(6.0 * np.sin(x / 25.0))

    along = step * np.arange(count, dtype=np.float64)
    C = np.column_stack([along, bend(along), np.full(count, 1.6)])
    C[:, 1:] += rng.normal(0.0, 0.15, (count, 2))
    heading = 0.35 * np.sin(along / 3.5) + rng.normal(0.0, 0.1, count)
    ahead = np.column_stack([6.0 * np.sin(heading), 6.0 * np.cos(heading), rng.normal(0.0, 0.4, count)])
    rolls = np.tan(np.radians(rng.uniform(-4.0, 4.0, count)) / 2.0)
    poses = [Pose(K, look_at(c, c + d, r), c) for c, d, r in zip(C, ahead, rolls.tolist(), strict=True)]
    n = count * CORNERS // 4
    x = rng.uniform(-4.0, step * count + 4.0, n)
    away = rng.choice([4.0, 7.0, 7.5, 9.0], n) + rng.uniform(0.0, 0.8, n)
    X = np.column_stack([x, bend(x) + away, rng.uniform(-1.0, 5.0, n)])
    nearest = np.clip(np.rint(x / step).astype(int) + rng.integers(-4, 5, n), 0, count - 1)
    return poses, X, C[nearest], None


def _observe(
    pose: Pose, X: F64, first: F64, depths: F32 | None, k: int, rng: np.random.Generator
) -> tuple[I64, F64]:
    """Points (M,) that view k has as corners, and their exact pixels."""
    (width, height), Y = SIZE, (X - pose.C) @ pose.R.T
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = (Y @ pose.K.T)[:, :2] / Y[:, 2:]
    seen = (Y[:, 2] > 0.2) & (xy > MARGIN_PX).all(axis=1)
    seen &= (xy[:, 0] < width - 1 - MARGIN_PX) & (xy[:, 1] < height - 1 - MARGIN_PX)
    ray, old = X - pose.C, X - first
    length, before = np.linalg.norm(ray, axis=1), np.linalg.norm(old, axis=1)
    seen &= np.einsum("na,na->n", ray, old) > np.cos(np.radians(ANGLE_DEG)) * length * before
    seen &= (length < SCALE * before) & (before < SCALE * length)
    i = np.flatnonzero(seen)
    if depths is not None:
        u, v = np.rint(xy[i]).astype(int).T
        i = i[np.abs(depths[k, v, u] - Y[i, 2]) < 0.02 * Y[i, 2]]
    i = i[rng.random(len(i)) < REPEATED]
    if len(i) > 1.5 * CORNERS:
        i = np.sort(rng.choice(i, 3 * CORNERS // 2, replace=False))
    return i, xy[i]


def _pairs(tracks: Tracks, poses: list[Pose], rng: np.random.Generator) -> list[TwoView]:
    """Each view with the ``NEIGHBOURS`` that share most points, F from the true cameras."""
    n, K = tracks.n_views, len(tracks.xy)
    A = scipy.sparse.csr_array(
        (np.ones(K), (tracks.view_index, tracks.point_index)), shape=(n, tracks.n_points)
    )
    common = (A @ A.T).toarray()
    np.fill_diagonal(common, 0.0)
    near = np.argsort(-common, axis=1, kind="stable")[:, :NEIGHBOURS]
    chosen = sorted({(min(i, int(j)), max(i, int(j))) for i in range(n) for j in near[i]})
    rows = [np.flatnonzero(tracks.view_index == v) for v in range(n)]
    pairs = []
    for i, j in chosen:
        if common[i, j] < MIN_COMMON:
            continue
        points = (tracks.point_index[rows[i]], tracks.point_index[rows[j]])
        _, a, b = np.intersect1d(*points, return_indices=True, assume_unique=True)
        F = _fundamental(poses[i], poses[j])
        xy1, xy2 = tracks.xy[rows[i][a]], tracks.xy[rows[j][b]]
        good = np.abs(sampson_residuals(F, xy1, xy2)) < GATE_PX
        xy1, xy2, few = xy1[good], xy2[good], np.flatnonzero(good)[:200]
        flat = homography_inlier_ratio(F, xy1[: len(few)], xy2[: len(few)], tolerance_px=GATE_PX, rng=rng)
        affine = np.tile(np.eye(2), (len(xy1), 1, 1))
        pairs.append(
            TwoView(i, j, F, 0.35, a[good], b[good], xy1, xy2, affine, len(a), flat, True, "", "general")
        )
    return pairs


def _fundamental(one: Pose, two: Pose) -> F64:
    translation = two.R @ (one.C - two.C)
    F = cross_matrix(translation) @ two.R @ one.R.T
    F = np.linalg.inv(two.K).T @ F @ np.linalg.inv(one.K)
    return np.asarray(F / np.linalg.norm(F))
