"""The thesis' cube study (5.5): estimators of F on noisy projections of a cube.

"The 3D points were perfectly projected onto the pixel planes of the cameras [...] Gaussian noise were added
to the feature points and the epipolar configuration was estimated. The results are presented in table" - here
the surviving text breaks off. Neither numbers nor columns of the table are known, so ours stand alone. Every
pair of the 27 cameras whose common points lie on more than one face takes part: points of one plane leave F
undetermined.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar.precision import fundamental_bound
from thesisrecon.geometry.camera_matrix import compose_camera
from thesisrecon.geometry.two_view import epipoles, symmetric_residuals
from validation.scenes.cube import CubeSequence, make_cube
from validation.studies.epipolar_methods import MATCHED_SIGMAS, METHODS, THRESHOLD_PX, Method
from validation.studies.runner import Part, pick, text_table

NOISES_PX = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0)
OFF_FACE = 20
"""Least number of common points off the face that holds most of them."""
BOUND = "the bound"
CUBE_METHODS = (
    "eight-point, raw pixels, rank 3",
    "eight-point, raw pixels",
    "eight-point, normalised",
    "gradient (5.4), thesis' rows",
    "gradient (5.4), orthonormal",
    "epipolar distance (5.6), thesis' rows",
    "epipolar distance (5.6), orthonormal",
    "gold standard, orthonormal",
    "gold standard, orthonormal, started from the default",
    "Algorithm 2, seven-point search alone",
    "Algorithm 2, gradient",
    "Algorithm 2, epipolar distance",
    "Algorithm 2, gradient, test of both lines",
    "Algorithm 2, gradient, test of the sum",
    "least median of squares",
    "default",
)
"""The thesis' methods and the two that this library adds."""


@dataclass(frozen=True)
class CubePair:
    """Two cameras (3, 4) with calibration K, the common points X (N, 3) and their exact pixels."""

    K: F64
    P1: F64
    P2: F64
    X: F64
    xy1: F64
    xy2: F64


@dataclass(frozen=True)
class CubeRow:
    """One method at one noise over all pairs.

    ``distance_px``, ``worst_px``: median and 90 % quantile over pairs of the RMS distance of the exact
    points to their epipolar lines; ``residual_px``: median over pairs of the same for the noisy points that
    F is estimated from; ``ratio``: RMS over pairs of the distance over the KCR bound; ``epipole_deg``:
    median angle between the rays of the true and the estimated epipole; ``within``: share of pairs with a
    distance below 1 px; ``failures``: pairs without F.
    """

    method: str
    sigma_px: float
    distance_px: float
    worst_px: float
    residual_px: float
    ratio: float
    epipole_deg: float
    within: float
    failures: int


def cube_pairs(cube: CubeSequence) -> list[CubePair]:
    """Return the pairs whose common points do not lie on one face."""
    P = [compose_camera(cube.K, R, -R @ C) for R, C in zip(cube.R, cube.C, strict=True)]
    pairs = []
    for i, j in combinations(range(len(P)), 2):
        both = cube.visible[i] & cube.visible[j]
        on_face = np.bincount(cube.face[both], minlength=3)
        if on_face.sum() - on_face.max() >= OFF_FACE:
            pairs.append(CubePair(cube.K, P[i], P[j], cube.X[both], cube.xy[i, both], cube.xy[j, both]))
    return pairs


def run_cube(
    pairs: Sequence[CubePair], methods: Sequence[Method], noises: Sequence[float] = NOISES_PX
) -> list[CubeRow]:
    """Measure every method, and the bound, at every noise; all methods get the same noise."""
    rows = []
    for sigma in noises:
        bounds = [fundamental_bound(p.P1, p.P2, p.X, sigma_px=sigma) if sigma else None for p in pairs]
        expected = np.array([b.rms_distance_px if b else np.nan for b in bounds])
        for method in methods:
            measured = [
                _measure(method, pair, sigma, np.random.default_rng((seed, round(1e3 * sigma))))
                for seed, pair in enumerate(pairs)
            ]
            rows.append(_row(method.name, sigma, np.array(measured), expected))
        if sigma:
            middle, worst = np.quantile(expected, (0.5, 0.9))
            within, nan = float(np.mean(expected < 1.0)), float("nan")
            rows.append(CubeRow(BOUND, sigma, float(middle), float(worst), nan, 1.0, nan, within, 0))
    return rows


