"""The lens before everything else: the division model of pairs of images (Fitzgibbon, CVPR 2001).

With places p = (xy - middle) / half diagonal the points of a straight image are at p / w, w = 1 + k1 |p|^2 +
k2 |p|^4. The default estimator of F scores the matches of pairs straightened by each of some values of k1:
sampling is as good as minimal solvers (Tzamos, Kocur and Ding, 2024). The best value is refined with all F,
then with k2. If it explains the matches better, w = 1 + k1 s^2 + k2 s^4 of the straight radius s replaces it,
a radial lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from thesisrecon.arrays import B8, F64, I64
from thesisrecon.epipolar.locally_optimised import LocallyOptimisedRansac
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.homogeneous import unit_norm
from thesisrecon.lens import DIVISION, PERSPECTIVE, straight_places, straight_weights
from thesisrecon.optimize.least_squares import (
    DenseSystem,
    huber,
    invert_information,
    noise_from_distances,
    run_levenberg_marquardt,
)
from thesisrecon.records import Matches

VALUES = (0.1, 0.0, -0.1, -0.2, -0.3, -0.45, -0.6, -0.75, -0.9, -1.05, -1.2, -1.35)
"""Values of k1 that are tried: from a pincushion of a tenth to lenses of about 190 degrees."""
BENT = -0.45
"""A value that explains the matches of any lens that bends lines much better than zero does."""
MAX_MAGNIFICATION = 5.0
"""Points beyond this magnification, 60 degrees or more off the axis, wait for the metric stage."""
LEAST = 0.1
"""Smaller lenses are found in the metric stage: two deviations of the prior of k1 at 90 degrees."""
MIN_MATCHES, FEW_MATCHES, MAX_MATCHES = 40, 300, 600
MAX_PAIRS, FEW_PAIRS, MIN_PAIRS = 12, 4, 3
MAX_ROUNDS = 8  # estimates of the noise, which falls while the lens is refined
TABLE = 4096  # radii at which the inverse of the straightening is tabulated


@dataclass(frozen=True)
class DivisionEstimate:
    """A lens ``k`` (3,) in half diagonals, k1, k2 and its base, and the covariance (2, 2) of k1 and k2."""

    k: F64
    covariance: F64

    @property
    def bends(self) -> bool:
        """Whether lines bend more than the metric stage expects of a lens."""
        deviation = float(np.sqrt(self.covariance.sum()))
        return bool(abs(self.k[0] + self.k[1]) > LEAST + 2.0 * deviation)


def straighten(xy: F64, sizes: I64 | F64, k: F64) -> tuple[F64, F64]:
    """Straight positions (N, 2) of pixels, and their magnification (N,), negative beyond the horizon."""
    # `sizes` (2,) or (N, 2) and `k`, (3,) or (N, 3), are those of the image of each pixel.
    middle, half = (np.asarray(sizes) - 1.0) / 2.0, _half_diagonal(sizes)
    places, magnification = straight_places(np.asarray((xy - middle) / half), k)
    return np.asarray(middle + half * places), magnification


def bend(xy: F64, size: I64 | F64, k: F64) -> F64:
    """Pixels (N, 2) of straight positions, the inverse of :func:`straighten`; NaN: none."""
    middle, half = np.asarray((np.asarray(size) - 1.0) / 2.0), float(_half_diagonal(size)[0])
    p = (xy - middle) / half
    wanted = np.linalg.norm(p, axis=-1)

    def straight(radii: F64) -> tuple[F64, F64]:
        places, growth = straighten(middle + half * np.column_stack([radii, 0.0 * radii]), size, k)
        return (places[:, 0] - middle[0]) / half, growth

    # Radii of the image up to the horizon, and a little beyond its corners.
    radii = np.linspace(0.0, 1.2, TABLE)
    reached, growth = straight(radii)
    grows = int(np.argmin(np.append(growth > 0.0, False)))
    r = np.interp(wanted, reached[:grows], radii[:grows], right=np.nan)
    for _ in range(3):
        now, growth = straight(r)
        r = r - (now - wanted) / growth
    shrunk = np.divide(r, wanted, out=np.ones_like(r), where=wanted > 0.0)
    return np.asarray(middle + half * p * shrunk[..., None])


def is_straight(magnification: F64) -> B8:
    """Whether points are far enough from the horizon of the lens to be used as those of a pinhole camera."""
    return np.asarray((magnification > 0.0) & (magnification < MAX_MAGNIFICATION))


def _half_diagonal(sizes: I64 | F64) -> F64:
    return np.asarray(np.linalg.norm(sizes, axis=-1, keepdims=True) / 2.0)


class _Pair(NamedTuple):
    """Places (2, N, 2) of the matches of a pair in half diagonals, and the half diagonals (2,) px."""

    places: F64
    half: F64


def estimate_division(matches: Sequence[Matches], sizes: I64, rng: Generator) -> DivisionEstimate | None:
    """Estimate the lens of pairs of images of one camera; None without enough matches."""
    # Most lenses bend little: other values are tried only where a refined one differs from zero.
    pairs = [_sampled(m, sizes, rng) for m in _chosen_pairs(matches, MAX_PAIRS)]
    return _small_lens(pairs[:FEW_PAIRS], rng) or _best_of(pairs, VALUES, rng)


def is_nearly_straight(matches: Sequence[Matches], sizes: I64, rng: Generator) -> bool:
    """Whether a few matches of few pairs of images of one camera show that its lens bends little."""
    pairs = [_sampled(m, sizes, rng, FEW_MATCHES) for m in _chosen_pairs(matches, FEW_PAIRS)]
    return _small_lens(pairs, rng) is not None


def _small_lens(pairs: Sequence[_Pair], rng: Generator) -> DivisionEstimate | None:
    """The lens refined from zero; None if it may be larger than k1 near zero."""
    # F of a bent lens agrees with the matches of a part of the images, for which zero is a minimum too.
    start = _best_value(pairs, (0.0, BENT), rng)
    if start is None or start[1] != 0.0:
        return None
    found = DivisionEstimate(*_adjusted(start[0], np.array([0.0, 0.0, DIVISION]), 1)[1:])
    small = abs(found.k[0]) < LEAST / 2.0 and found.covariance[0, 0] < LEAST**2 / 4.0
    return found if small else None


def _chosen_pairs(matches: Sequence[Matches], wanted: int) -> list[Matches]:
    """Pairs of many matches, such that few of them share an image."""
    order = sorted((m for m in matches if len(m.xy1) >= MIN_MATCHES), key=lambda m: -len(m.xy1))
    used: dict[int, int] = {}
    chosen = list[Matches]()
    for most in (1, 2, len(order)):
        for m in order:
            if len(chosen) < wanted and m not in chosen and max(used.get(m.i, 0), used.get(m.j, 0)) < most:
                used[m.i], used[m.j] = used.get(m.i, 0) + 1, used.get(m.j, 0) + 1
                chosen.append(m)
    return chosen


def _sampled(m: Matches, sizes: I64, rng: Generator, most: int = MAX_MATCHES) -> _Pair:
    some, ends = rng.permutation(len(m.xy1))[:most], sizes[[m.i, m.j]]
    half = _half_diagonal(ends)
    return _Pair(
        (np.stack([m.xy1[some], m.xy2[some]]) - (ends[:, None] - 1.0) / 2.0) / half[:, None], half[:, 0]
    )


def _best_of(pairs: Sequence[_Pair], values: Sequence[float], rng: Generator) -> DivisionEstimate | None:
    """The value of k1 by which all pairs together have the least truncated distances, refined."""
    start = _best_value(pairs, values, rng)
    if start is None:
        return None
    found = _adjusted(start[0], np.array([start[1], 0.0, DIVISION]), 1)
    found = _adjusted(_searched_again(found, rng), found[1], 2)
    found = _adjusted(_searched_again(found, rng), found[1], 2)
    radial = _adjusted(found[0], _radial_like(found[1]), 2)
    found = min(found, radial, key=_truncated)
    return DivisionEstimate(*found[1:])


def _best_value(
    pairs: Sequence[_Pair], values: Sequence[float], rng: Generator
) -> tuple[list[tuple[_Pair, F64]], float] | None:
    """The value of k1 of least truncated distances of all pairs, with F of those that have one; or None."""
    if len(pairs) < MIN_PAIRS:
        return None
    trials = [[_fundamental(pair, np.array([k, 0.0, DIVISION]), rng) for pair in pairs] for k in values]
    best = int(np.argmin([sum(score for score, _ in trial) for trial in trials]))
    some = [(pair, F) for pair, (_, F) in zip(pairs, trials[best], strict=True) if F.any()]
    return None if len(some) < MIN_PAIRS else (some, values[best])


def _searched_again(found: _Adjusted, rng: Generator) -> list[tuple[_Pair, F64]]:
    """The pairs with F of another search by the refined lens where it explains more matches."""
    answer = list[tuple[_Pair, F64]]()
    for pair, F in found[0]:
        score, other = _fundamental(pair, found[1], rng)
        answer.append((pair, other if score < _score(F, found[1], pair) else F))
    return answer


def _radial_like(k: F64) -> F64:
    """The radial lens of least squares like a division lens, over the image."""
    radii = np.linspace(0.0, 1.0, 101)[1:]
    w, slope = straight_weights(k, radii**2)
    s = radii / w
    seen = (w > 0.0) & (w - 2.0 * radii**2 * slope > 0.0) & (s < 4.0)
    fit = np.linalg.lstsq(s[seen, None] ** [3, 5], (radii - s)[seen], rcond=None)[0]
    return np.append(fit, PERSPECTIVE)


def _truncated(found: _Adjusted) -> float:
    """Mean truncated squared distance of the matches of all pairs, in gates."""
    sizes = [pair.places.shape[1] for pair, _ in found[0]]
    return float(np.average([_score(F, found[1], pair) for pair, F in found[0]], weights=sizes))


def _score(F: F64, k: F64, pair: _Pair) -> float:
    """Mean truncated squared distance of the matches of a pair, in gates."""
    gate = 2.0 * LocallyOptimisedRansac().threshold_px
    return float(np.minimum((_distances(F, k, pair) / gate) ** 2, 1.0).mean())


def _fundamental(pair: _Pair, k: F64, rng: Generator) -> tuple[float, F64]:
    """Mean truncated squared distance of all matches in gates, and F; 1 and 0 without F."""
    places, magnification = straight_places(pair.places, k)
    straight, near = pair.half[:, None, None] * places, is_straight(magnification).all(axis=0)
    if near.sum() < MIN_MATCHES // 2:
        return 1.0, np.zeros((3, 3))
    try:
        F = LocallyOptimisedRansac().estimate(straight[0][near], straight[1][near], rng).F
    except StageFailure:
        return 1.0, np.zeros((3, 3))
    scale = [np.diag([half, half, 1.0]) for half in pair.half]
    F = unit_norm(scale[1] @ F @ scale[0])
    return _score(F, k, pair), F


def _distances(F: F64, k: F64, pair: _Pair) -> F64:
    """Signed Sampson distances px of matches as imaged: of x2' F x1 with x = (p, w(|p|))."""
    return _derivatives(F[None], F, k, pair)[0]


