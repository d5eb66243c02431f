"""All 55 pairs of kermit, hand-held with wide baselines: how many are related, and do they tell one story.

There are no true cameras. A pair contradicts a model where the RMS Sampson distance of its own verified
matches, freed of distortion, to the F of the model's cameras of its two views exceeds ``CONTRADICTS_PX``;
right pairs lie far below, wrong ones far above. There are two models: the one the default pipeline makes of
our pairs, and COLMAP's, which owes them nothing and so tells whether a pair is wrong or our model is. Pairs
with a view that a model lacks cannot be judged by it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from thesisrecon import reconstruct
from thesisrecon.arrays import F64
from thesisrecon.geometry.camera_matrix import undistort
from thesisrecon.geometry.homogeneous import dehomogenize, homogenize
from thesisrecon.geometry.two_view import fundamental_from_cameras, sampson_residuals
from thesisrecon.records import Reconstruction, RunResult, TwoView
from validation.studies.front_end_pairs import OURS, SIFT, THESIS, PreparedViews, front_ends
from validation.metrics.record import Metric
from validation.references.colmap_run import reconstruct_with_pycolmap
from validation.scenes.real import load_real_scene

OUR_MODEL, COLMAP = "our model", "COLMAP's"
CONTRADICTS_PX = 3.0
FEW, MANY = 30, 100
PAIRS_WITH_FEW, PAIRS_WITH_MANY = 38, 30


@dataclass(frozen=True)
class JudgedPair:
    """A pair by one front end and how far it is from each model, NaN where that lacks a view."""

    view: TwoView
    disagreement_px: Mapping[str, float]

    def contradicts(self, model: str) -> bool:
        """Whether the pair tells another geometry than this model."""
        return self.disagreement_px[model] > CONTRADICTS_PX


@dataclass(frozen=True)
class KermitRun:
    """The pairs of each front end, and how many views each model has that they are held against."""

    by: Mapping[str, list[JudgedPair]]
    registered: Mapping[str, int]


def measure_kermit() -> KermitRun | None:
    """Relate all pairs by every front end and hold them against both models; None without photographs.

    The pairs of the default front end are those that our model itself was made of.
    """
    scene = load_real_scene("kermit")
    if scene is None:
        return None
    photographs = scene.image_paths[0].parent
    with tempfile.TemporaryDirectory() as folder:
        result = reconstruct(photographs, Path(folder) / "ours", until="metric")
        reference = reconstruct_with_pycolmap(photographs, Path(folder) / "colmap")
    assert result.metric is not None
    models = {OUR_MODEL: result.metric.reconstruction, COLMAP: reference.reconstruction}
    by = {name: [judge(v, models) for v in _pairs(name, result)] for name in (OURS, THESIS, SIFT)}
    return KermitRun(by, {name: int(model.registered.sum()) for name, model in models.items()})


def judge(view: TwoView, models: Mapping[str, Reconstruction]) -> JudgedPair:
    """The pair beside the models."""
    return JudgedPair(view, {name: disagreement(view, model) for name, model in models.items()})


def _pairs(name: str, result: RunResult) -> list[TwoView]:
    if name == OURS:
        return list(result.pairs)
    prepared = PreparedViews(front_ends()[name], result.images)
    return [prepared.relate(i, j) for i, j in combinations(range(len(result.images)), 2)]


def disagreement(view: TwoView, model: Reconstruction) -> float:
    """RMS Sampson distance, px, of the verified matches of a pair to the F of the model's cameras.

    NaN where there are no matches or the model lacks one of the views.
    """
    if view.inliers == 0 or not (model.registered[view.i] and model.registered[view.j]):
        return float("nan")
    F = fundamental_from_cameras(model.P[view.i], model.P[view.j])
    d = sampson_residuals(F, _undistorted(view.xy1, model, view.i), _undistorted(view.xy2, model, view.j))
    return float(np.sqrt(np.mean(d**2)))


def _undistorted(xy: F64, model: Reconstruction, i: int) -> F64:
    assert model.K is not None
    if model.distortion is None:
        return xy
    normalized = dehomogenize(homogenize(xy) @ np.linalg.inv(model.K[i]).T)
    return dehomogenize(homogenize(undistort(normalized, model.distortion[i])) @ model.K[i].T)


def check_kermit(run: KermitRun) -> list[Metric]:
    """Pairs with many verified matches, and those that contradict a model."""

    def count(wanted: Callable[[JudgedPair], bool]) -> dict[str, float | None]:
        return {name: float(sum(map(wanted, pairs))) for name, pairs in run.by.items()}

    def row(name: str, values: Mapping[str, float | None], **judged: Any) -> Metric:
        return Metric("kermit", name, "", values, OURS, **judged)

    all_verified = {name: float(sum(p.view.inliers for p in pairs)) for name, pairs in run.by.items()}
    rows = [
        row(
            f"pairs with >= {least} verified, of 55",
            count(lambda p, least=least: p.view.inliers >= least),  # type: ignore[misc]
            target=float(target),
            at_most=False,
        )
        for least, target in ((FEW, PAIRS_WITH_FEW), (MANY, PAIRS_WITH_MANY))
    ]
    rows += [
        row("pairs accepted", count(lambda p: p.view.accepted)),
        row("verified, all pairs", all_verified),
    ]
    for model, views in run.registered.items():
        against = count(lambda p, m=model: p.view.accepted and p.contradicts(m))  # type: ignore[misc]
        among = count(lambda p, m=model: p.view.inliers >= FEW and p.contradicts(m))  # type: ignore[misc]
        title = f"contradict {model} ({views} views)"
        rows.append(row(f"accepted pairs that {title}", against, target=0.0))
        rows.append(row(f"pairs with >= {FEW} that {title}", among, target=0.0))
        worst = {name: _worst_agreeing(pairs, model) for name, pairs in run.by.items()}
        rows.append(row(f"largest disagreement with {model} below {CONTRADICTS_PX:g} px", worst))
    return rows


def _worst_agreeing(pairs: list[JudgedPair], model: str) -> float | None:
    """The largest disagreement of a pair that counts as agreeing."""
    agreeing = [
        p.disagreement_px[model]
        for p in pairs
        if p.view.inliers >= FEW and p.disagreement_px[model] <= CONTRADICTS_PX
    ]
    return max(agreeing, default=None)


def kermit_table(run: KermitRun) -> str:
    """Every pair that some front end relates: verified matches / disagreement with each model, px."""
    lines = [f"| {' / '.join(('verified', *run.registered))} | {' | '.join(run.by)} |"]
    lines.append(f"| --- |{' --- |' * len(run.by)}")
    for pairs in zip(*run.by.values(), strict=True):
        if max(p.view.inliers for p in pairs) >= FEW:
            cells = [_cell(p) for p in pairs]
            lines.append(f"| {pairs[0].view.i}-{pairs[0].view.j} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(pair: JudgedPair) -> str:
    told = " / ".join(f"{px:.2f}" for px in pair.disagreement_px.values())
    return f"{pair.view.inliers} / {told}{'' if pair.view.accepted else ', refused'}"
