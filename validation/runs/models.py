"""A report of existing models: nothing is run. Each is compared with a reference, camera by camera."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thesisrecon.api.models import compare_models
from thesisrecon.arrays import F64
from thesisrecon.camera import project_camera
from thesisrecon.errors import UsageError, counted
from thesisrecon.io._files import read_json, write_text
from thesisrecon.io._outputs import join_claim
from thesisrecon.results import ModelComparison, SparseModel
from validation.metrics.cameras import (
    AUC_DEG,
    STEPS,
    area_under_recall,
    mean_accuracy,
    recall,
    relative_pose_errors,
)
from validation.runs.page import plot_at, write_page
from validation.runs.results import row_of
from validation.runs.tables import (
    Metric,
    Plot,
    commit,
    finite,
    machine,
    number,
    plot,
    row,
    scatter,
    text_table,
    write_csv,
)

TEMPLATE = Path(__file__).parent / "report.html.j2"
COLOURS = ("#2166ac", "#c2571a", "#3b7a57", "#8a5a9e", "#b8860b", "#555555")
PARTS = {
    "cameras": "Cameras against the reference after the best similarity; relative poses need none.",
    "model": "Points and observations of each model by itself.",
}


class Compared(NamedTuple):
    """A model, its comparison with the reference, the pose errors (degrees) of all pairs of cameras of the
    reference, and the standard deviations that the model states, by error and camera.
    """

    name: str
    found: ModelComparison
    pairs: F64
    stated: Mapping[str, Mapping[str, float]]


def report_models(models: Mapping[str, Path], reference: tuple[str, Path], out: Path) -> Path:
    """Write ``index.html``, ``tables.md``, ``numbers.csv`` and ``numbers.json`` about models of one scene.

    Models and the reference are anything that :func:`thesisrecon.read_cameras` reads. Raises ``UsageError``
    if one cannot be read or has no camera in common with the reference.
    """
    compared = [_compared(name, path, reference) for name, path in models.items()]
    metrics = {
        part: [m for m in make(compared) if any(value is not None for value in m.values.values())]
        for part, make in (("cameras", _of_cameras), ("model", _of_models))
    }
    plots = _plots(compared)
    first = compared[0].name
    with join_claim(out):
        write_text(out / "tables.md", _text(metrics, list(models)))
        records = [{"name": m.name, "unit": m.unit, **m.values} for some in metrics.values() for m in some]
        write_csv(out / "numbers.csv", records)
        write_text(out / "numbers.json", json.dumps(records, indent=1))
        sections = [
            {
                "id": part,
                "title": part.capitalize(),
                "definition": PARTS[part],
                "rows": [row_of("models", m, None) for m in some],
                "references": [c.name for c in compared[1:]],
                "plots": [
                    plot_at(f"{part}-{n}", p) for n, p in enumerate(plots if part == "cameras" else ())
                ],
                "pictures": (),
                "notes": [f"{c.name}: {note}" for c in compared for note in c.found.notes]
                if part == "cameras"
                else (),
            }
            for part, some in metrics.items()
        ]
        page = out / "index.html"
        write_page(
            page,
            TEMPLATE,
            sections,
            title=f"{', '.join(models)} against {reference[0]}",
            links=(),
            verdict=_verdict(compared, reference[0]),
            several=False,
            failures=(),
            environment=[
                ("commit", commit()),
                ("machine", machine()),
                *((n, str(p)) for n, p in models.items()),
            ],
            ours=first,
            limits=False,
            about="Hover over a number's name for what it is. The numbers are also in numbers.csv.",
        )
    return page


def _compared(name: str, path: Path, reference: tuple[str, Path]) -> Compared:
    try:
        found = compare_models(path, reference[1])
    except UsageError as error:
        raise UsageError(f"{name}: {error}") from None
    of_b = {view.name: k for k, view in enumerate(found.b.views)}
    R_true = np.array([view.R for view in found.b.views])
    C_true = np.array([view.centre for view in found.b.views])
    R, C = np.full_like(R_true, np.nan), np.full_like(C_true, np.nan)
    of_a = {view.name: view for view in found.a.views}
    for a, b in zip(found.names, found.names_b, strict=True):
        R[of_b[b]], C[of_b[b]] = of_a[a].R, of_a[a].centre
    return Compared(name, found, relative_pose_errors(R, C, R_true, C_true), _stated(path, found))


def _stated(path: Path, found: ModelComparison) -> dict[str, dict[str, float]]:
    """Standard deviations that a model states (RMS over the axes) by error and camera: of centres in units of
    the reference, of rotations in degrees, and relative ones of focal lengths.
    """
    scale, stated = 1.0 if found.similarity is None else found.similarity.scale, dict[str, dict[str, float]]()
    file = path / "cameras.json" if path.is_dir() else path
    content = read_json(file) if file.suffix == ".json" else None
    cameras = content.get("cameras") if isinstance(content, dict) else None
    for camera in cameras if isinstance(cameras, list) else ():
        focal = camera["K"][0][0] if camera.get("K") else np.nan
        for error, part, unit in (
            ("centre_error", "centre_", scale),
            ("rotation_error_deg", "rotation_", 1.0),
            ("focal_error_rel", "focal_px", 1.0 / focal),
        ):
            deviations = [std for name, std in camera.get("std", {}).items() if name.startswith(part)]
            if deviations:
                rms = float(np.sqrt(np.mean(np.square(deviations))))
                stated.setdefault(error, {})[str(camera["name"])] = unit * rms
    return stated


def _of_cameras(compared: Sequence[Compared]) -> list[Metric]:
    def each(
        name: str, unit: str, values: Sequence[float | None], definition: str, *, more: bool = False
    ) -> Metric:
        table = {c.name: finite(v) for c, v in zip(compared, values, strict=True)}
        return row("models", name, unit, table, definition, more=more, judged=compared[0].name)

    total = len(compared[0].found.b.views)
    share = [100.0 * len(c.found.names) / total for c in compared]
    rows = [each("cameras found", "%", share, f"cameras of the {total} of the reference", more=True)]
    about = "area under the recall of relative poses of all pairs of the reference; missing cameras fail"
    for threshold in AUC_DEG:
        areas = [100.0 * area_under_recall(c.pairs, threshold) for c in compared]
        rows.append(each(f"AUC@{threshold:g}°", "%", areas, about, more=True))
    mean = [100.0 * mean_accuracy(c.pairs) for c in compared]
    rows.append(
        each("mAA(10°)", "%", mean, "mean recall of relative poses at 1, 2 ... 10 degrees", more=True)
    )
    for name, unit, attribute, factor in (
        ("centre error, median", "units of the reference", "centre_error", 1.0),
        ("rotation error, median", "°", "rotation_error_deg", 1.0),
        ("focal error, median", "%", "focal_error_rel", 100.0),
        ("principal point error, median", "px", "principal_point_error_px", 1.0),
    ):
        errors = [factor * np.abs(getattr(c.found, attribute)) for c in compared]
        rows.append(each(name, unit, [_median(e) for e in errors], "of the cameras that both have"))
    return rows


def _of_models(compared: Sequence[Compared]) -> list[Metric]:
    numbers, first, rows = [_of_model(c.found.a) for c in compared], compared[0].name, list[Metric]()
    for name, (unit, about, more) in {
        "points": ("", "points of the model", True),
        "observations": ("", "pixels of points", True),
        "track length, mean": ("images", "observations of a point", True),
        "reprojection, median": ("px", "distance of observations from their projected points", False),
        "reprojection, RMS": ("px", "of the same distances", False),
    }.items():
        table = {c.name: finite(n.get(name)) for c, n in zip(compared, numbers, strict=True)}
        rows.append(row("models", name, unit, table, about, more=more, ranked=False, judged=first))
    for name, attribute in (("to the reference", "a_to_b"), ("from the reference", "b_to_a")):
        apart = {
            c.name: None if c.found.points is None else getattr(c.found.points, attribute) for c in compared
        }
        about, unit = "median distance to the nearest point of the other model", "units of the reference"
        rows.append(row("models", f"points {name}, median", unit, apart, about, judged=first))
    return rows


def _of_model(model: SparseModel) -> dict[str, float]:
    found = {"points": float(len(model.X))}
    if not len(model.xy):
        return found
    found |= {
        "observations": float(len(model.xy)),
        "track length, mean": len(model.xy) / max(len(np.unique(model.point_index)), 1),
    }
    distances = []
    for number_of_view, view in enumerate(model.views):
        here = model.view_index == number_of_view
        if view.K is None or view.distortion is None or not here.any():
            continue
        X = model.X[model.point_index[here]]
        seen = project_camera(view.K, view.R, view.t, X, distortion=view.distortion)
        distances.append(np.linalg.norm(seen - model.xy[here], axis=1))
    if distances:
        d = np.concatenate(distances)
        found |= {
            "reprojection, median": float(np.median(d)),
            "reprojection, RMS": float(np.sqrt(np.mean(d**2))),
        }
    return found


def _plots(compared: Sequence[Compared]) -> list[Plot]:
    at = np.linspace(0.0, max(AUC_DEG), STEPS + 1)[1:] ** 2 / max(AUC_DEG)
    size: dict[str, Any] = {"height": 400}
    curves = [
        scatter(c.name, at, (100.0 * recall(c.pairs, at)).round(2), "lines", line={"color": colour})
        for c, colour in zip(compared, _colours(compared), strict=True)
        if len(c.pairs)
    ]
    log, title = {"type": "log"}, "Recall of relative poses"
    found = [plot(title, curves, "largest error (degrees)", "pairs (%)", xaxis=log, **size)] if curves else []
    order = {view.name: k for k, view in enumerate(compared[0].found.b.views, 1)}
    zero = {"rangemode": "tozero"}
    for title, attribute, unit, factor in (
        ("Centre error by image", "centre_error", "units of the reference", 1.0),
        ("Rotation error by image", "rotation_error_deg", "degrees", 1.0),
        ("Focal error by image", "focal_error_rel", "%", 100.0),
    ):
        traces = []
        for c, colour in zip(compared, _colours(compared), strict=True):
            errors = factor * getattr(c.found, attribute)
            if not np.isfinite(errors).any():
                continue
            x = [order[name] for name in c.found.names_b]
            marker = {"color": colour, "size": 6}
            more: dict[str, Any] = {"text": list(c.found.names), "hoverinfo": "text+y"}
            if std := c.stated.get(attribute):
                bars = [1.96 * factor * std.get(name, 0.0) for name in c.found.names]
                more["error_y"] = {"type": "data", "array": bars, "color": colour, "thickness": 1}
            traces.append(scatter(c.name, x, [finite(e) for e in errors], marker=marker, **more))
        caption = "Bars: stated 95 % intervals." if any("error_y" in trace for trace in traces) else ""
        if traces:
            found.append(plot(title, traces, "image", unit, caption, yaxis=zero, **size))
    return found


def _colours(compared: Sequence[Compared]) -> list[str]:
    return [COLOURS[k % len(COLOURS)] for k in range(len(compared))]


def _verdict(compared: Sequence[Compared], reference: str) -> dict[str, Any]:
    order = sorted(compared, key=lambda c: -area_under_recall(c.pairs, 5.0))
    areas = "; ".join(f"{c.name} {number(100.0 * area_under_recall(c.pairs, 5.0))} %" for c in order)
    total = counted(len(compared[0].found.b.views), "camera")
    sentence = f"AUC@5° of relative poses of {total} of {reference}: {areas}."
    if not any(len(c.pairs) for c in compared):
        errors = {c.name: _median(100.0 * np.abs(c.found.focal_error_rel)) for c in compared}
        areas = "; ".join(f"{name} {number(error)} %" for name, error in errors.items())
        sentence = f"Median focal error against {reference}: {areas}."
    return {"level": "open", "word": "Compared", "reasons": (), "sentence": sentence}


def _text(metrics: Mapping[str, Sequence[Metric]], names: Sequence[str]) -> str:
    rows = [
        [f"{m.name}, {m.unit}" if m.unit else m.name, *(number(m.values.get(name)) for name in names)]
        for some in metrics.values()
        for m in some
    ]
    return text_table(["", *names], rows) + "\n"


def _median(errors: F64) -> float | None:
    known = errors[np.isfinite(errors)]
    return float(np.median(known)) if len(known) else None
