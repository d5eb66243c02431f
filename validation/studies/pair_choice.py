"""What the estimate of the overlap tries and misses: ``python -m validation.studies.pair_choice``.

All pairs of each set are matched and verified by the default pipeline; the estimate then chooses from the
same features as if the set were large. Sets: the photographs as they are, and 30 parts of them at random
places and zooms (:mod:`validation.scenes.crops`).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thesisrecon.config import ImageOptions, preset
from thesisrecon.matching.pair_selection import AllPairs, OverlapEstimate
from thesisrecon.pipeline.reconstruction import reconstruct
from thesisrecon.records import Image, RunResult
from thesisrecon.runtime.executors import Workers
from validation.studies.growth import draw_crops
from validation.metrics.record import Metric, summary_table
from validation.scenes.real import REAL_SCENES, load_fixture_scene, load_real_scene

LEAST_RECALL = 0.97
OURS = "overlap estimate"


@dataclass(frozen=True)
class Choice:
    """How many pairs of a set are possible, tried by the estimate, accepted when all are tried, and missed:
    the verified matches of each pair that would have been accepted and was not tried."""

    scene: str
    possible: int
    tried: int
    accepted: int
    missed: tuple[int, ...]

    @property
    def recall(self) -> float:
        """The share of the accepted pairs that was tried."""
        return 1.0 - len(self.missed) / max(self.accepted, 1)


def choose(scene: str, everything: RunResult, threads: int, estimate: OverlapEstimate) -> Choice:
    """Judge the estimate by a run that tried all pairs."""
    choice = estimate.select(
        [image.name for image in everything.images],
        everything.features,
        map_all=Workers(threads).map_all,
        rng=np.random.default_rng(0),
    )
    tried = {(int(i), int(j)) for i, j in choice.pairs}
    accepted = [pair for pair in everything.pairs if pair.accepted]
    missed = tuple(sorted(pair.inliers for pair in accepted if (pair.i, pair.j) not in tried))
    return Choice(scene, len(everything.pairs), len(tried), len(accepted), missed)


def match_all(images: Sequence[Path] | Sequence[Image], threads: int, max_size_px: int) -> RunResult:
    """The default pipeline over all pairs, up to the matches, photographs reduced to ``max_size_px``."""
    config = replace(preset("default"), pairs=AllPairs(), images=ImageOptions(max_size_px))
    with tempfile.TemporaryDirectory() as place:
        return reconstruct(list(images), Path(place) / "run", config=config, until="matches", threads=threads)


def to_metrics(choice: Choice) -> list[Metric]:
    """The rows of the table."""
    lost = ", ".join(str(n) for n in choice.missed)
    return [
        Metric(choice.scene, "pairs tried", "%", {OURS: 100.0 * choice.tried / choice.possible}, OURS),
        Metric(
            choice.scene,
            "pairs accepted of all",
            "%",
            {OURS: 100.0 * choice.accepted / choice.possible},
            OURS,
        ),
        Metric(
            choice.scene,
            "accepted pairs that were tried",
            "%",
            {OURS: 100.0 * choice.recall},
            OURS,
            100.0 * LEAST_RECALL,
            at_most=False,
            note=f"missed pairs have {lost} verified matches" if lost else "",
        ),
    ]


def main(arguments: list[str] | None = None) -> int:
    """Print the table; 1 where a set misses the bound."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.pair_choice", description=__doc__)
    parser.add_argument("--crops", type=int, nargs="*", default=[1, 2], help="seeds of the sets of parts")
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--long-side", type=int, default=480)
    parser.add_argument("--max-size", type=int, default=1600, help="long side of the photographs, px")
    parser.add_argument("--threads", type=int, default=2)
    wishes = parser.parse_args(arguments)
    scenes = [load_fixture_scene(), *(load_real_scene(name) for name in REAL_SCENES)]
    sets: list[tuple[str, Sequence[Path] | Sequence[Image]]]
    sets = [(scene.name, scene.image_paths) for scene in scenes if scene is not None]
    for seed in wishes.crops:
        crops = draw_crops(wishes.count, wishes.long_side, seed)
        sets.append((f"{wishes.count} parts, seed {seed}", [crop.image for crop in crops]))
    rows: list[Metric] = []
    for name, images in sets:
        everything = match_all(images, wishes.threads, wishes.max_size)
        rows += to_metrics(choose(name, everything, wishes.threads, OverlapEstimate(all_up_to=0)))
        print(f"{name}: done", flush=True)
    print(summary_table(rows, ("pairs accepted of all", "pairs tried", "accepted pairs that were tried")))
    for row in rows:
        if row.note:
            print(f"{row.scene}: {row.note}")
    return int(any(row.verdict == "missed" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
