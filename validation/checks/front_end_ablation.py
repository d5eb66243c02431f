"""What each step of the front end buys: ``python -m validation.checks.front_end_ablation``.

Two tables over pairs (i, i + 2) of fountain-P11 and Herz-Jesus-P8: the thesis' corners and matching with one
step more in each row until they are the default's, and the default with one thing changed. Every row has
the same photographs, estimator of F and verification.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.config import Detector, Matcher, PipelineConfig
from thesisrecon.features import CornerMeasure, HarrisCorners, MultiScaleCorners
from thesisrecon.io.images import read_photographs
from thesisrecon.matching import SeedsAndGrowth, StrengthOfMatch
from thesisrecon.pipeline import detect_features, match_views
from thesisrecon.types import Image
from validation.checks.front_end_pairs import MAX_SIZE_PX, Related
from validation.metrics.epipolar import NONE_PX, rms_epipolar_distance
from validation.scenes.real import load_real_scene
from validation.scenes.real_pairs import SCENES_WITH_CAMERAS, camera_pairs

FrontEnd = tuple[Detector, Matcher]
CORNERS, GROWTH = MultiScaleCorners(), SeedsAndGrowth()


def ladder() -> dict[str, FrontEnd]:
    """From the thesis' method to the default's, one step a row."""
    strength, corners = StrengthOfMatch(), HarrisCorners()
    rows: dict[str, FrontEnd] = {"thesis: 2000 corners, strength of match": (corners, strength)}
    strength = replace(strength, radius_rel=0.26)
    rows["+ search radius 0.26 of the long side, not 0.16"] = corners, strength
    corners = replace(corners, max_corners=3000, selection="spread")
    rows["+ 3000 corners, spread over the image"] = corners, strength
    strength = replace(strength, weight="relative-difference")
    rows["+ relative difference as the weight"] = corners, strength
    strength = replace(strength, least_correlation=0.7, least_strength=0.15)
    rows["+ correlation >= 0.7, strength >= 0.15 per neighbour"] = corners, strength
    strength = replace(strength, align=True)
    rows["+ least-squares alignment"] = corners, strength
    rows["+ 1500 corners of the half size"] = CORNERS, strength
    seeds = replace(GROWTH, growth=False, coarse_first=False, rematch=False)
    rows["seeds without a radius in place of strength of match"] = CORNERS, seeds
    grown = replace(seeds, growth=True)
    rows["+ growth by local affine maps"] = CORNERS, grown
    rows["+ the half size grows first"] = CORNERS, replace(grown, coarse_first=True)
    rows["+ guided rematching: the default"] = CORNERS, GROWTH
    return rows


def one_changed() -> dict[str, FrontEnd]:
    """The default, and the default with one thing off or otherwise."""
    measures = {
        "no surface fit": CornerMeasure(subpixel=False),
        "det - k trace^2": CornerMeasure(formula="harris"),
        "corners of colour": CornerMeasure(colour=True),
    }
    corners = {
        "the strongest corners, not spread": replace(CORNERS, spread=False),
        "4500 corners of one size": replace(CORNERS, full_corners=4500, half_corners=0),
        **{name: replace(CORNERS, measure=measure) for name, measure in measures.items()},
        "seeds of 3 levels, not 5": replace(CORNERS, levels=3),
    }
    matching = {
        "seeds upright only": replace(GROWTH, orientation="upright"),
        "no strength of match on seeds": replace(GROWTH, support="never"),
        "strength of match on seeds always": replace(GROWTH, support="always"),
        "seeds without ratio test": replace(GROWTH, ratio=1.0),
        "no growth": replace(GROWTH, growth=False),
        "growth without the half size first": replace(GROWTH, coarse_first=False),
        "no guided rematching": replace(GROWTH, rematch=False),
        "growth without ratio test": replace(GROWTH, grown_ratio=1.0),
        "growth without the epipolar band": replace(GROWTH, band_rel=1.0),
        "maps of the nearest seed alone": replace(GROWTH, neighbours=1),
        "no least-squares alignment": replace(GROWTH, align=False),
        "alignment of the place alone": replace(GROWTH, affine_std=0.0),
    }
    rows: dict[str, FrontEnd] = {"default": (CORNERS, GROWTH)}
    rows |= {name: (found, GROWTH) for name, found in corners.items()}
    return rows | {name: (CORNERS, variant) for name, variant in matching.items()}


@dataclass
class Bench:
    """Photographs of one scene and the views prepared of them, each with the CPU seconds it took."""

    images: tuple[Image, ...]
    pairs: Mapping[tuple[int, int], np.ndarray[Any, np.dtype[np.float64]]]
    _views: dict[tuple[str, int], tuple[Any, float]] = field(default_factory=dict)

    def view(self, config: PipelineConfig, i: int) -> tuple[Any, float]:
        """A prepared photograph; kept for the rows that prepare it alike."""
        alike = config.matching if isinstance(config.matching, StrengthOfMatch) else ""
        key = (f"{config.features}{alike}", i)
        if key not in self._views:
            begin = time.process_time()
            view = config.matching.prepare(self.images[i], detect_features(config, self.images[i]))
            self._views[key] = view, time.process_time() - begin
        return self._views[key]


@dataclass(frozen=True)
class Row:
    """One front end on all pairs of a scene; CPU seconds, means."""

    found: Sequence[Related]
    image_s: float
    pair_s: float

    @property
    def right(self) -> Sequence[Related]:
        """The pairs whose F is right."""
        return [f for f in self.found if f.right]

    @property
    def verified(self) -> float:
        """Verified matches, mean over the pairs; 0 for a wrong F."""
        return float(np.mean([f.verified for f in self.found]))

    @property
    def sigma_px(self) -> float:
        """Median noise of the inliers of right F's."""
        return float(np.median([f.view.sigma_px for f in self.right] or [np.nan]))


