"""Depth maps from photographs alone, for the checks of what is made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import thesisrecon
from thesisrecon.config import preset
from thesisrecon.dense.multiview import MultiViewStereo
from thesisrecon.types import DepthMap, PinholeView


def depth_maps_of(
    photographs: Sequence[Path], out: Path, stereo: MultiViewStereo, *, threads: int = 2
) -> tuple[dict[int, DepthMap], dict[int, PinholeView]]:
    """Depth maps and photographs without distortion by view; what was computed before is kept in ``out``.

    Raises ``RuntimeError`` where there are none.
    """
    config = replace(preset("default"), dense=stereo)
    run = thesisrecon.reconstruct(list(photographs), out, config=config, until="dense", threads=threads)
    if not run.depth_maps:
        raise RuntimeError(f"{out}: {run.failure}")
    return {m.view: m for m in run.depth_maps}, {v.view: v for v in run.views}
