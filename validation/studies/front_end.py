"""The front end of chapter 4 beside SIFT and COLMAP on real images.

``pairs``: verified matches of fountain-P11 and Herz-Jesus-P8 (:mod:`validation.studies.front_end_pairs`).
``kermit``: the 55 pairs of a hand-held set with wide baselines and without true cameras. A pair contradicts a
model if the RMS Sampson distance of its verified, undistorted matches to the F of the model exceeds
``CONTRADICTS_PX``. The models are ours and COLMAP's, which is independent of our pairs. SIFT is OpenCV's with
all features, ratio 0.8 and mutual best matches.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np

from thesisrecon import reconstruct
from thesisrecon.geometry.two_view import fundamental_from_cameras, sampson_residuals
from thesisrecon.records import Reconstruction, TwoView
from thesisrecon.results import RunResult
from validation.metrics.record import Metric
from validation.references.colmap import read_run, reconstruct_with_pycolmap
from validation.scenes.real_pairs import SCENES_WITH_CAMERAS
from validation.studies.front_end_pairs import (
    OURS,
    SIFT,
    THESIS,
    PreparedViews,
    check_pairs,
    front_ends,
    measure_pairs,
    pair_table,
)
from validation.studies.rectification import undistorted
from validation.studies.runner import CACHE, Part, Rows, load_scene, text_table

OUR_MODEL, COLMAP_MODEL = "our model", "COLMAP's"
CONTRADICTS_PX = 3.0
FEW, MANY = 30, 100
PAIRS_WITH_FEW, PAIRS_WITH_MANY = 38, 30


@dataclass(frozen=True)
class JudgedPair:
    """A pair by one front end and its distance from each model, NaN if a model lacks a view."""

    view: TwoView
    disagreement_px: Mapping[str, float]

    def contradicts(self, model: str) -> bool:
        return self.disagreement_px[model] > CONTRADICTS_PX


@dataclass(frozen=True)
class KermitRun:
    """The pairs of each front end, and the registered views of each model."""

    by: Mapping[str, list[JudgedPair]]
    registered: Mapping[str, int]


def measure_kermit() -> KermitRun | None:
    """Relate all pairs with every front end; None if the images are not on this machine.

    The pairs of the default front end are those that our model was made of.
    """
    scene = load_scene("kermit")
    if scene is None:
        return None
    images = scene.image_paths[0].parent
    with tempfile.TemporaryDirectory() as folder:
        result = reconstruct(images, Path(folder) / "ours", until="metric")
        reconstruct_with_pycolmap(images, Path(folder) / "colmap")
        reference = read_run(images, Path(folder) / "colmap")
    assert result.metric is not None
    models = {OUR_MODEL: result.metric.reconstruction, COLMAP_MODEL: reference.reconstruction}
    by = {name: [judge(v, models) for v in _all_pairs(name, result)] for name in (OURS, THESIS, SIFT)}
    return KermitRun(by, {name: int(model.registered.sum()) for name, model in models.items()})


def judge(view: TwoView, models: Mapping[str, Reconstruction]) -> JudgedPair:
    return JudgedPair(view, {name: disagreement(view, model) for name, model in models.items()})


def _all_pairs(name: str, result: RunResult) -> list[TwoView]:
    if name == OURS:
        return list(result.pairs)
    prepared = PreparedViews(front_ends()[name], result.images)
    return [prepared.relate(i, j) for i, j in combinations(range(len(result.images)), 2)]


def disagreement(view: TwoView, model: Reconstruction) -> float:
    """Return the RMS Sampson distance (px) of the verified matches to the F of the model.

    NaN without matches or if the model lacks one of the views.
    """
    if view.inliers == 0 or not (model.registered[view.i] and model.registered[view.j]):
        return float("nan")
    F = fundamental_from_cameras(model.P[view.i], model.P[view.j])
    d = sampson_residuals(F, undistorted(model, view.i, view.xy1), undistorted(model, view.j, view.xy2))
    return float(np.sqrt(np.mean(d**2)))


def check_kermit(run: KermitRun) -> list[Metric]:
    """Return pairs with many verified matches, and those that contradict a model."""

    def count(wanted: Callable[[JudgedPair], bool]) -> dict[str, float | None]:
        return {name: float(sum(map(wanted, pairs))) for name, pairs in run.by.items()}

    rows = Rows("kermit", OURS)
    for least, target in ((FEW, PAIRS_WITH_FEW), (MANY, PAIRS_WITH_MANY)):
        many = count(lambda p, least=least: p.view.inliers >= least)  # type: ignore[misc]
        rows.add(f"pairs with >= {least} verified, of 55", many, at_least=float(target))
    rows.add("pairs accepted", count(lambda p: p.view.accepted))
    verified = {name: float(sum(p.view.inliers for p in pairs)) for name, pairs in run.by.items()}
    rows.add("verified, all pairs", verified)
    for model, views in run.registered.items():
        against = count(lambda p, m=model: p.view.accepted and p.contradicts(m))  # type: ignore[misc]
        among = count(lambda p, m=model: p.view.inliers >= FEW and p.contradicts(m))  # type: ignore[misc]
        title = f"contradict {model} ({views} views)"
        rows.add(f"accepted pairs that {title}", against, at_most=0.0)
        rows.add(f"pairs with >= {FEW} that {title}", among, at_most=0.0)
        worst = {name: _worst_agreeing(pairs, model) for name, pairs in run.by.items()}
        rows.add(f"largest disagreement with {model} below {CONTRADICTS_PX:g} px", worst)
    return rows


def _worst_agreeing(pairs: list[JudgedPair], model: str) -> float | None:
    agreeing = [
        p.disagreement_px[model]
        for p in pairs
        if p.view.inliers >= FEW and p.disagreement_px[model] <= CONTRADICTS_PX
    ]
    return max(agreeing, default=None)


def kermit_table(run: KermitRun) -> str:
    """Return verified matches / disagreement with each model (px) of every related pair."""
    head = [" / ".join(("verified", *run.registered)), *run.by]
    related = (p for p in zip(*run.by.values(), strict=True) if max(one.view.inliers for one in p) >= FEW)
    return text_table(head, ([f"{p[0].view.i}-{p[0].view.j}", *map(_kermit_cell, p)] for p in related))


def _kermit_cell(pair: JudgedPair) -> str:
    models = " / ".join(f"{px:.2f}" for px in pair.disagreement_px.values())
    return f"{pair.view.inliers} / {models}{'' if pair.view.accepted else ', refused'}"


def front_end_study(
    parts: Sequence[Literal["pairs", "kermit"]] = ("pairs", "kermit"),
    gaps: Sequence[int] = (1, 2, 3),
    cache: Path = CACHE,
) -> Iterator[Part]:
    """Compare the front end of chapter 4 with SIFT and COLMAP on real images."""
    for scene in SCENES_WITH_CAMERAS if "pairs" in parts else ():
        for gap in gaps:
            pairs = list(measure_pairs(scene, (gap,), cache))
            if pairs:
                yield check_pairs(scene, gap, pairs)
                yield pair_table(scene, pairs)
    kermit = measure_kermit() if "kermit" in parts else None
    if kermit is not None:
        yield check_kermit(kermit)
        yield kermit_table(kermit)
