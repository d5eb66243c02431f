"""Whether degenerate pairs are named, and a wrong F is not called sure.

``python -m validation.studies.epipolar_certainty`` prints the tables. An F is right where the RMS distance of
exact correspondences to its epipolar lines is at most 1 px, and sure where the certainty of its fit says that
the matches determine it.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thesisrecon.arrays import F64
from thesisrecon.epipolar.configuration import Configuration, classify_configuration
from thesisrecon.epipolar.degeneracy import assess_degeneracy
from thesisrecon.epipolar.estimation import estimate_fundamental
from thesisrecon.epipolar.linear import estimate_eight_point
from thesisrecon.errors import StageFailure
from thesisrecon.geometry.camera_matrix import compose_camera
from thesisrecon.geometry.two_view import symmetric_residuals
from validation.metrics.record import Metric, markdown_table
from validation.scenes.facade import FacadeMaker
from validation.scenes.real import Scene, load_fixture_scene, load_real_scene
from validation.scenes.real_pairs import exact_correspondences, match_photographs
from validation.scenes.two_views import make_two_views

RIGHT_PX = 1.0
NOISES_PX = (0.1, 0.25, 0.5, 1.0, 2.0)
SIZE = (1280.0, 960.0)
OURS = "ours"
LEAST_TRUTH = 20
CELLS = ("right and sure", "right and unsure", "wrong and unsure", "wrong and sure", "refused")


@dataclass(frozen=True)
class JudgedPair:
    """Matches ``xy1``, ``xy2`` (N, 2) px and exact correspondences ``exact1``, ``exact2`` (M, 2) px."""

    group: str
    xy1: F64
    xy2: F64
    exact1: F64
    exact2: F64


def named_rightly(kind: Configuration, sigma_px: float, n: int, trials: int, *, wrong: float) -> float:
    """Share of scenes of ``kind`` that are named so; with ``wrong`` matches after the robust estimate."""
    right = 0
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        scene = make_two_views(kind, n, rng)
        xy1, xy2 = (xy + rng.normal(0.0, sigma_px, xy.shape) for xy in (scene.xy1, scene.xy2))
        if wrong == 0.0:
            found = classify_configuration(estimate_eight_point(xy1, xy2), xy1, xy2)
        else:
            chosen = rng.random(n) < wrong
            xy2[chosen] = rng.uniform((0.0, 0.0), SIZE, (int(chosen.sum()), 2))
            # The threshold of a user who knows that the noise is large.
            fit = estimate_fundamental(xy1, xy2, threshold_px=max(1.0, 2.0 * sigma_px), seed=seed)
            found = classify_configuration(fit.F, xy1, xy2, inliers=fit.inliers)
        right += found.kind is kind
    return right / trials


def check_degeneracy(n: int, trials: int, *, wrong: float) -> list[Metric]:
    """A row for each kind and noise: the share that is named rightly."""
    rows = []
    for kind in Configuration:
        target = 0.99 if kind is Configuration.GENERAL else 0.98
        for sigma_px in NOISES_PX:
            value = named_rightly(kind, sigma_px, n, trials, wrong=wrong)
            title = f"n = {n}, {100.0 * wrong:.0f} % wrong"
            name = f"named {kind.value}, {sigma_px:g} px, of {trials}"
            # With fewer points than the target is for, the numbers are reported only.
            bound = target if n >= 100 else None
            rows.append(Metric(title, name, "", {OURS: value}, OURS, bound, at_most=False))
    return rows


def facade_pairs(scenes: int) -> Iterator[JudgedPair]:
    """Facades of the whole range, apart by how many right matches stand off the plane."""
    for seed in range(scenes):
        rng = np.random.default_rng(seed)
        facade = FacadeMaker.drawn(rng).make(rng)
        group = "facades, 15 or more matches off the wall" if facade.off_plane >= 15 else "facades, flat"
        yield JudgedPair(group, facade.xy1, facade.xy2, facade.exact1, facade.exact2)


def photograph_pairs(name: str, cache: Path, *, ratios: tuple[float, ...]) -> Iterator[JudgedPair]:
    """Pairs (i, i + 1) to (i, i + 4) of a scene with cameras, SIFT matches of one direction."""
    scene = load_fixture_scene(name) if name == "courtyard" else load_real_scene(name)
    if scene is None:
        print(f"{name}: its photographs are not on this machine, left out", flush=True)
        return
    for i in range(len(scene.image_paths)):
        for gap in range(1, 5):
            if i + gap < len(scene.image_paths):
                yield from _pairs_of(scene, i, i + gap, cache, ratios)


def _pairs_of(scene: Scene, i: int, j: int, cache: Path, ratios: tuple[float, ...]) -> Iterator[JudgedPair]:
    assert scene.K is not None
    assert scene.R is not None
    assert scene.C is not None
    paths = (scene.image_paths[i], scene.image_paths[j])
    P1, P2 = (compose_camera(scene.K[v], scene.R[v], -scene.R[v] @ scene.C[v]) for v in (i, j))
    for ratio in ratios:
        xy1, xy2 = match_photographs(paths, cache, ratio=ratio, mutual=False)
        exact = exact_correspondences(P1, P2, xy1, xy2)
        if len(exact) >= LEAST_TRUTH:
            yield JudgedPair(f"{scene.name}, i + {j - i}", xy1, xy2, exact[:, :2], exact[:, 2:])


def judge_pairs(pairs: Iterable[JudgedPair], seeds: int) -> tuple[dict[str, Counter[str]], list[float]]:
    """How often each group ended in which of ``CELLS``; ratios of the judgement's time to the fit's."""
    cells: dict[str, Counter[str]] = {}
    ratios = []
    for pair in pairs:
        counter = cells.setdefault(pair.group, Counter())
        for seed in range(seeds):
            start = time.process_time()
            try:
                fit = estimate_fundamental(pair.xy1, pair.xy2, seed=seed)
            except StageFailure:
                counter["refused"] += 1
                continue
            middle = time.process_time()
            degeneracy = assess_degeneracy(fit, pair.xy1, pair.xy2, rng=np.random.default_rng(seed))
            ratios.append((time.process_time() - middle) / max(middle - start, 1e-9))
            distances = symmetric_residuals(fit.F, pair.exact1, pair.exact2)
            right = np.sqrt(np.mean(distances**2) / 2.0) <= RIGHT_PX
            sure = "sure" if degeneracy.determined else "unsure"
            counter[f"{'right' if right else 'wrong'} and {sure}"] += 1
    return cells, ratios


def certainty_table(cells: dict[str, Counter[str]]) -> str:
    """The counts of every group as a Markdown table."""
    lines = [f"| | {' | '.join(CELLS)} |", f"| --- |{' --- |' * len(CELLS)}"]
    for group, counter in cells.items():
        lines.append(f"| {group} | {' | '.join(str(counter[cell]) for cell in CELLS)} |")
    return "\n".join(lines)


def certainty_metrics(cells: dict[str, Counter[str]]) -> list[Metric]:
    """Wrong and called sure, of all wrong; right and called unsure, of the ordinary pairs."""
    everything = sum(cells.values(), Counter())
    ordinary = sum((c for group, c in cells.items() if group.endswith(("i + 1", "i + 2"))), Counter())
    rows = []
    for name, counter, first, second, target in (
        ("wrong ones called sure, of all pairs", everything, "wrong and sure", "wrong and unsure", 0.01),
        (
            "right ones called unsure, of (i, i + 1) and (i, i + 2)",
            ordinary,
            "right and unsure",
            "right and sure",
            0.05,
        ),
    ):
        of = counter[first] + counter[second]
        if of:
            rows.append(Metric("certainty", f"{name} ({of})", "", {OURS: counter[first] / of}, OURS, target))
    return rows


def main() -> int:
    """Print the tables; 1 where a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--points", type=int, nargs="+", default=[30, 100, 1000])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--facades", type=int, default=300)
    parser.add_argument("--ratios", type=float, nargs="+", default=[0.8, 0.85])
    default = Path(tempfile.gettempdir()) / "thesisrecon-matches"
    parser.add_argument("--cache", type=Path, default=default, help="folder that keeps the SIFT matches")
    parser.add_argument("--only", choices=["degeneracy", "certainty"])
    wishes = parser.parse_args()
    rows: list[Metric] = []
    if wishes.only != "certainty":
        for n in wishes.points:
            for wrong in (0.0, 0.3):
                block = check_degeneracy(n, wishes.trials, wrong=wrong)
                rows += block
                print(block[0].scene, markdown_table(block), sep="\n\n", flush=True)
    if wishes.only != "degeneracy":
        cells, ratios = judge_pairs(facade_pairs(wishes.facades), 1)
        for name in ("fountain-P11", "Herz-Jesus-P8", "courtyard"):
            more, other = judge_pairs(
                photograph_pairs(name, wishes.cache, ratios=tuple(wishes.ratios)), wishes.seeds
            )
            cells, ratios = cells | more, ratios + other
        block = certainty_metrics(cells)
        rows += block
        print(certainty_table(cells), markdown_table(block), sep="\n\n")
        print(f"\ntime of the judgement over that of the estimate: median {np.median(ratios):.2f}")
    return int(any(row.verdict == "missed" for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
