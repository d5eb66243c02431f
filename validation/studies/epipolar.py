"""Chapter 5 against theory, ``python -m validation.studies.epipolar``: precision, coverage, degeneracy."""

from __future__ import annotations

import argparse

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar.configuration import Configuration, classify_configuration
from thesisrecon.epipolar.estimation import estimate_fundamental
from thesisrecon.epipolar.frame import PairFrame
from thesisrecon.epipolar.linear import estimate_eight_point
from thesisrecon.epipolar.precision import (
    epipolar_distance_interval,
    epipoles_of,
    fundamental_bound,
    fundamental_covariance,
)
from thesisrecon.epipolar.refinement import refine_reprojection
from thesisrecon.geometry.homogeneous import homogenize
from thesisrecon.geometry.two_view import epipolar_lines, epipoles, sampson_residuals, symmetric_residuals
from thesisrecon.records import FundamentalFit
from validation.metrics.record import Metric, markdown_table
from validation.scenes.two_views import make_two_views

GOLD, DEFAULT = "gold standard", "default"
DISTANCES, EPIPOLES, PIXELS = INTERVALS = ("distances", "epipoles", "epipoles in pixels")
NOISES_PX = (0.1, 0.25, 0.5, 1.0, 2.0)


def gold_standard(xy1: F64, xy2: F64) -> FundamentalFit:
    """The least-reprojection estimate with its noise and covariance."""
    F = refine_reprojection(estimate_eight_point(xy1, xy2), xy1, xy2)
    r = sampson_residuals(F, xy1, xy2)
    sigma, frame = float(np.sqrt(r @ r / (len(r) - 7))), PairFrame.of(xy1, xy2)
    covariance = fundamental_covariance(
        frame, frame.matrix_in_frame(F), frame.points(xy1, xy2), sigma * frame.scale
    )
    return FundamentalFit(F, np.ones(len(xy1), dtype=bool), sigma, covariance)


def check_precision(sigma_px: float, n: int, trials: int) -> list[Metric]:
    """RMS distance over the bound, and coverage of the 95 % intervals of distances and of epipoles."""
    ratios: dict[str, list[float]] = {GOLD: [], DEFAULT: []}
    held: dict[str, dict[str, list[float]]] = {w: {GOLD: [], DEFAULT: []} for w in INTERVALS}
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        scene = make_two_views(Configuration.GENERAL, n, rng)
        bound = fundamental_bound(scene.P1, scene.P2, scene.X, sigma_px=sigma_px)
        xy1, xy2 = (xy + rng.normal(0.0, sigma_px, xy.shape) for xy in (scene.xy1, scene.xy2))
        for name, fit in ((GOLD, gold_standard(xy1, xy2)), (DEFAULT, estimate_fundamental(xy1, xy2))):
            squared = np.mean(symmetric_residuals(fit.F, scene.xy1, scene.xy2) ** 2) / 2.0
            ratios[name].append(float(squared) / bound.rms_distance_px**2)
            off = np.abs(np.sum(homogenize(scene.xy2) * epipolar_lines(fit.F, scene.xy1), axis=1))
            half = epipolar_distance_interval(fit, scene.xy1, scene.xy2)
            truths = list(zip(epipoles_of(fit), epipoles(bound.F), strict=True))
            held[DISTANCES][name].append(float(np.mean(off <= half)))
            held[EPIPOLES][name].append(float(np.mean([e.contains(t) for e, t in truths])))
            held[PIXELS][name].append(float(np.mean([e.contains_xy(t[:2] / t[2]) for e, t in truths])))
    scene_name = f"sigma {sigma_px:g} px, n = {n}"
    rms = {name: float(np.sqrt(np.mean(values))) for name, values in ratios.items()}
    rows = [Metric(scene_name, "RMS distance over bound", "", rms, name, 1.05) for name in rms]
    for what, values in held.items():
        mean = {name: float(np.mean(v)) for name, v in values.items()}
        for name in mean:
            rows.append(Metric(scene_name, f"coverage of {what}", "", mean, name, 0.93, at_most=False))
            rows.append(Metric(scene_name, f"coverage of {what}", "", mean, name, 0.97))
    return rows


def check_degeneracy(sigma_px: float, n: int, trials: int) -> list[Metric]:
    """Share of the scenes of each kind that are named rightly."""
    rows = []
    for kind in Configuration:
        right = 0
        for seed in range(trials):
            rng = np.random.default_rng(seed)
            scene = make_two_views(kind, n, rng)
            xy1, xy2 = (xy + rng.normal(0.0, sigma_px, xy.shape) for xy in (scene.xy1, scene.xy2))
            right += classify_configuration(estimate_eight_point(xy1, xy2), xy1, xy2).kind is kind
        target = 0.99 if kind is Configuration.GENERAL else 0.98
        name = f"named {kind.value} of {trials}"
        rows.append(
            Metric(
                f"sigma {sigma_px:g} px", name, "", {"ours": right / trials}, "ours", target, at_most=False
            )
        )
    return rows


def main() -> int:
    """Print the tables; 1 where a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--points", type=int, nargs="+", default=[30, 100, 1000])
    parser.add_argument("--noise", type=float, nargs="+", default=[0.5, 1.0, 2.0])
    parser.add_argument("--only", choices=["precision", "degeneracy"])
    arguments = parser.parse_args()
    rows: list[Metric] = []
    if arguments.only != "degeneracy":
        for sigma in arguments.noise:
            for n in arguments.points:
                block = check_precision(sigma, n, arguments.trials)
                rows += block
                print(block[0].scene, markdown_table(block), sep="\n\n", flush=True)
    if arguments.only != "precision":
        for sigma in NOISES_PX:
            block = check_degeneracy(sigma, 100, arguments.trials)
            rows += block
            print(block[0].scene, markdown_table(block), sep="\n\n")
    return int(any(row.verdict == "missed" for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
