"""Section 2.5: disparities of rectified pairs by ours and OpenCV, against dense truth."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import PIL.Image

from thesisrecon.arrays import F32, U8
from thesisrecon.records import DisparityMap
from thesisrecon.stereo.scanline import MaximumLikelihoodScanline
from thesisrecon.stereo.semi_global import SemiGlobalMatching
from validation.metrics.depth import bad_pixels, coloured
from validation.references.libraries import one_thread
from validation.references.opencv import OpenCVSemiGlobal
from validation.runs.records import Judgement, Outcome, Picture, ReportOptions, Stage, Task, read_arrays
from validation.runs.tables import OURS, each, ratio, row
from validation.scenes.stereo import STEREO_PAIRS, StereoPair, load_stereo_pair

THESIS = "ours (thesis)"
MATCHERS: dict[str, SemiGlobalMatching | MaximumLikelihoodScanline] = {
    OURS: SemiGlobalMatching(),
    THESIS: MaximumLikelihoodScanline(),
}
THREE_WAY, HH = "SGBM 3-way", "SGBM HH"
BAD, KNOWN = "off by more than 1 px", "share before holes are filled"
DEFINITION = "share of the pixels visible in both images, holes filled along the row"


class DisparityStage(Stage):
    """Dense matching with the same parameters for all pairs."""

    name = "disparity"
    always = (*MATCHERS, THREE_WAY, HH)

    scenes = STEREO_PAIRS

    def run(self, task: Task, folder: Path, options: ReportOptions) -> None:
        pair = _pair(task.scene)
        runs = 1 if options.quick else 3
        disparity = _match(task.method, pair)  # compiles
        seconds = []
        for _ in range(runs):
            start = time.process_time()
            # The columns that we add at the left border are not counted as OpenCV's.
            _match(task.method, pair, widened=False)
            seconds.append(time.process_time() - start)
        np.savez(folder / "disparity.npz", disparity=disparity, seconds=min(seconds))

    def judge(self, scene: str, outcomes: Mapping[str, Outcome], options: ReportOptions) -> Judgement:
        pair = _pair(scene)
        found = {name: read_arrays(outcome, "disparity.npz") for name, outcome in outcomes.items()}
        maps: dict[str, F32 | None] = {n: None if f is None else f["disparity"] for n, f in found.items()}
        wrong = each(maps, lambda d: bad_pixels(d, pair, 1.0))
        worse = each(maps, lambda d: bad_pixels(d, pair, 2.0))
        unseen = np.isfinite(pair.truth) & ~pair.judged
        hidden = each(maps, lambda d: 100.0 * np.isfinite(d)[unseen].mean())
        with np.errstate(invalid="ignore"):
            off = {n: None if d is None else np.abs(d - pair.truth)[pair.judged] for n, d in maps.items()}
            on_surfaces = each(off, lambda d: d[d < 1.0].mean())
        known = each(maps, lambda d: 100.0 * np.isfinite(d)[pair.judged].mean())
        spent = each(found, lambda f: 1e3 * float(f["seconds"]))
        better = min((v for n in (THREE_WAY, HH) if (v := wrong[n]) is not None), default=None)
        over, slower = ratio(wrong[OURS], better), ratio(spent[OURS], spent[HH])
        metrics = [
            row(scene, BAD, "%", wrong, DEFINITION),
            row(scene, "off by more than 2 px", "%", worse, DEFINITION),
            row(scene, "known", "%", known, KNOWN, more=True),
            row(scene, "time", "ms", spent, "processor time, minimum of all runs"),
            row(scene, "bad pixels over the better reference", "", over, f"{BAD}, over the better SGBM"),
        ]
        unseen_text = "share of the pixels hidden in the other image that have a disparity"
        near_text = "mean over the pixels visible in both images that are off by less than 1 px"
        metrics += [
            row(scene, f"{THESIS}: {BAD}", "%", wrong[THESIS], DEFINITION),
            row(scene, f"{THESIS}: known", "%", known[THESIS], KNOWN, more=True),
            row(scene, "known though hidden", "%", hidden, unseen_text),
            row(scene, "error on surfaces", "px", on_surfaces, near_text),
            row(scene, "time over SGBM HH", "s / s", slower, "processor time on the same machine"),
        ]
        drawn = {name: d for name, d in maps.items() if d is not None}
        shown = [name for name in (THESIS, OURS, THREE_WAY) if name in drawn]
        PIL.Image.fromarray(_picture(pair, drawn, shown)).save(options.folder(self.name, scene) / "maps.png")
        text = f"Left image and truth, then {', '.join(shown)}; below: off by 1 px yellow, by 2 px red."
        return Judgement(metrics, pictures=[Picture("maps.png", "Disparities", text)])


def _pair(scene: str) -> StereoPair:
    pair = load_stereo_pair(scene)
    if pair is None:
        raise ValueError(f"the pair {scene} is not on this machine")
    return pair


def _match(method: str, pair: StereoPair, *, widened: bool = True) -> F32:
    if method in MATCHERS:
        limits = (0, pair.disparities - 1)
        return MATCHERS[method].match(pair.left, pair.right, disparity_range=limits).disparity
    one_thread()
    return OpenCVSemiGlobal(method, widened).match(pair.left, pair.right, pair.disparities)


def _picture(pair: StereoPair, maps: Mapping[str, F32], names: Sequence[str]) -> U8:
    """Draw truth and maps in colours; below each map the errors above 1 px (yellow) and 2 px (red)."""
    top = [pair.left, coloured(pair.truth / np.float64(pair.disparities))]
    dark = (pair.left // 3 + 50).astype(np.uint8)
    low = [dark, np.where(pair.judged[..., None], np.uint8(200), dark)]
    for name in names:
        top.append(coloured(maps[name] / np.float64(pair.disparities)))
        shown = dark.copy()
        filled = DisparityMap(maps[name], np.zeros_like(maps[name]), 0.0).filled()
        error = np.nan_to_num(np.abs(filled - pair.truth), nan=np.inf)
        shown[pair.judged & (error > 1.0)] = (255, 255, 0)
        shown[pair.judged & (error > 2.0)] = (255, 0, 0)
        low.append(shown)
    return np.concatenate([np.concatenate(top, axis=1), np.concatenate(low, axis=1)])