def _derivatives(directions: F64, F: F64, k: F64, pair: _Pair) -> tuple[F64, F64]:
    """Distances (N,) and their derivatives (N, D) along ``directions`` (D, 3, 3) of F."""
    places = pair.places
    w, slope = straight_weights(k, np.sum(places**2, axis=2))
    x1, x2 = np.concatenate([places, w[..., None]], axis=2)
    by_place = 2.0 * slope[..., None] * places
    every = np.concatenate([F[None], directions])
    l1, l2 = x2 @ every, x1 @ every.transpose(0, 2, 1)
    g1 = (l1[..., :2] + l1[..., 2:] * by_place[0]) / pair.half[0]
    g2 = (l2[..., :2] + l2[..., 2:] * by_place[1]) / pair.half[1]
    e, g = np.einsum("nc,dnc->dn", x2, l2), np.concatenate([g1, g2], axis=2)
    length = np.sqrt(np.sum(g[0] ** 2, axis=1) + 1e-300)
    turned = np.einsum("nc,dnc->dn", g[0], g[1:]) / length**2
    return e[0] / length, ((e[1:] - e[0] * turned) / length).T


_State = tuple[list[F64], F64]
"""F of each pair, and k."""
_Adjusted = tuple[list[tuple[_Pair, F64]], F64, F64]


