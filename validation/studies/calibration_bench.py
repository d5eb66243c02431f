"""The bench of self-calibration on real photographs: runs of ours and of COLMAP that are kept in a folder,
and rows of the same quantities of several methods."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thesisrecon.config import PipelineConfig
from thesisrecon.errors import StageFailure
from thesisrecon.pipeline.reconstruction import reconstruct
from thesisrecon.records import Reconstruction, RunResult
from validation.studies.calibration_parts import LEAST_HOLDING, Cameras
from validation.studies.reconstruction import COLMAP, COLMAP_PP, OURS
from validation.metrics.cameras import CameraErrors, TrueCameras, measure_cameras
from validation.metrics.intervals import focal_errors_pct, interval_scores
from validation.metrics.record import Metric
from validation.references.colmap_mapping import Start, map_with_pycolmap, read_run
from validation.references.colmap_matching import match_with_pycolmap
from validation.scenes.real import Scene

Config = Callable[[PipelineConfig], PipelineConfig]


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
                images,
                self.out / "ours",
                config=config,
                seed=self.seed,
                threads=self.threads,
                until="metric",
                overwrite=True,
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
        self.add("focal error, median", "%", {m: reduced(np.median, e) for m, e in errors.items()}, median)
        self.add("focal error, worst", "%", {m: reduced(np.max, e) for m, e in errors.items()}, worst)

    def _focals(self, model: Reconstruction | None) -> np.ndarray | None:
        if model is None or model.K is None or not model.registered.any():
            return None
        return focal_errors_pct(model.K, self.K)[model.registered]

    def all_focals(self, model: Reconstruction | None) -> np.ndarray:
        """Focal errors (V,) in percent of all views, infinite where one is not registered."""
        errors = None if model is None or model.K is None else focal_errors_pct(model.K, self.K)
        return np.full(self.total, np.inf) if errors is None else np.nan_to_num(errors, nan=np.inf)

    def poses(self, centre_mm: float | None = None, rotation_deg: float | None = None) -> None:
        """Centres and rotations."""
        self.error("camera centres, mean", "mm", _centre_mm, centre_mm)
        self.error("camera rotations, median", "deg", lambda e: e.rotation_error_deg, rotation_deg)

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
        sure = {OURS: float(run.metric.trusted)}
        self.metrics.append(
            Metric(self.title, "trusted by the self-check", "", sure, OURS, 1.0, at_most=False)
        )


def reduced(reduce: Callable[[np.ndarray], float], values: np.ndarray | None) -> float | None:
    """One number of many; None without any."""
    return None if values is None or not len(values) else float(reduce(values))


def _centre_mm(errors: CameraErrors) -> float | None:
    return None if errors.centre_error is None else 1000.0 * errors.centre_error
