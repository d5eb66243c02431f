"""F of real photographs beside OpenCV, COLMAP and PoseLib, ``python -m validation.studies.epipolar_real``.

Three sets, each method run with several seeds. ``kusvod2``: errors on hand-made correspondences. ``strecha``:
errors on noise-free correspondences of the true cameras. ``adelaide``: inliers against labels. An error is
the RMS distance to the epipolar lines over both images. The targets are the best of OpenCV's two USAC
variants, COLMAP and PoseLib, PoseLib, and the reference with the best F1: each with whichever of its
settings is better.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar.degeneracy import assess_degeneracy
from validation.metrics.epipolar import precision_recall, rms_epipolar_distance, rms_sampson_distance
from validation.metrics.record import Metric, markdown_table
from validation.references.fundamental import OURS, SOLVERS, Estimate, estimate_with
from validation.references.libraries import one_thread
from validation.scenes.real import load_real_scene
from validation.scenes.real_pairs import (
    SCENES_WITH_CAMERAS,
    RealPair,
    adelaide_pairs,
    camera_pairs,
    kusvod2_pairs,
)

Runs = dict[str, list[list[Estimate]]]
THRESHOLD_PX = 1.0
FAILED_PX = 5.0
STRONG, STRONGEST = ("USAC_ACCURATE", "USAC_MAGSAC", "COLMAP", "PoseLib"), ("PoseLib",)
"""References to beat on kusvod2, and on the scenes with cameras."""


def run_pair(
    pair: RealPair, methods: Iterable[str], *, seeds: int, threshold_px: float
) -> dict[str, list[Estimate]]:
    """Every method on one pair, once a seed."""
    return {
        method: [
            estimate_with(method, pair.xy1, pair.xy2, threshold_px=threshold_px, seed=seed)
            for seed in range(seeds)
        ]
        for method in methods
    }


def least(values: dict[str, float], rivals: tuple[str, ...]) -> float | None:
    """The smallest number of the methods whose names begin like a rival, None where none ran."""
    return min((value for method, value in values.items() if method.startswith(rivals)), default=None)


def errors_of(
    runs: dict[str, list[Estimate]], pair: RealPair, error: Callable[[F64 | None, F64], float]
) -> dict[str, F64]:
    """Errors (seeds,) of every method on the pair's truth."""
    assert pair.truth is not None
    return {name: np.array([error(e.F, pair.truth) for e in found]) for name, found in runs.items()}


def error_rows(
    scene: str,
    pairs: list[str],
    errors: list[dict[str, F64]],
    rivals: tuple[str, ...],
    limits: tuple[float, ...],
) -> list[Metric]:
    """A row of medians for each pair; over all runs the median and the number beyond each limit, judged."""
    medians = [{m: float(np.median(e)) for m, e in row.items()} for row in errors]
    rows = [Metric(scene, pair, "px", row, OURS) for pair, row in zip(pairs, medians, strict=True)]
    every = {method: np.concatenate([row[method] for row in errors]) for method in errors[0]}
    n = len(next(iter(every.values())))
    middle = {method: float(np.median(e)) for method, e in every.items()}
    rows.append(Metric(scene, "**median of all runs**", "px", middle, OURS, least(middle, rivals)))
    over_pairs = {m: float(np.median([row[m] for row in medians])) for m in middle}
    rows.append(
        Metric(scene, "**median of the pairs' medians**", "px", over_pairs, OURS, least(over_pairs, rivals))
    )
    for limit in limits:
        beyond = {method: float(np.sum(e > limit)) for method, e in every.items()}
        name = f"**runs > {limit:g} px**, of {n}"
        rows.append(Metric(scene, name, "", beyond, OURS, least(beyond, rivals)))
    return rows


def check_kusvod2(pairs: Iterable[RealPair], methods: list[str], seeds: int) -> list[Metric]:
    """Errors on the hand-made correspondences of the pairs."""
    labels: list[str] = []
    errors: list[dict[str, F64]] = []
    sampson: list[dict[str, F64]] = []
    sure = 0
    for pair in pairs:
        assert pair.truth is not None
        runs = run_pair(pair, methods, seeds=seeds, threshold_px=THRESHOLD_PX)
        labels.append(f"{pair.name} ({len(pair.xy1)} matches)")
        errors.append(errors_of(runs, pair, rms_epipolar_distance))
        sampson.append(errors_of(runs, pair, rms_sampson_distance))
        sure += sum(called_sure(e, pair, FAILED_PX) for e in runs.get(OURS, []))
    if not labels:
        return []
    rows = error_rows("kusvod2", labels, errors, STRONG, (FAILED_PX,))
    for label, row in zip(labels, errors, strict=True):
        failed = {method: float(np.sum(e > FAILED_PX)) for method, e in row.items()}
        if any(failed.values()):
            rows.append(Metric("kusvod2", f"runs > {FAILED_PX:g} px of {label.split()[0]}", "", failed, OURS))
    middle = {m: float(np.median(np.concatenate([row[m] for row in sampson]))) for m in methods}
    rows.append(Metric("kusvod2", "median Sampson distance of all runs", "px", middle, OURS))
    if OURS in methods:
        rows.append(
            Metric("kusvod2", f"runs > {FAILED_PX:g} px and called sure", "", {OURS: float(sure)}, OURS)
        )
    return rows


