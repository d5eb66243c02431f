"""One camera per image where some photographs hardly overlap: what becomes of those whose own focal length
their matches do not determine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thesisrecon.records import Reconstruction, RunResult
from validation.studies.calibration_bench import Bench, Rows, model_of, reduced
from validation.studies.calibration_parts import LEAST_HOLDING, MODES, SUCCESS_PCT, named
from validation.studies.reconstruction import COLMAP, OURS
from validation.metrics.intervals import LEVEL
from validation.metrics.record import Metric
from validation.references.colmap_mapping import Start
from validation.scenes.zoomed import windowed_scene

WINDOW = 0.3, 0.45
"""Width and height of the windows, as shares of those of a photograph."""


def check_wide(bench: Bench) -> list[list[Metric]]:
    """Every third photograph keeps only a window, one camera per image: what becomes of those."""
    rng, weak = np.random.default_rng(11), np.arange(1, len(bench.scene.image_paths), 3)
    corners = rng.uniform(0.1, 0.9 - np.array(WINDOW), (len(weak), 2))
    boxes = {int(v): np.hstack([corner, corner + WINDOW]) for v, corner in zip(weak, corners, strict=True)}
    scene = windowed_scene(bench.scene, bench.out / "wide" / "images", boxes)
    here = replace(bench, scene=scene, out=bench.out / "wide")
    run, models = here.methods("per-image")
    rows = Rows(f"{bench.scene.name}, windows of {len(weak)} photographs, per-image", scene, models)
    rows.registered()
    errors = {m: rows.all_focals(model) for m, model in models.items()}
    for what, views in (("whole", np.setdiff1d(np.arange(rows.total), weak)), ("windowed", weak)):
        there = {m: e[views][np.isfinite(e[views])] for m, e in errors.items()}
        for name, reduce in (("median", np.median), ("worst", np.max)):
            values = {m: reduced(reduce, e) for m, e in there.items()}
            rows.add(f"focal error of the {what}, {name}", "%", values)
    if run is not None and run.metric is not None:
        result = run.metric
        silent = [v for v in weak if errors[OURS][v] > SUCCESS_PCT and not named(result, int(v))]
        rows.add(
            f"windowed, off by more than {SUCCESS_PCT:.0f} % and not named", "", {OURS: len(silent)}, 0.0
        )
        rows.add("windowed that are named", "", {OURS: float(sum(named(result, int(v)) for v in weak))})
    rows.intervals(run)
    return [rows.metrics]


def check_against_shared(bench: Bench) -> list[list[Metric]]:
    """Photographs of one camera without truth: one camera per image held against one for all.

    The focal lengths of a method are compared with its own answer for one camera, which is far more certain.
    """
    title = f"{bench.scene.name}, per-image against shared"
    runs = {cameras: bench.ours(cameras) for cameras in MODES}
    focals = {c: {OURS: _focals_of(model_of(run))} for c, run in runs.items()}
    for cameras in MODES:
        focals[cameras][COLMAP] = _focals_of(bench.colmap(cameras, "default", Start()))
    values: dict[str, dict[str, float | None]] = {"registered": {}, "median": {}, "worst": {}}
    for method in (OURS, COLMAP):
        alone, together = focals["per-image"][method], focals["shared"][method]
        off = 100.0 * np.abs(alone / np.nanmedian(together) - 1.0)
        values["registered"][method] = float(np.isfinite(alone).sum())
        values["median"][method], values["worst"][method] = float(np.nanmedian(off)), float(np.nanmax(off))
    metrics = [
        Metric(title, "cameras registered", "", values["registered"], OURS),
        Metric(title, "focal off the shared one, median", "%", values["median"], OURS),
        Metric(title, "focal off the shared one, worst", "%", values["worst"], OURS),
    ]
    run = runs["per-image"]
    if run is not None and run.metric is not None:
        result, shared = run.metric, float(np.nanmedian(focals["shared"][OURS]))
        unsure = _stated(runs["shared"])
        there = np.flatnonzero(result.reconstruction.registered)
        stated = [result.intrinsics[v]["focal_px"] for v in there]
        z = np.array([(f.value - shared) / max(np.hypot(f.std, unsure), 1e-12) for f in stated])
        held = float(np.mean(np.abs(z) <= LEVEL))
        silent = [
            v for v in there if abs(focals["per-image"][OURS][v] / shared - 1.0) > 0.01 * SUCCESS_PCT
            and not named(result, int(v))
        ]  # fmt: skip
        row = "95 % intervals of the focal that hold the shared one"
        metrics.append(Metric(title, row, "", {OURS: held}, OURS, LEAST_HOLDING, at_most=False))
        row = f"off by more than {SUCCESS_PCT:.0f} % and not named"
        metrics.append(Metric(title, row, "", {OURS: float(len(silent))}, OURS, 0.0))
    return [metrics]


def _stated(run: RunResult | None) -> float:
    """The sigma (px) that a run states of its focal length."""
    if run is None or run.metric is None:
        return 0.0
    return float(np.median([view["focal_px"].std for view in run.metric.intrinsics if view]))


def _focals_of(model: Reconstruction | None) -> np.ndarray:
    """Focal lengths (V,) px, NaN where a view is not registered."""
    if model is None or model.K is None:
        return np.array([np.nan])
    return np.where(model.registered, np.sqrt(model.K[:, 0, 0] * model.K[:, 1, 1]), np.nan)
