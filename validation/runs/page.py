"""Write the pages of a report: ``index.html`` and one page for each scene."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import PIL.Image

from thesisrecon import __version__
from thesisrecon.errors import counted, made
from thesisrecon.io._files import write_text
from thesisrecon.report._page import plotly_script, render_page
from validation.runs.overview import cost_ratio, overview
from validation.runs.records import Judgement, Picture, Plot, ReportOptions, Stage, key_of, slug
from validation.runs.report import Judged
from validation.runs.results import Results, Row
from validation.runs.tables import number

HERE = Path(__file__).parent
TEMPLATE = HERE / "report.html.j2"


@dataclass(frozen=True)
class _Verdict:
    level: str
    word: str
    sentence: str
    reasons: tuple[str, ...] = ()


def write_pages(
    options: ReportOptions,
    stages: Mapping[str, Stage],
    judged: Judged,
    results: Results,
    earlier: Results | None = None,
) -> Path:
    """Write all pages and return the path of the first, which opens with an overview of all stages."""
    scenes = [s for s in options.scenes if any(scene == s for _, scene in judged)]
    links = [("All scenes", "index.html"), *((s, f"scene-{slug(s)}.html") for s in scenes)]
    names = {
        key_of(stage, m): m.name for (stage, _), (judgement, _) in judged.items() for m in judgement.metrics
    }
    warnings: list[str] = []

    def write_scene(scene: str) -> None:
        rows = [r for r in results.rows if r.key.split("/")[1] == scene]
        sections = [
            _section(stages[name], rows, names) | _figures(options.folder(name, scene), name, judgement)
            for (name, where), (judgement, _) in judged.items()
            if where == scene
        ]
        failures = [(k, why) for k, why in results.failures.items() if k.split("/")[1] == scene]
        missing = [k for k in results.missing if k.split("/")[1] == scene]
        write_page(
            options.out / f"scene-{slug(scene)}.html",
            TEMPLATE,
            sections,
            title=scene,
            links=links,
            verdict=_verdict(rows, missing),
            several=False,
            failures=failures,
            environment=(),
        )

    for scene in scenes:
        made(f"scene-{slug(scene)}.html", partial(write_scene, scene), warnings, None)
    whole = [_section(stages[name], results.rows, names) for name in options.stages]
    write_page(
        options.out / "index.html",
        TEMPLATE,
        [overview(results, earlier), *(section for section in whole if section["rows"])],
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


def _verdict(rows: Iterable[Row], missing: Sequence[str]) -> _Verdict:
    rows = list(rows)
    judged = [row for row in rows if row.limit is not None]
    broken = [row for row in judged if row.verdict != "reached"]
    if not judged and not missing:
        sentence = f"{counted(len(rows), 'number')} reported, none with a limit."
        return _Verdict("open", "Nothing promised here", sentence)
    summary = f"{len(judged) - len(broken)} of {len(judged) + len(missing)} limits are reached"
    reasons = tuple(f"{r.key}: {number(r.value)} {r.unit}, {r.direction} {number(r.limit)}" for r in broken)
    reasons += tuple(f"{key}: no method reported this number" for key in missing)
    if reasons:
        return _Verdict("bad", "Broken", f"{summary}.", reasons)
    return _Verdict("good", "Reached", f"{summary}; {counted(len(rows), 'number')} in all.")


def _section(stage: Stage, rows: Sequence[Row], names: Mapping[str, str]) -> dict[str, Any]:
    """Return the numbers of a stage, without figures."""
    rows = [r for r in rows if r.key.startswith(f"{stage.name}/")]
    return {
        "id": stage.name,
        "title": stage.title,
        "definition": stage.definition,
        "rows": [_row(row, names) for row in rows],
        "references": list(dict.fromkeys(name for row in rows for name in row.reference)),
        "plots": (),
        "pictures": (),
        "notes": (),
    }


def _figures(folder: Path, stage: str, judgement: Judgement) -> dict[str, Any]:
    """Return what the judgement in the folder ``folder`` adds to the section of its stage."""
    return {
        "plots": [plot_at(f"{slug(stage)}-{n}", plot) for n, plot in enumerate(judgement.plots)],
        "pictures": [_picture(folder, picture) for picture in judgement.pictures],
        "notes": judgement.notes,
    }


def _row(row: Row, names: Mapping[str, str]) -> dict[str, Any]:
    _, scene, last = row.key.split("/")
    return vars(row) | {
        "name": names.get(row.key, last),
        "scene": scene,
        "definition": row.source or "as its name says",
        "ratio": cost_ratio(row),
    }


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
