"""Finished runs read back from their folders."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon.arrays import I64
from thesisrecon.io._files import read_json
from thesisrecon.io._images import image_without_pixels
from thesisrecon.pipeline._matching_stages import final_pairs
from thesisrecon.pipeline._outputs import with_image_names
from thesisrecon.pipeline._stages import best_result
from thesisrecon.records import Image
from thesisrecon.results import RunResult
from thesisrecon.runtime._run import FOLDERS
from thesisrecon.runtime._run_folder import MANIFEST_FILE, StageFolder


def load_run(folder: Path, summary: Mapping[str, Any], run: Mapping[str, Any]) -> RunResult:
    # The folders of later stages may be those of a run that this one replaced.
    finished = {stage: folder / name for stage, name in FOLDERS.items() if stage in summary["seconds"]}
    reports = [StageFolder(path).finished(_keys(path)) for path in finished.values()]
    stages: dict[str, dict[str, Any]] = {stage: {} for stage in FOLDERS}
    stages |= {stage: _records(path) for stage, path in finished.items() if stage != "dense"}
    views, projective = summary["cameras"], list(stages["projective"].values())
    sizes = projective[0].sizes if projective else [_working_size(view) for view in views]
    names = [view["name"] for view in views]
    unread = {one["name"]: one["reason"] for one in summary["refused"] if one["name"] not in names}
    features = tuple(stages["features"].values())
    result = RunResult(
        out=folder,
        images=tuple(_image(view, size) for view, size in zip(views, sizes, strict=True)),
        unread=unread,
        features=features,
        pairs=final_pairs(stages["matches"], features),
        groups=np.array([view["camera"] for view in views], dtype=np.int64),
        settings=run["settings"],
        pair_choice=stages["pairs"].get("choice"),
        tracks=stages["tracks"].get("tracks"),
        mesh=stages["model"].get("model"),
        held_out=stages["model"].get("held-out"),
        reports=tuple(report for report in reports if report is not None),
        warnings=tuple(summary["warnings"]),
        summary=summary,
        failure=summary["failure"] or "",
    )
    attempts = [
        replace(
            result,
            projective=stages["projective"][item],
            calibration=stages["selfcalibration"].get(item),
            metric=stages["metric"].get(f"{item}-more", stages["metric"].get(item)),
        )
        for item in stages["projective"]
    ]
    return with_image_names(best_result(attempts or [result]))


def _keys(folder: Path) -> dict[str, str]:
    content = read_json(folder / MANIFEST_FILE)
    return dict(content["keys"]) if isinstance(content, dict) else {}


def _records(folder: Path) -> dict[str, Any]:
    """Item -> record of a stage, in order of the items."""
    stage = StageFolder(folder)
    found = {item: stage.load(item, key) for item, key in sorted(_keys(folder).items())}
    return {item: record for item, record in found.items() if record is not None}


def _working_size(view: Mapping[str, Any]) -> I64:
    return np.array([int(view[side] * view["working_scale"] + 1e-9) for side in ("width_px", "height_px")])


def _image(view: Mapping[str, Any], size: I64) -> Image:
    grey = image_without_pixels(view["name"], (int(size[0]), int(size[1])))
    return Image(grey.name, grey.rgb, (view["width_px"], view["height_px"]))