def _adjusted(some: Sequence[tuple[_Pair, F64]], k: F64, unknowns: int) -> _Adjusted:
    """Pairs with F, k and its covariance of the least robust sum of squared distances; F have rank 2."""
    state: _State = [F for _, F in some], k
    noise = np.inf
    for _ in range(MAX_ROUNDS):
        pairs = zip(some, state[0], strict=True)
        distances = [np.abs(_distances(F, state[1], pair)) for (pair, _), F in pairs]
        before, noise = noise, max(noise_from_distances(np.concatenate(distances)), 0.05)
        near = [
            pair._replace(places=pair.places[:, distance < 6.0 * noise])
            for (pair, _), distance in zip(some, distances, strict=True)
        ]
        problem = _Problem(near, 2.0 * noise, unknowns)
        state = run_levenberg_marquardt(
            problem.linearize, problem.moved, problem.cost, state, max_iterations=10, tolerance=1e-5,
            initial_damping=1e-3,
        ).state  # fmt: skip
        if noise > 0.98 * before:
            break
    covariance = np.zeros((2, 2))
    free = slice(-unknowns, None)
    covariance[:unknowns, :unknowns] = (
        noise**2 * invert_information(problem.linearize(state).hessian)[free, free]
    )
    return [(pair, F) for (pair, _), F in zip(some, state[0], strict=True)], state[1], covariance


