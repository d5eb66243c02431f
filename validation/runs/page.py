"""Write the pages of a report: ``index.html``, which opens with ours over the best reference, and scenes."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image

from thesisrecon import __version__
from thesisrecon.errors import counted, made
from thesisrecon.io._files import write_text
from thesisrecon.report._page import plotly_script, render_page
from validation.runs.records import Picture, ReportOptions, Stage
from validation.runs.report import Judged
from validation.runs.results import Results, Row
from validation.runs.tables import Plot, log_ticks, number, scatter, slug

HERE = Path(__file__).parent
TEMPLATE = HERE / "report.html.j2"


def write_pages(
    options: ReportOptions, stages: Mapping[str, Stage], judged: Judged, results: Results
) -> Path:
    """Write all pages and return the path of the first, which opens with an overview of all stages."""
    scenes = [s for s in options.scenes if any(scene == s for _, scene in judged)]
    links = [("All scenes", "index.html"), *((s, f"scene-{slug(s)}.html") for s in scenes)]
    warnings: list[str] = []

    def write_scene(scene: str) -> None:
        rows, sections = [r for r in results.rows if r.scene == scene], []
        for (name, where), (judgement, _) in judged.items():
            if where == scene:
                plots = [plot_at(f"{slug(name)}-{n}", plot) for n, plot in enumerate(judgement.plots)]
                pictures = [_picture(options.folder(name, scene), one) for one in judgement.pictures]
                figures = {"plots": plots, "pictures": pictures, "notes": judgement.notes}
                sections.append(_section(stages[name], rows) | figures)
        failures = [(k, why) for k, why in results.failures.items() if k.split("/")[1] == scene]
        missing = [k for k in results.missing if k.split("/")[1] == scene]
        values = {"title": scene, "verdict": _verdict(rows, missing), "failures": failures}
        path = options.out / f"scene-{slug(scene)}.html"
        write_page(path, TEMPLATE, sections, links=links, several=False, environment=(), **values)

    for scene in scenes:
        made(f"scene-{slug(scene)}.html", partial(write_scene, scene), warnings, None)
    whole = [_section(stages[name], results.rows) for name in options.stages]
    write_page(
        options.out / "index.html",
        TEMPLATE,
        [overview(results), *(section for section in whole if section["rows"])],
        title="Ours and the references",
        links=links,
        verdict=_verdict(results.rows, results.missing),
        several=True,
        failures=[*results.failures.items(), *(("page", text) for text in warnings)],
        environment=list(results.environment.items()),
    )
    return options.out / "index.html"


def write_page(path: Path, template: Path, sections: Sequence[Mapping[str, Any]], **values: Any) -> None:
    """Write a page of ``sections``, whose plots plotly.js draws, with the other values of its template."""
    figures = {plot["id"]: plot["figure"] for section in sections for plot in section["plots"]}
    scripts = [plotly_script(), (HERE / "page.js").read_text(encoding="utf-8")] if figures else []
    values |= {"sections": sections, "figures": figures, "version": __version__}
    text = template.read_text(encoding="utf-8")
    write_text(path, render_page(text, scripts, filters={"short": number}, **values))


def _verdict(rows: Iterable[Row], missing: Sequence[str]) -> dict[str, Any]:
    rows = list(rows)
    judged = [row for row in rows if row.limit is not None]
    broken = [row for row in judged if row.verdict != "reached"]
    numbers = counted(len(rows), "number")
    if not judged and not missing:
        sentence = f"{numbers} reported, none with a limit."
        return {"level": "open", "word": "Nothing promised here", "sentence": sentence, "reasons": ()}
    summary = f"{len(judged) - len(broken)} of {len(judged) + len(missing)} limits are reached"
    reasons = [
        f"{r.key}: {'no value' if r.value is None else f'{number(r.value)} {r.unit}'.rstrip()}, "
        f"{r.direction} {number(r.limit)}{', much better than measured' * (r.verdict == 'moved')}"
        for r in broken
    ]
    reasons += [f"{key}: no method reported this number" for key in missing]
    if reasons:
        return {"level": "bad", "word": "Broken", "sentence": f"{summary}.", "reasons": reasons}
    return {"level": "good", "word": "Reached", "sentence": f"{summary}; {numbers} in all.", "reasons": ()}


EMPTY: dict[str, Any] = {"rows": (), "references": (), "plots": (), "pictures": (), "notes": ()}


def _section(stage: Stage, rows: Sequence[Row]) -> dict[str, Any]:
    """Return the numbers of a stage, without figures."""
    rows = [r for r in rows if r.key.startswith(f"{stage.name}/")]
    references = list(dict.fromkeys(name for row in rows for name in row.reference))
    head = {"id": stage.name, "title": stage.title, "definition": stage.definition}
    return EMPTY | head | {"rows": rows, "references": references}


def plot_at(folder: str, plot: Plot) -> dict[str, Any]:
    """Return a plot as an entry of a section; ``folder`` becomes part of its identifier."""
    return {"id": f"plot-{folder}", **vars(plot), "solid": "scene" in plot.figure.get("layout", {})}


def _picture(folder: Path, picture: Picture) -> dict[str, Any]:
    """Return the image as a data URL at page width."""
    with PIL.Image.open(folder / picture.file) as opened:
        rgb = opened.convert("RGB")
    rgb.thumbnail((1400, 1400))
    sink = io.BytesIO()
    rgb.save(sink, "JPEG", quality=88)
    address = "data:image/jpeg;base64," + base64.b64encode(sink.getvalue()).decode("ascii")
    return {**vars(picture), "address": address, "width": rgb.width, "height": rgb.height}


ROW_PX, FRAME_PX = 17, 90
BETTER, WORSE = "#2166ac", "#c2571a"
KINDS = {"ms": ", time", "s": ", time", "MB": ", memory", "": ", counts", "%": ", shares"}
"""Numbers of other kinds than lengths and angles have means of their own."""
DEFINITION = (
    "Each dot is a number of ours over that of the best reference, inverted where more is better: left of "
    "the line we are better. Diamonds are geometric means of a stage on a scene, of errors, shares, counts, "
    "times and memory each by itself; the worst are on top."
)


def overview(results: Results) -> dict[str, Any]:
    """Return the first section of the report."""
    ratios = dict[str, list[tuple[float, str]]]()
    for row in results.rows:
        if row.ratio is not None:
            where, name = row.key.rsplit("/", 1)
            ratios.setdefault(f"{where}{KINDS.get(row.unit, '')}", []).append((row.ratio, name))
    means = {key: float(np.exp(np.mean(np.log([r for r, _ in found])))) for key, found in ratios.items()}
    # Plotly draws the first row at the bottom.
    order = sorted(means, key=lambda key: (means[key], key))
    dots = [(key, ratio, name) for key in order for ratio, name in ratios[key]]
    mean_dots = [(key, means[key], "geometric mean") for key in order]
    traces = [_trace(dots, 6, "circle", 0.45), _trace(mean_dots, 10, "diamond", 1.0)]
    layout = _layout(len(order), [ratio for _, ratio, _ in dots])
    worst = Plot("Worst first", {"data": traces, "layout": layout})
    better = sum(mean < 1.0 for mean in means.values())
    where = f"{better} of {len(means)} combinations of stage and scene"
    notes = [f"In {where} we are better than the best reference (geometric mean)."]
    lacking = sum(row.value is None and row.best is not None for row in results.rows)
    if lacking:
        notes.append(f"{counted(lacking, 'number')} of a reference without one of ours: not in the plot.")
    head = {"id": "overview", "title": "Ours over the best reference", "definition": DEFINITION}
    return EMPTY | head | {"plots": [plot_at("overview", worst)] if order else (), "notes": notes}


def _trace(dots: Sequence[tuple[str, float, str]], size: int, symbol: str, opacity: float) -> dict[str, Any]:
    colours = [BETTER if ratio <= 1.0 else WORSE for _, ratio, _ in dots]
    marker = {"size": size, "symbol": symbol, "opacity": opacity, "color": colours}
    text = [f"{name}: {number(ratio)}" for _, ratio, name in dots]
    x, y = [ratio for _, ratio, _ in dots], [label for label, _, _ in dots]
    return scatter("", x, y, text=text, hoverinfo="text+y", showlegend=False, marker=marker)


def _layout(rows: int, ratios: Sequence[float]) -> dict[str, Any]:
    stroke = {"color": "#444", "width": 1}
    line = {"type": "line", "x0": 1, "x1": 1, "y0": 0, "y1": 1, "yref": "paper", "line": stroke}
    y = {"automargin": True, "tickfont": {"size": 10}, "gridcolor": "#f0f3f5", "dtick": 1}
    return {
        "height": ROW_PX * rows + FRAME_PX,
        "margin": {"l": 10, "r": 10, "t": 30, "b": 40},
        "xaxis": {"type": "log", "side": "top", "gridcolor": "#e3e8ec"} | log_ticks(ratios),
        "yaxis": y | {"range": [-1, rows]},
        "shapes": [line],
    }
