"""Dense matching of rectified pairs beside OpenCV: ``python -m validation.studies.stereo [-o OUT]``.

Percent of pixels off by more than one and two pixels among those both cameras see, holes filled along the
row; how many are known before the filling and how many of these are off; processor time on one thread, all
methods in turn; memory. OUT gets ``stereo.md``, ``stereo.json`` and a picture a pair. The exit code is 1
where a target is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import tracemalloc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from PIL import Image

from thesisrecon.arrays import F32, U8
from thesisrecon.io.files import write_text
from thesisrecon.records import DisparityMap
from thesisrecon.stereo.scanline import MaximumLikelihoodScanline
from thesisrecon.stereo.semi_global import PUBLISHED, PairMatcher, SemiGlobalMatching
from validation.metrics.record import Metric, markdown_table, summary_table
from validation.references.libraries import one_thread
from validation.references.semi_global import OpenCVSemiGlobal
from validation.scenes.stereo import STEREO_PAIRS, StereoPair, load_stereo_pair

DEFAULT, THESIS, LETTER, SEMI_GLOBAL = "default", "thesis", "thesis, to the letter", "semi-global"
OURS: dict[str, PairMatcher] = {
    DEFAULT: SemiGlobalMatching(),
    THESIS: MaximumLikelihoodScanline(),
    LETTER: MaximumLikelihoodScanline(radius=0, out_of_view=False),
    SEMI_GLOBAL: PUBLISHED,
}
THREE_WAY, HH = "SGBM 3-way", "SGBM HH"
THEIRS = {
    THREE_WAY: OpenCVSemiGlobal(THREE_WAY),
    HH: OpenCVSemiGlobal(HH),
    f"{THREE_WAY}, as called": OpenCVSemiGlobal(THREE_WAY, widened=False),
    f"{HH}, as called": OpenCVSemiGlobal(HH, widened=False),
}
LITERATURE_PCT = {"Tsukuba": 4.1, "Teddy": 14.0, "Cones": 10.5}
"""Scanline dynamic programming, percent off by more than one pixel (Scharstein and Szeliski's table)."""
SEEN_PCT = {"Tsukuba": 3.5, "Teddy": 10.2, "Cones": 4.8}
"""What the better mode of OpenCV reached when the targets were set."""


def match_pair_with(pair: StereoPair) -> dict[str, Callable[[], F32]]:
    """A call for every method that returns its disparities."""

    def ours(matcher: PairMatcher) -> Callable[[], F32]:
        limits = (0, pair.disparities - 1)
        return lambda: matcher.match(pair.left, pair.right, disparity_range=limits).disparity

    def theirs(matcher: OpenCVSemiGlobal) -> Callable[[], F32]:
        return lambda: matcher.match(pair.left, pair.right, pair.disparities)

    calls = {name: ours(matcher) for name, matcher in OURS.items()}
    return calls | {name: theirs(matcher) for name, matcher in THEIRS.items()}


def bad_pixels(disparity: F32, pair: StereoPair, limit_px: float) -> float:
    """Percent of the judged pixels off by more than ``limit_px``, holes filled along the row."""
    filled = DisparityMap(disparity, np.zeros_like(disparity), 0.0).filled()
    error = np.abs(filled - pair.truth)[pair.judged]
    return float(100.0 * np.mean(~(error <= limit_px)))


def check_pair(pair: StereoPair, runs: int) -> tuple[list[Metric], dict[str, F32]]:
    """Rows of one pair, and the disparities of every method."""
    calls = match_pair_with(pair)
    maps = {name: call() for name, call in calls.items()}
    off = {px: {name: bad_pixels(found, pair, px) for name, found in maps.items()} for px in (1.0, 2.0)}
    known = {name: np.isfinite(found) & pair.judged for name, found in maps.items()}
    share = {name: float(100.0 * k[pair.judged].mean()) for name, k in known.items()}
    errors = {name: np.abs(maps[name] - pair.truth)[k] for name, k in known.items()}
    # A method that knows nothing has no errors to speak of.
    wrong = {n: float(100.0 * np.mean(e > 1.0)) if len(e) else None for n, e in errors.items()}
    spread = {n: float(1.4826 * np.median(e)) if len(e) else None for n, e in errors.items()}
    time_ms = processor_time({name: calls[name] for name in (*OURS, THREE_WAY, f"{HH}, as called")}, runs)
    hh = time_ms[f"{HH}, as called"]
    better = {px: min(off[px][name] for name in THEIRS) for px in off}
    aim = min(better[1.0], SEEN_PCT.get(pair.name, np.inf))
    rows = [
        Metric(pair.name, "off by more than 1 px", "%", off[1.0], DEFAULT, aim),
        Metric(pair.name, "off by more than 2 px", "%", off[2.0], DEFAULT, better[2.0]),
        Metric(
            pair.name, "thesis off by more than 1 px", "%", off[1.0], THESIS, LITERATURE_PCT.get(pair.name)
        ),
        Metric(pair.name, "known", "%", share, DEFAULT),
        Metric(pair.name, "known ones off by more than 1 px", "%", wrong, DEFAULT),
        Metric(pair.name, "median error of known ones, as a deviation", "px", spread, DEFAULT),
        Metric(pair.name, "time", "ms", time_ms, DEFAULT, hh),
        Metric(pair.name, "time over SGBM HH", "", {n: t / hh for n, t in time_ms.items()}, DEFAULT, 1.0),
        Metric(pair.name, "memory", "MB", {name: peak_mb(calls[name]) for name in OURS}, DEFAULT),
    ]
    return rows, maps


def processor_time(calls: Mapping[str, Callable[[], F32]], runs: int) -> dict[str, float]:
    """Least processor time in ms of each; they take turns, so that all meet the same machine."""
    one_thread()
    least = dict.fromkeys(calls, float("inf"))
    for _ in range(runs):
        for name, call in calls.items():
            start = time.process_time()
            call()
            least[name] = min(least[name], 1e3 * (time.process_time() - start))
    return least


def peak_mb(call: Callable[[], F32]) -> float:
    """Largest sum of the arrays alive at a time during the call."""
    tracemalloc.start()
    call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def picture(pair: StereoPair, maps: Mapping[str, F32], names: Sequence[str]) -> U8:
    """Truth and maps as heights of colour; below each map what is off by one pixel (yellow) and two (red)."""
    top = [pair.left, _colors(pair.truth, pair.disparities)]
    dark = (pair.left // 3 + 50).astype(np.uint8)
    low = [dark, np.where(pair.judged[..., None], np.uint8(200), dark)]
    for name in names:
        top.append(_colors(maps[name], pair.disparities))
        shown = dark.copy()
        filled = DisparityMap(maps[name], np.zeros_like(maps[name]), 0.0).filled()
        error = np.nan_to_num(np.abs(filled - pair.truth), nan=np.inf)
        shown[pair.judged & (error > 1.0)] = (255, 255, 0)
        shown[pair.judged & (error > 2.0)] = (255, 0, 0)
        low.append(shown)
    return np.concatenate([np.concatenate(top, axis=1), np.concatenate(low, axis=1)])


def _colors(disparity: F32, largest: int) -> U8:
    share = np.nan_to_num(np.clip(disparity / largest, 0.0, 1.0))
    colors = np.stack(
        [np.clip(2.0 * share - 0.5, 0, 1), np.sin(np.pi * share), np.clip(1.2 - 1.6 * share, 0, 1)]
    )
    colors[:, ~np.isfinite(disparity)] = 0.0
    return np.asarray(255.0 * np.moveaxis(colors, 0, 2), dtype=np.uint8)


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, write if asked, and say whether every target was reached."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.stereo", description=__doc__)
    parser.add_argument("-o", "--out", type=Path)
    parser.add_argument("--pairs", nargs="+", default=list(STEREO_PAIRS), choices=STEREO_PAIRS)
    parser.add_argument("--runs", type=int, default=7, help="of every method, the fastest counts")
    wishes = parser.parse_args(arguments)
    tables: list[list[Metric]] = []
    for name in wishes.pairs:
        pair = load_stereo_pair(name)
        if pair is None:
            print(f"{name}: not on this machine (THESISRECON_DATA; scikit-image), left out", flush=True)
            continue
        rows, maps = check_pair(pair, wishes.runs)
        print(f"\n{name}\n\n{markdown_table(rows)}", flush=True)
        tables.append(rows)
        if wishes.out is not None:
            wishes.out.mkdir(parents=True, exist_ok=True)
            shown = picture(pair, maps, (THESIS, DEFAULT, THREE_WAY))
            Image.fromarray(shown).save(wishes.out / f"{name}.png")
    if not tables:
        parser.error("none of these pairs is on this machine")
    every = [metric for rows in tables for metric in rows]
    print("\n" + summary_table(every, ("off by more than 1 px", "time over SGBM HH")))
    if wishes.out is not None:
        write_results(wishes.out, tables)
    return int(any(metric.verdict == "missed" for metric in every))


def write_results(out: Path, tables: Sequence[Sequence[Metric]]) -> None:
    """``stereo.md`` and ``stereo.json`` in ``out``."""
    text = ["# Dense matching of rectified pairs", ""]
    for rows in tables:
        text += [f"## {rows[0].scene}", "", markdown_table(list(rows)), ""]
    told = [{**asdict(metric), "verdict": metric.verdict} for rows in tables for metric in rows]
    write_text(out / "stereo.md", "\n".join(text))
    write_text(out / "stereo.json", json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
