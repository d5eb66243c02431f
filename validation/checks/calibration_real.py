"""Self-calibration on real photographs beside COLMAP and the truth, nothing told of the cameras:
``python -m validation.checks.calibration_real -o OUT [--scenes NAME ...] [--parts PART ...]``.

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
from thesisrecon.errors import StageFailure
from thesisrecon.pipeline import reconstruct
from thesisrecon.selfcalibration import HypothesesAndRefinement
from thesisrecon.types import Reconstruction, RunResult
from validation.checks.calibration_parts import MODES, Cameras, check_parts
from validation.checks.reconstruction import COLMAP, COLMAP_PP, OURS
from validation.metrics.cameras import CameraErrors, TrueCameras, measure_cameras
from validation.metrics.intervals import focal_errors_pct, interval_scores, join_scores
from validation.metrics.record import Metric, markdown_table
from validation.references.pycolmap_reference import Start, map_with_pycolmap, match_with_pycolmap, read_run
from validation.scenes.real import Scene, load_real_scene
from validation.scenes.zoomed import central_scene, rezoom_scene

TRUE_K = "COLMAP, true K"
PARTS = ("cameras", "guesses", "centre", "zoom", "parts")
Config = Callable[[PipelineConfig], PipelineConfig]


@dataclass(frozen=True)
class Targets:
    """Of one set: focal %, principal point px, centres mm, rotations deg, with one camera for all."""

    focal_pct: float
    principal_point_px: float
    centre_mm: float
    rotation_deg: float


TARGETS = {
    "fountain-P11": Targets(0.15, 3.0, 3.3, 0.05),
    "Herz-Jesus-P8": Targets(0.25, 3.0, 4.0, 0.03),
}
PER_IMAGE_MEDIAN_PCT, PER_IMAGE_WORST_PCT = 0.2, 0.5
ZOOM_MEDIAN_PCT, ZOOM_WORST_PCT = 0.5, 3.0
GUESS_CHANGE_PCT = 0.02
LEAST_HOLDING = 0.92
"""Of the 95 % intervals: what chance leaves a study of a hundred of them."""


def truth_of(scene: Scene) -> TrueCameras:
    """The true cameras of a scene that has them."""
    assert scene.K is not None
    assert scene.R is not None
    assert scene.C is not None
    return TrueCameras(scene.K, scene.R, scene.C)


@dataclass(frozen=True)
class Bench:
    """Where the runs of one scene are kept, and how they are made."""

    scene: Scene
    out: Path
    threads: int = 2
    seed: int = 0

    def ours(self, cameras: Cameras, change: Config | None = None) -> RunResult | None:
        """A run of ours; the photographs are matched once for all of them. None where it fails."""
        config = PipelineConfig()
        config = replace(config, intrinsics=replace(config.intrinsics, cameras=cameras))
        config = config if change is None else change(config)
        images = list(self.scene.image_paths)
        try:
            return reconstruct(
                images, self.out / "ours", config=config, seed=self.seed, threads=self.threads, overwrite=True
            )
        except StageFailure as failure:
            print(f"{self.scene.name}: {cameras}: {failure}", flush=True)
            return None

    def colmap(self, cameras: Cameras, name: str, start: Start) -> Reconstruction | None:
        """A run of COLMAP, read where it is there already. None where it fails."""
        images, place = self.scene.image_paths[0].parent, self.out / f"colmap-{cameras}"
        try:
            if (place / name / "sparse" / "0").is_dir():
                return read_run(images, place / name).reconstruction
            if not (place / "matched" / "seconds.json").is_file():
                match_with_pycolmap(
                    images, place / "matched", shared_camera=cameras == "shared", threads=self.threads
                )
            run = map_with_pycolmap(
                images, place / "matched", place / name, start=start, threads=self.threads
            )
        except StageFailure as failure:
            print(f"{self.scene.name}: COLMAP, {name}: {failure}", flush=True)
            return None
        return run.reconstruction

    def methods(self, cameras: Cameras) -> tuple[RunResult | None, dict[str, Reconstruction | None]]:
        """Ours and COLMAP's models in this mode, COLMAP also with its principal point refined."""
        run = self.ours(cameras)
        models = {OURS: model_of(run), COLMAP: self.colmap(cameras, "default", Start())}
        models[COLMAP_PP] = self.colmap(cameras, "principal-point", Start(refine_principal_point=True))
        return run, models

    def colmap_true(self) -> Reconstruction | None:
        """COLMAP with the true calibration."""
        assert self.scene.K is not None
        K = {path.name: K for path, K in zip(self.scene.image_paths, self.scene.K, strict=True)}
        return self.colmap("per-image", "true-K", Start(K=K))


def model_of(run: RunResult | None) -> Reconstruction | None:
    """The metric model of a run; None without one."""
    return None if run is None or run.metric is None else run.metric.reconstruction


