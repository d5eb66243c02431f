"""Progress where there is no terminal: one line per stage in notebooks and log files."""

import sys
import time
from collections.abc import Callable

STAGE_LABELS = {
    "frames": "frames of the video", "kernels": "compiling (first run)", "features": "corners",
    "pairs": "pair selection", "matches": "image pairs", "projective": "projective cameras",
    "selfcalibration": "self-calibration", "metric": "metric refinement", "dense": "depth maps",
    "model": "surface and texture", "correspondence": "dense correspondence", "views": "views",
}  # fmt: skip
SILENT_S = 30.0  # a line stands for a part of a stage if this time has passed


def print_stages(write: Callable[[str], object]) -> Callable[[str, int, int], None]:
    """Return a progress function that writes a line when a stage is done, and one each ``SILENT_S``."""
    started, ended, said = dict[str, float](), dict[str, int](), time.monotonic()

    def update(stage: str, done: int, total: int) -> None:
        nonlocal said
        now = time.monotonic()
        started.setdefault(stage, now)
        if done >= total == ended.get(stage):
            return  # said twice by the stage
        if done >= total or now - said > SILENT_S:
            said, ended[stage] = now, done
            write(f"{STAGE_LABELS.get(stage, stage)}: {done} of {total}, {now - started[stage]:.0f} s\n")

    return update


def default_progress() -> Callable[[str, int, int], None]:
    """Lines in the output of a notebook's cell, nothing elsewhere."""
    if "ipykernel" not in sys.modules:
        return lambda *_: None
    return print_stages(lambda line: print(line, end="", flush=True))
