"""Solvers for F and the division model together, beside sampling k1 with the default estimator of F.

Places p (N, 2) of matches are in half diagonals from the middle; x = (p, 1 + k1 |p|^2) is straight.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import scipy

from thesisrecon.arrays import F64
from thesisrecon.epipolar import division
from thesisrecon.geometry.homogeneous import unit_norm
from thesisrecon.lens import DIVISION
from thesisrecon.optimize.ransac import draw_samples
from thesisrecon.records import Matches
from validation.runs.study import Part
from validation.runs.tables import text_table

SIZE, K1 = np.array([1000.0, 750.0]), -0.4
MOST = 2.0  # largest magnitude of k1 of the candidates
Candidates = tuple[F64, F64]
"""Values of k1 (S,), and F (S, 3, 3)."""


def nine_point(p1: F64, p2: F64) -> Candidates:
    """Linear solver of nine matches or more: a quadratic eigenvalue problem (Fitzgibbon, CVPR 2001)."""
    D1, D2, D3 = _design(p1, p2)
    # (D3 + m D2 + m^2 D1) f = 0 with m = 1 / k1.
    last = np.linalg.lstsq(D1, np.hstack([D2, D3]), rcond=None)[0]
    m, vectors = np.linalg.eig(np.block([[-last], [np.eye(9), np.zeros((9, 9))]]))
    real = (np.abs(m.imag) < 1e-6 * np.abs(m)) & (np.abs(m) > 1.0 / MOST)
    return 1.0 / m[real].real, unit_norm(vectors[9:, real].real.T.reshape(-1, 3, 3))


def eight_point(p1: F64, p2: F64) -> Candidates:
    """Minimal solver with det F = 0 (Kukelova and Pajdla, CVWW 2007).

    F is the cofactors of the 8 x 9 design, polynomials in k1; det F of degree 16 is interpolated on a circle.
    """
    D = _design(p1[:8], p2[:8])
    places = MOST * np.exp(2j * np.pi * np.arange(17) / 17)
    polynomial = np.fft.fft(np.linalg.det(_cofactors(D, places))) / 17
    k = np.roots(polynomial[::-1]) * MOST
    k = k[(np.abs(k.imag) < 1e-4) & (np.abs(k.real) < MOST)].real
    for _ in range(3):  # secant steps: the interpolation has lost digits
        h = 1e-5
        low, middle, high = (np.linalg.det(unit_norm(_cofactors(D, k + s))) for s in (-h, 0.0, h))
        k = k - np.clip(2.0 * h * middle / np.where(high == low, np.inf, high - low), -0.01, 0.01)
    return np.asarray(k), unit_norm(_cofactors(D, k))


def fifteen_point(p1: F64, p2: F64) -> tuple[F64, F64]:
    """Linear solver of 15 matches or more for two lenses (Barreto and Daniilidis, ICCV 2005): k1 (2,) and F.

    The places (p, 1, |p|^2) of both images are related by a matrix (4, 4) of rank 2: its last column is k1 of
    the first image times the third, its last row k1 of the second one times the third.
    """
    x1, x2 = (np.column_stack([p, np.ones(len(p)), np.sum(p**2, axis=1)]) for p in (p1, p2))
    U, S, Vt = np.linalg.svd(np.linalg.svd(_products(x2, x1))[2][-1].reshape(4, 4))
    F = (U[:, :2] * S[:2]) @ Vt[:2]
    k = [float(a[:, 3] @ a[:, 2] / (a[:, 2] @ a[:, 2])) for a in (F, F.T)]
    return np.array(k), unit_norm(F[:3, :3])


def _products(a: F64, b: F64) -> F64:
    return (a[:, :, None] * b[:, None]).reshape(len(a), -1)


def _design(p1: F64, p2: F64) -> tuple[F64, F64, F64]:
    """Matrices (N, 9) of 1, k1 and k1^2 in x2' F x1."""
    x1, x2 = (np.column_stack([p, np.ones(len(p))]) for p in (p1, p2))
    q1, q2 = (np.column_stack([0.0 * p, np.sum(p**2, axis=1)]) for p in (p1, p2))
    return _products(x2, x1), _products(x2, q1) + _products(q2, x1), _products(q2, q1)


