"""Wide baselines: which front ends find the right matches, and up to which difference of the views.

``warped``: images and warped views of them (roll, scale, obliqueness, exposure), ``rendered``: a yard from
two known poses. A pair is found if it is accepted and its F is right: the median distance of the
true correspondences to its epipolar lines is below ``RIGHT_REL`` of the long side; accepted with another F
it is wrong.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from thesisrecon.config import PipelineConfig, preset
from thesisrecon.features.multiscale import MultiScaleCorners
from thesisrecon.geometry.two_view import symmetric_residuals
from thesisrecon.pipeline.image_pair import match_images
from thesisrecon.records import TwoView
from validation.references.sift import affine_sift_front_end, sift_front_end
from validation.runs.study import Part, pick, report_progress
from validation.runs.tables import Metric, Rows, text_table
from validation.scenes.wide_baseline import STEPS, WidePair, WideStep, rendered_pair, warped_pairs

OURS, ORDINARY, SIFT, AFFINE_SIFT = "ours", "without simulated views", "SIFT", "SIFT, simulated views"
RIGHT_REL = 0.003


class _WithoutTilts(MultiScaleCorners):
    oblique_tilts = ()


def front_ends() -> dict[str, PipelineConfig]:
    """Our front end and two of OpenCV with the same estimator of F and verification."""
    ours = preset("default")
    ordinary = replace(ours, features=_WithoutTilts())
    return {
        OURS: ours,
        ORDINARY: ordinary,
        SIFT: sift_front_end(ours),
        AFFINE_SIFT: affine_sift_front_end(ours),
    }


@dataclass(frozen=True)
class WideResult:
    """A pair by one front end, and the median distance (share of the long side) of true correspondences."""

    pair: WidePair
    view: TwoView
    error_rel: float

    @property
    def found(self) -> bool:
        return self.view.accepted and self.error_rel < RIGHT_REL

    @property
    def wrong(self) -> bool:
        return self.view.accepted and not self.error_rel < RIGHT_REL


def relate(config: PipelineConfig, pair: WidePair) -> WideResult:
    view = match_images(config, pair.images, 0)
    if not view.accepted:
        return WideResult(pair, view, np.inf)
    d = symmetric_residuals(view.F, pair.truth[:, :2], pair.truth[:, 2:]) / np.sqrt(2.0)
    return WideResult(pair, view, float(np.median(d)) / max(pair.images[0].size))


def check_step(step: WideStep, by: dict[str, list[WideResult]]) -> list[Metric]:
    """Pairs found and wrong, and the verified matches of those found."""
    rows, pairs = Rows(str(step), OURS), max(map(len, by.values()))
    rows.add(f"pairs found, of {pairs}", {n: float(sum(r.found for r in found)) for n, found in by.items()})
    wrong = {n: float(sum(r.wrong for r in found)) for n, found in by.items()}
    rows.add("wrong", wrong, at_most=0.0 if OURS in by else None)
    return rows


def wide_baseline_study(
    parts: Sequence[Literal["warped", "rendered"]] = ("warped", "rendered"),
    methods: Sequence[str] | None = None,
) -> Iterator[Part]:
    """Find pairs of images whose view directions, distances or rolls differ much."""
    configs = front_ends()
    chosen = pick(methods, configs)
    lines, rows = list[list[object]](), list[Part]()
    for step in STEPS:
        pairs = list(_pairs(step, parts))
        if not pairs:
            return
        by = {name: [relate(configs[name], pair) for pair in pairs] for name in chosen}
        lines.append([step, *(_cell(by[name]) for name in chosen)])
        report_progress(" | ".join(map(str, lines[-1])))
        rows.append(check_step(step, by))
    yield text_table(["step; found of all (wrong), median verified", *chosen], lines)
    yield from rows


def _pairs(step: WideStep, parts: Iterable[str]) -> Iterator[WidePair]:
    if "warped" in parts:
        yield from warped_pairs(step)
    if "rendered" in parts:
        yield rendered_pair(step)


def _cell(results: Sequence[WideResult]) -> str:
    wrong = sum(r.wrong for r in results)
    verified = [r.view.inliers if r.found else 0 for r in results]
    return f"{sum(r.found for r in results)} of {len(results)} ({wrong}), {np.median(verified):.0f}"
