"""Self-calibration on real photographs beside COLMAP and the truth, nothing told of the cameras:
``python -m validation.studies.calibration_real -o OUT [--scenes NAME ...] [--parts PART ...]``.

Each set is matched once by either program; what follows the matches is run with one camera for all
photographs and with one for each, on the photographs as they are, on zoomed and cropped ones, on their
central parts, with wrong guesses of the focal length, and on parts of the set. OUT gets
``calibration_real.md`` and ``calibration_real.json``, and keeps all runs: what is there is not run again. The
exit code is 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from thesisrecon.config import PipelineConfig
from thesisrecon.io.files import write_text
from thesisrecon.records import Reconstruction
from thesisrecon.selfcalibration.hypotheses import HypothesesAndRefinement
from validation.studies.calibration_bench import Bench, Config, Rows, model_of, truth_of
from validation.studies.calibration_parts import LEAST_HOLDING, MODES, check_parts
from validation.studies.calibration_wide import check_against_shared, check_wide
from validation.studies.reconstruction import COLMAP, OURS
from validation.metrics.intervals import interval_scores, join_scores
from validation.metrics.record import Metric, markdown_table
from validation.references.colmap_mapping import Start
from validation.scenes.real import REAL_SCENES, load_real_scene
from validation.scenes.zoomed import central_scene, rezoom_scene

TRUE_K = "COLMAP, true K"
PARTS = ("cameras", "guesses", "centre", "zoom", "wide", "parts")


@dataclass(frozen=True)
class Targets:
    """Of one set: focal %, principal point px, centres mm, rotations deg, with one camera for all."""

    focal_pct: float | None = None
    principal_point_px: float | None = None
    centre_mm: float | None = None
    rotation_deg: float | None = None


TARGETS = {
    "fountain-P11": Targets(0.15, 3.0, 3.3, 0.05),
    "Herz-Jesus-P8": Targets(0.25, 3.0, 4.0, 0.03),
}
PER_IMAGE_MEDIAN_PCT, PER_IMAGE_WORST_PCT = 0.2, 0.5
ZOOM_MEDIAN_PCT, ZOOM_WORST_PCT = 0.5, 3.0
GUESS_CHANGE_PCT = 0.02
# ---------------------------------------------------------------- the set as it is


def check_cameras(bench: Bench) -> list[list[Metric]]:
    """One camera for all photographs, and one for each."""
    tables = []
    for cameras in MODES:
        run, models = bench.methods(cameras)
        rows = Rows(f"{bench.scene.name}, {cameras}", bench.scene, {**models, TRUE_K: bench.colmap_true()})
        rows.registered()
        target = TARGETS[bench.scene.name] if cameras == "shared" else Targets()
        if cameras == "shared":
            rows.error("focal error", "%", lambda e: e.focal_error_pct, target.focal_pct)
        else:
            rows.focals(PER_IMAGE_MEDIAN_PCT, PER_IMAGE_WORST_PCT)
        rows.error(
            "principal point error", "px", lambda e: e.principal_point_error_px, target.principal_point_px
        )
        rows.poses(target.centre_mm, target.rotation_deg)
        # A value that all views share is one value: it is in its interval or not.
        rows.intervals(run, 1.0 if cameras == "shared" else LEAST_HOLDING)
        tables.append(rows.metrics)
    return tables


# ---------------------------------------------------------------- guesses that are wrong


def check_guesses(bench: Bench) -> list[list[Metric]]:
    """How far the focal length moves when what it starts from is five times too long or too short.

    Ours starts from no guess. What comes nearest to one is the weak pull of self-calibration and a prior of
    the user that is wrong by its own sigma.
    """
    assert bench.scene.K is not None
    true, title = float(np.median(bench.scene.K[:, 0, 0])), f"{bench.scene.name}, wrong guesses"
    ours = _focal(model_of(bench.ours("shared")))
    colmap = _focal(bench.colmap("shared", "default", Start()))
    metrics = []
    for word, factor in (("long", 5.0), ("short", 0.2)):
        start = Start(focal_rel=1.2 * factor)
        pulled = _focal(model_of(bench.ours("shared", _pulled(factor))))
        told = _focal(model_of(bench.ours("shared", _told(factor * true))))
        theirs = _focal(bench.colmap("shared", f"five-times-too-{word}", start))
        values = {OURS: _change_pct(pulled, ours), COLMAP: _change_pct(theirs, colmap)}
        name = f"focal change, default guess five times too {word}"
        metrics.append(Metric(title, name, "%", values, OURS, GUESS_CHANGE_PCT))
        name = f"focal change, prior five times too {word}, within a factor of five"
        metrics.append(Metric(title, name, "%", {OURS: _change_pct(told, ours)}, OURS, GUESS_CHANGE_PCT))
    return [metrics]


def _pulled(factor: float) -> Config:
    """The weak pull of the focal toward a value that is wrong by ``factor``."""

    def change(config: PipelineConfig) -> PipelineConfig:
        method = config.selfcalibration
        assert isinstance(method, HypothesesAndRefinement)
        there = method.criterion.focal_log_mean + float(np.log(factor))
        criterion = replace(method.criterion, focal_log_mean=there)
        return replace(config, selfcalibration=replace(method, criterion=criterion))

    return change


def _told(focal_px: float) -> Config:
    """A prior at ``focal_px`` with a sigma of a factor of five."""

    def change(config: PipelineConfig) -> PipelineConfig:
        wish = replace(config.intrinsics, focal_px=focal_px, focal_std_rel=float(np.log(5.0)))
        return replace(config, intrinsics=wish)

    return change


def _focal(model: Reconstruction | None) -> float | None:
    if model is None or model.K is None or not model.registered.any():
        return None
    return float(np.median(model.K[model.registered, 0, 0]))


def _change_pct(value: float | None, reference: float | None) -> float | None:
    return None if value is None or reference is None else 100.0 * abs(value / reference - 1.0)


# ---------------------------------------------------------------- other lenses


def check_centre(bench: Bench) -> list[list[Metric]]:
    """The central quarter of every photograph: a lens twice as long, at its own size and enlarged."""
    tables = []
    for zoom in (1.0, 2.0):
        name = f"centre-{zoom:g}"
        scene = central_scene(bench.scene, bench.out / name / "images", zoom=zoom)
        here = replace(bench, scene=scene, out=bench.out / name)
        run, models = here.methods("shared")
        rows = Rows(
            f"{bench.scene.name}, central quarter, {'enlarged' if zoom > 1 else 'as it is'}", scene, models
        )
        rows.registered()
        rows.error("focal error", "%", lambda e: e.focal_error_pct)
        rows.error("principal point error", "px", lambda e: e.principal_point_error_px)
        rows.poses()
        rows.intervals(run, 1.0)
        tables.append(rows.metrics)
    return tables


def check_zoom(bench: Bench, seeds: Sequence[int]) -> list[list[Metric]]:
    """Every photograph zoomed and cropped for itself, one camera per image: a table for each seed and one of
    them all."""
    tables = []
    pooled: dict[str, list[np.ndarray]] = {}
    scores = []
    title = f"{bench.scene.name}, zoomed and cropped"
    for seed in seeds:
        scene = rezoom_scene(bench.scene, bench.out / f"zoom-{seed}" / "images", seed=seed)
        here = replace(bench, scene=scene, out=bench.out / f"zoom-{seed}")
        run, models = here.methods("per-image")
        rows = Rows(f"{title}, seed {seed}", scene, models)
        rows.registered()
        rows.focals(ZOOM_MEDIAN_PCT, ZOOM_WORST_PCT)
        rows.error("principal point error", "px", lambda e: e.principal_point_error_px)
        rows.poses()
        rows.intervals(run)
        tables.append(rows.metrics)
        for method, model in models.items():
            pooled.setdefault(method, []).append(rows.all_focals(model))
        if run is not None and run.metric is not None:
            scores.append(interval_scores(run.metric, rows.K))
    tables.append(_pooled(f"{title}, all seeds", pooled))
    if scores:
        joined = join_scores(scores)
        for name, columns in (("focal", (0,)), ("principal point", (1, 2))):
            row = f"95 % intervals of the {name} that hold the truth"
            held = {OURS: joined.holding(columns)}
            tables[-1].append(Metric(title, row, "", held, OURS, LEAST_HOLDING, at_most=False))
    return tables


def _pooled(title: str, pooled: Mapping[str, list[np.ndarray]]) -> list[Metric]:
    together = {method: np.concatenate(errors) for method, errors in pooled.items()}
    registered = {m: float(np.isfinite(e).sum()) for m, e in together.items()}
    total = len(next(iter(together.values())))
    median = {m: float(np.median(e)) for m, e in together.items()}
    worst = {m: float(np.max(e[np.isfinite(e)], initial=0.0)) for m, e in together.items()}
    return [
        Metric(title, f"cameras registered of {total}", "", registered, OURS, float(total), at_most=False),
        Metric(title, "focal error, median", "%", median, OURS, ZOOM_MEDIAN_PCT),
        Metric(title, "focal error, worst", "%", worst, OURS, ZOOM_WORST_PCT),
    ]


# ---------------------------------------------------------------- the command


def write_results(out: Path, tables: Sequence[Sequence[Metric]]) -> None:
    """``calibration_real.md`` and ``calibration_real.json`` in ``out``."""
    text = ["# Self-calibration on real photographs", ""]
    for rows in tables:
        text += [f"## {rows[0].scene}", "", markdown_table(list(rows)), ""]
    told = [{**asdict(metric), "verdict": metric.verdict} for rows in tables for metric in rows]
    write_text(out / "calibration_real.md", "\n".join(text))
    write_text(out / "calibration_real.json", json.dumps(told, indent=1) + "\n")


def measure(bench: Bench, parts: Sequence[str], seeds: Sequence[int]) -> list[list[Metric]]:
    """The tables of one set."""
    checks: dict[str, Callable[[], list[list[Metric]]]] = {
        "cameras": lambda: check_cameras(bench),
        "guesses": lambda: check_guesses(bench),
        "centre": lambda: check_centre(bench),
        "zoom": lambda: check_zoom(bench, seeds),
        "wide": lambda: check_wide(bench),
        "parts": lambda: check_parts(bench.scene.name, bench.ours("shared"), truth_of(bench.scene)),
    }
    tables = []
    if not bench.scene.has_truth:
        checks, parts = {"against shared": lambda: check_against_shared(bench)}, ["against shared"]
    for part in parts:
        found = checks[part]()
        for rows in found:
            print(f"\n{rows[0].scene}\n\n{markdown_table(list(rows))}", flush=True)
        tables += found
    return tables


def main(arguments: list[str] | None = None) -> int:
    """Measure, write, and say whether every target was reached."""
    parser = argparse.ArgumentParser(prog="python -m validation.studies.calibration_real", description=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--scenes", nargs="+", default=list(REAL_SCENES), choices=list(REAL_SCENES))
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=PARTS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of the zoomed sets")
    parser.add_argument("--threads", type=int, default=2)
    wishes = parser.parse_args(arguments)
    out = wishes.out.resolve()
    tables: list[list[Metric]] = []
    for name in wishes.scenes:
        scene = load_real_scene(name)
        if scene is None:
            print(f"{name}: its photographs are not on this machine, left out", flush=True)
            continue
        tables += measure(Bench(scene, out / name, wishes.threads), wishes.parts, wishes.seeds)
        # Written after each scene, so that a run cut short keeps what it has.
        write_results(out, tables)
    if not tables:
        parser.error("none of these scenes is on this machine")
    return int(any(metric.verdict == "missed" for rows in tables for metric in rows))


if __name__ == "__main__":
    sys.exit(main())
