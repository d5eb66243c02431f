"""Rendered places that look alike: models that are right, named as doubtful, or wrong and trusted."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from thesisrecon import reconstruct
from thesisrecon.errors import StageFailure
from validation.metrics.cameras import pose_pair_errors
from validation.runs.study import Part, report_progress
from validation.runs.tables import text_table
from validation.scenes.look_alikes import KINDS, SCENES, SIZE, build_look_alike
from validation.scenes.pose import true_cameras
from validation.scenes.sensor import write_images

MAX_ERROR_DEG, MAX_WRONG = 8.0, 0.1  # error of a relative pose, and share of wrong ones in a right model


def look_alikes_study(*, kinds: Sequence[str] = (), every: int = 1) -> Iterator[Part]:
    """Wrong models of look-alike places that are trusted: towers, rooms, houses and windows."""
    rows = list[list[object]]()
    for kind in KINDS:
        chosen = [scene for scene in SCENES[::every] if scene[0] == kind]
        if not chosen or (kinds and not any(word in kind for word in kinds)):
            continue
        found = list[str]()
        for n, scene in enumerate(chosen):
            report_progress(f"{kind}: {n + 1} of {len(chosen)}")
            found.append(verdict(*scene))
        rows.append([kind, *(found.count(word) for word in VERDICTS)])
    yield text_table(["places", *VERDICTS], rows)


VERDICTS = ("right", "right, not trusted", "wrong, not trusted", "wrong and trusted", "no model")


def verdict(kind: str, detail: int, seed: int) -> str:
    """Reconstruct a scene and compare its model with the truth."""
    scene = build_look_alike(kind, detail, seed)
    with tempfile.TemporaryDirectory() as folder:
        images = Path(folder) / "images"
        numbers = [2010, KINDS.index(kind), detail, seed]
        write_images(images, scene.world, dict(enumerate(scene.poses)), SIZE, numbers)
        try:
            metric = reconstruct(images, Path(folder) / "out", until="metric").metric
        except StageFailure:
            return VERDICTS[4]
    if metric is None:
        return VERDICTS[4]
    errors = pose_pair_errors(metric.reconstruction, true_cameras(scene.poses))
    right = np.mean(errors[np.isfinite(errors)] > MAX_ERROR_DEG) <= MAX_WRONG
    return VERDICTS[(0 if right else 2) + ((not metric.trusted) if right else int(metric.trusted))]