class Rows:
    """Rows of one table: the same quantities of several methods."""

    def __init__(self, title: str, scene: Scene, models: Mapping[str, Reconstruction | None]) -> None:
        self.title, self.models, self.metrics = title, models, list[Metric]()
        truth = truth_of(scene)
        self.K, self.total = truth.K, len(truth.K)
        self.errors = {m: None if r is None else measure_cameras(r, truth) for m, r in models.items()}

    def add(
        self, name: str, unit: str, values: Mapping[str, float | None], target: float | None = None
    ) -> None:
        """A row, at most ``target``."""
        self.metrics.append(Metric(self.title, name, unit, values, OURS, target))

    def registered(self) -> None:
        """Cameras of all."""
        values = {m: 0.0 if r is None else float(r.registered.sum()) for m, r in self.models.items()}
        name = f"cameras registered of {self.total}"
        self.metrics.append(Metric(self.title, name, "", values, OURS, float(self.total), at_most=False))

    def error(
        self,
        name: str,
        unit: str,
        read: Callable[[CameraErrors], float | None],
        target: float | None = None,
    ) -> None:
        """A row of one of the errors of the cameras."""
        self.add(name, unit, {m: None if e is None else read(e) for m, e in self.errors.items()}, target)

    def focals(self, median: float | None = None, worst: float | None = None) -> None:
        """Median and worst focal error of the views."""
        errors = {m: self._focals(r) for m, r in self.models.items()}
        self.add("focal error, median", "%", {m: _of(np.median, e) for m, e in errors.items()}, median)
        self.add("focal error, worst", "%", {m: _of(np.max, e) for m, e in errors.items()}, worst)

    def _focals(self, model: Reconstruction | None) -> np.ndarray | None:
        if model is None or model.K is None or not model.registered.any():
            return None
        return focal_errors_pct(model.K, self.K)[model.registered]

    def poses(self, targets: Targets | None = None) -> None:
        """Centres and rotations."""
        t = targets
        self.error("camera centres, mean", "mm", _centre_mm, None if t is None else t.centre_mm)
        self.error(
            "camera rotations, median",
            "deg",
            lambda e: e.rotation_error_deg,
            None if t is None else t.rotation_deg,
        )

    def intervals(self, run: RunResult | None, least: float | None = LEAST_HOLDING) -> None:
        """What the 95 % intervals of focal and principal point hold, and how wide they are."""
        if run is None or run.metric is None:
            return
        scores = interval_scores(run.metric, self.K)
        for name, columns in (("focal", (0,)), ("principal point", (1, 2))):
            held = {OURS: scores.holding(columns)}
            row = f"95 % intervals of the {name} that hold the truth"
            self.metrics.append(Metric(self.title, row, "", held, OURS, least, at_most=False))
            self.add(f"largest deviation, {name}", "stated sigmas", {OURS: scores.worst(columns)})
        width = 100.0 * scores.std_rel
        self.add("stated sigma of the focal, median", "%", {OURS: float(np.nanmedian(width))})
        self.add("trusted by the self-check", "", {OURS: float(run.metric.trusted)})


def _of(reduce: Callable[[np.ndarray], float], values: np.ndarray | None) -> float | None:
    return None if values is None or not len(values) else float(reduce(values))


def _centre_mm(errors: CameraErrors) -> float | None:
    return None if errors.centre_error is None else 1000.0 * errors.centre_error


# ---------------------------------------------------------------- the set as it is


def check_cameras(bench: Bench) -> list[list[Metric]]:
    """One camera for all photographs, and one for each."""
    targets = TARGETS.get(bench.scene.name)
    tables = []
    for cameras in MODES:
        run, models = bench.methods(cameras)
        rows = Rows(f"{bench.scene.name}, {cameras}", bench.scene, {**models, TRUE_K: bench.colmap_true()})
        rows.registered()
        shared = targets if cameras == "shared" else None
        if cameras == "shared":
            rows.error(
                "focal error", "%", lambda e: e.focal_error_pct, None if shared is None else shared.focal_pct
            )
        else:
            rows.focals(PER_IMAGE_MEDIAN_PCT, PER_IMAGE_WORST_PCT)
        rows.error(
            "principal point error",
            "px",
            lambda e: e.principal_point_error_px,
            None if shared is None else shared.principal_point_px,
        )
        rows.poses(shared)
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
            pooled.setdefault(method, []).append(_all_focals(rows, model))
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


def _all_focals(rows: Rows, model: Reconstruction | None) -> np.ndarray:
    """Focal errors of all views, those that are not registered infinitely wrong."""
    errors = None if model is None or model.K is None else focal_errors_pct(model.K, rows.K)
    return np.full(rows.total, np.inf) if errors is None else np.nan_to_num(errors, nan=np.inf)


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
    (out / "calibration_real.md").write_text("\n".join(text), encoding="utf-8")
    (out / "calibration_real.json").write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


def measure(bench: Bench, parts: Sequence[str], seeds: Sequence[int]) -> list[list[Metric]]:
    """The tables of one set."""
    checks: dict[str, Callable[[], list[list[Metric]]]] = {
        "cameras": lambda: check_cameras(bench),
        "guesses": lambda: check_guesses(bench),
        "centre": lambda: check_centre(bench),
        "zoom": lambda: check_zoom(bench, seeds),
        "parts": lambda: check_parts(bench.scene.name, bench.ours("shared"), truth_of(bench.scene)),
    }
    tables = []
    for part in parts:
        found = checks[part]()
        for rows in found:
            print(f"\n{rows[0].scene}\n\n{markdown_table(list(rows))}", flush=True)
        tables += found
    return tables


def main(arguments: list[str] | None = None) -> int:
    """Measure, write, and say whether every target was reached."""
    parser = argparse.ArgumentParser(prog="python -m validation.checks.calibration_real", description=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--scenes", nargs="+", default=list(TARGETS), choices=list(TARGETS))
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