def _cofactors(D: tuple[F64, F64, F64], k: Any) -> Any:
    """The vectors (S, 3, 3) of signed 8 x 8 minors, in the null space of the design at each k1."""
    M = D[0] + np.asarray(k)[:, None, None] * (D[1] + np.asarray(k)[:, None, None] * D[2])
    minors = [(-1) ** c * np.linalg.det(np.delete(M, c, axis=2)) for c in range(9)]
    return np.stack(minors, axis=1).reshape(-1, 3, 3)


def sampled(pair: Any, solver: Callable[..., Candidates], size: int, trials: int, rng: Any) -> float:
    """k1 of the candidate of least truncated distances of all matches of a pair, over random samples."""
    scored = [(np.inf, np.nan)]
    for rows in draw_samples(rng, trials, pair.places.shape[1], size):
        k, F = solver(*pair.places[:, rows])
        near = [
            (matrix, np.array([one, 0.0, DIVISION]))
            for one, matrix in zip(k, F, strict=True)
            if abs(one) < MOST
        ]
        scored += [(division._score(matrix, lens, pair), lens[0]) for matrix, lens in near]
    return float(min(scored)[1])


def bent_matches(rng: Any, noise: float, wrong: float, views: int = 12, k1: float = K1) -> list[Matches]:
    """Matches of successive images of one lens (division) that look about in a box, some of them wrong."""
    X, found = rng.uniform([-3, -2, 3], [3, 2, 6], (300, 3)), list[F64]()
    half = np.linalg.norm(SIZE) / 2.0
    for _ in range(views):
        turn = scipy.spatial.transform.Rotation.from_rotvec(rng.normal(0.0, 0.15, 3))
        Y = turn.apply(X - rng.uniform(-1.0, 1.0, 3))
        u = 0.6 * Y[:, :2] / Y[:, 2:]
        p = 2.0 * u / (1.0 + np.sqrt(1.0 - 4.0 * k1 * np.sum(u**2, axis=1, keepdims=True)))
        xy = half * p + (SIZE - 1.0) / 2.0 + rng.normal(0.0, noise, p.shape)
        bad = rng.permutation(len(X))[: round(wrong * len(X))]
        xy[bad] = rng.uniform(0.0, SIZE, (len(bad), 2))
        found.append(xy)
    n, none = np.arange(len(X)), np.zeros((len(X), 2, 2))
    return [
        Matches(v, v + 1, n, n, found[v], found[v + 1], np.ones(len(X), np.float32), none)
        for v in range(0, views, 2)
    ]


def lens_solvers_study(
    noise: Sequence[float] = (0.3, 1.0), wrong: float = 0.3, trials: int = 100, seeds: int = 5
) -> Iterator[Part]:
    """Compare solvers in random samples of six pairs (median of k1, refined) with the sampling of k1."""
    solvers = {"nine-point": (nine_point, 9), "eight-point": (eight_point, 8), "15-point": (_one_lens, 15)}
    lines, sizes = list[list[object]](), np.tile(SIZE.astype(np.int64), (12, 1))
    for px in noise:
        errors: dict[str, list[tuple[float, float, float]]] = {}
        for seed in range(seeds):
            matches = bent_matches(np.random.default_rng(seed), px, wrong)
            pairs = [division._sampled(m, sizes, np.random.default_rng(0)) for m in matches]
            for name in ("sampling of k1 (default)", *solvers):
                began, rng = time.process_time(), np.random.default_rng(seed)
                start, values = np.nan, list(division.VALUES)
                if name in solvers:
                    start = np.nanmedian([sampled(pair, *solvers[name], trials, rng) for pair in pairs])
                    values = [float(start)]
                best = division._best_of(pairs, values, rng)
                seconds, corner = time.process_time() - began, np.nan if best is None else sum(best.k[:2])
                errors.setdefault(name, []).append((abs(start - K1), abs(corner - K1), seconds))
        for name, found in errors.items():
            off = np.median(found, axis=0)
            lines.append([px, name, f"{off[0]:.4f}", f"{off[1]:.4f}", f"{off[2]:.2f}"])
    yield text_table(["noise px", "method", "error of k1", "k1 + k2, refined", "seconds"], lines)


def _one_lens(p1: F64, p2: F64) -> Candidates:
    """The candidates of the 15-point solver for equal lenses: the mean of both."""
    k, F = fifteen_point(p1, p2)
    return k.mean(keepdims=True), F[None]