def _measure(method: Method, pair: CubePair, sigma: float, rng: np.random.Generator) -> tuple[float, ...]:
    xy1, xy2 = (xy + rng.normal(0.0, 1.0, xy.shape) * sigma for xy in (pair.xy1, pair.xy2))
    threshold = max(THRESHOLD_PX, MATCHED_SIGMAS * sigma)
    return measure_pair(method.fundamental(xy1, xy2, threshold_px=threshold, seed=0), pair, xy1, xy2)


def measure_pair(F: F64 | None, pair: CubePair, xy1: F64, xy2: F64) -> tuple[float, ...]:
    """Measure one F on one pair.

    Returns
    -------
    tuple of float
        RMS distances of the exact and of the noisy points to their epipolar lines (px) and the larger epipole
        error (degrees); NaN without F.
    """
    if F is None:
        return float("nan"), float("nan"), float("nan")
    distances = (
        float(np.sqrt(np.mean(symmetric_residuals(F, a, b) ** 2) / 2.0))
        for a, b in ((pair.xy1, pair.xy2), (xy1, xy2))
    )
    return *distances, _epipole_error_deg(F, pair)


def _epipole_error_deg(F: F64, pair: CubePair) -> float:
    centres = [np.linalg.svd(P)[2][3] for P in (pair.P1, pair.P2)]
    truths = (pair.P1 @ centres[1], pair.P2 @ centres[0])
    angles = []
    for found, true in zip(epipoles(F), truths, strict=True):
        a, b = (np.linalg.solve(pair.K, e) for e in (found, true))
        sine, cosine = np.linalg.norm(np.cross(a, b)), abs(float(a @ b))
        angles.append(float(np.degrees(np.arctan2(sine, cosine))))
    return max(angles)


def _row(name: str, sigma: float, measured: F64, expected: F64) -> CubeRow:
    good = ~np.isnan(measured[:, 0])
    distance, residual, angle = measured[good].T if good.any() else np.full((3, 1), np.inf)
    ratio = np.sqrt(np.mean((distance / expected[good]) ** 2)) if good.any() else np.inf
    return CubeRow(
        name,
        sigma,
        float(np.median(distance)),
        float(np.quantile(distance, 0.9)),
        float(np.median(residual)),
        float(ratio),
        float(np.median(angle)),
        float(np.sum(distance < 1.0) / len(measured)),
        int(np.sum(~good)),
    )


MEASURES: tuple[tuple[str, Callable[[CubeRow], str]], ...] = (
    (
        "RMS distance of the exact points to their epipolar lines, px: median (90 % quantile) of the pairs",
        lambda r: f"{_short(r.distance_px)} ({_short(r.worst_px)})",
    ),
    ("the same distance over the bound, RMS of the pairs", lambda r: _short(r.ratio)),
    ("direction of the worse epipole, degrees: median of the pairs", lambda r: _short(r.epipole_deg)),
    (
        "RMS distance of the noisy points, which needs no truth, px: median",
        lambda r: _short(r.residual_px),
    ),
    (
        "pairs within 1 px, %",
        lambda r: f"{100.0 * r.within:.0f}" + (f", {r.failures} none" * bool(r.failures)),
    ),
)


def _short(value: float) -> str:
    if np.isnan(value):
        return "-"
    return f"{value:.0e}" if 0.0 < value < 1e-3 else f"{value:.3g}"


def report(rows: Sequence[CubeRow]) -> Iterator[str]:
    """Give a Markdown table of methods by noise for each measure."""
    sigmas = list(dict.fromkeys(r.sigma_px for r in rows))
    names = list(dict.fromkeys(r.method for r in rows))
    cells = {(r.method, r.sigma_px): r for r in rows}
    for title, cell in MEASURES:
        lines = ([n, *(cell(cells[n, s]) if (n, s) in cells else "-" for s in sigmas)] for n in names)
        yield f"{title}\n\n{text_table(['', *(f'{s:g} px' for s in sigmas)], lines)}"


def epipolar_cube_study(
    noise: Sequence[float] = NOISES_PX,
    every: int = 1,
    methods: Sequence[str] = CUBE_METHODS,
) -> Iterator[Part]:
    """Repeat the thesis' cube study (5.5)."""
    names = pick(methods, [m.name for m in METHODS])
    pairs = cube_pairs(make_cube())[::every]
    rows = run_cube(pairs, [m for m in METHODS if m.name in names], noise)
    yield f"{len(pairs)} pairs of 27 cameras"
    yield from report(rows)
