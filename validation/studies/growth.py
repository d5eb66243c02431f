"""How time and memory grow with the number of photographs: ``python -m validation.studies.growth``.

10, 30 and 100 parts of photographs at random places and zooms (:mod:`validation.scenes.crops`) are taken up
to their matches, each set in a process of its own, once with all pairs and once with the estimate of the
overlap; all pairs only up to ``--all-pairs-up-to``. The exponents are slopes of straight lines through the
logarithms; those of time are of processor time, which does not hang on what else the machine does.

By default every ten photographs show a scene of their own, so that each overlaps with as many whatever their
number; with ``--same-scenes`` all sizes show the same ones, and the overlapping pairs grow with the square.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.config import PipelineConfig, preset
from thesisrecon.io.files import write_text
from thesisrecon.matching.pair_selection import AllPairs, OverlapEstimate
from thesisrecon.pipeline.reconstruction import reconstruct
from thesisrecon.records import RunResult
from validation.harness.process import own_cores, run_process
from validation.scenes.crops import Crop, make_crops, make_separate_crops, shared_area
from validation.scenes.real import REAL_SCENES, load_fixture_scene, load_real_scene

METHODS = ("overlap-estimate", "all-pairs")
SHARED = 0.3
"""Crops of one photograph that share as much of the smaller one must be tried."""


@dataclass(frozen=True)
class Growth:
    """One set and method: pairs, seconds by stage, processor seconds of all, peak memory.

    ``pair_list`` (i, j, accepted) are the pairs tried. ``overlapping_tried`` is the share of the pairs known
    to overlap (crops of one photograph) that was tried, None without any, ``recall`` that of the pairs
    accepted when all are tried, None where nobody tried all.
    """

    method: str
    photographs: int
    possible: int
    tried: int
    accepted: int
    features_s: float
    pairs_s: float
    matches_s: float
    cpu_s: float
    overlapping_tried: float | None
    pair_list: tuple[tuple[int, int, bool], ...]
    peak_mb: float = 0.0
    recall: float | None = None


def draw_crops(count: int, long_side: int, seed: int, *, separate: bool = False) -> list[Crop]:
    """The set of this size: parts of the photographs of all scenes that are on this machine.

    ``separate`` : each ten have a scene of their own, else all scenes give to all sizes.
    """
    scenes = [load_fixture_scene(), *(load_real_scene(name) for name in REAL_SCENES)]
    paths = [scene.image_paths for scene in scenes if scene is not None]
    make = make_separate_crops if separate else make_crops
    return make(paths, count, long_side=long_side, rng=np.random.default_rng([seed, count]))


def configure(method: str) -> PipelineConfig:
    """The default pipeline with this choice of pairs, whatever the size of the set."""
    pairs = AllPairs() if method == "all-pairs" else OverlapEstimate(all_up_to=0)
    return replace(preset("default"), pairs=pairs)


def measure_here(wishes: argparse.Namespace, method: str, count: int) -> Growth:
    """Take one set up to its matches in this process, warm."""
    crops = draw_crops(count, wishes.long_side, wishes.seed, separate=not wishes.same_scenes)
    threads = wishes.threads
    config = configure(method)
    with tempfile.TemporaryDirectory() as place:
        # Loading the compiled kernels is no part of what grows.
        few = [crop.image for crop in crops[:4]]
        reconstruct(few, Path(place) / "warm", config=config, until="matches", threads=threads)
        images = [crop.image for crop in crops]
        start = time.process_time()
        result = reconstruct(images, Path(place) / "run", config=config, until="matches", threads=threads)
        cpu_s = time.process_time() - start
    return growth_of(method, crops, result, cpu_s)


def growth_of(method: str, crops: Sequence[Crop], result: RunResult, cpu_s: float) -> Growth:
    """What a run up to its matches says of its crops."""
    # A crop that was left out has no number among the views.
    views = [crops[int(Path(image.name).stem)] for image in result.images]
    n = len(views)
    tried = {(pair.i, pair.j) for pair in result.pairs}
    known = [(i, j) for i in range(n) for j in range(i + 1, n) if shared_area(views[i], views[j]) >= SHARED]
    seconds = result.summary["seconds"]
    return Growth(
        method=method,
        photographs=n,
        possible=n * (n - 1) // 2,
        tried=len(tried),
        accepted=sum(pair.accepted for pair in result.pairs),
        features_s=seconds["features"],
        pairs_s=seconds["pairs"],
        matches_s=seconds["matches"],
        cpu_s=cpu_s,
        overlapping_tried=sum(pair in tried for pair in known) / len(known) if known else None,
        pair_list=tuple((pair.i, pair.j, pair.accepted) for pair in result.pairs),
    )


def recall_of(tried: Growth, everything: Growth) -> float:
    """The share of the pairs accepted among all that the choice tried."""
    pairs = {(i, j) for i, j, _ in tried.pair_list}
    accepted = [(i, j) for i, j, good in everything.pair_list if good]
    return sum(pair in pairs for pair in accepted) / max(len(accepted), 1)


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """The slope of log cost against log size, least squares; NaN where all sizes are the same."""
    if min(sizes) == max(sizes):
        return float("nan")
    return float(np.polyfit(np.log(np.maximum(sizes, 1e-9)), np.log(np.maximum(costs, 1e-9)), 1)[0])


def table(rows: Sequence[Growth]) -> str:
    """The rows and, below each method's, its exponents against the photographs and the accepted pairs."""
    head = (
        "method",
        "photographs",
        "tried of possible",
        "accepted",
        "known overlaps tried",
        "of all accepted, tried",
        "features s",
        "choice s",
        "matching s",
        "processor s",
        "peak MB",
    )
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for r in rows:
        share = f"{r.tried} of {r.possible} ({100 * r.tried / r.possible:.0f} %)"
        shares = (_percent(r.overlapping_tried), _percent(r.recall))
        cells = (r.method, r.photographs, share, r.accepted, *shares)
        numbers = (r.features_s, r.pairs_s, r.matches_s, r.cpu_s)
        lines.append(
            f"| {' | '.join(str(c) for c in cells)} | {' | '.join(f'{v:.1f}' for v in numbers)} "
            f"| {r.peak_mb:.0f} |"
        )
    lines.append("")
    for method in METHODS:
        own = [r for r in rows if r.method == method]
        if len(own) > 1:
            lines.append(exponents(method, own))
    return "\n".join(lines)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"