def called_sure(estimate: Estimate, pair: RealPair, limit_px: float) -> bool:
    """Whether F is off by more than the limit and yet the matches are said to determine it."""
    assert pair.truth is not None
    if estimate.fit is None or rms_epipolar_distance(estimate.F, pair.truth) <= limit_px:
        return False
    rng = np.random.default_rng(0)
    return assess_degeneracy(estimate.fit, pair.xy1, pair.xy2, rng=rng).determined


def check_cameras(
    pairs: Iterable[RealPair], methods: list[str], seeds: int, *, verbose: bool
) -> list[Metric]:
    """Errors on noise-free correspondences of the true cameras, of the pairs of one scene."""
    labels: list[str] = []
    errors: list[dict[str, F64]] = []
    sure = 0
    scene = ""
    for pair in pairs:
        assert pair.truth is not None
        scene = pair.name.split()[0]
        runs = run_pair(pair, methods, seeds=seeds, threshold_px=THRESHOLD_PX)
        labels.append(f"{pair.name.split()[1]} ({len(pair.xy1)} matches)")
        errors.append(errors_of(runs, pair, rms_epipolar_distance))
        sure += sum(called_sure(e, pair, 1.0) for e in runs.get(OURS, []))
    if not labels:
        return []
    rows = error_rows(scene, labels, errors, STRONGEST, (1.0, 3.0))
    for limit in (1.0, 3.0):
        off = {m: float(sum(np.median(row[m]) > limit for row in errors)) for m in methods}
        name = f"**pairs off by > {limit:g} px**, of {len(labels)}"
        rows.append(Metric(scene, name, "", off, OURS, least(off, STRONGEST)))
    if OURS in methods:
        rows.append(Metric(scene, "runs > 1 px and called sure", "", {OURS: float(sure)}, OURS, 0.0))
    return rows if verbose else rows[len(labels) :]


def check_adelaide(methods: list[str], seeds: int) -> list[Metric]:
    """Precision and recall of the inliers, means over the seeds.

    The target is the reference with the largest F1: who calls every match an inlier has the best recall.
    """
    rows = []
    for pair in adelaide_pairs():
        assert pair.right is not None
        for threshold in (1.0, 2.0):
            runs = run_pair(pair, methods, seeds=seeds, threshold_px=threshold)
            shares = {
                m: np.mean([precision_recall(e.inliers, pair.right) for e in found], axis=0)
                for m, found in runs.items()
            }
            f1 = {m: float(2.0 * v.prod() / max(v.sum(), 1e-9)) for m, v in shares.items()}
            others = [m for m in methods if m != OURS]
            best = max(others, key=lambda m: f1[m]) if others else None
            for what, values in (
                ("precision", {m: float(v[0]) for m, v in shares.items()}),
                ("recall", {m: float(v[1]) for m, v in shares.items()}),
                ("F1", f1),
            ):
                name, note = f"{pair.name}, {what} at {threshold:g} px", best or ""
                target = values[best] if best else None
                rows.append(Metric("adelaide", name, "", values, OURS, target, at_most=False, note=note))
    return rows


def blocks(a: argparse.Namespace) -> Iterator[list[Metric]]:
    """The rows of each set asked for, empty where its photographs are not on this machine."""
    if a.only in (None, "kusvod2"):
        names = tuple(a.pairs) if a.pairs else None
        yield check_kusvod2(kusvod2_pairs(a.cache, names, mutual=a.mutual), a.methods, a.seeds)
    for scene in SCENES_WITH_CAMERAS if a.only in (None, "strecha") else ():
        yield check_cameras(
            camera_pairs(load_real_scene(scene), a.cache), a.methods, a.seeds, verbose=a.verbose
        )
    if a.only in (None, "adelaide"):
        yield check_adelaide(a.methods, a.seeds)


def main() -> int:
    """Print the tables; 1 where a target is missed, 3 where there are no photographs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=["kusvod2", "strecha", "adelaide"])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--methods", nargs="+", choices=list(SOLVERS), default=list(SOLVERS))
    parser.add_argument("--pairs", nargs="+", help="some pairs of kusvod2 by name")
    parser.add_argument("--mutual", action="store_true", help="kusvod2: matches nearest to each other")
    parser.add_argument("--verbose", action="store_true", help="every pair of the scenes with cameras")
    default = Path(tempfile.gettempdir()) / "thesisrecon-matches"
    parser.add_argument("--cache", type=Path, default=default, help="folder that keeps the SIFT matches")
    arguments = parser.parse_args()
    one_thread()
    rows: list[Metric] = []
    for found in blocks(arguments):
        rows += found
        if found:
            title = f"## {found[0].scene}, {arguments.seeds} seeds"
            print(title, markdown_table(found), "", sep="\n\n", flush=True)
    if not rows:
        print("the photographs are not on this machine (THESISRECON_DATA)", file=sys.stderr)
        return 3
    return int(any(row.verdict == "missed" for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
