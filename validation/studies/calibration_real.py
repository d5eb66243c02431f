"""Self-calibration of real images beside COLMAP and the truth, without prior knowledge of the cameras.

Either program matches each set once. The later stages run with one camera for all images and with one for
each; on the images as they are, zoomed and cropped, and with every third image reduced to a window. OUT keeps
all runs, which are not repeated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from thesisrecon.api.reconstruct import reconstruct
from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure
from thesisrecon.records import Reconstruction
from thesisrecon.results import RunResult
from validation.harness.gates import camera_limit
from validation.harness.scenes import truth_of
from validation.metrics.cameras import measure_cameras
from validation.metrics.intervals import LEVEL, focal_errors_pct, interval_scores, join_scores
from validation.metrics.record import Metric
from validation.references.colmap import Start, map_with_pycolmap, match_with_pycolmap, read_run
from validation.scenes.real import REAL_SCENES, Scene
from validation.scenes.zoomed import rezoom_scene, windowed_scene
from validation.studies.coverage import (
    COLUMNS,
    MIN_HOLDING,
    MODES,
    SUCCESS_PCT,
    Cameras,
    add_intervals,
    named,
)
from validation.studies.main_job import COLMAP, COLMAP_PP, OURS
from validation.studies.runner import Part, Rows, report_progress, scenes_here


@dataclass(frozen=True)
class Bench:
    """One scene and the folder that keeps its runs."""

    scene: Scene
    out: Path
    threads: int = 2

    def ours(self, cameras: Cameras) -> RunResult | None:
        """Run ours; the images are matched once for all runs. None if it fails."""
        config = PipelineConfig()
        config = replace(config, intrinsics=replace(config.intrinsics, cameras=cameras))
        images = list(self.scene.image_paths)
        try:
            return reconstruct(
                images, self.out / "ours",
                config=config, threads=self.threads, until="metric", overwrite=True,
            )  # fmt: skip
        except StageFailure as failure:
            report_progress(f"{self.scene.name}: {cameras}: {failure}")
            return None

    def colmap(self, cameras: Cameras, name: str, start: Start) -> Reconstruction | None:
        """Run COLMAP, or read an earlier run. None if it fails."""
        images, place = self.scene.image_paths[0].parent, self.out / f"colmap-{cameras}"
        try:
            if not (place / "matched" / "seconds.json").is_file():
                match_with_pycolmap(
                    images, place / "matched", shared_camera=cameras == "shared", threads=self.threads
                )
            if not (place / name / "sparse" / "0").is_dir():
                map_with_pycolmap(images, place / "matched", place / name, start=start, threads=self.threads)
            return read_run(images, place / name).reconstruction
        except StageFailure as failure:
            report_progress(f"{self.scene.name}: COLMAP, {name}: {failure}")
            return None

    def methods(self, cameras: Cameras) -> tuple[RunResult | None, dict[str, Reconstruction | None]]:
        """Return our run and the models of ours and of COLMAP, also with its principal point refined."""
        run = self.ours(cameras)
        models = {OURS: model_of(run), COLMAP: self.colmap(cameras, "default", Start())}
        models[COLMAP_PP] = self.colmap(cameras, "principal-point", Start(refine_principal_point=True))
        return run, models

    def colmap_true(self) -> Reconstruction | None:
        assert self.scene.K is not None
        K = {path.name: K for path, K in zip(self.scene.image_paths, self.scene.K, strict=True)}
        return self.colmap("per-image", "true-K", Start(K=K))


def model_of(run: RunResult | None) -> Reconstruction | None:
    return None if run is None or run.metric is None else run.metric.reconstruction


class CameraRows(Rows):
    """Rows with the same quantities of several methods on one scene."""

    def __init__(self, title: str, scene: Scene, models: Mapping[str, Reconstruction | None]) -> None:
        super().__init__(title, OURS)
        truth = truth_of(scene)
        assert truth is not None
        self.models, self.K, self.total = models, truth.K, len(truth.K)
        self.errors = {m: None if r is None else measure_cameras(r, truth) for m, r in models.items()}

    def registered(self) -> None:
        values = {m: 0.0 if r is None else float(r.registered.sum()) for m, r in self.models.items()}
        self.add(f"cameras registered of {self.total}", values, at_least=float(self.total))

    def focals(self, median: float | None = None, worst: float | None = None) -> None:
        errors = {m: self.all_focals(r) for m, r in self.models.items()}
        for name, reduce, bound in (("median", np.median, median), ("worst", np.max, worst)):
            values = {m: reduced(reduce, e) for m, e in errors.items()}
            self.add(f"focal error, {name}", values, "%", at_most=bound)

    def all_focals(self, model: Reconstruction | None) -> np.ndarray:
        """Return focal errors (V,) in percent of all views, infinite if a view is not registered."""
        errors = None if model is None or model.K is None else focal_errors_pct(model.K, self.K)
        return np.full(self.total, np.inf) if errors is None else np.nan_to_num(errors, nan=np.inf)

    def poses(self, centre_mm: float | None = None, rotation_deg: float | None = None) -> None:
        self.each("camera centres, mean", self.errors, lambda e: e.centre_error_mm, "mm", centre_mm)
        self.each(
            "camera rotations, median", self.errors, lambda e: e.rotation_error_deg, "deg", rotation_deg
        )

    def principal_point(self, bound: float | None = None) -> None:
        self.each("principal point error", self.errors, lambda e: e.principal_point_error_px, "px", bound)

    def intervals(self, run: RunResult | None, least: float | None = MIN_HOLDING) -> None:
        if run is None or run.metric is None:
            return
        add_intervals(self, interval_scores(run.metric, self.K), least)
        self.add("trusted by the self-check", run.metric.trusted, at_least=1.0)


def reduced(reduce: Callable[[np.ndarray], float], errors: np.ndarray) -> float | None:
    """Return the median or the like of the finite errors, None without any."""
    finite = errors[np.isfinite(errors)]
    return float(reduce(finite)) if len(finite) else None


WINDOW = 0.3, 0.45
"""Width and height of the windows over those of an image."""


def check_wide(bench: Bench) -> Iterator[list[Metric]]:
    """Calibrate with one camera per image when every third image keeps only a window."""
    rng, weak = np.random.default_rng(11), np.arange(1, len(bench.scene.image_paths), 3)
    corners = rng.uniform(0.1, 0.9 - np.array(WINDOW), (len(weak), 2))
    boxes = {int(v): np.hstack([corner, corner + WINDOW]) for v, corner in zip(weak, corners, strict=True)}
    here = _variant(bench, "wide", partial(windowed_scene, boxes=boxes))
    run, models = here.methods("per-image")
    rows = CameraRows(f"{bench.scene.name}, windows of {len(weak)} images, per-image", here.scene, models)
    rows.registered()
    errors = {m: rows.all_focals(model) for m, model in models.items()}
    for label, views in (("whole", np.setdiff1d(np.arange(rows.total), weak)), ("windowed", weak)):
        for name, reduce in (("median", np.median), ("worst", np.max)):
            values = {m: reduced(reduce, e[views]) for m, e in errors.items()}
            rows.add(f"focal error of the {label}, {name}", values, "%")
    if run is not None and run.metric is not None:
        marked = [named(run.metric, int(v)) for v in weak]
        silent = sum(errors[OURS][v] > SUCCESS_PCT and not m for v, m in zip(weak, marked, strict=True))
        rows.add(f"windowed, off by more than {SUCCESS_PCT:.0f} % and not marked", silent, at_most=0.0)
        rows.add("windowed that are marked", sum(marked))
    rows.intervals(run)
    yield rows


def check_against_shared(bench: Bench) -> Iterator[list[Metric]]:
    """Compare one camera per image with one for all, on images without truth.

    The result for a shared camera is far more certain and stands in for the truth.
    """
    runs = {cameras: bench.ours(cameras) for cameras in MODES}
    focals = {c: {OURS: _focals_of(model_of(run))} for c, run in runs.items()}
    for cameras in MODES:
        focals[cameras][COLMAP] = _focals_of(bench.colmap(cameras, "default", Start()))
    alone, shared = focals["per-image"], {m: np.nanmedian(f) for m, f in focals["shared"].items()}
    off = {m: 100.0 * np.abs(f / shared[m] - 1.0) for m, f in alone.items()}
    rows = Rows(f"{bench.scene.name}, per-image against shared", OURS)
    rows.add("cameras registered", {m: float(np.isfinite(f).sum()) for m, f in alone.items()})
    rows.add("focal off the shared one, median", {m: float(np.nanmedian(o)) for m, o in off.items()}, "%")
    rows.add("focal off the shared one, worst", {m: float(np.nanmax(o)) for m, o in off.items()}, "%")
    run = runs["per-image"]
    if run is not None and run.metric is not None:
        there = np.flatnonzero(run.metric.reconstruction.registered)
        stated = [run.metric.intrinsics[v]["focal_px"] for v in there]
        std = _stated(runs["shared"])
        z = np.array([(f.value - shared[OURS]) / max(np.hypot(f.std, std), 1e-12) for f in stated])
        silent = sum(off[OURS][v] > SUCCESS_PCT and not named(run.metric, int(v)) for v in there)
        held = float(np.mean(np.abs(z) <= LEVEL))
        rows.add("95 % intervals of the focal that hold the shared one", held, at_least=MIN_HOLDING)
        rows.add(f"off by more than {SUCCESS_PCT:.0f} % and not marked", silent, at_most=0.0)
    yield rows


def _stated(run: RunResult | None) -> float:
    """Return the standard deviation (px) of the focal length that a run states."""
    if run is None or run.metric is None:
        return 0.0
    return float(np.median([view["focal_px"].std for view in run.metric.intrinsics if view]))


def _focals_of(model: Reconstruction | None) -> np.ndarray:
    """Return focal lengths (V,) px, NaN if a view is not registered."""
    if model is None or model.K is None:
        return np.array([np.nan])
    return np.where(model.registered, np.sqrt(model.K[:, 0, 0] * model.K[:, 1, 1]), np.nan)


TRUE_K = "COLMAP, true K"


ZOOM_MEDIAN_PCT, ZOOM_WORST_PCT = 0.5, 3.0


def check_cameras(bench: Bench) -> Iterator[list[Metric]]:
    """Calibrate with one camera for all images and with one for each, bounded by the gates of the report."""
    limit = partial(camera_limit, bench.scene.name)
    for cameras in MODES:
        run, models = bench.methods(cameras)
        title = f"{bench.scene.name}, {cameras}"
        rows = CameraRows(title, bench.scene, {**models, TRUE_K: bench.colmap_true()})
        rows.registered()
        if cameras == "shared":
            rows.each("focal error", rows.errors, lambda e: e.focal_error_pct, "%", limit("focal-error"))
            rows.principal_point(limit("principal-point-error"))
            rows.poses(limit("centre-error"), limit("rotation-error"))
        else:
            rows.focals(limit("focal-error-a-camera-each"), limit("worst-focal-error-a-camera-each"))
            rows.principal_point()
            rows.poses()
        # A shared camera is one value, inside its interval or not.
        rows.intervals(run, 1.0 if cameras == "shared" else MIN_HOLDING)
        yield rows


def _variant(bench: Bench, name: str, change: Callable[[Scene, Path], Scene]) -> Bench:
    scene = change(bench.scene, bench.out / name / "images")
    return replace(bench, scene=scene, out=bench.out / name)


def check_zoom(bench: Bench, seeds: Sequence[int]) -> Iterator[list[Metric]]:
    """Calibrate images that are zoomed and cropped each on its own: a table per seed and one of all."""
    pooled: dict[str, list[np.ndarray]] = {}
    scores = []
    title = f"{bench.scene.name}, zoomed and cropped"
    for seed in seeds:
        here = _variant(bench, f"zoom-{seed}", partial(rezoom_scene, seed=seed))
        run, models = here.methods("per-image")
        rows = CameraRows(f"{title}, seed {seed}", here.scene, models)
        rows.registered()
        rows.focals(ZOOM_MEDIAN_PCT, ZOOM_WORST_PCT)
        rows.principal_point()
        rows.poses()
        rows.intervals(run)
        yield rows
        for method, model in models.items():
            pooled.setdefault(method, []).append(rows.all_focals(model))
        if run is not None and run.metric is not None:
            scores.append(interval_scores(run.metric, rows.K))
    every = _pooled(f"{title}, all seeds", pooled)
    for name, columns in COLUMNS.items() if scores else ():
        share = join_scores(scores).holding(columns)
        every.add(f"95 % intervals of the {name} that hold the truth", share, at_least=MIN_HOLDING)
    yield every


def _pooled(title: str, pooled: Mapping[str, list[np.ndarray]]) -> Rows:
    together = {method: np.concatenate(errors) for method, errors in pooled.items()}
    total, rows = len(next(iter(together.values()))), Rows(title, OURS)
    registered = {m: float(np.isfinite(e).sum()) for m, e in together.items()}
    rows.add(f"cameras registered of {total}", registered, at_least=float(total))
    median = {m: float(np.median(e)) for m, e in together.items()}
    rows.add("focal error, median", median, "%", at_most=ZOOM_MEDIAN_PCT)
    worst = {m: float(np.max(e[np.isfinite(e)], initial=0.0)) for m, e in together.items()}
    rows.add("focal error, worst", worst, "%", at_most=ZOOM_WORST_PCT)
    return rows


Name = Literal["cameras", "zoom", "wide"]


def calibration_real_study(
    out: Path,
    scenes: Sequence[str] = tuple(REAL_SCENES),
    parts: Sequence[Name] = ("cameras", "zoom", "wide"),
    seeds: Sequence[int] = (0, 1, 2),
    threads: int = 2,
) -> Iterator[Part]:
    """Compare self-calibration of real images with COLMAP and the truth."""
    for scene in scenes_here(scenes):
        bench = Bench(scene, out / scene.name, threads)
        checks: dict[str, Callable[[Bench], Iterable[list[Metric]]]] = {
            "cameras": check_cameras,
            "zoom": partial(check_zoom, seeds=seeds),
            "wide": check_wide,
        }
        if scene.has_truth:
            for part in parts:
                yield from checks[part](bench)
        else:
            yield from check_against_shared(bench)