def exponents(method: str, rows: Sequence[Growth]) -> str:
    """One sentence: how each cost grows."""
    n = [float(r.photographs) for r in rows]
    accepted = [float(r.accepted) for r in rows]
    told = {
        "accepted pairs": accepted,
        "tried pairs": [float(r.tried) for r in rows],
        "features": [r.features_s for r in rows],
        "choice": [r.pairs_s for r in rows],
        "matching": [r.matches_s for r in rows],
        "processor time": [r.cpu_s for r in rows],
        "peak memory": [r.peak_mb for r in rows],
    }
    powers = ", ".join(f"{name} {exponent(n, costs):.2f}" for name, costs in told.items())
    per_pair = exponent(accepted, told["processor time"])
    return f"{method}, powers of N: {powers}. Processor time over accepted pairs: {per_pair:.2f}."


def measure(wishes: argparse.Namespace, method: str, count: int) -> Growth:
    """One set in a process of its own, so that its peak memory is its own."""
    with tempfile.TemporaryDirectory() as place:
        answer = Path(place) / "answer.json"
        command = [sys.executable, "-m", "validation.studies.growth", "--child", method, str(count)]
        command += ["--long-side", str(wishes.long_side), "--threads", str(wishes.threads)]
        command += ["--seed", str(wishes.seed), "-o", str(answer)]
        command += ["--same-scenes"] if wishes.same_scenes else []
        log = Path(place) / "log"
        environment = {"OPENBLAS_NUM_THREADS": "1"}
        process = run_process(command, log=log, cores=own_cores()[: wishes.threads], environment=environment)
        if process.code != 0:
            raise RuntimeError(log.read_text(encoding="utf-8"))
        told: dict[str, Any] = json.loads(answer.read_text(encoding="utf-8"))
    told["pair_list"] = tuple((i, j, good) for i, j, good in told["pair_list"])
    return replace(Growth(**told), peak_mb=process.peak_mb)


def main(arguments: list[str] | None = None) -> int:
    """Measure the sets and print the table."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.growth", description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[10, 30, 100])
    parser.add_argument("--all-pairs-up-to", type=int, default=30)
    parser.add_argument("--long-side", type=int, default=480)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--same-scenes", action="store_true", help="overlaps grow with the square")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", type=Path, help="JSON of the rows")
    parser.add_argument("--child", nargs=2, metavar=("METHOD", "COUNT"), help=argparse.SUPPRESS)
    wishes = parser.parse_args(arguments)
    if wishes.child:
        method, count = wishes.child
        row = measure_here(wishes, method, int(count))
        write_text(wishes.out, json.dumps(asdict(row)))
        return 0
    # Compiling the kernels would take the most memory of all, in whichever process comes first.
    measure(wishes, "overlap-estimate", 4)
    rows = []
    for count in wishes.sizes:
        row = measure(wishes, "overlap-estimate", count)
        if count <= wishes.all_pairs_up_to:
            everything = measure(wishes, "all-pairs", count)
            row = replace(row, recall=recall_of(row, everything))
            rows.append(everything)
        rows.append(row)
        print(f"{count} photographs: {row.cpu_s:.1f} processor s", flush=True)
    rows.sort(key=lambda row: METHODS.index(row.method))
    facts = f"long side {wishes.long_side} px, {wishes.threads} threads, seed {wishes.seed}"
    print(f"\n{facts}, {os.cpu_count()} cores\n")
    print(table(rows))
    if wishes.out is not None:
        write_text(wishes.out, json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