def benches(gap: int, most: int, cache: Path) -> Iterator[tuple[str, Bench]]:
    """The scenes that are on this machine, with ``most`` pairs (i, i + gap) spread over each."""
    for name in SCENES_WITH_CAMERAS:
        scene = load_real_scene(name)
        if scene is None:
            continue
        images = read_photographs(scene.image_paths, max_size_px=MAX_SIZE_PX).images
        chosen = np.unique(np.linspace(0, len(images) - gap - 1, most).round().astype(int))
        truths = [pair.truth for pair in camera_pairs(load_real_scene(name), cache, (gap,))]
        pairs = {(int(i), int(i) + gap): truth for i in chosen if (truth := truths[i]) is not None}
        yield name, Bench(images, pairs)


def measure(bench: Bench, front_end: FrontEnd) -> Row:
    """One front end on the pairs of one scene, with the estimator and the verification of the default."""
    config = replace(PipelineConfig(), features=front_end[0], matching=front_end[1])
    found, pair_s = [], []
    seconds: dict[int, float] = {}
    for (i, j), truth in bench.pairs.items():
        (view1, seconds[i]), (view2, seconds[j]) = bench.view(config, i), bench.view(config, j)
        begin = time.process_time()
        view = match_views(config, view1, view2, (i, j), 0)
        pair_s.append(time.process_time() - begin)
        error = rms_epipolar_distance(view.F, truth) if view.F.any() else NONE_PX
        found.append(Related(view, error))
    return Row(found, float(np.mean(list(seconds.values()))), float(np.mean(pair_s)))


def warm_up(bench: Bench) -> None:
    """Let every kernel compile outside the measurement."""
    pair, truth = next(iter(bench.pairs.items()))
    for front_end in ((HarrisCorners(selection="spread"), StrengthOfMatch(align=True)), (CORNERS, GROWTH)):
        measure(Bench(bench.images, {pair: truth}), front_end)


def table(title: str, rows: Mapping[str, FrontEnd], scenes: Mapping[str, Bench]) -> str:
    """A row for each front end; numbers of the scenes beside each other."""
    head = f"| {title}: {', '.join(scenes)} | verified | F right | sigma, px | s per image | s per pair |"
    lines = [head, "| --- |" + " --- |" * 5]
    for name, front_end in rows.items():
        found = [measure(bench, front_end) for bench in scenes.values()]
        verified = ", ".join(f"{row.verified:.0f}" for row in found)
        right = f"{sum(len(row.right) for row in found)} of {sum(len(row.found) for row in found)}"
        sigma = ", ".join(f"{row.sigma_px:.3f}" for row in found)
        seconds = [f"{np.mean([getattr(row, of) for row in found]):.2f}" for of in ("image_s", "pair_s")]
        lines.append(f"| {name} | {verified} | {right} | {sigma} | {' | '.join(seconds)} |")
        print(lines[-1], file=sys.stderr, flush=True)
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Print both tables; 3 where there are no photographs."""
    parser = argparse.ArgumentParser(
        prog="python -m validation.checks.front_end_ablation", description=__doc__
    )
    parser.add_argument("--gap", type=int, default=2)
    parser.add_argument("--most", type=int, default=4, help="pairs of each scene")
    default = Path(tempfile.gettempdir()) / "thesisrecon-matches"
    parser.add_argument("--cache", type=Path, default=default, help="folder that keeps the SIFT matches")
    wishes = parser.parse_args(arguments)
    scenes = dict(benches(wishes.gap, wishes.most, wishes.cache))
    if not scenes:
        print("the photographs are not on this machine (THESISRECON_DATA)", file=sys.stderr)
        return 3
    warm_up(next(iter(scenes.values())))
    print(table("one step more", ladder(), scenes))
    print()
    print(table("one thing changed", one_changed(), scenes))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
