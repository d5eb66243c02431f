"""Dense matching of rectified pairs beside OpenCV.

Percent of pixels off by more than one and two pixels among those that both cameras see, holes filled along
the row; the share of known pixels and of errors among them; processor time on one thread; memory.
"""

from __future__ import annotations

import sys
import tracemalloc
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from thesisrecon.arrays import F32, U8
from thesisrecon.records import DisparityMap
from thesisrecon.stereo.scanline import MaximumLikelihoodScanline
from thesisrecon.stereo.semi_global import PUBLISHED, SemiGlobalMatching
from validation.metrics.record import Metric, summary_table
from validation.references.libraries import one_thread
from validation.references.semi_global import OpenCVSemiGlobal
from validation.scenes.stereo import STEREO_PAIRS, StereoPair, load_stereo_pair
from validation.studies.measuring import least_seconds
from validation.studies.runner import Part, Rows, pick

DEFAULT, THESIS, LETTER, SEMI_GLOBAL = "default", "thesis", "thesis, to the letter", "semi-global"
OURS: dict[str, SemiGlobalMatching | MaximumLikelihoodScanline] = {
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
"""Scanline dynamic programming, percent off by more than one pixel (table of Scharstein and Szeliski)."""
SEEN_PCT = {"Tsukuba": 3.5, "Teddy": 10.2, "Cones": 4.8}
"""Result of the better OpenCV mode when the bounds were set."""


def match_pair_with(pair: StereoPair) -> dict[str, Callable[[], F32]]:
    """Return a call for every method that gives its disparities."""

    def ours(matcher: SemiGlobalMatching | MaximumLikelihoodScanline) -> Callable[[], F32]:
        limits = (0, pair.disparities - 1)
        return lambda: matcher.match(pair.left, pair.right, disparity_range=limits).disparity

    def theirs(matcher: OpenCVSemiGlobal) -> Callable[[], F32]:
        return lambda: matcher.match(pair.left, pair.right, pair.disparities)

    calls = {name: ours(matcher) for name, matcher in OURS.items()}
    return calls | {name: theirs(matcher) for name, matcher in THEIRS.items()}


def bad_pixels(disparity: F32, pair: StereoPair, limit_px: float) -> float:
    """Return the percentage of judged pixels off by more than ``limit_px``, holes filled along the row."""
    filled = DisparityMap(disparity, np.zeros_like(disparity), 0.0).filled()
    error = np.abs(filled - pair.truth)[pair.judged]
    return float(100.0 * np.mean(~(error <= limit_px)))


def check_pair(pair: StereoPair, repeats: int) -> tuple[list[Metric], dict[str, F32]]:
    """Measure every method on one pair; also return its disparities."""
    calls = match_pair_with(pair)
    maps = {name: call() for name, call in calls.items()}
    off = {px: {name: bad_pixels(found, pair, px) for name, found in maps.items()} for px in (1.0, 2.0)}
    known = {name: np.isfinite(found) & pair.judged for name, found in maps.items()}
    errors = {name: np.abs(maps[name] - pair.truth)[k] for name, k in known.items()}
    one_thread()
    seconds = least_seconds(
        {name: calls[name] for name in (*OURS, THREE_WAY, f"{HH}, as called")}, repeats, warm=False
    )
    time_ms = {name: 1e3 * cpu for name, (cpu, _) in seconds.items()}
    hh = time_ms[f"{HH}, as called"]
    better = {px: min(off[px][name] for name in THEIRS) for px in off}
    rows, thesis = Rows(pair.name, DEFAULT), Rows(pair.name, THESIS)
    rows.add(
        "off by more than 1 px", off[1.0], "%", at_most=min(better[1.0], SEEN_PCT.get(pair.name, np.inf))
    )
    rows.add("off by more than 2 px", off[2.0], "%", at_most=better[2.0])
    thesis.add("thesis off by more than 1 px", off[1.0], "%", at_most=LITERATURE_PCT.get(pair.name))
    rows += thesis
    rows.add("known", {n: float(100.0 * k[pair.judged].mean()) for n, k in known.items()}, "%")
    # A method without known pixels has no error.
    wrong = {n: float(100.0 * np.mean(e > 1.0)) if len(e) else None for n, e in errors.items()}
    spread = {n: float(1.4826 * np.median(e)) if len(e) else None for n, e in errors.items()}
    rows.add("known ones off by more than 1 px", wrong, "%")
    rows.add("median error of known ones, as a standard deviation", spread, "px")
    rows.add("time", time_ms, "ms", at_most=hh)
    rows.add("time over SGBM HH", {n: t / hh for n, t in time_ms.items()}, at_most=1.0)
    rows.add("memory", {name: peak_mb(calls[name]) for name in OURS}, "MB")
    return rows, maps


def peak_mb(call: Callable[[], F32]) -> float:
    """Return the largest sum of the arrays alive during the call."""
    tracemalloc.start()
    call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def picture(pair: StereoPair, maps: Mapping[str, F32], names: Sequence[str]) -> U8:
    """Draw truth and maps in colours; below each map the errors above 1 px (yellow) and 2 px (red)."""
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


def stereo_study(out: Path, pairs: Sequence[str] | None = None, repeats: int = 7) -> Iterator[Part]:
    """Compare dense matching of rectified pairs with OpenCV; OUT gets a picture of each pair.

    Parameters
    ----------
    pairs : sequence of str
        Names of stereo pairs (default: all).
    """
    every: list[Metric] = []
    for name in pick(pairs, STEREO_PAIRS):
        pair = load_stereo_pair(name)
        if pair is None:
            print(f"{name}: not on this machine (THESISRECON_DATA, scikit-image), left out", file=sys.stderr)
            continue
        rows, maps = check_pair(pair, repeats)
        every += rows
        Image.fromarray(picture(pair, maps, (THESIS, DEFAULT, THREE_WAY))).save(out / f"{name}.png")
        yield rows
    if every:
        yield summary_table(every, ("off by more than 1 px", "time over SGBM HH"))
