"""Metric models of one set of tracks are joined by a similarity on which their common points agree.

Growth ends at an image that sees few points of the model. Beyond it, a further model may share points with
the first one that no single image sees in number. A track that one of the models observes in a single image
is a point of unknown depth there. If all are such tracks, images of one model that resect in the other one
give the similarity: two of them its scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.geometry.camera_matrix import poses_of_model
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.strata import estimate_similarity, nearest_rotation
from thesisrecon.lens import stacked_rows, undistort
from thesisrecon.optimize.least_squares import central_differences
from thesisrecon.optimize.ransac import Budget, draw_samples, resect_calibrated
from thesisrecon.records import Reconstruction, Similarity

MIN_COMMON, MIN_SHARE = 6, 0.6  # common points that must agree, and the smallest share of the common points
SIGMAS = 15.0
"""Largest distance of two estimates of a point, in standard deviations given the cameras; the errors of the
cameras, largest at the ends of a row, come on top."""
SAMPLES = Budget(confidence=0.9999, max_samples=2000)
MAX_CHANCE = 1e-4  # largest expected number of similarities on which as many wrong points agree
MAX_STD = 0.01
"""Largest standard deviation of the rotation in rad and of the relative scale, given the cameras."""

MIN_SEEN, MIN_EXPECTED = 0.05, 30
"""Smallest share of the expected points that images observe of the other model, relative to the share between
images of one model; and number of expected points from which this tells something."""
MAX_TURN, MAX_ZOOM, MAX_VIEWS, MAX_OBSERVATIONS = np.radians(10.0), 1.5, 50, 20000
"""A point is expected in an image if another one sees it from within this angle and ratio of distances; most
images and observations that are counted."""


@dataclass(frozen=True)
class _Points:
    """Points (N, 3) in two models, covariances (N, 3, 3), and whether (N,) both know the depth."""

    a: F64
    b: F64
    cov_a: F64
    cov_b: F64
    whole: B8

    def covariance(self, s: Similarity) -> F64:
        """Covariance (N, 3, 3) of a - s(b)."""
        return np.asarray(self.cov_a + s.scale**2 * s.R @ self.cov_b @ s.R.T)

    def whitened(self, s: Similarity) -> F64:
        """The differences a - s(b) (N, 3) in standard deviations."""
        difference = (self.a - s.apply(self.b))[:, :, None]
        return np.asarray(np.linalg.solve(np.linalg.cholesky(self.covariance(s)), difference)[:, :, 0])

    def distances(self, s: Similarity) -> F64:
        """Distances (N,) of a and s(b) in standard deviations."""
        return np.asarray(np.linalg.norm(self.whitened(s), axis=1))

    def cost(self, s: Similarity) -> float:
        """Truncated quadratic cost of a similarity."""
        return float(np.minimum((self.distances(s) / SIGMAS) ** 2, 1.0).sum())

    def moved(self, s: Similarity, step: F64) -> Similarity:
        """The similarity after a small rotation, scaling and translation (7,) about the points a."""
        centre, size = self.a.mean(axis=0), float(np.linalg.norm(self.a.std(axis=0)))
        turn = np.exp(step[3]) * scipy.spatial.transform.Rotation.from_rotvec(step[:3]).as_matrix()
        t = turn @ (s.t - centre) + centre + size * step[4:]
        return Similarity(float(np.exp(step[3]) * s.scale), np.exp(-step[3]) * turn @ s.R, t)

    def select(self, some: B8) -> _Points:
        """Some of the points."""
        return _Points(self.a[some], self.b[some], self.cov_a[some], self.cov_b[some], self.whole[some])


def joinable(model: Reconstruction, groups: Sequence[list[int]]) -> list[list[int]]:
    """The groups of views that may share enough points with a model, or with another such group."""
    t, reached, left = model.tracks, model.registered.copy(), list(groups)

    def shares_points(views: Sequence[int]) -> bool:
        masks = reached, np.isin(np.arange(t.n_views), views)
        a, b = (np.bincount(t.point_index[m[t.view_index]], minlength=t.n_points) for m in masks)
        common = (a > 0) & (b > 0) & (a + b > 2)
        if common.sum() < MIN_COMMON or ((a > 1) & (b > 1)).sum() >= 3:
            return bool(common.sum() >= MIN_COMMON)
        seen = [np.bincount(t.view_index[(n > 1)[t.point_index]], minlength=t.n_views) for n in (a, b)]
        return sum(int((n[m] >= MIN_COMMON).sum()) for n, m in zip(seen, masks[::-1], strict=True)) >= 2

    while found := next((views for views in left if shares_points(views)), None):
        reached[list(found)] = True
        left.remove(found)
    return [views for views in groups if reached[views[0]]]


def join_all(
    first: Reconstruction, others: Sequence[Reconstruction], rng: np.random.Generator
) -> Reconstruction:
    """Join one model after another with the first, until none of the others can be joined."""
    left = list(others)
    while True:
        tried = [join_models(first, other, rng) for other in left]
        k = next((k for k, joined in enumerate(tried) if joined is not None), None)
        if k is None:
            return first
        first = tried[k] or first
        del left[k]


def join_models(
    first: Reconstruction, second: Reconstruction, rng: np.random.Generator
) -> Reconstruction | None:
    """Join models of the same tracks in the world of the first; None if few points agree, or by chance."""
    numbers = np.flatnonzero(_observed(first, second) & _observed(second, first))
    whole = (first.valid & second.valid)[numbers]
    if len(numbers) < MIN_COMMON or not (first.used.any() and second.used.any()):
        return None
    (a, cov_a), (b, cov_b) = (_estimates(model, numbers) for model in (first, second))
    points = _Points(a, b, cov_a, cov_b, whole)
    trials = [*_hypotheses(points, rng), *_of_resected_images(first, second, rng)]
    if not (best := sorted(trials, key=points.cost)[:5]):
        return None
    found = min((_refined(points, s) for s in best), key=points.cost)
    agree = points.distances(found) < SIGMAS
    if agree.sum() < max(MIN_COMMON, MIN_SHARE * len(agree)):
        return None
    if _log_chance(points, found, agree) > np.log(MAX_CHANCE) or _std(points, found, agree) > MAX_STD:
        return None
    joined = _merged(first, second, found, numbers[agree])
    return None if _contradicted(joined, first.registered) else joined


def _contradicted(joined: Reconstruction, first: B8) -> bool:
    """Whether images miss what they should see of the other model, as in front of two equal facades.

    An image observes most points that lie in it and that another one sees from nearly the same place. If they
    are missing, the places are different (Zach, Irschara and Bischof, CVPR 2008).
    """
    second = joined.registered & ~first
    # The images of one model may be far from each other: half of a few points are taken as seen.
    inside = _seen(joined, first, first) + _seen(joined, second, second) + MIN_EXPECTED * np.array([0.5, 1.0])
    across = _seen(joined, first, second) + _seen(joined, second, first)
    few = across[0] * inside[1] < MIN_SEEN * inside[0] * across[1]
    return bool(across[1] >= MIN_EXPECTED and few)


def _seen(model: Reconstruction, views: B8, by: B8) -> I64:
    """Numbers of points of ``views`` that the images ``by`` observe, and that these should observe."""
    t, total = model.tracks, np.zeros(2, np.int64)
    C = np.zeros((len(views), 3))
    here = np.flatnonzero(model.registered)
    C[here] = -np.linalg.solve(model.P[here, :, :3], model.P[here, :, 3:])[:, :, 0]
    k = np.flatnonzero(model.inlier & views[t.view_index])
    k = k[:: 1 + len(k) // MAX_OBSERVATIONS]
    view, point, X = t.view_index[k], t.point_index[k], model.X[t.point_index[k], :3]
    ray = X - C[view]
    distance = np.linalg.norm(ray, axis=1)
    for v in np.flatnonzero(by)[:: 1 + by.sum() // MAX_VIEWS]:
        x, other = X @ model.P[v, :, :3].T + model.P[v, :, 3], X - C[v]
        ahead = np.maximum(x[:, 2:], 1e-12)
        inside = (x[:, 2] > 0.0) & (np.abs(x[:, :2] / ahead / model.sizes[v] - 0.5) < 0.45).all(axis=1)
        length = np.linalg.norm(other, axis=1)
        near = np.einsum("ni,ni->n", ray, other) > np.cos(MAX_TURN) * distance * length
        near &= np.abs(np.log(length / distance)) < np.log(MAX_ZOOM)
        expected = np.unique(point[inside & near & (view != v)])
        total += np.isin(expected, t.point_index[t.view_index == v]).sum(), len(expected)
    return total


def _hypotheses(points: _Points, rng: np.random.Generator, most: int = 500) -> list[Similarity]:
    """Similarities of three points: of all triples up to ``most``, or of as many random ones."""
    whole = np.flatnonzero(points.whole)
    if len(whole) < 3:
        return []
    chosen = whole[draw_samples(rng, most, len(whole), 3)]
    if scipy.special.comb(len(whole), 3) <= most:
        chosen = np.array(list(combinations(whole, 3)))
    found = list[Similarity]()
    for three in chosen:
        with suppress(ValueError):  # points on one line
            found.append(estimate_similarity(points.b[three], points.a[three]))
    return found


def _of_resected_images(
    first: Reconstruction, second: Reconstruction, rng: np.random.Generator
) -> list[Similarity]:
    """Similarities of the second to the first model by two images of either that the other one resects."""
    poses = [pose[::-1] for pose in _resected(first, second, rng)] + _resected(second, first, rng)
    answer = list[Similarity]()
    for one, two in combinations(poses, 2):
        R = nearest_rotation(one[0][:, :3].T @ one[1][:, :3] + two[0][:, :3].T @ two[1][:, :3])
        here, there = (np.array([-p[:, :3].T @ p[:, 3] for p in ends]) for ends in zip(one, two, strict=True))
        lengths = [float(np.linalg.norm(ends[1] - ends[0])) for ends in (here, there)]
        if min(lengths) > 0.0:
            scale = lengths[0] / lengths[1]
            answer.append(Similarity(scale, R, here.mean(axis=0) - scale * R @ there.mean(axis=0)))
    return answer


def _resected(
    model: Reconstruction, other: Reconstruction, rng: np.random.Generator
) -> list[tuple[F64, F64]]:
    """[R t] in the ``other`` model, and in the model itself, of its images that see enough of the other."""
    assert model.K is not None
    t, answer = model.tracks, list[tuple[F64, F64]]()
    known = other.valid[t.point_index] & ~other.registered[t.view_index]
    for view in np.flatnonzero(model.registered).tolist():
        k = np.flatnonzero(known & (t.view_index == view))
        if len(k) < MIN_COMMON:
            continue
        threshold = SIGMAS * model.sigma_px / float(model.K[view, 0, 0])
        X, rays = other.X[t.point_index[k], :3], _normalized(model, k)
        pose, inlier, _ = resect_calibrated(X, rays, threshold=threshold, budget=SAMPLES, rng=rng)
        if pose is not None and inlier.sum() >= MIN_COMMON:
            R, translation, _ = poses_of_model(model, np.array([view]))
            answer.append((pose, np.column_stack([R[0], translation[0]])))
    return answer


def _normalized(model: Reconstruction, k: I64) -> F64:
    """Observations (N, 2) of a model without calibration and lens."""
    assert model.K is not None
    assert model.distortion is not None
    t = model.tracks
    pixels = np.linalg.solve(model.K[t.view_index[k]], homogenize(t.xy[k])[:, :, None])[:, :2, 0]
    return undistort(np.asarray(pixels, dtype=np.float64), model.distortion[t.view_index[k]])


def _refined(points: _Points, s: Similarity) -> Similarity:
    """The similarity of least squares of the points within a gate that narrows."""
    for factor in (3.0, 2.0, 1.0, 1.0):
        near = points.distances(s) < factor * SIGMAS
        if near.sum() < MIN_COMMON:
            break
        some = points.select(near)

        def residuals(step: F64, s: Similarity = s, some: _Points = some) -> F64:
            return some.whitened(some.moved(s, step)).ravel()

        found = scipy.optimize.least_squares(residuals, np.zeros(7), loss="soft_l1", max_nfev=20)
        s = min((s, some.moved(s, found.x)), key=points.cost)
    return s


def _log_chance(points: _Points, s: Similarity, agree: B8) -> float:
    """Log expected number of similarities on which as many random points, in the extent of all, agree."""
    variance, axes = np.linalg.eigh(points.covariance(s)[agree])
    spread = np.einsum("nik,ij,njk->nk", axes, np.cov(points.a.T), axes)
    gate = 2.0 * SIGMAS * np.sqrt(variance / np.maximum(12.0 * spread, 1e-300))
    # The most telling three are spent on the similarity.
    chance = np.sort(np.log(np.minimum(gate, 1.0)).sum(axis=1))[3:].sum()
    n, k = len(agree), int(agree.sum())
    return float(chance + np.log(scipy.special.comb(n, k)) + np.log(scipy.special.comb(k, 3)))


def _std(points: _Points, s: Similarity, agree: B8) -> float:
    """Largest standard deviation of the rotation (rad) and the relative scale."""
    some = points.select(agree)
    J = central_differences(lambda step: some.whitened(some.moved(s, step)).ravel(), np.zeros(7))
    singular, Vt = np.linalg.svd(J, full_matrices=False)[1:]
    std = np.linalg.norm(Vt.T / np.maximum(singular, 1e-300), axis=1)
    return float(std[:4].max())


def _observed(model: Reconstruction, other: Reconstruction) -> B8:
    """Tracks (N,) that are points of a model, or points of the other one that the model observes once."""
    t = model.tracks
    count = np.bincount(t.point_index[model.registered[t.view_index]], minlength=t.n_points)
    return np.asarray(model.valid | (other.valid & (count == 1)))


def _estimates(model: Reconstruction, numbers: I64) -> tuple[F64, F64]:
    """Points (N, 3) and covariances (N, 3, 3) given the cameras; those seen once at the median depth."""
    assert model.K is not None
    t, place = model.tracks, np.full(model.tracks.n_points, -1)
    place[numbers] = np.arange(len(numbers))
    used = np.flatnonzero(model.used)
    depth = float(
        np.median(np.einsum("ni,ni->n", model.P[t.view_index[used], 2], model.X[t.point_index[used]]))
    )
    alone = ~model.valid[t.point_index]
    k = np.flatnonzero((model.inlier | alone) & model.registered[t.view_index] & (place[t.point_index] >= 0))
    view, point = t.view_index[k], place[t.point_index[k]]
    P, K = model.P[view], model.K[view]
    ray = np.linalg.solve(P[:, :, :3], K @ homogenize(_normalized(model, k))[:, :, None])[:, :, 0]
    X = np.where(model.valid[numbers, None], model.X[numbers, :3], 0.0)
    lone = alone[k]
    X[point[lone]] = depth * ray[lone] - np.linalg.solve(P[lone, :, :3], P[lone, :, 3:])[:, :, 0]
    x = (P @ homogenize(X[point])[:, :, None])[:, :, 0]
    J = (P[:, :2, :3] - (x[:, :2] / x[:, 2:])[:, :, None] * P[:, 2:, :3]) / x[:, 2:, None] / model.sigma_px
    # The depth of a single observation is free: its standard deviation is 10 median depths.
    J = np.concatenate([J, ray[:, None] / (10.0 * depth)], axis=1)
    information = np.zeros((len(numbers), 3, 3))
    np.add.at(information, point, np.swapaxes(J, 1, 2) @ J)
    return X, np.asarray(np.linalg.inv(information), dtype=np.float64)


def _merged(first: Reconstruction, second: Reconstruction, s: Similarity, agree: I64) -> Reconstruction:
    """Both models in the world of the first one; points that do not ``agree`` have inliers of one model."""
    t, new, both = first.tracks, second.registered, np.isin(np.arange(first.tracks.n_points), agree)
    assert second.K is not None
    assert first.K is not None
    assert second.distortion is not None
    assert first.distortion is not None
    turn, t_new, _ = poses_of_model(second, new)
    R = turn @ s.R.T
    P, K = first.P.copy(), first.K.copy()
    P[new] = second.K[new] @ np.concatenate([R, s.scale * t_new[:, :, None] - R @ s.t[:, None]], axis=2)
    K[new] = second.K[new]
    only = second.valid & ~first.valid
    X = np.where(only[:, None], homogenize(s.apply(second.X[:, :3])), first.X)
    of_first = np.where((both & only)[t.point_index], first.registered[t.view_index], first.inlier)
    of_second = np.where((both & ~second.valid)[t.point_index], new[t.view_index], second.inlier)
    inlier = of_first | (of_second & (only | both)[t.point_index])
    lenses = stacked_rows([*first.distortion, *second.distortion])
    distortion = np.where(new[:, None], lenses[len(P) :], lenses[: len(P)])
    registered, valid, reasons = first.registered | new, first.valid | only, ("",) * len(P)
    seen = (registered, valid, inlier, t, first.sizes, first.sigma_px, reasons, K, distortion)
    return Reconstruction("metric", P, X, *seen)