@dataclass(frozen=True)
class _Problem:
    """All F, seven unknowns each, then the first ``unknowns`` of k, under Huber's loss of width ``delta``."""

    pairs: Sequence[_Pair]
    delta: float
    unknowns: int

    def linearize(self, state: _State) -> DenseSystem:
        size = 7 * len(self.pairs) + self.unknowns
        H, g, cost = np.zeros((size, size)), np.zeros(size), 0.0
        k, steps = state[1], 1e-5 * np.eye(3)[: self.unknowns]
        for n, (pair, F) in enumerate(zip(self.pairs, state[0], strict=True)):
            r, J = _derivatives(_tangent(F), F, k, pair)
            by_k = [
                (_distances(F, k + s, pair) - _distances(F, k - s, pair)) / (2.0 * s.max()) for s in steps
            ]
            J = np.column_stack([J, *by_k])
            rho, weight = huber(r**2, self.delta)
            place = np.append(np.arange(7 * n, 7 * n + 7), np.arange(size - self.unknowns, size))
            H[np.ix_(place, place)] += (J.T * weight) @ J
            g[place] += J.T @ (weight * r)
            cost += 0.5 * float(rho.sum())
        return DenseSystem(cost, H, g)

    def moved(self, state: _State, step: F64) -> _State:
        """F of rank 2 and unit norm after steps along their tangents, and k."""
        moved = list[F64]()
        for F, part in zip(state[0], step[: 7 * len(self.pairs)].reshape(-1, 7), strict=True):
            U, S, Vt = np.linalg.svd(F + np.tensordot(part, _tangent(F), axes=1))
            moved.append(unit_norm((U[:, :2] * S[:2]) @ Vt[:2]))
        return moved, state[1] + np.append(step[7 * len(self.pairs) :], np.zeros(3 - self.unknowns))

    def cost(self, state: _State) -> float:
        squared = (_distances(F, state[1], pair) ** 2 for pair, F in zip(self.pairs, state[0], strict=True))
        return 0.5 * sum(float(huber(s, self.delta)[0].sum()) for s in squared)


def _tangent(F: F64) -> F64:
    """Seven directions (7, 3, 3) of F of rank 2 and unit norm: all u_i v_j' but that of the null vectors."""
    U, S, Vt = np.linalg.svd(F)
    every = np.einsum("ai,jb->ijab", U, Vt)
    ratio = (S[1] * every[0, 0] - S[0] * every[1, 1]) / np.hypot(S[0], S[1])
    others = [every[i, j] for i, j in ((0, 1), (1, 0), (0, 2), (2, 0), (1, 2), (2, 1))]
    return np.stack([ratio, *others])
