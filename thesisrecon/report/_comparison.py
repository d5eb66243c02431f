"""Tables and page of a comparison of two models."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from thesisrecon import __version__
from thesisrecon.report._assessment import count_of
from thesisrecon.report._figures import model_scene, scene_figure, upright_rotation
from thesisrecon.report._page import figure_content, page_resource, render_page
from thesisrecon.results import THRESHOLDS, ModelComparison

COLORS = {"a": ("#ff9f43", "#ffc78a"), "b": ("#3fb8ff", "#9fd8f7")}
"""Cameras and points of each model."""
_MAX_POINTS = 10_000
"""Points of each model on the page: they take half a megabyte together."""
_COLUMNS = {
    "centre_error": ("centre (unit of B)", 1.0),
    "rotation_error_deg": ("rotation (deg)", 1.0),
    "focal_error_rel": ("focal length (%)", 100.0),
    "principal_point_error_px": ("principal point (px)", 1.0),
}

Table = list[list[str]]


def _number(value: float) -> str:
    return f"{value:.4g}" if np.isfinite(value) else "–"


def summary_table(comparison: ModelComparison) -> Table:
    """Statistics of the absolute errors that are known, with a head row."""
    rows = [["error of A", "median", "mean", "RMS", "largest"]]
    for name, statistics in comparison.summary.items():
        label, factor = _COLUMNS[name]
        rows.append([label, *(_number(factor * value) for value in statistics.values())])
    return rows


def camera_table(comparison: ModelComparison) -> Table:
    """Errors of each common camera, with a head row."""
    rows = [["camera", *(label for label, _ in _COLUMNS.values())]]
    errors = [factor * getattr(comparison, name) for name, (_, factor) in _COLUMNS.items()]
    columns = zip(comparison.names, *errors, strict=True)
    return rows + [[name, *map(_number, numbers)] for name, *numbers in columns]


def point_table(comparison: ModelComparison) -> Table:
    """Distances of the points in both directions, with a head row; empty without them."""
    found = comparison.points
    if found is None:
        return []
    rows = [["points", "A to nearest of B", "B to nearest of A"]]
    rows.append(["median distance (unit of B)", _number(found.a_to_b), _number(found.b_to_a)])
    columns = (THRESHOLDS, found.thresholds, found.a_within, found.b_within)
    for share, limit, *within in zip(*columns, strict=True):
        label = f"within {_number(limit)} ({100 * share:g} % of the scene)"
        rows.append([label, *(f"{100 * part:.1f} %" for part in within)])
    return rows


def headline(comparison: ModelComparison) -> str:
    """Number of common cameras, and of those of one model only."""
    text = count_of(len(comparison.names), "common camera")
    for which, only in (("A", comparison.only_a), ("B", comparison.only_b)):
        if only:
            text += f", {len(only)} only in {which}"
    scale = comparison.similarity
    return text if scale is None else f"{text}; one unit of A is {_number(scale.scale)} units of B"


def comparison_figure(comparison: ModelComparison) -> dict[str, Any]:
    """Both models in the world of B as one plotly.js figure, upright."""
    upright = upright_rotation(np.stack([view.R for view in comparison.b.views]))
    models = {"b": comparison.b, "a": comparison.a}
    scenes = {key: model_scene(model, upright, max_points=_MAX_POINTS) for key, model in models.items()}
    low = np.min([scene.low for scene in scenes.values()], axis=0)
    high = np.max([scene.high for scene in scenes.values()], axis=0)
    figure: dict[str, Any] = {}
    for key, scene in scenes.items():
        accent, paint = COLORS[key]
        names = [f"{key.upper()}: {name}" for name in models[key].names]
        drawn = scene_figure(replace(scene, low=low, high=high), names, paint, accent=accent)
        figure = {**drawn, "data": [*figure.get("data", []), *drawn["data"]]}
    return figure


def comparison_page(comparison: ModelComparison, a: str, b: str) -> str:
    """Render the page of a comparison; ``a`` and ``b`` name the models."""
    aligned = comparison.similarity is not None
    scripts, drawing = figure_content({"scene-figure": comparison_figure(comparison)} if aligned else {})
    return render_page(
        page_resource("comparison.html.j2"),
        scripts,
        **drawing,
        version=__version__,
        names={"a": a, "b": b},
        colors={key: cameras for key, (cameras, _) in COLORS.items()},
        headline=headline(comparison),
        notes=[note[:1].upper() + note[1:] + "." for note in comparison.notes],
        tables=[table for table in (summary_table(comparison), point_table(comparison)) if table],
        cameras=camera_table(comparison),
    )
